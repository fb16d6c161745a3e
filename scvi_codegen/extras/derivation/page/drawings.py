"""Drawings of a page: points of a method, its trial curve with tables, and the pattern of the Jacobian."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import singledispatch
from html import escape
from itertools import accumulate
from typing import Any

import sympy
from sympy import Function, Identity, KroneckerProduct, MatrixSymbol, Symbol

from scvi_codegen.api.formulas import Number, jacobian, mp
from scvi_codegen.api.methods import Method, StageSystem
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.api.text import TableBlock, counted
from scvi_codegen.extras.derivation.equations import StepEquations
from scvi_codegen.extras.derivation.notation import TableEntry
from scvi_codegen.extras.derivation.writing import Content, Drawing, Formula, Paragraph, Section, formulas
from scvi_codegen.methods import SCVI, SVI, Composition, RungeKutta, SpectralCollocation, StoermerVerlet
from scvi_codegen.methods.tables.quadrature import Quadrature

WIDTH, MARGIN, ROW, RADIUS = 640, 30, 74, 5
TALLEST = 30
"""Height of the stem of the largest weight."""
INDEX = '<tspan dy="4" font-size="10">k</tspan>'


def step_drawing(method: Method) -> Drawing | None:
    """Return a drawing with one line per part of the method; ``None`` without parts."""
    if not method.parts:
        return None
    height = ROW * len(method.parts) + 34
    rows = [_row(part, ROW * (k + 1)) for k, part in enumerate(method.parts)]
    ends = _text(MARGIN, height - 8, f"t{INDEX}", "start") + _text(
        WIDTH - MARGIN, height - 8, f't{INDEX}<tspan dy="-4"> + h</tspan>', "end"
    )
    caption = "The step from t_k to t_k + h."
    if any(isinstance(part, Quadrature) for part in method.parts):
        caption = "The step from t_k to t_k + h, quadrature points as high as their weights."
    svg = (
        f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(caption)}" style="--width: {WIDTH}px">'
        f"{''.join(rows)}{ends}</svg>"
    )
    return Drawing(svg, caption)


def _positions(part: Any) -> tuple[Number, ...]:
    """Return the abscissae on the step, in [0, 1], of a tableau, nodes or a quadrature."""
    positions: tuple[Number, ...] = part.c if hasattr(part, "c") else part.abscissae
    return positions


def _row(part: Any, y: int) -> str:
    line = f'<path d="M{MARGIN} {y}H{WIDTH - MARGIN}" stroke="currentColor" opacity="0.4"/>'
    marks = [_mark(float(c), y, stem) for c, stem in zip(_positions(part), _stems(part), strict=True)]
    return line + _text(MARGIN, y - 46, escape(_words(part)), "start") + "".join(marks)


def _mark(c: float, y: int, stem: float | None) -> str:
    x = MARGIN + c * (WIDTH - 2 * MARGIN)
    if stem is None:
        return f'<circle cx="{x:.1f}" cy="{y}" r="{RADIUS}" fill="var(--link)"/>'
    top = y - stem
    return (
        f'<path d="M{x:.1f} {y}V{top:.1f}" stroke="var(--link)" stroke-width="2"/>'
        f'<circle cx="{x:.1f}" cy="{top:.1f}" r="{RADIUS - 1}" fill="var(--paper)" stroke="var(--link)" '
        'stroke-width="2"/>'
    )


def _stems(part: Any) -> list[float | None]:
    """Return heights by weight for a quadrature; ``None`` for nodes and stages."""
    if not isinstance(part, Quadrature):
        return [None] * len(_positions(part))
    weights: tuple[Number, ...] = part.weights
    largest = max(abs(weight) for weight in weights)
    return [float(TALLEST * weight / largest) for weight in weights]


def _words(part: Any) -> str:
    count = len(_positions(part))
    if isinstance(part, Quadrature):
        return f"{counted(count, 'quadrature point')} ({part.name})"
    return f"{counted(count, 'stage' if hasattr(part, 'c') else 'node')} ({part.name})"


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x}" y="{y}" font-size="13" text-anchor="{anchor}">{text}</text>'


CAPTIONS = {
    "l": "l_j(tau_n): cardinal functions at the quadrature points",
    "dl": "Slopes of the cardinal functions l_j at the quadrature points",
    "D": "D_{n,j}: the differentiation matrix (11) on [-1, 1]",
    "DD": "Products of differentiation matrices, for accelerations at the nodes (16)",
    "a": "a_{n,j}: positions from velocities",
    "aa": "(A^2)_{n,j}: positions from accelerations",
    "c": "c_n: positions from the velocity at the start",
    "r": "r_{n,j}: positions along the curve",
    "u": "u_{n,j}: velocities along the curve",
    "bA": "(bA)_j: the position at the end from accelerations",
    "beta": "beta_j: the position at the end",
    "gamma": "gamma_j: the fractions of the step",
}
SHOWN_WITH_PARTS = ("w", "dw", "d", "b")
"""Entries that are part of the tables of quadratures and tableaux."""
SHORT = 40
"""Largest number of characters of an exact form that is shown."""
MOST_CELLS = 40
"""Largest number of rows, and of columns, of a table; of a longer column the first ones are shown."""
tau, j, s = Symbol("tau"), Symbol("j", integer=True), Symbol("s")


def curve_section(method: Method) -> Section:
    """Return the section on the nodes and points of a method, and the curve through them."""
    drawing = step_drawing(method)
    contents = (*_curve(method), *(() if drawing is None else (drawing,)))
    return Section(name="curve", title="The trial curve", contents=contents)


def tables_section(method: Method, entries: tuple[TableEntry, ...]) -> Section:
    """Return the section on nodes, weights, tableaux, and all entries that the equations name."""
    contents: list[Content] = [*method.tables]
    skipped = {*SHOWN_WITH_PARTS, *("ac" if any(hasattr(part, "c") for part in method.parts) else "")}
    for prefix in dict.fromkeys(entry.name.of for entry in entries):
        if prefix not in skipped:
            contents += _entry_table(prefix, [entry for entry in entries if entry.name.of == prefix])
    contents.append(
        Paragraph(
            "Numbers are computed in 60 digits and shown in 17, or as radicals where these are short. Entries that are "
            "0, 1 or -1 have no name: here a dash, in the equations what they are."
        )
    )
    return Section(name="tables", title="Nodes, weights and tables", contents=tuple(contents))


def _entry_table(prefix: str, entries: list[TableEntry]) -> Iterator[Content]:
    """Yield entries of one name: a matrix, or a column if they have one index; say what is left out."""
    cells: dict[tuple[int, ...], Any] = {entry.name.indices: _shown(entry) for entry in entries}
    caption = CAPTIONS.get(prefix, f"{prefix}_{{n,j}}: coefficients of the equations")
    if any(len(index) < 2 for index in cells):
        column = tuple((str(index[-1]), cell) for index, cell in sorted(cells.items()))
        yield TableBlock(columns=("", prefix), rows=column[:MOST_CELLS], name=caption)
        if len(column) > MOST_CELLS:
            yield Paragraph(f"{caption}: the first {MOST_CELLS} of {len(column)} entries.")
        return
    lines, columns = ({index[k] for index in cells} for k in range(2))
    if max(len(lines), len(columns)) > MOST_CELLS:
        yield Paragraph(f"{caption}: {len(lines)} rows and {len(columns)} columns, not shown.")
        return
    rows = tuple((str(n), *(cells.get((n, column)) for column in sorted(columns))) for n in sorted(lines))
    yield TableBlock(columns=("n", *(f"j = {column}" for column in sorted(columns))), rows=rows, name=caption)


def _shown(entry: TableEntry) -> Any:
    is_short = entry.exact is not None and len(str(entry.exact)) <= SHORT
    return entry.exact if is_short else str(mp.nstr(entry.value, 17))


@singledispatch
def _curve(method: Method) -> Iterator[Content]:
    """Yield the description of the curve of a method, if there is one."""
    return iter(())


@_curve.register
def _(method: SVI) -> Iterator[Content]:
    if method.curves.nodal:
        yield from _nodal(method.degree)
    else:
        yield Paragraph(
            f"Curves of the space '{method.curves.name}', given by their velocities V_j at "
            f"{method.curves.dimension(method.degree)} points. The discrete Lagrangian is the quadrature of L along "
            "the curve, and stationary in what is inside:"
        )
    yield from _action("25")


@_curve.register
def _(method: SpectralCollocation) -> Iterator[Content]:
    if method.form == "position":
        yield from _nodal(method.degree)
        yield Paragraph("It satisfies the Euler-Lagrange equations at nodes 1 to s; there is no equation at node 0.")
    else:
        yield _stages(method.form)
    yield from kronecker_form(method)


@_curve.register
def _(method: RungeKutta) -> Iterator[Content]:
    yield _stages(method.form)


def _stages(form: str) -> Paragraph:
    where = "Hamilton's equations" if form == "phase-space" else "(q, v)"
    return Paragraph(
        f"Stages of a Runge-Kutta method on {where}, (22): positions at c_i are q_k and the velocities of the "
        "stages, weighted by the tableau."
    )


@_curve.register
def _(method: StoermerVerlet) -> Iterator[Content]:
    yield Paragraph(
        "The Lobatto IIIA-IIIB pair of two stages, at both ends of the step. For constant masses it is the "
        "leapfrog scheme: half a kick, a drift, half a kick."
    )


@_curve.register
def _(method: Composition) -> Iterator[Content]:
    yield Paragraph(
        f"{counted(len(method.fractions), 'leapfrog step')} of sizes gamma_j h one after the other: kicks by forces "
        "and drifts with constant velocity in turn."
    )


def _nodal(degree: int) -> Iterator[Content]:
    yield Paragraph(
        f"The polynomial of degree s = {degree} through the positions Q^j at the nodes, Q^0 = q_k; l_j are the "
        "cardinal functions, tau in [-1, 1] is time on the step:"
    )
    cardinal = Function("l_j")(tau)
    yield Formula(sympy.Sum(Symbol("Q__j") * cardinal, (j, 0, s)), Function("q")(tau))


def kronecker_form(method: SpectralCollocation) -> Iterator[Paragraph | Formula]:
    """Yield (18), (21) with letters for matrices."""
    s, m = method.degree, Symbol("m", integer=True, positive=True)
    A, a0 = MatrixSymbol("A", s, s), MatrixSymbol("a_0", s, 1)
    q0, p0, v0 = (MatrixSymbol(name, m, 1) for name in ("q_k", "p_k", "v_k"))
    Q, P, V, G, rates = (MatrixSymbol(name, s * m, 1) for name in ("Q", "P", "V", "G", "Q_ddot"))
    yield Paragraph(
        "In matrices, A the differentiation matrix on the step without the row of node 0, a_0 its column of node 0, "
        "and what belongs to the nodes one below the other:"
    )
    if method.form == "position":
        partials = KroneckerProduct(A**2, Identity(m)) * Q + KroneckerProduct(a0, v0) + KroneckerProduct(A * a0, q0)
        yield Formula(rates, partials, "18")
        yield Paragraph("where the accelerations on the right solve the Euler-Lagrange equations at the nodes.")
    else:
        once = KroneckerProduct(A, Identity(m))
        yield Formula(V, once * Q + KroneckerProduct(a0, q0), "21")
        yield Formula(G, once * P + KroneckerProduct(a0, p0), "21")
        yield Paragraph("where V and G are H_p and -H_q at the nodes.")


def _action(number: str) -> Iterator[Content]:
    n, g, h = Symbol("n", integer=True), Symbol("g"), Symbol("h")
    tau = Symbol("tau_n")
    L = Function("L")(Function("q")(tau), Function("q_dot")(tau), Symbol("t_n"))
    yield Paragraph("The discrete Lagrangian is the quadrature of L along it:")
    yield Formula(h / 2 * sympy.Sum(Symbol("w_n") * L, (n, 1, g)), Symbol("L_d"), number)


@_curve.register
def _(method: SCVI) -> Iterator[Content]:
    if method.abscissae is None:
        yield from _nodal(method.degree)
        yield Paragraph("It satisfies the Euler-Lagrange equations at nodes 1 to s, E_i = 0 (34a), v_0 at its start.")
    else:
        yield Paragraph(
            f"The collocation solution of the Euler-Lagrange equations on {method.places}: v_0 the velocity at the "
            "start, z_i the accelerations at the abscissae times h."
        )
    yield from _action("33")
    if method.variational and (method.degree > 1 or method.abscissae is not None):
        i = Symbol("i", integer=True)
        terms = sympy.Sum(Symbol("lambda_i") * Symbol("E_i"), (i, 1, s))
        yield Paragraph(
            "The curve depends on both ends. With multipliers for this dependence the discrete Lagrangian is "
            "differentiated in full; the stationary function is"
        )
        yield Formula(Symbol("L_d") + terms, Symbol("G"))
    elif not method.variational:
        yield Paragraph(
            "As printed in the paper, partial derivatives of L_d replace total ones: with more than two nodes the "
            "step is not symplectic."
        )


SIDE = 320
"""Width of the picture in pixels."""
LARGEST_DRAWN = 400
"""Largest number of rows of a matrix of which every entry is drawn."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """Sparsity pattern of a square matrix of ``size`` rows: by row, the ascending columns of nonzero entries."""

    size: int
    rows: tuple[tuple[int, ...], ...]

    @property
    def entries(self) -> int:
        """Number of nonzero entries."""
        return sum(map(len, self.rows))


def jacobian_pattern(stages: StageSystem, dimension: int) -> Pattern:
    """Return the pattern of the residuals with respect to the unknowns, in the order of the equations, by blocks."""
    offsets = [0, *accumulate(stages.block_sizes(dimension))]
    lines = [0, *accumulate(stages.row_sizes(dimension))]
    columns: list[set[int]] = [set() for _ in range(lines[len(stages.rows)])]
    for group in stages.stage_groups:
        for scatter in group.scatters:
            for gather in group.gathers:
                pairs = jacobian(scatter.results, gather.arguments)
                for r, b in _coupled_pairs(scatter.table.entries, gather.table.entries, len(stages.rows)):
                    for i, j in pairs:
                        columns[lines[r] + i].add(offsets[b] + j)
    return Pattern(len(columns), tuple(tuple(sorted(row)) for row in columns))


def _coupled_pairs(
    rows: Iterable[tuple[object, ...]], blocks: Iterable[tuple[object, ...]], count: int
) -> set[tuple[int, int]]:
    return {
        (r, b - 1)
        for row, block in zip(rows, blocks, strict=True)
        for r in range(count)
        if row[r] != 0
        for b in range(1, len(block))
        if block[b] != 0
    }


def pattern_drawing(pattern: Pattern, unknowns: Sequence[str] = ()) -> Drawing | None:
    """Return a picture of the matrix, ``None`` if it is too large; with names of unknowns its entries have tooltips."""
    if pattern.size > LARGEST_DRAWN:
        return None
    cell = SIDE / pattern.size
    runs = [
        f"M{first * cell:.2f} {r * cell:.2f}h{length * cell:.2f}v{cell:.2f}h{-length * cell:.2f}z"
        for r, row in enumerate(pattern.rows)
        for first, length in _runs(row)
    ]
    share = 100 * pattern.entries / pattern.size**2
    caption = (
        f"The Jacobian: {pattern.size} rows and columns, {pattern.entries} entries that are not zero "
        f"({share:.0f} per cent)."
    )
    svg = (
        f'<svg viewBox="-1 -1 {SIDE + 2} {SIDE + 2}" role="img" aria-label="{caption}" '
        f'style="--width: {SIDE}px; min-width: 0">'
        f'<path d="{"".join(runs)}" fill="var(--link)"/>{"".join(_tooltips(pattern, unknowns, cell))}'
        f'<path d="M0 0H{SIDE}V{SIDE}H0z" fill="none" stroke="currentColor" opacity="0.5"/></svg>'
    )
    return Drawing(svg, caption)


def _tooltips(pattern: Pattern, unknowns: Sequence[str], cell: float) -> Iterator[str]:
    """Yield the tooltips of entries: the equation and the unknown."""
    for i, row in enumerate(pattern.rows if unknowns else ()):
        for j in row:
            geometry = f'x="{j * cell:.2f}" y="{i * cell:.2f}" width="{cell:.2f}" height="{cell:.2f}"'
            yield f'<rect class="entry" {geometry}><title>equation {i + 1} by {escape(unknowns[j])}</title></rect>'


def _runs(columns: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return first column and length of every run of neighbours."""
    runs: list[tuple[int, int]] = []
    for column in columns:
        if runs and sum(runs[-1]) == column:
            runs[-1] = (runs[-1][0], runs[-1][1] + 1)
        else:
            runs.append((column, 1))
    return runs


LARGEST_SHOWN = 3
"""Largest number of rows of a Jacobian whose entries are typeset."""
MOST_TITLED = 1000
"""Largest number of entries of a Jacobian with tooltips."""


def jacobian_section(
    system: MechanicalSystem, stages: StageSystem, derived: StepEquations | None, program: Any
) -> Section:
    """Return the section on the sparsity pattern of the Jacobian."""
    pattern = jacobian_pattern(stages, system.dimension)
    titled = derived is not None and pattern.entries <= MOST_TITLED
    drawing = pattern_drawing(pattern, [str(z) for z in derived.unknowns] if derived is not None and titled else ())
    text = (
        f"Derivatives of the {pattern.size} equations with respect to the {pattern.size} unknowns: {pattern.entries} "
        f"of {pattern.size**2} entries are structurally nonzero. It is assembled by sums over the points "
        "from the derivatives of the kernels, the same expressions at every point."
    )
    contents: list[Content] = [Paragraph(text)]
    contents += [] if drawing is None else [drawing]
    if derived is not None and pattern.size <= LARGEST_SHOWN:
        entries = derived.jacobian.todok().items()
        contents += formulas([Formula(value, Symbol(f"J_{i + 1}_{j + 1}")) for (i, j), value in entries], "entry")
    equations = program.equations
    if program.newton:
        contents.append(
            Paragraph(
                f"Compiled, the unknowns of Newton's method are {equations.blocks} velocities or accelerations per "
                f"coordinate, {equations.unknowns} numbers. In the chosen ordering, coupled coordinates are at most "
                f"{equations.bandwidth} apart, and the matrix is banded, or full if that is smaller."
            )
        )
    else:
        contents.append(
            Paragraph("The step is explicit, or solved by fixed-point iteration alone: the C has no Jacobian.")
        )
    return Section(name="jacobian", title="Jacobian", contents=tuple(contents))
