"""Fixed-point iterations on forces, velocities or momenta at points, and explicit splittings, as data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from scvi_codegen.ir.kernel import IndexedSum, Kernel
from scvi_codegen.ir.numbers import Number, NumberTable
from scvi_codegen.ir.sweep import GuessTables, Kept, Sweep, SweepTable, transposed

__all__ = [
    "CoupledSweep",
    "HamiltonianSweep",
    "PointSweep",
    "SeparableSweep",
    "Splitting",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparableSweep(Sweep):
    """A fixed-point iteration for constant diagonal mass m and forces F of position and time; points are lanes.

        q_n = q0 + h drift[n] v0 + h^2 sum_j product[n][j] F_j / m,     v0 = p0 / m,
        q1 = q0 + h v0 + h^2 sum_j end_position[j] F_j / m,             p1 = p0 + h sum_j end_momentum[j] F_j.

    All tables are padded to ``lanes`` rows and columns, and printed in two parts, so that what their rounding does to
    the map is 2^-53 times less than what one rounding of a sum does: the energy of a variational method does not drift.

    Attributes:
        points: real points; lanes beyond repeat the last one and have weight 0.
        lanes: a power of two.
        abscissae: (lanes,) c_n, where time stands.
        drift, end_position, end_momentum: (lanes,); product: (lanes, lanes).
        guess: from the forces of former steps to sum_j product[n][j] F_j.
        force: F at (q, t).
        mass: m (no arguments).
        velocity: (lanes, lanes) V_n = v0 + h sum_j velocity[n][j] F_j / m, where forces depend on velocities.
    """

    points: int
    lanes: int
    abscissae: tuple[Number, ...]
    drift: tuple[Number, ...]
    product: NumberTable
    end_position: tuple[Number, ...]
    end_momentum: tuple[Number, ...]
    guess: GuessTables
    force: Kernel
    mass: Kernel
    velocity: NumberTable = ()

    mass_entries: tuple[tuple[int, int], ...] = ()

    kept: ClassVar[Kept] = Kept.FORCES
    sweeps_after: ClassVar[int] = 1
    """The final one, with all digits of the coefficients."""

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""
        return (self.force,)

    @property
    def tables(self) -> Iterator[SweepTable]:
        """Most in two parts."""
        yield SweepTable("ABSCISSA", self.abscissae)
        yield SweepTable("DRIFT", self.drift, in_two_parts=True)
        yield SweepTable("PRODUCT", self.product, in_two_parts=True)
        yield SweepTable("POINT_END_POSITION", self.end_position, in_two_parts=True)
        yield SweepTable("POINT_END_MOMENTUM", self.end_momentum, in_two_parts=True)
        if self.velocity:
            yield SweepTable("VELOCITY", self.velocity)
        yield from self.guess.tables

    @property
    def changes_part(self) -> str:
        """By forces and their slopes."""
        return "" if self.velocity else "separable_changes"

    @property
    def changes_tables(self) -> tuple[SweepTable, ...]:
        """The transpose of what leads from forces to positions."""
        return (SweepTable("PRODUCT_BACK", transposed(self.product, self.points)),)

    @property
    def parts(self) -> tuple[str, ...]:
        """One."""
        return ("separable_sweep",)

    @property
    def constant_mass(self) -> Kernel:
        """M."""
        return self.mass

    @property
    def guess_through(self) -> NumberTable:
        """From forces to positions."""
        return self.product

    @property
    def serves_many(self) -> bool:
        """Always."""
        return True

    def memory(self, dimension: int) -> int:
        """The forces at the points in the last two steps."""
        return 2 * dimension * self.lanes

    def with_forces(self, forces: tuple[IndexedSum, ...]) -> SeparableSweep:
        """See :meth:`Sweep.with_forces`."""
        return replace(self, force=self.force.with_sums(forces))


@dataclass(frozen=True, slots=True, kw_only=True)
class PointSweep(Sweep):
    """What the two iterations on velocities at the points have in common; tables padded to ``lanes``.

        q_n = q0 + sum_j position[n][j] (h position_weights[j] V_j),    q1 = q0 + sum_j end_position[j] (h .. V_j),
        P_n = p0 + sum_j momentum[n][j] (h momentum_weights[j] F_j),    p1 = p0 + sum_j end_momentum[j] (h .. F_j),

    F being L_q (-H_q) at the points.

    Attributes:
        points: real points g; lanes beyond repeat the last one and have weight 0.
        lanes: a power of two.
        abscissae: (lanes,) c_n, where time stands.
        guess: from the velocities of former steps to those of the next.
        kernel: what gives the velocities.
        force: F alone.
        integrands: what is integrated along the curve, if anything.
    """

    points: int
    lanes: int
    abscissae: tuple[Number, ...]
    position: NumberTable
    position_weights: tuple[Number, ...]
    momentum: NumberTable
    momentum_weights: tuple[Number, ...]
    end_position: tuple[Number, ...]
    end_momentum: tuple[Number, ...]
    guess: GuessTables
    kernel: Kernel
    force: Kernel
    integrands: Kernel | None = None

    kept: ClassVar[Kept] = Kept.VELOCITIES

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""
        return (self.kernel, self.force, *((self.integrands,) if self.integrands else ()))

    @property
    def tables(self) -> Iterator[SweepTable]:
        """Those of positions and momenta, what else the kind has, and the guess."""
        yield SweepTable("ABSCISSA", self.abscissae)
        yield SweepTable("POSITION", self.position)
        yield SweepTable("POSITION_WEIGHT", self.position_weights)
        yield SweepTable("MOMENTUM", self.momentum)
        yield SweepTable("MOMENTUM_WEIGHT", self.momentum_weights)
        yield SweepTable("POINT_END_POSITION", self.end_position)
        yield SweepTable("POINT_END_MOMENTUM", self.end_momentum)
        yield from self.further_tables
        yield from self.guess.tables

    @property
    def further_tables(self) -> tuple[SweepTable, ...]:
        """Those of one kind alone."""
        return ()

    @property
    def uses_time(self) -> bool:
        """Whether time occurs in a kernel with lanes."""
        return any(kernel.uses_time for kernel in self.kernels)

    def with_forces(self, forces: tuple[IndexedSum, ...]) -> Self | None:
        """See :meth:`Sweep.with_forces`."""
        return replace(self, force=self.force.with_sums(forces))


@dataclass(frozen=True, slots=True, kw_only=True)
class CoupledSweep(PointSweep):
    """A fixed-point iteration on velocities for any regular Lagrangian: V += L_vv^-1 (P - L_v) until nothing moves.

    The kernel: F, L_v and the mass at (q, V, t).

    Attributes:
        blocks: velocities s that give the curve, g unless the method is an SVI with other points.
        velocity, projection: (lanes, lanes) from the blocks z to V and from points to blocks, with other points than
            blocks; else empty.
        mass_entries: (i, j), i >= j, of the slopes of ``kernel``.
        followed: whether the kernel gives F_q, F_v and L_vq, too, by which a correction is followed by another, and
            forces by both.
        damping: its rate, if there is one.
    """

    blocks: int
    velocity: NumberTable
    projection: NumberTable
    mass_entries: tuple[tuple[int, int], ...]
    followed: bool = False
    damping: Kernel | None = None

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes; forces that follow are not asked for again."""
        given = super(CoupledSweep, self).kernels
        return tuple(each for each in given if each is not self.force) if self.followed else given

    def memory(self, dimension: int) -> int:
        """The velocities z of the last two steps."""
        return 2 * dimension * self.lanes

    def with_forces(self, forces: tuple[IndexedSum, ...]) -> Self | None:
        """In both kernels: positions come first in the arguments, forces in the values; ``None`` with their slopes."""
        if self.followed:
            return None
        return replace(self, kernel=self.kernel.with_sums(forces), force=self.force.with_sums(forces))

    @property
    def projected(self) -> bool:
        """Whether the unknowns are not the velocities at the points."""
        return bool(self.velocity)

    @property
    def further_tables(self) -> tuple[SweepTable, ...]:
        """Between the unknowns and the velocities at the points, where they differ."""
        tables = (SweepTable("VELOCITY", self.velocity), SweepTable("PROJECTION", self.projection))
        return tables if self.projected else ()

    @property
    def facts(self) -> Mapping[str, int]:
        """Whether unknowns and velocities at the points differ."""
        return {"PROJECTED": 1} if self.projected else {}

    @property
    def parts(self) -> tuple[str, ...]:
        """Weights, which damping changes, a mass, corrections, the sweep."""
        damped = ("damped_points",) if self.damping else ()
        corrections = "followed_corrections" if self.followed else "corrections"
        return (*damped, "point_weights", self.mass_part, "places", corrections, "coupled_sweep")

    @property
    def changes_part(self) -> str:
        """By velocities, where these are the unknowns and nothing else is carried along."""
        return "" if self.projected or self.damping or self.integrands else "coupled_changes"

    @property
    def changes_tables(self) -> tuple[SweepTable, ...]:
        """Positions from velocities, momenta from forces, and their transposes."""
        tables = {
            "CHANGE_POSITION": _weighed(self.position, self.position_weights),
            "CHANGE_MOMENTUM": _weighed(self.momentum, self.momentum_weights),
        }
        back = (SweepTable(f"{name}_BACK", transposed(table, self.points)) for name, table in tables.items())
        return (*(SweepTable(name, table) for name, table in tables.items()), *back)

    @property
    def integral_part(self) -> str:
        """Along the velocities."""
        return "coupled_integrals" if self.integrands else ""

    @property
    def serves_many(self) -> bool:
        """Unless unknowns are projected, or something is integrated."""
        return not self.projected


@dataclass(frozen=True, slots=True, kw_only=True)
class HamiltonianSweep(PointSweep):
    """A fixed-point iteration for any Hamiltonian: F = -H_q(q, P), P, V = H_p(q, P), q in turn until nothing moves.

    The kernel: H_p at (q, P, t).
    """

    mass_entries: tuple[tuple[int, int], ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        """Weights, the sweep."""
        return ("point_weights", "hamiltonian_sweep")

    @property
    def integral_part(self) -> str:
        """Along positions and momenta."""
        return "hamiltonian_integrals" if self.integrands else ""

    def memory(self, dimension: int) -> int:
        """Velocities and forces of the last two steps."""
        return 4 * dimension * self.lanes


@dataclass(frozen=True, slots=True, kw_only=True)
class Splitting:
    """An explicit step: kick 0, drift 0, kick 1, drift 1, .., those of weight 0 left out.

    Attributes:
        kicks: (n,) p += h kicks[n] L_q.
        drifts: (n,) q += h drifts[n] v.
        abscissae: (n,) c_n of the kicks.
        force: L_q at (q, t).
        drift: the constant diagonal of M (no arguments), v = M^-1 p, or v = H_p at p.
        by_masses: which of both.
    """

    kicks: tuple[Number, ...]
    drifts: tuple[Number, ...]
    abscissae: tuple[Number, ...]
    force: Kernel
    drift: Kernel
    by_masses: bool

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Both."""
        return (self.force, self.drift)

    @property
    def acts(self) -> bool:
        """Whether it has a discrete Lagrangian in closed form: a single drift, whose velocity is (q1 - q0) / h."""
        return self.by_masses and sum(x != 0 for x in self.drifts) == 1


def _weighed(table: NumberTable, weights: tuple[Number, ...]) -> NumberTable:
    """Columns times weights."""
    return tuple(tuple(x * weight for x, weight in zip(row, weights, strict=True)) for row in table)
