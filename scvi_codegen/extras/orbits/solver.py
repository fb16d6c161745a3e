"""Periodic orbits: Newton's iteration on the state after one period, with the exact monodromy matrix.

The steps of a period are equal, or chosen adaptively and then frozen relative to the period while Newton's method
iterates. The error of a run from the start of an orbit (:mod:`scvi_codegen.runs.accuracy.run_error`) gives the end x of
the exact motion: with its defect d, x minus the start, and the Jacobian A of the closing equations, A^+ d is the error
of the orbit, computed minus exact, up to its square.

Where tangent vectors grow along the guess, the period is cut into segments first (multiple shooting).

Periodic orbits are not isolated: the initial point is arbitrary, and orbits form one-parameter families (by energy or
another conserved quantity). Each Newton step is the minimum-norm solution of the linearised equations (Moore-Penrose
inverse), so the iteration converges to a nearby orbit without phase conditions. Equations implied by conserved
quantities are projected out (Munoz-Almaraz et al., Physica D 181 (2003) 1).

Symmetric orbits start in the fixed set of a reversor R and return to it after half a period, which is computed alone:
the end x has the defect (x - R x)/2; see :mod:`~scvi_codegen.extras.orbits.reversor`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.checks import checked_count, checks_arguments
from scvi_codegen.api.runs import Products, without_accuracy_warnings
from scvi_codegen.api.states import Array, Fixed, Parameters, Reduction, checked_number
from scvi_codegen.api.text import summary
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import (
    AccuracyWarning,
    EventError,
    MethodError,
    OrbitError,
    StateError,
    StepFailedError,
    closest,
    warn,
)
from scvi_codegen.extras.fits.fixed_steps import tangents_along
from scvi_codegen.extras.fits.measurements import state_names
from scvi_codegen.extras.orbits.constraint_manifold import reduction_of
from scvi_codegen.extras.orbits.reversor import Reversor
from scvi_codegen.extras.orbits.step_sequence import StepSequence
from scvi_codegen.extras.paths.size import INCREMENT, ROUNDOFF, SAME_MOTION, SizeOfMotion
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory

ERROR, ERROR_OF_EQUAL_STEPS = 1e-9, 1e-6
"""Default bounds of the discretisation error, of adaptive steps and of those that the user chose. The first also bounds
defects of symplecticity and reversal, and singular values that count as zero: defects of symmetric steps are 1e-16 to
2e-15 (Henon-Heiles, orbits about L1), those of the motions of a wrong reversor about 0.4."""
TOLERANCES = (1e-2, 1e-4, 0.0)
"""Local tolerances of adaptive steps, relative to the bound of the discretisation error, until one meets it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PeriodicOrbit:
    """Periodic orbit of the computed map.

    Attributes:
        q, p: (m,) initial state.
        t: initial time.
        period: the period.
        steps: number of steps per period.
        sequence: ends of the steps relative to the period.
        monodromy: (2m, 2m) derivative of the end with respect to the start; of systems with rotations in canonical
            coordinates of the reduced space, with 6 rows for a rotation, 4 for a direction and 2 for a spin, and of the
            constraint manifold, with 2 rows fewer for each holonomic constraint.
        residual: largest entry of the end minus the start, of the computed map; of symmetric orbits (x - R x)/2 of the
            state x after half a period.
        error: largest of three relative errors, with those of rounding: of the positions and of the momenta at the
            start, relative to the largest range of a position and the largest momentum of a velocity over the orbit,
            and of the period; infinite where they are unknown.
        errors: errors of the start and of the period, by those of a run from it (``run.error``). They are linear in it:
            near a separatrix, where multipliers times ``error`` are above 1, those of few steps are larger.
        autonomous: whether motions that are shifted in time are motions, too, so that a multiplier is 1.
        iterations: number of Newton iterations.
        parameters: (k,) in the order of ``stepper.parameters``.
        stepper: the compiled integrator.
    """

    q: Array
    p: Array
    t: float
    period: float
    steps: int
    monodromy: Array
    residual: float
    error: float
    errors: ErrorsOfOrbit = field(repr=False)
    autonomous: bool
    iterations: int
    parameters: Array
    stepper: Stepper = field(repr=False)
    sequence: StepSequence = field(repr=False)
    options: SolverOptions | None = field(default=None, repr=False)

    __repr__ = summary("q", "p", "period", "steps", "error")

    def __str__(self) -> str:
        """Return start and period, with the uncertain digits in parentheses."""
        names, values = [*state_names(self.stepper), "period"], [*self.q, *self.p, self.period]
        rows = zip(names, values, self.errors.bounds, strict=True)
        lines = [f"{name} = {Products.with_uncertainty(value, bound)}" for name, value, bound in rows]
        return "\n".join([*lines, f"relative error {self.error:.0e}", *filter(None, [self.errors.reason])])

    def run(self, *, save_every: int = 1) -> Trajectory:
        """Return the trajectory of one period, every ``save_every``-th state; of adaptive steps a new adaptive run."""
        steps: dict[str, Any] = {"h": self.period / self.steps, "steps": self.steps}
        if self.sequence.tolerance is not None:
            steps = {"t_end": self.t + self.period, "tolerance": self.sequence.tolerance or None}
        return self.stepper.integrate(
            self.q, self.p, **steps, save_every=save_every, t=self.t, parameters=self.parameters, options=self.options
        )

    @property
    def energy(self) -> float:
        """Energy of the initial state."""
        return float(self.stepper.energy(self.q, self.p, self.t, self.parameters))

    @cached_property
    def multipliers(self) -> NDArray[np.complex128]:
        """(2m,) Floquet multipliers, the eigenvalues of the monodromy matrix, in descending order of modulus.

        Multiple eigenvalues at 1, caused by conserved quantities, are accurate to half of the digits only.
        """
        values = np.linalg.eigvals(self.monodromy).astype(complex)
        return values[np.argsort(-np.abs(values))]

    @cached_property
    def monodromy_error(self) -> Array:
        """(2m, 2m) error of the monodromy matrix with its sign, by steps of a finer method along the exact orbit.

        Raises:
            MethodError: if the stepper has no finer method (it was loaded without its system).
        """
        finer = self.stepper.products.finer.with_events(self.stepper.changing_events)
        rest: dict[str, Any] = {"sequence": self.sequence, "fixed_indices": (), "energy": None, "options": self.options}
        exact = np.concatenate([self.q, self.p, [self.period]]) - np.nan_to_num(self.errors.signed)
        z, none = exact[:-1], np.zeros(len(self.q))
        search = OrbitSearch.at(
            finer,
            z[: len(none)],
            period=self.period,
            gain=none,
            drifts=none > 0,
            t=self.t,
            parameters=self.parameters,
            **rest,
        )
        segment = search._segment(z, self.sequence, 0, len(self.sequence), float(exact[-1]))
        return self.monodromy - search.leaving(segment, z) @ segment.monodromy

    @cached_property
    def multiplier_errors(self) -> NDArray[np.complex128]:
        """(2m,) errors of the multipliers, each minus the nearest one of the monodromy matrix without its error.

        Rounding is no part of them: see :attr:`multiplier_bounds`.
        """
        exact = list(np.linalg.eigvals(self.monodromy - self.monodromy_error))
        nearest = (exact.pop(int(np.argmin(np.abs(np.array(exact) - value)))) for value in self.multipliers)
        return np.asarray(self.multipliers - np.fromiter(nearest, complex))

    @cached_property
    def multiplier_bounds(self) -> Array:
        """(2m,) radii of discs about the multipliers that contain those of the system, with rounding errors.

        A matrix within epsilon of another one, A, has as many eigenvalues in a part of the set where the least singular
        value of A - z is at most epsilon as A has (L. N. Trefethen, M. Embree, Spectra and Pseudospectra, 2005, 2 and
        52): k equal multipliers, as of Kepler's orbits, change by the k-th root of epsilon. It is the error of the
        monodromy matrix and a rounding of it for each step, in coordinates that balance it.

        Raises:
            MethodError: as :attr:`monodromy_error`.
        """
        from scipy.linalg import matrix_balance  # imported on use, as in other functions of matrices

        matrix, (scales, _) = matrix_balance(self.monodromy, permute=False, separate=True)
        change = self.monodromy_error / scales[:, np.newaxis] * scales
        epsilon = np.linalg.norm(change, 2) + len(self.sequence) * ROUNDOFF * np.linalg.norm(matrix, 2)
        circle = np.exp(2j * np.pi * np.arange(CIRCLE) / CIRCLE)[:, np.newaxis, np.newaxis] * np.eye(len(matrix))

        def radius(value: complex) -> float:
            size = float(epsilon)
            while (
                np.linalg.svd(matrix - value * np.eye(len(matrix)) - size * circle, compute_uv=False).min() <= epsilon
            ):
                size *= 2.0
            return size

        return np.array([radius(value) for value in self.multipliers])

    @property
    def reciprocal_error(self) -> float:
        """Deviation of the multipliers' moduli from the pairs s, 1/s of symplectic maps: the largest ``|s s' - 1|``."""
        sizes = np.abs(self.multipliers)
        return float(np.abs(sizes * sizes[::-1] - 1.0).max())

    @property
    def symplectic_error(self) -> float:
        """Symplecticity defect of the monodromy matrix, relative to its squared norm."""
        return _symplectic_error(self.monodromy)

    @cached_property
    def stability_indices(self) -> NDArray[np.complex128]:
        """(m,) stability indices (s + 1/s)/2 of the pairs of multipliers s, 1/s, descending; stable between -1 and 1.

        They have the accuracy of the monodromy matrix, also at 1 (Broucke, AIAA J. 7 (1969) 1003; Howell, Celest. Mech.
        32 (1984) 53).

        Raises:
            MethodError: if the steps are not symplectic.
        """
        if self.symplectic_error > ERROR:
            raise MethodError(
                f"stability indices are undefined: steps of '{self.stepper.title}' are not symplectic; use multipliers"
            )
        means = list(np.linalg.eigvals(self.monodromy + _inverse(self.monodromy)).astype(complex) / 2.0)
        indices = []
        while means:  # each index occurs twice
            largest = means.pop(int(np.argmax(np.abs(means))))
            indices.append((largest + means.pop(int(np.argmin(np.abs(np.array(means) - largest))))) / 2.0)
        return np.array(indices)

    @property
    def stable(self) -> bool:
        """Return whether no multiplier exceeds 1 in modulus, up to rounding."""
        if self.symplectic_error > ERROR:
            return bool(np.abs(self.multipliers).max() <= 1.0 + SAME_MOTION)
        indices = self.stability_indices
        return bool((np.abs(indices.real) <= 1.0 + SAME_MOTION).all() and (np.abs(indices.imag) <= SAME_MOTION).all())


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorsOfOrbit:
    """Errors of the start and the period of an orbit, computed minus exact, of the nearest orbit of the system.

    Attributes:
        signed: (2m + 1,) errors of q, p and the period with their signs, NaN where they are unknown.
        bounds: (2m + 1,) bounds of their absolute values: errors by comparison and those of rounding are added.
        reason: why the errors are unknown, else empty.
    """

    signed: Array
    bounds: Array
    reason: str = ""

    @classmethod
    def unknown(cls, m: int, reason: str) -> ErrorsOfOrbit:
        """Return errors that are unknown for a reason."""
        return cls(signed=np.full(2 * m + 1, math.nan), bounds=np.full(2 * m + 1, math.inf), reason=reason)

    @property
    def q(self) -> Array:
        """(m,) errors of the initial positions."""
        return self.signed[: len(self.signed) // 2]

    @property
    def p(self) -> Array:
        """(m,) errors of the initial momenta."""
        return self.signed[len(self.signed) // 2 : -1]

    @property
    def period(self) -> float:
        """Error of the period."""
        return float(self.signed[-1])


def _inverse(matrix: Array) -> Array:
    """Return the inverse -Omega M^T Omega of a symplectic matrix M."""
    m = len(matrix) // 2
    a, b, c, d = matrix[:m, :m], matrix[:m, m:], matrix[m:, :m], matrix[m:, m:]
    return np.block([[d.T, -b.T], [-c.T, a.T]])


def _symplectic_error(monodromy: Array) -> float:
    """Return the largest entry of M^-1 M - 1 with the inverse of a symplectic matrix, relative to |M|^2."""
    defect = _inverse(monodromy) @ monodromy - np.eye(len(monodromy))
    return float(np.abs(defect).max() / max(1.0, np.linalg.norm(monodromy, 2) ** 2))


CONTRACTION = 0.25
"""Largest ratio of successive residuals of the simplified Newton iteration that converges (P. Deuflhard, Newton Methods
for Nonlinear Problems, 2004, 2.1.2)."""
CIRCLE = 32
"""Number of points of a circle at which singular values are computed: they change slowly along it."""
MOST_ITERATIONS, MOST_HALVINGS = 50, 12
EASY, GROWTH = 10.0, 4.0
"""Growth of tangent vectors in a period up to which one segment is enough, and that in each of more segments."""
CLOSED = 1e-11
"""Largest closing error, relative to the size of the motion and the norm of the monodromy matrix."""
OPEN = 1e-3
"""Closing error relative to the size of the motion above which no growth of rounding errors makes an orbit closed."""
IMPLIED = 10.0
"""Least strength of conserved directions relative to the closing error: equations are then implied up to a tenth."""
CONSERVED = 1e-3
"""Relative error of the transported gradient of an integral up to which the integral counts as conserved."""
SETTLED = 1e-13
"""Newton step, relative to the motion and the period, below which the iteration ends."""
MOST_INCREASE = 10.0
"""Largest factor by which a Newton step may increase the residual."""
FREEDOM = 3.0
"""Largest factor by which the period of an orbit may differ from its guess."""
FAR = 1.5
"""Factor between the periods, and part of the distance of the guess from the middle of the orbit, beyond which an
orbit is not the guessed one."""
RESTORATIONS = 4
"""Newton iterations, of quadratic convergence, that restore fixed entries after a state is normalised: 0.1^(2^4) is
rounding, so that a tenth of the size of the motion is restored."""
OTHER = 1.0 / 3.0
"""Part of the amplitude of an orbit from which its distance to the guess is reported."""


@checks_arguments(StateError, stepper=Stepper.KIND)
def periodic_orbit(
    stepper: Stepper,
    q: ArrayLike,
    p: ArrayLike | None = None,
    *,
    velocity: ArrayLike | None = None,
    period: float,
    steps: int | None = None,
    h: float | None = None,
    error: float | None = None,
    max_step: float | None = None,
    fixed_period: bool = False,
    energy: float | None = None,
    fixed: Sequence[str] = (),
    gain: ArrayLike | Sequence[float | None] | None = None,
    reversor: str | Sequence[str] | None = None,
    t: float = 0.0,
    parameters: Parameters = None,
    options: SolverOptions | None = None,
) -> PeriodicOrbit:
    """Find a periodic orbit near an initial guess, by Newton's iteration with exact derivatives of the steps.

    Where the orbit is unstable, multiple shooting improves the guess first. Give a state on the orbit and the period;
    without ``fixed`` or ``energy`` the orbit is one of a family near the guess. Steps are adaptive along the guess and
    frozen, relative to the period, while Newton's method iterates, unless ``steps`` or ``h`` makes them equal. The
    error of a run from its start then gives the error of the orbit, ``orbit.error``; an
    :class:`~scvi_codegen.AccuracyWarning` reports one above the bound ``error``. If the iteration
    fails or converges to an equilibrium, it is repeated from a closed curve near the guess, and with fixed positions.
    An :class:`~scvi_codegen.AccuracyWarning` reports an orbit that differs from the guess by more than a third of its
    amplitude, with its period, this distance and its amplitude: another member of the family, or another orbit.

    Args:
        stepper: the compiled stepper.
        q, p, velocity: (m,) initial guess of a state on the orbit, with one of p and velocity, which is moved onto the
            constraints. Rotations must close as rotations, not as quaternions.
        period: initial guess of the period, positive.
        steps: number of equal steps per period, instead of adaptive ones.
        h: instead of ``steps``, the largest step size for the initial period; its sign is ignored.
        error: bound of ``orbit.error``, by default 1e-9; adaptive steps become smaller until
            it is met. By default 1e-6 with ``steps`` or ``h``, which it does not change.
        max_step: largest size of adaptive steps, at most an eighth of the period.
        fixed_period: keep the period fixed; required if the system depends on time.
        energy: prescribed energy of the orbit.
        fixed: coordinates and momenta (``"p_x"``) that keep their initial values: an amplitude, or a section such as
            ``["y"]``.
        gain: (m,) increase of the positions over a period: 2 pi for a rotating angle, by default 0, and ``None`` where
            it is unknown, of a coordinate on which the motion does not depend: the way of a walker.
        reversor: of a symmetric orbit, of which half a period is computed: formulas of positions R(q), such as
            ``["x", "-y", "z"]``, if a motion q(t), reversed as R(q(-t)), is one, too, or ``"detect"`` for changes of
            signs. The guess is moved to a state with q = R(q) and v = -R'v.
        t, parameters, options: as of :meth:`Stepper.integrate`.

    Returns:
        A :class:`PeriodicOrbit`.

    Raises:
        OrbitError: if the iteration does not converge, converges to an equilibrium or to another energy, if there are
            no constrained positions near q, or if the system is not periodic in time with this period.
        MethodError: if time is transformed, the stepper has nonholonomic constraints, an energy is prescribed with
            forces, or the period of a time-dependent system is free.
        StateError: if a shape, name or number is invalid, an input is not set, or ``reversor`` is no symmetry.
        StepFailedError: if a step from the initial guess fails.
    """
    stepper = stepper.bind(q, parameters)[0]._known_with_events
    stepper.products.require("periodic_orbit")
    stepper.products.check_given(parameters)
    if energy is not None:
        stepper.products.require("energy")
    if (period := checked_number(period, "the period")) <= 0.0:
        raise StateError(f"the period must be positive, not {period:g}")
    sequence, largest = _equal_steps(period, steps, h), stepper.products.largest_step(max_step)
    if sequence is not None and largest < math.inf:
        raise StateError(f"max_step={max_step:g} requires adaptive steps: omit it, or steps and h")
    if sequence is None:
        stepper.products.require("adaptive")
    t = checked_number(t, "t")
    start, values = stepper.products.start(q, p, velocity, t, parameters)
    search = OrbitSearch.at(
        stepper,
        start[: stepper.dimension],
        period=period,
        sequence=sequence,
        max_step=largest,
        fixed_indices=indices_of(stepper, fixed, fixed_period=fixed_period),
        energy=None if energy is None else checked_number(energy, "the energy"),
        **gains_of(stepper, gain),
        t=t,
        parameters=values,
        options=options,
    )
    guess = np.append(start, search.period)
    guess = search.moved(guess, 0.0 * guess)
    if reversor is not None:
        search, guess = search.symmetric(reversor, start, lambda _: guess)
    return search.orbit(guess, bound_of(sequence, error))


def bound_of(sequence: StepSequence | None, error: float | None) -> float:
    """Return the bound of the discretisation error, by default that of adaptive or equal steps."""
    if error is None:
        return ERROR if sequence is None else ERROR_OF_EQUAL_STEPS
    return checked_part("error", error, "a bound of the relative discretisation error")


def checked_part(name: str, value: float, meaning: str) -> float:
    """Return a number between 0 and 1, or raise :class:`StateError`."""
    if not 0.0 < (value := checked_number(value, name)) <= 1.0:
        raise StateError(f"{name} must be between 0 and 1, {meaning}, not {value:g}")
    return value


def indices_of(stepper: Stepper, fixed: Sequence[str], *, fixed_period: bool) -> tuple[int, ...]:
    """Return the indices of the unknowns with fixed values, -1 of the period."""
    names = state_names(stepper)
    for name in fixed:
        if name not in names:
            raise StateError(f"fixed names '{name}', which is no coordinate or momentum{closest(name, names)}")
    return (*map(names.index, dict.fromkeys(fixed)), *([-1] if fixed_period else []))


def gains_of(stepper: Stepper, gain: ArrayLike | Sequence[float | None] | None) -> dict[str, Any]:
    """Return the increase of the positions over a period, and a mask of those that return up to an unknown increase."""
    entries: Any = np.zeros(stepper.dimension) if gain is None else gain
    drifts = np.array([entry is None for entry in np.atleast_1d(np.asarray(entries, dtype=object))])
    if drifts.any():
        if stepper.interface.imposed:
            raise StateError("a gain of None requires a system without constraints: give its number")
        entries = [0.0 if entry is None else entry for entry in entries]
    return {"gain": stepper.products.states.vector(entries, "gain"), "drifts": drifts}


def _equal_steps(period: float, steps: int | None, h: float | None) -> StepSequence | None:
    """Return the equal steps of a period, by their number or their largest size; ``None`` for adaptive steps."""
    if steps is not None and h is not None:
        raise StateError(
            "give the number of steps per period (steps=200), or the largest step size (h=0.05), or neither for "
            f"adaptive steps; periodic_orbit got both, steps={steps} and h={h}"
        )
    if steps is not None:
        return StepSequence.equal(checked_count(steps, "steps", least=1))
    return None if h is None else StepSequence.equal(int(Fixed.checked(h).number_in(period)))


@dataclass(frozen=True, eq=False)
class OrbitSearch:
    """Equations of a periodic orbit as a function of z = (q, p, period).

    Attributes:
        reduction: maps between (q, p) and the tangent space without gauge directions of rotations.
        sequence: ends of the steps relative to the period; ``None`` for adaptive ones that are not yet known.
        max_step: largest size of adaptive steps.
        fixed_indices: indices of the fixed entries of z, -1 that of the period.
        at_rest: (m,) momenta without velocity at the guess, which are no size of the motion.
        gain: (m,) increase of the positions over a period.
        drifts: (m,) mask of positions with another increase, which is unknown.
        reversor: of symmetric orbits, whose steps and segments are those of half a period.
        varied: index of the parameter by which ends of segments are differentiated.
    """

    stepper: Stepper
    reduction: Reduction
    at_rest: Array
    period: float
    sequence: StepSequence | None
    max_step: float
    fixed_indices: tuple[int, ...]
    energy: float | None
    gain: Array
    drifts: NDArray[np.bool_]
    t: float
    parameters: Array
    options: SolverOptions | None
    reversor: Reversor | None = None
    varied: int | None = None

    @classmethod
    def at(
        cls, stepper: Stepper, q: Array, *, t: float, parameters: Array, max_step: float = math.inf, **rest: Any
    ) -> OrbitSearch:
        """Return the equations next to a position, whose momenta without velocity are 0 where they are undefined."""
        at_rest = np.zeros_like(q)
        with suppress(StateError):  # undefined of most Hamiltonians
            at_rest = stepper.momentum(q, at_rest, t, parameters)
        reduction = reduction_of(stepper, t, parameters)
        own: dict[str, Any] = {"at_rest": at_rest, "reduction": reduction, "max_step": max_step}
        return cls(stepper=stepper, t=t, parameters=parameters, **own | rest)

    def orbit(self, guess: Array, bound: float) -> PeriodicOrbit:
        """Return the orbit near a guess, with a discretisation error below a bound if steps are adaptive.

        Raises as :func:`periodic_orbit`.
        """
        if self.sequence is not None:
            orbit = self._nearest(guess)
        else:
            orbit = self.adapted(guess, TOLERANCES[0] * bound)._nearest(guess)
            for part in TOLERANCES:  # the first sequence of steps is that of the guess, a different motion
                near = np.concatenate([orbit.q, orbit.p, [orbit.period]])
                refreshed = self.adapted(near, part * bound)._refreshed(near)
                orbit = replace(refreshed, iterations=orbit.iterations + refreshed.iterations)
                if orbit.error <= bound:
                    break
        _warn_of_distance(orbit, guess)
        _warn_of_discretisation(orbit, bound)
        return orbit

    def adapted(self, z: Array, tolerance: float) -> OrbitSearch:
        """Return the search with the steps of an adaptive run along z."""
        at = self.max_step, self.t, self.parameters, self.options
        end = 1.0 if self.reversor is None else 0.5
        return replace(self, sequence=StepSequence.adaptive(self.stepper, z[:-1], float(z[-1]), tolerance, *at, end))

    def symmetric(
        self, reversor: str | Sequence[str], state: Array, guess_of: Callable[[Reversor], Array]
    ) -> tuple[OrbitSearch, Array]:
        """Return the search of symmetric orbits, and the guess z by the reversor, in its fixed set, near a state."""
        stepper = self.stepper
        if stepper.divides_steps or self.reduction.size < 2 * stepper.dimension or self.drifts.any():
            raise StateError("reversor= excludes events, kinks, rotations, constraints and unknown gains: omit it")
        if self.sequence is not None and len(self.sequence) % 2:
            raise StateError(f"reversor= requires an even number of steps, not {len(self.sequence)}")
        texts = reversor.split(",") if isinstance(reversor, str) else reversor
        detects = reversor == "detect"
        for own in Reversor.fitting(state) if detects else [Reversor.of(stepper.coordinates, texts)]:
            guess = guess_of(own)
            if self.of_reversor(own).irreversibility(guess) <= ERROR:
                return self.of_reversor(own), np.append((guess[:-1] + own(guess[:-1])) / 2.0, guess[-1])
        tried = "no change of signs that keeps the guess reverses" if detects else "it does not reverse"
        raise StateError(f"reversor={reversor!r}: {tried} the steps of '{stepper.title}'; give a symmetry, or omit it")

    def of_reversor(self, reversor: Reversor | None) -> OrbitSearch:
        """Return the search of orbits that are symmetric by another reversor, or of whole ones."""
        sequence = self.sequence
        if sequence is not None and (reversor is None) != (self.reversor is None):
            sequence = sequence.mirrored if reversor is None else sequence.half
        return replace(self, reversor=reversor, sequence=sequence)

    def irreversibility(self, z: Array) -> float:
        """Return the distance of mirror images of states from steps back to them, relative to the motion."""
        assert self.reversor is not None
        search = self if self.sequence is not None else self.adapted(z, TOLERANCES[0] * ERROR)
        at: Any = np.zeros((0, self.stepper.products.tangents)), self.parameters, self.options
        times = z[-1] * search.steps.ends
        states = tangents_along(self.stepper, z[:-1], self.t + times[:-1], np.diff(times), *at)[0]
        images, away = self.reversor(states), []
        for k in range(len(states) - 1):
            step = self.t - times[k + 1 : k + 2], np.diff(times)[k : k + 1]
            away.append(tangents_along(self.stepper, images[k + 1], *step, *at)[0][-1] - images[k])
        return float((np.abs(away) / self.sizes_of(states)).max())

    def _refreshed(self, z: Array) -> PeriodicOrbit:
        """Return the orbit of the steps of this search next to one of other steps."""
        try:
            return self.described(*self._iterated(z, self.closing_equations(z), 0), guess=z)
        except OrbitError:
            return self._nearest(z)

    def _nearest(self, guess: Array) -> PeriodicOrbit:
        """Return the orbit near a guess, found in one of a few attempts.

        The first one starts at the trajectory of the guess; the second one at a closed curve near it. If nothing is
        fixed two more keep the positions, so that the amplitude cannot vanish: then the iteration does not converge to
        an equilibrium.
        """
        failures: list[Exception] = []
        far: list[PeriodicOrbit] = []
        attempts = [(self, False), (self, True)]
        if self.energy is None and self.reversor is None and not set(self.fixed_indices) - {-1}:
            at_positions = replace(self, fixed_indices=(*self.fixed_indices, *range(self.stepper.dimension)))
            attempts += [(at_positions, False), (at_positions, True)]
        for search, smoothed in attempts:
            try:
                iterated = search._iterated(*search._by_segments(guess, smoothed=smoothed))
                orbit = search.described(*iterated, guess=guess)
                if _is_near(orbit, guess, search._whole(iterated[1].motion.states)):
                    return orbit
                far.append(orbit)
            except (OrbitError, StepFailedError, np.linalg.LinAlgError) as failure:
                failures.append(failure)
        if far:
            return far[0]
        raise next((failure for failure in failures if isinstance(failure, OrbitError)), failures[0])

    @property
    def steps(self) -> StepSequence:
        """Steps of the search, after they are known."""
        assert self.sequence is not None
        return self.sequence

    def described(self, z: Array, equations: ClosingEquations, iterations: int, *, guess: Array) -> PeriodicOrbit:
        """Return the orbit at the end of the iteration, after all checks; raise OrbitError if there is none."""
        m, motion, steps = self.stepper.dimension, equations.motion, self.of_reversor(None).steps
        sizes, reduced = equations.sizes, self.reduced_sizes(equations.sizes)
        rounding = Products.RESOLVED * ROUNDOFF * float((np.abs(z[:-1]) / sizes).max())
        scaled_norm = float(np.linalg.norm(equations.monodromy / reduced[:, np.newaxis] * reduced, 2))
        allowed = (CLOSED + rounding) * max(1.0, scaled_norm)
        if OPEN < equations.relative_error <= allowed:
            self._check_motion(z, motion, guess)
        if not equations.relative_error <= min(OPEN, allowed):
            raise OrbitError(
                f"no periodic orbit was found near the guess: after {iterations} iterations the closing error is "
                f"{equations.error:.1e}, for q = {_listed(z[:m])}, p = {_listed(z[m:-1])}, period {z[-1]:.6g}. "
                "Give a better initial guess (unstable orbits need one within a few percent), fix an "
                "amplitude, fixed=['x', ..], or the period, fixed_period=True, or take more steps"
            )
        self._check_energy(equations, allowed)
        self._check_motion(z, motion, guess)
        if motion.by_time.any():
            self._check_next_period(z, equations, allowed)
        error, errors = self._errors(z, equations)
        return PeriodicOrbit(
            q=z[:m],
            p=z[m:-1],
            t=self.t,
            period=float(z[-1]),
            steps=len(steps),
            sequence=steps,
            monodromy=equations.monodromy,
            residual=equations.error,
            error=error,
            errors=errors,
            autonomous=not motion.by_time.any(),
            iterations=iterations,
            parameters=self.parameters,
            stepper=self.stepper,
            options=self.options,
        )

    def _check_motion(self, z: Array, motion: _Segment, guess: Array) -> None:
        """Raise :class:`OrbitError` if a closed orbit is an equilibrium, by the ranges of its positions and momenta."""
        m = self.stepper.dimension
        ranges, distances = (
            sizes.reshape(2, m).max(axis=1) for sizes in (np.ptp(motion.states, axis=0), abs(z - guess)[:-1])
        )
        rounding = Products.RESOLVED * ROUNDOFF * np.abs(z[:m]).max()
        at_rest = (ranges < SAME_MOTION * distances).any() and not self.gain.any()  # momenta may be constant
        if at_rest or ranges[0] <= rounding:
            raise OrbitError(
                f"the iteration converged to an equilibrium, q = {_listed(z[:m])}, p = {_listed(z[m:-1])}: fix an "
                "amplitude, fixed=['x', ..], or give a better initial guess"
            )

    def _check_next_period(self, z: Array, equations: ClosingEquations, allowed: float) -> None:
        """Raise an error if the period of a time-dependent system is free, or the orbit does not close again."""
        system, period = self.stepper.interface.system, float(z[-1])
        if -1 not in self.fixed_indices:
            raise MethodError(
                f"'{system}' depends on time: give the period of this dependence as period, with fixed_period=True"
            )
        later = replace(self, t=self.t + period).closing_equations(z)
        apart = np.abs(later.motion.states[-1] - equations.motion.states[-1]) / equations.sizes
        error = max(float(apart.max()), later.relative_error)
        if not error <= allowed:
            raise OrbitError(
                f"the orbit from t = {self.t:g} does not close in the next period (error {error:.1e}): '{system}' is "
                f"not periodic in time with the period {period:.10g}"
            )

    def _by_segments(self, guess: Array, *, smoothed: bool) -> tuple[Array, ClosingEquations, int]:
        """Improve a guess by multiple shooting where tangent vectors grow along it; one segment needs no improvement.

        States at the ends of segments are further unknowns, and continuity there further equations (Stoer & Bulirsch,
        *Introduction to Numerical Analysis*, 7.3.5).
        """
        nodes = self.nodes(guess, smoothed=smoothed)
        if nodes is None:
            return guess, self.closing_equations(guess), 0
        z, _, iterations = self._iterated(nodes, self.closing_equations(nodes), 0)
        nearer = np.append(z[: len(guess) - 1], z[-1])
        return nearer, self.closing_equations(nearer), iterations

    def nodes(self, guess: Array, *, smoothed: bool) -> Array | None:
        """Return the starts of the segments of a guess and its period; ``None`` if one segment is enough.

        The first nodes are those of half a period forward and half a period backward from the guess: an error of the
        guess grows by the square root of the growth in a period.
        """
        start, count = guess[:-1], len(self.steps)
        earlier, later, monodromy = self._halves(start, float(guess[-1]))
        growth = float(np.abs(np.linalg.eigvals(monodromy)).max())
        if growth <= EASY:
            return None
        pairs = int(np.ceil(np.log(growth) / np.log(GROWTH) / 2.0))
        parts = 2 if self.reversor is None else 1
        segments = min((2 if smoothed else 1) * parts * pairs, count)
        middle = count - len(later)
        path = np.vstack([start, earlier[:middle], later[-2::-1]])
        if smoothed and len(later) > 1:  # distributes the jump in the middle, quadratically in time
            k = np.arange(len(path))
            share = np.minimum(k / middle, (count - k) / len(later))
            path += np.outer(np.where(k <= middle, 0.5, -0.5) * share**2, later[-1] - earlier[middle - 1])
        nodes = np.append(path[self.bounds(segments)[:-1]], guess[-1])
        return self.moved(nodes, 0.0 * nodes)

    def _halves(self, start: Array, period: float) -> tuple[Array, Array, Array]:
        """Return the states forward and backward from a start, the latter a period later, and the monodromy matrix."""
        steps = self.steps
        half, count = steps.middle, len(steps)
        if self.reversor is not None:
            forward = self._segment(start, steps, 0, count, period)
            return forward.states, forward.states[-1:], self.reversor.monodromy(forward.monodromy)
        if self.stepper.divides_steps:  # derivatives through events require runs forward in time
            forward = self._segment(start, steps, 0, count, period)
            later, monodromy = self._states_before(start, period), self.leaving(forward, start) @ forward.monodromy
        else:
            forward = self._segment(start, steps, 0, half, period)
            backward = self._segment(start, steps.reversed, 0, count - half, -period)
            forth, back = (self.leaving(part, backward.states[-1]) @ part.monodromy for part in (forward, backward))
            later, monodromy = backward.states, np.asarray(np.linalg.solve(back.T, forth.T).T)  # forth back^-1
        return forward.states, later + np.append(self.gain, np.zeros(len(self.gain))), monodromy

    def _states_before(self, start: Array, period: float) -> Array:
        """Return the states before a state, in equal steps back over half a period, of impacts that can be undone."""
        count = len(self.steps)
        plan, steps = Fixed(-period / count), count - count // 2
        q, p = np.split(start, 2)
        forward_only = self.stepper.interface.contacts or any(event.changes for event in self.stepper.events)
        if self.steps.tolerance is None and not forward_only:
            settings: dict[str, Any] = {"t": self.t, "parameters": self.parameters, "options": self.options}
            run = self.stepper.products.run_by(plan, q, p, **settings)
            with suppress(EventError, StepFailedError):
                motion, ends = run._recorded(steps), self.t + plan.h * np.arange(1, steps + 1)
                rows = np.searchsorted(-motion.t, -ends + 0.5**30 * period, side="right") - 1
                return np.concatenate([motion.q, motion.p], axis=1)[rows]
        return start[np.newaxis]

    def bounds(self, count: int) -> NDArray[np.intp]:
        """Return the (count + 1,) numbers of the steps at which segments begin and end."""
        return np.linspace(0, len(self.steps), count + 1).round().astype(np.intp)

    def _iterated(self, z: Array, equations: ClosingEquations, iterations: int) -> tuple[Array, ClosingEquations, int]:
        """Iterate until no step helps; return the unknowns, their equations, and the number of all iterations."""
        while iterations < MOST_ITERATIONS and (nearer := self._newton_iterate(z, equations)) is not None:
            (z, equations), iterations = nearer, iterations + 1
        return z, equations, iterations

    def _check_energy(self, equations: ClosingEquations, allowed: float) -> None:
        """Raise :class:`OrbitError` if a closed orbit has another energy.

        ``allowed`` is the error of its state relative to the motion; that of the energy may be its rounding error.
        """
        if self.energy is None:
            return
        away, row = float(equations.defects[-1]), float(self.row_units(equations)[-1])
        if not abs(away) <= allowed * row + Products.RESOLVED * ROUNDOFF * abs(self.energy):
            raise OrbitError(
                f"the periodic orbit near the guess has the energy {self.energy + away:.10g}, not {self.energy:.10g}: "
                "fix fewer entries of the state, or give a better initial guess"
            )

    def _newton_iterate(self, z: Array, equations: ClosingEquations) -> tuple[Array, ClosingEquations] | None:
        """Return the damped Newton iterate, or ``None`` if no step length succeeds or the step is negligible.

        A step length is accepted if the simplified Newton correction with the same Jacobian decreases (Deuflhard's
        natural monotonicity test), which is independent of the unstable direction that dominates the residuals.
        """
        units, into, rows = self._units(equations), equations.into, self.row_units(equations)
        residual = float(np.linalg.norm(equations.defects / rows))
        inverses = [self._inverse(closing) for closing in (equations, *self._without_implied(z, equations))]
        changes = [inverse @ equations.defects for inverse in inverses]
        if np.linalg.norm(changes[0] / units) <= SETTLED * math.sqrt(len(z)):
            return None
        corrections = list(zip(inverses, changes, strict=True))
        for shortened, (inverse, change) in product(0.5 ** np.arange(MOST_HALVINGS), corrections):
            if not self.period / FREEDOM <= z[-1] - shortened * change[-1] <= self.period * FREEDOM:
                continue
            with suppress(EventError, OrbitError, StepFailedError):
                trial, decrease = self.moved(z, -shortened * into @ change), 1.0 - shortened / 4.0
                at = self.closing_equations(trial)
                less = np.linalg.norm(inverse @ at.defects / units) < decrease * np.linalg.norm(change / units)
                if less and np.linalg.norm(at.defects / rows) < MOST_INCREASE * residual:
                    return trial, at
        return None

    def _without_implied(self, z: Array, equations: ClosingEquations) -> Iterator[ClosingEquations]:
        """Yield the equations without those that conserved quantities imply near a closed orbit, if they have more.

        Far from it the equations keep what is implied only up to their error (see :meth:`independent_equations`), in
        which the linear part of a return may say nothing; which correction is right its decrease decides.
        """
        if self.reversor is not None or IMPLIED * equations.relative_error <= CONSERVED:
            return
        starts, size = z[:-1].reshape(-1, 2 * self.stepper.dimension), self.reduction.size
        independent = self.independent_equations(starts, equations.segments, equations.sizes, error=0.0)
        partials, last = equations.partials.copy(), slice((len(starts) - 1) * size, len(starts) * size)
        partials[last] = independent @ partials[last]
        yield replace(equations, partials=partials)

    def moved(self, z: Array, change: Array) -> Array:
        """Return unknowns after a change, normalised and on the constraints, with the fixed entries."""
        moved, rows = z + change, self.fixed_rows(len(z))
        for _ in range(RESTORATIONS):
            moved[:-1] = np.ravel([space.normalised(*state) for space, state in self._nodes(moved)])
            away = rows @ (z + change - moved)
            if not away.any():
                break
            into = block_diagonal([*(space.inward(*state) for space, state in self._nodes(moved)), np.eye(1)])
            moved += into @ np.linalg.lstsq(rows @ into, away, rcond=ERROR)[0]
        return moved

    def _nodes(self, z: Array) -> Iterator[tuple[Reduction, Array]]:
        """Yield the tangent spaces at the starts of segments, and (2, m) positions and momenta there."""
        starts = z[:-1].reshape(-1, 2, self.stepper.dimension)
        ends = self.steps.ends[self.bounds(len(starts))[:-1]] if len(starts) > 1 else [0.0]
        for start, end in zip(starts, ends, strict=True):
            yield self.reduction.at(self.t + float(z[-1] * end), self.parameters), start

    def _units(self, equations: ClosingEquations) -> Array:
        """Return the sizes of the unknowns: of the motion for each start of a segment, and the time of one radian."""
        sizes = self.reduced_sizes(equations.sizes)
        return np.append(np.tile(sizes, len(equations.segments)), self.period / (2.0 * math.pi))

    def row_units(self, equations: ClosingEquations) -> Array:
        """Return the sizes of the equations, of that of the energy the change by the size of the motion."""
        rows = np.tile(self.reduced_sizes(equations.sizes), len(equations.segments))
        if self.energy is None:
            return rows
        return np.append(rows, float(np.linalg.norm(equations.partials[-1] * self._units(equations))) or 1.0)

    def _inverse(self, equations: ClosingEquations) -> Array:
        """Return the pseudoinverse of the Jacobian in units of the motion; fixed unknowns do not change."""
        units, rows = self._units(equations), self.row_units(equations)
        fixed = self.fixed_changes(equations.into, units)
        free = np.linalg.svd(fixed)[2][np.linalg.matrix_rank(fixed) :].T
        scaled = equations.partials * units / rows[:, np.newaxis] @ free
        inverse: Array = free @ np.linalg.pinv(scaled, ERROR)
        return units[:, np.newaxis] * inverse / rows

    def fixed_changes(self, into: Array, units: Array) -> Array:
        """Return (n, r) changes of fixed entries by the reduced unknowns in units, each relative to the largest one."""
        fixed = self.fixed_rows(len(into)) @ into * units
        return np.asarray(fixed / np.fmax(np.abs(fixed).max(axis=1, initial=0.0), np.finfo(float).tiny)[:, np.newaxis])

    def fixed_rows(self, count: int) -> Array:
        """Return (n, count) rows of fixed entries of z, and of changes across the fixed set of the reversor."""
        rows = np.eye(count)[list(self.fixed_indices)]
        if self.reversor is None:
            return rows
        across = np.linalg.svd(self.reversor.odd)[2][: self.stepper.dimension]
        return np.vstack([rows, np.pad(across, ((0, 0), (0, count - across.shape[1])))])

    def reduced_sizes(self, sizes: Array) -> Array:
        """Return sizes (2m,) of positions and momenta as those of the coordinates of the reduced tangent space."""
        return np.repeat(sizes[[0, -1]], self.reduction.size // 2)

    def _size_of(self, states: Array) -> SizeOfMotion:
        q, p = np.split(states, 2, axis=1)
        return SizeOfMotion.of(q, p, self.at_rest)

    def sizes_of(self, states: Array) -> Array:
        """Return the (2m,) sizes of positions and momenta along states, at least their rounding errors."""
        size = self._size_of(states)
        least = (Products.RESOLVED * rounding or np.finfo(float).tiny for rounding in size.rounding)
        return np.repeat(list(map(max, (size.position, size.momentum), least)), self.stepper.dimension)

    def closing_equations(self, z: Array) -> ClosingEquations:
        """Integrate one period and return the residuals with their derivatives; ``z`` has the start of each segment."""
        size, starts = self.reduction.size, z[:-1].reshape(-1, 2 * self.stepper.dimension)
        count = len(starts)
        bounds = self.bounds(count)
        segments = [
            self._segment(start, self.steps, first, last, z[-1])
            for start, first, last in zip(starts, bounds[:-1], bounds[1:], strict=True)
        ]
        sizes = self.sizes_of(self._whole(np.vstack([starts, *(segment.states for segment in segments)])))
        rows = np.zeros((count, size, count * size + 1))
        defects = np.zeros(rows.shape[:2])
        for k, segment in enumerate(segments):
            after = (k + 1) % count
            leaving, closes = self.leaving(segment, starts[after]), after == 0
            defects[k] = self._defect(segment, starts[after], closes=closes)
            rows[k, :, k * size : (k + 1) * size] = leaving @ segment.monodromy
            if not closes or self.reversor is None:
                rows[k, :, after * size : (after + 1) * size] -= np.eye(size)
            rows[k, :, -1] = leaving @ segment.by_period
        rows[-1, np.flatnonzero(self.drifts)] = 0.0
        error, relative_error = float(np.abs(defects).max()), float(np.abs(defects / self.reduced_sizes(sizes)).max())
        monodromy = leaving @ segments[-1].monodromy
        if self.reversor is None:
            returning = self.independent_equations(starts, segments, sizes, relative_error)
        else:
            monodromy, returning = self.reversor.monodromy(monodromy), self.reversor.odd
        rows[-1], defects[-1] = returning @ rows[-1], returning @ defects[-1]
        partials, residuals = rows.reshape(defects.size, -1), defects.ravel()
        if self.energy is not None:
            first = starts[0]
            energy = self._integrals(first[np.newaxis], np.array([self.t]))[0, 0]
            residuals = np.append(residuals, energy - self.energy)
            row = np.zeros(count * size + 1)
            row[:size] = self.integral_gradients(first, self.t, sizes)[0] @ segments[0].inward
            partials = np.vstack([partials, row])
        return ClosingEquations(segments, monodromy, error, relative_error, sizes, residuals, partials, returning)

    def _whole(self, states: Array) -> Array:
        """Return states along a period by those that were computed."""
        return states if self.reversor is None else np.concatenate([states, self.reversor(states)])

    def _defect(self, segment: _Segment, start: Array, *, closes: bool) -> Array:
        """Return the end of a segment minus the start that follows, of the last one after the period."""
        end = segment.states[-1]
        returned = self._returned(end, start) if closes else end
        if closes and self.reversor is not None:
            return np.asarray((end - self.reversor(returned)) / 2.0)
        outward = self.reduction.at(segment.end_time, self.parameters).outward(*np.split(start, 2))
        return np.asarray(outward @ (self.reduction.aligned(returned, start) - start))

    def _returned(self, end: Array, start: Array) -> Array:
        """Return the state after a period without the increase of its positions."""
        q, p = np.split(end, 2)
        return np.concatenate([np.where(self.drifts, start[: len(q)], q - self.gain), p])

    def leaving(self, segment: _Segment, start: Array) -> Array:
        """Return the matrix from changes of (q, p) at the end of a segment to the reduced space of a state near it."""
        return self.reduction.at(segment.end_time, self.parameters).outward_beside(segment.states[-1], start)

    def _segment(self, start: Array, steps: StepSequence, first: int, last: int, period: float) -> _Segment:
        """Integrate from the start of step ``first`` of a sequence to the start of step ``last``."""
        size, ends, widths = self.reduction.size, steps.ends[first : last + 1], steps.widths[first:last]
        space = self.reduction.at(self.t + period * float(ends[0]), self.parameters)
        inward, shift = space.inward(*np.split(start, 2)), np.zeros(len(start))
        tangents = np.zeros((size + 2 + (self.varied is not None), self.stepper.products.tangents))
        tangents[:size, : len(start)] = inward.T
        if self.varied is not None:
            tangents[-1, len(start) + self.varied] = 1.0
            shift = tangents[-1, : len(start)] = space.shift(start, self.varied, period)
        tangents[size, -2] = ends[0]
        tangents[size + 1, -2] = 1.0
        variations = np.zeros((last - first, len(tangents)))
        variations[:, size] = widths
        at = self.t + period * ends[:-1], period * widths, tangents, self.parameters, self.options, variations
        states, vectors, _ = tangents_along(self.stepper, start, *at)
        partials = vectors[-1].T.copy()
        return _Segment(
            states=states[1:],
            start_time=self.t + period * float(ends[0]),
            end_time=self.t + period * float(ends[-1]),
            inward=inward,
            shift=shift,
            monodromy=partials[:, :size],
            by_period=partials[:, size],
            by_time=partials[:, size + 1],
            by_parameter=partials[:, -1],
        )

    def _exact_end(self, z: Array) -> tuple[Array, Array, Array]:
        """Return the states of a run from a start over its period, its exact end, and rounding errors of the end.

        Raises:
            ScviCodegenError: if the run fails, or its error is unknown.
        """
        period, steps = float(z[-1]), self.steps
        span = period * float(steps.ends[-1])
        plan: dict[str, Any] = {"h": span / len(steps), "steps": len(steps)}
        if steps.tolerance is not None:
            plan = {"t_end": self.t + span, "tolerance": steps.tolerance or None, "check_growth": False}
        plan |= {"t": self.t, "parameters": self.parameters, "options": self.options}
        with without_accuracy_warnings():
            run = self.stepper.integrate(*np.split(z[:-1], 2), **plan)
            error = run.error
        end, own = (np.concatenate([part.q[-1], part.p[-1]]) for part in (run, error))
        if not (np.isfinite(own).all() and error.lost is None):
            raise StateError(error.reason or "the run of a period has no meaningful digits at its end: take more steps")
        widths = np.concatenate([bounds[-1] for bounds in error.bounds]) - np.abs(own)
        return np.hstack([run.q, run.p]), end - own, widths

    def _errors(self, z: Array, equations: ClosingEquations) -> tuple[float, ErrorsOfOrbit]:
        """Return the error of a closed orbit and its entries, by the error of a run from its start.

        They are two steps of Newton's method for the exact motion, the first of which must leave a small part of its
        closing error.
        """
        m, size, last = self.stepper.dimension, self.reduced_sizes(equations.sizes), equations.segments[-1]

        def closing(x: Array, at: Array) -> Array:
            time = self.t + float(at[-1]) * float(self.steps.ends[-1])
            return self._defect(replace(last, states=x[np.newaxis], end_time=time), at[:-1], closes=True)

        try:
            states, exact, widths = self._exact_end(z)
            defects = np.array([closing(x, z) for x in (exact, *(exact + np.diag(widths))[widths > 0.0])])
            inverse = self._inverse(equations)[:, : len(equations.returning)] @ equations.returning
            changes = (equations.into @ inverse @ defects.T).T
            errors, length = changes[0], float(np.linalg.norm(defects[0] / size))
            rounding = float(np.linalg.norm((defects[1:] - defects[0]) / size))
            growth = float(np.linalg.norm(equations.monodromy / size[:, np.newaxis] * size, 2))
            second = np.zeros(len(z))
            if length * growth > math.sqrt(ROUNDOFF):  # terms of the order of its square
                moved = self.moved(z, -errors)
                remainder = closing(self._exact_end(moved)[1], moved)
                left = float(np.linalg.norm(remainder / size))
                if not left <= CONTRACTION * length + rounding:
                    raise StateError(
                        f"the closing error is not linear in the errors of the orbit: without them {left:.1e} of "
                        f"{length:.1e} is left. Take more steps, or adaptive steps (omit steps and h)"
                    )
                second = equations.into @ inverse @ remainder
        except (EventError, MethodError, StateError, StepFailedError) as failure:
            return math.inf, ErrorsOfOrbit.unknown(m, str(failure))
        bounds = np.abs(errors) + np.abs(second) + np.linalg.norm(changes - errors, axis=0)
        errors = errors + second
        bounds += np.where(bounds > 0.0, ROUNDOFF * np.abs(z), 0.0)  # fixed entries are exact
        q, p = (float(part.max()) for part in np.split(bounds[:-1], 2))
        relative = max(float(bounds[-1]) / float(z[-1]), self._size_of(self._whole(states)).error(q, p))
        return relative, ErrorsOfOrbit(signed=errors, bounds=bounds)

    def independent_equations(self, starts: Array, segments: Sequence[_Segment], sizes: Array, error: float) -> Array:
        """Return the (size, size) projection onto the equations of return not implied by conserved quantities.

        Energy and momentum maps count as conserved if the Jacobian of every segment maps their gradients accordingly,
        and if events that change the state leave their values at the ends of steps unchanged. A return that misses by
        the relative error e changes J by O(e^2): along a direction of the strength s among unit gradients it is implied
        up to O(e^2/s), where s is small next to motions along a symmetry (grad H = w grad L of a conical pendulum).
        """
        conserved_masks, units = [], self.reduced_sizes(sizes)
        accepted = (
            CONSERVED if self.stepper.interface.conserves_energy else SAME_MOTION
        )  # weak damping is no conservation
        times = [segment.start_time for segment in segments]
        gradients = [self.integral_gradients(*at, sizes) for at in zip(starts, times, strict=True)]
        begins = [gradient @ part.inward * units for gradient, part in zip(gradients, segments, strict=True)]
        for start, segment, begin in zip(starts, segments, begins, strict=True):
            last = segment.states[-1]
            space = self.reduction.at(segment.end_time, self.parameters)
            end = self.integral_gradients(last, segment.end_time, sizes) @ space.inward(*np.split(last, 2)) * units
            monodromy = self.leaving(segment, last) @ segment.monodromy / units[:, np.newaxis] * units
            largest = np.linalg.norm(end, axis=1) * np.linalg.norm(monodromy, 2)
            conserved_masks.append(np.linalg.norm(end @ monodromy - begin, axis=1) <= accepted * largest)
            if self.stepper.divides_steps:
                states = np.vstack([start, segment.states])
                values = self._integrals(states, np.linspace(segment.start_time, segment.end_time, len(states)))
                conserved_masks.append(np.ptp(values, axis=0) <= CONSERVED * np.linalg.norm(begin, axis=1))
        conserved = begins[0][np.all(conserved_masks, axis=0)]
        conserved /= np.maximum(np.linalg.norm(conserved, axis=1), np.finfo(float).tiny)[:, np.newaxis]
        directions, strengths, _ = np.linalg.svd(conserved.T, full_matrices=False)
        directions = directions[:, strengths > max(CONSERVED, IMPLIED * error) * strengths.max(initial=0.0)]
        projection = np.eye(self.reduction.size) - directions @ directions.T
        return np.asarray(units[:, np.newaxis] * projection / units)

    def integral_gradients(self, state: Array, t: float, sizes: Array) -> Array:
        """Return (r, 2m) gradients of the energy and the momentum maps by finite differences, for directions only.

        Differences of small motions, of which a few digits remain beside the energy itself, are of the size of the
        motion.
        """
        size = len(state)
        for widths in (INCREMENT * sizes, sizes):
            states = np.vstack([state + np.diag(widths), state - np.diag(widths)])
            values = self._integrals(states, np.full(2 * size, t))
            differences = values[:size] - values[size:]
            rounding = ROUNDOFF * np.abs(values).max(axis=0)
            if (CONSERVED * np.abs(differences).max(axis=0) >= rounding).all():
                break
        return np.asarray(differences.T / (2.0 * widths))

    def _integrals(self, states: Array, t: Array) -> Array:
        """Return (n, r) values of the energy and the momentum maps of states."""
        q, p = map(np.ascontiguousarray, np.split(states, 2, axis=1))
        maps = self.stepper.momentum_maps(q, p, t, self.parameters).reshape(len(t), -1)
        return np.column_stack([self.stepper.energy(q, p, t, self.parameters), maps])


def _listed(values: Array) -> str:
    return f"[{', '.join(f'{x:.6g}' for x in values[:6])}{', ..' if len(values) > 6 else ''}]"


def _warn_of_discretisation(orbit: PeriodicOrbit, bound: float) -> None:
    """Warn if the error of an orbit exceeds a bound."""
    if not Products.warnings_wanted() or orbit.error <= bound:
        return
    remedy = "Omit steps and h, for adaptive steps, or take more steps"
    if orbit.sequence.tolerance is not None:
        remedy = "Use a method of higher degree, or fixed_period= or fixed= if the orbit is one of a family"
    reason = f" ({orbit.errors.reason})" if orbit.errors.reason else ""
    warn(
        f"the periodic orbit is one of its {orbit.steps} steps rather than of the system, from whose orbit it has the "
        f"relative distance {orbit.error:.1e}{reason} (the bound is {bound:.1e}). {remedy}",
        AccuracyWarning,
    )


def _warn_of_distance(orbit: PeriodicOrbit, guess: Array) -> None:
    """Warn if an orbit is another member of its family than that of the guess, or far from it."""
    with without_accuracy_warnings():  # that of the orbit itself is a warning of its own
        states = orbit.run()
    amplitude = float(np.ptp(np.concatenate([states.q, states.p], axis=1), axis=0).max()) / 2.0
    away = float(np.abs(np.concatenate([orbit.q, orbit.p]) - guess[:-1]).max())
    if away > OTHER * amplitude or not _is_near(orbit, guess, np.concatenate([states.q, states.p], axis=1)):
        period = "" if orbit.period == guess[-1] else f"its period is {orbit.period:.6g}, not {guess[-1]:.6g}, and "
        warn(
            f"the periodic orbit that was found is far from the guess: {period}its state differs by {away:.2g}, where "
            f"the amplitude of the orbit is {amplitude:.2g}. Compare both, or fix an amplitude",
            AccuracyWarning,
        )


def _is_near(orbit: PeriodicOrbit, guess: Array, states: Array) -> bool:
    """Return whether an orbit with (n, 2m) states is near the guess, by the distance of the guess from its middle."""
    away = np.concatenate([orbit.q, orbit.p]) - guess[:-1]
    middle = (states.max(axis=0) + states.min(axis=0)) / 2.0
    near = np.abs(away).max() <= FAR * np.abs(guess[:-1] - middle).max()
    return bool(1 / FAR < orbit.period / guess[-1] < FAR and near)


@dataclass(frozen=True, eq=False)
class _Segment:
    """Trajectory along some of the steps of a period.

    Attributes:
        states: (n, 2m) states after each step.
        start_time, end_time: times of its ends.
        inward: (2m, r) changes of the start by those in the reduced tangent space.
        shift: (2m,) change of the start by the parameter that varies, of constraints that contain it.
        monodromy, by_period, by_time, by_parameter: derivatives of the end; by time 0 for autonomous systems, and by
            the parameter that varies, if one does.
    """

    states: Array
    start_time: float
    end_time: float
    inward: Array
    shift: Array
    monodromy: Array
    by_period: Array
    by_time: Array
    by_parameter: Array


@dataclass(frozen=True, eq=False)
class ClosingEquations:
    """Residuals of the conditions of continuity and closing.

    Attributes:
        segments: in their order.
        monodromy: derivative of the end of the last segment by its start, without gauge directions.
        error, relative_error: largest entry of the ends minus the starts that follow, itself and relative to sizes.
        sizes: (2m,) sizes of the motion.
        defects: (n,) residuals.
        partials: (n, r segments + 1) Jacobian of the residuals with respect to changes of the starts of segments in the
            reduced tangent space, and the period.
        returning: (size, size) projection of the closing equations onto those that conserved quantities do not imply;
            of symmetric orbits onto changes that the reversor reverses.
    """

    segments: Sequence[_Segment]
    monodromy: Array
    error: float
    relative_error: float
    sizes: Array
    defects: Array
    partials: Array
    returning: Array

    @property
    def motion(self) -> _Segment:
        """The trajectory of a period in one segment."""
        (motion,) = self.segments
        return motion

    @property
    def into(self) -> Array:
        """(2m segments + 1, r segments + 1) changes of the unknowns by those in the reduced tangent space."""
        return block_diagonal([*(segment.inward for segment in self.segments), np.eye(1)])


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """Return the matrix of blocks along the diagonal."""
    rows, columns = np.cumsum([[0, 0], *(block.shape for block in blocks)], axis=0).T
    matrix = np.zeros((rows[-1], columns[-1]))
    for block, row, column in zip(blocks, rows, columns, strict=False):
        matrix[row : row + len(block), column : column + block.shape[1]] = block
    return matrix
