"""Functions of a state: Legendre transforms, energies, conserved quantities, rates of transformed time, parameters.

All C calls release the GIL and share no state, so one integrator may be used from many threads.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.native.option_table import OPTION, VELOCITY, excluding, lacking
from scvi_codegen.codegen.native.options import REASONS
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array, Parameters, States, coordinate_shapes
from scvi_codegen.runs.states.words import by_name, low_words, product_of, quotient_of, scalar, sum_of, unnamed
from scvi_codegen.runs.stepping.compiled_method import CompiledMethod

PROBES = 8
"""Number of random momenta that estimate the size of the direction of a symmetry."""
HUGE = 1e20
"""Size of coordinates or momenta whose powers overflow, although the energy or its other terms may not."""
FINITE = "Start at a state where L and its forces are finite"
REPORTED = 1e-3
"""Largest relative difference between a velocity and the velocity recomputed from its momentum."""


def undefined_energy(q: Array, p: Array) -> StateError:
    """Return the error of states whose energy is no number."""
    largest = max(float(abs(np.asarray(x)).max(initial=0.0)) for x in (q, p))
    overflow = f"a term overflows at coordinates or momenta of {largest:.0e}: choose larger units, or a smaller step"
    reason = overflow if HUGE < largest < np.inf else "a value is infinite or NaN"
    return StateError(f"the energy of a state cannot be computed: {reason}")


def neither_or_both(p: States | None) -> StateError:
    """Return the error for a state with neither momenta nor velocities, or with both."""
    return StateError(lacking(VELOCITY) if p is None else excluding(OPTION["p"], OPTION["velocity"]))


class StateFunctions(CompiledMethod):
    """Compiled method with functions of a state, which do not depend on the steps."""

    def _parameters_at(self, q: States, p: States | None, parameters: Parameters = None) -> Array:
        """Return (k,) values in order; in transformed time the energy defaults to that of the state (q, p)."""
        values = self._parameters(parameters)
        if not self._has_energy(parameters):
            q, p = self._states.pair(q, cast(States, p))
            values[self.interface.energy_index] = self.energy(q, p, 0.0, values)
        return values

    def _has_energy(self, parameters: Mapping[str, Any] | Sequence[Any] | Array | None) -> bool:
        """Return whether the parameters contain the energy required by transformed time, or none is required."""
        name = self.interface.energy_parameter
        return name is None or (parameters is not None and (not isinstance(parameters, Mapping) or name in parameters))

    def rates(self, q: States, p: States, parameters: Parameters = None) -> Array:
        """Return (n,) rates dt/dtau at (n, m) states; 1 if time is not transformed."""
        _, positions, momenta = self._states.rows(q, p, 0.0)
        rates = np.ones((positions.size // self.dimension, self.interface.words))
        if not self.in_tau:
            return rates[:, 0]
        arrays = *map(self._states.block, (positions, momenta, self._parameters(parameters))), rates
        if self.binding.function("rates")(len(rates), *map(self.binding.pointer, arrays)):
            raise StateError("the rate dt/dtau of the time transformation must be positive at every state")
        return self._states.numbers(rates)[:, 0]

    def momentum(self, q: States, v: States, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """Return momenta p = dL/dv at (q, v, t), the Legendre transform: (m,), or (n, m) for (n, m) states."""
        return self._transform("momentum", q, v, t, parameters, "v")

    def velocity(self, q: States, p: States, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """Return velocities v with dL/dv(q, v, t) = p, the inverse Legendre transform (Newton's iteration from v = 0).

        Returns:
            (m,), or (n, m) for (n, m) states with one time or (n,) times.
        """
        return self.named(self._transform("velocity", q, p, t, parameters, "p"))

    def _initial_momenta(
        self, q: States, p: States | None, velocity: States | None, t: float, parameters: Parameters
    ) -> States:
        """Return the momenta of a state by p or by velocity; StateError unless exactly one of both is passed."""
        if velocity is None and p is not None:
            return p
        if velocity is None or p is not None:
            raise neither_or_both(p)
        return self.initial_momentum(q, velocity, t, parameters)

    def initial_momentum(self, q: States, velocity: States, t: float, parameters: Parameters) -> Array:
        """Return the (m,) momentum of the initial state of a run."""
        q, v = self._states.pair(q, velocity, "velocity")
        p = self._transformed("momentum", self._states.time(t), q, v, self._parameters(parameters))
        dropped = (p == 0.0) & (v != 0.0)
        if dropped.any():
            try:
                back = self.velocity(q, p, t, parameters)
            except StateError:
                back = np.full_like(v, np.nan)
            dropped &= ~(np.abs(back - v) <= REPORTED * np.abs(v).max())
        if not dropped.any():
            return p
        i = int(np.flatnonzero(dropped)[0])
        name = self.coordinates[i]
        raise StateError(
            f"the velocity {name}_dot = {v.ravel()[i]:g} at q = {np.asarray(q)} has no momentum: the mass matrix is "
            f"singular there in the direction of '{name}', so the motion is undetermined. Start from a state where the "
            f"kinetic energy depends on {name}_dot, or use coordinates that are regular there (Cartesian instead of "
            "polar coordinates at the origin)"
        )

    def energy(self, q: States, p: States, t: ArrayLike = 0.0, parameters: Parameters = None) -> Any:
        """Return the energy p.v - L: a float for (m,) states, (n,) for (n, m) with one time or (n,) times."""
        times, positions, momenta = self._states.rows(q, p, t)
        result = self._energies_of(times, positions, momenta, self._parameters(parameters))
        if not self._states.is_one(q):
            return result
        return scalar(result[0])

    def _failures_from(self, q: Array, p: Array, t: float, parameters: Parameters) -> Mapping[str, tuple[str, str]]:
        """Return cause and remedy of the failures of a step from a state; an energy that is undefined there is one."""
        try:
            if not np.isfinite(self.energy(q, p, t, parameters)):  # of arrays of run-time sizes
                raise undefined_energy(q, p)
        except StateError as error:
            return dict.fromkeys(self.binding.failures, (f"at its start {error}", FINITE))
        return self.binding.failures

    def _energy_parts(self, q: Array, p: Array, t: Array, parameters: Array) -> Array:
        """Return (n, 3) kinetic, potential and total energies of (n, m) states; parts of run-time sizes, else NaN."""
        parts = np.full((len(q), 3), np.nan)
        if self.binding.has("energy_parts"):
            arrays = (np.ascontiguousarray(vectors, dtype=float) for vectors in (t, q, p, parameters))
            pointers = map(self.binding.pointer, (*arrays, parts))
            self.binding.function("energy_parts")(len(t), *pointers, self.binding.workspace())
        else:
            parts[:, 2] = self.energy(q, p, t, parameters)
        return parts

    def _energies_of(self, t: Array, q: Array, p: Array, parameters: Array) -> Array:
        """Return (n,) energies of unchecked contiguous arrays of shapes (n,), (n, m), (n, m) and (k,)."""
        result, binding = np.empty(len(t) * self.interface.words), self.binding
        states = self._states
        arrays = states.times_block(t), *map(states.block, (q, p)), result
        at, positions, momenta, energies = binding.pointers(*arrays)
        values, workspace = binding.pointer(states.block(parameters)), binding.workspace()
        status = binding.function("energies")(len(t), at, positions, momenta, values, energies, workspace)
        if status:
            raise undefined_energy(q, p)
        result = states.times(result)
        if self.in_tau:
            energy = parameters[self.interface.energy_index]
            result = sum_of(energy, quotient_of(result, self.rates(q, p, parameters)))
        return result

    def momentum_maps(self, q: States, p: States, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """Return the k conserved quantities in the order of ``momentum_map_names``.

        Returns:
            (k,) for (m,) states, (n, k) for (n, m) states with one time or (n,) times.

        Raises:
            StateError: if a shape, name or number is invalid.
        """
        values = self._momentum_maps_and_sizes(q, p, t, parameters)[0]
        return values[0] if self._states.is_one(q) else values

    def _momentum_maps_and_sizes(
        self, q: States, p: States, t: ArrayLike = 0.0, parameters: Parameters = None
    ) -> tuple[Array, Array]:
        """Return (n, k) momentum maps and the root sum of squares of their terms, the scale of rounding errors."""
        times, positions, momenta = self._states.rows(q, p, t)
        sizes = np.empty((len(times), len(self.momentum_map_names)))
        values = np.empty((len(times), sizes.shape[1] * self.interface.words))
        if not values.size:
            return values, sizes
        layout, numbers = self._states, (positions, momenta, self._parameters(parameters))
        arrays = layout.times_block(times), *map(layout.block, numbers), values, sizes
        sizes_of = () if self.problem is None else (self.binding.workspace(),)
        status = self.binding.function("momentum_maps")(len(times), *map(self.binding.pointer, arrays), *sizes_of)
        if status:
            raise StateError(f"the momentum maps of a state cannot be computed: {REASONS[status]}")
        return self._states.numbers(values), sizes

    def _momentum_bounds(self, q: Array, p: Array, t: Array, parameters: Parameters) -> Array:
        """Return (k,) bounds |p| |xi| of the momentum maps p . xi at the state with the largest momenta.

        |xi| is estimated by random momenta.
        """
        q, p, t = (np.asarray(vectors, dtype=float) for vectors in (q, p, t))
        sizes = np.linalg.norm(p, axis=1)
        at = int(np.argmax(sizes))
        probes = np.random.default_rng(PROBES).normal(size=(1 + PROBES, p.shape[1]))
        probes[0] = 0.0
        values = self._momentum_maps_and_sizes(np.tile(q[at], (len(probes), 1)), probes, t[at], parameters)[0]
        values = np.asarray(values, dtype=float)
        return np.asarray(sizes[at] * np.sqrt(np.mean((values[1:] - values[0]) ** 2, axis=0)))

    def _transform(
        self, name: str, q: States, other: States, t: ArrayLike, parameters: Parameters, label: str
    ) -> Array:
        if self._states.is_one(q):
            at, values = self._states.time(t), self._parameters(parameters)
            return self._transformed(name, at, *self._states.pair(q, other, label), values)
        times, positions, others = self._states.rows(q, other, t, name=label)
        values, result, done = self._parameters(parameters), others.copy(), 0
        if not (self.in_tau or self.interface.words > 1 or self.interface.layout.momenta):
            arrays = map(self.binding.pointer, (times, positions, others, values, result))
            call, sizes = self.binding.function("call_transform"), positions.shape
            done = call(name == "velocity", *sizes, *arrays, self.binding.workspace())
        for k in range(done, len(times)):  # the first one fails, unless none was transformed
            result[k] = self._transformed(name, times[k], positions[k], others[k], values)
        return result

    def _transformed(self, name: str, t: float, q: Array, other: Array, values: Array) -> Array:
        """Transform between p and dq/dt in transformed time, on the energy surface of the state."""
        if not self.in_tau:
            return self._called(name, t, q, other, values)
        if name == "velocity":
            values[self.interface.energy_index] = self.energy(q, other, t, values)
            return quotient_of(self._called(name, t, q, other, values), self.rates(q, other, values))
        rate = self.rates(q, np.zeros_like(q), values)
        p = self._called(name, t, q, product_of(other, rate), values)
        if self.rates(q, p, values) != rate:
            raise StateError("dt/dtau depends on the momenta, so velocity does not determine them: give p")
        return p

    def _called(self, name: str, t: float, q: Array, other: Array, values: Array) -> Array:
        if self.interface.layout.momenta:
            other_form = "give momenta p instead of velocity" if name == "momentum" else "use the momenta p"
            raise StateError(f"velocities are unavailable for a system defined by a Hamiltonian: {other_form}")
        result = np.empty(len(other) * self.interface.words)
        pointers = map(self.binding.pointer, (*map(self._states.block, (q, other, values)), result))
        status = self.binding.function(name)(self._time_argument(t), *pointers, self.binding.workspace())
        if status:
            hint = "; if the Hamiltonian is singular in p, give p instead of velocity" if name == "momentum" else ""
            raise StateError(f"the {name} at q = {q} and {other} cannot be computed: {REASONS[status]}{hint}")
        return self._states.numbers(result)

    def _time_argument(self, t: float) -> Any:
        """Return a time as an argument of C: a number or, in double-double arithmetic, a pointer to both words."""
        if self.interface.words == 1:
            return float(t)
        return self.binding.pointer(np.array([float(t), float(low_words(t))]))

    def arrays(self, values: Array) -> dict[str, Array]:
        """Return (.., m) positions, momenta or velocities by the names of coordinates and of arrays of known sizes.

        States are accepted in the same form, ``{"x": 0.0, "q": [..]}`` of ``coordinates=["x", "q[8]"]``.
        """
        return by_name(unnamed(values), coordinate_shapes(self.interface))

    def _parameters(self, parameters: Parameters, base: Array | None = None) -> Array:
        """Return the (k,) parameters; those that are not passed by name are those of ``base``, or defaults."""
        return self._states.parameters(parameters, base)

    def parameters_by_name(self, values: Array) -> dict[str, Any]:
        """Return (k,) parameters of one or two words by name; those of arrays of run-time sizes as arrays."""
        interface = self.interface if self.problem is None or self.origin is None else self.origin.interface
        numbers = list(values) if interface.words > 1 else values.tolist()
        result: dict[str, Any] = dict(zip(interface.parameters, numbers, strict=self.problem is None))
        if self.problem is not None:
            fields = [(field.name, field.shape(self.problem.sizes)) for field in interface.layout.fields]
            result |= by_name(np.asarray(values)[len(interface.parameters) :], fields)
        return result

    def constraint_arrays(self, values: Array) -> Any:
        """Return numbers of all constraints in the form of :attr:`Run.multipliers`."""
        if self.problem is None:
            return values
        from scvi_codegen.runs.stepping.array_interface import constraint_shapes

        shapes = constraint_shapes(self.interface.layout, self.problem.sizes)
        return tuple(by_name(values, enumerate(map(tuple, shapes))).values())
