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

DEAR = ("two_words", "packages", "hessians")
"""Properties that compile several integrators, or much code, for several seconds: always rotated."""
LATER = ("work_and_impulses", "flows", "events", "changes", "restarts", "controlled", "single_precision")
"""Properties of the second tier."""

pytestmark = pytest.mark.long


def identity(name: str, case: Case) -> str:
    scheme = case.scheme
    method = scheme.method if isinstance(scheme.method, str) else ":".join(map(str, list(scheme.method.values())[:2]))
    return f"{name}-{case.problem.name}-{method}-{scheme.solver}-{scheme.precision}-{case.situation}"


def sample() -> list[object]:
    """Cases with each property of each kind of run, each situation and each system; dear ones and those beyond rotate,
    the cases of a stepper, which is compiled once, together."""
    kinds, names = [(name, problem.kind) for name in PROPERTIES for problem in PROBLEMS], [x.name for x in PROBLEMS]
    combinations = {
        (
            ("property of a kind", kinds.index((name, case.kind))),
            ("situation", [*SITUATIONS].index(case.situation)),
            ("system", names.index(case.problem.name)),
        ): (name, case)
        for name, case in reversed(CASES)
    }
    first = {combinations[x] for x in cover(sorted(combinations))}
    steppers = {x: i for i, x in enumerate(dict.fromkeys((case.problem, case.method) for _, case in CASES))}

    def tier(name: str, case: Case) -> pytest.MarkDecorator:
        if (name, case) not in first or name in DEAR:
            return pytest.mark.rotated(steppers[case.problem, case.method])
        return pytest.mark.second if name in LATER else pytest.mark.quick

    return [pytest.param(*case, id=identity(*case), marks=tier(*case)) for case in CASES]


@pytest.mark.parametrize(("name", "case"), sample())
def test_quantities_are_those_of_independent_code(name: str, case: Case) -> None:
    check, _ = PROPERTIES[name]
    check(case)
