"""Discretisation error of a path: its intervals in finer steps, and the response of all nodes to their defects.

An interval from (q0, p0), in ``FINER`` steps, ends at (q1 + dq, p1 + dp). Between the same positions the finer steps
have the momenta p0 - b dq and p1 + dp - e dq with b = dp0/dq1 and e = dp1/dq1, so that the residual of the discrete
Euler-Lagrange equations at a node is d = (dp - e dq) of the interval before it plus b dq of the one after it. The path
of the finer steps is at the distance -H^-1 d, with the Hessian H whose factors are those of the last Newton step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.api.states import RESOLVED, Array, roundoff
from scvi_codegen.common.errors import StepFailedError
from scvi_codegen.extras.paths.intervals import Intervals
from scvi_codegen.extras.paths.solver import Solution

FINER = 3
"""Number of steps by which each interval is solved again."""
OF_FINER = FINER**2 / (FINER**2 - 1.0)
"""Largest ratio of the error to the distance from the path of the finer steps, of a method of order 2 at least."""
NO_MOTION, ENERGY_OF_NO_MOTION = 0.1, 0.5
"""Discretisation error, and relative change of a conserved energy from node to node, from which a stationary point of
the discrete action is no path of the system, as one that passes through an attractive singularity."""


@dataclass(frozen=True, slots=True)
class Discretisation:
    """Comparison of a path with the motion of the system.

    Attributes:
        error: of positions relative to their largest range, or of momenta relative to the largest one of a velocity,
            whichever is larger, and the rounding error of both; infinite if a finer step fails.
        energy_change: range of the energy of the nodes relative to the largest p . v; 0 if it is not conserved.
    """

    error: float
    energy_change: float

    @property
    def is_motion(self) -> bool:
        """True if the path approximates a motion of the system."""
        return self.error < NO_MOTION and self.energy_change < ENERGY_OF_NO_MOTION


def discretisation_of(solution: Solution) -> Discretisation:
    """Return the discretisation error of a path and the change of its energy."""
    return Discretisation(_error(solution), _energy_change(solution))


def _error(solution: Solution) -> float:
    intervals, at, q = solution.intervals, solution.at, solution.q
    try:
        end, end_momenta = intervals.refined(q, at.p0, FINER)
    except StepFailedError:
        return np.inf
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
    position, momentum = (float(np.abs(changes).max(initial=0.0)) for changes in (nodes, impulses))
    return solution.size.error(OF_FINER * position, OF_FINER * momentum)


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
    rounding = RESOLVED * roundoff(1) * (np.abs(energies).max() + of_momenta)
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
        width = DIFFERENCE_INCREMENT * (float(np.abs(p).max()) or 1.0)
        momenta = p[k] + width * np.vstack([np.eye(m), -np.eye(m)])
        t = float(intervals.t[0]) + k * float(intervals.h[0])
        at = np.tile(q[k], (2 * m, 1)), momenta, np.full(2 * m, t), intervals.parameters_at_start
        velocities = np.asarray(stepper.velocity(*at))
        inverse = (velocities[:m] - velocities[m:]) / (2.0 * width)
        masses = np.array([intervals.tangent(k, row) for row in np.linalg.pinv(inverse, DIFFERENCE_INCREMENT)])
        masses = np.array([intervals.tangent(k, row) for row in masses.T])
        values = np.linalg.eigvalsh((masses + masses.T) / 2.0)
        if values[0] < -NEGATIVE * np.abs(values).max():
            return False
    return True


DIFFERENCE_INCREMENT, NEGATIVE = 1e-6, 1e-4
"""Increment of momenta relative to the largest one, and least negative part of the largest mass that is no rounding."""
