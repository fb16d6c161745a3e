"""A compiled integrator in Python: step, integrate, Legendre transforms. Imports neither SymPy nor Jinja.

``step`` depends on its arguments alone. A *run* (:meth:`Stepper.start`, used by :meth:`Stepper.integrate`) has memory:
it guesses each step by extrapolating the one before and carries along what rounding cut off the state. The whole memory
is one plain C struct; :meth:`Run.save` gives its bytes and :meth:`Stepper.restore` goes on from them, bit for bit.

All calls into C release the GIL and share nothing, so one stepper may be used from many threads.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.display.cards import card, listed, plain
from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.native import building
from scvi_codegen.native.arguments import checked_number, checked_step, real_array
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import STATUS, SolverOptions, step_failure
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.runtime.dense_output import checked_times, states_at, times_of_run
from scvi_codegen.runtime.event_search import crossings_of
from scvi_codegen.runtime.events import Crossings, Event, EventLike, as_events
from scvi_codegen.runtime.observation import Observation
from scvi_codegen.runtime.run import Run
from scvi_codegen.runtime.trajectory import Trajectory

if TYPE_CHECKING:
    from scvi_codegen.runtime.ensemble import EnsembleTrajectory

__all__ = ["Run", "SolverOptions", "Stepper"]

Array = NDArray[np.float64]
Parameters = Mapping[str, float] | Sequence[float] | Array | None


class Stepper:
    """One method for one system, compiled.

    Attributes:
        title: system and method, one line.
        coordinates, parameters: names in order.
        defaults: (k,) default parameter values.
        dimension: degrees of freedom m.
        momentum_map_names: what symmetries conserve.
        source: the C text it was compiled from.
        ensemble: the C text for many trajectories at once, compiled when first used; ``None`` if the method has none.
        events: zero crossings that every run records.
    """

    def __init__(
        self,
        source: Source,
        interface: Interface,
        *,
        ensemble: Source | None = None,
        flags: tuple[str, ...] = building.TUNED_FLAGS,
        events: tuple[Event, ...] = (),
    ) -> None:
        self.interface, self.ensemble, self.flags, self.events = interface, ensemble, flags, events
        self._plain = source
        self.source = _watching(source, interface, events) if events else source
        self.binding = Binding(building.load(self.source, flags=flags), interface)

    def __repr__(self) -> str:
        return f"<Stepper {self.title}>"

    def _repr_html_(self) -> str:
        interface = self.interface
        parameters = zip(interface.parameters, interface.defaults, strict=True)
        return card(
            interface.title,
            (
                ("method", plain(", ".join(interface.notes))),
                ("coordinates", listed(interface.coordinates)),
                ("parameters", listed([f"{name} = {value:g}" for name, value in parameters])),
                ("C", plain(f"{interface.prefix}.c, {len(self.source.code.splitlines())} lines")),
            ),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return (_rebuild, (self._plain, self.interface, self.ensemble, self.flags, self.events))

    @property
    def title(self) -> str:
        """System and method, one line."""
        return self.interface.title

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Coordinate names."""
        return self.interface.coordinates

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameter names."""
        return self.interface.parameters

    @property
    def defaults(self) -> Array:
        """(k,) default parameter values."""
        return np.array(self.interface.defaults, dtype=float)

    @property
    def momentum_map_names(self) -> tuple[str, ...]:
        """What symmetries of the system conserve: ``"angular momentum"``, ``"boost of x"``."""
        return self.interface.map_names

    @property
    def dimension(self) -> int:
        """Degrees of freedom m."""
        return self.interface.dimension

    def step(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array]:
        """One step from (q, p) at t to t + h, a function of its arguments alone.

        Args:
            q, p: (m,) positions and momenta.
            h: step size, negative to go back.
            t: time.
            parameters: by name (others keep their defaults) or all in order.
            options: convergence of the stage equations.

        Returns:
            (q1, p1), each (m,).

        Raises:
            StateError: on wrong shapes, names or non-finite numbers.
            StepFailedError: if the stage equations cannot be solved.
        """
        q0, p0, values = self._vector(q, "q"), self._vector(p, "p"), self._parameters(parameters)
        q1, p1 = np.empty_like(q0), np.empty_like(p0)
        report = self.binding.new("report *")
        status = self.binding.function("step")(
            checked_number(t, "the time t"),
            checked_step(h),
            self.binding.pointer(q0),
            self.binding.pointer(p0),
            self.binding.pointer(values),
            self.binding.options(options),
            self.binding.pointer(q1),
            self.binding.pointer(p1),
            report,
            self.binding.workspace(),
        )
        if status:
            raise step_failure(status, report, step=0, h=h)
        return q1, p1

    def integrate(
        self,
        q: ArrayLike,
        p: ArrayLike,
        *,
        h: float,
        steps: int,
        every: int = 1,
        t: float = 0.0,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        t_eval: ArrayLike | None = None,
        events: EventLike | Sequence[EventLike] | None = None,
    ) -> Trajectory:
        """Run ``steps`` steps and keep every ``every``-th state, the initial one first.

        Args:
            q, p: (m,) initial positions and momenta.
            h: step size, negative to go back.
            steps: number of steps.
            every: distance between kept states.
            t: initial time.
            parameters, options: as in :meth:`step`.
            progress: called now and then with the number of steps done.
            t_eval: (n,) times, sorted as the run goes: keep the states at these instead, as :meth:`Trajectory.at` gives
                them.
            events: zero crossings to record as ``events`` of the trajectory; a terminal one ends it. An
                :class:`~scvi_codegen.runtime.events.Event`, a function of (q, v, p, t) as text or SymPy expression, or
                several. They are compiled with the integrator, once. By default those of :func:`compile_stepper`.

        Returns:
            A :class:`Trajectory` of steps // every + 1 states, fewer if an event ended it.

        Raises:
            StateError: on wrong shapes, names or numbers.
            EventError: for an event with an unknown symbol, or where its function is not finite.
            StepFailedError: if a step fails; its ``trajectory`` holds the states before.
        """
        stepper = self if events is None else self.with_events(events)
        run = stepper.start(q, p, h=h, t=t, parameters=parameters, options=options)
        if t_eval is None:
            return run.record(steps, every=every, progress=progress)
        if every != 1:
            raise StateError(f"states are kept at t_eval or every so many steps (every={every}), not both")
        return Observation(run, times=times_of_run(t_eval, t, h, steps)).advance(steps, progress)

    def with_events(self, events: EventLike | Sequence[EventLike]) -> Stepper:
        """The same integrator, whose runs record these events in place of its own."""
        wanted = as_events(events)
        if wanted == self.events:
            return self
        return Stepper(self._plain, self.interface, ensemble=self.ensemble, flags=self.flags, events=wanted)

    def crossings(self, trajectory: Trajectory) -> tuple[Crossings, ...]:
        """The events of this stepper along a trajectory of the same integrator, see :meth:`Trajectory.crossings`."""
        return crossings_of(self, trajectory)

    def states_at(self, trajectory: Trajectory, t: ArrayLike) -> tuple[Array, Array]:
        """States between those of a trajectory, see :meth:`Trajectory.at`."""
        times = checked_times(t, "t")
        q, p = states_at(trajectory, times.ravel())
        return q.reshape(*times.shape, -1), p.reshape(*times.shape, -1)

    def integrate_ensemble(
        self,
        q: ArrayLike,
        p: ArrayLike,
        *,
        h: float,
        steps: int,
        every: int = 1,
        t: float = 0.0,
        parameters: Mapping[str, ArrayLike] | Sequence[Any] | Array | None = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        threads: int | None = None,
    ) -> EnsembleTrajectory:
        """Run k trajectories with common times, eight at a time as vector lanes, over all cores.

        Args:
            q, p: (k, m) initial positions and momenta.
            h, steps, every, t, options, progress: as in :meth:`integrate`.
            parameters: by name, one number or k each; or (k, number of parameters).
            threads: workers, by default one a core.

        Returns:
            An :class:`EnsembleTrajectory`; states equal those of :meth:`integrate` to round-off. A trajectory that
            fails has NaN from there on and says why in ``status``; the others are not disturbed.

        Raises:
            StateError: on wrong shapes, names or numbers.
        """
        from scvi_codegen.runtime.ensemble import integrate_ensemble

        return integrate_ensemble(
            self,
            q,
            p,
            h=h,
            steps=steps,
            every=every,
            t=t,
            parameters=parameters,
            options=options,
            progress=progress,
            threads=threads,
        )

    def start(
        self,
        q: ArrayLike,
        p: ArrayLike,
        *,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
    ) -> Run:
        """A run from (q, p) at t with step h, to be advanced at will."""
        q0, p0 = self._vector(q, "q"), self._vector(p, "p")
        memory = self.binding.new("run *")
        self.binding.function("start")(
            memory, checked_number(t, "the time t"), checked_step(h), self.binding.pointer(q0), self.binding.pointer(p0)
        )
        return Run(self, memory, self._parameters(parameters), options)

    def restore(self, saved: bytes, *, parameters: Parameters = None, options: SolverOptions | None = None) -> Run:
        """The run whose :meth:`Run.save` gave these bytes, to go on exactly as it would have."""
        memory = self.binding.new("run *")
        buffer = self.binding.buffer(memory)
        if not isinstance(saved, bytes):
            raise StateError(f"a saved run is bytes, not {type(saved).__name__}")
        if len(saved) != len(buffer):
            raise StateError(f"{len(saved)} bytes are not a saved run of this stepper, which has {len(buffer)}")
        buffer[:] = saved
        _check_run(memory)
        return Run(self, memory, self._parameters(parameters), options)

    def momentum(self, q: ArrayLike, v: ArrayLike, t: float = 0.0, parameters: Parameters = None) -> Array:
        """(m,) momenta p = dL/dv at (q, v, t), the Legendre transform."""
        return self._transform("momentum", self._vector(q, "q"), self._vector(v, "v"), t, parameters)

    def velocity(self, q: ArrayLike, p: ArrayLike, t: float = 0.0, parameters: Parameters = None) -> Array:
        """(m,) velocities v with dL/dv(q, v, t) = p, the inverse Legendre transform (Newton's iteration from rest)."""
        return self._transform("velocity", self._vector(q, "q"), self._vector(p, "p"), t, parameters)

    def energy(self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None) -> Any:
        """Energy p.v - L: a float for (m,) states, (n,) for (n, m) states with one time or (n,) times."""
        times, positions, momenta = self._states(q, p, t)
        result = np.empty(len(times))
        status = self.binding.function("energies")(
            len(times),
            self.binding.pointer(times),
            self.binding.pointer(positions),
            self.binding.pointer(momenta),
            self.binding.pointer(self._parameters(parameters)),
            self.binding.pointer(result),
            self.binding.workspace(),
        )
        if status:
            raise StateError(f"the energy of a state cannot be computed ({STATUS[status]})")
        return float(result[0]) if np.ndim(q) == 1 else result

    def momentum_maps(self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """What symmetries conserve, k numbers in the order of ``momentum_map_names``.

        Returns:
            (k,) for (m,) states, (n, k) for (n, m) states with one time or (n,) times.

        Raises:
            StateError: on wrong shapes, names or numbers.
        """
        values = self.momentum_maps_and_sizes(q, p, t, parameters)[0]
        return values[0] if np.ndim(q) == 1 else values

    def momentum_maps_and_sizes(
        self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None
    ) -> tuple[Array, Array]:
        """The same, (n, k), and the roots of the sums of the squares of their terms, beside which rounding is small."""
        times, positions, momenta = self._states(q, p, t)
        values, sizes = np.empty((2, len(times), len(self.momentum_map_names)))
        if not values.size:
            return values, sizes
        status = self.binding.function("momentum_maps")(
            len(times),
            self.binding.pointer(times),
            self.binding.pointer(positions),
            self.binding.pointer(momenta),
            self.binding.pointer(self._parameters(parameters)),
            self.binding.pointer(values),
            self.binding.pointer(sizes),
        )
        if status:
            raise StateError(f"the momentum maps of a state cannot be computed ({STATUS[status]})")
        return values, sizes

    def discrete_lagrangian(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> float:
        """L_d(q0, q1), the approximate action of the curve from q0 at t to q1 at t + h; paper (25), (33).

        Raises:
            MethodError: for methods without a discrete Lagrangian.
            StepFailedError: if no curve is found.
        """
        return self._discrete_legendre(q0, q1, h, t, parameters, options)[2]

    def discrete_legendre_minus(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array]:
        """F-: (q0, q1) -> (q0, p0 = -D1 L_d(q0, q1)); paper, section 1.2. Raises as :meth:`discrete_lagrangian`."""
        return self._vector(q0, "q0"), self._discrete_legendre(q0, q1, h, t, parameters, options)[0]

    def discrete_legendre_plus(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array]:
        """F+: (q0, q1) -> (q1, p1 = D2 L_d(q0, q1)); paper, section 1.2. Raises as :meth:`discrete_lagrangian`."""
        return self._vector(q1, "q1"), self._discrete_legendre(q0, q1, h, t, parameters, options)[1]

    def step_positions(
        self,
        q_previous: ArrayLike,
        q_current: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> Array:
        """The discrete Euler-Lagrange equation (4): (q_{k-1} at t, q_k at t + h) -> q_{k+1} at t + 2 h.

        Raises as :meth:`discrete_lagrangian`.
        """
        q, p = self.discrete_legendre_plus(q_previous, q_current, h, t, parameters, options=options)
        return self.step(q, p, h, t + h, parameters, options=options)[0]

    def _discrete_legendre(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        h: float,
        t: float,
        parameters: Parameters,
        options: SolverOptions | None,
    ) -> tuple[Array, Array, float]:
        if not self.interface.has_action:
            raise MethodError(f"{self.interface.method} has no discrete Lagrangian; SVI, SCVI and Gauss methods have")
        start, end = self._vector(q0, "q0"), self._vector(q1, "q1")
        p0, p1, action = np.empty_like(start), np.empty_like(start), np.empty(1)
        report = self.binding.new("report *")
        status = self.binding.function("discrete_legendre")(
            checked_number(t, "the time t"),
            checked_step(h),
            self.binding.pointer(start),
            self.binding.pointer(end),
            self.binding.pointer(self._parameters(parameters)),
            self.binding.options(options),
            self.binding.pointer(p0),
            self.binding.pointer(p1),
            self.binding.pointer(action),
            report,
            self.binding.workspace(),
        )
        if status:
            raise step_failure(status, report, step=0, h=h)
        return p0, p1, float(action[0])

    def _transform(self, name: str, q: Array, other: Array, t: float, parameters: Parameters) -> Array:
        result = np.empty_like(other)
        status = self.binding.function(name)(
            checked_number(t, "the time t"),
            self.binding.pointer(q),
            self.binding.pointer(other),
            self.binding.pointer(self._parameters(parameters)),
            self.binding.pointer(result),
            self.binding.workspace(),
        )
        if status:
            hint = "; does this Hamiltonian determine momenta by velocities? Give p" if name == "momentum" else ""
            raise StateError(f"the {name} at q = {q} and {other} cannot be computed ({STATUS[status]}{hint})")
        return result

    def _states(self, q: ArrayLike, p: ArrayLike, t: ArrayLike) -> tuple[Array, Array, Array]:
        """(n,) times and (n, m) positions and momenta, contiguous, of one state or many."""
        positions, momenta = real_array(q, "q"), real_array(p, "p")
        if positions.ndim == 1:
            positions, momenta = self._vector(q, "q"), self._vector(p, "p")
        elif positions.ndim != 2 or positions.shape != momenta.shape or positions.shape[1] != self.dimension:
            raise StateError(
                f"states must have shape (n, {self.dimension}), not q {positions.shape} and p {momenta.shape}"
            )
        count = positions.size // self.dimension
        times = real_array(t, "the time t")
        if not np.isfinite(times).all():
            raise StateError("a time t is not finite")
        if times.shape not in ((), (count,)):
            raise StateError(f"there are {count} states, but the time has shape {times.shape}")
        times = np.ascontiguousarray(np.broadcast_to(times, (count,)))
        return times, np.ascontiguousarray(positions), np.ascontiguousarray(momenta)

    def _vector(self, value: ArrayLike, name: str) -> Array:
        """A finite, contiguous (m,) copy."""
        array = real_array(value, name)
        if array.shape != (self.dimension,):
            names = ", ".join(self.coordinates[:6]) + (", ..." if self.dimension > 6 else "")
            raise StateError(f"{name} must have shape ({self.dimension},) for ({names}), not {array.shape}")
        if not np.isfinite(array).all():
            worst = int(np.flatnonzero(~np.isfinite(array))[0])
            raise StateError(f"{name}[{worst}] ({self.coordinates[worst]}) is {array[worst]}")
        return array

    def _parameters(self, parameters: Parameters) -> Array:
        values = self.defaults
        if parameters is None:
            return values
        if isinstance(parameters, Mapping):
            for name, value in parameters.items():
                values[self.parameter_index(name)] = checked_number(value, f"the parameter {name}")
        else:
            given = real_array(parameters, "parameters")
            if given.shape != values.shape:
                names = ", ".join(self.parameters) or "none"
                raise StateError(f"there are {len(values)} parameters ({names}), not {given.size}")
            values = given
        if not np.isfinite(values).all():
            worst = int(np.flatnonzero(~np.isfinite(values))[0])
            raise StateError(f"the parameter {self.parameters[worst]} is {values[worst]}")
        return values

    def parameter_index(self, name: str) -> int:
        """The place of a parameter; StateError with the nearest name if there is none."""
        if name in self.parameters:
            return self.parameters.index(name)
        folded = {parameter.lower(): parameter for parameter in self.parameters}
        near = [folded[key] for key in difflib.get_close_matches(str(name).lower(), folded, 1)]
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise StateError(f"there is no parameter {name!r} among {', '.join(self.parameters) or 'none'}{hint}")


def _check_run(memory: Any) -> None:
    """Raise :class:`StateError` for bytes that no run has."""
    numbers = [memory.t0, memory.h, *memory.q, *memory.p, *memory.carry_q, *memory.carry_p]
    counts = {"step": memory.step, "guess": memory.guess, "iterations": memory.iterations}
    sound = np.isfinite(numbers).all() and memory.h != 0.0 and all(0 <= count < 2**53 for count in counts.values())
    if not sound or memory.guess > 2:
        raise StateError(f"these bytes are not a saved run: h = {memory.h:g}, {counts}")


def _watching(source: Source, interface: Interface, events: tuple[Event, ...]) -> Source:
    from scvi_codegen.rendering.events import with_events  # here, because it imports SymPy

    return with_events(source, interface, tuple(event.function for event in events))


def _rebuild(
    source: Source, interface: Interface, ensemble: Source | None, flags: tuple[str, ...], events: tuple[Event, ...]
) -> Stepper:
    return Stepper(source, interface, ensemble=ensemble, flags=flags, events=events)
