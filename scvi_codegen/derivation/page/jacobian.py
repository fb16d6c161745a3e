"""Sparsity pattern of the Jacobian of the stage equations, from the tables and the derivatives of kernels."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import accumulate

from sympy import Symbol

from scvi_codegen.derivation.equations import StepEquations
from scvi_codegen.display.page.blocks import Content, Drawing, Formula, Paragraph, Section, formulas
from scvi_codegen.formulas.expressions import jacobian
from scvi_codegen.ir.program import Program
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import StageSystem

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
    system: MechanicalSystem, stages: StageSystem, derived: StepEquations | None, program: Program
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
