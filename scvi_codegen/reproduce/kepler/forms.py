"""SCVI as printed and in variational form on Kepler's problem: runs, and the structure of one step.

With two points both are the same map. With more, the printed (34d) and (34e) lack the chain-rule term: see the
experiment ``correction``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods import SCVI
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.kepler.exact_flow import SYSTEM, angular_momentum, perihelion, perihelion_turn
from scvi_codegen.reproduce.kepler.step import structure_of
from scvi_codegen.reproduce.laboratory.experiment import Comparison, TableBlock, holds
from scvi_codegen.reproduce.laboratory.running import SECTION_4, trajectory
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

__all__ = [
    "ECCENTRICITY",
    "FORMS",
    "PRESERVED",
    "PRINTED",
    "STEP",
    "TWO_FORMS",
    "VARIATIONAL",
    "Orbit",
    "orbit_of",
    "shooting",
    "structure_check",
    "structure_table",
]

Array = NDArray[np.float64]

ECCENTRICITY, STEP = 0.5, 0.3
PRINTED, VARIATIONAL = "as printed", "variational"
FORMS = (PRINTED, VARIATIONAL)
TWO_FORMS = (
    "SCVI is run twice: as printed, (34a)-(34e), and in variational form, with the chain-rule term in (34d), (34e)."
)
PRESERVED = 0.05
"""Largest energy error at which a phase trajectory counts as preserved: a tenth of the semi-major axis."""
SYMPLECTIC = 1e-11
"""Largest defect of a symplectic step, above the noise of the differences."""


def shooting(points: int, gauss: int, form: str) -> SCVI:
    """Return SCVI with given numbers of Chebyshev and Gauss points."""
    return SCVI(points - 1, f"gauss-legendre:{gauss}", variational=form == VARIATIONAL)


@dataclass(frozen=True, slots=True)
class Orbit:
    """Run and its errors over time.

    Attributes:
        run: states.
        energy, momentum: errors over time.
        turn: rotation of the perihelion, in radians per revolution.
        failed: True if a step had no solution before the end.
    """

    run: Trajectory
    energy: Array
    momentum: Array
    turn: float
    failed: bool

    @property
    def largest(self) -> tuple[float, float]:
        """Largest errors of energy and momentum."""
        return float(np.abs(self.energy).max()), float(np.abs(self.momentum).max())

    @property
    def lost(self) -> float:
        """First time at which the energy is off by a tenth, or the last time."""
        off = np.flatnonzero(np.abs(self.energy) > PRESERVED)
        return float(self.run.t[off[0]]) if len(off) else self.end

    @property
    def end(self) -> float:
        """Time of the last state."""
        return float(self.run.t[-1])


@lru_cache(maxsize=16)
def orbit_of(method: Method, h: float, span: float, e: float = ECCENTRICITY) -> Orbit:
    """Return the orbit from the perihelion, with the tolerance of section 4."""
    failed = False
    try:
        run = trajectory(SYSTEM, method, *perihelion(e), h=h, span=span, options=SECTION_4, solver=_solver(method))
    except StepFailedError as failure:
        run, failed = Trajectory.before(failure), True
    energy, momentum = run.energy(), angular_momentum(run.q, run.p)
    turn = perihelion_turn(run.q, run.p) / (run.t[-1] / (2 * math.pi))
    return Orbit(run, energy - energy[0], momentum - momentum[0], turn, failed)


def _solver(method: Method) -> str:
    return "newton" if isinstance(method, SCVI) else "auto"


def structure_table(points: int, gauss: tuple[int, ...]) -> TableBlock:
    """Return symplecticity defect, change of momentum and order of both forms."""

    def row(count: int, form: str) -> tuple[str | int | float, ...]:
        result = structure_of(shooting(points, count, form))
        return points, count, form, result.defect, result.momentum, result.order

    return TableBlock(
        name="structure",
        columns=("points", "Gauss points", "form", "symplecticity defect", "change of momentum in a step", "order"),
        rows=tuple(row(count, form) for count in gauss for form in FORMS),
        formats={"points": "d", "Gauss points": "d", "order": ".1f"},
    )


def structure_check(points: int, gauss: tuple[int, ...], form: str) -> Comparison:
    """Return the check that one form is symplectic."""
    result = [structure_of(shooting(points, count, form)) for count in gauss]
    defects = ", ".join(f"{structure.defect:.1e}" for structure in result)
    orders = ", ".join(f"{structure.order:.1f}" for structure in result)
    return Comparison(
        claim=f"SCVI is symplectic ({form}).",
        measured=(
            f"One step h = 0.3 with {points} points and {_counts(gauss)} Gauss points: max |J^T Omega J - Omega| = "
            f"{defects}; measured order {orders}."
        ),
        verdict=holds(all(structure.defect < SYMPLECTIC for structure in result)),
        bears_on=("scvi-structure",),
    )


def _counts(gauss: tuple[int, ...]) -> str:
    return ", ".join(map(str, gauss))
