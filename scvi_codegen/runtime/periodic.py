"""Periodic orbits: Newton's iteration on the end of a motion after a period, with the exact monodromy matrix.

Such orbits are seldom alone: they may be begun anywhere on them, and belong to families, by energy or by another
conserved quantity. Each step of the iteration is the shortest that meets the linearised equations, in the directions
that these decide (Moore & Penrose), so that the orbit found is one near the guess, and no condition has to be thought
of for what does not matter. What a motion keeps returns by itself: that much of the equations is left out
(Munoz-Almaraz et al., Physica D 181 (2003) 1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import MethodError, OrbitError, StateError, StepFailedError, closest
from scvi_codegen.kinds import NAMES, SWITCH, of, takes
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.inputs import Array, Parameters, check_inputs_given, checked_parameters, checked_vector
from scvi_codegen.runtime.linearised import Starts
from scvi_codegen.runtime.measurements import state_names
from scvi_codegen.runtime.stepper import Stepper
from scvi_codegen.runtime.times import times_after
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["PeriodicOrbit", "periodic_orbit"]

MOST_ITERATIONS, MOST_HALVINGS = 50, 12
UNDECIDED = 1e-9
"""Beside the largest singular value: directions in which the end moves along with the start."""
CLOSED = 1e-11
"""Beside the size of the state, and what the monodromy makes of its rounding: where an orbit ends where it began."""
KEPT = 1e-3
"""Beside their sizes: how far slopes of an integral may change along a motion that keeps it, by the errors of steps."""
BESIDE = 1e-6
"""Beside the size of a state: where its neighbours are."""
SAME = 1e-6
"""Beside 1: what may be rounding of a stability index."""
SETTLED = 1e-13
"""Beside the size of state and period: a step that is rounding."""
WORSE = 10.0
"""Than before: what a defect may become on the way."""
RESTING = 1e-6
"""Beside the size of the state: how far a motion goes in a period that goes nowhere."""
WHOLE = 1e-9
"""Of a step: what rounding may leave of a period."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PeriodicOrbit:
    """A motion that ends where it began, of the computed map.

    Attributes:
        q, p: (m,) where it begins.
        t: when.
        period: after which it is there again.
        steps: of a period, each of ``period / steps``.
        monodromy: (2m, 2m) derivative of the end by the start.
        residual: how far the end is from the start, the largest number.
        iterations: of Newton.
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
    iterations: int
    parameters: Array
    stepper: Stepper = field(repr=False)
    options: SolverOptions | None = field(default=None, repr=False)

    def run(self, *, every: int = 1) -> Trajectory:
        """The motion of a period, ``every``-th state."""
        return self.stepper.integrate(
            self.q,
            self.p,
            h=self.period / self.steps,
            steps=self.steps,
            every=every,
            t=self.t,
            parameters=self.parameters,
            options=self.options,
        )

    @property
    def energy(self) -> float:
        """Where it begins."""
        return float(self.stepper.energy(self.q, self.p, self.t, self.parameters))

    @cached_property
    def multipliers(self) -> NDArray[np.complex128]:
        """(2m,) Floquet multipliers, the eigenvalues of the monodromy matrix, the largest first.

        Of those near 1, which are several for a motion that keeps its energy, only half of the digits are known.
        """
        values = np.linalg.eigvals(self.monodromy).astype(complex)
        return values[np.argsort(-np.abs(values))]

    @property
    def reciprocal_error(self) -> float:
        """How far sizes of multipliers are from the pairs s, 1/s of symplectic steps: the largest of s s' - 1."""
        sizes = np.abs(self.multipliers)
        return float(np.abs(sizes * sizes[::-1] - 1.0).max())

    @property
    def symplectic_error(self) -> float:
        """How far the monodromy matrix is from symplectic, beside its square."""
        product = _inverse(self.monodromy) @ self.monodromy - np.eye(len(self.monodromy))
        return float(np.abs(product).max() / max(1.0, np.linalg.norm(self.monodromy, 2) ** 2))

    @cached_property
    def stability_indices(self) -> NDArray[np.complex128]:
        """(m,) of each pair of multipliers s, 1/s its (s + 1/s)/2, the largest first: stable between -1 and 1.

        They are known to the digits of the monodromy matrix, also at 1 (Broucke, AIAA J. 7 (1969) 1003; Howell, Celest.
        Mech. 32 (1984) 53).

        Raises:
            MethodError: where steps are not symplectic.
        """
        if self.symplectic_error > UNDECIDED:
            raise MethodError(f"multipliers are no pairs: the steps of '{self.stepper.title}' are not symplectic here")
        left = list(np.linalg.eigvals(self.monodromy + _inverse(self.monodromy)).astype(complex) / 2.0)
        indices = []
        while left:
            one = left.pop(int(np.argmax(np.abs(left))))
            indices.append((one + left.pop(int(np.argmin(np.abs(np.array(left) - one))))) / 2.0)
        return np.array(indices)

    @property
    def stable(self) -> bool:
        """Whether no multiplier is larger than 1, to rounding."""
        if self.symplectic_error > UNDECIDED:
            return bool(np.abs(self.multipliers).max() <= 1.0 + SAME)
        indices = self.stability_indices
        return bool((np.abs(indices.real) <= 1.0 + SAME).all() and (np.abs(indices.imag) <= SAME).all())


def _inverse(matrix: Array) -> Array:
    """Of a symplectic matrix."""
    m = len(matrix) // 2
    a, b, c, d = matrix[:m, :m], matrix[:m, m:], matrix[m:, :m], matrix[m:, m:]
    return np.block([[d.T, -b.T], [-c.T, a.T]])


@takes(StateError, stepper=of("a compiled stepper", Stepper), hold=NAMES, fixed_period=SWITCH)
def periodic_orbit(
    stepper: Stepper,
    q: ArrayLike,
    p: ArrayLike | None = None,
    *,
    velocity: ArrayLike | None = None,
    period: float,
    steps: int | None = None,
    h: float | None = None,
    fixed_period: bool = False,
    energy: float | None = None,
    hold: Sequence[str] = (),
    gain: ArrayLike | None = None,
    t: float = 0.0,
    parameters: Parameters = None,
    options: SolverOptions | None = None,
) -> PeriodicOrbit:
    """Find the periodic orbit next to a guess, by Newton's iteration with the exact derivatives of the steps.

    Args:
        stepper: system and method.
        q, p, velocity: (m,) a guess of a state on it, one of p and velocity.
        period: a guess of its period, positive.
        steps: of a period, as many whatever its length becomes.
        h: instead, the longest step for the period guessed.
        fixed_period: whether the period is as given: so it must be where the system depends on time.
        energy: that of the orbit, if it is given.
        hold: coordinates and momenta (``"p_x"``) of the state that stay as given: an amplitude, or a section such as
            ``["y"]``.
        gain: (m,) what positions have gained after a period: 2 pi for an angle that turns, by default 0.
        t, parameters, options: as of :meth:`Stepper.integrate`.

    Returns:
        A :class:`PeriodicOrbit`.

    Raises:
        OrbitError: where the iteration does not close an orbit, or ends in a state at rest.
        MethodError: in transformed time, with constraints, and for an energy where forces act.
        StateError: on wrong shapes, names or numbers.
    """
    search = _OrbitSearch.checked(
        stepper,
        period=period,
        steps=steps,
        h=h,
        fixed_period=fixed_period,
        energy=energy,
        hold=hold,
        gain=gain,
        t=t,
        parameters=parameters,
        options=options,
    )
    momenta = stepper.momenta_given(q, p, velocity, search.t, search.parameters)
    start = np.concatenate([checked_vector(stepper.interface, each, name) for each, name in ((q, "q"), (momenta, "p"))])
    return search.orbit(np.append(start, search.period))


@dataclass(frozen=True, eq=False)
class _OrbitSearch:
    """What an orbit has to meet, as a function of z = (q, p, period).

    Attributes:
        free: (j,) places in z of what may change.
    """

    stepper: Stepper
    period: float
    steps: int
    free: NDArray[np.intp]
    energy: float | None
    gain: Array
    t: float
    parameters: Array
    options: SolverOptions | None

    @classmethod
    def checked(
        cls,
        stepper: Stepper,
        *,
        period: float,
        steps: int | None,
        h: float | None,
        fixed_period: bool,
        energy: float | None,
        hold: Sequence[str],
        gain: ArrayLike | None,
        t: float,
        parameters: Parameters,
        options: SolverOptions | None,
    ) -> _OrbitSearch:
        """From what users give."""
        interface, names = stepper.interface, (*state_names(stepper), "period")
        if interface.constraints:
            raise MethodError("periodic orbits are found without constraints: take coordinates that need none")
        check_inputs_given(interface, parameters)
        if energy is not None and interface.exchange_names:
            raise MethodError(f"forces act on '{interface.system}', so an orbit has no energy to be given")
        if (period := checked_number(period, "the period")) <= 0.0:
            raise StateError(f"a period is positive, not {period:g}")
        if (steps is None) == (h is None):
            raise StateError("the number of steps of a period, or h, the longest of them: give one of them")
        for name in hold:
            if name not in names[:-1]:
                raise StateError(f"the state has no '{name}' to hold{closest(name, names[:-1])}")
        held = {*hold, *(["period"] if fixed_period else [])}
        return cls(
            stepper=stepper,
            period=period,
            steps=math.ceil(period / abs(checked_step(h)) - WHOLE) if h else checked_count(steps, "steps", least=1),
            free=np.array([k for k, name in enumerate(names) if name not in held], dtype=np.intp),
            energy=None if energy is None else checked_number(energy, "the energy"),
            gain=np.zeros(stepper.dimension) if gain is None else checked_vector(interface, gain, "gain"),
            t=checked_number(t, "the time t"),
            parameters=checked_parameters(interface, parameters),
            options=options,
        )

    def orbit(self, guess: Array) -> PeriodicOrbit:
        """The orbit next to a guess."""
        z, found = guess, self._closing(guess)
        for iteration in range(MOST_ITERATIONS):  # noqa: B007  (how many there were is told)
            nearer = self._nearer(z, found)
            if nearer is None:
                break
            z, found = nearer
        m, motion = self.stepper.dimension, found.monodromy
        size = float(np.abs([z[:-1], guess[:-1]]).max())
        if not found.error <= CLOSED * size * max(1.0, float(np.linalg.norm(motion, 2))):
            raise OrbitError(
                f"no orbit closes near here: after {iteration} iterations it ends {found.error:.1e} from where it "
                "began. Give a nearer guess, or more steps"
            )
        if np.linalg.norm(found.by_period) * z[-1] <= RESTING * size:
            raise OrbitError("the iteration ended in a state at rest, which every period closes: give a nearer guess")
        return PeriodicOrbit(
            q=z[:m],
            p=z[m:-1],
            t=self.t,
            period=float(z[-1]),
            steps=self.steps,
            monodromy=motion,
            residual=found.error,
            iterations=iteration,
            parameters=self.parameters,
            stepper=self.stepper,
            options=self.options,
        )

    def _nearer(self, z: Array, found: _Closing) -> tuple[Array, _Closing] | None:
        """A step of Newton's iteration, shortened until it helps; ``None`` where none does, or is left.

        It helps if what the same slopes would change next is less (Deuflhard's natural monotonicity): defects would be
        those of the one direction in which motions part.
        """
        inverse = np.zeros((len(z), len(found.defects)))
        inverse[self.free] = np.linalg.pinv(found.slopes[:, self.free], UNDECIDED)
        change = inverse @ found.defects
        if np.linalg.norm(change) <= SETTLED * np.linalg.norm(z):
            return None
        for shortened in 0.5 ** np.arange(MOST_HALVINGS):
            trial = z - shortened * change
            if trial[-1] <= 0.0:
                continue
            with suppress(StepFailedError):
                at = self._closing(trial)
                less = np.linalg.norm(inverse @ at.defects) < (1.0 - shortened / 4.0) * np.linalg.norm(change)
                if less and np.linalg.norm(at.defects) < WORSE * np.linalg.norm(found.defects):
                    return trial, at
        return None

    def _closing(self, z: Array) -> _Closing:
        """One motion of a period, with its derivatives."""
        stepper, m, size = self.stepper, self.stepper.dimension, len(z) - 1
        h = z[-1] / self.steps
        starts = Starts.chain(z[:m], z[m:-1], times_after(self.t, h, np.arange(self.steps))[0], np.full(self.steps, h))
        vectors = np.zeros((self.steps + 1, size + 1, stepper.given))
        vectors[0, :size, :size] = np.eye(size)
        vectors[0, size, -1] = 1.0 / self.steps
        q, p = stepper.linearise(starts, vectors, self.parameters, self.options, chained=True)
        slopes = vectors[-1, :, :size].T
        monodromy, by_period = slopes[:, :size], slopes[:, size]
        end = np.concatenate([q[-1], p[-1]])
        defects = end - z[:-1] - np.append(self.gain, np.zeros(m))
        slopes = np.column_stack([monodromy - np.eye(size), by_period])
        free = self._not_implied(z, end, monodromy)
        rows, wanted = free @ slopes, free @ defects
        if self.energy is not None:
            wanted = np.append(wanted, stepper.energy(z[:m], z[m:-1], self.t, self.parameters) - self.energy)
            rows = np.vstack([rows, np.append(self._slopes_of_integrals(z[:-1], self.t)[0], 0.0)])
        return _Closing(float(np.abs(defects).max()), wanted, rows, monodromy.copy(), by_period.copy())

    def _not_implied(self, z: Array, end: Array, monodromy: Array) -> Array:
        """(2m, 2m) projection on the equations that are left: what a motion keeps returns by itself.

        Energy and momentum maps are kept if their slopes are carried from the start to those at the end.
        """
        start, ends = (self._slopes_of_integrals(state, t) for state, t in ((z[:-1], self.t), (end, self.t + z[-1])))
        carried = ends @ monodromy
        sizes = np.linalg.norm(ends, axis=1) * np.linalg.norm(monodromy, 2)
        kept = start[np.linalg.norm(carried - start, axis=1) <= KEPT * sizes]
        directions, strengths, _ = np.linalg.svd(kept.T, full_matrices=False)
        directions = directions[:, strengths > KEPT * strengths.max(initial=0.0)]
        projection: Array = np.eye(len(end)) - directions @ directions.T
        return projection

    def _slopes_of_integrals(self, state: Array, t: float) -> Array:
        """(r, 2m) of the energy, first, and of the momentum maps, by differences: they show directions only."""
        size, width = len(state), BESIDE * max(1.0, float(np.abs(state).max()))
        states = np.vstack([state + width * np.eye(size), state - width * np.eye(size)])
        q, p = np.ascontiguousarray(states[:, : size // 2]), np.ascontiguousarray(states[:, size // 2 :])
        times = np.full(2 * size, t)
        values = np.column_stack(
            [
                self.stepper.energy(q, p, times, self.parameters),
                self.stepper.momentum_maps(q, p, times, self.parameters).reshape(2 * size, -1),
            ]
        )
        slopes: Array = (values[:size] - values[size:]).T / (2.0 * width)
        return slopes


@dataclass(frozen=True, eq=False)
class _Closing:
    """How far a motion is from closing.

    Attributes:
        error: the largest number of the end less the start.
        defects: (r,) of what has to be 0.
        slopes: (r, 2m + 1) of them by (q, p, period).
        monodromy, by_period: derivatives of the end.
    """

    error: float
    defects: Array
    slopes: Array
    monodromy: Array
    by_period: Array
