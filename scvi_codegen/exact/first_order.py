"""Exact motion of first-order systems in 60 digits, in the variables (q, y) of their states.

The Euler-Lagrange equations of L = theta(q, y, t) . q' - H(q, y, t) are

    (d theta / d y)^T q' = H_y,        (d theta / d y) y' = (d theta / d q)^T q' - (d theta / d q) q' - theta_t - H_q.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.exact.newton import Array as Numbers
from scvi_codegen.exact.newton import NotConvergedError, Solve, newton, solver
from scvi_codegen.exact.solution import DIGITS, ExactMotion, solved
from scvi_codegen.formulas.expressions import Tape
from scvi_codegen.mechanics.first_order import FirstOrderSystem
from scvi_codegen.tables.precision import Number


class FirstOrderMotion(ExactMotion):
    """Exact motion of a first-order system; p of all methods are its variables y."""

    system: FirstOrderSystem

    @cached_property
    def _theta(self) -> Tape:
        """theta, and its derivatives by q and by y, row by row; then by t."""
        theta, q, y = self.system.one_form, self.system.coordinates, self.system.momenta
        derivatives = [each.diff(x) for x in (*q, *y) for each in theta]
        return Tape([*theta, *derivatives, *(each.diff(self.system.time) for each in theta)], self.symbols)

    def _one_form(self, q: Numbers, y: Numbers, t: Number) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """Return theta (m,), d theta_i / d q_j and d theta_i / d y_j (m, m), d theta / dt (m,)."""
        m, values = len(q), self._values(self._theta, q, y, t)
        by_q, by_y = (values[m * k : m * (k + m)].reshape(m, m).T for k in (1, m + 1))
        return values[:m], by_q, by_y, values[-m:]

    def momenta(self, q: Numbers, p: Numbers, t: Number) -> Numbers:
        """Return theta(q, y, t)."""
        return self._one_form(q, p, t)[0]

    def variables(self, q: Numbers, theta: Numbers, t: Number, guess: Numbers) -> Numbers:
        """Return y with theta(q, y, t) = theta, by Newton's iteration.

        Raises:
            StateError: if there is none.
        """

        def derivatives(y: Numbers) -> Solve:
            return solver(self._one_form(q, y, t)[2].astype(float))

        try:
            return newton(lambda y: self.momenta(q, y, t) - theta, derivatives, guess, DIGITS)
        except NotConvergedError as failure:
            raise StateError(f"Newton's iteration finds no state with these momenta: {failure}") from failure

    def two_form(self, q: Numbers, p: Numbers, t: Number) -> NDArray[np.float64]:
        """Return dq ^ d theta in (q, y)."""
        _, by_q, by_y, _ = self._one_form(q, p, t)
        m = len(q)
        mapped = np.block([[np.eye(m), np.zeros((m, m))], [by_q.astype(float), by_y.astype(float)]])
        return np.asarray(mapped.T @ super().two_form(q, p, t) @ mapped)

    def velocity(self, q: Numbers, p: Numbers, t: Number, digits: int = DIGITS) -> Numbers:
        """Return q'."""
        _, _, by_y, _ = self._one_form(q, p, t)
        return solved(by_y.T, self._values(self._by_second, q, p, t))

    def _rates(self, state: Numbers, t: Number) -> Numbers:
        q, y = np.split(state, 2)
        _, by_q, by_y, by_t = self._one_form(q, y, t)
        values = self._values(self._right_hand_side, q, y, t)
        v = solved(by_y.T, values[len(q) :])
        return np.concatenate([v, solved(by_y, by_q.T @ v - by_q @ v - by_t - values[: len(q)])])
