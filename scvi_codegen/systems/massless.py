"""Massless bodies between joints: coordinates without kinetic energy whose velocities the constraints determine.

Where M = L_vv is singular, momenta alone do not determine velocities. With the rates G v + g_t = 0 of the constraints
they do if v = 0 is the only velocity with M v = 0 and G v = 0; then the saddle-point matrix [M, G^T; G, 0] of the stage
equations is regular, too, and only the Legendre transform and its mass matrix need a remedy, the gauge energy

    U = s/2 |G v + g_t|^2,        M' = M + s G^T G,

with the sum s of the masses: M' is positive definite where M is positive semidefinite. Along trajectories L + U has
the momenta, the energy and the constraint forces of L: U is quadratic in rates that are 0 there. Stage equations are
those of L itself, so that steps are the limits of those of small masses. (M. Benzi, G. H. Golub, J. Liesen, Numerical
solution of saddle point problems, Acta Numerica 14 (2005), section 3.)
"""

from typing import TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr

from scvi_codegen.systems.constraints import constraint_jacobian, constraint_rates
from scvi_codegen.systems.derived_expressions import DEPENDENT, dense, sample_points, unit_rows, values_at
from scvi_codegen.systems.formulas.expressions import hessian
from scvi_codegen.systems.system import MechanicalSystem

Array: TypeAlias = NDArray[np.float64]
SHARE = 1e-6
"""Smallest entry of a motion of length 1 by which a coordinate takes part in it, and smallest rate of a constraint that
hinders it."""


def gauge_of_rates(system: MechanicalSystem) -> tuple[Expr, tuple[str, ...]]:
    """Return U of the constraints that hinder massless motions, and the coordinates that move in the others.

    The sum of masses is that of the constant ones, if there are any. U is 0 without masses, and if the formulas have no
    value at any sampled point.
    """
    mass, jacobian = hessian(system.lagrangian, system.velocities), constraint_jacobian(system)
    rates = constraint_rates(system)
    diagonal = [entry for (i, j), entry in mass.items() if i == j]
    constant = [entry for entry in diagonal if entry.free_symbols <= set(system.parameters)]
    m = system.dimension
    points = sample_points(system.velocities, (*system.coordinates, system.time), system.constants)
    for values in values_at(points, [*mass.values(), *jacobian.values()]):
        motions = _null_space(unit_rows(dense(mass, values[: len(mass)], (m, m))))
        hindered = unit_rows(dense(jacobian, values[len(mass) :], (len(rates), m))) @ motions
        used = [rate for rate, row in zip(rates, hindered, strict=True) if np.abs(row).max(initial=0.0) > SHARE]
        moving = np.abs(motions @ _null_space(hindered)).max(axis=1, initial=0.0) > SHARE
        free = tuple(q.name for q, moves in zip(system.coordinates, moving, strict=True) if moves)
        return sympy.Add(*(constant or diagonal)) / 2 * sympy.Add(*(rate**2 for rate in used)), free
    return sympy.S.Zero, ()


def _null_space(matrix: Array) -> Array:
    """Return an orthonormal basis of the null space of a matrix whose rows have length 1 at most, as columns."""
    _, values, right = np.linalg.svd(matrix)
    return right[np.count_nonzero(values > DEPENDENT) :].T
