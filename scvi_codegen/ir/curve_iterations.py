"""Fixed-point iterations on the accelerations of a curve, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from scvi_codegen.ir.iteration import FixedPointIteration, PredictorTables, StoredValues, printed
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = ["CollocationIteration", "NodeTables", "PointTables", "PrintedEnds", "ShootingIteration"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeTables:
    """Curves from v0 and z = h a: V = v0 + A z and q = q0 + h A V at the nodes; all padded to whole vectors.

    Attributes:
        count: of the nodes; lanes beyond repeat the last and have weight 0.
        abscissae: c_n, of the time.
        collocation: A.
        end: b, q1 = q0 + h sum b V and v1 = v0 + sum b z.
        mask: 1 for nodes.
    """

    count: int
    abscissae: tuple[Number, ...] = field(metadata=printed("NODE_TIME"))
    collocation: NumberTable = field(metadata=printed("COLLOCATION"))
    end: tuple[Number, ...] = field(metadata=printed("NODE_END"))
    mask: tuple[Number, ...] = field(metadata=printed("NODE_MASK"))


@dataclass(frozen=True, slots=True, kw_only=True)
class PointTables:
    """Quadrature points on a curve: q = q0 + h a V and v = l V, V the velocities at the nodes.

    Attributes:
        abscissae: c_n, of the time.
        position, velocity: a, l.
        action: L_q and L_v at (q, v, t).
    """

    abscissae: tuple[Number, ...] = field(metadata=printed("POINT_TIME"))
    position: NumberTable = field(metadata=printed("POINT_POSITION"))
    velocity: NumberTable = field(metadata=printed("POINT_VELOCITY"))
    action: Kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveIteration(FixedPointIteration):
    """Common part of the two iterations on accelerations.

    Attributes:
        nodes, points: of the curve, and of a quadrature along it, if there is one.
        kernel: at the nodes.
        guess: predictor of z from former steps.
        mass_entries: (i, j), i >= j, of the derivatives of ``kernel``.
    """

    lanes: int
    nodes: NodeTables
    guess: PredictorTables
    points: PointTables | None
    kernel: Kernel
    mass_entries: tuple[tuple[int, int], ...]

    kept: ClassVar[StoredValues] = StoredValues.ACCELERATIONS
    in_groups: ClassVar[bool] = False

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels that are evaluated on SIMD lanes."""
        return (self.kernel, self.points.action) if self.points else (self.kernel,)

    @property
    def facts(self) -> Mapping[str, int]:
        """Number of nodes, as a macro."""
        return {"NODES": self.nodes.count, **self.mass_facts}


@dataclass(frozen=True, slots=True, kw_only=True)
class ShootingIteration(CurveIteration):
    """The fixed-point iteration of a shooting-based variational method; tables padded to ``lanes`` rows.

    Unknowns: v0, the scaled accelerations z_i = h a_i at the nodes and the scaled multipliers m_i. With
    V = v0 + A z and q = q0 + h A V at the nodes, and q = q0 + h a V, v = l V at the points, one iteration is

        z -= h M^-1 E(q, V, z / h),          p1 = p0 + h sum w L_q + h^2 sum (m . E)_q,
        gamma = h a^T w L_q + l^T w L_v + h (m . E)_v + h^2 A^T (m . E)_q - b p1,
        v0 -= M^-1 sum gamma,                m = -M^-1 A^T (gamma - l^T w sum gamma).

    The kernel: E, (m . E)_q, (m . E)_v and the mass at (q, V, a, m, t).

    Attributes:
        collocation_transposed, position_transposed, velocity_transposed: A^T, a^T, l^T.
        weights: (lanes,) w; consistency: (lanes,) l^T w.
    """

    collocation_transposed: NumberTable = field(metadata=printed("COLLOCATION_T"))
    position_transposed: NumberTable = field(metadata=printed("POINT_POSITION_T"))
    velocity_transposed: NumberTable = field(metadata=printed("POINT_VELOCITY_T"))
    weights: tuple[Number, ...] = field(metadata=printed("POINT_WEIGHT"))
    consistency: tuple[Number, ...] = field(metadata=printed("NODE_CONSISTENCY"))

    @property
    def parts(self) -> tuple[str, ...]:
        """Support headers: mass, curve, points, iteration."""
        return ("mass_matrix", "curve", "shooting_iteration")

    def memory(self, dimension: int) -> int:
        """Return the length of z of the last two steps, v0 and m."""
        return dimension * (3 * self.lanes + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedEnds:
    """Momenta at both ends of a curve by quadrature, in the printed form of the paper; all (lanes,).

        p0 = -sum (h start_force L_q + start_momentum L_v),     p1 = p0 + sum (h end_force L_q + end_momentum L_v).

    Attributes:
        start_force, start_momentum: w l_0 and w l_0', l_0 of the first node.
        end_force, end_momentum: w (l_0 + l_s) and w (l_0' + l_s').
    """

    start_force: tuple[Number, ...] = field(metadata=printed("START_FORCE"))
    start_momentum: tuple[Number, ...] = field(metadata=printed("START_MOMENTUM"))
    end_force: tuple[Number, ...] = field(metadata=printed("END_FORCE"))
    end_momentum: tuple[Number, ...] = field(metadata=printed("END_MOMENTUM"))


@dataclass(frozen=True, slots=True, kw_only=True)
class CollocationIteration(CurveIteration):
    """A fixed-point iteration on accelerations: the Euler-Lagrange equations at the nodes of a curve from q0.

    With V = v0 + A z and q = q0 + h A V at the nodes, z = h M^-1 (L_q - L_vq V - L_vt) is iterated to convergence.
    Without ``ends``, p0 and p1 are L_v at the ends of the curve, and v0 is known; with them they are sums over the
    points, and v0 is corrected after z by M^-1 times the residual of p0.

    The kernel: L_q - L_vq V - L_vt and the mass at (q, V, t).

    Attributes:
        ends: of the printed form, ``None`` for spectral collocation and Runge-Kutta methods.
        hamiltonian: whether the system is Hamiltonian.
    """

    ends: PrintedEnds | None
    hamiltonian: bool

    @property
    def facts(self) -> Mapping[str, int]:
        """Number of nodes; without points, whether the system is Hamiltonian."""
        known = {"NODES": self.nodes.count} if self.points else {"HAMILTONIAN": int(self.hamiltonian)}
        return {**known, **self.mass_facts}

    @property
    def parts(self) -> tuple[str, ...]:
        """Support headers: mass, curve, ends, iteration."""
        return ("mass_matrix", "curve", "collocation_iteration")

    def memory(self, dimension: int) -> int:
        """Return the length of z of the last two steps and v0."""
        return dimension * (2 * self.lanes + 1)
