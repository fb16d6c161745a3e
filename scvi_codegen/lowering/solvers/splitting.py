"""The explicit solver: kicks and drifts in turn, for Stoermer-Verlet and its compositions on separable systems."""

from __future__ import annotations

from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.rounding import lower_vector
from scvi_codegen.ir.sweeps import Splitting
from scvi_codegen.mechanics.forms import force, is_separable, mass_entries
from scvi_codegen.mechanics.hamiltonian import lagrangian_twin
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.composition import Composition, kicks_and_drifts
from scvi_codegen.methods.galerkin import StoermerVerlet
from scvi_codegen.methods.method import Method
from scvi_codegen.tables.precision import mp

__all__ = ["splitting_of"]


def splitting_of(system: MechanicalSystem, method: Method) -> Splitting | None:
    """The sequence of kicks and drifts, or ``None`` where the method is implicit."""
    if isinstance(method, StoermerVerlet):
        method = Composition(2)
    twin = lagrangian_twin(system) if isinstance(method, Composition) else None
    if twin is None or not is_separable(twin):
        return None
    assert isinstance(method, Composition)  # or there would be no twin
    kicks, drifts = kicks_and_drifts(method.fractions)
    common = {"time": system.time, "parameters": system.parameters}
    mass = mass_entries(twin)
    return Splitting(
        kicks=lower_vector(kicks),
        drifts=lower_vector(drifts),
        abscissae=lower_vector(tuple(mp.fsum(drifts[:n]) for n in range(len(kicks)))),
        force=lower_kernel("force", arguments=system.coordinates, values=force(twin), **common),
        mass=lower_kernel("mass", arguments=(), values=tuple(mass.values()), **common),
    )
