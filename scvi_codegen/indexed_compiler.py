"""From a Lagrangian of sums over indices to a compiled integrator of any number of coordinates.

    IndexedSystem  x  Method
      -> lower       IndexedProgram  kernels of terms, tables of one coordinate (:mod:`scvi_codegen.lowering.indexed`)
      -> render      Source          loops around kernels (:mod:`scvi_codegen.rendering.indexed`)
      -> IndexedStepper              runs over arrays (:mod:`scvi_codegen.runtime.indexed_stepper`)

Neither the length of the text nor the time to compile it depends on the number of coordinates.
"""

from __future__ import annotations

from scvi_codegen.compiler import c_identifier
from scvi_codegen.kinds import TEXT, TEXTS, takes
from scvi_codegen.lowering.indexed import lower_indexed, one_coordinate
from scvi_codegen.mechanics.indexed.symmetry import momentum_maps
from scvi_codegen.mechanics.indexed.system import INDEXED, IndexedSystem
from scvi_codegen.methods import as_method
from scvi_codegen.methods.method import Method
from scvi_codegen.native.building import TUNED_FLAGS
from scvi_codegen.native.waiting import waiting_for
from scvi_codegen.rendering.indexed import render_indexed
from scvi_codegen.rendering.source import Source
from scvi_codegen.rendering.text_cache import remembered_text
from scvi_codegen.runtime.indexed_interface import IndexedInterface
from scvi_codegen.runtime.indexed_stepper import IndexedStepper

__all__ = ["compile_indexed", "generate_indexed"]


@takes(system=INDEXED, flags=TEXTS, prefix=TEXT)
def compile_indexed(
    system: IndexedSystem,
    method: Method | str,
    *,
    flags: tuple[str, ...] = TUNED_FLAGS,
    prefix: str | None = None,
) -> IndexedStepper:
    """Derive, generate, compile and load the integrator of sums over indices.

    Args:
        system: what moves.
        method: how its motion is discretised, or a name: ``"svi:4"``, ``"stoermer-verlet"``. Explicit methods, and
            those whose equations sweeps over positions solve: SVI, SC, Runge-Kutta.
        flags: for the C compiler; by default tuned to this processor.
        prefix: of the C names; by default made from the names of system and method.

    Raises:
        BuildError: if there is no C compiler.
        MethodError: for a method without such sweeps.
    """
    return IndexedStepper(*generate_indexed(system, method, prefix=prefix), flags=flags)


def generate_indexed(
    system: IndexedSystem, method: Method | str, *, prefix: str | None = None
) -> tuple[Source, IndexedInterface]:
    """The C text, and what a caller must know of it; arguments and errors as of :func:`compile_indexed`."""
    one = one_coordinate(system)
    chosen = as_method(method, one)
    name = c_identifier(prefix or f"{system.name}_{chosen.name}")

    def text() -> str:
        with waiting_for(f"deriving the equations of {system.name} by {chosen.name}"):
            return render_indexed(lower_indexed(system, chosen, name)).to_json()

    source = Source.from_json(remembered_text((*system.key(), *chosen.key(), name, "indexed"), text))
    return source, _interface(system, chosen, source)


def _interface(system: IndexedSystem, method: Method, source: Source) -> IndexedInterface:
    return IndexedInterface(
        prefix=source.prefix,
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
    )
