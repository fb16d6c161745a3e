"""Choice of the fixed-point solver for a method and a system.

All of them iterate on kernels at points that are the lanes of one vector, without a Newton matrix:
:mod:`~scvi_codegen.lowering.solvers.separable` on positions, :mod:`~scvi_codegen.lowering.solvers.coupled` on
velocities, :mod:`~scvi_codegen.lowering.solvers.hamiltonian` on momenta and velocities,
:mod:`~scvi_codegen.lowering.solvers.collocation` on accelerations, :mod:`~scvi_codegen.lowering.solvers.shooting` on
accelerations and multipliers.
"""

from __future__ import annotations

from collections.abc import Sequence

from scvi_codegen.errors import MethodError
from scvi_codegen.ir.iteration import FixedPointIteration
from scvi_codegen.ir.iterations import Splitting
from scvi_codegen.lowering.solvers.base import Solver, StepProblem
from scvi_codegen.lowering.solvers.collocation import position_iteration, printed_iteration
from scvi_codegen.lowering.solvers.coupled import coupled_iteration
from scvi_codegen.lowering.solvers.hamiltonian import hamiltonian_iteration
from scvi_codegen.lowering.solvers.separable import separable_iteration
from scvi_codegen.lowering.solvers.shooting import shooting_iteration
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import StageSystem

__all__ = ["FIXED_POINTS", "check_solver", "iteration_of"]

FIXED_POINTS: tuple[Solver, ...] = (
    separable_iteration,
    hamiltonian_iteration,
    coupled_iteration,
    position_iteration,
    printed_iteration,
    shooting_iteration,
)
"""Fixed-point solvers, the fastest first; the first that is applicable is used."""


def iteration_of(system: MechanicalSystem, stages: StageSystem) -> FixedPointIteration | None:
    """Return the fixed-point iteration of the stage equations of a system, or ``None`` if there is none."""
    if system.constraints:
        return None
    problem = StepProblem(system, stages.shape)
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
