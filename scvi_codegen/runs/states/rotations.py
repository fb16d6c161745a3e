"""States of systems with rotations, directions and spins by name, as homogeneous coordinates and momenta."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.codegen.rendering.source import COMPONENTS, Interface
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.runs.states.attitudes import (
    matrices,
    momenta_of_body,
    quaternions,
    scaled_vectors,
    velocities_of_body,
)
from scvi_codegen.runs.states.validation import Array, States, checked_vector, coordinate_shapes, flat_state, shapes_of
from scvi_codegen.runs.states.words import Shapes, split, with_low

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
    """Return the rotations, directions and spins of a system, whose coordinates follow the ordinary ones.

    Args:
        dimension: number of all coordinates.
        declarations: as of :attr:`~scvi_codegen.codegen.rendering.source.Interface.rotations`.
    """
    parts = [text.split() for text in declarations]
    first = dimension - sum(COMPONENTS[kind] for kind, *_ in parts)
    members = []
    for kind, name, *rate in parts:
        columns = slice(first, first + COMPONENTS[kind])
        members.append(Member(kind, name, rate[0] if rate else "", columns, momentum=len(rate) > 1))
        first += COMPONENTS[kind]
    return tuple(members)


def homogeneous_state(interface: Interface, q: Any, p: Any, velocity: Any) -> tuple[Any, Any, Any]:
    """Return (q, p, velocity) with states by name as (.., m) numbers, and numbers as they are; see :func:`state_of`.

    In double-double arithmetic ordinary coordinates and the variables of first-order systems have both words;
    rotations, directions and spins by name are doubles.
    """
    if interface.words > 1:
        return _homogeneous_state_of_two_words(interface, q, p, velocity)
    if interface.variables:
        return _first_order_state(interface, q, p, velocity)
    by_name = [each for each in (q, p, velocity) if isinstance(each, Mapping)]
    if not by_name or not interface.rotations:
        return q, p, velocity
    members = members_of(interface.dimension, interface.rotations)
    homogeneous = interface.coordinates[members[0].columns.start :]
    if not any(each.keys().isdisjoint(homogeneous) for each in by_name):
        return q, p, velocity
    return state_of(interface.coordinates, members, q, p, velocity, shapes_of(interface) or ())


def _homogeneous_state_of_two_words(interface: Interface, q: Any, p: Any, velocity: Any) -> tuple[Any, Any, Any]:
    doubles = replace(interface, words=1)
    if interface.variables:
        if p is not None or velocity is not None:
            return homogeneous_state(doubles, q, p, velocity)
        halves = (homogeneous_state(doubles, words, None, None)[:2] for words in split(q, "the state"))
        q, p = map(with_low, *halves)
        return q, p, None
    if not (interface.rotations and any(isinstance(each, Mapping) for each in (q, p, velocity))):
        return q, p, velocity
    ordinary, first = dict[str, tuple[slice, tuple[int, ...]]](), 0
    for name, shape in coordinate_shapes(interface):
        if first < members_of(interface.dimension, interface.rotations)[0].columns.start:
            ordinary[name] = slice(first, first + math.prod(shape)), shape
        first += math.prod(shape)
    high, low = list[Any](), list[dict[str, Array]]()
    for label, values in (("q", q), ("p", p), ("velocity", velocity)):
        by_name = values if isinstance(values, Mapping) else {}
        words = {name: split(value, f"{label}: '{name}'") for name, value in by_name.items() if name in ordinary}
        low.append({name: part for name, (_, part) in words.items()})
        high.append({**by_name, **{name: part for name, (part, _) in words.items()}} if by_name else values)
    results = []
    for values, parts in zip(homogeneous_state(doubles, *high), low, strict=True):
        if parts:
            rest = np.zeros(values.shape)
            for name, part in parts.items():
                columns, shape = ordinary[name]
                rest[..., columns] = part.reshape(*part.shape[: part.ndim - len(shape)], math.prod(shape))
            values = with_low(np.array(values), rest)
        results.append(values)
    return results[0], results[1], results[2]


def flat_states(interface: Interface, q: States, other: States | None, name: str) -> tuple[Any, Any]:
    """Return positions, and the momenta (``name`` is ``"p"``) or velocities, by name as (.., m) numbers in order."""
    if interface.rotations and (isinstance(q, Mapping) or isinstance(other, Mapping)):
        q, *moving = homogeneous_state(interface, q, *((other, None) if name == "p" else (None, other)))
        other = moving[name != "p"]
    return flat_state(interface, q, "q"), None if other is None else flat_state(interface, other, name)


def checked_pair(interface: Interface, q: States, other: States, name: str = "p") -> tuple[Array, Array]:
    """Return finite, contiguous (m,) copies of positions and momenta (or what ``name`` names), also by name."""
    if interface.words == 1 and (isinstance(q, Mapping) or isinstance(other, Mapping)):
        q, other = flat_states(interface, q, other, name)
    return checked_vector(interface, q, "q"), checked_vector(interface, other, name)


def checked_states(
    interface: Interface, q: States, p: States, t: ArrayLike, *, second: str = "p"
) -> tuple[Array, Array, Array]:
    """Return (n,) times and contiguous (n, m) positions and momenta (or what ``second`` names) of one or n states."""
    if interface.words > 1:
        words = [split(each, name) for each, name in ((q, "q"), (p, second), (t, "the time t"))]
        doubles = replace(interface, words=1)
        high, low = (checked_states(doubles, *each, second=second) for each in zip(*words, strict=True))
        times, positions, momenta = map(with_low, high, low)
        return times, positions, momenta
    q, p = flat = flat_states(interface, q, p, second)
    positions, momenta = (real_array(each, name) for each, name in zip(flat, ("q", second), strict=True))
    if positions.ndim <= 1:
        positions, momenta = checked_pair(interface, q, p, second)
    elif positions.ndim != 2 or positions.shape != momenta.shape or positions.shape[1] != interface.dimension:
        raise StateError(
            f"states must have shape (n, {interface.dimension}), not q {positions.shape} and {second} {momenta.shape}"
        )
    count = positions.size // interface.dimension
    times = real_array(t, "the time t")
    if not np.isfinite(times).all():
        raise StateError("the time t must be finite")
    if times.shape not in ((), (count,)):
        raise StateError(f"the time t must be one number or {count}, one for each state, not of shape {times.shape}")
    times = np.ascontiguousarray(np.broadcast_to(times, (count,)))
    return times, np.ascontiguousarray(positions), np.ascontiguousarray(momenta)


def is_one_state(interface: Interface, q: States) -> bool:
    """Return whether these are the positions of one state, not of several."""
    if interface.words > 1:
        q = split(q, "q")[0]
    plain = not isinstance(q, Mapping) and real_array(q, "q").ndim == 1
    return plain or real_array(flat_states(interface, q, None, "p")[0], "q").ndim == 1


def _first_order_state(interface: Interface, z: Any, p: Any, velocity: Any) -> tuple[Any, Any, None]:
    """Return the halves of the values z of all variables of a first-order system, or (q, p) as they are."""
    if velocity is not None:
        raise StateError(
            f"'{interface.system}' is a first-order system, whose velocities follow from the state: omit velocity"
        )
    names = interface.variables
    if p is not None:
        return z, p, None
    if isinstance(z, Mapping):
        z = dict(chain.from_iterable(_entries(names, name, value) for name, value in z.items()))
        _check(z, names, "the state")
        values = _joined([_column(z, name, "the state") for name in names])
    else:
        values = real_array(z, "the state")
        if not values.ndim or values.shape[-1] != len(names):
            raise StateError(
                f"the state of '{interface.system}' must have {len(names)} values, {', '.join(names)}, not the shape "
                f"{values.shape}"
            )
    halves = interface.coordinates, interface.momenta
    q, rest = (values[..., [names.index(name) for name in half]] for half in halves)
    return q, rest, None


def _entries(names: Sequence[str], name: str, value: Any) -> list[tuple[str, Any]]:
    """Return the names and values of the entries ``x_0``, ``x_1`` of an array ``x`` of variables."""
    entries = [each for each in names if name not in names and re.fullmatch(rf"{re.escape(name)}(_\d+)+", each)]
    if not entries:
        return [(name, value)]
    array, axes = real_array(value, name), entries[0].removeprefix(name).count("_")
    outer = array.shape[: max(0, array.ndim - axes)]
    if array.size != len(entries) * int(np.prod(outer, dtype=int)):
        raise StateError(f"'{name}' must have {len(entries)} values, not the shape {array.shape}")
    return list(zip(entries, np.moveaxis(array.reshape(*outer, len(entries)), -1, 0), strict=True))


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
            raise StateError(f"'{name}' must have the shape {axes[base]}{' of vectors' * last}, not {array.shape}")
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

    Raises:
        StateError: naming what is unknown, missing or invalid.
    """
    q, p, velocity = (_by_entry(shapes, members, each) for each in (q, p, velocity))
    ordinary = coordinates[: members[0].columns.start]
    if isinstance(q, Mapping):
        _check(q, [*ordinary, *(member.name for member in members)], "q")
        parts = [_column(q, name, "q") for name in ordinary]
        attitudes = {member.name: _coordinates(member, q) for member in members}
        state = _joined([*parts, *(attitudes[member.name][0] for member in members)])
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
        state, velocity = np.broadcast_arrays(
            state, _joined(_moving(ordinary, members, velocity, attitudes, "velocity"))
        )
    if isinstance(p, Mapping):
        state, p = np.broadcast_arrays(state, _joined(_moving(ordinary, members, p, attitudes, "p")))
    return state, p, velocity


def state_by_name(system: MechanicalSystem, q: Any, p: Any, velocity: Any) -> tuple[Any, Any, Any]:
    """Return the state of a system as of :func:`state_of`; as it is if q names no rotation, direction or spin."""
    members = members_of(system.dimension, [each.declaration for each in system.rotations])
    shapes = [(array.name, array.shape({})) for array in system.arrays if array.axes]
    turning = {*(member.name for member in members), *(array.name for array in system.arrays if array.letters)}
    if not isinstance(q, Mapping) or turning.isdisjoint(q):
        return q, p, velocity
    names = [coordinate.name for coordinate in system.coordinates]
    q, p, velocity = state_of(names, members, q, p, velocity, shapes)
    return q, *(None if each is None else np.asarray(each, dtype=float) for each in (p, velocity))


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
    """Return coordinates and momenta (.., 2) of a spin: a real and positive, or b where s points down."""
    transverse, up = s[..., 0] + 1j * s[..., 1], s[..., 2]
    size = length[..., 0]
    north = up >= 0
    large = np.sqrt(2 * (size + np.abs(up)))
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
) -> list[Array]:
    """Return the parts of momenta or velocities."""
    named = {m.name for m in members if m.kind == "rotation" and (m.momentum or argument == "velocity")}
    names = {m.name: m.rate if m.name in named else m.name for m in members}
    known = [*ordinary, *(names[m.name] for m in members if m.kind != "spin")]
    _check(values, known, argument, also=[f"{names[m.name]}_space" for m in members if m.kind == "rotation"])
    parts = [_column(values, name, argument) for name in ordinary]
    for member in members:
        q, p = attitudes[member.name]
        name = names[member.name]
        if member.kind == "spin":
            parts.append(p)
            continue
        in_space = member.kind == "rotation" and f"{name}_space" in values
        vector = real_array(values[f"{name}_space" if in_space else name], f"{argument}: '{name}'")
        if not vector.ndim or vector.shape[-1] != 3 or not np.isfinite(vector).all():
            raise StateError(f"{argument}: '{name}' must have three finite components, not {vector.tolist()}")
        if member.kind == "direction":
            radial = (q * vector).sum(axis=-1, keepdims=True)
            if not (np.abs(radial) <= TANGENT * np.abs(vector).max(axis=-1, keepdims=True)).all():
                raise StateError(
                    f"{argument}: '{name}' = {vector.tolist()} is not tangent to the unit sphere: its component "
                    f"along it is {np.abs(radial).max():.3g}. The length is constant: give an orthogonal vector"
                )
            parts.append(np.asarray(vector - q * radial))
            continue
        body = np.einsum("...ji,...j->...i", matrices(q), vector) if in_space else vector
        q, body = np.broadcast_arrays(q, np.concatenate([body, body[..., :1]], axis=-1))
        parts.append((velocities_of_body if argument == "velocity" else momenta_of_body)(q, body[..., :3]))
    return parts


def _check(values: Mapping[str, Any], known: Sequence[str], argument: str, also: Sequence[str] = ()) -> None:
    for name in values:
        if name not in known and name not in also:
            raise StateError(
                f"there is no '{name}' in {argument}{closest(str(name), [*known, *also])} Known: {', '.join(known)}"
            )
    for name in known:
        count = (name in values) + (f"{name}_space" in set(also) & set(values))
        if count != 1:
            both = f"both '{name}' and '{name}_space' are in {argument}: give one of them"
            raise StateError(both if count else f"'{name}' is missing in {argument}")


def _column(values: Mapping[str, Any], name: str, argument: str) -> Array:
    return real_array(values[name], f"{argument}: '{name}'")[..., None]


def _joined(parts: Sequence[Array]) -> Array:
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts], axis=-1)
