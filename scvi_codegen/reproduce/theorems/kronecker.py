"""Section 2.1.1: spectral collocation in matrix form, (18) and (21), by Lemmas 2.1 and 2.2."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product

import sympy

from scvi_codegen.derivation.equations import derive
from scvi_codegen.derivation.page.curve import kronecker_form
from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods import SpectralCollocation
from scvi_codegen.models.problems import problem
from scvi_codegen.reproduce.laboratory.experiment import (
    Block,
    Comparison,
    Paragraph,
    Result,
    TableBlock,
    Verdict,
    experiment,
    holds,
)
from scvi_codegen.tables.precision import mp

TITLE = "Spectral collocation with Kronecker products, (18) and (21)"
FORMS = {"position": "18", "phase-space": "21"}
SHOWN_DEGREE, DEGREES = 2, (1, 2, 3)
STATES = {"planar-pendulum": (("0.7",), ("0.4",)), "double-pendulum": (("0.7", "-0.4"), ("0.3", "0.2"))}
"""States (q, p); the mass matrix of the second system is full and not constant."""
STEP = mp.mpf(1) / 10
VANISHES = 1e-40


def lemma_differences() -> tuple[sympy.Matrix, sympy.Matrix]:
    """Return left less right side of Lemma 2.1 (symbolic 2 x 3, 3 x 2, 2 x 4) and of Lemma 2.2 (columns)."""
    A, B, C = _letters("a", 2, 3), _letters("b", 3, 2), _letters("c", 2, 4)
    left, right = _letters("a", 3, 1), _letters("b", 4, 1)
    first = _vec(A * B * C) - sympy.kronecker_product(A, C.T) * _vec(B)
    return first.expand(), (_vec(left * right.T) - sympy.kronecker_product(left, right)).expand()


def _letters(name: str, rows: int, columns: int) -> sympy.Matrix:
    return sympy.Matrix(rows, columns, sympy.symbols(f"{name}:{rows * columns}"))


def _vec(matrix: sympy.Matrix) -> sympy.Matrix:
    """Return the rows of a matrix stacked atop one another (Definition 2.2)."""
    return sympy.Matrix(list(matrix))


def residual(name: str, form: str, degree: int) -> float:
    """Return the largest row of (18) or (21) at the solution of the scalar equations of the step, in 60 digits."""
    system, method = problem(name).system, SpectralCollocation(degree, form=form)
    derived, (q, p) = derive(system, method), STATES[name]
    solved = derived_step(system, method)([*map(mp.mpf, q)], [*map(mp.mpf, p)], STEP)
    symbols = [*derived.unknowns, *derived.state[0], *derived.state[1], derived.time, derived.step]
    numbers = [*solved.unknowns, *map(mp.mpf, (*q, *p)), mp.zero, STEP]
    values = {symbol: sympy.Float(str(number), 50) for symbol, number in zip(symbols, numbers, strict=True)}
    values |= {s: sympy.Float(x, 50) for s, x in zip(system.parameters, system.defaults, strict=True)}  # as doubles
    return float(max(abs(row.xreplace(values).evalf(50)) for row in derived.matrix_form().residual))


def _body() -> Iterator[Block]:
    yield Paragraph(
        "vec stacks the rows of a matrix. Lemma 2.1, vec(A B C) = (A x C^T) vec(B), turns the differentiation of all "
        "coordinates at all nodes into one matrix that acts on one column; Lemma 2.2, vec(A B^T) = A x B, does it for "
        "the known state. x is Kronecker's product."
    )
    for form in FORMS:
        yield Paragraph(f"In {'positions' if form == 'position' else 'phase space'}:")
        yield from kronecker_form(SpectralCollocation(SHOWN_DEGREE, form=form))


@experiment("section-2.1", "Spectral collocation with Kronecker products, (18) and (21)")
def _run(_: Mapping[str, Result]) -> Result:
    rows = [(name, f"({FORMS[form]})", s, residual(name, form, s)) for name, form, s in product(STATES, FORMS, DEGREES)]
    first, second = lemma_differences()
    largest = max(row[-1] for row in rows)
    return Result(
        setting=(
            f"One step h = {mp.nstr(STEP, 3)} of the pendulum and of the double pendulum, whose masses are not "
            f"constant, so that (18) and (21) are two methods; degree {DEGREES[0]} to {DEGREES[-1]}.",
            "The equations are written out without matrices and solved in 60 digits; then they are put into (18) and "
            "(21). The lemmas are checked for matrices of letters.",
        ),
        checks=(
            Comparison(
                claim="vec(A B C) = (A x C^T) vec(B) and vec(A B^T) = A x B, with vec by rows (Lemmas 2.1, 2.2).",
                measured=f"For letters, 2 x 3, 3 x 2 and 2 x 4: {sum(d != 0 for d in (*first, *second))} of "
                f"{len(first) + len(second)} entries differ.",
                verdict=holds(first.is_zero_matrix is True and second.is_zero_matrix is True),
            ),
            Comparison(
                claim="(18) and (21) are the equations of spectral collocation.",
                measured=f"The largest of their rows is {largest:.0e} where the written-out equations are solved.",
                verdict=holds(largest < VANISHES),
            ),
            Comparison(
                claim="(21) adds d0 x q0 and d0 x p0.",
                measured="d0 is not defined; it is a0, the column of (12), with which the rows vanish.",
                verdict=Verdict.SHOWN,
            ),
        ),
        tables=(TableBlock(columns=("problem", "form", "degree", "largest row"), rows=tuple(rows)),),
        body=tuple(_body()),
    )
