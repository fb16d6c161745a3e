"""Every quantity, in systems and situations in which nothing is a default: a table, and a property for each column."""

import pytest
from tiers import cover

from tests.motions.motions import PROBLEMS
from tests.motions.properties import PROPERTIES
from tests.motions.situations import SITUATIONS, Case

CASES = [
    (name, Case(problem, method, situation))
    for problem in PROBLEMS
    for method in range(len(problem.methods))
    for situation in SITUATIONS
    for name, (_, applies) in PROPERTIES.items()
    if applies(Case(problem, method, situation))
]

pytestmark = pytest.mark.long


def identity(name: str, case: Case) -> str:
    scheme = case.scheme
    method = scheme.method if isinstance(scheme.method, str) else ":".join(map(str, list(scheme.method.values())[:2]))
    return f"{name}-{case.problem.name}-{method}-{scheme.solver}-{scheme.precision}-{case.situation}"


def sample() -> list[object]:
    """Quick cases with each property of each kind of run, each situation and each system; the others rotate, those of a
    stepper, which is compiled once, together."""
    kinds, names = [(name, problem.kind) for name in PROPERTIES for problem in PROBLEMS], [x.name for x in PROBLEMS]
    combinations = {
        (
            ("property of a kind", kinds.index((name, case.kind))),
            ("situation", [*SITUATIONS].index(case.situation)),
            ("system", names.index(case.problem.name)),
        ): (name, case)
        for name, case in reversed(CASES)
    }
    first = [combinations[x] for x in sorted(cover(sorted(combinations)))]
    steppers = [*dict.fromkeys((case.problem, case.method) for _, case in CASES)]
    marks = [[] if x in first else [pytest.mark.rotated(steppers.index((x[1].problem, x[1].method)))] for x in CASES]
    return [pytest.param(*case, id=identity(*case), marks=of) for case, of in zip(CASES, marks, strict=True)]


@pytest.mark.parametrize(("name", "case"), sample())
def test_quantities_are_those_of_independent_code(name: str, case: Case) -> None:
    check, _ = PROPERTIES[name]
    check(case)
