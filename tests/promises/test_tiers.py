"""Selection of combinations for the default and the full tier."""

import tomllib
from collections import Counter
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiers import QUICK, cover, first_of_each, long_ones_first


@pytest.mark.parametrize("times", [1, 2, 3])
@pytest.mark.parametrize("sizes", [(1, 1), (15, 4), (3, 3, 3), (2, 7, 5)])
def test_every_value_is_in_the_requested_number_of_combinations(sizes: tuple[int, ...], times: int) -> None:
    combinations = [tuple((f"x{k}", i) for k, i in enumerate(one)) for one in product(*map(range, sizes))]
    chosen = cover(combinations, times)
    uses = Counter(value for one in chosen for value in one)
    there = Counter(value for one in combinations for value in one)
    assert all(uses[value] >= min(times, count) for value, count in there.items())
    assert len(chosen) <= min(len(combinations), times * max(sizes) + len(sizes))


def test_first_value_of_each_kind_is_in_the_default_tier() -> None:
    found = first_of_each(["a1", "a2", "b1", "a3", "b2"], key=lambda word: word[0])
    assert [one.values[0] for one in found if not one.marks] == ["a1", "b1"]
    assert [one.values[0] for one in found] == ["a1", "a2", "b1", "a3", "b2"]


def test_long_files_start_first_and_others_retain_their_order():
    items = [SimpleNamespace(name=name, get_closest_marker={"long": name.isupper() or None}.get) for name in "abCdE"]
    long_ones_first(items)
    assert "".join(item.name for item in items) == "CEabd"


def test_the_quick_tier_is_what_pytest_runs():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert f"-m '{QUICK}'" in project["tool"]["pytest"]["ini_options"]["addopts"]
