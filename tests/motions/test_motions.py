"""Every quantity, in systems and situations in which nothing is a default: a table, and a property for each column."""

import zlib

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


def identity(name: str, case: Case) -> str:
    scheme = case.scheme
    method = scheme.method if isinstance(scheme.method, str) else ":".join(map(str, list(scheme.method.values())[:2]))
    return f"{name}-{case.problem.name}-{method}-{scheme.solver}-{scheme.precision}-{case.situation}"


def sample() -> list[tuple[str, Case]]:
    """Cases with each property of each kind of run, each situation and each system, then the others by hash."""
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
    others = [case for case in CASES if case not in first]
    return first + sorted(others, key=lambda case: zlib.crc32(identity(*case).encode()))


@pytest.mark.tiers(60, 200)
@pytest.mark.parametrize(("name", "case"), [pytest.param(*case, id=identity(*case)) for case in sample()])
def test_quantities_are_those_of_independent_code(name: str, case: Case) -> None:
    check, _ = PROPERTIES[name]
    check(case)
