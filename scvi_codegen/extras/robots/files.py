"""Lagrangian systems of the files of robots, URDF and MJCF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

from scvi_codegen.common.errors import SystemDefinitionError, SystemDefinitionWarning, warn
from scvi_codegen.extras.robots.trees.closures import conditions_of
from scvi_codegen.extras.robots.trees.contacts import contacts_of
from scvi_codegen.extras.robots.trees.energies import exact_number, system_of_tree
from scvi_codegen.extras.robots.trees.keyframes import keyframe as keyframe
from scvi_codegen.extras.robots.trees.keyframes import outside_limits
from scvi_codegen.extras.robots.trees.mjcf import links_of_mjcf
from scvi_codegen.extras.robots.trees.tendons import contacts_of_tendons, energies_of
from scvi_codegen.extras.robots.trees.urdf import links_of_urdf

if TYPE_CHECKING:
    from scvi_codegen.systems.lagrangian import LagrangianSystem


def of_urdf(
    kind: type[LagrangianSystem],
    path: str | PathLike[str],
    *,
    parts: Mapping[str, str],
    floating: bool,
    gravity: Sequence[float],
    name: str | None,
    **how: Any,
) -> LagrangianSystem:
    """Return the system of a URDF file, see :meth:`LagrangianSystem.from_urdf`; ``parts``: what is read or ignored."""
    robot, links = links_of_urdf(path, floating=floating, parts=_read(parts))
    return _of_tree(kind, path, name or robot, links, gravity, **how)


def of_mjcf(
    kind: type[LagrangianSystem],
    path: str | PathLike[str],
    *,
    parts: Mapping[str, str],
    actuators: bool,
    name: str | None,
    **how: Any,
) -> LagrangianSystem:
    """Return the system of an MJCF file, see :meth:`LagrangianSystem.from_mjcf`; ``parts``: what is read or ignored."""
    model, links, gravity, *others = links_of_mjcf(path, [*_read(parts), *["actuators"] * actuators])
    return _of_tree(kind, path, name or model, links, gravity, *others, **how)


def _read(parts: Mapping[str, str]) -> list[str]:
    """Return the names of the parts of a robot that are not ignored."""
    return [part for part, how in parts.items() if how != "ignore"]


def _of_tree(
    kind: type[LagrangianSystem],
    path: Any,
    name: str,
    links: Any,
    gravity: Any,
    *others: Any,
    actuated: Any,
    check_inertias: bool,
    law: tuple[float, str],
) -> LagrangianSystem:
    try:
        closures, tendons, touches, actuators, keys = others or ((), (), (), (), {})
        of_impacts = {"restitution": exact_number(law[0]), "impacts": law[1]}
        touching = contacts_of(links, touches, of_impacts) + contacts_of_tendons(links, tendons, of_impacts)
        added = (
            conditions_of(links, closures),
            check_inertias,
            energies_of(links, tendons),
            touching,
            of_impacts,
            actuators,
        )
        system: LagrangianSystem = system_of_tree(kind, name, links, gravity, actuated, *added, keys=keys)
    except SystemDefinitionError as error:
        raise SystemDefinitionError(f"{path}: {error}") from error
    if beyond := outside_limits(system.contacts, system.keyframes):
        remedy = "pass other positions, correct ref, qpos or range, or limits='ignore'"
        warn(f"{path}: no run begins outside limits, as {beyond}: {remedy}", SystemDefinitionWarning)
    return system
