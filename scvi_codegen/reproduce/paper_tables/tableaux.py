"""Tables 1 to 3: the Gauss tableaux as printed, compared with the collocation integrals (23)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeAlias

import sympy

from scvi_codegen.reproduce.laboratory.experiment import (
    Block,
    Comparison,
    Formula,
    Paragraph,
    Result,
    TableBlock,
    Verdict,
    experiment,
    judged,
)
from scvi_codegen.tables.closed_forms import exact_tableau
from scvi_codegen.tables.precision import Number, mp
from scvi_codegen.tables.tableau import Tableau, gauss

Exact: TypeAlias = tuple[tuple[tuple[sympy.Expr, ...], ...], tuple[sympy.Expr, ...], tuple[sympy.Expr, ...]]
AGREES = mp.mpf("1e-50")

PRINTED: Mapping[int, tuple[str, ...]] = {
    1: (
        "1/2 - sqrt(3)/6 : 1/4, 1/4 - sqrt(3)/6",
        "1/2 + sqrt(3)/6 : 1/4 + sqrt(3)/6, 1/4",
        "1/2, 1/2",
    ),
    2: (
        "1/2 - sqrt(15)/10 : 5/36, 2/9 - sqrt(15)/15, 5/36 - sqrt(15)/30",
        "1/2 : 5/36 + sqrt(15)/24, 2/9, 5/36 - sqrt(15)/24",
        "1/2 + sqrt(15)/10 : 5/36 + sqrt(15)/30, 2/9 + sqrt(15)/15, 5/36",
        "5/18, 4/9, 5/18",
    ),
    3: (
        "2*w1 + 2*v1 - 2*w3 - w5 : w1, v1 - w3 + v4, v1 - w3 - v4, w1 - w5",
        "2*w1 + 2*v1 - 2*v3 - v5 : w1 - v3 + w4, v1, v1 - v5, w1 - v3 - w4",
        "2*w1 + 2*v1 + 2*v3 + v5 : w1 + v3 + w4, v1 + v5, v1, w1 - v3 - w4",
        "2*w1 + 2*v1 + 2*w3 + w5 : w1 + w5, v1 + w3 + v4, v1 + w3 - v4, w1",
        "2*w1, 2*v1, 2*v1, 2*w1",
    ),
}
"""Rows c_i : a_i1, .., a_is and finally b_1, .., b_s, as the paper prints them; v denotes w'."""

CORRECTED: Mapping[int, tuple[tuple[int, int, str], ...]] = {3: ((2, 3, "w1 + v3 - w4"),)}
"""Corrected entries of A (indices from 0), used when a table is typeset."""

LETTERS: Mapping[str, str] = {
    "w1": "1/8 - sqrt(30)/144",
    "v1": "1/8 + sqrt(30)/144",
    "w2": "sqrt((15 + 2*sqrt(30))/35)/2",
    "v2": "sqrt((15 - 2*sqrt(30))/35)/2",
    "w3": "w2*(1/6 + sqrt(30)/24)",
    "v3": "v2*(1/6 - sqrt(30)/24)",
    "w4": "w2*(1/21 + 5*sqrt(30)/168)",
    "v4": "v2*(1/21 - 5*sqrt(30)/168)",
    "w5": "w2 - 2*w3",
    "v5": "v2 - 2*v3",
}
"""Symbols in which Table 3 is written."""

NAMES = {letter: sympy.Symbol(f"w_{letter[1]}" if letter[0] == "w" else f"w__'_{letter[1]}") for letter in LETTERS}


def _gauss_table(number: int, s: int, _: Mapping[str, Result]) -> Result:
    exact = exact_tableau(gauss(s))
    assert exact is not None
    printed = _printed(number, _letter_values())
    return Result(
        setting=(
            f"Printed entries are evaluated in 60 digits and compared with the collocation integrals (23) on the {s} "
            "Gauss-Legendre points; they agree if they differ by less than 1e-50.",
            "Order and symplecticity are identities in square roots, checked by exact arithmetic.",
        ),
        checks=(
            _entries_check(number, printed, gauss(s)),
            _order_check(printed, exact, s),
            _symplectic_check(printed, exact),
        ),
        tables=(_entries_table(number, printed, gauss(s)),),
        body=tuple(_typeset(number)),
    )


def _rows(number: int) -> tuple[list[str], list[list[str]]]:
    """Return the texts of c, then of the rows of A and b."""
    *stages, weights = PRINTED[number]
    split = [row.split(" : ") for row in stages]
    return [c for c, _ in split], [row.split(", ") for row in (*(row for _, row in split), weights)]


def _expression(text: str, letters: Mapping[str, sympy.Expr]) -> sympy.Expr:
    return sympy.sympify(text, locals=dict(letters))


def _letter_values() -> dict[str, sympy.Expr]:
    values: dict[str, sympy.Expr] = {}
    for letter, text in LETTERS.items():
        values[letter] = _expression(text, values)
    return values


def _printed(number: int, letters: Mapping[str, sympy.Expr]) -> Exact:
    """Return (A, b, c) as the paper prints them."""
    abscissae, rows = _rows(number)
    *A, b = (tuple(_expression(text, letters) for text in row) for row in rows)
    return tuple(A), b, tuple(_expression(text, letters) for text in abscissae)


def _number(expression: sympy.Expr) -> Number:
    return mp.mpf(str(sympy.N(expression, 60)))


def _labelled(A: Sequence[Sequence[Any]], b: Sequence[Any], c: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    for i, row in enumerate(A, start=1):
        yield f"c_{i}", c[i - 1]
        yield from ((f"a_{i}{j}", value) for j, value in enumerate(row, start=1))
    yield from ((f"b_{j}", value) for j, value in enumerate(b, start=1))


def _entries_table(number: int, printed: Exact, computed: Tableau) -> TableBlock:
    abscissae, rows = _rows(number)
    texts = [text.replace("v", "w'") for _, text in _labelled(rows[:-1], rows[-1], abscissae)]
    values = [_number(value) for _, value in _labelled(*printed)]
    result = list(_labelled(computed.A, computed.b, computed.c))
    return TableBlock(
        columns=("entry", "as printed", "its value", "by (23)", "difference"),
        rows=tuple(
            (label, f"{text}", float(value), float(exact), float(abs(value - exact)))
            for text, value, (label, exact) in zip(texts, values, result, strict=True)
        ),
        formats={"its value": ".15f", "by (23)": ".15f", "difference": ".1e"},
    )


def _entries_check(number: int, printed: Exact, computed: Tableau) -> Comparison:
    table = _entries_table(number, printed, computed)
    wrong = [row for row in table.rows if row[-1] > AGREES]
    named = "; ".join(
        f"{label} is printed {text} = {value:.6f}, it is {right:.6f}" for label, text, value, right, _ in wrong
    )
    count = len(table.rows)
    return Comparison(
        claim=f"Table {number} lists the coefficients (23) of the Gauss method with {computed.stages} stages.",
        measured=f"{count - len(wrong)} of {count} printed entries agree to 50 digits"
        + (f"; {named}." if wrong else "."),
        verdict=Verdict.HOLDS if not wrong else Verdict.PARTLY if len(wrong) < count else Verdict.FAILS,
    )


def _numeric(exact: Exact, name: str) -> Tableau:
    A, b, c = exact
    return Tableau(
        name=name,
        A=tuple(tuple(map(_number, row)) for row in A),
        b=tuple(map(_number, b)),
        c=tuple(map(_number, c)),
    )


def _order_check(printed: Exact, exact: Exact, s: int) -> Comparison:
    residuals = list(order_residuals(exact))
    zero, order = sum(residual == 0 for residual in residuals), _numeric(printed, "printed").order
    return Comparison(
        claim=f"The method has order {2 * s}.",
        measured=f"{zero} of the {len(residuals)} conditions B({2 * s}), C({s}), D({s}), which together give order "
        f"{2 * s}, hold exactly for the closed form; the entries as printed give order {order}.",
        verdict=judged(zero == len(residuals), order == 2 * s),
    )


def _symplectic_check(printed: Exact, exact: Exact) -> Comparison:
    residuals = list(symplectic_residuals(exact))
    zero, satisfied = sum(residual == 0 for residual in residuals), _numeric(printed, "printed").is_symplectic
    return Comparison(
        claim="Gauss methods are symplectic.",
        measured=f"{zero} of the {len(residuals)} conditions b_i a_ij + b_j a_ji = b_i b_j hold exactly for the closed "
        f"form; the entries as printed {'satisfy' if satisfied else 'do not satisfy'} them.",
        verdict=judged(zero == len(residuals), satisfied),
    )


def order_residuals(exact: Exact) -> Iterator[sympy.Expr]:
    """Yield the residuals of B(2s), C(s), D(s), expanded; if all are 0 the order is 2s (Butcher's theorem)."""
    A, b, c = exact
    s, one = len(b), sympy.S.One
    for k in range(1, 2 * s + 1):
        yield sympy.expand(sum(b[i] * c[i] ** (k - 1) for i in range(s)) - one / k)
    for k in range(1, s + 1):
        for i in range(s):
            yield sympy.expand(sum(A[i][j] * c[j] ** (k - 1) for j in range(s)) - c[i] ** k / k)
            left = sum(b[j] * c[j] ** (k - 1) * A[j][i] for j in range(s))
            yield sympy.expand(left - b[i] * (1 - c[i] ** k) / k)


def symplectic_residuals(exact: Exact) -> Iterator[sympy.Expr]:
    """Yield b_i a_ij + b_j a_ji - b_i b_j for i <= j, expanded."""
    A, b, _ = exact
    for i in range(len(b)):
        for j in range(i, len(b)):
            yield sympy.expand(b[i] * A[i][j] + b[j] * A[j][i] - b[i] * b[j])


def _typeset(number: int) -> Iterator[Block]:
    A, b, c = _printed(number, NAMES)
    changed = {(i, j): _expression(text, NAMES) for i, j, text in CORRECTED.get(number, ())}
    A = tuple(tuple(changed.get((i, j), value) for j, value in enumerate(row)) for i, row in enumerate(A))
    if changed:
        named = ", ".join(f"a_{i + 1}{j + 1}" for i, j in changed)
        yield Paragraph(f"The tableau, with {named} corrected:")
    for name, rows in (("c", [[value] for value in c]), ("A", A), ("b", [b])):
        yield Formula(sympy.ImmutableMatrix(rows), sympy.Symbol(name))
    if sympy.Matrix(A).free_symbols:
        yield Paragraph("where")
        for letter, text in LETTERS.items():
            yield Formula(_expression(text, NAMES), NAMES[letter])


for number in PRINTED:
    stages = number + 1
    experiment(f"table-{number}", f"Gauss method of order {2 * stages}")(partial(_gauss_table, number, stages))
