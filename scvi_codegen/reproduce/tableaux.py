"""Tables 1 to 4: the Gauss tableaux as printed against equation (23), and the properties of collocation methods."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, TypeAlias

import sympy

from scvi_codegen.methods.collocation import SpectralCollocation
from scvi_codegen.precision import Number, mp
from scvi_codegen.reproduce.drawing import COLORS, panels
from scvi_codegen.reproduce.experiment import (
    Block,
    Check,
    Experiment,
    Formula,
    Paragraph,
    Picture,
    Result,
    Table,
    Verdict,
    holds,
)
from scvi_codegen.tableau import (
    Tableau,
    chebyshev_gauss,
    chebyshev_lobatto,
    exact_tableau,
    gauss,
    lobatto_iiia,
    radau_ia,
    radau_iia,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["EXPERIMENTS"]

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
"""Rows c_i : a_i1, .., a_is and at last b_1, .., b_s, as the paper prints them; v stands for w'."""

CORRECTED: Mapping[int, tuple[tuple[int, int, str], ...]] = {3: ((2, 3, "w1 + v3 - w4"),)}
"""Entries of A, counted from 0, that stand here in place of the printed ones when a table is typeset."""

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
"""What Table 3 is written in."""

NAMES = {letter: sympy.Symbol(f"w_{letter[1]}" if letter[0] == "w" else f"w__'_{letter[1]}") for letter in LETTERS}
MOST_STAGES = 9
FAMILIES: Mapping[str, tuple[Callable[[int], Tableau], int, str]] = {
    "Gauss": (gauss, 1, "Gauss"),
    "Chebyshev-Gauss": (chebyshev_gauss, 1, "Chebyshev"),
    "Chebyshev-Lobatto": (chebyshev_lobatto, 2, "Chebyshev"),
    "Radau IIA": (radau_iia, 1, "Radau"),
    "Radau IA": (radau_ia, 1, "Radau"),
    "Lobatto IIIA": (lobatto_iiia, 2, "Lobatto IIIA"),
}
"""Tableaux by number of stages, the smallest number, and the column of Table 4."""

MARKS: Mapping[str, tuple[str, ...]] = {
    "A-stable": ("Gauss", "Chebyshev", "Radau", "Lobatto IIIA"),
    "symmetric": ("Gauss", "Chebyshev", "Lobatto IIIA"),
    "symplectic": ("Gauss",),
    "superconvergent": ("Gauss",),
}
"""Table 4: the columns with a mark."""


def table_1(results: Mapping[str, Result]) -> Result:
    """Gauss method of order 4."""
    return _gauss_table(1, 2)


def table_2(results: Mapping[str, Result]) -> Result:
    """Gauss method of order 6."""
    return _gauss_table(2, 3)


def table_3(results: Mapping[str, Result]) -> Result:
    """Gauss method of order 8."""
    return _gauss_table(3, 4)


def _gauss_table(number: int, s: int) -> Result:
    exact = exact_tableau(gauss(s))
    assert exact is not None
    printed = _printed(number, _letter_values())
    return Result(
        name=f"table-{number}",
        title=f"Gauss method of order {2 * s}",
        setting=(
            f"Printed entries are evaluated in 60 digits and set beside the collocation integrals (23) on the {s} "
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
    """Texts of c, then of the rows of A and b."""
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
    """(A, b, c) as the paper prints them."""
    abscissae, rows = _rows(number)
    *A, b = (tuple(_expression(text, letters) for text in row) for row in rows)
    return tuple(A), b, tuple(_expression(text, letters) for text in abscissae)


def _number(expression: sympy.Expr) -> Number:
    return mp.mpf(str(sympy.N(expression, 60)))


def _labelled(A: Sequence[Sequence[object]], b: Sequence[object], c: Sequence[object]) -> Iterator[tuple[str, object]]:
    for i, row in enumerate(A, start=1):
        yield f"c_{i}", c[i - 1]
        yield from ((f"a_{i}{j}", value) for j, value in enumerate(row, start=1))
    yield from ((f"b_{j}", value) for j, value in enumerate(b, start=1))


def _entries_table(number: int, printed: Exact, computed: Tableau) -> Table:
    abscissae, rows = _rows(number)
    texts = [text.replace("v", "w'") for _, text in _labelled(rows[:-1], rows[-1], abscissae)]
    values = [_number(value) for _, value in _labelled(*printed)]
    found = list(_labelled(computed.A, computed.b, computed.c))
    return Table(
        columns=("entry", "as printed", "its value", "by (23)", "difference"),
        rows=tuple(
            (label, f"{text}", float(value), float(exact), float(abs(value - exact)))
            for text, value, (label, exact) in zip(texts, values, found, strict=True)
        ),
        formats={"its value": ".15f", "by (23)": ".15f", "difference": ".1e"},
    )


def _entries_check(number: int, printed: Exact, computed: Tableau) -> Check:
    table = _entries_table(number, printed, computed)
    wrong = [row for row in table.rows if row[-1] > AGREES]
    named = "; ".join(f"{label} is printed {text} = {value:.6f}, it is {exact:.6f}" for label, text, value, exact, _ in wrong)
    count = len(table.rows)
    return Check(
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


def _order_check(printed: Exact, exact: Exact, s: int) -> Check:
    residuals = list(order_residuals(exact))
    zero, order = sum(residual == 0 for residual in residuals), _numeric(printed, "printed").order
    return Check(
        claim=f"The method has order {2 * s}.",
        measured=f"{zero} of the {len(residuals)} conditions B({2 * s}), C({s}), D({s}), which together give order "
        f"{2 * s}, hold exactly for the closed form; the entries as printed give order {order}.",
        verdict=_common(zero == len(residuals), order == 2 * s),
    )


def _symplectic_check(printed: Exact, exact: Exact) -> Check:
    residuals = list(symplectic_residuals(exact))
    zero, kept = sum(residual == 0 for residual in residuals), _numeric(printed, "printed").is_symplectic
    return Check(
        claim="Gauss methods are symplectic.",
        measured=f"{zero} of the {len(residuals)} conditions b_i a_ij + b_j a_ji = b_i b_j hold exactly for the closed "
        f"form; the entries as printed {'satisfy' if kept else 'do not satisfy'} them.",
        verdict=_common(zero == len(residuals), kept),
    )


def _common(exact: bool, printed: bool) -> Verdict:
    return Verdict.PARTLY if exact != printed else holds(exact)


def order_residuals(exact: Exact) -> Iterator[sympy.Expr]:
    """What B(2s), C(s), D(s) leave, expanded; Butcher's theorem makes order 2s of them if all vanish."""
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
    """b_i a_ij + b_j a_ji - b_i b_j for i <= j, expanded."""
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


@dataclass(frozen=True, slots=True)
class Properties:
    """Of one tableau, computed from its coefficients."""

    family: str
    stages: int
    order: int
    marks: Mapping[str, bool]


def properties(family: str, tableau: Tableau) -> Properties:
    """A-stability by Sturm's and Routh's theorems, symmetry and symplecticity by their identities, order by B, C, D."""
    return Properties(
        family,
        tableau.stages,
        tableau.order,
        {
            "A-stable": tableau.is_a_stable,
            "symmetric": tableau.is_symmetric,
            "symplectic": tableau.is_symplectic,
            "superconvergent": tableau.order >= 2 * tableau.stages,
        },
    )


@lru_cache(maxsize=1)
def _all_properties() -> tuple[Properties, ...]:
    methods = [
        properties(family, build(s))
        for family, (build, least, _) in FAMILIES.items()
        for s in range(least, MOST_STAGES + 1)
    ]
    collocation = [properties("SC", SpectralCollocation(s).tableau) for s in range(1, MOST_STAGES + 1)]
    return (*methods, *collocation)


def table_4(results: Mapping[str, Result]) -> Result:
    """Properties of collocation methods."""
    found = _all_properties()
    return Result(
        name="table-4",
        title="Properties of different collocation methods",
        setting=(
            f"Every mark is computed from A, b, c in 60 digits for all numbers of stages up to {MOST_STAGES}.",
            "'Chebyshev methods' are taken to be collocation on the Chebyshev-Gauss and on the Chebyshev-Lobatto points, "
            "'Radau methods' Radau IIA and IA; the paper names no points.",
            "SC, the spectral collocation of the paper's experiments, collocates at the nodes 1 .. s of s + 1 "
            "Chebyshev-Lobatto nodes and has no column in the paper's table; it is added here.",
        ),
        checks=(*(_mark_check(name, found) for name in MARKS), _collocation_check(found)),
        tables=(_property_table(found),),
        picture=Picture(draw=partial(draw_marks, found), width=9.0, height=5.2),
    )


def _property_table(found: Sequence[Properties]) -> Table:
    return Table(
        columns=("family", "stages", "order", *MARKS),
        rows=tuple(
            (one.family, one.stages, one.order, *("yes" if one.marks[name] else "no" for name in MARKS)) for one in found
        ),
        formats={"stages": "d", "order": "d"},
    )


def _mark_check(name: str, found: Sequence[Properties]) -> Check:
    """Whether the marks of one row are right for every family and number of stages."""
    agreeing, others = 0, []
    for family, (_, _, column) in FAMILIES.items():
        expected = column in MARKS[name]
        members = [one for one in found if one.family == family]
        differing = [one.stages for one in members if one.marks[name] != expected]
        agreeing += len(members) - len(differing)
        if differing:
            others.append(f"{family} with {_listed(differing)} {'is not' if expected else 'is'}")
    total = sum(one.family in FAMILIES for one in found)
    return Check(
        claim=f"{_joined(MARKS[name])} methods are {name}" + (", the others are not." if len(MARKS[name]) < 4 else "."),
        measured=f"So it is for {agreeing} of {total} tableaux"
        + (f"; {'; '.join(others)}." if others else f", all families with up to {MOST_STAGES} stages."),
        verdict=holds(agreeing == total) if agreeing in (0, total) else Verdict.PARTLY,
    )


def _collocation_check(found: Sequence[Properties]) -> Check:
    members = [one for one in found if one.family == "SC"]
    named = {name: [one.stages for one in members if one.marks[name]] for name in MARKS}
    unstable = [one.stages for one in members if not one.marks["A-stable"]]
    orders = ", ".join(str(one.order) for one in members)
    same = not unstable and len(named["symmetric"]) == len(members)
    return Check(
        claim="What the table says of Chebyshev methods, A-stable and symmetric, is true of the SC of the experiments.",
        measured=f"SC is not A-stable with {_listed(unstable)}; symmetric: {_listed(named['symmetric'])}; symplectic: "
        f"{_listed(named['symplectic'])}; order {orders} for 1 to {len(members)} stages.",
        verdict=holds(same),
    )


def _listed(stages: Sequence[int]) -> str:
    """``1, 3 stages``."""
    if not stages:
        return "no number of stages"
    return f"{', '.join(map(str, stages))} stage{'s' * (list(stages) != [1])}"


def _joined(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def draw_marks(found: Sequence[Properties], figure: Figure) -> None:
    """A panel a property: families down, stages across, a filled square where it holds."""
    families = list(dict.fromkeys(one.family for one in found))
    for axes, name in zip(panels(figure, 2, 2), MARKS, strict=True):
        for one in found:
            color = COLORS["SRK"] if one.marks[name] else "#eeeeee"
            axes.add_patch(_square(one.stages, families.index(one.family), color))
        axes.set(xlim=(0.5, MOST_STAGES + 0.5), ylim=(len(families) - 0.5, -0.5), title=name)
        axes.set_xticks(range(1, MOST_STAGES + 1))
        axes.set_yticks(range(len(families)), families)
        axes.set_xlabel("stages")
        axes.tick_params(length=0)
        axes.grid(False)


def _square(x: float, y: float, color: str) -> object:
    from matplotlib.patches import Rectangle

    return Rectangle((x - 0.42, y - 0.42), 0.84, 0.84, facecolor=color, edgecolor="none")


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(name="table-1", title="Gauss method of order 4", run=table_1),
    Experiment(name="table-2", title="Gauss method of order 6", run=table_2),
    Experiment(name="table-3", title="Gauss method of order 8", run=table_3),
    Experiment(name="table-4", title="Properties of different collocation methods", run=table_4),
)
