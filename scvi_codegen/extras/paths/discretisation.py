"""Error of a path: the steps of a finer method along its intervals, and the response of all nodes to their defects.

It is the error of a run (:mod:`scvi_codegen.runs.accuracy.run_error`) with conditions at both ends instead of one. The
step of the finer method from (q0, p0) ends at (q1 + dq, p1 + dp). Between the same positions it has the momenta
p0 - b dq and p1 + dp - e dq with b = dp0/dq1 and e = dp1/dq1, so that the residual of the discrete Euler-Lagrange
equations at a node is d = (dp - e dq) of the interval before it plus b dq of the one after it. The path of the system
is at the distance -H^-1 d, with the Hessian H whose factors are those of the last Newton step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.api.runs import Products
from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import MethodError, StepFailedError
from scvi_codegen.extras.paths.intervals import Intervals
from scvi_codegen.extras.paths.size import INCREMENT, ROUNDOFF
from scvi_codegen.extras.paths.solver import Solution

NEGATIVE = 1e-4
"""Least negative part of the largest mass that is no rounding."""
ENERGY_OF_NO_MOTION = 0.5
"""Relative change of a conserved energy from node to node, from which a stationary point of
the discrete action is no path of the system, as one that passes through an attractive singularity."""


@dataclass(frozen=True, slots=True)
class Discretisation:
    """Comparison of a path with the motion of the system.

    Attributes:
        error: of positions relative to their largest range, or of momenta relative to the largest one of a velocity,
            whichever is larger, and the rounding error of both; infinite if a finer step fails, NaN if it is unknown.
        q, p: (N + 1, m) errors of positions and momenta with their signs, computed minus exact.
        reason: why the error is unknown, else empty.
        energy_change: range of the energy of the nodes relative to the largest p . v; 0 if it is not conserved.
    """

    energy_change: float
    error: float
    q: Array
    p: Array
    reason: str = ""

    @property
    def is_motion(self) -> bool:
        """True if the path approximates a motion of the system."""
        return not self.error >= Products.LOST and self.energy_change < ENERGY_OF_NO_MOTION


def discretisation_of(solution: Solution) -> Discretisation:
    """Return the errors of a path and the change of its energy."""
    intervals, at, q, change = solution.intervals, solution.at, solution.q, _energy_change(solution)
    lost = np.full_like(q, np.nan)
    try:
        end, end_momenta = intervals.finer_ends(q, at.p0)
    except StepFailedError as failure:
        return Discretisation(change, np.inf, lost, lost, str(failure))
    except MethodError as unknown:
        return Discretisation(change, np.nan, lost, lost, str(unknown))
    moved, kicked = (
        np.array([intervals.tangent(k, row) for k, row in enumerate(rows, 1)])
        for rows in (end - q[1:], end_momenta - at.p1)
    )
    own, before, other, after = at.blocks
    first, last = intervals.products(before, moved), kicked - intervals.products(after, moved)
    defects = last[:-1] + first[1:]
    if (M := intervals.symmetry) is not None:
        defects = np.concatenate([(intervals.basis_map(M).T @ last[-1] + first[0])[np.newaxis], defects])
    changes = -solution.factors.solve(defects)
    nodes = np.zeros((len(q), moved.shape[1]))
    if M is None:
        nodes[1:-1] = changes
    else:
        nodes[:-1], nodes[-1] = changes, intervals.basis_map(M) @ changes[0]
    ends = nodes[1:] - moved
    impulses = [
        intervals.products(own, nodes[:-1]) + intervals.products(before, ends),
        intervals.products(other, nodes[:-1]) + intervals.products(after, ends) + kicked,
    ]
    error = solution.size.error(*(float(np.abs(changes).max(initial=0.0)) for changes in (nodes, impulses)))
    momenta = [*impulses[0], impulses[1][-1]]
    errors = [np.array([-intervals.outward(k, row) for k, row in enumerate(rows)]) for rows in (nodes, momenta)]
    return Discretisation(change, error, errors[0], errors[1])


def _energy_change(solution: Solution) -> float:
    intervals, q, momenta = solution.intervals, solution.q, solution.momenta
    stepper: Any = intervals.stepper
    if not stepper.interface.conserves_energy or intervals.parameters.ndim == 2 or solution.at_rest:
        return 0.0
    t = np.append(intervals.t, intervals.t[-1] + intervals.h[-1])
    energies = stepper.energy(q, momenta, t, intervals.parameters)
    velocities = stepper.velocity(q, momenta, t, intervals.parameters)
    kinetic = np.abs(np.sum(momenta * velocities, axis=1)).max()
    of_momenta = np.abs(q).max() * np.abs(solution.at.blocks).max() * np.abs(velocities).max()
    rounding = Products.RESOLVED * ROUNDOFF * (np.abs(energies).max() + of_momenta)
    return float(max(np.ptp(energies) - rounding, 0.0) / kinetic) if kinetic else 0.0


def kinetic_energy_is_positive(intervals: Intervals, q: Array, p: Array) -> bool:
    """Return whether the kinetic energy is positive (semi-)definite along a path.

    The mass matrix is the inverse of dv/dp, by central differences at three nodes; its signature is that of all nodes,
    as the mass matrix of a regular Lagrangian has no eigenvalue 0. With constraints it is restricted to admissible
    velocities.
    """
    stepper: Any = intervals.stepper
    m = q.shape[1]
    for k in (0, len(q) // 2, len(q) - 1):
        width = INCREMENT * (float(np.abs(p).max()) or 1.0)
        momenta = p[k] + width * np.vstack([np.eye(m), -np.eye(m)])
        t = float(intervals.t[0]) + k * float(intervals.h[0])
        at = np.tile(q[k], (2 * m, 1)), momenta, np.full(2 * m, t), intervals.parameters_at_start
        velocities = np.asarray(stepper.velocity(*at))
        inverse = (velocities[:m] - velocities[m:]) / (2.0 * width)
        masses = np.array([intervals.tangent(k, row) for row in np.linalg.pinv(inverse, INCREMENT)])
        masses = np.array([intervals.tangent(k, row) for row in masses.T])
        values = np.linalg.eigvalsh((masses + masses.T) / 2.0)
        if values[0] < -NEGATIVE * np.abs(values).max():
            return False
    return True
