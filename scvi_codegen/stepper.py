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

from scvi_codegen import building
from scvi_codegen.arguments import checked_number, checked_step
from scvi_codegen.binding import STATUS, Binding, SolverOptions, step_failure
from scvi_codegen.cards import card, listed, plain
from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.run import Run
from scvi_codegen.source import Interface, Source
from scvi_codegen.trajectory import Trajectory

if TYPE_CHECKING:
    from scvi_codegen.ensemble import EnsembleTrajectory

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
        source: the C text it was compiled from.
        ensemble: the C text for many trajectories at once, compiled when first used; ``None`` if the method has none.
    """

    def __init__(
        self,
        source: Source,
        interface: Interface,
        *,
        ensemble: Source | None = None,
        flags: tuple[str, ...] = building.TUNED_FLAGS,
    ) -> None:
        self.source, self.interface, self.ensemble, self.flags = source, interface, ensemble, flags
        self.binding = Binding(building.load(source, flags=flags), interface)

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
        return (_rebuild, (self.source, self.interface, self.ensemble, self.flags))

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

        Returns:
            A :class:`Trajectory` of steps // every + 1 states.

        Raises:
            StateError: on wrong shapes, names or numbers.
            StepFailedError: if a step fails; its ``trajectory`` holds the states before.
        """
        run = self.start(q, p, h=h, t=t, parameters=parameters, options=options)
        return run.record(steps, every=every, progress=progress)

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
        from scvi_codegen.ensemble import integrate_ensemble

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
        if len(saved) != len(buffer):
            raise StateError(f"{len(saved)} bytes are not a saved run of this stepper, which has {len(buffer)}")
        buffer[:] = saved
        return Run(self, memory, self._parameters(parameters), options)

    def momentum(self, q: ArrayLike, v: ArrayLike, t: float = 0.0, parameters: Parameters = None) -> Array:
        """(m,) momenta p = dL/dv at (q, v, t), the Legendre transform."""
        return self._transform("momentum", self._vector(q, "q"), self._vector(v, "v"), t, parameters)

    def velocity(self, q: ArrayLike, p: ArrayLike, t: float = 0.0, parameters: Parameters = None) -> Array:
        """(m,) velocities v with dL/dv(q, v, t) = p, the inverse Legendre transform (Newton's iteration from rest)."""
        return self._transform("velocity", self._vector(q, "q"), self._vector(p, "p"), t, parameters)

    def energy(self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None) -> Any:
        """Energy p.v - L: a float for (m,) states, (n,) for (n, m) states with one time or (n,) times."""
        positions, momenta = np.asarray(q, dtype=float), np.asarray(p, dtype=float)
        if positions.ndim == 1:
            positions, momenta = self._vector(q, "q"), self._vector(p, "p")
        elif positions.ndim != 2 or positions.shape != momenta.shape or positions.shape[1] != self.dimension:
            raise StateError(
                f"states must have shape (n, {self.dimension}), not q {positions.shape} and p {momenta.shape}"
            )
        count = positions.size // self.dimension
        times = np.asarray(t, dtype=float)
        if times.shape not in ((), (count,)):
            raise StateError(f"there are {count} states, but the time has shape {times.shape}")
        times = np.ascontiguousarray(np.broadcast_to(times, (count,)))
        positions, momenta = np.ascontiguousarray(positions), np.ascontiguousarray(momenta)
        result = np.empty(count)
        status = self.binding.function("energies")(
            count,
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

    def _vector(self, value: ArrayLike, name: str) -> Array:
        """A finite, contiguous (m,) copy."""
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise StateError(f"{name} must be {self.dimension} real numbers: {error}") from error
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
            try:
                given = np.array(parameters, dtype=float)
            except (TypeError, ValueError) as error:
                raise StateError(f"parameters must be real numbers: {error}") from error
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


def _rebuild(source: Source, interface: Interface, ensemble: Source | None, flags: tuple[str, ...]) -> Stepper:
    return Stepper(source, interface, ensemble=ensemble, flags=flags)
