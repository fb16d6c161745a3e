"""Named quantities of rotations, directions, spins and meshes, for tables and files."""

from typing import Any

import numpy as np

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.labelled_arrays import LONG_NAMES, NamedQuantity
from scvi_codegen.runs.states.attitudes import angular_velocity, body_momentum, matrices, unit_vectors
from scvi_codegen.runs.states.rotations import Member, members_of
from scvi_codegen.runs.states.validation import Array

COMPLEX_STEP = 1e-30
SPACE, BODY = (("space_axis",), ("body_axis",))


def named_quantities(interface: Interface) -> tuple[NamedQuantity, ...]:
    """Return the quantities of :func:`values_by_name`, in order."""
    if (mesh := _mesh(interface)) is not None:
        axes = {axis.name: axis.points for axis in mesh.axes}
        nothing = np.zeros((1, interface.dimension))
        return tuple(
            NamedQuantity(_free_name(name), tuple(axes), (), f"{name} at the points of the mesh", axes)
            for name in mesh.fields_of(nothing, nothing, nothing)
        )
    variables = [name for name in interface.momenta if name in interface.variables]
    named = tuple(NamedQuantity(name, (), (), f"variable {name} of the state") for name in variables)
    return named + tuple(
        quantity for member in members_of(interface.dimension, interface.rotations) for quantity in _names(member)
    )


def _mesh(interface: Interface) -> Any:
    """Return the mesh of fields discretised from a density, or ``None``."""
    return None if interface.layout is None else interface.layout.mesh


def _free_name(name: str) -> str:
    return name if name not in LONG_NAMES else f"{name}_"


def values_by_name(interface: Interface, q: Array, p: Array, velocity: Array) -> dict[str, Array]:
    """Return (.., 3) vectors and (.., 3, 3) matrices by name, of (.., m) states."""
    if (mesh := _mesh(interface)) is not None:
        return {_free_name(name): values for name, values in mesh.fields_of(q, p, velocity).items()}
    result: dict[str, Array] = {}
    if interface.variables:
        result |= {name: p[..., k] for k, name in enumerate(interface.momenta)}
    for member in members_of(interface.dimension, interface.rotations):
        own, momenta, rates = (vectors[..., member.columns] for vectors in (q, p, velocity))
        values: tuple[Array, ...]
        if member.kind == "rotation":
            values = matrices(own), angular_velocity(own, rates), body_momentum(own, momenta)
        elif member.kind == "direction":
            n = unit_vectors(own)
            moving = rates - n * (n * rates).sum(axis=-1, keepdims=True)
            values = n, moving / np.linalg.norm(own, axis=-1, keepdims=True)
        else:
            values = (spins(own, momenta),)
        result |= zip((quantity.name for quantity in _names(member)), values, strict=True)
    return result


def spins(q: Array, p: Array) -> Array:
    """Return (.., 3) spins of (.., 2) canonical pairs (:class:`scvi_codegen.systems.formulas.rotations.Spin`)."""
    (a, b), (c, d) = np.moveaxis(q, -1, 0), np.moveaxis(p, -1, 0)
    return np.stack([(a * b + c * d) / 2, (a * d - b * c) / 2, (a * a + c * c - b * b - d * d) / 4], axis=-1)


def observable_names(interface: Interface) -> tuple[str, ...]:
    """Return the names of the entries of rotation matrices, body momenta, directions and spins."""
    return tuple(
        name for member in members_of(interface.dimension, interface.rotations) for name in _observables(member)
    )


def observables(interface: Interface, states: Array) -> Array:
    """Return the (.., k) values of :func:`observable_names` at states (.., 2m)."""
    q, p = states[..., : interface.dimension], states[..., interface.dimension :]
    parts = []
    for member in members_of(interface.dimension, interface.rotations):
        own, momenta = q[..., member.columns], p[..., member.columns]
        if member.kind == "rotation":
            parts += [matrices(own).reshape(*own.shape[:-1], 9), body_momentum(own, momenta)]
        else:
            parts.append(unit_vectors(own) if member.kind == "direction" else spins(own, momenta))
    return np.concatenate(parts, axis=-1)


def observable_derivatives(interface: Interface, states: Array) -> Array:
    """Return the (n, k, 2m) derivatives of :func:`observables`, by complex steps."""
    moved = states[:, np.newaxis] + 1j * COMPLEX_STEP * np.eye(states.shape[1])
    return np.asarray(observables(interface, moved).imag.swapaxes(1, 2) / COMPLEX_STEP)


def _observables(member: Member) -> tuple[str, ...]:
    """Return the columns of the quantities of a member that are functions of (q, p)."""
    quantities = _names(member)
    of_state = quantities[::2] if member.kind == "rotation" else quantities[:1]
    return tuple(name for quantity in of_state for name in quantity.columns)


def _names(member: Member) -> tuple[NamedQuantity, ...]:
    """Return the quantities of a member; names that files use otherwise have a trailing underscore."""
    name = _free_name(member.name)
    if member.kind == "spin":
        return (NamedQuantity(name, SPACE, _columns(name), f"spin {name}"),)
    if member.kind == "direction":
        rates = tuple(f"{component}_dot" for component in _columns(name))
        return (
            NamedQuantity(name, SPACE, _columns(name), f"unit vector {name}"),
            NamedQuantity(f"{name}_dot", SPACE, rates, f"velocity of the unit vector {name}"),
        )
    entries = tuple(f"{name}_{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
    omega, momentum = (f"omega_{name}", member.rate) if member.momentum else (member.rate, f"p_{name}")
    return (
        NamedQuantity(name, SPACE + BODY, entries, f"rotation matrix {name} from body to space"),
        NamedQuantity(omega, BODY, _columns(omega), f"angular velocity of {name} in the body frame"),
        NamedQuantity(momentum, BODY, _columns(momentum), f"angular momentum of {name} in the body frame"),
    )


def _columns(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in (1, 2, 3))
