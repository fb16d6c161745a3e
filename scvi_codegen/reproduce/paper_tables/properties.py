"""Table 4: properties of collocation methods, computed from their coefficients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from scvi_codegen.methods.collocation import SpectralCollocation
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Result,
    TableBlock,
    Verdict,
    experiment,
    holds,
)
from scvi_codegen.tables.tableau import (
    Tableau,
    chebyshev_gauss,
    chebyshev_lobatto,
    gauss,
    lobatto_iiia,
    radau_ia,
    radau_iia,
)

MOST_STAGES = 9
FAMILIES: Mapping[str, tuple[Callable[[int], Tableau], int, str]] = {
    "Gauss": (gauss, 1, "Gauss"),
    "Chebyshev-Gauss": (chebyshev_gauss, 1, "Chebyshev"),
    "Chebyshev-Lobatto": (chebyshev_lobatto, 2, "Chebyshev"),
    "Radau IIA": (radau_iia, 1, "Radau"),
    "Radau IA": (radau_ia, 1, "Radau"),
    "Lobatto IIIA": (lobatto_iiia, 2, "Lobatto IIIA"),
}
"""Tableaux as functions of the number of stages, the smallest number, and the column of Table 4."""

MARKS: Mapping[str, tuple[str, ...]] = {
    "A-stable": ("Gauss", "Chebyshev", "Radau", "Lobatto IIIA"),
    "symmetric": ("Gauss", "Chebyshev", "Lobatto IIIA"),
    "symplectic": ("Gauss",),
    "superconvergent": ("Gauss",),
}
"""Columns with a mark in Table 4, by property."""


@dataclass(frozen=True, slots=True)
class Properties:
    """Properties of one tableau, computed from its coefficients."""

    family: str
    stages: int
    order: int
    marks: Mapping[str, bool]


def properties(family: str, tableau: Tableau) -> Properties:
    """Return A-stability by Sturm's and Routh's theorems, symmetry, symplecticity, order by B(p), C(q), D(r)."""
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


@experiment("table-4", "Properties of different collocation methods")
def table_4(results: Mapping[str, Result]) -> Result:
    """Return Table 4: properties of collocation methods."""
    result = _all_properties()
    return Result(
        setting=(
            f"Every mark is computed from A, b, c in 60 digits for all numbers of stages up to {MOST_STAGES}.",
            "The paper names no points: 'Chebyshev methods' are taken to be collocation on the Chebyshev-Gauss and on "
            "the Chebyshev-Lobatto points, 'Radau methods' Radau IIA and IA.",
            "SC, the spectral collocation of the paper's experiments, collocates at the nodes 1 .. s of s + 1 "
            "Chebyshev-Lobatto nodes and has no column in the paper's table; it is added here.",
        ),
        checks=(*(_mark_check(name, result) for name in MARKS), _collocation_check(result), _stability_check(result)),
        tables=(_property_table(result),),
    )


def _property_table(result: Sequence[Properties]) -> TableBlock:
    return TableBlock(
        columns=("family", "stages", "order", *MARKS),
        rows=tuple(
            (one.family, one.stages, one.order, *("yes" if one.marks[name] else "no" for name in MARKS))
            for one in result
        ),
        formats={"stages": "d", "order": "d"},
    )


def _mark_check(name: str, result: Sequence[Properties]) -> Comparison:
    """Return the check of the marks of one row for every family and number of stages."""
    agreeing, others = 0, []
    for family, (_, _, column) in FAMILIES.items():
        expected = column in MARKS[name]
        members = [one for one in result if one.family == family]
        differing = [one.stages for one in members if one.marks[name] != expected]
        agreeing += len(members) - len(differing)
        if differing:
            others.append(f"{family} with {_listed(differing)} {'is not' if expected else 'is'}")
    total = sum(one.family in FAMILIES for one in result)
    return Comparison(
        claim=f"{_joined(MARKS[name])} methods are {name}" + (", the others are not." if len(MARKS[name]) < 4 else "."),
        measured=f"So it is for {agreeing} of {total} tableaux"
        + (f"; {'; '.join(others)}." if others else f", all families with up to {MOST_STAGES} stages."),
        verdict=holds(agreeing == total) if agreeing in (0, total) else Verdict.PARTLY,
    )


def _collocation_check(result: Sequence[Properties]) -> Comparison:
    members = [one for one in result if one.family == "SC"]
    named = {name: [one.stages for one in members if one.marks[name]] for name in MARKS}
    unstable = [one.stages for one in members if not one.marks["A-stable"]]
    orders = ", ".join(str(one.order) for one in members)
    same = not unstable and len(named["symmetric"]) == len(members)
    return Comparison(
        claim="SC, the Chebyshev method of the experiments, is A-stable and symmetric, as the table states.",
        measured=f"SC is not A-stable with {_listed(unstable)}; symmetric: {_listed(named['symmetric'])}; symplectic: "
        f"{_listed(named['symplectic'])}; order {orders} for 1 to {len(members)} stages.",
        verdict=holds(same),
    )


def _stability_check(result: Sequence[Properties]) -> Comparison:
    svi, sc = (
        [one.stages for one in result if one.family == name and one.marks["A-stable"]] for name in ("Gauss", "SC")
    )
    return Comparison(
        claim="SVI shows better stability than Chebyshev collocation methods when using large time-steps (section 5).",
        measured=f"SVI with as many Gauss points as its degree is the Gauss method, A-stable with {_listed(svi)}; SC "
        f"is with {_listed(sc)}.",
        verdict=holds(set(svi) > set(sc)),
        bears_on=("stability",),
    )


def _listed(stages: Sequence[int]) -> str:
    """Return stages as text: ``1, 3 stages``."""
    if not stages:
        return "unknown number of stages"
    return f"{', '.join(map(str, stages))} stage{'s' * (list(stages) != [1])}"


def _joined(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
