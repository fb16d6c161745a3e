"""Which momentum maps a method conserves exactly."""

from __future__ import annotations

from scvi_codegen.mechanics.symmetry.symmetry import Symmetry
from scvi_codegen.methods.collocation import RungeKutta
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.galerkin import SVI, StoermerVerlet
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.shooting import SCVI
from scvi_codegen.tables.spaces import Polynomials

__all__ = ["is_exact"]


def is_exact(symmetry: Symmetry, method: Method) -> bool:
    """Whether the method conserves the momentum map exactly, that is to round-off, for every step.

    A variational method of degree s does if the symmetry maps its curves to each other (A constant, b of degree s in
    t) and its quadrature is exact for df/dt along them (of degree d s + k - 1 for terms t^k q^d of f): then L_d changes
    by what f does from end to end. Stoermer-Verlet does if, in addition, f is linear in q. Runge-Kutta methods in phase
    space conserve what is linear in (t, q, p), symplectic ones what is quadratic. Of others nothing is claimed: a map
    may be conserved nevertheless.
    """
    terms = symmetry.degrees()
    if terms is None:
        return False
    if max(sum(powers) for powers in terms) <= _conserved_degree(method):
        return True
    if isinstance(method, StoermerVerlet | Composition) and any(d == 2 and e == 0 for _, d, e in terms):
        return False
    degree, order = _curves(method)
    return all(_is_kept(k, d, e, degree, order) for k, d, e in terms)


def _is_kept(k: int, d: int, e: int, degree: int, order: int) -> bool:
    """Whether a term t^k q^d p^e is one of the direction (e = 1) or gauge (e = 0) that the curves allow."""
    if e == 0:
        return d * degree + k <= order
    return e == 1 and ((d == 0 and k <= degree) or (d == 1 and k == 0 <= degree))


def _conserved_degree(method: Method) -> int:
    """Degree of the polynomials in (t, q, p) that are conserved exactly whenever they are conserved."""
    if isinstance(method, RungeKutta) and method.form == "phase-space":
        return 2 if method.symplectic else 1
    if isinstance(method, SVI) and isinstance(method.curves, Polynomials) and len(method.rule) == method.degree:
        return 2 if method.rule.order == 2 * method.degree else 0
    return 0


def _curves(method: Method) -> tuple[int, int]:
    """Degree of the curves and order of the quadrature of a variational method; (-1, -1) for others."""
    if not method.symplectic:
        return -1, -1
    if isinstance(method, RungeKutta):
        stages = len(method.tableau.b)
        return (stages, 2 * stages) if method.tableau.order == 2 * stages else (-1, -1)
    if isinstance(method, SVI):
        return (method.degree, method.rule.order) if isinstance(method.curves, Polynomials) else (0, -1)
    if isinstance(method, SCVI):
        return method.degree, method.rule.order
    return 1, 2
