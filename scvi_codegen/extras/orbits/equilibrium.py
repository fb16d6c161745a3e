"""Equilibria and their modes, from the derivative of short steps.

An equilibrium is a fixed point of the step of any size h. The eigenvalues mu of the step's derivative there are those
of the linear motion, mu = exp(lambda h); at a pair lambda = +-i omega begins a family of periodic orbits of the period
2 pi/omega (Lyapunov's centre theorem; Moser, Comm. Pure Appl. Math. 29 (1976) 727).
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.runs import Products
from scvi_codegen.api.states import Array, Parameters, Reduction
from scvi_codegen.api.text import summary
from scvi_codegen.common.errors import OrbitError, StateError, StepFailedError
from scvi_codegen.extras.fits.fixed_steps import tangents_along
from scvi_codegen.extras.orbits.constraint_manifold import reduction_of
from scvi_codegen.extras.orbits.solver import MOST_ITERATIONS, SETTLED
from scvi_codegen.extras.paths.size import ROUNDOFF, SAME_MOTION
from scvi_codegen.runs.stepper import Stepper

LEAST_CHANGE = 0.1
"""Least |mu - 1| of the steps, whose eigenvalues have the error of one short step."""
HALVINGS = 60
NULL = 1e-10
"""Singular values below this fraction of the largest belong to directions in which the system is free."""
FLAT = 1e-3
"""Part of the eigenvalues at the guess below which the iteration leaves for infinity, where no force is left."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Equilibrium:
    """A state of rest.

    Attributes:
        q, p: (m,) positions and momenta.
        t: time at which it was determined.
        eigenvalues: (2m,) those of the linear motion, in descending order of their imaginary parts.
        error: difference of the eigenvalues from those of half the step, relative to the largest one.
        vectors: (2m, 2m) their eigenvectors (changes of q and p), in columns.
        parameters: (k,) in the order of ``stepper.parameters``.
        stepper: the compiled integrator.
    """

    q: Array
    p: Array
    t: float
    eigenvalues: NDArray[np.complex128]
    vectors: NDArray[np.complex128] = field(repr=False)
    error: float
    parameters: Array
    stepper: Stepper = field(repr=False)

    __repr__ = summary("q", "p", "frequencies", "stable")

    @property
    def _oscillations(self) -> NDArray[np.bool_]:
        values, sizes = self.eigenvalues, np.abs(self.eigenvalues)
        return np.asarray((values.imag > SAME_MOTION * sizes.max()) & (np.abs(values.real) <= SAME_MOTION * sizes))

    @property
    def frequencies(self) -> Array:
        """Angular frequencies of the oscillations without growth or decay, in descending order."""
        return np.asarray(self.eigenvalues.imag[self._oscillations])

    @property
    def modes(self) -> NDArray[np.complex128]:
        """(2m, n) changes of (q, p) of the oscillations; the real and imaginary parts are a quarter period apart."""
        return np.asarray(self.vectors[:, self._oscillations])

    @property
    def stable(self) -> bool:
        """Return whether no eigenvalue has a positive real part, up to rounding."""
        return bool((self.eigenvalues.real <= SAME_MOTION * np.abs(self.eigenvalues).max()).all())


@checks_arguments(StateError, stepper=Stepper.KIND)
def equilibrium(stepper: Stepper, q: ArrayLike, *, t: float = 0.0, parameters: Parameters = None) -> Equilibrium:
    """Find the equilibrium near given positions by Newton's method, with the frequencies of its small oscillations.

    Args:
        stepper: the compiled stepper.
        q: (m,) positions near those of the equilibrium.
        t, parameters: as of :meth:`Stepper.integrate`.

    Raises:
        OrbitError: if the iteration does not converge.
        MethodError: if the stepper has no derivatives, nonholonomic constraints or transformed time.
        StateError: if a shape, name or number is invalid, or the equilibrium is at a kink, beside which motions differ.
    """
    stepper = stepper.bind(q, parameters)[0]._known_with_events
    stepper.products.require("periodic_orbit")
    stepper.products.check_given(parameters, step=True)
    state, values = stepper.products.start(q, None, np.zeros(stepper.dimension), t, parameters)
    reduction = reduction_of(stepper, t, values)
    guess = state
    state = np.ravel(reduction.normalised(*np.split(state, 2)))
    motion = _Motion(stepper, reduction, t, values)
    motion = motion.of_short_steps(state)
    factors, begun, largest = np.full(reduction.size, math.inf), 0.0, 0.0
    for _ in range(MOST_ITERATIONS):
        former, (defect, derivative) = factors, motion.step(state)
        factors = np.linalg.eigvals(derivative)
        moving = derivative - np.eye(reduction.size)
        units = _units(moving)
        balanced = moving * units / units[:, np.newaxis]
        change = units * np.linalg.lstsq(balanced, -defect / units, rcond=NULL)[0]
        force = np.abs(balanced @ (change / units) + defect / units).max()  # in directions in which the system is free
        largest = max(largest, np.abs(defect / units).max())
        sizes = np.abs(reduction.outward(*np.split(state, 2))) @ np.abs(state) / units
        at_rest = force <= max(SAME_MOTION * largest, Products.RESOLVED * ROUNDOFF * sizes.max())
        state = np.ravel(reduction.normalised(*np.split(state + reduction.inward(*np.split(state, 2)) @ change, 2)))
        # The derivative of the step, which the change of the state hardly changes, gives the scale of a small change.
        strength = np.abs(factors - 1).max()
        begun = begun or strength
        converged = np.abs(np.sort(factors) - np.sort(former)).max() <= SAME_MOTION * strength
        if converged and at_rest and strength >= FLAT * begun:
            stepper.products.check_sides(np.array([guess, state]), (t, t), motion.h, values)
            return motion.at_rest(state)
    raise OrbitError(
        f"no equilibrium of '{stepper.title}' was found near q = {np.asarray(q)}: {MOST_ITERATIONS} iterations did not "
        "converge. Give a better initial guess"
    )


def _units(moving: Array) -> Array:
    """Return the units of mass-weighted coordinates, 1/sqrt(m), and of momenta, by dq = h/m dp of a short step."""
    half = len(moving) // 2
    mobility = np.abs(np.diag(moving[:half, half:]))
    roots = np.sqrt(np.where(mobility > 0.0, mobility, 1.0))
    return np.concatenate([roots, 1.0 / roots])


@dataclass(frozen=True, eq=False)
class _Motion:
    """Short steps of a system, and their derivatives in the reduced tangent space."""

    stepper: Stepper
    reduction: Reduction
    t: float
    parameters: Array
    h: float = 1.0

    def of_short_steps(self, state: Array) -> _Motion:
        """Return the motion in the least step, a power of two, whose derivative differs from 1 by a tenth."""
        for h in 2.0 ** np.arange(-HALVINGS, HALVINGS):
            with suppress(StepFailedError), np.errstate(all="ignore"):
                longer = replace(self, h=float(h))
                if np.abs(np.linalg.eigvals(longer.step(state)[1]) - 1).max() >= LEAST_CHANGE:
                    return longer
        return self

    def step(self, state: Array) -> tuple[Array, Array]:
        """Return the change of a state by a step and the derivative of the step."""
        tangents = np.zeros((len(state), self.stepper.products.tangents))
        tangents[:, : len(state)] = np.eye(len(state))
        at = np.array([self.t]), np.array([self.h]), tangents, self.parameters
        states, vectors, _ = tangents_along(self.stepper, state, *at)
        outward, inward = (m(*np.split(state, 2)) for m in (self.reduction.outward, self.reduction.inward))
        end = self.reduction.aligned(states[-1], state)
        return outward @ (end - state), outward @ vectors[-1].T @ inward

    def _spectrum(self, state: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the eigenvalues of the linear motion by the derivative of the step, and their vectors."""
        factors, vectors = np.linalg.eig(self.step(state)[1].astype(complex))
        return np.log(factors) / self.h, vectors

    def at_rest(self, state: Array) -> Equilibrium:
        """Return the equilibrium at a state; the step is halved while its eigenvalues approach those of half of it."""
        motion, error, (values, vectors) = self, math.inf, self._spectrum(state)
        while error > SETTLED:
            motion = replace(motion, h=motion.h / 2.0)
            finer, finer_vectors = motion._spectrum(state)
            difference = float(np.abs(values[:, np.newaxis] - finer).min(axis=1).max())
            difference /= float(np.abs(finer).max()) or 1.0  # free in all directions
            if difference > error / 2.0:
                break
            error, values, vectors = difference, finer, finer_vectors
        order = np.argsort(-values.imag, kind="stable")
        q, p = np.split(state, 2)
        return Equilibrium(
            q=q,
            p=p,
            t=self.t,
            eigenvalues=values[order],
            vectors=self.reduction.inward(q, p) @ vectors[:, order],
            error=error,
            parameters=self.parameters,
            stepper=self.stepper,
        )
