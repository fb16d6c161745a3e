"""The exact motion of a system over a short time, in 60 digits, from its formula alone.

It shares nothing with the compiler but the formula: SymPy's ``diff`` takes the derivatives, Hamilton's equations or
those of Euler and Lagrange give the rates, and the midpoint rule, extrapolated to step size 0 (Gragg, Bulirsch, Stoer;
Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, II.9), follows them. What is compiled is measured
against this.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.formulas.tape import Tape
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.precision import Number, mp

__all__ = ["ExactMotion", "Numbers", "exact_motion", "numbers"]

Numbers = NDArray[Any]
"""Arrays of 60-digit numbers."""

MOST_COLUMNS, MOST_HALVINGS, MOST_ITERATIONS = 24, 12, 60
ACCURACY = mp.mpf(10) ** -45


def numbers(values: Any) -> Numbers:
    """60-digit numbers, the doubles given exactly."""
    array = np.array(values, dtype=object)
    return np.array([mp.mpf(x) for x in array.ravel()], dtype=object).reshape(array.shape)


class ExactMotion:
    """L or H of a system as a function of numbers, and the motion that follows; parameters have their defaults."""

    def __init__(self, system: MechanicalSystem) -> None:
        self.system, self.hamiltonian = system, bool(system.auxiliaries)
        self.second = system.auxiliaries or system.velocities
        self.parameters = [mp.mpf(value) for value in system.defaults]
        self.symbols = (*system.coordinates, *self.second, system.time, *system.parameters)

    @cached_property
    def _formula(self) -> Tape:
        return Tape([self.system.formula], self.symbols)

    @cached_property
    def _slopes(self) -> list[sympy.Expr]:
        """DL/dv, or dH/dp."""
        return [self.system.formula.diff(x) for x in self.second]

    @cached_property
    def _by_second(self) -> Tape:
        return Tape(self._slopes, self.symbols)

    @cached_property
    def _curvature(self) -> list[list[sympy.Expr]]:
        """Derivatives of dL/dv by v, q and t, a row each."""
        variables = (*self.second, *self.system.coordinates, self.system.time)
        return [[slope.diff(x) for x in variables] for slope in self._slopes]

    @cached_property
    def _momentum_and_mass(self) -> Tape:
        """DL/dv and d2L/dv2."""
        m = len(self.second)
        return Tape([*self._slopes, *(entry for row in self._curvature for entry in row[:m])], self.symbols)

    @cached_property
    def _right_hand_side(self) -> Tape:
        """DL/dq and the derivatives of dL/dv; dH/dp and dH/dq."""
        by_position = [self.system.formula.diff(q) for q in self.system.coordinates]
        others = self._slopes if self.hamiltonian else [entry for row in self._curvature for entry in row]
        return Tape([*by_position, *others], self.symbols)

    def _values(self, tape: Tape, q: Numbers, second: Numbers, t: Number) -> Numbers:
        return np.array(tape([*q, *second, t, *self.parameters]), dtype=object)

    def momentum(self, q: Numbers, v: Numbers, t: Number) -> Numbers:
        """(m,) momenta dL/dv of a Lagrangian."""
        return self._values(self._by_second, q, v, t)

    def velocity(self, q: Numbers, p: Numbers, t: Number) -> Numbers:
        """(m,) velocities: dH/dp, or the v with dL/dv = p, by Newton's iteration from rest.

        Raises:
            StateError: if there is none.
        """
        if self.hamiltonian:
            return self._values(self._by_second, q, p, t)
        v = numbers(np.zeros(len(q)))
        m = len(q)
        for _ in range(MOST_ITERATIONS):
            found = self._values(self._momentum_and_mass, q, v, t)
            change = _solved(found[m:].reshape(m, m), found[:m] - p)
            v, whole = self._moved(q, v, t, change)
            if whole and max(map(abs, change)) <= ACCURACY * max(1, *map(abs, v)):
                return v
        raise StateError("the momenta of this state have no velocities that Newton's iteration finds")

    def _moved(self, q: Numbers, v: Numbers, t: Number, change: Numbers) -> tuple[Numbers, bool]:
        """The update, or so much of it that L is defined there; whether it is the whole."""
        for halvings in range(MOST_ITERATIONS):
            trial = v - change / 2**halvings
            try:
                self.momentum(q, trial, t)
            except ArithmeticError:
                continue
            return trial, halvings == 0
        raise StateError("the momenta of this state have no velocities that Newton's iteration finds")

    def energy(self, q: Numbers, p: Numbers, t: Number) -> Number:
        """H, or p . v - L."""
        if self.hamiltonian:
            return self._values(self._formula, q, p, t)[0]
        v = self.velocity(q, p, t)
        return p @ v - self._values(self._formula, q, v, t)[0]

    def _rates(self, state: Numbers, t: Number) -> Numbers:
        """Of (q, p) where H is given, of (q, v) where L is."""
        q, second = np.split(state, 2)
        m, found = len(q), self._values(self._right_hand_side, q, second, t)
        force = found[:m]
        if self.hamiltonian:
            return np.concatenate([found[m:], -force])
        slopes = found[m:].reshape(m, 2 * m + 1)
        applied = force - slopes[:, m : 2 * m] @ second - slopes[:, 2 * m]
        return np.concatenate([second, _solved(slopes[:, :m], applied)])

    def rates(self, q: Numbers, p: Numbers, t: Number) -> tuple[Numbers, Numbers]:
        """(m,) velocities and forces: the rates of q and p by Hamilton's equations."""
        v = self.velocity(q, p, t)
        if self.hamiltonian:
            return v, self._rates(np.concatenate([q, p]), t)[len(q) :]
        return v, self._values(self._right_hand_side, q, v, t)[: len(q)]

    def acceleration(self, q: Numbers, v: Numbers, t: Number) -> Numbers:
        """(m,) accelerations at (q, v) of a Lagrangian."""
        return self._rates(np.concatenate([q, v]), t)[len(q) :]

    def flow(self, q: Any, p: Any, h: Any, t: Any = 0) -> tuple[Numbers, Numbers]:
        """(q, p) at t + h of the motion through (q, p) at t, to about 45 digits.

        Raises:
            StateError: if extrapolation does not converge on any part of the interval: a singularity may lie there.
        """
        q, p, h, t = numbers(q), numbers(p), mp.mpf(h), mp.mpf(t)
        start = np.concatenate([q, p if self.hamiltonian else self.velocity(q, p, t)])
        end = self._followed(start, h, t, MOST_HALVINGS)
        position, second = np.split(end, 2)
        return position, second if self.hamiltonian else self.momentum(position, second, t + h)

    def _followed(self, start: Numbers, h: Number, t: Number, halvings: int) -> Numbers:
        found = self._extrapolated(start, h, t)
        if found is not None:
            return found
        if not halvings:
            raise StateError("the exact motion cannot be followed over one step: it may end in a singularity")
        middle = self._followed(start, h / 2, t, halvings - 1)
        return self._followed(middle, h / 2, t + h / 2, halvings - 1)

    def _extrapolated(self, start: Numbers, h: Number, t: Number) -> Numbers | None:
        """Aitken-Neville in (h / n)^2 for n = 2, 4, 6, ..; ``None`` if the last columns still differ."""
        row: list[Numbers] = []
        for k in range(1, MOST_COLUMNS + 1):
            new = [self._midpoints(start, h, t, 2 * k)]
            for j, old in enumerate(row, 1):
                new.append(new[-1] + (new[-1] - old) / (mp.mpf(k) ** 2 / (k - j) ** 2 - 1))
            if row and max(abs(new[-1] - row[-1])) <= ACCURACY * max(abs(new[-1])):
                return new[-1]
            row = new
        return None

    def _midpoints(self, start: Numbers, h: Number, t: Number, n: int) -> Numbers:
        width = h / n
        before: Numbers = start
        now: Numbers = start + self._rates(start, t) * width
        for j in range(1, n):
            before, now = now, before + self._rates(now, t + j * width) * (2 * width)
        return now


def _solved(matrix: Numbers, right: Numbers) -> Numbers:
    if len(right) == 1:
        return np.array([right[0] / matrix[0, 0]], dtype=object)
    return np.array(list(mp.lu_solve(mp.matrix(matrix.tolist()), mp.matrix(right.tolist()))), dtype=object)


@lru_cache(maxsize=64)
def exact_motion(system: MechanicalSystem) -> ExactMotion:
    """The motion of a system, its formula differentiated once a process."""
    return ExactMotion(system)
