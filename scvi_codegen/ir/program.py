"""The intermediate representation: a program is kernels, tables and loops, C without syntax. It prints itself.

A kernel is straight-line arithmetic over ``u[i]`` (its arguments), ``t`` and ``parameters[i]``: temporaries, each used
more than once, then results. Operations are ``+ - * / neg sqrt``, ``inverse_root_k`` (x^(-k/2)) and calls of elementary
functions on binary64 numbers; there are no branches, loops or integers. Everything around the kernels (gather, scatter,
Newton, sweeps, the run) is a loop over tables, the same for every method and system, and stands in the templates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, TypeAlias

if TYPE_CHECKING:
    import sympy

__all__ = [
    "CollocationSweep",
    "Constant",
    "CoupledSweep",
    "Expression",
    "Family",
    "GatherLoop",
    "GuessTables",
    "HamiltonianSweep",
    "Kernel",
    "LaneTable",
    "Load",
    "MomentumMap",
    "NodeTables",
    "Operation",
    "PointSweep",
    "PointTables",
    "PrintedEnds",
    "Program",
    "ScatterLoop",
    "SeparableSweep",
    "ShootingSweep",
    "SlopeBlock",
    "SplitMatrix",
    "SplitVector",
    "Splitting",
    "Sweep",
]

WORTH_REMEMBERING = 32
"""Unknowns from which on factors of the Newton matrix go from step to step. With 16 (Kepler's problem, degree 8) new
ones take as long as the additional iterations with old ones, with 34 twice as long, with 144 ten times."""


@dataclass(frozen=True, slots=True)
class Constant:
    """A binary64 number."""

    value: float


@dataclass(frozen=True, slots=True)
class Load:
    """``u[index]``, ``parameters[index]``, ``t`` (index -1) or temporary ``w[index]``, by ``source``."""

    source: str
    index: int


@dataclass(frozen=True, slots=True)
class Operation:
    """``operator`` applied to operands; anything but ``+ - * / neg`` is a call of that C function."""

    operator: str
    operands: tuple[Expression, ...]


Expression: TypeAlias = Constant | Load | Operation


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """Straight-line code: ``temporaries[k]`` defines ``w[k]``; ``results`` are stored as soon as they can be.

    Attributes:
        name: C identifier.
        arguments: length of ``u``.
        temporaries, results: expressions.
        values: how many of the results are values; the rest are slopes.
        symbols: what ``u`` holds, in the symbols of the formulas.
        formulas: what the results were before their common parts were found.
    """

    name: str
    arguments: int
    temporaries: tuple[Expression, ...]
    results: tuple[Expression, ...]
    values: int
    symbols: tuple[sympy.Symbol, ...] = field(default=(), repr=False, compare=False)
    formulas: tuple[sympy.Expr, ...] = field(default=(), repr=False, compare=False)

    @property
    def uses_arguments(self) -> bool:
        """Whether any ``u[i]`` occurs."""
        return self._uses("u")

    @property
    def uses_time(self) -> bool:
        """Whether ``t`` occurs."""
        return self._uses("t")

    @property
    def uses_parameters(self) -> bool:
        """Whether any ``parameters[i]`` occurs."""
        return self._uses("parameters")

    def _uses(self, source: str) -> bool:
        return any(_occurs(source, expression) for expression in (*self.temporaries, *self.results))

    def operation_counts(self) -> dict[str, int]:
        """Operations by name, in alphabetical order."""
        counts: dict[str, int] = {}
        for expression in (*self.temporaries, *self.results):
            _count(expression, counts)
        return dict(sorted(counts.items()))

    def statements(self) -> Iterator[tuple[str, int, Expression]]:
        """("w", "value" or "slope", index, expression): each result right after the last temporary that it needs."""
        due: list[list[int]] = [[] for _ in range(len(self.temporaries) + 1)]
        for k, expression in enumerate(self.results):
            due[1 + _last_temporary(expression)].append(k)
        for k, ready in enumerate(due):
            if k > 0:
                yield "w", k - 1, self.temporaries[k - 1]
            for number in ready:
                slope = number >= self.values
                yield "slope" if slope else "value", number - slope * self.values, self.results[number]

    def __str__(self) -> str:
        """The kernel as readable text, one assignment a line."""
        lines = [f"kernel {self.name}(u[{self.arguments}], t, parameters)"]
        for kind, k, expression in self.statements():
            target = f"w{k}" if kind == "w" else f"{kind}[{k}]"
            lines.append(f"  {target} = {_text(expression)}")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True, kw_only=True)
class GatherLoop:
    """m arguments: ``u[offset + i] = (q0[i] +) h^power sum_b table[n][b] z[b][i]``."""

    name: str
    offset: int
    from_state: bool
    power: int
    table: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScatterLoop:
    """m results: ``rows[r][i] += weight_n h^power table[n][r] value[offset + i]``; the last column belongs to p1."""

    name: str
    offset: int
    power: int
    table: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeBlock:
    """Non-zero slopes of one scatter against one gather: ``slope[first + e]`` is d value[i_e] / d u[j_e]."""

    scatter: int
    gather: int
    first: int
    entries: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Points of one kind with the loops around their kernel.

    Attributes:
        arguments: what the gathers give, m each.
        value, slope: the kernel, and the kernel with its derivatives.
        action: what is summed to the discrete Lagrangian with h^(1 + action_power), or ``None``.
    """

    name: str
    arguments: tuple[str, ...]
    abscissae: tuple[float, ...]
    weights: tuple[float, ...]
    gathers: tuple[GatherLoop, ...]
    scatters: tuple[ScatterLoop, ...]
    value: Kernel
    slope: Kernel
    blocks: tuple[SlopeBlock, ...]
    action: Kernel | None
    action_power: int

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.abscissae)

    @property
    def uses_time(self) -> bool:
        """Whether the kernel depends on time explicitly (its slopes then can only do so, too)."""
        return self.value.uses_time or self.slope.uses_time

    @property
    def uses_step(self) -> bool:
        """Whether h occurs around the kernel."""
        powers = [loop.power for loop in self.gathers] + [loop.power for loop in self.scatters]
        return self.uses_time or any(powers)

    @property
    def scratch(self) -> int:
        """Arguments, values and slopes at all points."""
        return self.points * (self.slope.arguments + len(self.slope.results))


LaneTable: TypeAlias = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class SplitVector:
    """Numbers in twice the precision of a double: ``high + low``."""

    high: tuple[float, ...]
    low: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class SplitMatrix:
    """The same for a table."""

    high: LaneTable
    low: LaneTable


@dataclass(frozen=True, slots=True, kw_only=True)
class GuessTables:
    """(lanes, lanes) tables that continue what was kept at the points: ``last_alone``, or ``last`` and ``before``."""

    last_alone: LaneTable
    last: LaneTable
    before: LaneTable


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparableSweep:
    """A fixed-point iteration for constant diagonal mass m and forces F of position and time; points are lanes.

        q_n = q0 + h drift[n] v0 + h^2 sum_j product[n][j] F_j / m,     v0 = p0 / m,
        q1 = q0 + h v0 + h^2 sum_j end_position[j] F_j / m,             p1 = p0 + h sum_j end_momentum[j] F_j.

    All tables are padded to ``lanes`` rows and columns, and split, so that what their rounding does to the map is
    2^-53 times less than what one rounding of a sum does: the energy of a variational method does not drift.

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
    abscissae: tuple[float, ...]
    drift: SplitVector
    product: SplitMatrix
    end_position: SplitVector
    end_momentum: SplitVector
    guess: GuessTables
    force: Kernel
    mass: Kernel

    kind: ClassVar[str] = "separable"
    mass_entries: ClassVar[tuple[tuple[int, int], ...]] = ()
    diagonal: ClassVar[bool] = True

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""
        return (self.force,)

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
    """

    points: int
    lanes: int
    abscissae: tuple[float, ...]
    position: LaneTable
    position_weights: tuple[float, ...]
    momentum: LaneTable
    momentum_weights: tuple[float, ...]
    end_position: tuple[float, ...]
    end_momentum: tuple[float, ...]
    guess: GuessTables
    kernel: Kernel
    force: Kernel

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""
        return (self.kernel, self.force)

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
    velocity: LaneTable
    projection: LaneTable
    mass_entries: tuple[tuple[int, int], ...]

    kind: ClassVar[str] = "coupled"

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
    abscissae: tuple[float, ...]
    collocation: LaneTable
    end: tuple[float, ...]
    mask: tuple[float, ...]
    guess: GuessTables


@dataclass(frozen=True, slots=True, kw_only=True)
class PointTables:
    """Quadrature points on such a curve: q = q0 + h a V and v = l V, V the velocities at the nodes.

    Attributes:
        abscissae: c_n, where time stands.
        position, velocity: a, l.
        action: L_q and L_v at (q, v, t).
    """

    abscissae: tuple[float, ...]
    position: LaneTable
    velocity: LaneTable
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

    collocation_transposed: LaneTable
    position_transposed: LaneTable
    velocity_transposed: LaneTable
    weights: tuple[float, ...]
    consistency: tuple[float, ...]

    kind: ClassVar[str] = "shooting"

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

    start_force: tuple[float, ...]
    start_momentum: tuple[float, ...]
    end_force: tuple[float, ...]
    end_momentum: tuple[float, ...]


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

    kicks: tuple[float, ...]
    drifts: tuple[float, ...]
    abscissae: tuple[float, ...]
    force: Kernel
    mass: Kernel

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Both."""
        return (self.force, self.mass)


@dataclass(frozen=True, slots=True, kw_only=True)
class MomentumMap:
    """What a symmetry conserves, by name and formula; ``exact`` if the method is known to conserve it, too."""

    name: str
    formula: str
    exact: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """All of an integrator but its syntax.

    Attributes:
        prefix: C identifier that begins every exported name.
        title: one line, the system and the method.
        notes: lines for the header's comment: order, symmetry, symplecticity.
        coordinate_names, parameter_names, parameter_defaults: for people and for Python.
        blocks: number of unknown blocks B; the unknowns are B m numbers.
        families: points and kernels.
        places: (m,) the place of each coordinate in matrices, chosen so that those that meet are near each other.
        bandwidth: how many places they are apart at most.
        momentum_rows: (B,) coefficient of p0 in each row.
        end_position: (B,) weights of q1 = q0 + h sum_b beta_b z_b.
        straight: (B,) 1 where the straight-line guess of a block is v0, 0 where it is not.
        momentum_blocks: (B,) 1 where that guess is p0.
        moving_blocks: (B,) 1 where h times the block is a length; convergence is judged by these.
        extrapolation: (B, B) guess for the next step.
        legendre: p and dp/dv at (q, v); where a Hamiltonian is given, v and dv/dp at (q, p).
        mass_entries: (i, j) of the slopes of ``legendre``.
        energy: L at (q, v), from which and ``legendre`` follows the energy; where a Hamiltonian is given, H at (q, p).
        hamiltonian: whether a Hamiltonian is given.
        momentum_maps: what is conserved.
        momentum_kernel: their values at (q, p), then the sums of the squares of their terms; ``None`` without any.
        sweep: the fixed-point iteration tried first, or ``None`` for Newton's alone.
        splitting: the explicit sequence that replaces both, or ``None``.
        newton: whether Newton's iteration is there at all.
    """

    prefix: str
    title: str
    notes: tuple[str, ...]
    coordinate_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    parameter_defaults: tuple[float, ...]
    blocks: int
    families: tuple[Family, ...]
    places: tuple[int, ...]
    bandwidth: int
    momentum_rows: tuple[float, ...]
    end_position: tuple[float, ...]
    straight: tuple[int, ...]
    momentum_blocks: tuple[int, ...]
    moving_blocks: tuple[int, ...]
    extrapolation: tuple[tuple[float, ...], ...]
    legendre: Kernel
    mass_entries: tuple[tuple[int, int], ...]
    energy: Kernel
    hamiltonian: bool
    momentum_maps: tuple[MomentumMap, ...]
    momentum_kernel: Kernel | None
    sweep: Sweep | None
    splitting: Splitting | None
    newton: bool

    @property
    def dimension(self) -> int:
        """Degrees of freedom m."""
        return len(self.coordinate_names)

    @property
    def unknowns(self) -> int:
        """B m."""
        return self.blocks * self.dimension

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Every kernel, in the order of emission."""
        pairs = [kernel for family in self.families for kernel in (family.value, family.slope)] if self.newton else []
        actions = {family.action.name: family.action for family in self.families if self.newton and family.action}
        maps = (self.momentum_kernel,) if self.momentum_kernel else ()
        return (*pairs, self.legendre, *({self.energy.name: self.energy} | actions).values(), *maps)

    @property
    def action(self) -> bool:
        """Whether there is a discrete Lagrangian."""
        return self.newton and any(family.action for family in self.families)

    @property
    def memory(self) -> int:
        """Numbers a run remembers of its last step to guess the next."""
        if self.splitting:
            return self.dimension
        points = self.sweep.memory(self.dimension) if self.sweep else 0
        return max(points, self.unknowns + self.point if self.newton else 0)

    @property
    def remembers_factors(self) -> bool:
        """Whether Newton's iteration begins a step with the factors of the one before: not if new ones cost little."""
        return self.newton and not self.splitting and self.unknowns >= WORTH_REMEMBERING

    @property
    def point(self) -> int:
        """Numbers that say where the factors were made: time, q0 with what rounding cut off, unknowns."""
        return 1 + 2 * self.dimension + self.unknowns if self.remembers_factors else 0

    def matrix_size(self, blocks: int) -> int:
        """Numbers of a matrix with ``blocks`` unknowns a coordinate: its band with room for fill-in, or all of it."""
        rows, reach = self.dimension * blocks, (self.bandwidth + 1) * blocks - 1
        return rows * min(rows, 3 * reach + 1)

    def __str__(self) -> str:
        """Readable text of the whole program."""
        head = [
            f"program {self.prefix}: {self.title}",
            f"  {self.blocks} blocks of {self.dimension} unknowns, bandwidth {self.bandwidth}",
        ]
        for family in self.families:
            head.append(f"  family {family.name}: {family.points} points")
            head += [
                f"    gather  {loop.name}: {'q0 + ' * loop.from_state}h^{loop.power} sum_b {loop.name}[n][b] z[b]"
                for loop in family.gathers
            ]
            head += [f"    scatter {loop.name}: w[n] h^{loop.power} {loop.name}[n][r]" for loop in family.scatters]
        return "\n".join([*head, *(str(kernel) for kernel in self.kernels)])


def _last_temporary(expression: Expression) -> int:
    """The largest index of a temporary in an expression, -1 without one."""
    if isinstance(expression, Load):
        return expression.index if expression.source == "w" else -1
    if isinstance(expression, Operation):
        return max((_last_temporary(operand) for operand in expression.operands), default=-1)
    return -1


def _occurs(source: str, expression: Expression) -> bool:
    if isinstance(expression, Load):
        return expression.source == source
    return isinstance(expression, Operation) and any(_occurs(source, operand) for operand in expression.operands)


def _count(expression: Expression, counts: dict[str, int]) -> None:
    if isinstance(expression, Operation):
        counts[expression.operator] = counts.get(expression.operator, 0) + 1
        for operand in expression.operands:
            _count(operand, counts)


def _text(expression: Expression) -> str:
    if isinstance(expression, Constant):
        return repr(expression.value)
    if isinstance(expression, Load):
        return "t" if expression.source == "t" else f"{expression.source}{expression.index}"
    return f"({expression.operator} {' '.join(_text(operand) for operand in expression.operands)})"
