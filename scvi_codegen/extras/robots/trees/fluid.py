"""Forces of a medium of a density rho and a viscosity beta on bodies, by MuJoCo's models.

Of a box with the edges b, of the mass and inertia of the body: f_i = -3 pi beta m v_i - rho/2 b_j b_k |v_i| v_i and the
torque -pi beta m^3 w_i - rho/64 b_i (b_j^4 + b_k^4) |w_i| w_i, with the mean m of b. Of ellipsoids: added mass, drag,
the lift of Magnus and of Kutta and Joukowski. https://mujoco.readthedocs.io/en/stable/computation/fluid.html
"""

import numpy as np
import scipy
from sympy import Abs, Expr, Matrix, sqrt

from scvi_codegen.api.formulas import Intermediate
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.extras.robots.trees.energies import TINY, exact_number, exact_vector
from scvi_codegen.extras.robots.trees.tree import Vector, about

MOST_TURNS = 500
"""Rotations of Jacobi's method, which takes fewer than ten."""


def box(edges: Vector, rho: float, beta: float, w: Matrix, v: Matrix) -> list[Expr]:
    """Return torque and force on a box at the angular velocity and velocity in its axes."""
    mean, j, k = edges.mean(), np.roll(edges, -1), np.roll(edges, -2)
    linear = np.repeat([np.pi * beta * mean**3, 3 * np.pi * beta * mean], 3)
    square = (*(rho / 64 * edges * (j**4 + k**4)), *(rho / 2 * j * k))
    factors = zip(map(exact_number, linear), map(exact_number, square), (*w, *v), strict=True)
    return [-(a + b * Abs(x)) * x for a, b, x in factors]


def ellipsoid(r: Vector, coefficients: Vector, rho: float, beta: float, w: Matrix, v: Matrix) -> list[Expr]:
    """Return torque and force on an ellipsoid with the half axes r.

    Coefficients are those of blunt, slender and angular drag, and of the lifts of Kutta and Magnus. Added masses are
    rho V k_i/(2 - k_i) with k_i = integral of r_i r_j r_k/((r_i^2 + l)^3 (r_j^2 + l) (r_k^2 + l))^(1/2) over l > 0.
    """
    number, (blunt, slender, angular, kutta, magnus) = exact_number, coefficients
    j, k, volume, (_, middle, largest) = np.roll(r, -1), np.roll(r, -2), 4 / 3 * np.pi * r.prod(), np.sort(r)
    share, across, d = 2 / 3 * r.prod() * scipy.special.elliprd(j**2, k**2, r**2), j**2 - k**2, 2 / 3 * r.sum()
    apart = np.abs(np.roll(share, -1) - np.roll(share, -2))
    below = np.maximum(np.abs(2 * np.abs(across) - (j**2 + k**2) * apart), 1e-14)  # as MuJoCo, 0 of equal axes
    swept, most = 8 / 15 * np.pi * r * np.maximum(j, k) ** 4, 8 / 15 * np.pi * middle * largest**4
    pull, spin, normal, drag = (
        exact_vector(values).multiply_elementwise(along)
        for values, along in (
            (rho * volume * share / (2 - share), v),
            (rho * volume / 5 * across**2 * apart / below, w),
            ((j * k) ** 2, v),
            (angular * swept + slender * (most - swept), w),
        )
    )
    speed, top, bottom = sqrt(v.dot(v) + TINY), normal.dot(v), normal.dot(normal) + TINY
    area = Intermediate.named(number(np.pi) * sqrt(bottom / (top + TINY)))  # across the velocity
    resistance = number(slender * np.pi * largest * middle) + number(blunt - slender) * area
    force = pull.cross(w) - (number(3 * np.pi * beta * d) + number(rho) * speed * resistance) * v
    force += number(magnus * rho * volume) * w.cross(v)
    force += number(kutta * rho) * area * top / (speed * bottom) * normal.cross(v).cross(v)
    turning = number(np.pi * beta * d**3) + number(rho) * sqrt(drag.dot(drag) + TINY)
    return [*(pull.cross(v) + spin.cross(w) - turning * w), *force]


def principal_axes(matrix: Vector) -> Vector:
    """Return principal axes by Jacobi's rotations from the axes of a matrix, as MuJoCo does, also for equal moments."""
    turn = np.eye(3)
    for _ in range(MOST_TURNS):
        inner = turn.T @ matrix @ turn
        k = max(range(3), key=lambda axis: abs(inner[axis - 2, axis - 1]))
        off, apart = inner[k - 2, k - 1], inner[k - 2, k - 2] - inner[k - 1, k - 1]
        angle = np.arctan2(2 * off * np.copysign(1, apart), abs(apart)) / 2
        if not (abs(off) > 1e-12 and 1 - np.cos(angle) > 1e-12):
            return turn
        turn = turn @ about(np.eye(3)[k], angle)
    raise SystemDefinitionError(f"Jacobi's rotations to the principal axes of {matrix.tolist()} do not converge")
