"""Tables 1 to 3: the Gauss tableaux as printed, compared with the collocation integrals (23)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import sympy

from scvi_codegen.display.page.blocks import TableBlock
from scvi_codegen.reproduce.experiment import Comparison, Experiment, Result, Verdict, holds
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.tableau import Tableau, gauss

AGREES = mp.mpf("1e-50")
PRINTED: Mapping[int, tuple[str, ...]] = {
    2: (
        "1/2 - sqrt(3)/6 : 1/4, 1/4 - sqrt(3)/6",
        "1/2 + sqrt(3)/6 : 1/4 + sqrt(3)/6, 1/4",
        "1/2, 1/2",
    ),
    3: (
        "1/2 - sqrt(15)/10 : 5/36, 2/9 - sqrt(15)/15, 5/36 - sqrt(15)/30",
        "1/2 : 5/36 + sqrt(15)/24, 2/9, 5/36 - sqrt(15)/24",
        "1/2 + sqrt(15)/10 : 5/36 + sqrt(15)/30, 2/9 + sqrt(15)/15, 5/36",
        "5/18, 4/9, 5/18",
    ),
    4: (
        "2*w1 + 2*v1 - 2*w3 - w5 : w1, v1 - w3 + v4, v1 - w3 - v4, w1 - w5",
        "2*w1 + 2*v1 - 2*v3 - v5 : w1 - v3 + w4, v1, v1 - v5, w1 - v3 - w4",
        "2*w1 + 2*v1 + 2*v3 + v5 : w1 + v3 + w4, v1 + v5, v1, w1 - v3 - w4",
        "2*w1 + 2*v1 + 2*w3 + w5 : w1 + w5, v1 + w3 + v4, v1 + w3 - v4, w1",
        "2*w1, 2*v1, 2*v1, 2*w1",
    ),
}
"""Rows c_i : a_i1, .., a_is and finally b_1, .., b_s by number of stages, as the paper prints them; v denotes w'."""
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


def printed_entries(stages: int) -> dict[str, tuple[str, Any]]:
    """Return text and value in 60 digits of the printed entries by name, such as ``a_12``."""
    letters: dict[str, sympy.Expr] = {}
    for letter, formula in LETTERS.items():
        letters[letter] = sympy.sympify(formula, locals=dict(letters))
    *rows, b = PRINTED[stages]
    texts = {f"b_{j}": text for j, text in enumerate(b.split(", "), start=1)}
    for i, row in enumerate(rows, start=1):
        texts[f"c_{i}"], a = row.split(" : ")
        texts |= {f"a_{i}{j}": text for j, text in enumerate(a.split(", "), start=1)}
    values = {name: sympy.N(sympy.sympify(text, locals=letters), 60) for name, text in texts.items()}
    return {name: (text.replace("v", "w'"), mp.mpf(str(values[name]))) for name, text in texts.items()}


def labelled(tableau: Tableau) -> Iterator[tuple[str, Any]]:
    """Yield the entries of a tableau with their names."""
    yield from ((f"b_{j}", value) for j, value in enumerate(tableau.b, start=1))
    yield from ((f"c_{i}", value) for i, value in enumerate(tableau.c, start=1))
    yield from ((f"a_{i}{j}", x) for i, row in enumerate(tableau.A, start=1) for j, x in enumerate(row, start=1))


def _result(stages: int, _: Mapping[str, Result]) -> Result:
    printed, exact = printed_entries(stages), dict(labelled(gauss(stages)))
    numbers = range(1, stages + 1)
    tableau = Tableau(
        name="printed",
        A=tuple(tuple(printed[f"a_{i}{j}"][1] for j in numbers) for i in numbers),
        b=tuple(printed[f"b_{j}"][1] for j in numbers),
        c=tuple(printed[f"c_{i}"][1] for i in numbers),
    )
    rows = [
        (name, text, float(value), float(exact[name]), float(abs(value - exact[name])))
        for name, (text, value) in printed.items()
    ]
    wrong = [row for row in rows if row[-1] > AGREES]
    named = "; ".join(f"{name} is printed {text} = {value:.6f}, it is {x:.6f}" for name, text, value, x, _ in wrong)
    symplectic = "" if tableau.is_symplectic else "not "
    return Result(
        setting=(
            f"Printed entries are evaluated in 60 digits and compared with the collocation integrals (23) on the "
            f"{stages} Gauss-Legendre points; they agree if they differ by less than 1e-50.",
        ),
        checks=(
            Comparison(
                claim=f"The table lists the coefficients (23) of the Gauss method with {stages} stages.",
                measured=f"{len(rows) - len(wrong)} of {len(rows)} printed entries agree to 50 digits"
                + (f"; {named}." if wrong else "."),
                verdict=Verdict.PARTLY if 0 < len(wrong) < len(rows) else holds(not wrong),
            ),
            Comparison(
                claim=f"The method has order {2 * stages} and is symplectic.",
                measured=f"The entries as printed have order {tableau.order} and are {symplectic}symplectic.",
                verdict=holds(tableau.order == 2 * stages and tableau.is_symplectic),
            ),
        ),
        tables=(
            TableBlock(
                columns=("entry", "as printed", "its value", "by (23)", "difference"),
                rows=tuple(rows),
                formats={"its value": ".15f", "by (23)": ".15f", "difference": ".1e"},
            ),
        ),
    )


EXPERIMENTS = tuple(
    Experiment(name=f"table-{s - 1}", title=f"Gauss method of order {2 * s}", run=partial(_result, s)) for s in PRINTED
)
