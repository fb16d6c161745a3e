"""Stepper of arrays whose sizes and tables are those of one call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, Protocol, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.indices import Loop
from scvi_codegen.native import building
from scvi_codegen.native.arguments import real_array
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.runtime.arrays.binding import ArrayBinding
from scvi_codegen.runtime.arrays.interface import RunArrays, field_values, number_values
from scvi_codegen.runtime.arrays.saving import saved_bytes
from scvi_codegen.runtime.core.compiled_method import Variants
from scvi_codegen.runtime.core.named_arrays import EntryNames
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.core.validation import Array, Parameters
from scvi_codegen.runtime.events.event import Event


class AnySizes(Protocol):
    """Interface required of a stepper of any size (:class:`ArrayStepper`)."""

    source: Source | None
    interface: Interface
    flags: tuple[str, ...]
    _variants: Variants

    def with_sizes(
        self, sizes: Mapping[str, int] | None = None, /, *, tables: Mapping[str, ArrayLike] | None = None, **named: int
    ) -> Stepper:
        """Return the stepper compiled with these sizes."""


class BoundStepper(Stepper):
    """Stepper of arrays for the sizes and tables of one call; states and parameters are vectors, as for known sizes.

    What requires derivatives of steps, or formulas of entries, uses the stepper compiled with these sizes.

    Args:
        origin: stepper of arrays of any size.
        arrays: sizes and tables.
        threads: number of threads per step.
        source: source of the steps, by default with a fixed step size.
        events: events that every run records.
    """

    binding: ArrayBinding

    def __init__(
        self,
        origin: AnySizes,
        arrays: RunArrays,
        *,
        threads: int = 1,
        source: Source | None = None,
        events: tuple[Event, ...] = (),
    ) -> None:
        self.origin, self.problem, self.threads = origin, arrays, threads
        super().__init__(
            cast(Source, source or origin.source),
            _bound_interface(origin.interface, arrays),
            variants=origin._variants,
            flags=origin.flags,
            events=events,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self.origin, self.problem, self.threads, self._plain, self.events)

    def _load(self) -> None:
        self.source = self._plain
        library = building.load(self.source, flags=self.flags)
        self.binding = ArrayBinding(library, self.origin.interface, self.problem, self.threads)

    def _copy(self, source: Source, events: tuple[Event, ...]) -> Self:
        return type(self)(self.origin, self.problem, threads=self.threads, source=source, events=events)

    @cached_property
    def known(self) -> Stepper:
        """Stepper compiled with these sizes; raises as :meth:`ArrayStepper.with_sizes`."""
        return self.origin.with_sizes(self.problem.sizes, tables=self.problem.places)

    @property
    def tangent(self) -> Binding:
        """Library with derivatives of steps of these sizes."""
        return self.known.tangent

    @property
    def _second_derivatives(self) -> Binding:
        return self.known._second_derivatives

    def _variational_source(self, count: int) -> Source | None:
        return self.known._variational_source(count)

    def _discrete_legendre(self, *arguments: Any) -> tuple[Array, Array, float]:
        return self.known._discrete_legendre(*arguments)

    @property
    def impulse_names(self) -> tuple[str, ...]:
        """Names of the momentum maps of L alone that forces change."""
        return self.known.impulse_names

    def work_and_impulses(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return a step with the work of the forces in it, as :meth:`Stepper.work_and_impulses`."""
        return self.known.work_and_impulses(q, p, h, t, self._parameters(parameters), options=options)

    @property
    def defaults(self) -> Array:
        """(k,) default values of scalar parameters and fields."""
        return self._parameters({})

    def _parameters(self, parameters: Parameters, base: Array | None = None) -> Array:
        """Return scalar parameters and fields in one vector; those not passed are those of ``base``, or defaults."""
        if parameters is not None and not isinstance(parameters, Mapping):
            values = real_array(parameters, "parameters")
            if values.shape != (self.binding.parameter_count,):
                raise StateError(f"parameters must have {self.binding.parameter_count} values, not {values.size}")
            return values
        argument = ({} if base is None else self.parameters_by_name(base)) | dict(parameters or {})
        fields = field_values(self.origin.interface, argument, self.problem.sizes)
        numbers = number_values(self.origin.interface, argument)
        return np.concatenate([numbers, *(values.reshape(-1) for values in fields.values())])

    def parameters_by_name(self, values: Array) -> dict[str, Any]:
        """Return scalar parameters and fields by name."""
        interface = self.origin.interface
        result: dict[str, Any] = dict(zip(interface.parameters, values.tolist(), strict=False))
        for field, (first, end) in zip(interface.layout.fields, self.binding.field_rows, strict=True):
            result[field.name] = values[first:end].reshape(field.shape(self.problem.sizes))
        return result

    def velocity(self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """Return velocities, as :meth:`Stepper.velocity`.

        Raises:
            StateError: if the system is defined by a Hamiltonian.
        """
        if self.origin.interface.layout.momenta:
            raise StateError("velocities are unavailable for a system defined by a Hamiltonian: use the momenta p")
        return super().velocity(q, p, t, parameters)

    def inverse_masses(self, parameters: Parameters = None) -> dict[str, Array]:
        """Return 1/m of every coordinate by the name of its array; empty for a Hamiltonian."""
        if self.origin.interface.layout.momenta:
            return {}
        return self.arrays(self.binding.inverse_masses(self._parameters(parameters)))

    def _energy_parts(self, q: Array, p: Array, t: Array, parameters: Array) -> Array:
        """Return (n, 3) kinetic, potential and total energies of (n, m) states; 0, H, H for a Hamiltonian."""
        arrays = (np.ascontiguousarray(each, dtype=float) for each in (t, q, p, parameters))
        return self.binding.energy_parts(len(t), *map(self.binding.pointer, arrays))

    def _checkpoint(self, run: Any) -> bytes:
        """Return a run with its problem, for :meth:`ArrayStepper.from_checkpoint`."""
        return saved_bytes(self, run)

    def constraint_arrays(self, values: Array) -> tuple[Array, ...]:
        """Split numbers of all constraints into an array over the loops of each."""
        parts, first = [], 0
        for shape in _constraint_shapes(self.origin.interface, self.problem):
            size = int(np.prod(shape))
            parts.append(values[first : first + size].reshape(shape))
            first += size
        return tuple(parts)


def _bound_interface(interface: Interface, arrays: RunArrays) -> Interface:
    """Return the interface of these sizes, whose names are made when they are read."""
    layout = interface.layout
    shapes = [(array.name, array.shape(arrays.sizes)) for array in (*layout.coordinates, *layout.fields)]
    count = len(layout.coordinates)
    momenta = [(array.name, array.shape(arrays.sizes)) for array in layout.momenta]
    names: dict[str, Any] = {
        "coordinates": EntryNames(shapes[:count]),
        "parameters": EntryNames([*((name, ()) for name in interface.parameters), *shapes[count:]]),
        "momentum_names": EntryNames(momenta) if momenta else (),
        "constraints": tuple(
            f"constraint {number}" + (str(list(map(int, index))) if shape else "")
            for number, shape in enumerate(_constraint_shapes(interface, arrays), 1)
            for index in np.ndindex(*shape)
        ),
    }
    declared = tuple(f"{name}[{', '.join(map(str, shape))}]" if shape else name for name, shape in shapes)
    return replace(interface, arrays=declared, map_names=tuple(each.name for each in layout.maps), **names)


def _constraint_shapes(interface: Interface, arrays: RunArrays) -> list[list[int]]:
    """Return one axis per loop of each constraint; the two loops of a pair share one axis."""

    def shape(loops: tuple[Loop, ...]) -> list[int]:
        outer = {loop.behind for loop in loops}
        spans = [
            (loop, loop.end.at(arrays.sizes) - loop.first.at(arrays.sizes)) for loop in loops if loop.index not in outer
        ]
        return [span * (span - 1) // 2 if loop.behind else span for loop, span in spans]

    return [shape(loops) for loops in interface.layout.constraints]


def _rebuild(
    origin: AnySizes, arrays: RunArrays, threads: int, source: Source, events: tuple[Event, ...]
) -> BoundStepper:
    return BoundStepper(origin, arrays, threads=threads, source=source, events=events)
