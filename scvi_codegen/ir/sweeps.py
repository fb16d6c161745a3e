"""Fixed-point iterations and explicit splittings as data: kernels at lanes, and the tables between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = [
    "CollocationSweep",
    "CoupledSweep",
    "GuessTables",
    "HamiltonianSweep",
    "NodeTables",
    "PointSweep",
    "PointTables",
    "PrintedEnds",
    "SeparableSweep",
    "ShootingSweep",
    "Splitting",
    "Sweep",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class GuessTables:
    """(lanes, lanes) tables that continue what was kept at the points: ``last_alone``, or ``last`` and ``before``.

    Attributes:
        abscissae: where the kept values stand on a step, without padding.
        degree, highest: (lanes,) what gives the highest Legendre coefficient of the curve through them.
    """

    abscissae: tuple[Number, ...]
    degree: int
    highest: tuple[Number, ...]
    last_alone: NumberTable
    last: NumberTable
    before: NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparableSweep:
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

    kind: ClassVar[str] = "separable"
    sweeps_after: ClassVar[int] = 1
    """The final one, with all digits of the coefficients."""
    mass_entries: ClassVar[tuple[tuple[int, int], ...]] = ()
    diagonal: ClassVar[bool] = True

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""
        return (self.force,)

    @property
    def error_power(self) -> int:
        """Of h in the square of the displacement by the highest coefficient over that by all."""
        return 2 * self.guess.degree + 2

    def memory(self, dimension: int) -> int:
        """The forces at the points in the last two steps."""
        return 2 * dimension * self.lanes


@dataclass(frozen=True, slots=True, kw_only=True)
class PointSweep:
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

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""
        return (self.kernel, self.force, *((self.integrands,) if self.integrands else ()))

    @property
    def error_power(self) -> int:
        """Of h in the square of the displacement by the highest coefficient over that by all but the mean."""
        return 2 * self.guess.degree

    @property
    def uses_time(self) -> bool:
        """Whether time occurs in a kernel with lanes."""
        return any(kernel.uses_time for kernel in self.kernels)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoupledSweep(PointSweep):
    """A fixed-point iteration on velocities for any regular Lagrangian: V += L_vv^-1 (P - L_v) until nothing moves.

    The kernel: F, L_v and the mass at (q, V, t).

    Attributes:
        blocks: velocities s that give the curve, g unless the method is an SVI with other points.
        velocity, projection: (lanes, lanes) from the blocks z to V and from points to blocks, with other points than
            blocks; else empty.
        mass_entries: (i, j), i >= j, of the slopes of ``kernel``.
    """

    blocks: int
    velocity: NumberTable
    projection: NumberTable
    mass_entries: tuple[tuple[int, int], ...]

    kind: ClassVar[str] = "coupled"
    sweeps_after: ClassVar[int] = 0

    def memory(self, dimension: int) -> int:
        """The velocities z of the last two steps."""
        return 2 * dimension * self.lanes

    @property
    def projected(self) -> bool:
        """Whether the unknowns are not the velocities at the points."""
        return bool(self.velocity)

    @property
    def diagonal(self) -> bool:
        """Whether the mass matrix is diagonal."""
        return all(i == j for i, j in self.mass_entries)


@dataclass(frozen=True, slots=True, kw_only=True)
class HamiltonianSweep(PointSweep):
    """A fixed-point iteration for any Hamiltonian: F = -H_q(q, P), P, V = H_p(q, P), q in turn until nothing moves.

    The kernel: H_p at (q, P, t).
    """

    kind: ClassVar[str] = "hamiltonian"
    sweeps_after: ClassVar[int] = 0
    projected: ClassVar[bool] = False
    diagonal: ClassVar[bool] = True
    mass_entries: ClassVar[tuple[tuple[int, int], ...]] = ()

    def memory(self, dimension: int) -> int:
        """Velocities and forces of the last two steps."""
        return 4 * dimension * self.lanes


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeTables:
    """Curves given by v0 and z = h a: V = v0 + A z and q = q0 + h A V at the nodes; all padded to whole vectors.

    Attributes:
        count: of the nodes; lanes beyond repeat the last and have weight 0.
        abscissae: c_n, where time stands.
        collocation: A.
        end: b, q1 = q0 + h sum b V and v1 = v0 + sum b z.
        mask: 1 for nodes.
        guess: from z of former steps to z.
    """

    count: int
    abscissae: tuple[Number, ...]
    collocation: NumberTable
    end: tuple[Number, ...]
    mask: tuple[Number, ...]
    guess: GuessTables


@dataclass(frozen=True, slots=True, kw_only=True)
class PointTables:
    """Quadrature points on such a curve: q = q0 + h a V and v = l V, V the velocities at the nodes.

    Attributes:
        abscissae: c_n, where time stands.
        position, velocity: a, l.
        action: L_q and L_v at (q, v, t).
    """

    abscissae: tuple[Number, ...]
    position: NumberTable
    velocity: NumberTable
    action: Kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveSweep:
    """What the two iterations on accelerations have in common.

    Attributes:
        nodes, points: of the curve, and of a quadrature along it where there is one.
        kernel: at the nodes.
        mass_entries: (i, j), i >= j, of the slopes of ``kernel``.
    """

    lanes: int
    nodes: NodeTables
    points: PointTables | None
    kernel: Kernel
    mass_entries: tuple[tuple[int, int], ...]

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""
        return (self.kernel, self.points.action) if self.points else (self.kernel,)

    @property
    def guess(self) -> GuessTables:
        """That of the accelerations."""
        return self.nodes.guess

    @property
    def error_power(self) -> int:
        """Of h in the square of the displacement by the highest coefficient over that by all."""
        return 2 * self.guess.degree + 2

    @property
    def diagonal(self) -> bool:
        """Whether the mass matrix is diagonal."""
        return all(i == j for i, j in self.mass_entries)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShootingSweep(CurveSweep):
    """The fixed-point iteration of a shooting-based variational method; tables padded to ``lanes`` rows.

    Unknowns: v0, the scaled accelerations z_i = h a_i at the nodes and the scaled multipliers m_i. With
    V = v0 + A z and q = q0 + h A V at the nodes, and q = q0 + h a V, v = l V at the points, one sweep is

        z -= h M^-1 E(q, V, z / h),          p1 = p0 + h sum w L_q + h^2 sum (m . E)_q,
        gamma = h a^T w L_q + l^T w L_v + h (m . E)_v + h^2 A^T (m . E)_q - b p1,
        v0 -= M^-1 sum gamma,                m = -M^-1 A^T (gamma - l^T w sum gamma).

    The kernel: E, (m . E)_q, (m . E)_v and the mass at (q, V, a, m, t).

    Attributes:
        collocation_transposed, position_transposed, velocity_transposed: A^T, a^T, l^T.
        weights: (lanes,) w; consistency: (lanes,) l^T w.
    """

    collocation_transposed: NumberTable
    position_transposed: NumberTable
    velocity_transposed: NumberTable
    weights: tuple[Number, ...]
    consistency: tuple[Number, ...]

    kind: ClassVar[str] = "shooting"
    sweeps_after: ClassVar[int] = 0

    def memory(self, dimension: int) -> int:
        """Z of the last two steps, v0 and m."""
        return dimension * (3 * self.lanes + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedEnds:
    """Momenta at both ends of a curve by quadrature, as the paper prints them; all (lanes,).

        p0 = -sum (h start_force L_q + start_momentum L_v),     p1 = p0 + sum (h end_force L_q + end_momentum L_v).

    Attributes:
        start_force, start_momentum: w l_0 and w l_0', l_0 of the first node.
        end_force, end_momentum: w (l_0 + l_s) and w (l_0' + l_s').
    """

    start_force: tuple[Number, ...]
    start_momentum: tuple[Number, ...]
    end_force: tuple[Number, ...]
    end_momentum: tuple[Number, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class CollocationSweep(CurveSweep):
    """A fixed-point iteration on accelerations: the Euler-Lagrange equations at the nodes of a curve from q0.

    With V = v0 + A z and q = q0 + h A V at the nodes, z = h M^-1 (L_q - L_vq V - L_vt) until nothing moves. Without
    ``ends``, p0 and p1 are L_v at the ends of the curve, and v0 is known; with them they are sums over the points, and
    v0 is corrected after z by M^-1 times the misfit of p0.

    The kernel: L_q - L_vq V - L_vt and the mass at (q, V, t).

    Attributes:
        ends: of the printed form, ``None`` for spectral collocation and Runge-Kutta methods.
    """

    ends: PrintedEnds | None

    kind: ClassVar[str] = "collocation"
    sweeps_after: ClassVar[int] = 0

    def memory(self, dimension: int) -> int:
        """Z of the last two steps and v0."""
        return dimension * (2 * self.lanes + 1)


Sweep: TypeAlias = SeparableSweep | CoupledSweep | HamiltonianSweep | ShootingSweep | CollocationSweep
"""A fixed-point iteration; ``kind`` says which."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Splitting:
    """An explicit step: kick 0, drift 0, kick 1, drift 1, .., kick s.

    Attributes:
        kicks: (s + 1,) p += h kicks[n] L_q.
        drifts: (s,) q += h drifts[n] M^-1 p.
        abscissae: (s + 1,) c_n of the kicks.
        force: L_q at (q, t).
        mass: constant diagonal (no arguments).
    """

    kicks: tuple[Number, ...]
    drifts: tuple[Number, ...]
    abscissae: tuple[Number, ...]
    force: Kernel
    mass: Kernel

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Both."""
        return (self.force, self.mass)
