"""Tiers of the tests: quick (the default), second, full.

``second_tier.txt`` lists test functions after two numbers of cases, in the order of the file: the first ones are quick,
the further ones up to the second number are of the second tier, the others are full. Cases marked ``quick`` and
functions that are not listed are quick; the marks ``second`` and ``full`` are left as they are. The file is measured:
``record_tiers.py`` writes it. Of the cases that it makes full, one in ``PARTS`` is of the second tier where the
environment variable ``SCVI_CODEGEN_TESTS_PART`` is a number, which ``.ci/run`` sets to the number of commits: so many
runs reach all of them. With ``all`` all of them are.

``@pytest.mark.covering`` on a test with several parametrised arguments keeps few of their combinations, so that each
value of each argument is in one; ``@pytest.mark.covering(2)`` so that each is in two (where there are as many).
``@pytest.mark.sampled(n)`` keeps n of the cases of a test, evenly spaced in the order of their names.
``first_of_each`` does the like for one argument, by what its values have in common. ``pytest.mark.long`` on a file
begins it before others, so that no process waits for another at the end.
"""

import os
import re
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

from scvi_codegen.methods.method import Method

QUICK, SECOND = "not full and not second", "second"
"""Expressions of the quick tier, as in pyproject.toml, and of the second."""
UNOPTIMISED_TIERS = (QUICK, SECOND, "not full")
SECOND_TIER = Path(__file__).with_name("second_tier.txt")
PARTS = 16
"""Number of parts of the measured full tier, of which a run with SCVI_CODEGEN_TESTS_PART takes one."""

Combination = tuple[tuple[str, int], ...]
"""Which value of each argument."""


def cover(combinations: Sequence[Combination], times: int = 1) -> set[Combination]:
    """Few combinations with every value ``times`` times, as far as there are: always one that adds most, of values that
    were chosen least."""
    there = Counter(value for combination in combinations for value in combination)
    wanted = {value: min(count, times) for value, count in there.items()}
    used: Counter[tuple[str, int]] = Counter()
    chosen: list[Combination] = []
    while any(used[value] < count for value, count in wanted.items()):
        left = [one for one in combinations if one not in chosen]
        adds = [(sum(used[value] < wanted[value] for value in one), -sum(used[value] for value in one)) for one in left]
        chosen.append(left[adds.index(max(adds))])
        used.update(chosen[-1])
    return set(chosen)


def mark_the_rest_full(items: Iterable[pytest.Item]) -> None:
    """Mark tests with ``covering`` or ``sampled`` that the default tier does not need as tests of the full tier."""
    cases: defaultdict[tuple[str, str], list[pytest.Item]] = defaultdict(list)
    tests: defaultdict[tuple[str, str], list[pytest.Function]] = defaultdict(list)
    for item in sorted(items, key=lambda item: item.nodeid):  # in one order, however they are shuffled
        if isinstance(item, pytest.Function) and item.get_closest_marker("covering"):
            tests[str(item.path), item.originalname].append(item)
        if isinstance(item, pytest.Function) and item.get_closest_marker("sampled"):
            cases[str(item.path), item.originalname].append(item)
    for found in tests.values():
        combinations = [tuple((name, id(value)) for name, value in item.callspec.params.items()) for item in found]
        (marker,) = found[0].iter_markers("covering")
        saved = cover(combinations, *marker.args)
        for item, combination in zip(found, combinations, strict=True):
            if combination not in saved:
                item.add_marker(pytest.mark.full)
    for all_cases in cases.values():
        wanted = next(all_cases[0].iter_markers("sampled")).args[0]
        short = [item for item in all_cases if not item.get_closest_marker("full")]
        saved_cases = {short[k * len(short) // wanted] for k in range(min(wanted, len(short)))}
        for item in set(short) - saved_cases:
            item.add_marker(pytest.mark.full)


def function_of(nodeid: str) -> str:
    """Return the name of a test without the case, as in ``second_tier.txt``."""
    return nodeid.partition("[")[0]


def listed_cases() -> dict[str, tuple[int, int]]:
    """Return the numbers of cases in the quick tier and in both, by test function of ``second_tier.txt``."""
    lines = (line.split() for line in SECOND_TIER.read_text(encoding="utf-8").splitlines())
    return {name: (int(quick), int(both)) for quick, both, name in lines}


def mark_later_tiers(items: Iterable[pytest.Item]) -> None:
    """Mark the cases of listed tests that are not quick."""
    listed, part = listed_cases(), os.environ.get("SCVI_CODEGEN_TESTS_PART", "")
    seen: Counter[str] = Counter()
    for item in items:
        name = function_of(item.nodeid)
        if name in listed and not any(map(item.get_closest_marker, ("quick", "second", "full"))):
            quick, both = listed[name]
            seen[name] += 1
            rotated = part == "all" or (part.isdigit() and (zlib.crc32(item.nodeid.encode()) - int(part)) % PARTS == 0)
            if seen[name] > quick:
                item.add_marker(pytest.mark.second if seen[name] <= both or rotated else pytest.mark.full)


def long_ones_first(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


def family(method: Method) -> tuple[object, ...]:
    """Methods are of one family if their names differ in numbers alone, and what they claim in an order above two."""
    return re.sub(r"[\d.]+", "", method.name), (method.order or 0) > 2, method.symmetric, method.symplectic


def first_of_each(values: Iterable[Any], key: Callable[[Any], Hashable]) -> list[Any]:
    """Values for ``parametrize``: the first of each kind in the default tier, the others in the full one."""
    seen: set[Hashable] = set()
    found = []
    for value in values:
        kind = key(value)
        found.append(pytest.param(value, marks=[pytest.mark.full] if kind in seen else []))
        seen.add(kind)
    return found
