"""Which fixed-point solver serves a method and a system.

All of them iterate on kernels at points that are the lanes of one vector, without a Newton matrix:
:mod:`~scvi_codegen.lowering.solvers.separable` on positions, :mod:`~scvi_codegen.lowering.solvers.coupled` on
velocities, :mod:`~scvi_codegen.lowering.solvers.hamiltonian` on momenta and velocities,
:mod:`~scvi_codegen.lowering.solvers.collocation` on accelerations, :mod:`~scvi_codegen.lowering.solvers.shooting` on
accelerations and multipliers.
"""

from __future__ import annotations

from collections.abc import Sequence

from scvi_codegen.errors import MethodError
from scvi_codegen.ir.sweeps import Splitting, Sweep
from scvi_codegen.lowering.solvers.collocation import position_sweep, printed_sweep
from scvi_codegen.lowering.solvers.coupled import coupled_sweep
from scvi_codegen.lowering.solvers.hamiltonian import hamiltonian_sweep
from scvi_codegen.lowering.solvers.separable import separable_sweep
from scvi_codegen.lowering.solvers.shooting import shooting_sweep
from scvi_codegen.lowering.solvers.velocity_tables import velocity_tables
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.hamiltonian import lagrangian_twin
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.collocation import RungeKutta, SpectralCollocation
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.shooting import SCVI

__all__ = ["check_solver", "sweep_of"]


def sweep_of(system: MechanicalSystem, method: Method) -> Sweep | None:
    """The fixed-point iteration of a method for a system, or ``None`` where there is none.

    Of a Hamiltonian its own, but for separable ones and where the method has none for it: then the one of its
    Lagrangian, if there is one. The step is the same (35f).
    """
    twin = lagrangian_twin(system)
    if system.auxiliaries and not (twin and forms_of(twin).separable):
        tables = velocity_tables(system, method)
        own = hamiltonian_sweep(system, tables) if tables else None
        if own is not None:
            return own
    return None if twin is None else _lagrangian_sweep(twin, method)


def _lagrangian_sweep(system: LagrangianSystem, method: Method) -> Sweep | None:
    if isinstance(method, SCVI) and method.degree > 1:
        return shooting_sweep(system, method) if method.variational else printed_sweep(system, method)
    separable = forms_of(system).separable
    if isinstance(method, RungeKutta | SpectralCollocation) and method.form == "position" and not separable:
        return position_sweep(system, method.tableau)
    tables = velocity_tables(system, method)
    if tables is None:
        return None
    return separable_sweep(system, tables) if separable else coupled_sweep(system, tables)


def check_solver(solver: str, method: Method, names: Sequence[str], *, found: Sweep | Splitting | None) -> None:
    """Raise :class:`MethodError` for a solver that does not exist, or was not ``found`` for this method and system."""
    if solver not in names:
        raise MethodError(f"there is no solver {solver!r}; there are {', '.join(names)}")
    if solver == "explicit" and found is None:
        raise MethodError(f"{method.name} is not explicit for this system; use solver='auto'")
    if solver == "fixed-point" and found is None:
        raise MethodError(
            f"{method.name} has no fixed-point iteration for this system; use solver='auto' or 'newton', "
            "or at most 32 points, for an SVI at least as many as its degree, for a variational SCVI 8 coordinates"
        )
