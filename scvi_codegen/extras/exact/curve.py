"""Collocation of the Euler-Lagrange equations (2) at many Gauss points in 60 digits.

A step is divided into equal pieces with n Gauss points each. The unknowns are the initial velocity v0 and
z = h (acceleration) at every point; velocities and positions follow by integration of the interpolating polynomials,

    V = v0 + A z,    Q = q0 + h A V,    E(Q, V, z / h, t) = 0 at every point.

The errors at the ends and of the action decrease like rho^(-2n), where rho > 1 grows with the smoothness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from scvi_codegen.api.formulas import Number, mp
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.exact.newton import Array, Floats, Solve, inverse, largest, newton, scaled, solver
from scvi_codegen.extras.exact.solution import ExactMotion
from scvi_codegen.methods import Gauss

BITS = 240
"""Precision of fixed-point numbers in bits (72 digits)."""
CONJUGATE = 1e-11
"""Singular values of dq1/dv0, divided by h, below which the ends count as conjugate points."""


def fixed(values: Array, exponent: int) -> Array:
    """Return numbers times 2^(BITS - exponent) as integers, whose matrix products are ten times faster."""
    shifted = [int(mp.ldexp(value, BITS - exponent)) for value in values.ravel()]
    return np.array(shifted, dtype=object).reshape(values.shape)


@dataclass(frozen=True, slots=True)
class Grid:
    """Grid of n Gauss points in each of several equal pieces of [0, 1].

    Attributes:
        pieces: number of pieces.
        abscissae: (pieces * n,) all points.
        weights: (n,) weights of a piece of length 1.
        integrals: (n + 1, n) integrals from 0 to each point of a piece of length 1 and to its end, as integers.
        matrix: the Runge-Kutta matrix of all points together, in double precision.
        row: its weights, likewise.
    """

    pieces: int
    abscissae: Array
    weights: Array
    integrals: Array
    matrix: Floats
    row: Floats

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, points: int, pieces: int) -> Grid:
        """Return the grid with this number of points per piece."""
        c, b, A = _gauss_tables(points)
        below, ones = np.tril(np.ones((pieces, pieces)), -1), np.ones(points)
        floats = b.astype(float)
        return cls(
            pieces=pieces,
            abscissae=np.concatenate([(piece + c) / pieces for piece in range(pieces)]),
            weights=b,
            integrals=fixed(np.vstack([A, b]), 0),
            matrix=(np.kron(np.eye(pieces), A.astype(float)) + np.kron(below, np.outer(ones, floats))) / pieces,
            row=np.tile(floats, pieces) / pieces,
        )

    def integrate(self, rates: Array, start: Array) -> tuple[Array, Array]:
        """Return the integral of ``rates`` with the initial value ``start``, at the points and at the end."""
        values = []
        for piece in np.split(rates, self.pieces):
            exponent = int(mp.mag(largest(piece) or mp.one))
            products = self.integrals @ fixed(piece, exponent)
            numbers = [mp.ldexp(mp.mpf(product), exponent - 2 * BITS) for product in products.ravel()]
            moved = start + np.array(numbers, dtype=object).reshape(products.shape) / self.pieces
            values.append(moved[:-1])
            start = moved[-1]
        return np.concatenate(values), start


@lru_cache(maxsize=16)
def _gauss_tables(points: int) -> tuple[Array, Array, Array]:
    tableau = Gauss(points).tableau
    return np.array(tableau.c, dtype=object), np.array(tableau.b, dtype=object), np.array(tableau.A, dtype=object)


@dataclass(frozen=True, slots=True)
class Curve:
    """Curve over a step h from q0 at t, defined by its initial velocity and z = h (acceleration) at the points."""

    motion: ExactMotion
    grid: Grid
    t: Number
    h: Number
    position: Array
    velocity: Array
    z: Array

    @classmethod
    def straight(cls, motion: ExactMotion, grid: Grid, t: Number, h: Number, start: Array, end: Array) -> Curve:
        """Return the uniform motion from ``start`` to ``end``."""
        rest = np.full((len(grid.abscissae), len(start)), mp.zero, dtype=object)
        return cls(motion, grid, t, h, start, (end - start) / h, rest)

    @classmethod
    def launched(
        cls, motion: ExactMotion, grid: Grid, t: Number, h: Number, start: Array, velocity: Array, digits: int
    ) -> Curve:
        """Return the solution of (2) with this initial position and velocity, computed piece after piece."""
        position, speed, coefficients, length = start, velocity, [], h / grid.pieces
        for index in range(grid.pieces):
            first = cls(
                motion, Grid.of(len(grid.weights), 1), t + index * length, length, position, speed, np.empty((0,))
            )
            curve = first._uniformly_accelerated()._solved(digits)
            coefficients.append(curve.z * grid.pieces)
            position, speed = curve.ends()[1], curve.end_velocities()[1]
        return cls(motion, grid, t, h, start, velocity, np.concatenate(coefficients))

    def _uniformly_accelerated(self) -> Curve:
        rest = np.array([mp.zero] * len(self.position), dtype=object)
        at = (self.position, self.velocity, self.t, rest)
        acceleration = -solver(self.motion.residual_jacobian(*at)[2])(self.motion.residual(*at))
        return replace(self, z=np.array([acceleration * self.h] * len(self.grid.abscissae), dtype=object))

    def _solved(self, digits: int) -> Curve:
        """Return the solution with the same initial position and velocity."""

        def linearised(z: Array) -> Solve:
            return solver(replace(self, z=z)._residual_jacobians()[0])

        return replace(self, z=newton(lambda z: replace(self, z=z)._residual(), linearised, self.z, digits))

    def joined_to(self, end: Array, digits: int) -> Curve:
        """Return the solution that ends at ``end``: v0 is an additional unknown, and q(h) = ``end`` its equation."""

        def moved(unknown: Array) -> Curve:
            return replace(self, velocity=unknown[0], z=unknown[1:])

        def residual(unknown: Array) -> Array:
            curve = moved(unknown)
            return np.vstack([((curve.ends()[1] - end) / self.h)[None], curve._residual()])

        x = newton(
            residual, lambda unknown: moved(unknown)._bordered(), np.vstack([self.velocity[None], self.z]), digits
        )
        return moved(x)

    def _states(self) -> tuple[Array, Array]:
        velocities, _ = self.grid.integrate(self.z, self.velocity)
        return self.grid.integrate(velocities * self.h, self.position)[0], velocities

    def _points(self) -> list[tuple[Array, Array, Number, Array]]:
        times = self.t + self.grid.abscissae * self.h
        return list(zip(*self._states(), times, self.z / self.h, strict=True))

    def _residual(self) -> Array:
        return np.array([self.motion.residual(*point) for point in self._points()], dtype=object)

    def _residual_jacobians(self) -> tuple[Floats, Floats]:
        """Return the derivatives of all residuals with respect to z (square) and to v0."""
        # Q = q0 + h c v0 + h A^2 z, V = v0 + A z, a = z/h.
        by_q, by_v, by_a = np.array([self.motion.residual_jacobian(*point) for point in self._points()]).swapaxes(0, 1)
        h, A, c = float(self.h), self.grid.matrix, self.grid.abscissae.astype(float)
        blocks = np.einsum("ij,iab->iajb", A, by_v) + h * np.einsum("ij,iab->iajb", A @ A, by_q)
        size = np.arange(len(c))
        blocks[size, :, size, :] += by_a / h
        count = by_a.shape[0] * by_a.shape[1]
        return blocks.reshape(count, count), (by_v + h * c[:, None, None] * by_q).reshape(count, -1)

    def _bordered(self) -> Solve:
        """Return a solver for (v0, z) that eliminates z; its Schur complement is dq1/dv0, the Jacobi field."""
        # [1, b A; E_v0, E_z] (dv0, dz): dz = E_z^-1 (r - E_v0 dv0), (1 - b A E_z^-1 E_v0) dv0 = r_0 - b A E_z^-1 r.
        by_z, by_v0 = self._residual_jacobians()
        m = len(self.position)
        inverted = inverse(by_z)
        response, border = inverted @ by_v0, np.kron(self.grid.row @ self.grid.matrix, np.eye(m))
        field = np.eye(m) - border @ response
        if np.linalg.svd(field, compute_uv=False)[-1] < CONJUGATE:
            raise StateError(
                "q1 is conjugate to q0 (the trajectories from q0 meet again there), so the discrete "
                "Lagrangian is undefined. Use a smaller step size, or give guess to select another "
                "trajectory"
            )

        def solve(floats: Floats) -> Floats:
            inner = inverted @ floats[m:]
            start = np.linalg.solve(field, floats[:m] - border @ inner)
            return np.concatenate([start, inner - response @ start])

        return lambda right: scaled(solve, right)

    def ends(self) -> tuple[Array, Array]:
        """Return the positions at both ends."""
        velocities, _ = self.grid.integrate(self.z, self.velocity)
        return self.position, self.grid.integrate(velocities * self.h, self.position)[1]

    def end_velocities(self) -> tuple[Array, Array]:
        """Return the velocities at both ends."""
        return self.velocity, self.grid.integrate(self.z, self.velocity)[1]

    def end_momenta(self) -> tuple[Array, Array]:
        """Return the momenta at both ends."""
        (q0, q1), (v0, v1) = self.ends(), self.end_velocities()
        return self.motion.momentum(q0, v0, self.t), self.motion.momentum(q1, v1, self.t + self.h)

    def action(self) -> Number:
        """Return the integral of L over the step."""
        return self._integral([self.motion.lagrangian(q, v, t) for q, v, t, _ in self._points()]) * self.h

    def sizes(self) -> tuple[Number, Number, Number]:
        """Return the integral of ``|L|``, the largest position and the largest momentum."""
        points, motion = self._points(), self.motion
        action = self._integral([abs(motion.lagrangian(q, v, t)) for q, v, t, _ in points]) * abs(self.h)
        momenta = np.array([motion.momentum(q, v, t) for q, v, t, _ in points])
        return action, largest(np.array(self.ends())), largest(momenta)

    def _integral(self, values: list[Number]) -> Number:
        return mp.fdot(np.tile(self.grid.weights, self.grid.pieces), values) / self.grid.pieces
