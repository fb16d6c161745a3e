"""The shape every method shares: points on the step, a small symbolic kernel at each, and tables of numbers between.

A step from (t, q0, p0) with step size h has unknown *blocks* z_1 .. z_B, of m components each unless they say otherwise
(multipliers of constraints). At point n of a *family*
(quadrature points, collocation nodes, the start, the end) the arguments of a kernel are *gathered* from the unknowns,

    u_n = scale h^power (G_n0 q0 + sum_b h^(power of b) G_nb z_b),                       t_n = t + c_n h,

the kernel phi (results in the arguments, time and parameters) is evaluated, its results are *scattered* into rows,

    R_r = (momentum coefficient) p0 + sum_families sum_n scale w_n h^(power + power of r) S_nr phi(u_n) = 0,

the last column of S belonging to p1, which is a row like the others; q1 is one more gather. With damping gamma weights
are w_n e^(gamma c_n h), and the row of p1 gives e^(gamma h) p1. The symbolic work is the
kernel: it knows neither the degree nor the number of points. Everything else is a table, kept in 60 digits.

Two parametrisations of the same method use this shape. The *paper's* has the positions Q^v at the nodes as unknowns;
``derive`` shows it. The *compiled* one has velocities as unknowns: its tables are free of h, the known state enters as
"q0" and "p0" alone, and p1 = p0 + increments, so nothing cancels for small steps or far from the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import count

import sympy

from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp

__all__ = [
    "Block",
    "Gather",
    "PointFamily",
    "Row",
    "ScalarFamily",
    "Scatter",
    "Shape",
    "StageSystem",
    "Table",
    "dyadic",
    "stationary_increments",
    "stationary_nodal",
]

DYADIC_BITS = 52
ROUNDING = mp.mpf("1e-50")
"""Entries below are what rounding leaves of sums that are 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A matrix of numbers, each with a name for display.

    Attributes:
        entries: one row a point, one column a block; 60-digit numbers.
        names: parallel to ``entries``; ``""`` marks an entry shown as its value (0, 1, -1).
    """

    entries: Matrix
    names: tuple[tuple[str, ...], ...]

    @classmethod
    def named(cls, prefix: str, entries: Sequence[Sequence[Number]], *, row: int = 1, column: int = 1) -> Table:
        """Name the entries ``prefix_n_b``, counting from ``row`` and ``column``; 0, 1 and -1 stay anonymous."""
        rows = tuple(tuple(mp.mpf(x) if abs(x) > ROUNDING else mp.zero for x in line) for line in entries)
        names = tuple(
            tuple("" if x in (0, 1, -1) else f"{prefix}_{n}_{b}" for b, x in enumerate(line, column))
            for n, line in enumerate(rows, row)
        )
        return cls(entries=rows, names=names)

    @classmethod
    def joined(cls, *tables: Table) -> Table:
        """The tables side by side."""
        return cls(
            entries=tuple(sum(rows, ()) for rows in zip(*(table.entries for table in tables), strict=True)),
            names=tuple(sum(rows, ()) for rows in zip(*(table.names for table in tables), strict=True)),
        )

    @classmethod
    def constant(cls, points: int, columns: int, value: int = 0) -> Table:
        """A table of one small integer."""
        return cls.named("", [[value] * columns] * points)

    @classmethod
    def identity(cls, size: int, sign: int = 1) -> Table:
        """The identity matrix, or its negative."""
        return cls.named("", [[sign * int(i == j) for j in range(size)] for i in range(size)])

    def columns(self, indices: Sequence[int]) -> Table:
        """The columns named, in that order."""
        return Table(
            entries=tuple(tuple(line[i] for i in indices) for line in self.entries),
            names=tuple(tuple(line[i] for i in indices) for line in self.names),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Unknowns of one kind: ``Q_1`` (position, power 0), ``V_3`` (velocity, power 1), ``lambda_2``, ``v_0``.

    Attributes:
        name: its symbol in displayed equations.
        power: the power of h that makes it a position.
        straight: (a, b) of the straight-line guess z = a q0 + b h^(1 - power) v0.
        momentum: coefficient of p0 in that guess.
        moves: whether it is measured in positions, once multiplied by h^power; momenta and their multipliers are not.
        size: how many components it has; ``None``: m. Other blocks than of m components begin with 0, and q1 does not
            depend on them.
    """

    name: str
    power: int
    straight: tuple[Number, Number]
    momentum: int = 0
    moves: bool = True
    size: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Equations: their number in the paper, kind (``"stage"``, ``"IDEL"``), coefficient of p0, extra power of h, size.

    ``size`` is how many they are, m unless it is said; then p0 does not occur in them.
    """

    number: str
    kind: str
    momentum: Number
    power: int = 0
    size: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Gather:
    """Kernel arguments u_n = scale h^power (G_n0 q0 + sum_b h^(power of b) G_nb z_b); column 0 multiplies q0.

    They are as many as the blocks have components that are gathered; columns of other blocks are 0.
    """

    arguments: tuple[sympy.Symbol, ...]
    table: Table
    power: int
    scale: Fraction = Fraction(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatter:
    """Kernel results, added to row r as h^(power + power of r) S_nr phi_n; the last column of S belongs to p1.

    They are as many as the rows have equations to which they are added; columns of other rows are 0.
    """

    results: tuple[sympy.Expr, ...]
    table: Table
    power: int
    scale: Fraction = Fraction(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointFamily:
    """Points c_n in [0, 1] with weights, evaluated by one kernel.

    Where the kernel is the gradient of a ``scalar``, sum_n w_n h^(1 + scalar_power) scalar(u_n) is part of a generating
    function, and of the discrete Lagrangian if ``in_action``; where it is ``forced``, forces stand beside the gradient.
    ``computes`` says what the kernel gives, where its name does not.
    """

    name: str
    abscissae: Vector
    weights: Vector
    gathers: tuple[Gather, ...]
    scatters: tuple[Scatter, ...]
    weight_names: tuple[str, ...]
    scalar: sympy.Expr | None = None
    scalar_power: int = 0
    in_action: bool = False
    forced: bool = False
    computes: str = ""

    @property
    def arguments(self) -> tuple[sympy.Symbol, ...]:
        """All kernel arguments, gather after gather."""
        return sum((gather.arguments for gather in self.gathers), ())

    @property
    def results(self) -> tuple[sympy.Expr, ...]:
        """All kernel results, scatter after scatter."""
        return sum((scatter.results for scatter in self.scatters), ())


class Shape:
    """Base of what a solver without a matrix must know of stage equations: :mod:`scvi_codegen.methods.shapes`."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class StageSystem:
    """The equations of one step of one method for one system, points and tables not yet multiplied out.

    Attributes:
        blocks: the unknowns.
        rows: the equations, as many as blocks.
        families: where the kernels are evaluated.
        end_position: one row, 1 + B columns: q1 = E_0 q0 + sum_b h^(power of b) E_b z_b.
        end_momentum: coefficient of p0 in p1.
        end_numbers: the paper's numbers of the equations for q1 and p1.
        extrapolation: (B, B) matrix from the unknowns of one step to a guess for the next, or ``None``.
        damping: gamma, a formula of parameters.
        shape: what a solver without a matrix must know of the equations, or ``None``: only Newton's iteration is left.
    """

    blocks: tuple[Block, ...]
    rows: tuple[Row, ...]
    families: tuple[PointFamily, ...]
    end_position: Table
    end_momentum: Number
    end_numbers: tuple[str, str]
    extrapolation: Matrix | None = None
    shape: Shape | None = None
    damping: sympy.Expr = sympy.S.Zero

    def block_sizes(self, dimension: int) -> tuple[int, ...]:
        """How many components each block has."""
        return tuple(dimension if block.size is None else block.size for block in self.blocks)

    def row_sizes(self, dimension: int) -> tuple[int, ...]:
        """How many equations each row has; the last are the m of p1."""
        return (*(dimension if row.size is None else row.size for row in self.rows), dimension)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalarFamily:
    """Points whose weighted sum sum_n scale w_n h^(1 + power) s(u_n) is part of a generating function.

    ``forces`` f_g, for the first gathers, stand beside its slopes, as in the principle of Lagrange and d'Alembert: the
    variation is ds + sum_g f_g . du_g.
    """

    name: str
    abscissae: Vector
    weights: Vector
    weight_names: tuple[str, ...]
    gathers: tuple[Gather, ...]
    scalar: sympy.Expr
    power: int = 0
    scale: Fraction = Fraction(1)
    in_action: bool = True
    forces: tuple[tuple[sympy.Expr, ...], ...] = ()

    def slopes(self) -> list[tuple[Gather, tuple[sympy.Expr, ...]]]:
        """The derivatives of the scalar and the forces, one tuple of m a gather."""
        slopes = []
        for g, gather in enumerate(self.gathers):
            entries = gradient(self.scalar, gather.arguments)
            own = tuple(entries.get(i, sympy.S.Zero) for i in range(len(gather.arguments)))
            slopes.append((gather, tuple(map(sympy.Add, own, self.forces[g])) if g < len(self.forces) else own))
        return slopes

    def point_family(self, tables: Sequence[Table]) -> PointFamily:
        """The family with its gradient as kernel, scattered through ``tables`` (one a gather)."""
        scatters = tuple(
            Scatter(
                results=results,
                table=table,
                power=1 + self.power + gather.power,
                scale=self.scale * gather.scale,
            )
            for (gather, results), table in zip(self.slopes(), tables, strict=True)
        )
        return PointFamily(
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


def dyadic(entries: Sequence[Sequence[Number]]) -> Matrix:
    """Round to multiples of 2^-52, so that entries of size up to 1 and their differences are exact in binary64."""
    unit = mp.ldexp(1, DYADIC_BITS)
    return tuple(tuple(mp.nint(x * unit) / unit for x in line) for line in entries)


def stationary_increments(
    *,
    families: Sequence[ScalarFamily],
    blocks: tuple[Block, ...],
    end_position: Sequence[Number],
    rows: tuple[Row, ...],
    extrapolation: Matrix | None,
    shape: Shape | None = None,
) -> StageSystem:
    """The variational method of G(q0, z, mu, q1) = S(q0, z) + mu . (q0 + h sum_b beta_b z_b - q1), unknowns velocities.

    Stationarity gives p1 = -mu = p0 + dS/dq0 and the rows beta_b p1 - (1/h) dS/dz_b = 0: every scatter table is
    beta_b G_n0 - G_nb with the gather's own G. The map has a generating function whatever the numbers in the tables,
    rounded ones included (paper (5); see :func:`dyadic` for why the differences lose nothing).
    """
    beta, number = tuple(end_position), count(1)
    built = []
    for family in families:
        tables = []
        for gather in family.gathers:
            lines = [
                [*(beta[b] * line[0] - line[b + 1] for b in range(len(blocks))), line[0]]
                for line in gather.table.entries
            ]
            tables.append(Table.named(f"s{next(number)}", lines))
        built.append(family.point_family(tables))
    return StageSystem(
        blocks=blocks,
        rows=rows,
        families=tuple(built),
        end_position=Table.named("beta", [(1, *beta)], column=0),
        end_momentum=mp.one,
        end_numbers=("q1", "p1"),
        extrapolation=extrapolation,
        shape=shape,
    )


def stationary_nodal(
    *,
    families: Sequence[ScalarFamily],
    blocks: tuple[Block, ...],
    end_block: int,
    rows: tuple[Row, ...],
    end_numbers: tuple[str, str],
) -> StageSystem:
    """The variational method of G(q0, .., q1) in the paper's unknowns, q1 being the block ``end_block``.

    Rows: p0 + dG/dq0 = 0, then dG/dz = 0 for every other block in order; p1 = dG/dq1 (paper (5), (26), (27)).
    """
    order = [0, *(b + 1 for b in range(len(blocks)) if b != end_block), end_block + 1]
    built = [family.point_family([gather.table.columns(order) for gather in family.gathers]) for family in families]
    unit = [int(b == end_block) for b in range(len(blocks))]
    return StageSystem(
        blocks=blocks,
        rows=rows,
        families=tuple(built),
        end_position=Table.named("", [(0, *unit)]),
        end_momentum=mp.zero,
        end_numbers=end_numbers,
    )
