"""System under test: the stepper, a stepper with Newton's method alone, generic states, and rounding of a step."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scvi_codegen.api.formulas import Number, mp
from scvi_codegen.api.methods import Method
from scvi_codegen.api.runs import Products
from scvi_codegen.api.states import Array
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import EventError, StateError, StepFailedError
from scvi_codegen.extras.exact.solution import ExactMotion, exact_motion, numbers
from scvi_codegen.extras.exact.step import DerivedStep, SolvedStep, derived_step
from scvi_codegen.runs.stepper import Stepper

Map = Callable[[Array], Array]

WEIGHTS = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
"""Weights of central differences of order six."""
WIDTHS = (0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4)
"""Widths of the differences, relative to the scales; the result is from the two neighbours that agree best."""


@dataclass(frozen=True, slots=True)
class Jacobian:
    """Jacobian of a step in units of the scales.

    Attributes:
        matrix: (2m, 2m), dimensionless.
        uncertainty: error estimate of its entries: the disagreement of two widths.
        scales: (2m,) sizes of q and of p, m times each.
    """

    matrix: Array
    uncertainty: float
    scales: Array

    def propagated(self, change: Array) -> Array:
        """Return (2m,) bounds on the change of the end for changes of the arguments of any sign."""
        return np.asarray(self.scales * (np.abs(self.matrix) @ (np.abs(change) / self.scales)))


def linearised(step: Map, state: Array, scales: Array) -> Jacobian | None:
    """Return the Jacobian of ``step`` at ``state``; ``None`` if steps fail in the neighbourhood."""
    best: Jacobian | None = None
    before: Array | None = None
    for width in WIDTHS:
        try:
            now = _differences(step, state, scales, width)
        except (EventError, StepFailedError):
            continue
        if before is not None:
            change = float(np.abs(now - before).max())
            if best is None or change < best.uncertainty:
                best = Jacobian(now, change, scales)
        before = now
    return best


def _differences(step: Map, state: Array, scales: Array, width: float) -> Array:
    columns = []
    for unit in np.diag(width * scales):
        derivatives = sum(w * (step(state + k * unit) - step(state - k * unit)) for k, w in WEIGHTS.items())
        columns.append(derivatives / (width * scales))
    return np.asarray(np.array(columns).T)


def canonical_form(m: int) -> Array:
    """Return the (2m, 2m) matrix Omega = [[0, 1], [-1, 0]] of the canonical symplectic form."""
    return np.asarray(np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(m)), dtype=float)


EPSILON, ROUNDINGS = float(np.finfo(float).eps), 16.0
"""Rounding error of doubles, and the bound on errors in units of the rounding of a state."""
ROUND_OFF, BOUND, NOISE_OF_DIFFERENCES = 1e-12, 1e-10, 1e-6
"""Sizes relative to their terms below which values are round-off, and bounds on relative errors of derivatives and
products, and of finite differences."""
STEP_DIVISOR, LARGEST_RATIO = 8, 0.25
"""Ratio of two step sizes whose errors are compared, and largest ratio of the errors of a better and a worse one."""
CONSECUTIVE_STEPS, SHORT_RUN, LONG_RUN, TRIALS, SAMPLED = 3, 40, 1000, 12, 12
"""Number of steps in a row that are checked, of steps of short runs and of states sampled in others, of steps of long
runs, of step sizes that a search tries, and of steps and changes of a run that are checked."""
EQUAL = 1e-30
"""Relative difference of equal numbers in 60 digits."""
WIDTH = 1e-5
"""Width of differences of constraints, relative to the state."""
PERTURBATION = 0.05
"""Perturbation of states relative to their size; divided by 4 until a step succeeds."""
MAX_COORDINATES = 18
"""Largest number of coordinates whose exact motion is computed; these take half a minute."""
REFERENCE_STEPS, ANNOUNCED_SECONDS = 12, 10.0
"""Number of 60-digit steps that take as long as a certificate of a large system; duration that is announced."""
MAX_UNKNOWNS = 200
"""Largest number of unknowns of a step solved in 60 digits."""


@dataclass(frozen=True, slots=True)
class State:
    """State (q, p) at time t, and the size h of the step to take from it."""

    q: Array
    p: Array
    t: float
    h: float

    @property
    def z(self) -> Array:
        """Phase-space vector (q, p), (2m,)."""
        return np.concatenate([self.q, self.p])


@dataclass(frozen=True)
class SystemUnderTest:
    """Integrator under test.

    Attributes:
        system: mechanical system.
        method: method of the stepper.
        stepper: stepper as built.
        newton: stepper with Newton's method alone, or ``None``.
        initial: state and step size of the certificate.
    """

    system: MechanicalSystem
    method: Method
    stepper: Stepper
    newton: Stepper | None
    initial: State

    @property
    def steppers(self) -> tuple[Stepper, ...]:
        """Stepper as built, and the one with Newton's method alone if that is another."""
        newton = self.newton
        return (self.stepper,) if newton is None or newton is self.stepper else (self.stepper, newton)

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Values slightly off the defaults, if steps succeed: equal masses would hide interchanged ones."""
        moved = {}
        for k, (name, value) in enumerate(self._defaults.items(), 1):
            moved[name] = value * (1 + PERTURBATION * np.sin(k)) or PERTURBATION * np.cos(k)
        moved |= {name: self._defaults[name] for name in self.stepper.interface.mode_names}
        at_zero = {name: moved[name] if value else 0.0 for name, value in self._defaults.items()}
        for values in (moved, at_zero):
            if self._works(values):
                return {name: float(value) for name, value in values.items()}
        return dict(self._defaults)

    @property
    def constant_inputs(self) -> dict[str, float]:
        """:attr:`parameters` with constant inputs, for long runs on which cubic inputs would grow."""
        rates = [f"{name}_{power}" for name in self.stepper.interface.inputs for power in "123"]
        return self.parameters | dict.fromkeys(rates, 0.0)

    @property
    def damping(self) -> float:
        """Damping rate at :attr:`parameters`; 0 without damping."""
        values = {parameter: self.parameters[parameter.name] for parameter in self.system.parameters}
        return float(self.system.damping.xreplace(values))

    @property
    def _defaults(self) -> dict[str, float]:
        return {name.name: value for name, value in self.system.constants.items()}

    def _works(self, parameters: Mapping[str, float]) -> bool:
        try:
            self.stepper.step(self.initial.q, self.initial.p, self.initial.h, self.initial.t, parameters)
        except StepFailedError:
            return False
        return True

    @cached_property
    def moved(self) -> MechanicalSystem:
        """System with :attr:`parameters` as defaults."""
        return self.system.with_parameters(**self.parameters)

    @cached_property
    def motion(self) -> ExactMotion:
        """Exact motion of :attr:`moved`.

        Raises:
            StateError: if it has too many coordinates.
        """
        if self.system.dimension > MAX_COORDINATES:
            raise StateError(f"{self.system.dimension} coordinates exceed the limit of {MAX_COORDINATES} in 60 digits")
        return exact_motion(self.moved)

    @cached_property
    def states(self) -> tuple[State, State]:
        """Two generic states: a step forward is taken from the first, a step backward from the second."""
        first = self._perturbed()
        now = first
        for _ in range(CONSECUTIVE_STEPS):
            try:
                q, p = self.step(now)
            except StepFailedError:
                break
            now = State(q, p, now.t + now.h, now.h)
        return first, State(now.q, now.p, now.t, -now.h / 2)

    def _perturbed(self) -> State:
        initial, m = self.initial, len(self.initial.q)
        sizes = self.scales(initial)
        directions = np.concatenate([np.cos(1.0 + np.arange(m)), np.sin(2.0 + 1.3 * np.arange(m))])
        for k in range(TRIALS):
            z = initial.z + PERTURBATION / 4**k * sizes * directions
            t = initial.t + 0.37 * initial.h
            try:
                q, p = z[:m], z[m:]
                if self.system.constraints:
                    q, p = self.stepper.project(q, p, t=t, parameters=self.parameters)
                state = State(q, p, t, initial.h)
                self.step(state)
            except (StateError, StepFailedError):
                continue
            return state
        return initial

    def tangents(self, state: State) -> Array:
        """Return (2m, 2(m - c)) directions, in units of :meth:`scales`, tangent to the constrained phase space."""
        left = 2 * (len(state.q) - len(self.system.constraints))
        return np.asarray(np.linalg.svd(self.constraint_derivatives(state, self.scales(state)))[2][-left:].T)

    def constraint_derivatives(self, state: State, units: Array) -> Array:
        """Return (2c, 2m) derivatives of constraints and their rates with respect to the state, in ``units``."""
        m, columns = len(state.q), []
        for unit in np.diag(WIDTH * units):
            ends = [state.z + sign * unit for sign in (1, -1)]
            values = [self.stepper.constraint_values(z[:m], z[m:], state.t, self.parameters) for z in ends]
            columns.append((np.concatenate(values[0]) - np.concatenate(values[1])) / (2 * WIDTH))
        return np.array(columns).T

    def step(
        self, state: State, stepper: Stepper | None = None, options: SolverOptions | None = None
    ) -> tuple[Array, Array]:
        """Return (q1, p1) of the compiled step; raises as :meth:`Stepper.step`."""
        stepper = stepper or self.stepper
        return stepper.step(state.q, state.p, state.h, state.t, self.parameters, options=options)

    def ends(self, state: State, stepper: Stepper | None = None, options: SolverOptions | None = None) -> Array:
        """Return the end of a step as one vector (2m,)."""
        return np.concatenate(self.step(state, stepper, options))

    def after(self, state: State) -> State:
        """Return the state after the compiled step."""
        return State(*self.step(state), state.t + state.h, state.h)

    def two_form(self, state: State) -> Array:
        """Return the (2m, 2m) symplectic form at a state."""
        return exact_motion(self.moved).two_form(numbers(state.q), numbers(state.p), mp.mpf(state.t))

    def scales(self, state: State) -> Array:
        """Return (2m,) the size of q and of p: of the state or, if larger, of its change in a step.

        All coordinates have the same size. The size of a momentum is its change for a common change of the velocities,
        whatever its mass. Sizes are at least those of the initial state, in place of which 0 has size 1.
        """
        return np.maximum(self._sizes(state), self._initial_sizes)

    @cached_property
    def _initial_sizes(self) -> Array:
        return self._sizes(self.initial)

    def _sizes(self, state: State) -> Array:
        m = len(state.q)
        try:
            end = np.concatenate(self.stepper.step(state.q, state.p, state.h, state.t, self.stepper.defaults))
        except StepFailedError:
            end = state.z
        if not state.z.any() and len(self.system.constraints) >= m:  # prescribed: changes are rounding errors
            end = state.z
        change = end - state.z
        sizes = [max(_rms(state.z[part]), _rms(change[part])) or 1.0 for part in (slice(m), slice(m, None))]
        return np.concatenate([np.full(m, sizes[0]), self._momentum_sizes(state, end, *sizes)])

    def _momentum_sizes(self, state: State, end: Array, length: float, size: float) -> Array:
        """Return (m,) changes of the momenta for a change of velocity by its mean; ``size`` for those without.

        In equilibrium, where velocities are rounding errors of forces that cancel, the mean is 1.
        """
        m = len(state.q)
        try:
            v, after = (self.stepper.velocity(q, p, state.t) for q, p in ((state.q, state.p), (end[:m], end[m:])))
            speed = max(_rms(v), _rms(after - v))
            moved = 0.1 * (speed if speed * abs(state.h) > ROUND_OFF * length else 1.0) * np.eye(m)
            changes = [self.stepper.momentum(state.q, v + unit, state.t) - state.p for unit in moved]
        except StateError:
            return np.full(m, size)
        sizes: Array = 10.0 * np.abs(np.diag(np.array(changes)))
        return np.where(sizes > 0.0, sizes, size)

    def linearised(self, state: State) -> Jacobian | None:
        """Return the Jacobian of the step at a state, by finite differences."""
        m = len(state.q)

        def step(z: Array) -> Array:
            return self.ends(State(z[:m], z[m:], state.t, state.h))

        return linearised(step, state.z, self.scales(state))

    def rounding(self, state: State) -> Array:
        """Return (2m,) bounds on the change of the end by one rounding of each number that enters a step.

        The least is one rounding of the size of all coordinates, and of all momenta: where terms cancel, as impulses
        and reactions at a pinned coordinate, the end is their rounding error whatever the derivatives of the step.
        """
        end, around = self.ends(state), self.linearised(state)
        propagated = np.abs(state.z) if around is None else around.propagated(state.z)
        time_change = 1e-6 * state.h
        later = self.ends(State(state.q, state.p, state.t + time_change, state.h))
        drift = np.abs(later - end) / abs(time_change) * (abs(state.t) + abs(state.h))
        longer = self.ends(State(state.q, state.p, state.t, state.h + time_change))
        step_change = np.abs(longer - end) / abs(time_change) * abs(state.h)
        total = propagated + np.abs(end) + np.abs(end - state.z) + drift + step_change
        sizes = self.scales(state)
        changes = (np.abs(end - state.z) / sizes).reshape(2, -1).max(axis=1, initial=1.0)
        return np.asarray(EPSILON * np.maximum(total, sizes * np.repeat(changes, len(state.q))) + np.finfo(float).tiny)

    def derived(self, method: Method | None = None, system: MechanicalSystem | None = None) -> DerivedStep:
        """Return the equations of the step in 60 digits, optionally of another method or system.

        Raises:
            StateError: if there are too many unknowns.
        """
        result = derived_step(system or self.motion.system, method or self.method)
        if result.unknowns > MAX_UNKNOWNS:
            raise StateError(f"{result.unknowns} unknowns per step exceed the limit of {MAX_UNKNOWNS} in 60 digits")
        return result

    @cached_property
    def _solved(self) -> dict[int, SolvedStep]:
        return {}

    @cached_property
    def ends_in_digits(self) -> dict[tuple[Number, ...], Array]:
        """Ends of steps in 60 digits by their arguments (q, p, parameters, t, h), which several checks share."""
        return {}

    def solved(self, index: int) -> SolvedStep:
        """Return the step from a state of :attr:`states` in 60 digits; raises as :meth:`derived` and its solution."""
        if index not in self._solved:
            state, derived = self.states[index], self.derived()
            start = state.q, state.p, state.h, state.t
            seconds = 0.0 if self._solved else REFERENCE_STEPS * derived.seconds(*start)
            text = f"{derived.unknowns} unknowns per step are solved in 60 digits, which takes about {seconds:.0f} s"
            if seconds > ANNOUNCED_SECONDS:
                Products.announce(text)
            self._solved[index] = derived(*start)
        return self._solved[index]

    def in_roundings(self, difference: Array, state: State) -> float:
        """Return the largest entry of a (2m,) difference of ends of a step, in units of rounding of this step."""
        return float(np.max(np.abs(difference) / self.rounding(state)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
