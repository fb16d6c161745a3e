"""Every quantity, in systems and situations in which nothing is a default: a table, and a property for each column."""

import pytest
from matrix_properties import PROPERTIES, SITUATIONS, Case
from matrix_systems import PROBLEMS
from tiers import cover

CASES = [
    (name, Case(problem, method, situation))
    for problem in PROBLEMS
    for method in range(len(problem.methods))
    for situation in SITUATIONS
    for name, (_, applies) in PROPERTIES.items()
    if applies(Case(problem, method, situation))
]
KINDS = [(x, y.kind) for x in PROPERTIES for y in PROBLEMS]
STEPPERS = [(x.name, k) for x in PROBLEMS for k in range(len(x.methods))]
INDICES = [
    (
        ("property of a kind", KINDS.index((name, case.kind))),
        ("situation", [*SITUATIONS].index(case.situation)),
        ("stepper", STEPPERS.index((case.problem.name, case.method))),
    )
    for name, case in CASES
]
QUICK = cover(INDICES)
"""Each property of each kind of run, each situation and each stepper, in few combinations; the full tier has all."""


def identity(name: str, case: Case) -> str:
    method, solver, _ = case.problem.methods[case.method]
    word = method if isinstance(method, str) else ":".join(map(str, list(method.values())[:2]))
    return f"{name}-{case.problem.name}-{word}-{solver}-{case.situation}"


@pytest.mark.rotated
@pytest.mark.sampled(14)
@pytest.mark.parametrize(
    ("name", "case"),
    [
        pytest.param(name, case, id=identity(name, case), marks=[] if index in QUICK else pytest.mark.full)
        for (name, case), index in zip(CASES, INDICES, strict=True)
    ],
)
def test_quantities_are_those_of_independent_code(name: str, case: Case) -> None:
    check, _ = PROPERTIES[name]
    check(case)
