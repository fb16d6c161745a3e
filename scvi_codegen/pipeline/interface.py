"""Interfaces of generated integrators: names, sizes and features that the runtime needs."""

from __future__ import annotations

from sympy import Expr

from scvi_codegen.ir.program import Program
from scvi_codegen.mechanics.arrays.symmetry import momentum_maps
from scvi_codegen.mechanics.arrays.system import ArraySystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.rendering.program_source import workspace_size
from scvi_codegen.rendering.source import ArrayLayout, Interface


def describe(
    program: Program,
    system: MechanicalSystem,
    method: Method,
    *,
    uses_fallback_library: bool = False,
    g: str | Expr | None = None,
) -> Interface:
    """Return the interface of a program; ``uses_fallback_library``: a separate library has Newton's iteration."""
    return Interface(
        prefix=program.prefix,
        title=program.title,
        notes=program.notes,
        system=system.name,
        method=method.name,
        coordinates=program.layout.names,
        parameters=program.layout.parameters,
        defaults=program.layout.defaults,
        unknowns=program.equations.unknowns,
        workspace=workspace_size(program),
        has_action=program.action or (uses_fallback_library and program.equations.acts),
        map_names=tuple(each.name for each in program.quantities.momentum_maps),
        map_formulas=tuple(each.formula for each in program.quantities.momentum_maps),
        map_exact=tuple(each.exact for each in program.quantities.momentum_maps),
        has_fallback=uses_fallback_library or (program.newton and program.fixed_point is not None),
        momentum_names=tuple(momentum.name for momentum in system.momentum_symbols),
        time_transformation="" if g is None else str(g),
        exchange_names=program.quantities.work_and_impulses,
        constraints=program.constraints.formulas if program.constraints else (),
        inputs=system.inputs,
        conserves_energy=not system.changes_energy and not system.inputs,
        arrays=_arrays_of(system),
        rotations=tuple(each.declaration for each in system.rotations),
        energy_parameter=system.clock.energy.name if system.clock else "",
        solver=_solver_of(program),
    )


def _arrays_of(system: MechanicalSystem) -> tuple[str, ...]:
    """Return the declarations of the arrays whose entries are all of the coordinates, or parameters."""
    names = [each.name for each in (*system.coordinates, *system.parameters)]
    known = [array for array in system.arrays if set(array.elements) <= set(names)]
    listed = [name for array in known for name in array.elements]
    whole = listed[: system.dimension] == names[: system.dimension]
    return tuple(str(array) for array in known if array.axes or whole) if whole else ()


def _solver_of(program: Program) -> str:
    """Return the name of the solver that is tried first."""
    if program.splitting:
        return "explicit"
    return "rattle" if program.rattle else "fixed-point" if program.fixed_point else "newton"


def describe_arrays(system: ArraySystem, method: Method, *, prefix: str, solver: str) -> Interface:
    """Return the interface of an integrator of arrays whose sizes are known at run time."""
    layout = ArrayLayout(
        sizes=system.sizes,
        coordinates=system.coordinates,
        momenta=system.momenta,
        fields=system.fields,
        tables=system.tables,
        field_defaults=system.field_defaults,
        maps=momentum_maps(system),
        accesses=system.accesses,
        depends_on_time=system.depends_on_time,
        constraints=tuple(term.loops for term in system.constraints),
        continued=not (method.fractions or system.constraints),
    )
    return Interface(
        prefix=prefix,
        title=f"{system.name}: {method.title}",
        system=system.name,
        method=method.name,
        coordinates=tuple(array.name for array in system.coordinates),
        parameters=tuple(parameter.name for parameter in system.parameters),
        defaults=system.defaults,
        inputs=system.inputs,
        conserves_energy=not (system.momenta or system.changes_energy or system.inputs),
        solver="rattle" if system.constraints else solver,
        layout=layout,
    )
