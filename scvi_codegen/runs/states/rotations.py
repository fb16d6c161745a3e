"""States of systems with rotations, directions and spins by name, as homogeneous coordinates and momenta."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.codegen.rendering.source import COMPONENTS
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.runs.states.attitudes import (
    matrices,
    momenta_of_body,
    quaternions,
    scaled_vectors,
    velocities_of_body,
)
from scvi_codegen.runs.states.validation import Array, common_shape
from scvi_codegen.runs.states.words import Shapes

if TYPE_CHECKING:
    from scvi_codegen.systems.system import MechanicalSystem


TANGENT = 1e-6
"""Largest component along a direction of its velocity or momentum, relative to these, which typed digits explain."""


@dataclass(frozen=True, slots=True)
class Member:
    """Rotation, direction or spin of a compiled system.

    Attributes:
        kind: ``"rotation"``, ``"direction"`` or ``"spin"``.
        name, rate: its name, and that of its angular velocity or, in a Hamiltonian, momentum.
        columns: its homogeneous coordinates among all; of an array of members their indices (.., k).
        momentum: whether ``rate`` names a momentum.
    """

    kind: str
    name: str
    rate: str
    columns: Any
    momentum: bool = False


def members_of(dimension: int, declarations: Sequence[str]) -> tuple[Member, ...]:
    """Return the rotations, directions and spins of a system, whose coordinates follow the ordinary ones."""
    parts = [text.split() for text in declarations]
    first = dimension - sum(COMPONENTS[kind] for kind, *_ in parts)
    members = []
    for kind, name, *rate in parts:
        columns = slice(first, first + COMPONENTS[kind])
        members.append(Member(kind, name, rate[0] if rate else "", columns, momentum=len(rate) > 1))
        first += COMPONENTS[kind]
    return tuple(members)


def _by_entry(shapes: Shapes, members: Sequence[Member], values: Any) -> Any:
    """Return a state by name with its arrays replaced by their entries, ``R_0``, ``R_1`` of ``R``."""
    if not isinstance(values, Mapping):
        return values
    by_name, axes, kinds = {member.name: member for member in members}, dict[str, tuple[int, ...]](), dict[str, str]()
    for name, shape in shapes:
        first = "_0" * (len(shape) - 1)
        member = by_name.get(name + first)
        axes[name] = shape if member is None else shape[:-1]
        if member is not None:
            rate = member.rate.removesuffix(first)
            axes[rate], kinds[name], kinds[rate] = shape[:-1], member.kind, "rate"
    entries = {}
    for name, value in values.items():
        base = name.removesuffix("_space")
        if not axes.get(base):
            entries[name] = value
            continue
        array = quaternions(value, name) if kinds.get(base) == "rotation" else real_array(value, name)
        last = int(base in kinds)
        outer = array.ndim - last - len(axes[base])
        if outer < 0 or array.shape[outer : array.ndim - last] != axes[base]:
            of_vectors = " of vectors" if base in kinds else ""
            raise StateError(f"'{name}' must have the shape {axes[base]}{of_vectors}, not {array.shape}")
        for index in np.ndindex(*axes[base]):
            suffix = "".join(f"_{k}" for k in index) + name.removeprefix(base)
            entries[base + suffix] = array[(slice(None),) * outer + index]
    return entries


def state_of(
    coordinates: Sequence[str], members: Sequence[Member], q: Any, p: Any, velocity: Any, shapes: Shapes = ()
) -> tuple[Any, Any, Any]:
    """Return (q, p, velocity) with states by name as (.., m) numbers, and momenta and velocities as they are.

    Args:
        coordinates: names of all coordinates.
        members: rotations, directions and spins.
        q: by name: ordinary coordinates, rotations as of :func:`quaternions`, unit vectors (.., 3), spins (.., 3);
            without spins also numbers (.., m).
        p: by name: momenta of ordinary coordinates, angular momentum of a rotation in the body frame under its name
            (that of its momentum in a Hamiltonian), or in the space frame under this name with ``_space``.
        velocity: by name: of ordinary coordinates and directions, and the angular velocity under its own name (body
            frame) or with ``_space``.
        shapes: names and shapes of arrays of coordinates, ``("R", (3, 4))`` of three rotations.
    """
    q, p, velocity = (_by_entry(shapes, members, part) for part in (q, p, velocity))
    ordinary = coordinates[: members[0].columns.start]
    if isinstance(q, Mapping):
        check_names(q, [*ordinary, *(member.name for member in members)], "q")
        attitudes = {member.name: _coordinates(member, q) for member in members}
        parts = columns(q, ordinary, "q")
        state = joined_columns(parts | {name: coordinates for name, (coordinates, _) in attitudes.items()}, "q")
    else:
        state = real_array(q, "q")
        if not state.ndim or state.shape[-1] != len(coordinates) or any(member.kind == "spin" for member in members):
            raise StateError(
                f"momenta and velocities by name require q by name, or numbers of the shape (.., {len(coordinates)}) "
                "and no spins"
            )
        attitudes = {member.name: (state[..., member.columns], np.zeros(0)) for member in members}
    if velocity is not None and any(member.kind == "spin" for member in members):
        raise StateError("spins have no velocities: give p, the momenta of coordinates and rotations by name")
    if p is None and velocity is None and not ordinary and all(member.kind == "spin" for member in members):
        p = {}
    if isinstance(velocity, Mapping):
        parts = _moving(ordinary, members, velocity, attitudes, "velocity", state.shape[:-1])
        state, velocity = _as_many(state, joined_columns(parts, "velocity"))
    if isinstance(p, Mapping):
        parts = _moving(ordinary, members, p, attitudes, "p", state.shape[:-1])
        state, p = _as_many(state, joined_columns(parts, "p"))
    return state, p, velocity


def state_by_name(system: MechanicalSystem, q: Any, p: Any, velocity: Any) -> tuple[Any, Any, Any]:
    """Return the state of a system as of :func:`state_of`; as it is if q names no rotation, direction or spin."""
    members = members_of(system.dimension, [rotation.declaration for rotation in system.rotations])
    shapes = [(array.name, array.shape({})) for array in system.arrays if array.axes]
    turning = {*(member.name for member in members), *(array.name for array in system.arrays if array.letters)}
    if not isinstance(q, Mapping) or turning.isdisjoint(q):
        return q, p, velocity
    names = [coordinate.name for coordinate in system.coordinates]
    q, p, velocity = state_of(names, members, q, p, velocity, shapes)
    return q, *(None if part is None else np.asarray(part, dtype=float) for part in (p, velocity))


def _coordinates(member: Member, q: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return (.., k) homogeneous coordinates and, of a spin, momenta."""
    value = q[member.name]
    if member.kind == "rotation":
        return quaternions(value, member.name), np.zeros(0)
    vector, length, exponent = scaled_vectors(value, f"the {member.kind} '{member.name}'")
    if member.kind == "direction":
        return np.asarray(vector / length), np.zeros(0)
    return _hopf(np.ldexp(vector, exponent), np.ldexp(length, exponent))


def _hopf(s: Array, length: Array) -> tuple[Array, Array]:
    """Return coordinates and momenta (.., 2) of spins (.., 3): a real and positive, or b where s points down.

    With (a, b) = q + i p in C^2 (Hopf map): s_x + i s_y = conj(a) b / 2, s_z = (|a|^2 - |b|^2) / 4 and
    |s| = (|a|^2 + |b|^2) / 4. Hence |a|^2 = 2 (|s| + s_z) and |b|^2 = 2 (|s| - s_z); the larger one is free of
    cancellation, the smaller amplitude follows from the product conj(a) b.
    """
    transverse, up = s[..., 0] + 1j * s[..., 1], s[..., 2]
    north = up >= 0
    large = np.sqrt(2 * (length[..., 0] + np.abs(up)))
    small = 2 * transverse / large
    a = np.where(north, large, np.conj(small))
    b = np.where(north, small, large)
    return np.stack([a.real, b.real], axis=-1), np.stack([a.imag, b.imag], axis=-1)


def _moving(
    ordinary: Sequence[str],
    members: Sequence[Member],
    values: Mapping[str, Any],
    attitudes: Mapping[str, tuple[Array, Array]],
    argument: str,
    states: tuple[int, ...],
) -> dict[str, Array]:
    """Return the parts of momenta or velocities by name, for positions of this shape."""
    named = {m.name for m in members if m.kind == "rotation" and (m.momentum or argument == "velocity")}
    names = {m.name: m.rate if m.name in named else m.name for m in members}
    required = [*ordinary, *(names[m.name] for m in members if m.kind != "spin")]
    check_names(values, required, argument, also=[f"{names[m.name]}_space" for m in members if m.kind == "rotation"])
    parts = columns(values, ordinary, argument)
    for name, rates in parts.items():
        common_shape({"q": states, f"{argument}: '{name}'": rates.shape[:-1]})
    for member in members:
        q, p = attitudes[member.name]
        name = names[member.name]
        if member.kind == "spin":
            parts[name] = p
            continue
        in_space = member.kind == "rotation" and f"{name}_space" in values
        vector = real_array(values[f"{name}_space" if in_space else name], f"{argument}: '{name}'")
        if not vector.ndim or vector.shape[-1] != 3 or not np.isfinite(vector).all():
            raise StateError(f"{argument}: '{name}' must have three finite components, not {vector.tolist()}")
        common_shape({"q": states, f"{argument}: '{name}'": vector.shape[:-1]})
        if member.kind == "direction":
            radial = (q * vector).sum(axis=-1, keepdims=True)
            if not (np.abs(radial) <= TANGENT * np.abs(vector).max(axis=-1, keepdims=True)).all():
                raise StateError(
                    f"{argument}: '{name}' = {vector.tolist()} is not tangent to the unit sphere: its component "
                    f"along it is {np.abs(radial).max():.3g}. The length is constant: give an orthogonal vector"
                )
            parts[name] = np.asarray(vector - q * radial)
            continue
        body = np.einsum("...ji,...j->...i", matrices(q), vector) if in_space else vector
        parts[name] = (velocities_of_body if argument == "velocity" else momenta_of_body)(q, body)
    return parts


def check_names(values: Mapping[str, Any], required: Sequence[str], argument: str, also: Sequence[str] = ()) -> None:
    """Raise :class:`StateError` for names that are unknown, missing or, with ``_space``, twice there."""
    for name in values:
        if name not in required and name not in also:
            raise StateError(
                f"there is no '{name}' in {argument}{closest(str(name), [*required, *also])} "
                f"Known: {', '.join(required)}"
            )
    in_space = {*also} & {*values}
    for name in required:
        count = (name in values) + (f"{name}_space" in in_space)
        if count != 1:
            both = f"both '{name}' and '{name}_space' are in {argument}: give one of them"
            raise StateError(both if count else f"'{name}' is missing in {argument}")


def _as_many(one: Array, other: Array) -> Sequence[Array]:
    """Return positions and momenta or velocities of as many states."""
    return (one, other) if one.shape == other.shape else np.broadcast_arrays(one, other)


def columns(values: Mapping[str, Any], names: Sequence[str], argument: str) -> dict[str, Array]:
    """Return numbers by name as columns; those of one state in one part, under the first name."""
    numbers = [values[name] for name in names]
    if {*map(type, numbers)} == {float}:
        return {names[0]: np.array(numbers)}
    return {name: column(values, name, argument) for name in names}


def column(values: Mapping[str, Any], name: str, argument: str) -> Array:
    """Return numbers by name as (.., 1) columns."""
    return real_array(values[name], f"{argument}: '{name}'")[..., None]


def joined_columns(parts: Mapping[str, Array], argument: str) -> Array:
    """Return the columns of all parts by name beside each other, of as many states as the longest."""
    shape = common_shape({f"{argument}: '{name}'": part.shape[:-1] for name, part in parts.items()})
    columns = (
        part if part.shape[:-1] == shape else np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts.values()
    )
    return np.concatenate([*columns], axis=-1)
