"""Periodic orbits: Newton's iteration on the state after one period, with the exact monodromy matrix.

Periodic orbits are not isolated: the initial point is arbitrary, and orbits form one-parameter families (by energy or
another conserved quantity). Each Newton step is the minimum-norm solution of the linearised equations (Moore-Penrose
inverse), so the iteration converges to a nearby orbit without phase conditions. Equations implied by conserved
quantities are projected out (Munoz-Almaraz et al., Physica D 181 (2003) 1).
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
"""Singular values below this fraction of the largest count as zero in the pseudoinverse."""
CLOSED = 1e-11
"""Largest closing error, relative to the size of the state and the norm of the monodromy matrix."""
KEPT = 1e-3
"""Relative error of the transported gradient of an integral up to which the integral counts as conserved."""
BESIDE = 1e-6
"""Increment of the finite differences of integrals, relative to the size of the state."""
SETTLED = 1e-13
"""Newton step, relative to state and period, below which the iteration ends."""
WORSE = 10.0
"""Largest factor by which a Newton step may increase the residual."""
RESTING = 1e-6
"""Motion over a period, relative to the size of the state, below which an orbit counts as an equilibrium."""


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
    """Find a periodic orbit near an initial guess, by Newton's iteration with exact derivatives of the steps.

    Args:
        stepper: the compiled stepper.
        q, p, velocity: (m,) initial guess of a state on the orbit, with one of p and velocity.
        period: initial guess of the period, positive.
        steps: number of steps per period.
        h: instead of ``steps``, the largest step size for the initial period; its sign is ignored.
        fixed_period: keep the period fixed; required if the system depends on time.
        energy: prescribed energy of the orbit.
        hold: coordinates and momenta (``"p_x"``) that keep their initial values: an amplitude, or a section such as
            ``["y"]``.
        gain: (m,) increase of the positions over a period: 2 pi for a rotating angle, by default 0.
        t, parameters, options: as of :meth:`Stepper.integrate`.

    Returns:
        A :class:`PeriodicOrbit`.

    Raises:
        OrbitError: if the iteration does not converge, converges to an equilibrium or to another energy, or if the
            system is not periodic in time with this period.
        MethodError: if time is transformed, the stepper has a monitor or constraints, an energy is prescribed with
            forces, or the period of a time-dependent system is free.
        StateError: if a shape, name or number is invalid, or an input is not set.
        StepFailedError: if a step from the initial guess fails.
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
    """Equations of a periodic orbit as a function of z = (q, p, period).

    Attributes:
        free: (j,) indices of the free entries of z.
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
        """Construct from validated arguments of :func:`periodic_orbit`."""
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
        """Return the orbit near a guess."""
        z, found = guess, self._closing(guess)
        for iteration in range(MOST_ITERATIONS):  # noqa: B007  (the count is reported)
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
        """Raise :class:`OrbitError` if a closed orbit has another energy; ``allowed`` is the error of its state."""
        away, slopes = float(found.defects[-1]), found.slopes[-1]
        if self.energy is not None and not abs(away) <= allowed * max(1.0, float(np.linalg.norm(slopes))):
            raise OrbitError(
                f"the orbit that closes near here has the energy {self.energy + away:.10g}, not {self.energy:.10g}: "
                "hold less of the state, or give a nearer guess"
            )

    def _check_repeats(self, z: Array, found: _Closing, allowed: float) -> None:
        """Raise an error unless the system is periodic in time: the orbit must also close in the next period."""
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
        """Return the damped Newton iterate, or ``None`` if no step length succeeds or the step is negligible.

        A step length is accepted if the simplified Newton correction with the same Jacobian decreases (Deuflhard's
        natural monotonicity test), which is independent of the unstable direction that dominates the residuals.
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
        """Integrate one period and return the residuals with their derivatives."""
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
        """Return the (2m, 2m) projection onto the equations not implied by conserved quantities.

        Energy and momentum maps count as conserved if the monodromy matrix maps their gradients accordingly.
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
        """Return (r, 2m) gradients of the energy and the momentum maps by finite differences, for directions only."""
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
    """Residuals of the closing conditions.

    Attributes:
        end: (2m,) state after one period.
        error: largest entry of the end minus the start.
        defects: (r,) residuals.
        slopes: (r, 2m + 1) Jacobian of the residuals with respect to (q, p, period).
        monodromy, by_period, by_time: derivatives of the end; the last is 0 for autonomous systems.
    """

    end: Array
    error: float
    defects: Array
    slopes: Array
    monodromy: Array
    by_period: Array
    by_time: Array
