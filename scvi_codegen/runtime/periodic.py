"""Periodic orbits: Newton's iteration on the end of a motion after a period, with the exact monodromy matrix.

Such orbits are seldom alone: they may be begun anywhere on them, and belong to families, by energy or by another
conserved quantity. Each step of the iteration is the shortest that meets the linearised equations, in the directions
that these decide (Moore & Penrose), so that the orbit found is one near the guess, and no condition has to be thought
of for what does not matter. What a motion keeps returns by itself: that much of the equations is left out
(Munoz-Almaraz et al., Physica D 181 (2003) 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import MethodError, OrbitError, StateError, StepFailedError, closest
from scvi_codegen.given.counts import checked_count
from scvi_codegen.given.kinds import NAMES, SWITCH, of, takes
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.inputs import Array, Parameters, check_inputs_given, checked_parameters, checked_vector
from scvi_codegen.runtime.linearised import Starts
from scvi_codegen.runtime.measurements import state_names
from scvi_codegen.runtime.periodic_orbit import PeriodicOrbit
from scvi_codegen.runtime.stepper import Stepper
from scvi_codegen.runtime.times import steps_within, times_after

__all__ = ["periodic_orbit"]

MOST_ITERATIONS, MOST_HALVINGS = 50, 12
UNDECIDED = 1e-9
"""Beside the largest singular value: directions in which the end moves along with the start."""
CLOSED = 1e-11
"""Beside the size of the state, and what the monodromy makes of its rounding: where an orbit ends where it began."""
KEPT = 1e-3
"""Beside their sizes: how far slopes of an integral may change along a motion that keeps it, by the errors of steps."""
BESIDE = 1e-6
"""Beside the size of a state: where its neighbours are."""
SETTLED = 1e-13
"""Beside the size of state and period: a step that is rounding."""
WORSE = 10.0
"""Than before: what a defect may become on the way."""
RESTING = 1e-6
"""Beside the size of the state: how far a motion goes in a period that goes nowhere."""


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
        h: instead, the longest step for the period guessed; its sign does not matter.
        fixed_period: whether the period is as given: so it must be where the system depends on time.
        energy: that of the orbit, if it is given.
        hold: coordinates and momenta (``"p_x"``) of the state that stay as given: an amplitude, or a section such as
            ``["y"]``.
        gain: (m,) what positions have gained after a period: 2 pi for an angle that turns, by default 0.
        t, parameters, options: as of :meth:`Stepper.integrate`.

    Returns:
        A :class:`PeriodicOrbit`.

    Raises:
        OrbitError: where the iteration does not close an orbit of that energy, or ends in a state at rest, and where
            what depends on time is another after a period.
        MethodError: in transformed time, where a monitor chooses the steps, with constraints, for an energy where
            forces act, and for a period that is to be found of what depends on time.
        StateError: on wrong shapes, names or numbers, and for inputs that are not given.
        StepFailedError: if a step fails on the way round from the guess.
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
        stepper.check_steps_of_h("a periodic orbit")
        check_inputs_given(interface, parameters)
        if interface.constraints:
            raise MethodError("periodic orbits are found without constraints: take coordinates that need none")
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
            steps=checked_count(steps, "steps", least=1) if h is None else int(steps_within(period, checked_step(h))),
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
        allowed = CLOSED * max(1.0, float(np.linalg.norm(motion, 2)))
        if not found.error <= allowed * size:
            raise OrbitError(
                f"no orbit closes near here: after {iteration} iterations it ends {found.error:.1e} from where it "
                "began. Give a nearer guess, or more steps"
            )
        self._check_energy(found, allowed * size)
        if np.linalg.norm(found.by_period) * z[-1] <= RESTING * size:
            raise OrbitError("the iteration ended in a state at rest, which every period closes: give a nearer guess")
        if found.by_time.any():
            self._check_repeats(z, found, allowed * size)
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

    def _check_energy(self, found: _Closing, allowed: float) -> None:
        """Raise :class:`OrbitError` for an orbit that closes, but has another energy; ``allowed``: of its state."""
        away, slopes = float(found.defects[-1]), found.slopes[-1]
        if self.energy is not None and not abs(away) <= allowed * max(1.0, float(np.linalg.norm(slopes))):
            raise OrbitError(
                f"the orbit that closes near here has the energy {self.energy + away:.10g}, not {self.energy:.10g}: "
                "hold less of the state, or give a nearer guess"
            )

    def _check_repeats(self, z: Array, found: _Closing, allowed: float) -> None:
        """Raise where what depends on time is another a period later: the next motion from there does not close."""
        period = float(z[-1])
        if len(z) - 1 in self.free:
            raise MethodError(
                f"'{self.stepper.interface.system}' depends on time, and orbits close after a period of what it "
                "depends on: give that as period, with fixed_period=True"
            )
        later = replace(self, t=self.t + period)._closing(z)
        away = max(float(np.abs(later.end - found.end).max()), later.error)
        if not away <= allowed:
            raise OrbitError(
                f"what closes from t = {self.t:g} ends {away:.1e} from there after another period: what "
                f"'{self.stepper.interface.system}' depends on is not the same {period:.10g} later"
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
        vectors = np.zeros((self.steps + 1, size + 2, stepper.given))
        vectors[0, :size, :size] = np.eye(size)
        vectors[0, size:, [-1, -2]] = np.diag([1.0 / self.steps, 1.0])
        q, p = stepper.linearise(starts, vectors, self.parameters, self.options, chained=True)
        slopes = vectors[-1, :, :size].T
        monodromy, by_period, by_time = slopes[:, :size], slopes[:, size], slopes[:, size + 1]
        end = np.concatenate([q[-1], p[-1]])
        defects = end - z[:-1] - np.append(self.gain, np.zeros(m))
        slopes = np.column_stack([monodromy - np.eye(size), by_period])
        free = self._not_implied(z, end, monodromy)
        rows, wanted = free @ slopes, free @ defects
        if self.energy is not None:
            wanted = np.append(wanted, stepper.energy(z[:m], z[m:-1], self.t, self.parameters) - self.energy)
            rows = np.vstack([rows, np.append(self._slopes_of_integrals(z[:-1], self.t)[0], 0.0)])
        error, derivatives = float(np.abs(defects).max()), (monodromy.copy(), by_period.copy(), by_time.copy())
        return _Closing(end, error, wanted, rows, *derivatives)

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
        end: (2m,) where it ends.
        error: the largest number of the end less the start.
        defects: (r,) of what has to be 0.
        slopes: (r, 2m + 1) of them by (q, p, period).
        monodromy, by_period, by_time: derivatives of the end; the last, by all times, is 0 where nothing depends on it.
    """

    end: Array
    error: float
    defects: Array
    slopes: Array
    monodromy: Array
    by_period: Array
    by_time: Array
