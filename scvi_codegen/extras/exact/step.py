"""Steps of a method's equations in 60 digits: the reference for a compiled step, free of round-off.

It shares the definition of the method with the compiled code, but not the solution: the equations are the paper's
(:meth:`~scvi_codegen.methods.method.Method.paper_form`, which
:func:`~scvi_codegen.extras.derivation.equations.derive` writes out), kernels are evaluated expression by
expression, and the matrix of Newton's iteration is computed by finite differences.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np

from scvi_codegen.api.formulas import Number, Tape, mp
from scvi_codegen.api.methods import Discretisation, Method, StageSystem
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.exact.newton import NotConvergedError, Solve, newton
from scvi_codegen.extras.exact.solution import DIGITS, Numbers, exact_motion, numbers

WIDTH = mp.mpf(10) ** -30
"""Relative width of the finite differences, which are correct to 30 digits."""
REFINEMENTS = 4
EVALUATIONS = 20
"""Number of evaluations of the equations that take as long as their solution."""
STEADY = 0.1
"""Convergence factor above which the Jacobian is recomputed; it is expensive (differences in 60 digits)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedStep:
    """Unknowns of a step, in the order of the derivation, and the final state.

    ``momenta`` are p, or theta(q, y) of a first-order system, whose p is y.
    """

    unknowns: tuple[Number, ...]
    q: tuple[Number, ...]
    p: tuple[Number, ...]
    momenta: tuple[Number, ...]


@dataclass(frozen=True, slots=True)
class _Start:
    q: Numbers
    p: Numbers
    h: Number
    t: Number
    momenta: Numbers


class DerivedStep:
    """Stage equations of a system as functions of numbers, with default or other values of the parameters."""

    def __init__(self, system: MechanicalSystem, stages: StageSystem) -> None:
        self.system, self.stages, self.motion = system, stages, exact_motion(system)
        groups, further = stages.stage_groups, (system.time, *system.parameters, Discretisation.MIDDLE)

        def tape(group: Any, formulas: Sequence[Any]) -> Tape:
            return Tape(formulas, (*group.arguments, *further))

        self.kernels = [tape(group, group.results) for group in groups]
        self.scalars = [None if group.scalar is None else tape(group, [group.scalar]) for group in groups]
        self.damping = Tape([stages.damping], system.parameters)
        self.rate = tape(groups[0], [system.clock.rate]) if system.clock else None
        self.blocks = _slices(stages.block_sizes(system.dimension))
        self.rows = _slices(stages.row_sizes(system.dimension))
        self.arguments = [_slices([len(gather.arguments) for gather in group.gathers]) for group in stages.stage_groups]
        self.results = [_slices([len(scatter.results) for scatter in group.scatters]) for group in stages.stage_groups]
        self.powers = [row.power for row in stages.rows] + [0]
        self.momenta = numbers([*(row.momentum for row in stages.rows), stages.end_momentum])
        self.gathers = [[numbers(gather.table.entries) for gather in group.gathers] for group in stages.stage_groups]
        self.scatters = [
            [numbers(scatter.table.entries) for scatter in group.scatters] for group in stages.stage_groups
        ]

    def with_parameters(self, parameters: Sequence[Number]) -> DerivedStep:
        """Return the same equations with other values of the parameters, in order."""
        result = copy(self)
        result.motion = self.motion.with_parameters(parameters)
        return result

    def _start_of(self, q: Any, p: Any, h: Any, t: Any) -> _Start:
        """Return the initial state of a step, with doubles converted exactly."""
        q, p, h, t = numbers(q), numbers(p), mp.mpf(h), mp.mpf(t)
        return _Start(q, p, h, t, self.motion.momenta(q, p, t))

    @property
    def unknowns(self) -> int:
        """Number of unknowns of a step."""
        return int(self.blocks[-1].stop)

    def seconds(self, q: Any, p: Any, h: Any, t: Any = 0) -> float:
        """Estimate the time of solving a step from that of evaluating its equations."""
        start, began = self._start_of(q, p, h, t), time.perf_counter()
        self._rows(self._straight(start), start)
        return EVALUATIONS * (time.perf_counter() - began)

    def __call__(self, q: Any, p: Any, h: Any, t: Any = 0) -> SolvedStep:
        """Compute the step to t + h of numbers as they are, 0.1 the double; StateError if Newton's iteration fails."""
        start = self._start_of(q, p, h, t)

        def linearised(z: Numbers) -> Solve:
            inverse = self._inverse(self._matrix(z, start, float), start)
            return lambda rows: inverse @ rows

        try:
            z = newton(
                lambda z: self._rows(z, start)[: self.unknowns], linearised, self._straight(start), DIGITS, stale=STEADY
            )
            return self._end(z, self._rows(z, start), start)
        except NotConvergedError as failure:
            where = f"with h = {mp.nstr(start.h, 6)}"
            raise StateError(f"Newton's iteration for the derived equations failed {where}: {failure}") from failure
        except ArithmeticError as failure:
            leaves = "an iterate of the derived equations is outside the domain of the formula"
            raise StateError(f"{leaves} with h = {mp.nstr(start.h, 6)}") from failure

    def first_update(self, q: Any, p: Any, h: Any, t: Any = 0) -> SolvedStep:
        """Return the result of one Newton update from the straight line, with the matrix from finite differences."""
        start = self._start_of(q, p, h, t)
        z = self._straight(start)
        matrix, rows = self._matrix(z, start, mp.mpf), self._rows(z, start)[: self.unknowns]
        inverse = self._inverse(matrix, start)
        update = inverse @ rows
        for _ in range(REFINEMENTS):
            update = update + inverse @ (rows - matrix @ update)
        z = z - update
        return self._end(z, self._rows(z, start), start)

    def duration(self, solved: SolvedStep, q: Any, p: Any, h: Any) -> Number:
        """Return the physical time of a step, the integral of dt/dtau by the method's quadrature; or StateError."""
        shape: Any = self.stages.shape
        if self.rate is None or not hasattr(shape, "weights"):
            raise StateError(f"'{self.system.name}' has no time transformation")
        start = self._start_of(q, p, h, 0)
        group, z = self.stages.stage_groups[0], np.array(solved.unknowns, dtype=object)
        rates = [
            self.rate(self._point(group, n, arguments, start))[0]
            for n, arguments in enumerate(self._arguments(0, z, start))
        ]
        return start.h * mp.fdot(shape.weights, rates)

    def action_gradient(self, solved: SolvedStep, q: Any, p: Any, h: Any, t: Any = 0) -> tuple[Numbers, Numbers] | None:
        """Return the (m,) and (unknowns,) central differences of the generating function by q0 and the unknowns.

        ``None`` if a group of points has no scalar, or its results are not the gradient of that alone (forces, turns).
        """
        if None in self.scalars or any(group.forced for group in self.stages.stage_groups):
            return None
        start = self._start_of(q, p, h, t)
        joined, m = np.array([*start.q, *solved.unknowns], dtype=object), self.system.dimension

        def action(values: Numbers) -> Number:
            return self._action(values[m:], replace(start, q=values[:m]))

        derivatives = np.empty_like(joined)
        for k in range(len(joined)):
            width = mp.mpf(10) ** -18 * max(1, abs(joined[k]))
            ends = []
            for sign in (1, -1):
                moved = joined.copy()
                moved[k] += sign * width
                ends.append(action(moved))
            derivatives[k] = (ends[0] - ends[1]) / (2 * width)
        return derivatives[:m], derivatives[m:]

    def _action(self, z: Numbers, start: _Start) -> Number:
        """Return the generating function, the sum over points of weight, e^(gamma c h) and scalar."""
        total = mp.zero
        for f, group in enumerate(self.stages.stage_groups):
            arguments = self._arguments(f, z, start)
            scale = mp.mpf(group.scatters[0].scale.numerator) / group.scatters[0].scale.denominator
            scale /= mp.mpf(group.gathers[0].scale.numerator) / group.gathers[0].scale.denominator
            for n, weight in enumerate(group.weights):
                scalar = self.scalars[f]
                assert scalar is not None  # checked above
                (value,) = scalar(self._point(group, n, arguments[n], start))
                grown = self._damping_factor(group.abscissae[n], start)
                total += self._row_scale(f, n) * scale * weight * grown * start.h ** (1 + group.scalar_power) * value
        return total

    def _row_scale(self, f: int, n: int) -> Number:
        """Return the factor of the action at a point that a row of its own has been divided by, 1 without such a row.

        The rows of a splitting are divided by the coefficients with which their unknowns enter the end position, so
        that kinetic energies have the weight 1 in them instead of the part of their step.
        """
        rows = {r for table in self.scatters[f] for r in np.flatnonzero(table[n])}
        if len(rows) != 1 or (row := rows.pop()) == len(self.stages.rows):
            return mp.one
        return numbers(self.stages.end_position.entries[0])[row + 1] / self.momenta[row]

    def _straight(self, start: _Start) -> Numbers:
        """Return the (unknowns,) initial guess: straight line with the initial velocity, 0 for other block sizes."""
        v = self.motion.velocity(start.q, start.p, start.t)
        return np.concatenate(self.stages.straight(start.q, v, start.p, start.h, mp.mpf))

    def _arguments(self, f: int, z: Numbers, start: _Start) -> Numbers:
        """Return the (points, arguments) of the kernel of a stage group."""
        parts = []
        for gather, table in zip(self.stages.stage_groups[f].gathers, self.gathers[f], strict=True):
            factor = mp.mpf(gather.scale.numerator) / gather.scale.denominator * start.h**gather.power
            parts.append(np.array([self._gathered(line, len(gather.arguments), z, start) * factor for line in table]))
        return np.concatenate(parts, axis=1)

    def _gathered(self, line: Numbers, size: int, z: Numbers, start: _Start) -> Numbers:
        """Return the (size,) sum of q0 and the blocks with the coefficients of a table row."""
        total = start.q * line[0] if line[0] else numbers([0] * size)
        for b in np.flatnonzero(line[1:]):
            total = total + z[self.blocks[b]] * (line[b + 1] * start.h ** self.stages.blocks[b].power)
        return total

    def _point(self, group: Any, n: int, arguments: Numbers, start: _Start) -> list[Number]:
        time, middle = (start.t + c * start.h for c in (group.abscissae[n], mp.mpf("0.5")))
        return [*arguments, time, *self.motion.parameters, middle]

    def _kernel(self, f: int, n: int, arguments: Numbers, start: _Start) -> Numbers:
        return np.array(self.kernels[f](self._point(self.stages.stage_groups[f], n, arguments, start)), dtype=object)

    def _factor(self, group: Any, s: int, n: int, r: Any, start: _Start) -> Number:
        scatter = group.scatters[s]
        scale = mp.mpf(scatter.scale.numerator) / scatter.scale.denominator
        grown = self._damping_factor(group.abscissae[n], start)
        return scale * group.weights[n] * grown * start.h ** (scatter.power + self.powers[r])

    def _damping_factor(self, c: Number, start: _Start) -> Number:
        """Return the factor e^(gamma c h) of a weight at the point c of the step, where gamma is the damping rate."""
        (rate,) = self.damping(self.motion.parameters)
        return mp.exp(rate * c * start.h)

    def _rows(self, z: Numbers, start: _Start) -> Numbers:
        """Return the residuals of the equations, followed by p1."""
        m = self.system.dimension
        first_terms = [
            start.momenta * x if row.stop - row.start == m else numbers([0] * (row.stop - row.start))
            for row, x in zip(self.rows, self.momenta, strict=True)
        ]
        rows = np.concatenate(first_terms)
        for f, group in enumerate(self.stages.stage_groups):
            arguments = self._arguments(f, z, start)
            for n in range(len(group.abscissae)):
                values = self._kernel(f, n, arguments[n], start)
                for s, (table, results) in enumerate(zip(self.scatters[f], self.results[f], strict=True)):
                    for r in np.flatnonzero(table[n]):
                        rows[self.rows[r]] += values[results] * (self._factor(group, s, n, r, start) * table[n, r])
        return rows

    def _matrix(self, z: Numbers, start: _Start, number: Callable[[Number], Any]) -> Numbers:
        """Return the derivatives of the rows with respect to the unknowns; those of the kernels by differences.

        ``number``: ``float``, which suffices for Newton's iteration, or ``mp.mpf``.
        """
        kind: Any = float if number is float else object
        matrix: Numbers = np.zeros((self.unknowns, self.unknowns), dtype=kind)
        powers = [start.h**block.power for block in self.stages.blocks]
        for f, group in enumerate(self.stages.stage_groups):
            arguments = self._arguments(f, z, start)
            for n in range(len(group.abscissae)):
                derivatives: Numbers = self._kernel_jacobian(f, n, arguments[n], start).astype(kind)
                for s, rows in enumerate(self.scatters[f]):
                    for g, gather in enumerate(group.gathers):
                        derivative = derivatives[self.results[f][s], self.arguments[f][g]]
                        moved = mp.mpf(gather.scale.numerator) / gather.scale.denominator * start.h**gather.power
                        for r in np.flatnonzero(rows[n, :-1]):
                            factor = self._factor(group, s, n, r, start) * rows[n, r] * moved
                            for b in np.flatnonzero(self.gathers[f][g][n, 1:]):
                                entry = factor * self.gathers[f][g][n, b + 1] * powers[b]
                                matrix[self.rows[r], self.blocks[b]] += derivative * number(entry)
        return matrix

    def _kernel_jacobian(self, f: int, n: int, arguments: Numbers, start: _Start) -> Numbers:
        values = self._kernel(f, n, arguments, start)
        derivatives = numbers(np.zeros((len(values), len(arguments))))
        for i in range(len(arguments)):
            moved, width = arguments.copy(), WIDTH * max(1, abs(arguments[i]))
            moved[i] += width
            derivatives[:, i] = (self._kernel(f, n, moved, start) - values) / width
        return derivatives

    def _inverse(self, exact: Numbers, start: _Start) -> Numbers:
        """Return the inverse in double precision, with rows and columns scaled to size 1; later updates correct it."""
        rows = np.array([1 / (max(map(abs, line)) or mp.one) for line in exact], dtype=object)
        exact = rows[:, None] * exact
        columns = np.array([1 / (max(map(abs, line)) or mp.one) for line in exact.T], dtype=object)
        try:
            inverse = np.linalg.inv((exact * columns).astype(float)).astype(object)
        except np.linalg.LinAlgError as error:
            raise StateError(f"the derived equations are singular with h = {float(start.h):g}") from error
        result: Numbers = columns[:, None] * inverse * rows
        return result

    def _end(self, z: Numbers, rows: Numbers, start: _Start) -> SolvedStep:
        q = self._gathered(numbers(self.stages.end_position.entries[0]), self.system.dimension, z, start)
        momenta = rows[self.rows[-1]] / self._damping_factor(mp.one, start)
        p = self.motion.variables(q, momenta, start.t + start.h, start.p)
        return SolvedStep(unknowns=tuple(z), q=tuple(q), p=tuple(p), momenta=tuple(momenta))


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    """Return the slices of consecutive parts with these sizes."""
    return tuple(slice(end - size, end) for size, end in zip(sizes, accumulate(sizes), strict=True))


@lru_cache(maxsize=64)
def derived_step(system: MechanicalSystem, method: Method) -> DerivedStep:
    """Return the paper's equations of a method for a system, cached."""
    return DerivedStep(system, Discretisation(system, method).reference)


@lru_cache(maxsize=64)
def compiled_equations(system: MechanicalSystem, method: Method) -> DerivedStep:
    """Return the equations in the unknowns of the compiled code, cached."""
    return DerivedStep(system, Discretisation(system, method).equations)
