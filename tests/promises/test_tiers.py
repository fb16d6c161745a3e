"""Selection of combinations, and of the quick tier."""

import tomllib
from collections import Counter
from itertools import product
from pathlib import Path

import pytest
from tiers import QUICK, cover, mark_later_tiers


@pytest.mark.parametrize("times", [1, 2, 3])
@pytest.mark.parametrize("sizes", [(1, 1), (15, 4), (3, 3, 3), (2, 7, 5)])
def test_every_value_is_in_the_requested_number_of_combinations(sizes: tuple[int, ...], times: int) -> None:
    combinations = [tuple((f"x{k}", i) for k, i in enumerate(one)) for one in product(*map(range, sizes))]
    chosen = cover(combinations, times)
    uses = Counter(value for one in chosen for value in one)
    there = Counter(value for one in combinations for value in one)
    assert all(uses[value] >= min(times, count) for value, count in there.items())
    assert len(chosen) <= min(len(combinations), times * max(sizes) + len(sizes))


def test_the_tier_of_a_case_prevails_over_that_of_its_test(request, monkeypatch):
    monkeypatch.delenv("SCVI_CODEGEN_TESTS_PART", raising=False)

    @pytest.mark.second
    def test():
        pass

    for tier, is_full in (("rotated", True), ("quick", False)):
        case = pytest.Function.from_parent(request.node.parent, name="case", callobj=test)
        case.add_marker(tier)
        mark_later_tiers([case])
        assert (case.get_closest_marker("full") is not None) == is_full


def test_the_quick_tier_is_what_pytest_runs():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert f"-m '{QUICK}'" in project["tool"]["pytest"]["ini_options"]["addopts"]
