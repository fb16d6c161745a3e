"""Lowering of indexed systems: kernels of terms, and the tables of one coordinate.

Since masses are constant, the tables of a method are the same for every coordinate, so that those of a system of one
coordinate serve all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from sympy import Add, S, Symbol

from scvi_codegen.errors import MethodError, ScviCodegenError
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.formulas.indexed import IndexedTerm
from scvi_codegen.formulas.indexed_forces import IndexedForce
from scvi_codegen.ir.indexed import IndexedProgram
from scvi_codegen.ir.iterations import HamiltonianIteration, SeparableIteration
from scvi_codegen.ir.kernel import LoopedKernel
from scvi_codegen.lowering.indexed_constraints import constrained_steps
from scvi_codegen.lowering.indexed_kernels import constants_of, kernel_of
from scvi_codegen.lowering.lattices import reach_of
from scvi_codegen.lowering.program import comment_text, notes_of
from scvi_codegen.lowering.solvers.base import StepProblem
from scvi_codegen.lowering.solvers.predictor_tables import control_of_iteration
from scvi_codegen.lowering.solvers.selection import iteration_of
from scvi_codegen.lowering.solvers.separable import separable_iteration
from scvi_codegen.lowering.solvers.splitting import splitting_of
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.indexed.masses import MassTerm
from scvi_codegen.mechanics.indexed.system import IndexedSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.methods.method import Method

__all__ = ["SOLVERS", "check_solver", "lower_indexed", "one_coordinate", "with_control"]

SOLVERS = ("fixed-point", "newton")
"""Solvers of the equations of a step of an indexed system."""


def check_solver(solver: object, error: type[ScviCodegenError] = MethodError) -> None:
    """Raise an error unless the solver is one of :data:`SOLVERS`."""
    if solver not in SOLVERS:
        raise error(f"unknown solver {solver!r} of an indexed system: use {' or '.join(map(repr, SOLVERS))}")


def one_coordinate(system: IndexedSystem) -> MechanicalSystem:
    """Return a system with one coordinate and the same form, from which a method's tables are taken."""
    if system.momenta:
        hamiltonian = "(x**2 + p_x**2)**2"  # of no special form
        return HamiltonianSystem.from_text(name=system.name, coordinates=["x"], hamiltonian=hamiltonian)
    return LagrangianSystem.from_text(name=system.name, coordinates=["x"], lagrangian="x_dot**2/2 - x**2/2")


def lower_indexed(system: IndexedSystem, method: Method, prefix: str, *, newton: bool = False) -> IndexedProgram:
    """Return the program of a system by a method, by fixed-point iteration or Newton's method.

    Raises:
        MethodError: for a method that is neither explicit nor solved by fixed-point iteration over positions.
    """
    one = one_coordinate(system)
    held = constrained_steps(system, discretise(one, method), method) if system.constraints else None
    splitting = None if held else splitting_of(one, method)
    if splitting and system.velocities:
        raise MethodError(
            f"{method.name} does not support velocity-dependent forces of indexed systems: use an SVI or a "
            "Runge-Kutta method"
        )
    kernels = [_force(system, term, number) for number, term in enumerate(system.potentials)]
    kernels += [_generalised_force(system, force, number) for number, force in enumerate(system.forces, len(kernels))]
    forces = tuple(kernels)
    products, diagonals = curvature(system) if newton else ((), ())
    if newton and (splitting or held or system.momenta or system.velocities or not products):
        raise MethodError(
            "Newton's method for indexed systems requires a Lagrangian with a potential that is not linear, forces of "
            "positions and time, no constraints, and an implicit method: leave out solver='newton'"
        )
    fixed_point = None if splitting or held else _fixed_point(one, method, velocities=bool(system.velocities))
    return IndexedProgram(
        prefix=prefix,
        title=comment_text(f"{system.name}: {method.title}"),
        notes=notes_of(method, one),
        order=method.order or (fixed_point.points if fixed_point else 0),
        sizes=system.sizes,
        coordinates=system.coordinates,
        momenta=system.momenta,
        velocities=system.velocities,
        fields=system.fields,
        tables=system.tables,
        parameter_names=tuple(parameter.name for parameter in system.parameters),
        parameter_defaults=system.defaults,
        forces=forces,
        masses=tuple(_mass(system, term, number) for number, term in enumerate(system.masses)),
        constants=tuple(_constant(system, term, number) for number, term in enumerate(system.energy_offsets)),
        fixed_point=fixed_point,
        splitting=splitting,
        held=held,
        products=products,
        diagonals=diagonals,
        reach=reach_of(system.coordinates, diagonals),
    )


def with_control(program: IndexedProgram) -> IndexedProgram | None:
    """Return the program with adaptive steps; ``None`` if there is no error estimate."""
    if program.fixed_point is None or not program.error_power:
        return None
    return replace(program, control=control_of_iteration(program.fixed_point))


def _fixed_point(
    one: MechanicalSystem, method: Method, *, velocities: bool
) -> SeparableIteration | HamiltonianIteration:
    stages = discretise(one, method)
    found = (
        separable_iteration(StepProblem(one, stages.shape), velocities=True)
        if velocities
        else iteration_of(one, stages)
    )
    if isinstance(found, SeparableIteration | HamiltonianIteration):
        return found
    explicit = "" if one.auxiliaries else ", Stoermer-Verlet or a composition"
    raise MethodError(
        f"{method.name} is not supported for indexed systems: use an SVI, a Runge-Kutta method of at "
        f"most 32 points{explicit}"
    )


def _force(system: IndexedSystem, term: IndexedTerm, number: int) -> LoopedKernel:
    arrays = dict(term.slots)
    u = [slot for slot, access in term.slots if access.array in system.state]
    partials = gradient(term.formula, u)
    signs = [-1 if arrays[slot].array in system.momenta else 1 for slot in u]  # of -H: -H_q and H_p
    values = [signs[place] * partials.get(place, S.Zero) for place in range(len(u))]
    looped = LoopedKernel(
        text=comment_text(str(term)),
        loops=term.loops,
        slots=tuple(arrays[slot] for slot in u),
        targets=tuple(arrays[slot] for slot in u),
        given=constants_of(term.slots, u),
        kernel=kernel_of(
            system, f"force_{number}", values, term.slots, u, "Derivatives with respect to its coordinates."
        ),
    )
    scalar = kernel_of(system, f"term_{number}", [term.formula], term.slots, u, "The term.")
    return replace(looped, scalar=scalar)


def _generalised_force(system: IndexedSystem, force: IndexedForce, number: int) -> LoopedKernel:
    """Return the kernel of a generalised force."""
    moving = (*system.state, *system.velocities)
    u = [slot for slot, access in force.slots if access.array in moving]
    values = [formula for _, formula in force.targets]
    return LoopedKernel(
        text=comment_text(f"forces {force}"),
        loops=force.loops,
        slots=tuple(access for slot, access in force.slots if slot in u),
        targets=tuple(access for access, _ in force.targets),
        given=constants_of(force.slots, u),
        kernel=kernel_of(system, f"force_{number}", values, force.slots, u, "Forces."),
    )


def curvature(system: IndexedSystem) -> tuple[tuple[LoopedKernel, ...], tuple[LoopedKernel, ...]]:
    """Return the Jacobian of the forces times a direction, and its diagonal, by term groups."""
    found = [_derived(system, term, number) for number, term in enumerate(_all_forces(system))]
    pairs = [pair for pair in found if pair]
    return tuple(product for product, _ in pairs), tuple(diagonal for _, diagonal in pairs)


def _all_forces(system: IndexedSystem) -> Iterator[IndexedForce]:
    """Yield all forces, those of the potentials by their slots."""
    for term in system.potentials:
        moving = [(slot, access) for slot, access in term.slots if access.array in system.state]
        partials = gradient(term.formula, [slot for slot, _ in moving])
        targets = tuple((access, partials[k]) for k, (_, access) in enumerate(moving) if k in partials)
        yield IndexedForce(loops=term.loops, slots=term.slots, targets=targets)
    yield from system.forces


def _derived(system: IndexedSystem, force: IndexedForce, number: int) -> tuple[LoopedKernel, LoopedKernel] | None:
    """Return the kernels of a force for :func:`curvature`; ``None`` if it does not depend on positions."""
    moving = [(slot, access) for slot, access in force.slots if access.array in system.state]
    u, w = [slot for slot, _ in moving], [Symbol(f"{slot.name} along", real=True) for slot, _ in moving]
    rows = [gradient(formula, u) for _, formula in force.targets]
    if not any(rows):
        return None
    along = [Add(*(derivative * w[k] for k, derivative in row.items())) for row in rows]
    own = [
        Add(*(derivative for k, derivative in row.items() if moving[k][1] == access))
        for row, (access, _) in zip(rows, force.targets, strict=True)
    ]
    accesses, targets = tuple(access for _, access in moving), tuple(access for access, _ in force.targets)
    given, text = constants_of(force.slots, u), comment_text(f"derivatives of {force}")
    both = [*force.slots, *zip(w, accesses, strict=True)]
    product = LoopedKernel(
        text=text,
        loops=force.loops,
        slots=(*accesses, *accesses),
        targets=targets,
        given=given,
        kernel=kernel_of(
            system, f"product_{number}", along, both, [*u, *w], "Jacobian of the forces times a direction."
        ),
        along=len(accesses),
    )
    diagonal = LoopedKernel(
        text=text,
        loops=force.loops,
        slots=accesses,
        targets=targets,
        given=given,
        kernel=kernel_of(system, f"diagonal_{number}", own, force.slots, u, "Diagonal of the Jacobian of the forces."),
    )
    return product, diagonal


def _constant(system: IndexedSystem, term: IndexedTerm, number: int) -> LoopedKernel:
    return LoopedKernel(
        text=comment_text(str(term)),
        loops=term.loops,
        slots=(),
        targets=(),
        given=constants_of(term.slots, ()),
        kernel=kernel_of(system, f"constant_{number}", [term.formula], term.slots, (), "The term."),
    )


def _mass(system: IndexedSystem, term: MassTerm, number: int) -> LoopedKernel:
    return LoopedKernel(
        text=comment_text(f"mass of {term.access}"),
        loops=term.loops,
        slots=(),
        targets=(term.access,),
        given=constants_of(term.slots, ()),
        kernel=kernel_of(system, f"mass_{number}", [term.formula], term.slots, (), "A mass."),
    )
