"""Explicit solver: alternating kicks and drifts, for Stoermer-Verlet and its compositions on separable systems."""

from __future__ import annotations

from scvi_codegen.ir.iterations import Splitting
from scvi_codegen.ir.numbers import lower_vector
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.hamiltonian import equivalent_lagrangian
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.composition import kicks_and_drifts
from scvi_codegen.methods.method import Method
from scvi_codegen.tables.precision import mp

__all__ = ["splitting_of"]


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
