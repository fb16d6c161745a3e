"""Stage equations common to all methods: points on the step, a small symbolic kernel at each, and tables of numbers.

A step from (t, q0, p0) with step size h has unknown *blocks* z_1 .. z_B, of m components each unless declared
otherwise (multipliers of constraints). At point n of a *stage group* (quadrature points, collocation nodes, the start,
the end) the arguments of a kernel are *gathered* from the unknowns,

    u_n = scale h^power (G_n0 q0 + sum_b h^(power of b) G_nb z_b),                       t_n = t + c_n h,

the kernel phi (results in the arguments, time and parameters) is evaluated, and its results are *scattered* into rows,

    R_r = (momentum coefficient) p0 + sum_families sum_n scale w_n h^(power + power of r) S_nr phi(u_n) = 0,

where the last column of S belongs to p1, a row like the others; q1 is one more gather. With damping gamma the weights
are w_n e^(gamma c_n h), and the row of p1 yields e^(gamma h) p1. Only kernels are symbolic; they are independent of
the degree and the number of points. Everything else is a table in 60 digits.

There are two parametrisations of the same method. The *paper's* has the positions Q^v at the nodes as unknowns;
``derive`` shows it. The *compiled* one has velocities as unknowns: its tables are free of h, the known state enters as
"q0" and "p0" alone, and p1 = p0 + increments, which avoids cancellation for small steps and far from the origin.

Shapes of stage equations: the structure that a solver without a Newton matrix must know.

A method states the shape of its stage system (:attr:`~scvi_codegen.methods.stage_system.StageSystem.shape`); a solver
states which shapes it supports (:mod:`scvi_codegen.codegen.lowering.program`). A shape consists of numbers of the
method, in 60 digits, independent of the system. Stage equations without a shape are solved by Newton's iteration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import count
from sys import float_info
from typing import Any

import sympy

from scvi_codegen.common.precision import Matrix, Number, Vector, mp
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import Tableau
from scvi_codegen.systems.formulas.expressions import gradient

_WORDS: ContextVar[int] = ContextVar("words of the entries of tables", default=1)
ROUNDING = mp.mpf("1e-50")
"""Bound below which entries are set to 0: round-off of sums that are 0."""


@dataclass(frozen=True, slots=True)
class EntryName:
    """Name of a table entry: a number of the method's tables by its indices, l_2(tau_n) or a_nj, times a factor.

    Attributes:
        of: letter of the table that the number belongs to.
        point: index of the point, ``None`` for tables of one row without it: b_j.
        column: index of the column, ``None`` for vectors over points: c_n.
        column_first: whether the index of the column is the first one, as in a transposed table.
        factor: of the number in this entry.
    """

    of: str
    point: int | None = None
    column: int | None = None
    column_first: bool = False
    factor: Fraction = Fraction(1)

    @property
    def indices(self) -> tuple[int, ...]:
        """Indices in their order."""
        both = (self.column, self.point) if self.column_first else (self.point, self.column)
        return tuple(index for index in both if index is not None)

    @property
    def number(self) -> str:
        """The named number without its factor."""
        return "_".join([self.of, *map(str, self.indices)])

    @property
    def transposed(self) -> EntryName:
        """Name of the same number in the transposed table, where points are columns."""
        one_index = self.point is None or self.column is None
        return replace(self, point=self.column, column=self.point, column_first=not (one_index or self.column_first))


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Matrix of numbers, each with a name for display.

    Attributes:
        entries: one row per point, one column per block; 60-digit numbers.
        names: parallel to ``entries``; ``None`` marks an entry shown as its value (0, 1, -1).
    """

    entries: Matrix
    names: tuple[tuple[EntryName | None, ...], ...]

    @classmethod
    def named(cls, prefix: str, entries: Sequence[Sequence[Number]], *, row: int = 1, column: int = 1) -> Table:
        """Return a table with names ``prefix_n_b``, counting from ``row`` and ``column``; 0, 1 and -1 get no name."""
        rows = tuple(tuple(mp.mpf(x) if abs(x) > ROUNDING else mp.zero for x in line) for line in entries)
        names = tuple(
            tuple(None if x in (0, 1, -1) else EntryName(prefix, n, b) for b, x in enumerate(line, column))
            for n, line in enumerate(rows, row)
        )
        return cls(entries=rows, names=names)

    @classmethod
    def joined(cls, *tables: Table) -> Table:
        """Return the tables side by side."""
        return cls(
            entries=tuple(sum(rows, ()) for rows in zip(*(table.entries for table in tables), strict=True)),
            names=tuple(sum(rows, ()) for rows in zip(*(table.names for table in tables), strict=True)),
        )

    @classmethod
    def constant(cls, points: int, columns: int, value: int = 0) -> Table:
        """Return a table of one small integer."""
        return cls.named("", [[value] * columns] * points)

    @classmethod
    def identity(cls, size: int, sign: int = 1) -> Table:
        """Return the identity matrix, or its negative."""
        return cls.named("", [[sign * int(i == j) for j in range(size)] for i in range(size)])

    @property
    def transposed(self) -> Table:
        """The transposed table."""
        names = tuple(tuple(name and name.transposed for name in line) for line in zip(*self.names, strict=True))
        return Table(entries=tuple(zip(*self.entries, strict=True)), names=names)

    def rows(self, indices: Sequence[int]) -> Table:
        """Return the rows with these indices, in that order."""
        return Table(entries=tuple(self.entries[i] for i in indices), names=tuple(self.names[i] for i in indices))

    def columns(self, indices: Sequence[int]) -> Table:
        """Return the columns with these indices, in that order."""
        return Table(
            entries=tuple(tuple(line[i] for i in indices) for line in self.entries),
            names=tuple(tuple(line[i] for i in indices) for line in self.names),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Unknowns of one kind: ``Q_1`` (position, power 0), ``V_3`` (velocity, power 1), ``lambda_2``, ``v_0``.

    Attributes:
        letter, index: of its symbol in displayed equations.
        power: the power of h that makes it a position.
        straight: (a, b) of the straight-line guess z = a q0 + b h^(1 - power) v0.
        momentum: coefficient of p0 in that guess.
        moves: whether h^power times the block has the unit of a position; false for momenta and their multipliers.
        size: number of components; ``None``: m. Blocks of other sizes have the initial guess 0, and q1 does not depend
            on them.
    """

    letter: str
    index: int | str
    power: int = 1
    straight: tuple[Number, Number] = (mp.zero, mp.zero)
    momentum: int = 0
    moves: bool = True
    size: int | None = None

    @property
    def name(self) -> str:
        """Symbol in displayed equations."""
        return f"{self.letter}_{self.index}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Equations: number in the paper, kind (``"stage"``, ``"IDEL"``), coefficient of p0, extra power of h, size.

    ``size`` is the number of equations, m if ``None``; with another size they do not contain p0.
    """

    number: str
    kind: str
    momentum: Number
    power: int = 0
    size: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Gather:
    """Kernel arguments u_n = scale h^power (G_n0 q0 + sum_b h^(power of b) G_nb z_b); column 0 multiplies q0.

    Their number equals the size of the gathered blocks; columns of other blocks are 0.
    """

    arguments: tuple[sympy.Symbol, ...]
    table: Table
    power: int
    scale: Fraction = Fraction(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatter:
    """Kernel results, added to row r as h^(power + power of r) S_nr phi_n; the last column of S belongs to p1.

    Their number equals the size of the rows to which they are added; columns of other rows are 0.
    """

    results: tuple[sympy.Expr, ...]
    table: Table
    power: int
    scale: Fraction = Fraction(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class StagePoints:
    """Points c_n in [0, 1] with weights, 1 without names by default, and the arguments of a kernel there."""

    name: str
    abscissae: Vector
    weights: Vector = ()
    weight_names: tuple[EntryName | None, ...] = ()
    gathers: tuple[Gather, ...]

    def __post_init__(self) -> None:
        points = len(self.abscissae)
        object.__setattr__(self, "weights", self.weights or (mp.one,) * points)
        object.__setattr__(self, "weight_names", self.weight_names or (None,) * points)


@dataclass(frozen=True, slots=True, kw_only=True)
class StageGroup(StagePoints):
    """Points evaluated by one kernel.

    If the kernel is the gradient of ``scalar``, sum_n w_n h^(1 + scalar_power) scalar(u_n) is part of a generating
    function, and of the discrete Lagrangian if ``in_action``; if ``forced``, the results are its gradient plus forces,
    or changes by a rotation.
    ``computes`` describes the results of the kernel if the name does not; ``scalar_weights`` replace the weights in the
    sum of the scalar.
    """

    scatters: tuple[Scatter, ...]
    scalar: sympy.Expr | None = None
    scalar_weights: Vector = ()
    scalar_power: int = 0
    in_action: bool = False
    forced: bool = False
    computes: str = ""

    @property
    def arguments(self) -> tuple[sympy.Symbol, ...]:
        """Arguments of the kernel, gather after gather."""
        return sum((gather.arguments for gather in self.gathers), ())

    @property
    def results(self) -> tuple[sympy.Expr, ...]:
        """Results of the kernel, scatter after scatter."""
        return sum((scatter.results for scatter in self.scatters), ())

    def widened(self, count: int) -> StageGroup:
        """Return the group with columns of 0 for ``count`` further blocks, and for as many rows before that of p1."""
        none = Table.constant(len(self.abscissae), count)
        before = range(len(self.scatters[0].table.entries[0]) - 1)
        gathers = (replace(gather, table=Table.joined(gather.table, none)) for gather in self.gathers)
        tables = (Table.joined(x.table.columns(before), none, x.table.columns([-1])) for x in self.scatters)
        scatters = (replace(scatter, table=table) for scatter, table in zip(self.scatters, tables, strict=True))
        return replace(self, gathers=tuple(gathers), scatters=tuple(scatters))

    def abscissa_name(self, n: int) -> EntryName | None:
        """Return the name of the abscissa of point n on the step; ``None`` for 0 and 1."""
        prefix = "d" if self.name == "quadrature" else "c"
        return None if self.abscissae[n] in (0, 1) else EntryName(prefix, n + 1)


class Shape:
    """Base class of the structure used by matrix-free solvers: :mod:`scvi_codegen.methods.stage_system`."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class StageSystem:
    """Equations of one step of one method for one system, in terms of points and tables.

    Attributes:
        blocks: the unknowns.
        rows: the equations, as many as blocks.
        stage_groups: groups of points at which kernels are evaluated.
        end_position: one row, 1 + B columns: q1 = E_0 q0 + sum_b h^(power of b) E_b z_b.
        end_momentum: coefficient of p0 in p1.
        end_numbers: the paper's numbers of the equations for q1 and p1.
        extrapolation: (B, B) matrix of the predictor from the unknowns of one step to the next, or ``None``.
        damping: gamma, a formula of parameters.
        shape: structure used by matrix-free solvers, or ``None``: then only Newton's iteration applies.
    """

    blocks: tuple[Block, ...]
    rows: tuple[Row, ...]
    stage_groups: tuple[StageGroup, ...]
    end_position: Table
    end_momentum: Number
    end_numbers: tuple[str, str]
    extrapolation: Matrix | None = None
    shape: Shape | None = None
    damping: sympy.Expr = sympy.S.Zero

    def block_sizes(self, dimension: int) -> tuple[int, ...]:
        """Return the number of components of each block."""
        return tuple(dimension if block.size is None else block.size for block in self.blocks)

    def row_sizes(self, dimension: int) -> tuple[int, ...]:
        """Return the number of equations of each row; the last entry is m, for p1."""
        return (*(dimension if row.size is None else row.size for row in self.rows), dimension)

    def straight(self, q: Any, v: Any, p: Any, h: Any, number: Callable[[Any], Any] = float) -> list[Any]:
        """Return an initial guess of each block of unknowns: the straight line from (q, p) with velocity v."""
        return [
            number(block.straight[0]) * q + number(block.straight[1]) * h ** (1 - block.power) * v + block.momentum * p
            if block.size is None
            else 0 * q[[0] * block.size]
            for block in self.blocks
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalarStageGroup(StagePoints):
    """Points whose weighted sum sum_n scale w_n h^(1 + power) s(u_n) is part of a generating function.

    ``forces`` f_g, for the first gathers, are added to its derivatives, as in the principle of Lagrange and d'Alembert:
    the variation is ds + sum_g f_g . du_g.
    """

    scalar: sympy.Expr
    power: int = 0
    scale: Fraction = Fraction(1)
    in_action: bool = True
    forces: tuple[tuple[sympy.Expr, ...], ...] = ()

    def derivatives(self) -> list[tuple[Gather, tuple[sympy.Expr, ...]]]:
        """Return the derivatives of the scalar plus the forces, one tuple of m per gather."""
        derivatives = []
        for g, gather in enumerate(self.gathers):
            entries = gradient(self.scalar, gather.arguments)
            row = tuple(entries.get(i, sympy.S.Zero) for i in range(len(gather.arguments)))
            derivatives.append((gather, tuple(map(sympy.Add, row, self.forces[g])) if g < len(self.forces) else row))
        return derivatives

    def to_stage_group(self, tables: Sequence[Table]) -> StageGroup:
        """Return the stage group with its gradient as kernel, scattered through ``tables`` (one per gather)."""
        scatters = tuple(
            Scatter(results=results, table=table, power=1 + self.power + gather.power, scale=self.scale * gather.scale)
            for (gather, results), table in zip(self.derivatives(), tables, strict=True)
        )
        return StageGroup(
            name=self.name,
            abscissae=self.abscissae,
            weights=self.weights,
            weight_names=self.weight_names,
            gathers=self.gathers,
            scatters=scatters,
            scalar=self.scalar,
            scalar_power=self.power,
            in_action=self.in_action,
            forced=bool(self.forces),
        )


@contextmanager
def tables_in_two_words() -> Iterator[None]:
    """Let :func:`dyadic` round to twice as many bits, so that entries of size up to 1 are exact in two words."""
    token = _WORDS.set(2)
    try:
        yield
    finally:
        _WORDS.reset(token)


def words_of_tables() -> int:
    """Return the number of words in which tables of variational methods are exact."""
    return _WORDS.get()


def dyadic(entries: Sequence[Sequence[Number]]) -> Matrix:
    """Round to multiples of 2^-52, so that entries of size up to 1 and their differences are exact in binary64."""
    unit = mp.ldexp(1, (float_info.mant_dig - 1) * words_of_tables())
    return tuple(tuple(mp.nint(x * unit) / unit for x in line) for line in entries)


def stationary_increments(
    *,
    stage_groups: Sequence[ScalarStageGroup],
    blocks: tuple[Block, ...],
    end_position: Sequence[Number],
    rows: tuple[Row, ...],
    extrapolation: Matrix | None,
    shape: Shape | None = None,
) -> StageSystem:
    """Return the variational method of G(q0, z, mu, q1) = S(q0, z) + mu . (q0 + h sum_b beta_b z_b - q1).

    The unknowns z are velocities. Stationarity gives p1 = -mu = p0 + dS/dq0 and the rows beta_b p1 - (1/h) dS/dz_b = 0:
    every scatter table is beta_b G_n0 - G_nb with the gather's own G. The map has a generating function for any numbers
    in the tables, rounded ones included (paper (5); :func:`dyadic` makes the differences exact).
    """
    beta, number = tuple(end_position), count(1)
    built = []
    for group in stage_groups:
        tables = []
        for gather in group.gathers:
            lines = [
                [*(beta[b] * line[0] - line[b + 1] for b in range(len(blocks))), line[0]]
                for line in gather.table.entries
            ]
            tables.append(Table.named(f"s{next(number)}", lines))
        built.append(group.to_stage_group(tables))
    return StageSystem(
        blocks=blocks,
        rows=rows,
        stage_groups=tuple(built),
        end_position=Table.named("beta", [(1, *beta)], column=0),
        end_momentum=mp.one,
        end_numbers=("q1", "p1"),
        extrapolation=extrapolation,
        shape=shape,
    )


def stationary_nodal(
    *,
    stage_groups: Sequence[ScalarStageGroup],
    blocks: tuple[Block, ...],
    end_block: int,
    rows: tuple[Row, ...],
    end_numbers: tuple[str, str],
) -> StageSystem:
    """Return the variational method of G(q0, .., q1) in the paper's unknowns, where q1 is the block ``end_block``.

    Rows: p0 + dG/dq0 = 0, then dG/dz = 0 for every other block in order; p1 = dG/dq1 (paper (5), (26), (27)).
    """
    order = [0, *(b + 1 for b in range(len(blocks)) if b != end_block), end_block + 1]
    built = [group.to_stage_group([gather.table.columns(order) for gather in group.gathers]) for group in stage_groups]
    unit = [int(b == end_block) for b in range(len(blocks))]
    return StageSystem(
        blocks=blocks,
        rows=rows,
        stage_groups=tuple(built),
        end_position=Table.named("", [(0, *unit)]),
        end_momentum=mp.zero,
        end_numbers=end_numbers,
    )


def unit_sum(weights: Sequence[Number]) -> Vector:
    """Round weights in [0, 1] to multiples of 2^-52 and adjust the largest so that they sum to exactly 1.

    Weights whose sum is not 1 (of an unusual quadrature) are only rounded.
    """
    rounded = list(dyadic([weights])[0])
    excess = mp.fsum(rounded) - 1
    if abs(excess) < mp.mpf("1e-12"):
        largest = max(range(len(rounded)), key=lambda n: abs(rounded[n]))
        rounded[largest] -= excess
    return tuple(rounded)


@dataclass(frozen=True, slots=True, kw_only=True)
class Velocities(Shape):
    """Unknown velocities V_b of a curve; positions and velocities at the points are linear in them.

        q_n = q0 + h sum_b position[n][b] V_b,    v_n = sum_b velocity[n][b] V_b,    q1 = q0 + h sum_b end[b] V_b,

    If ``variational``, h sum_n weights[n] L(q_n, v_n) is stationary. Otherwise the momenta at the points, which are the
    blocks, are p0 + h sum_j position[n][j] L_q, and p1 = p0 + h sum_n weights[n] L_q.

    Attributes:
        abscissae: (g,) of the points.
        blocks: (s,) abscissae of the velocities.
        position, velocity: (g, s) matrices.
        end: (s,) vector.
        weights: (g,) vector.
        variational: whether the equations are those of a stationary action.
        unrounded: the same shape in 60 digits, if these numbers are rounded to doubles.
    """

    abscissae: Vector
    blocks: Vector
    position: Matrix
    velocity: Matrix
    end: Vector
    weights: Vector
    variational: bool
    unrounded: Velocities | None = None


@dataclass(frozen=True, slots=True)
class Accelerations(Shape):
    """Unknown accelerations at the stages of a tableau in position form; p0 and p1 are L_v at the ends (18)."""

    tableau: Tableau


@dataclass(frozen=True, slots=True)
class ShotCurve(Shape):
    """Accelerations and multipliers at the nodes of a curve; momenta are total derivatives of its action (SCVI)."""

    tableau: Tableau
    rule: Quadrature


@dataclass(frozen=True, slots=True)
class PrintedCurve(Shape):
    """Accelerations at the nodes of a curve; momenta as the paper prints them: (34a), (34d), (34e)."""

    tableau: Tableau
    rule: Quadrature
