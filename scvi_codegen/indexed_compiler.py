"""Compilation pipeline of indexed systems: from a Lagrangian in index notation to an integrator of any size.

    IndexedSystem  x  Method
      -> lower       Program  kernels of terms, tables of one coordinate (:mod:`scvi_codegen.lowering.arrays`)
      -> render      Source          loops around kernels (:mod:`scvi_codegen.rendering.loops`)
      -> IndexedStepper              runs over arrays (:mod:`scvi_codegen.runtime.indexed_stepper`)

Neither the length of the C source nor its compile time depends on the number of coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

from scvi_codegen.compiler import c_identifier
from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.arrays import check_solver, lower_arrays, one_coordinate
from scvi_codegen.lowering.solvers.predictor_tables import control_of
from scvi_codegen.mechanics.indexed.symmetry import momentum_maps
from scvi_codegen.mechanics.indexed.system import INDEXED, IndexedSystem
from scvi_codegen.methods import as_method
from scvi_codegen.methods.method import Method
from scvi_codegen.native.announcements import announced
from scvi_codegen.native.building import TUNED_FLAGS
from scvi_codegen.rendering.program_source import render
from scvi_codegen.rendering.source import Source
from scvi_codegen.rendering.source_cache import cached_source
from scvi_codegen.runtime.indexed_interface import IndexedInterface
from scvi_codegen.runtime.indexed_stepper import IndexedStepper
from scvi_codegen.validation.argument_types import TEXT, TEXTS, checks_arguments

__all__ = ["compile_indexed", "generate_indexed"]


@checks_arguments(system=INDEXED, flags=TEXTS, prefix=TEXT, solver=TEXT)
def compile_indexed(
    system: IndexedSystem,
    method: Method | str,
    *,
    solver: str = "fixed-point",
    flags: tuple[str, ...] = TUNED_FLAGS,
    prefix: str | None = None,
) -> IndexedStepper:
    """Derive, generate, compile and load the integrator of an indexed system.

    Args:
        system: the indexed system.
        method: the discretisation, or a name: ``"svi:4"``, ``"stoermer-verlet"``. Explicit methods and methods with a
            fixed-point iteration over stage positions (SVI, SC, Runge-Kutta) are supported.
        solver: solver of the stage equations: ``"fixed-point"``, or ``"newton"`` for stiff systems: Newton-GMRES with
            Jacobian-vector products of the forces, preconditioned by the diagonal of the Jacobian or, on lattices, by
            its circulant (Fourier) average.
        flags: flags for the C compiler; the default is tuned to this processor.
        prefix: prefix of the C names; by default made from the names of system and method.

    Raises:
        BuildError: if there is no C compiler.
        MethodError: if the method or the solver is not supported.
    """
    sources = _IndexedSources(system, as_method(method, one_coordinate(system)), prefix, solver)
    return IndexedStepper(sources.plain, sources.interface, controlled=lambda: sources.controlled, flags=flags)


def generate_indexed(
    system: IndexedSystem, method: Method | str, *, solver: str = "fixed-point", prefix: str | None = None
) -> tuple[Source, IndexedInterface]:
    """Return the C source and its interface; arguments and errors as of :func:`compile_indexed`."""
    sources = _IndexedSources(system, as_method(method, one_coordinate(system)), prefix, solver)
    return sources.plain, sources.interface


class _IndexedSources:
    """C sources of one integrator, derived on first use."""

    def __init__(self, system: IndexedSystem, method: Method, prefix: str | None, solver: str) -> None:
        check_solver(solver)
        self.system, self.method, self.solver = system, method, solver
        self.prefix = c_identifier(prefix or f"{system.name}_{method.name}")

    @property
    def interface(self) -> IndexedInterface:
        """Interface of the generated library."""
        return replace(
            _interface(self.system, self.method, self.prefix),
            solver="rattle" if self.system.constraints else self.solver,
        )

    @cached_property
    def program(self) -> Program:
        """Lowered program with fixed step size."""
        with announced(f"deriving the equations of {self.system.name} by {self.method.name}"):
            return lower_arrays(self.system, self.method, self.prefix, newton=self.solver == "newton")

    @cached_property
    def plain(self) -> Source:
        """C source with fixed step size."""
        return Source.from_json(self._remembered("indexed", lambda: render(self.program).to_json()))

    @cached_property
    def controlled(self) -> Source | None:
        """C source with adaptive steps; ``None`` if the method has no error estimate."""

        def text() -> str:
            control = control_of(self.program)
            return render(self.program, control).to_json() if control else ""

        found = self._remembered("indexed controlled", text)
        return Source.from_json(found) if found else None

    def _remembered(self, what: str, make: Callable[[], str]) -> str:
        return cached_source((*self.system.key(), *self.method.key(), self.prefix, self.solver, what), make)


def _interface(system: IndexedSystem, method: Method, prefix: str) -> IndexedInterface:
    return IndexedInterface(
        prefix=prefix,
        title=f"{system.name}: {method.title}",
        system=system.name,
        method=method.name,
        sizes=system.sizes,
        coordinates=system.coordinates,
        momenta=system.momenta,
        fields=system.fields,
        tables=system.tables,
        parameters=tuple(parameter.name for parameter in system.parameters),
        defaults=system.defaults,
        field_defaults=system.field_defaults,
        maps=momentum_maps(system),
        accesses=system.accesses,
        depends_on_time=system.depends_on_time,
        inputs=system.inputs,
        constraints=tuple(term.loops for term in system.constraints),
        conserves_energy=not (system.momenta or system.changes_energy or system.inputs),
        continued=not (method.fractions or system.constraints),
    )
