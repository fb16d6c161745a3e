"""Masses on rods, from rest: as holonomic constraints, and for peers in the angles of the rods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from scvi_codegen.benchmark.cases import Array, Case, Formulation, scaled, second_order
from scvi_codegen.benchmark.contenders.contenders import Contender
from scvi_codegen.benchmark.contenders.ours import our_contenders
from scvi_codegen.benchmark.hanging_rods import (
    angles_of,
    positions_of,
    rod_accelerations,
    rods_in_angles,
    rods_in_positions,
)
from scvi_codegen.methods import as_method

__all__ = ["CONSTRAINED_CASES", "ConstrainedCase", "constrained_contenders"]

LARGEST_IN_ANGLES = 8
"""Largest number of rods in angles for this package: the full mass matrix has n^2 terms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstrainedCase:
    """Problem in two formulations.

    Attributes:
        angles: case for peers; errors are measured in its final q.
        positions: case with constraints.
        methods: methods for the constraints.
    """

    angles: Case
    positions: Case
    methods: tuple[str, ...]

    def shortened(self, share: float) -> ConstrainedCase:
        """Return the cases with a part of the span."""
        span = share * self.angles.span
        return replace(self, angles=replace(self.angles, span=span), positions=replace(self.positions, span=span))


def constrained_contenders(both: ConstrainedCase, *, quick: bool) -> list[Contender]:
    """Return contenders with constraints and, for few rods, in angles."""
    methods = [as_method(name, both.positions.system) for name in both.methods[: 1 if quick else None]]
    constrained = [_converted_to_angles(each) for each in our_contenders(both.positions, methods=methods, quick=quick)]
    few = both.angles.dimension <= LARGEST_IN_ANGLES
    return [*constrained, *(_named_angles(each) for each in our_contenders(both.angles, quick=quick) if few)]


def _converted_to_angles(contender: Contender) -> Contender:
    """Return the contender with final positions converted to angles, untimed."""

    def prepare(index: int) -> Callable[[], Array]:
        integrate = contender.prepare(index)
        return lambda: angles_of(integrate())

    return replace(contender, prepare=prepare, momenta=None)


def _named_angles(contender: Contender) -> Contender:
    return replace(contender, method=f"{contender.method}, angles", momenta=None)


def _rods(name: str, n: int, start: float, *, methods: tuple[str, ...], span: float, fine: float) -> ConstrainedCase:
    q = scaled((start,) * n, 0.05)
    angles = Case(
        name=f"constrained:{name}",
        system=rods_in_angles(n),
        formulations=(Formulation(name="tensions of the rods", rates=second_order(rod_accelerations)),),
        q=q,
        velocity=0.0 * q,
        span=span,
        step=fine,
        fine=fine,
    )
    positions = replace(
        angles, system=rods_in_positions(n), formulations=(), q=positions_of(q), velocity=0.0 * positions_of(q)
    )
    return ConstrainedCase(angles=angles, positions=positions, methods=methods)


CONSTRAINED_CASES: Mapping[str, Callable[[], ConstrainedCase]] = {
    "pendulum": partial(_rods, "pendulum", 1, 0.5, methods=("svi:6", "svi:8"), span=1000.0, fine=0.25),
    "double-pendulum": partial(_rods, "double-pendulum", 2, 0.5, methods=("svi:6", "svi:8"), span=200.0, fine=0.125),
    "chain:5": partial(_rods, "chain:5", 5, 0.3, methods=("svi:6",), span=100.0, fine=0.125),
    "chain:20": partial(_rods, "chain:20", 20, 0.3, methods=("svi:6",), span=50.0, fine=0.0625),
}
"""Functions that build a case, by the name after ``constrained:``."""
