"""Runs whose inputs are data: from breakpoint to breakpoint, the parameters of each input those of its piece.

Steps end at breakpoints; the compensated sums go on across them. See :mod:`scvi_codegen.mechanics.inputs`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.runtime.dense_output import checked_times
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.times import times_after
from scvi_codegen.runtime.trajectory import Trajectory

if TYPE_CHECKING:
    from scvi_codegen.runtime.integrator import Integrator
    from scvi_codegen.runtime.run import Run

__all__ = ["DrivenTrajectory", "Input", "checked_inputs", "drive", "end_of", "parameters_of"]

Number = TypeVar("Number", bound=np.generic)

POWERS = 4
NEGLIGIBLE_STEP = 1e-9
"""Of a step: what is left before a breakpoint that is not worth one."""


@dataclass(frozen=True, slots=True)
class Input:
    """A piecewise cubic of time.

    Attributes:
        breakpoints: (n + 1,) ascending times.
        coefficients: (4, n) of powers of the time since the breakpoint before, ascending.
    """

    breakpoints: Array
    coefficients: Array

    def parameters(self, name: str, t: float) -> dict[str, float]:
        """Values of the parameters of an input for the piece in which t lies."""
        piece = int(np.searchsorted(self.breakpoints, t, side="right")) - 1
        piece = min(max(piece, 0), len(self.breakpoints) - 2)
        values = {f"{name}_{k}": float(c) for k, c in enumerate(self.coefficients[:, piece])}
        return values | {f"{name}_t": float(self.breakpoints[piece])}


def checked_inputs(stepper: Integrator, given: Mapping[str, Any] | None) -> dict[str, Input]:
    """Inputs as users give them: (t, values), (t, values, kind), or a piecewise polynomial of SciPy's.

    Raises:
        StateError: for names that are no inputs, inputs that are not given, and data that make no function of time.
    """
    names = stepper.interface.inputs
    given = dict(given or {})
    for name in given:
        if name not in names:
            raise StateError(f"{name!r} is no input of this system, which has {', '.join(names) or 'none'}")
    if missing := [name for name in names if name not in given]:
        raise StateError(f"the input {missing[0]} is not given: inputs={{'{missing[0]}': (t, values)}}")
    return {name: _input(name, value) for name, value in given.items()}


def _input(name: str, given: Any) -> Input:
    if callable(given) and not hasattr(given, "c"):
        raise StateError(
            f"the input {name} is a function of Python's, which C cannot call in the middle of a step: give values, "
            f"{name}=(t, values) or scipy.interpolate.CubicSpline(t, values)"
        )
    if hasattr(given, "c") and hasattr(given, "x"):
        return _from_pieces(name, np.array(given.x, dtype=float), np.array(given.c, dtype=float)[::-1])
    if not isinstance(given, tuple) or len(given) not in (2, 3):
        raise StateError(f"the input {name} is given as (t, values), or (t, values, 'cubic'), not {given!r:.60}")
    t, values = (
        checked_times(part, f"{what} of the input {name}") for part, what in zip(given, ("t", "values"), strict=False)
    )
    kind = given[2] if len(given) == 3 else "linear"
    if kind not in KINDS:
        raise StateError(f"the input {name} is {' or '.join(KINDS)} between its values, not {kind!r}")
    if t.ndim != 1 or t.shape != values.shape or len(t) < 2:
        raise StateError(
            f"the input {name} has times of shape {t.shape} and values of shape {values.shape}: two or more each"
        )
    if (np.diff(t) <= 0.0).any():
        raise StateError(f"the times of the input {name} do not ascend")
    return _from_pieces(name, t, KINDS[kind](t, values))


def _constant(t: Array, values: Array) -> Array:
    return values[np.newaxis, :-1]


def _linear(t: Array, values: Array) -> Array:
    return np.array([values[:-1], np.diff(values) / np.diff(t)])


def _cubic(t: Array, values: Array) -> Array:
    from scipy.interpolate import CubicSpline  # here: slow to import

    found: Array = CubicSpline(t, values).c[::-1]
    return found


KINDS: dict[str, Callable[[Array, Array], Array]] = {"constant": _constant, "linear": _linear, "cubic": _cubic}


def _from_pieces(name: str, breakpoints: Array, ascending: Array) -> Input:
    if ascending.ndim != 2 or len(ascending) > POWERS or not np.isfinite(ascending).all():
        raise StateError(
            f"the pieces of the input {name} are polynomials of degree 3 at most, with finite coefficients"
        )
    coefficients = np.zeros((POWERS, ascending.shape[1]))
    coefficients[: len(ascending)] = ascending
    return Input(breakpoints, coefficients)


def drive(
    run: Run,
    inputs: Mapping[str, Input],
    t_end: float,
    *,
    every: int,
    values: Callable[[float], Array],
    progress: Callable[[int], None] | None,
) -> DrivenTrajectory:
    """The run to t_end, piece by piece.

    Args:
        run: at its start, with a goal where steps choose their length.
        inputs: by name.
        t_end: the time to reach.
        every: steps between kept states; those at breakpoints are kept, too.
        values: the parameters of the piece in which a time lies.
        progress: called with the steps done.
    """
    forward, h, pieces = np.sign(t_end - run.t), run.h, []
    ends = _ends(run.t, t_end, inputs)
    for end in ends:
        middle = run.t + 0.5 * (end - run.t)
        if run.goal is not None:
            run.change(parameters=values(middle), goal=replace(run.goal, t_end=end))
            pieces.append(run.record(every=every, progress=progress))
        else:
            run.change(parameters=values(middle), h=h)
            whole = int(np.floor((end - run.t) / h + NEGLIGIBLE_STEP))
            if whole:
                pieces.append(run.record(whole, every=every, progress=progress))
            if forward * (end - run.t) > NEGLIGIBLE_STEP * abs(h):
                run.change(h=end - run.t)
                pieces.append(run.record(1, progress=progress))
        if pieces and pieces[-1].ended_by is not None:
            break
    return DrivenTrajectory(tuple(pieces) or (run.record(0),))


def _ends(t: float, t_end: float, inputs: Mapping[str, Input]) -> list[float]:
    """Breakpoints on the way, and its end."""
    low, high = min(t, t_end), max(t, t_end)
    inner: set[float] = set()
    for name, data in inputs.items():
        first, last = data.breakpoints[0], data.breakpoints[-1]
        slack = NEGLIGIBLE_STEP * (last - first)
        if low < first - slack or high > last + slack:
            raise StateError(
                f"the input {name} is given from t = {first:g} to {last:g}; the run is from {low:g} to {high:g}"
            )
        inner |= {float(x) for x in data.breakpoints if low < x < high}
    ends = sorted(inner, reverse=t_end < t)
    return [*ends, *([t_end] if t_end != t else [])]


@dataclass(frozen=True, slots=True, eq=False)
class DrivenTrajectory:
    """States along a run with inputs, and what follows from them, each with the parameters of its piece.

    Attributes:
        pieces: trajectories from breakpoint to breakpoint, the first state of each the last of the one before.
    """

    pieces: tuple[Trajectory, ...]

    @property
    def t(self) -> Array:
        """(n,) times."""
        return self._joined(lambda piece: piece.t)

    @property
    def q(self) -> Array:
        """(n, m) positions."""
        return self._joined(lambda piece: piece.q)

    @property
    def p(self) -> Array:
        """(n, m) momenta."""
        return self._joined(lambda piece: piece.p)

    @property
    def velocity(self) -> Array:
        """(n, m) velocities."""
        return self._joined(lambda piece: piece.velocity)

    def constraint_values(self) -> tuple[Array, Array]:
        """(n, c) values of the constraints, and of their rates, at the states."""
        g, rate = (self._joined(partial(_value_or_rate, k)) for k in range(2))
        return g, rate

    @property
    def iterations(self) -> NDArray[np.int32]:
        """(n,) iterations since the state before."""
        return self._joined(lambda piece: piece.iterations)

    @property
    def steps(self) -> int:
        """Taken since the start."""
        return self.pieces[-1].steps

    @property
    def stepper(self) -> Integrator:
        """The compiled integrator."""
        return self.pieces[0].stepper

    def __len__(self) -> int:
        return len(self.t)

    def energy(self) -> Array:
        """(n,) energies p.v - L."""
        return self._joined(lambda piece: piece.energy())

    def momentum_maps(self) -> Array:
        """(n, k) values of what symmetries conserve."""
        return self._joined(lambda piece: piece.momentum_maps())

    def multipliers(self) -> Array:
        """(n, c) multipliers of the constraints."""
        return self._joined(lambda piece: piece.multipliers())

    def work(self) -> Array:
        """(n,) work of the forces since the first state."""
        return self._summed(lambda piece: piece.work())

    def impulses(self) -> Array:
        """(n, k) what forces gave to momentum maps since the first state."""
        return self._summed(lambda piece: piece.impulses())

    def at(self, t: ArrayLike) -> tuple[Array, Array]:
        """States between those kept, as of :meth:`Trajectory.at`."""
        times = checked_times(t, "t")
        flat, m = times.ravel(), self.stepper.dimension
        q, p = np.empty((2, len(flat), m))
        forward = self.pieces[0].forward
        ends = forward * np.array([piece.t[-1] for piece in self.pieces])
        number = np.minimum(np.searchsorted(ends, forward * flat), len(ends) - 1)
        for k in np.unique(number):
            q[number == k], p[number == k] = self.pieces[k].at(flat[number == k])
        return q.reshape(*times.shape, m), p.reshape(*times.shape, m)

    def _joined(self, part: Callable[[Trajectory], NDArray[Number]]) -> NDArray[Number]:
        first, *others = (part(piece) for piece in self.pieces)
        return np.concatenate([first, *(other[1:] for other in others)])

    def _summed(self, part: Callable[[Trajectory], Array]) -> Array:
        found = [part(piece) for piece in self.pieces]
        for before, after in pairwise(found):
            after += before[-1]
        return np.concatenate([found[0], *(each[1:] for each in found[1:])])


def _value_or_rate(k: int, piece: Trajectory) -> Array:
    return piece.constraint_values()[k]


def end_of(t: float, h: float | None, steps: int | None, t_end: float | None) -> float:
    """Where a run with inputs leads."""
    t = checked_number(t, "the time t")
    if (t_end is None) == (steps is None):
        raise StateError("a run with inputs leads to t_end or takes steps of h: give one of t_end and steps")
    if t_end is None:
        if h is None:
            raise StateError("steps that choose their length have no number: give t_end, or h and steps")
        return float(times_after(t, checked_step(h), checked_count(steps, "steps", least=0))[0])
    end = checked_number(t_end, "t_end")
    if h is not None and (end - t) * checked_step(h) < 0.0:
        raise StateError(f"steps of h = {h:g} do not lead from t = {t:g} to t_end = {end:g}")
    return end


def parameters_of(stepper: Integrator, given: Any, inputs: Mapping[str, Input]) -> Callable[[float], Array]:
    """The values of all parameters at a time, those of inputs by their pieces."""
    return partial(_parameters_at, stepper, given, inputs)


def _parameters_at(stepper: Integrator, given: Any, inputs: Mapping[str, Input], t: float) -> Array:
    values: Array = stepper._parameters(given)
    names: Sequence[str] = stepper.parameters
    for name, data in inputs.items():
        for key, value in data.parameters(name, t).items():
            values[names.index(key)] = value
    return values
