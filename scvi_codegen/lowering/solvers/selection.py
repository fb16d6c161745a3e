"""Choice of the fixed-point solver for a method and a system.

All of them iterate on kernels at points that are the lanes of one vector, without a Newton matrix:
:mod:`~scvi_codegen.lowering.solvers.points` on positions, :mod:`~scvi_codegen.lowering.solvers.points` on
velocities, :mod:`~scvi_codegen.lowering.solvers.points` on momenta and velocities,
:mod:`~scvi_codegen.lowering.solvers.curves` on accelerations, :mod:`~scvi_codegen.lowering.solvers.curves` on
accelerations and multipliers.
"""

from __future__ import annotations

from collections.abc import Sequence

from scvi_codegen.errors import MethodError
from scvi_codegen.ir.equations import FixedPointIteration, Splitting
from scvi_codegen.ir.kernel import lower_vector
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.solvers.curves import position_iteration, printed_iteration, shooting_iteration
from scvi_codegen.lowering.solvers.points import coupled_iteration, hamiltonian_iteration, separable_iteration
from scvi_codegen.lowering.solvers.tables import Solver, StepProblem
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.legendre import equivalent_lagrangian
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.leapfrog_stages import kicks_and_drifts
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import StageSystem
from scvi_codegen.tables.precision import mp

FIXED_POINTS: tuple[Solver, ...] = (
    separable_iteration,
    hamiltonian_iteration,
    coupled_iteration,
    position_iteration,
    printed_iteration,
    shooting_iteration,
)
"""Fixed-point solvers, the fastest first; the first that is applicable is used."""


def iteration_of(
    system: MechanicalSystem, stages: StageSystem, *, velocities: bool = False
) -> FixedPointIteration | None:
    """Return the fixed-point iteration of the stage equations of a system, or ``None`` if there is none.

    With ``velocities`` it has a table of those at the points, on which forces depend.
    """
    if system.constraints:
        return None
    problem = StepProblem(system, stages.shape)
    if velocities:
        return separable_iteration(problem, velocities=True)
    return next((fixed_point for solver in FIXED_POINTS if (fixed_point := solver(problem)) is not None), None)


def check_solver(
    solver: str, method: Method, names: Sequence[str], *, found: FixedPointIteration | Splitting | None
) -> None:
    """Raise :class:`MethodError` for an unknown solver, or one that this method and system do not have."""
    if solver not in names:
        raise MethodError(f"unknown solver {solver!r}: use one of {', '.join(names)}")
    if solver == "explicit" and found is None:
        raise MethodError(f"{method.name} is not explicit for this system: use solver='auto'")
    if solver == "fixed-point" and found is None:
        raise MethodError(
            f"{method.name} has no fixed-point iteration for this system: use solver='auto' or 'newton', "
            "or at most 32 points (an SVI: at least as many as its degree; a variational SCVI: at most 8 coordinates)"
        )


def splitting_of(system: MechanicalSystem, method: Method) -> Splitting | None:
    """Return the sequence of kicks and drifts, or ``None`` if the method is implicit."""
    if not method.fractions or system.constraints:
        return None
    twin = equivalent_lagrangian(system)
    by_masses = twin is not None and forms_of(twin).separable
    if not by_masses and not forms_of(system).split:
        return None
    moved = twin if twin is not None and by_masses else system
    forms = forms_of(moved)
    kicks, drifts = kicks_and_drifts(method)
    if by_masses:
        drift = system_kernel(moved, "mass", forms.mass.values(), of=(), purpose="The constant masses.")
    else:
        drift = system_kernel(moved, "drift_velocity", forms.legendre, of=moved.auxiliaries, purpose="H_p at u = p.")
    return Splitting(
        kicks=lower_vector(kicks),
        drifts=lower_vector(drifts),
        abscissae=lower_vector(tuple(mp.fsum(drifts[:n]) for n in range(len(kicks)))),
        force=system_kernel(moved, "force", forms.force, of=moved.coordinates, purpose="L_q at u = q."),
        drift=drift,
        by_masses=by_masses,
    )
