"""Lowering of systems of arrays to a program: kernels of terms, and the tables of one coordinate.

Since masses are constant, the tables of a method are the same for every coordinate, so that those of a system of one
coordinate serve all.
"""

from __future__ import annotations

from scvi_codegen.errors import MethodError, ScviCodegenError
from scvi_codegen.ir.iterations import HamiltonianIteration, SeparableIteration
from scvi_codegen.ir.program import Layout, Program
from scvi_codegen.lowering.constraints import constrained_steps
from scvi_codegen.lowering.kernels import comment_text
from scvi_codegen.lowering.loops import looped_terms
from scvi_codegen.lowering.program import notes_of
from scvi_codegen.lowering.solvers.points import separable_iteration
from scvi_codegen.lowering.solvers.selection import iteration_of, splitting_of
from scvi_codegen.lowering.solvers.tables import StepProblem
from scvi_codegen.mechanics.arrays.system import ArraySystem
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.methods.method import Method

__all__ = ["SOLVERS", "check_solver", "lower_arrays", "one_coordinate"]

SOLVERS = ("fixed-point", "newton")
"""Solvers of the equations of a step of an array system."""


def check_solver(solver: object, error: type[ScviCodegenError] = MethodError) -> None:
    """Raise an error unless the solver is one of :data:`SOLVERS`."""
    if solver not in SOLVERS:
        raise error(f"unknown solver {solver!r} of an array system: use {' or '.join(map(repr, SOLVERS))}")


def one_coordinate(system: ArraySystem) -> MechanicalSystem:
    """Return a system with one coordinate and the same form, from which a method's tables are taken."""
    if system.momenta:
        hamiltonian = "(x**2 + p_x**2)**2"  # of no special form
        return HamiltonianSystem.from_text(name=system.name, coordinates=["x"], hamiltonian=hamiltonian)
    return LagrangianSystem.from_text(name=system.name, coordinates=["x"], lagrangian="x_dot**2/2 - x**2/2")


def lower_arrays(system: ArraySystem, method: Method, prefix: str, *, newton: bool = False) -> Program:
    """Return the program of a system by a method, by fixed-point iteration or Newton's method.

    Raises:
        MethodError: for a method that is neither explicit nor solved by fixed-point iteration over positions.
    """
    one = one_coordinate(system)
    constrained = constrained_steps(system, discretise(one, method), method) if system.constraints else None
    splitting = None if constrained else splitting_of(one, method)
    if splitting and system.velocities:
        raise MethodError(
            f"{method.name} does not support velocity-dependent forces of array systems: use an SVI or a "
            "Runge-Kutta method"
        )
    loops = looped_terms(system, constrained, newton=newton)
    if newton and (splitting or constrained or system.momenta or system.velocities or not loops.products):
        raise MethodError(
            "Newton's method for array systems requires a Lagrangian with a potential that is not linear, forces of "
            "positions and time, no constraints, and an implicit method: leave out solver='newton'"
        )
    fixed_point = None if splitting or constrained else _fixed_point(one, method, velocities=bool(system.velocities))
    layout = Layout(
        coordinates=system.coordinates,
        momenta=system.momenta,
        velocities=system.velocities,
        fields=system.fields,
        tables=system.tables,
        sizes=system.sizes,
        parameters=tuple(parameter.name for parameter in system.parameters),
        defaults=system.defaults,
    )
    return Program(
        prefix=prefix,
        title=comment_text(f"{system.name}: {method.title}"),
        notes=notes_of(method, one),
        order=method.order or (fixed_point.points if fixed_point else 0),
        layout=layout,
        fixed_point=fixed_point,
        splitting=splitting,
        polynomial_curves=fixed_point is not None and (fixed_point.points > 1 or not system.velocities),
        loops=loops,
    )


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
        f"{method.name} is not supported for array systems: use an SVI, a Runge-Kutta method of at "
        f"most 32 points{explicit}"
    )
