"""Exact motion of a system over a short time, in 60 digits, from its formula alone.

It shares only the formula with the compiler: SymPy's ``diff`` takes the derivatives (other derivatives are used in the
Jacobian of Newton's iteration only), Hamilton's or the Euler-Lagrange equations give the rates, which are integrated by
the midpoint rule with extrapolation to step size 0 (Gragg, Bulirsch, Stoer; Hairer, Norsett & Wanner, Solving Ordinary
Differential Equations I, II.9). Compiled code is compared with this reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import sympy

from scvi_codegen.api.formulas import Number, Tape, jacobian, mp
from scvi_codegen.api.systems import MechanicalSystem, forms_of
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.exact.newton import Array as Numbers
from scvi_codegen.extras.exact.newton import Floats, NotConvergedError, Solve, newton, solver
from scvi_codegen.systems.first_order import FirstOrderSystem

__all__ = ["ExactMotion", "Numbers", "exact_motion", "numbers"]

MAX_PROJECTIONS = 6
"""Number of Newton projections onto constraints; each doubles the correct digits of a state given in doubles."""
MAX_COLUMNS, MAX_HALVINGS = 24, 12
DIGITS = 45
"""Digits to which equations are solved, of 60."""
ACCURACY = mp.mpf(10) ** -DIGITS


def numbers(values: Any) -> Numbers:
    """Return 60-digit numbers, with doubles converted exactly."""
    array = np.array(values, dtype=object)
    return np.array([mp.mpf(x) for x in array.ravel()], dtype=object).reshape(array.shape)


class ExactMotion:
    """Functions derived from L or H of a system, evaluated in 60 digits, and its flow.

    Args:
        system: the mechanical system.
        parameters: their values in order; by default those of the system.
    """

    def __init__(self, system: MechanicalSystem, parameters: Sequence[Number] | None = None) -> None:
        self.system, self.hamiltonian = system, bool(system.auxiliaries)
        self.second = system.auxiliaries or system.velocities
        self.parameters = [mp.mpf(value) for value in (system.defaults if parameters is None else parameters)]
        self.symbols = (*system.coordinates, *self.second, system.time, *system.parameters)

    def with_parameters(self, parameters: Sequence[Number]) -> ExactMotion:
        """Return the same functions with other values of the parameters, in order."""
        result = copy(self)
        result.parameters = [mp.mpf(value) for value in parameters]
        return result

    @cached_property
    def _formula(self) -> Tape:
        return Tape([self.system.formula], self.symbols)

    @cached_property
    def _momentum_expressions(self) -> list[sympy.Expr]:
        """Derivatives dL/dv, or dH/dp."""
        return [self.system.formula.diff(x) for x in self.second]

    @cached_property
    def _by_second(self) -> Tape:
        """Legendre transform dL/dv, or dH/dp, with the gauge energy of the system."""
        return Tape(self._regular_expressions, self.symbols)

    @cached_property
    def _regular_expressions(self) -> list[sympy.Expr]:
        return [f + self.system.gauge.diff(x) for f, x in zip(self._momentum_expressions, self.second, strict=True)]

    @cached_property
    def _curvature(self) -> list[list[sympy.Expr]]:
        """Derivatives of dL/dv with respect to v, q and t, one row each."""
        variables = (*self.second, *self.system.coordinates, self.system.time)
        return [[derivative.diff(x) for x in variables] for derivative in self._momentum_expressions]

    @cached_property
    def _mass(self) -> Tape:
        """Mass matrix d2L/dv2 with the gauge energy, row by row."""
        return Tape([p.diff(v) for p in self._regular_expressions for v in self.second], self.symbols)

    @cached_property
    def _by_position(self) -> list[sympy.Expr]:
        """Derivatives dL/dq + f - gamma p, or dH/dq - f + gamma p."""
        derivatives = [self.system.formula.diff(q) for q in self.system.coordinates]
        sign = -1 if self.hamiltonian else 1
        if self.system.damping != 0:
            momenta = self.system.auxiliaries or self._momentum_expressions
            derivatives = [x - sign * self.system.damping * p for x, p in zip(derivatives, momenta, strict=True)]
        return (
            [x + sign * f for x, f in zip(derivatives, self.system.forces, strict=True)]
            if self.system.forces
            else derivatives
        )

    @cached_property
    def _right_hand_side(self) -> Tape:
        """Right-hand side: dL/dq + f and the derivatives of dL/dv; or dH/dq - f and dH/dp."""
        others = self._momentum_expressions if self.hamiltonian else [entry for row in self._curvature for entry in row]
        return Tape([*self._by_position, *others], self.symbols)

    @cached_property
    def _constraint_tape(self) -> Tape:
        """G, directions D of forces, d/dt of the rates at constant v, conditions on positions, rates, and 1 - mask."""
        q, v, t = self.system.coordinates, self.second, self.system.time

        def rate(f: sympy.Expr) -> sympy.Expr:
            return sympy.Add(f.diff(t), *(f.diff(x) * y for x, y in zip(q, v, strict=True)))

        positions = forms_of(self.system).position_conditions
        rates = list(map(sympy.Add, map(rate, positions), forms_of(self.system).velocity_conditions))
        derivatives = [moving.diff(x) for moving in rates for x in v]
        directions, reactions = forms_of(self.system).force_directions, self.system.reactions
        forces = [directions.get(place, sympy.S.Zero) for place in np.ndindex(len(rates), len(v))]
        idle = [sympy.S.Zero] * (len(rates) - len(reactions)) + [1 - reaction.active for reaction in reactions]
        return Tape([*derivatives, *forces, *map(rate, rates), *positions, *rates, *idle], self.symbols)

    def _values(self, tape: Tape, q: Numbers, second: Numbers, t: Number) -> Numbers:
        return np.array(tape([*q, *second, t, *self.parameters]), dtype=object)

    def momentum(self, q: Numbers, v: Numbers, t: Number) -> Numbers:
        """Return the (m,) momenta dL/dv of a Lagrangian."""
        return self._values(self._by_second, q, v, t)

    def momenta(self, q: Numbers, p: Numbers, t: Number) -> Numbers:
        """Return the (m,) canonical momenta of a state (q, p): p, or theta(q, y, t) of a first-order system."""
        return p

    def variables(self, q: Numbers, theta: Numbers, t: Number, guess: Numbers) -> Numbers:
        """Return the p of the state with these canonical momenta: themselves, or y with theta(q, y, t) = theta."""
        return theta

    def two_form(self, q: Numbers, p: Numbers, t: Number) -> Floats:
        """Return the (2m, 2m) symplectic form dq ^ d theta in the variables of a state (q, p)."""
        return np.asarray(np.kron([[0, 1], [-1, 0]], np.eye(len(q))), dtype=np.float64)

    def velocity(self, q: Numbers, p: Numbers, t: Number, digits: int = DIGITS) -> Numbers:
        """Return the (m,) velocities: dH/dp, or v with dL/dv = p by Newton's iteration from v = 0; or StateError."""
        if self.hamiltonian:
            return self._values(self._by_second, q, p, t)
        m = len(q)

        def mass(v: Numbers) -> Solve:
            return solver(self._values(self._mass, q, v, t).reshape(m, m).astype(float))

        try:
            return newton(lambda v: self.momentum(q, v, t) - p, mass, numbers(np.zeros(m)), digits)
        except NotConvergedError as failure:
            raise StateError(f"Newton's iteration finds no velocity with these momenta: {failure}") from failure

    def lagrangian(self, q: Numbers, v: Numbers, t: Number) -> Number:
        """Return L of a Lagrangian."""
        return self._values(self._formula, q, v, t)[0]

    def energy(self, q: Numbers, p: Numbers, t: Number) -> Number:
        """Return H, or p . v - L."""
        if self.hamiltonian:
            return self._values(self._formula, q, p, t)[0]
        v = self.velocity(q, p, t)
        return p @ v - self.lagrangian(q, v, t)

    def _rates(self, state: Numbers, t: Number) -> Numbers:
        """Return the rates of (q, p) for a Hamiltonian, of (q, v) for a Lagrangian."""
        q, second = np.split(state, 2)
        m = len(q)
        if self.hamiltonian:
            values = self._values(self._right_hand_side, q, second, t)
            return np.concatenate([values[m:], -values[:m]])
        mass, applied = self._mass_and_applied(q, second, t)
        if self.system.constraints:
            return np.concatenate([second, self._constrained_accelerations(mass, applied, q, second, t)[:m]])
        return np.concatenate([second, solved(mass, applied)])

    def _mass_and_applied(self, q: Numbers, v: Numbers, t: Number) -> tuple[Numbers, Numbers]:
        """Return L_vv and the applied force (L_vv times unconstrained accelerations) at (q, v) of a Lagrangian."""
        m, values = len(q), self._values(self._right_hand_side, q, v, t)
        derivatives = values[m:].reshape(m, 2 * m + 1)
        return derivatives[:, :m], values[:m] - derivatives[:, m : 2 * m] @ v - derivatives[:, 2 * m]

    def _constrained_accelerations(self, mass: Numbers, applied: Numbers, q: Numbers, v: Numbers, t: Number) -> Numbers:
        """Return (m + c,) accelerations, and multipliers with which constraints have zero second derivatives."""
        derivatives, forces, (growth, _, _, idle) = self.constraint_terms(q, v, t)
        return solved(_saddle(mass, derivatives, forces, idle), np.concatenate([applied, -growth]))

    def constraint_terms(self, q: Numbers, v: Numbers, t: Number) -> tuple[Numbers, Numbers, Numbers]:
        """Return (c, m) G and D; (4, c) d/dt of the rates at constant v, constraints, rates, and 1 - mask."""
        m, count = len(q), len(self.system.constraints)
        derivatives, forces, terms = np.split(self._values(self._constraint_tape, q, v, t), (count * m, 2 * count * m))
        return derivatives.reshape(count, m), forces.reshape(count, m), terms.reshape(4, count)

    def met(self, q: Any, p: Any, t: Any = 0) -> tuple[Numbers, Numbers]:
        """Project (q, p) onto the constraints to all digits; without constraints it is returned unchanged."""
        q, p, t = numbers(q), numbers(p), mp.mpf(t)
        if not self.system.constraints:
            return q, p
        # Newton's method with the saddle-point matrix: M dq = G^T lambda, G dq = -g; then likewise for velocities.
        m, still = len(q), numbers(np.zeros(len(q)))
        v = self.velocity(q, p, t)
        for _ in range(MAX_PROJECTIONS):
            mass = self._mass_and_applied(q, v, t)[0]
            derivatives, _, (_, g, _, idle) = self.constraint_terms(q, v, t)
            q = q + solved(_saddle(mass, derivatives, derivatives, idle), np.concatenate([still, -g]))[:m]
        mass = self._mass_and_applied(q, v, t)[0]
        derivatives, _, (_, _, rate, idle) = self.constraint_terms(q, v, t)
        v = v + solved(_saddle(mass, derivatives, derivatives, idle), np.concatenate([still, -rate]))[:m]
        return q, self.momentum(q, v, t)

    def multipliers(self, q: Numbers, v: Numbers, t: Number) -> Numbers:
        """Return the (c,) constraint multipliers at a state."""
        mass, applied = self._mass_and_applied(q, v, t)
        return self._constrained_accelerations(mass, applied, q, v, t)[len(q) :]

    def rates(self, q: Numbers, p: Numbers, t: Number) -> tuple[Numbers, Numbers]:
        """Return (m,) velocities and forces: the rates of q and p by Hamilton's equations."""
        v = self.velocity(q, p, t)
        if self.hamiltonian:
            return v, self._rates(np.concatenate([q, p]), t)[len(q) :]
        return v, self._values(self._right_hand_side, q, v, t)[: len(q)]

    def acceleration(self, q: Numbers, v: Numbers, t: Number) -> Numbers:
        """Return the (m,) accelerations at (q, v) of a Lagrangian."""
        return self._rates(np.concatenate([q, v]), t)[len(q) :]

    def residual(self, q: Numbers, v: Numbers, t: Number, a: Numbers) -> Numbers:
        """Return the (m,) Euler-Lagrange residual of a Lagrangian, d/dt dL/dv - dL/dq - f."""
        mass, applied = self._mass_and_applied(q, v, t)
        return mass @ a - applied

    def residual_jacobian(self, q: Numbers, v: Numbers, t: Number, a: Numbers) -> Floats:
        """Return the (3, m, m) derivatives of the residual by position, velocity and acceleration, in doubles."""
        indices, tape = self._residual_jacobian_tape
        matrices = np.zeros((len(q), 3 * len(q)))
        matrices[indices] = [float(value) for value in tape([*q, *v, *a, t, *self.parameters])]
        return np.stack(np.split(matrices, 3, axis=1))

    @cached_property
    def _residual_jacobian_tape(self) -> tuple[tuple[list[int], list[int]], Tape]:
        """Rows and columns of the non-zero derivatives of the residual, and their values."""
        q, v, t = self.system.coordinates, self.second, self.system.time
        a = tuple(sympy.Dummy(real=True) for _ in q)
        residual = [
            sympy.Add(*(x * y for x, y in zip(row, (*a, *v, 1), strict=True)), -force)
            for row, force in zip(self._curvature, self._by_position, strict=True)
        ]
        entries = jacobian(residual, (*q, *v, *a))
        rows, columns = ([index[k] for index in entries] for k in range(2))
        return (rows, columns), Tape(list(entries.values()), (*q, *v, *a, t, *self.system.parameters))

    def flow(self, q: Any, p: Any, h: Any, t: Any = 0) -> tuple[Numbers, Numbers]:
        """Return (q, p) at t + h of the trajectory through (q, p) at t, to about 45 digits.

        Raises:
            StateError: if extrapolation does not converge on some part of the interval, which may contain a
            singularity.
        """
        q, p, h, t = numbers(q), numbers(p), mp.mpf(h), mp.mpf(t)
        start = np.concatenate([q, p if self.hamiltonian else self.velocity(q, p, t)])
        end = self._integrated_flow(start, h, t, MAX_HALVINGS)
        position, second = np.split(end, 2)
        return position, second if self.hamiltonian else self.momentum(position, second, t + h)

    def _integrated_flow(self, start: Numbers, h: Number, t: Number, halvings: int) -> Numbers:
        state = self._extrapolated(start, h, t)
        if state is not None:
            return state
        if not halvings:
            raise StateError("the exact trajectory cannot be computed over one step: it may contain a singularity")
        middle = self._integrated_flow(start, h / 2, t, halvings - 1)
        return self._integrated_flow(middle, h / 2, t + h / 2, halvings - 1)

    def _extrapolated(self, start: Numbers, h: Number, t: Number) -> Numbers | None:
        """Return the Aitken-Neville extrapolation in (h / n)^2 for n = 2, 4, 6, ..; ``None`` without convergence."""
        row: list[Numbers] = []
        # T_(k,j+1) = T_kj + (T_kj - T_(k-1,j))/((n_k/n_(k-j))^2 - 1).
        for k in range(1, MAX_COLUMNS + 1):
            new = [self._midpoints(start, h, t, 2 * k)]
            for j, old in enumerate(row, 1):
                new.append(new[-1] + (new[-1] - old) / (mp.mpf(k) ** 2 / (k - j) ** 2 - 1))
            if row and max(abs(new[-1] - row[-1])) <= ACCURACY * max(abs(new[-1])):
                return new[-1]
            row = new
        return None

    def _midpoints(self, start: Numbers, h: Number, t: Number, n: int) -> Numbers:
        # y_1 = y_0 + w f(y_0), y_(j+1) = y_(j-1) + 2 w f(y_j): its error is a series in w^2 for even n (Gragg).
        width = h / n
        before: Numbers = start
        now: Numbers = start + self._rates(start, t) * width
        for j in range(1, n):
            before, now = now, before + self._rates(now, t + j * width) * (2 * width)
        return now


class FirstOrderMotion(ExactMotion):
    """Exact motion of a first-order system; p of all methods are its variables y.

    The Euler-Lagrange equations of L = theta(q, y, t) . q' - H(q, y, t) are

        (d theta / d y)^T q' = H_y,     (d theta / d y) y' = (d theta / d q)^T q' - (d theta / d q) q' - theta_t - H_q.
    """

    system: FirstOrderSystem

    @cached_property
    def _theta(self) -> Tape:
        """Return theta, and its derivatives by q and by y, row by row; then by t."""
        theta, q, y = self.system.one_form, self.system.coordinates, self.system.momenta
        derivatives = [component.diff(x) for x in (*q, *y) for component in theta]
        return Tape([*theta, *derivatives, *(component.diff(self.system.time) for component in theta)], self.symbols)

    def _one_form(self, q: Numbers, y: Numbers, t: Number) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """Return theta (m,), d theta_i / d q_j and d theta_i / d y_j (m, m), d theta / dt (m,)."""
        m, values = len(q), self._values(self._theta, q, y, t)
        by_q, by_y = (values[m * k : m * (k + m)].reshape(m, m).T for k in (1, m + 1))
        return values[:m], by_q, by_y, values[-m:]

    def momenta(self, q: Numbers, p: Numbers, t: Number) -> Numbers:
        """Return theta(q, y, t)."""
        return self._one_form(q, p, t)[0]

    def variables(self, q: Numbers, theta: Numbers, t: Number, guess: Numbers) -> Numbers:
        """Return y with theta(q, y, t) = theta, by Newton's iteration; StateError if there is none."""

        def derivatives(y: Numbers) -> Solve:
            return solver(self._one_form(q, y, t)[2].astype(float))

        try:
            return newton(lambda y: self.momenta(q, y, t) - theta, derivatives, guess, DIGITS)
        except NotConvergedError as failure:
            raise StateError(f"Newton's iteration finds no state with these momenta: {failure}") from failure

    def two_form(self, q: Numbers, p: Numbers, t: Number) -> Floats:
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


def _saddle(mass: Numbers, derivatives: Numbers, forces: Numbers, idle: Numbers) -> Numbers:
    """Return the matrix [M, -D^T; G, 1 - mask], D = G for ideal constraints."""
    count, m = derivatives.shape
    matrix = numbers(np.zeros((m + count, m + count)))
    matrix[:m, :m], matrix[:m, m:], matrix[m:, :m] = mass, -forces.T, derivatives
    matrix[range(m, m + count), range(m, m + count)] = idle
    return matrix


def solved(matrix: Numbers, right: Numbers) -> Numbers:
    """Return the solution of a linear system."""
    diagonal = matrix.diagonal()
    if np.count_nonzero(matrix) == np.count_nonzero(diagonal) == len(right):
        return np.asarray(right / diagonal)
    return np.array(list(mp.lu_solve(mp.matrix(matrix.tolist()), mp.matrix(right.tolist()))), dtype=object)


@lru_cache(maxsize=64)
def exact_motion(system: MechanicalSystem) -> ExactMotion:
    """Return the exact motion of a system; cached, since its formula is differentiated."""
    if isinstance(system, FirstOrderSystem) and not system.is_canonical:
        return FirstOrderMotion(system)
    return ExactMotion(system)
