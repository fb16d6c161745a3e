"""Layout of the states of a compiled system: what users pass becomes rows of numbers at the door, results get names.

A state is (m,) positions and momenta in the order of the coordinates, of n states (n, m). Users may pass the numbers in
order, arrays by name, rotations as quaternions or matrices, the variables of a first-order system, and numbers of two
words. :func:`layout_of` chooses the layout once for a stepper:

    StateLayout          numbers in order, or coordinates and arrays by name
    RotationLayout       also rotations, directions and spins by name
    FirstOrderLayout     also the variables z, half of which are positions
    TwoWordLayout        numbers of two words, each of which is laid out by one of the above
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.rotations import check_names, column, joined_columns, members_of, state_of
from scvi_codegen.runs.states.validation import (
    Array,
    Parameters,
    States,
    check_lengths,
    coordinate_shapes,
    flat_state,
    is_vector,
    parameter_values,
    parameters_of_each,
    shapes_of,
    short_vector,
)
from scvi_codegen.runs.states.words import block_of, from_block, low_words, named, split, two_words, with_low, word

Start = tuple[Any, Any, Any]
"""Positions, momenta and velocities of a state, of which one of the last two is ``None``."""


class Initial(NamedTuple):
    """Initial state of a run, and what holds for all of its steps.

    Attributes:
        q, p, velocity: positions, and momenta or velocities; the other is ``None``.
        t: time.
        parameters, options: of the steps.
    """

    q: States
    p: States | None
    velocity: States | None
    t: float
    parameters: Parameters
    options: SolverOptions | None


class StateLayout:
    """States of numbers in order, or by the names of coordinates and arrays.

    Attributes:
        interface: of the compiled system.
        dimension: degrees of freedom m.
        shapes: names and shapes of the arrays of coordinates; ``None`` without arrays.
        words: number of doubles of each number.
    """

    words = 1

    def __init__(self, interface: Interface) -> None:
        self.interface, self.dimension, self.shapes = interface, interface.dimension, shapes_of(interface)

    def flat(self, values: Any, name: str) -> Any:
        """Return positions, momenta or velocities by name as (.., m) numbers in order, and numbers as they are."""
        return flat_state(self.interface, values, name)

    def start(self, q: Any, p: Any, velocity: Any) -> Start:
        """Return the initial state of a run or an ensemble, whose parts by name may depend on each other, as numbers.

        What depends on nothing else is left as it is, for :meth:`pair`, :meth:`rows` and :meth:`members`.
        """
        return q, p, velocity

    def flat_pair(self, q: States, other: States | None, name: str) -> tuple[Any, Any]:
        """Return positions, and momenta (``name`` is ``"p"``) or velocities, as (.., m) numbers in order."""
        return self.flat(q, "q"), None if other is None else self.flat(other, name)

    def positions(self, values: Any, name: str) -> Any:
        """Return positions by name, also attitudes, as (.., m) numbers in order, and numbers as they are."""
        return self.flat_pair(values, None, "p")[0] if isinstance(values, Mapping) else self.flat(values, name)

    def vector(self, values: States, name: str) -> Array:
        """Return a finite, contiguous (m,) copy; for one coordinate a number suffices."""
        interface = self.interface
        if (vector := short_vector(values, len(interface.coordinates))) is not None:
            return vector
        array, coordinates = real_array(self.flat(values, name), name), interface.coordinates
        if array.ndim == 0 and self.dimension == 1:
            array = array.reshape(1)
        if array.shape != (self.dimension,):
            names = ", ".join(coordinates[:6]) + (", ..." if self.dimension > 6 else "")
            raise StateError(f"{name} must have shape ({self.dimension},) for ({names}), not {array.shape}")
        if not np.isfinite(array).all():
            worst = int(np.flatnonzero(~np.isfinite(array))[0])
            raise StateError(f"{name}[{worst}] ({coordinates[worst]}) is {array[worst]}: it must be finite")
        return array

    def pair(self, q: States, other: States, name: str = "p") -> tuple[Array, Array]:
        """Return finite, contiguous (m,) copies of the positions and momenta, or what ``name`` names, of one state."""
        if isinstance(q, Mapping) or isinstance(other, Mapping):
            q, other = self.flat_pair(q, other, name)
        return self.vector(q, "q"), self.vector(other, name)

    def rows(self, q: Any, other: Any, t: ArrayLike, name: str = "p") -> tuple[Array, Array, Array]:
        """Return (n,) times and contiguous (n, m) positions and momenta, or what ``name`` names, of one or n states."""
        q, other = self.flat_pair(q, other, name)
        positions, moving = real_array(q, "q"), real_array(other, name)
        if positions.ndim <= 1:
            positions, moving = self.vector(q, "q"), self.vector(other, name)
        elif positions.ndim != 2 or positions.shape != moving.shape or positions.shape[1] != self.dimension:
            raise StateError(
                f"states must have shape (n, {self.dimension}), not q {positions.shape} and {name} {moving.shape}"
            )
        count = positions.size // self.dimension
        times = real_array(t, "t")
        if not np.isfinite(times).all():
            raise StateError("the time t must be finite")
        if times.shape not in ((), (count,)):
            raise StateError(
                f"the time t must be one number or {count}, one for each state, not of shape {times.shape}"
            )
        times = np.ascontiguousarray(times) if times.ndim else np.full(count, times)
        return times, np.ascontiguousarray(positions), np.ascontiguousarray(moving)

    def members(self, values: States, name: str) -> Array:
        """Return (k, m) finite positions, momenta or velocities of the members of an ensemble."""
        array = real_array(self.flat(values, name), name)
        if array.ndim == 1:
            array = array[np.newaxis]
        if array.ndim != 2 or array.shape[1] != self.dimension or len(array) == 0:
            raise StateError(f"{name} must have shape (k, {self.dimension}), not {array.shape}")
        if not np.isfinite(array).all():
            j, i = (int(index[0]) for index in np.nonzero(~np.isfinite(array)))
            coordinate = self.interface.coordinates[i]
            raise StateError(f"{name}[{j}, {i}] ({coordinate}) is {array[j, i]}: it must be finite")
        return array

    def axes(self, q: States) -> int:
        """Return the number of axes of positions: 1 of one state, 2 of several."""
        if is_vector(q):
            return 1
        if not isinstance(q, Mapping) and (axes := real_array(q, "q").ndim) == 1:
            return axes
        return real_array(self.positions(q, "q"), "q").ndim

    def is_one(self, q: States) -> bool:
        """Return whether these are the positions of one state, not of several."""
        return self.axes(q) == 1

    def parameters(self, values: Parameters, base: Array | None = None) -> Array:
        """Return the (k,) parameter values in order; by default those of ``base``, or the defaults."""
        if values is None and base is None:
            return self.defaults.copy()
        numbers = parameter_values(self.interface, values, base)
        check_lengths(self.interface, numbers)
        return numbers

    @cached_property
    def defaults(self) -> Array:
        """(k,) default values of the parameters, checked once."""
        numbers = parameter_values(self.interface, None)
        check_lengths(self.interface, numbers)
        return numbers

    def parameters_of_each(self, values: Parameters, count: int) -> Array:
        """Return (k, number of parameters) values: defaults replaced by name, one or k numbers each, or by an array."""
        numbers = parameters_of_each(self.interface, values, count, np.asarray(self.interface.defaults, dtype=float))
        for j, row in enumerate(numbers if self.interface.lengths else ()):
            check_lengths(self.interface, row, f" of trajectory {j}")
        return numbers

    def time(self, t: Any) -> float:
        """Return a finite time."""
        return checked_number(t, "t")

    def number(self, value: Any, name: str) -> tuple[float, float]:
        """Return the high and the low word of a finite number."""
        return checked_number(value, name), 0.0

    def block(self, values: Array) -> Array:
        """Return (.., m) numbers as C reads them."""
        return np.asarray(values)

    def times_block(self, times: Array) -> Array:
        """Return (n,) times as C reads them."""
        return times

    def numbers(self, block: Array) -> Array:
        """Return the numbers of an array of C, in the same memory."""
        return block

    def times(self, block: Array) -> Array:
        """Return the times of an array of C, (n,) or (n, words)."""
        return block.reshape(-1)

    def missing(self, shape: tuple[int, ...]) -> Array:
        """Return NaN."""
        return np.full(shape, np.nan)

    def named(self, values: Array) -> Array:
        """Return (.., m) numbers of states that arrays of coordinates index by name; without arrays unchanged."""
        return values if self.shapes is None else named(values, self.shapes)


class RotationLayout(StateLayout):
    """States with rotations, directions and spins, also by name, as homogeneous coordinates and momenta."""

    def __init__(self, interface: Interface) -> None:
        super().__init__(interface)
        self.rotations = members_of(interface.dimension, interface.rotations)

    def start(self, q: Any, p: Any, velocity: Any) -> Start:
        """Return the state; parts by the names of homogeneous coordinates are left as they are."""
        by_name = [part for part in (q, p, velocity) if isinstance(part, Mapping)]
        homogeneous = self.interface.coordinates[self.rotations[0].columns.start :]
        if not any(part.keys().isdisjoint(homogeneous) for part in by_name):
            return q, p, velocity
        return state_of(self.interface.coordinates, self.rotations, q, p, velocity, self.shapes or ())

    def flat_pair(self, q: States, other: States | None, name: str) -> tuple[Any, Any]:
        """Return positions and momenta or velocities; those of rotations depend on the positions."""
        if isinstance(q, Mapping) or isinstance(other, Mapping):
            p, velocity = (other, None) if name == "p" else (None, other)
            q, p, velocity = self.start(q, p, velocity)
            other = p if name == "p" else velocity
        return super().flat_pair(q, other, name)


class FirstOrderLayout(StateLayout):
    """States z of first-order systems, half of whose variables are positions and half of which are momenta."""

    def start(self, q: Any, p: Any, velocity: Any) -> Start:
        """Return the halves of the values of all variables, or (q, p) as they are."""
        interface, variables = self.interface, self.interface.variables
        if velocity is not None:
            raise StateError(
                f"'{interface.system}' is a first-order system, whose velocities follow from the state: omit velocity"
            )
        if p is not None:
            return q, p, None
        if isinstance(q, Mapping):
            entries = dict(chain.from_iterable(self._entries(name, values) for name, values in q.items()))
            check_names(entries, variables, "the state")
            z = joined_columns({name: column(entries, name, "the state") for name in variables}, "the state")
        else:
            z = real_array(q, "the state")
            if not z.ndim or z.shape[-1] != len(variables):
                raise StateError(
                    f"the state of '{interface.system}' must have {len(variables)} values, {', '.join(variables)}, not "
                    f"the shape {z.shape}"
                )
        halves = interface.coordinates, interface.momenta
        q, p = (z[..., [variables.index(name) for name in half]] for half in halves)
        return q, p, None

    def _entries(self, name: str, values: Any) -> list[tuple[str, Any]]:
        """Return the names and values of the entries ``x_0``, ``x_1`` of an array ``x`` of variables."""
        variables = self.interface.variables
        pattern = re.compile(rf"{re.escape(name)}(_\d+)+")
        entries = [entry for entry in variables if name not in variables and pattern.fullmatch(entry)]
        if not entries:
            return [(name, values)]
        array, axes = real_array(values, name), entries[0].removeprefix(name).count("_")
        outer = array.shape[: max(0, array.ndim - axes)]
        if array.size != len(entries) * int(np.prod(outer, dtype=int)):
            raise StateError(f"'{name}' must have {len(entries)} values, not the shape {array.shape}")
        return list(zip(entries, np.moveaxis(array.reshape(*outer, len(entries)), -1, 0), strict=True))


class TwoWordLayout(StateLayout):
    """States of double-double numbers: each word is laid out as that of a system in double.

    Ordinary coordinates and the variables of first-order systems have both words; rotations, directions and spins by
    name are doubles.

    Attributes:
        of_doubles: the layout of a word.
    """

    words = 2

    def __init__(self, interface: Interface) -> None:
        super().__init__(interface)
        self.of_doubles = layout_of(replace(interface, words=1))

    def start(self, q: Any, p: Any, velocity: Any) -> Start:
        """Return the state in two words."""
        match self.of_doubles:
            case FirstOrderLayout() if p is None and velocity is None:
                halves = (self.of_doubles.start(part, None, None)[:2] for part in split(q, "the state"))
                q, p = map(with_low, *halves)
                return q, p, None
            case RotationLayout() as rotations if any(isinstance(part, Mapping) for part in (q, p, velocity)):
                return self._with_rotations(rotations, {"q": q, "p": p, "velocity": velocity})
            case FirstOrderLayout():
                return self.of_doubles.start(q, p, velocity)
            case _:
                return q, p, velocity

    def _with_rotations(self, layout: RotationLayout, parts: Mapping[str, Any]) -> Start:
        """Return a state by name, whose ordinary coordinates alone have low words."""
        columns, first = dict[str, tuple[slice, tuple[int, ...]]](), 0
        for name, shape in coordinate_shapes(self.interface):
            end = first + math.prod(shape)
            if first < layout.rotations[0].columns.start:
                columns[name] = slice(first, end), shape
            first = end
        high, low = list[Any](), list[dict[str, Array]]()
        for label, values in parts.items():
            by_name = values if isinstance(values, Mapping) else {}
            words = {name: split(x, f"{label}: '{name}'") for name, x in by_name.items() if name in columns}
            low.append({name: rest for name, (_, rest) in words.items()})
            high.append({**by_name, **{name: x for name, (x, _) in words.items()}} if by_name else values)
        states = list[Any]()
        for rows, rests in zip(layout.start(*high), low, strict=True):
            lows = np.zeros(np.shape(rows) if rests else 0)
            for name, rest in rests.items():
                place, shape = columns[name]
                lows[..., place] = rest.reshape(*rest.shape[: rest.ndim - len(shape)], math.prod(shape))
            states.append(with_low(np.array(rows), lows) if rests else rows)
        return states[0], states[1], states[2]

    def vector(self, values: States, name: str) -> Array:
        """Return a finite (m,) copy of both words."""
        high, low = split(values, name)
        return self._both(self.of_doubles.vector(high, name), low, name)

    def pair(self, q: States, other: States, name: str = "p") -> tuple[Array, Array]:
        """Return copies of the state; both parts are numbers in order, or by the names of coordinates."""
        return self.vector(q, "q"), self.vector(other, name)

    def rows(self, q: States, other: States, t: ArrayLike, name: str = "p") -> tuple[Array, Array, Array]:
        """Return times and states of two words."""
        words = [split(values, label) for values, label in ((q, "q"), (other, name), (t, "t"))]
        high, low = (self.of_doubles.rows(part[0], part[1], part[2], name) for part in zip(*words, strict=True))
        times, positions, moving = map(with_low, high, low)
        return times, positions, moving

    def members(self, values: States, name: str) -> Array:
        """Return states of the members of an ensemble in two words."""
        high, low = split(values, name)
        return self._both(self.of_doubles.members(high, name), low, name)

    def _both(self, high: Array, low: Any, name: str) -> Array:
        states: Array = with_low(high, np.asarray(self.flat(low, name), dtype=float).reshape(high.shape))
        return states

    def axes(self, q: States) -> int:
        """Return the number of axes of positions."""
        return self.of_doubles.axes(split(q, "q")[0])

    def parameters(self, values: Parameters, base: Array | None = None) -> Array:
        """Return the parameter values in two words."""
        high, low = split(values, "parameters")
        numbers = self.of_doubles.parameters(high, base if base is None else np.asarray(base))
        before = np.zeros(numbers.shape) if base is None else low_words(base)
        words: Array = with_low(numbers, parameter_values(self.interface, low, before))
        return words

    def parameters_of_each(self, values: Parameters, count: int) -> Array:
        """Return the parameter values of each trajectory in two words."""
        high, low = split(values, "parameters")
        none = np.zeros(len(self.interface.defaults))
        numbers = self.of_doubles.parameters_of_each(high, count)
        words: Array = with_low(numbers, parameters_of_each(self.interface, low, count, none))
        return words

    def time(self, t: Any) -> float:
        """Return both words of a finite time."""
        return super().time(t) if type(t) is float else word(*two_words(t, "t"))

    def number(self, value: Any, name: str) -> tuple[float, float]:
        """Return both words of a finite number."""
        return two_words(value, name)

    def block(self, values: Array) -> Array:
        """Return high words followed by low words."""
        return block_of(values)

    def times_block(self, times: Array) -> Array:
        """Return (n, 2) words of times."""
        return block_of(times[:, np.newaxis])

    def numbers(self, block: Array) -> Array:
        """Return numbers from high words followed by low words, in the same memory."""
        return from_block(block)

    def times(self, block: Array) -> Array:
        """Return (n,) times of (n, 2) words."""
        times: Array = from_block(block.reshape(-1, 2))[:, 0]
        return times

    def missing(self, shape: tuple[int, ...]) -> Array:
        """Return NaN with low words 0."""
        states: Array = with_low(np.full(shape, np.nan), np.zeros(shape))
        return states


def layout_of(interface: Interface) -> StateLayout:
    """Return the layout of the states of a compiled system."""
    if interface.words > 1:
        return TwoWordLayout(interface)
    if interface.variables:
        return FirstOrderLayout(interface)
    return RotationLayout(interface) if interface.rotations else StateLayout(interface)
