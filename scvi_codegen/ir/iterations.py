"""Fixed-point iterations on forces, velocities or momenta at points, and explicit splittings, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

from scvi_codegen.ir.iteration import (
    FixedPointIteration,
    IterationTable,
    PredictorTables,
    StoredValues,
    printed,
    transposed,
)
from scvi_codegen.ir.kernel import Kernel, LoopedKernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = [
    "CoupledIteration",
    "HamiltonianIteration",
    "PointIteration",
    "SeparableIteration",
    "Splitting",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparableIteration(FixedPointIteration):
    """A fixed-point iteration for constant diagonal mass m and forces F of position and time; points are lanes.

        q_n = q0 + h drift[n] v0 + h^2 sum_j product[n][j] F_j / m,     v0 = p0 / m,
        q1 = q0 + h v0 + h^2 sum_j end_position[j] F_j / m,             p1 = p0 + h sum_j end_momentum[j] F_j.

    All tables are padded to ``lanes`` rows and columns, and printed as double-double numbers, so that their rounding
    perturbs the map 2^-53 times less than the rounding of a sum: the energy of a variational method does not drift.

    Attributes:
        points: real points; lanes beyond repeat the last one and have weight 0.
        lanes: a power of two.
        abscissae: (lanes,) c_n, of the time.
        drift, end_position, end_momentum: (lanes,); product: (lanes, lanes).
        guess: from the forces of former steps to sum_j product[n][j] F_j.
        force: F at (q, t).
        mass: m (no arguments).
        velocity: (lanes, lanes) V_n = v0 + h sum_j velocity[n][j] F_j / m, if forces depend on velocities.
    """

    points: int
    lanes: int
    abscissae: tuple[Number, ...] = field(metadata=printed("ABSCISSA"))
    drift: tuple[Number, ...] = field(metadata=printed("DRIFT", in_two_parts=True))
    product: NumberTable = field(metadata=printed("PRODUCT", in_two_parts=True))
    end_position: tuple[Number, ...] = field(metadata=printed("POINT_END_POSITION", in_two_parts=True))
    end_momentum: tuple[Number, ...] = field(metadata=printed("POINT_END_MOMENTUM", in_two_parts=True))
    guess: PredictorTables
    force: Kernel
    mass: Kernel
    velocity: NumberTable = field(default=(), metadata=printed("VELOCITY"))

    mass_entries: tuple[tuple[int, int], ...] = ()

    kept: ClassVar[StoredValues] = StoredValues.FORCES
    final_iterations: ClassVar[int] = 1
    """Number of iterations after convergence: the final one, with double-double coefficients."""

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels that are evaluated on SIMD lanes."""
        return (self.force,)

    @property
    def derivatives_part(self) -> str:
        """Support header of tangent and adjoint vectors, by forces and their derivatives."""
        return "" if self.velocity else "separable_derivatives"

    @property
    def derivatives_tables(self) -> tuple[IterationTable, ...]:
        """Transposed table from forces to positions."""
        return (IterationTable("PRODUCT_BACK", transposed(self.product, self.points)),)

    @property
    def parts(self) -> tuple[str, ...]:
        """Support header of the iteration."""
        return ("separable_iteration",)

    @property
    def constant_mass(self) -> Kernel:
        """Kernel of the constant diagonal masses."""
        return self.mass

    @property
    def predictor_matrix(self) -> NumberTable:
        """Table from forces to positions."""
        return self.product

    @property
    def serves_many(self) -> bool:
        """True: lanes may be trajectories."""
        return True

    def memory(self, dimension: int) -> int:
        """Return the number of forces at the points in the last two steps."""
        return 2 * dimension * self.lanes

    def with_forces(self, forces: tuple[LoopedKernel, ...]) -> SeparableIteration:
        """Return the iteration with further forces; see :meth:`FixedPointIteration.with_forces`."""
        return replace(self, force=self.force.with_sums(forces))


@dataclass(frozen=True, slots=True, kw_only=True)
class PointIteration(FixedPointIteration):
    """Common part of the two iterations on velocities at the points; tables are padded to ``lanes``.

        q_n = q0 + sum_j position[n][j] (h position_weights[j] V_j),    q1 = q0 + sum_j end_position[j] (h .. V_j),
        P_n = p0 + sum_j momentum[n][j] (h momentum_weights[j] F_j),    p1 = p0 + sum_j end_momentum[j] (h .. F_j),

    F being L_q (-H_q) at the points.

    Attributes:
        points: real points g; lanes beyond repeat the last one and have weight 0.
        lanes: a power of two.
        abscissae: (lanes,) c_n, of the time.
        guess: predictor of the velocities from former steps.
        kernel: that determines the velocities.
        force: F alone.
        integrands: functions integrated along the curve, if any.
    """

    points: int
    lanes: int
    abscissae: tuple[Number, ...] = field(metadata=printed("ABSCISSA"))
    position: NumberTable = field(metadata=printed("POSITION"))
    position_weights: tuple[Number, ...] = field(metadata=printed("POSITION_WEIGHT"))
    momentum: NumberTable = field(metadata=printed("MOMENTUM"))
    momentum_weights: tuple[Number, ...] = field(metadata=printed("MOMENTUM_WEIGHT"))
    end_position: tuple[Number, ...] = field(metadata=printed("POINT_END_POSITION"))
    end_momentum: tuple[Number, ...] = field(metadata=printed("POINT_END_MOMENTUM"))
    guess: PredictorTables
    kernel: Kernel
    force: Kernel
    integrands: Kernel | None = None

    kept: ClassVar[StoredValues] = StoredValues.VELOCITIES

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels that are evaluated on SIMD lanes."""
        return (self.kernel, self.force, *((self.integrands,) if self.integrands else ()))

    @property
    def uses_time(self) -> bool:
        """True if time occurs in a kernel on lanes."""
        return any(kernel.uses_time for kernel in self.kernels)

    def with_forces(self, forces: tuple[LoopedKernel, ...]) -> Self | None:
        """Return the iteration with further forces; see :meth:`FixedPointIteration.with_forces`."""
        return replace(self, force=self.force.with_sums(forces))


@dataclass(frozen=True, slots=True, kw_only=True)
class CoupledIteration(PointIteration):
    """A fixed-point iteration on velocities for any regular Lagrangian: V += L_vv^-1 (P - L_v) to convergence.

    The kernel: F, L_v and the mass at (q, V, t).

    Attributes:
        blocks: number of velocities that determine the curve, g unless the method is an SVI with other points.
        velocity, projection: (lanes, lanes) from the blocks z to V and from points to blocks, if they differ; else
            empty.
        mass_entries: (i, j), i >= j, of the derivatives of ``kernel``.
        followed: whether the kernel gives F_q, F_v and L_vq, too, with which forces and momenta are linearised in the
            correction.
        damping: its rate, if there is one.
    """

    blocks: int
    velocity: NumberTable = field(metadata=printed("VELOCITY"))
    projection: NumberTable = field(metadata=printed("PROJECTION"))
    mass_entries: tuple[tuple[int, int], ...]
    followed: bool = False
    damping: Kernel | None = None

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels that are evaluated on SIMD lanes; linearised forces are not evaluated again."""
        given = super(CoupledIteration, self).kernels
        return tuple(each for each in given if each is not self.force) if self.followed else given

    def memory(self, dimension: int) -> int:
        """Return the number of velocities z of the last two steps."""
        return 2 * dimension * self.lanes

    def with_forces(self, forces: tuple[LoopedKernel, ...]) -> Self | None:
        """Return the iteration with further forces in both kernels; ``None`` if forces are linearised."""
        if self.followed:
            return None
        return replace(self, kernel=self.kernel.with_sums(forces), force=self.force.with_sums(forces))

    @property
    def projected(self) -> bool:
        """True if the unknowns are not the velocities at the points."""
        return bool(self.velocity)

    @property
    def facts(self) -> Mapping[str, int]:
        """Macros of what differs: unknowns from velocities at the points, the mass matrix, the corrections."""
        known = {"PROJECTED": self.projected, "DIAGONAL_MASS": self.diagonal, "FOLLOWED": self.followed}
        return {name: 1 for name, holds in known.items() if holds}

    @property
    def parts(self) -> tuple[str, ...]:
        """Support headers: damping, weights, mass, corrections, iteration."""
        damped = ("damped_points",) if self.damping else ()
        return (*damped, "point_weights", "mass_matrix", "corrections", "coupled_iteration")

    @property
    def derivatives_part(self) -> str:
        """Support header of tangent and adjoint vectors, if velocities are the only unknowns."""
        return "" if self.projected or self.damping or self.integrands else "coupled_derivatives"

    @property
    def derivatives_tables(self) -> tuple[IterationTable, ...]:
        """Tables of positions from velocities, momenta from forces, and their transposes."""
        tables = {
            "CHANGE_POSITION": _weighed(self.position, self.position_weights),
            "CHANGE_MOMENTUM": _weighed(self.momentum, self.momentum_weights),
        }
        back = (IterationTable(f"{name}_BACK", transposed(table, self.points)) for name, table in tables.items())
        return (*(IterationTable(name, table) for name, table in tables.items()), *back)

    @property
    def serves_many(self) -> bool:
        """True if lanes may be trajectories: unless unknowns are projected."""
        return not self.projected


@dataclass(frozen=True, slots=True, kw_only=True)
class HamiltonianIteration(PointIteration):
    """A fixed-point iteration for any Hamiltonian: F = -H_q(q, P), P, V = H_p(q, P), q in turn to convergence.

    The kernel: H_p at (q, P, t).
    """

    mass_entries: tuple[tuple[int, int], ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        """Support headers: weights, iteration."""
        return ("point_weights", "hamiltonian_iteration")

    def memory(self, dimension: int) -> int:
        """Return the number of velocities and forces of the last two steps."""
        return 4 * dimension * self.lanes


@dataclass(frozen=True, slots=True, kw_only=True)
class Splitting:
    """An explicit step: kick 0, drift 0, kick 1, drift 1, .., without those of weight 0.

    Attributes:
        kicks: (n,) p += h kicks[n] L_q.
        drifts: (n,) q += h drifts[n] v.
        abscissae: (n,) c_n of the kicks.
        force: L_q at (q, t).
        drift: the constant diagonal of M (no arguments), v = M^-1 p, or v = H_p at p.
        by_masses: True for M^-1 p.
    """

    kicks: tuple[Number, ...]
    drifts: tuple[Number, ...]
    abscissae: tuple[Number, ...]
    force: Kernel
    drift: Kernel
    by_masses: bool

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels of kicks and drifts."""
        return (self.force, self.drift)

    @property
    def acts(self) -> bool:
        """True if it has a discrete Lagrangian in closed form: a single drift, whose velocity is (q1 - q0) / h."""
        return self.by_masses and sum(x != 0 for x in self.drifts) == 1


def _weighed(table: NumberTable, weights: tuple[Number, ...]) -> NumberTable:
    """Return the columns times weights."""
    return tuple(tuple(x * weight for x, weight in zip(row, weights, strict=True)) for row in table)
