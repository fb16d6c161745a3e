"""Systems of arrays of run-time sizes: the system whose tables serve all coordinates, and the available solvers."""

from scvi_codegen.codegen.ir.equations import ConstrainedSteps, FixedPointIteration, Splitting
from scvi_codegen.codegen.ir.program import RolledTerms
from scvi_codegen.common.errors import MethodError, ScviCodegenError, SizesRequiredError
from scvi_codegen.methods.method import Method
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.system import MechanicalSystem

SOLVERS = ("fixed-point", "newton")
"""Solvers of the equations of a step of an array system."""
UNSUPPORTED = (
    " is not supported for array systems: use an SVI, a Runge-Kutta method of at most 32 points, or with a Lagrangian "
    "'stoermer-verlet' or a composition"
)


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


def check_solver_of_arrays(
    system: ArraySystem,
    method: Method,
    solver: str,
    resolved: Splitting | ConstrainedSteps | FixedPointIteration | None,
    loops: RolledTerms,
) -> None:
    """Raise an error unless a method and a solver are available for an array system of run-time sizes.

    Args:
        solver: one of :data:`SOLVERS`.
        resolved: what the method becomes for the system with one coordinate; ``None`` if it is not available.
        loops: the terms in loops, with the eigenvectors of the method's matrix (``shifts``) if Newton's method can use
            them.

    Raises:
        MethodError: for splittings of a system whose forces depend on velocities.
        SizesRequiredError: for what is available if the sizes are known.
    """
    if isinstance(resolved, Splitting) and system.velocities:
        raise MethodError(
            f"{method.name} does not support velocity-dependent forces of array systems: use an SVI or a "
            "Runge-Kutta method"
        )
    is_iterated = isinstance(resolved, FixedPointIteration) and resolved.name in ("separable", "Hamiltonian")
    has_newton = is_iterated and loops.shifts is not None and not system.neighbours
    if solver == "newton" and not has_newton:
        raise SizesRequiredError(
            "Newton's method for array systems requires forces that are not constant, no constraints, no lists of "
            "neighbours, and an implicit method whose matrix has a basis of eigenvectors (for a Hamiltonian and for "
            "forces of velocities one with the same table for positions and momenta, as SVI and Gauss): leave out "
            "solver='newton'"
        )
    is_available = is_iterated or isinstance(resolved, Splitting | ConstrainedSteps)
    if not is_available:
        raise SizesRequiredError(method.name + UNSUPPORTED)
