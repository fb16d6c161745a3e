"""Tiers of the tests: quick (the default), second, full, by the markers ``quick``, ``second`` and ``full``.

Tests without a marker are quick; a marker of a test prevails over those of its class and of its file. Of a test with
``@pytest.mark.tiers(m)`` the first m cases are quick, the others of the second tier; with ``tiers(m, n)`` the first m
are quick, those up to the n-th of the second tier, the others rotated. One in ``PARTS`` of the rotated cases is of the
second tier where the environment variable ``SCVI_CODEGEN_TESTS_PART`` is a number, which ``.ci/run`` sets to the number
of commits: so many runs reach all of them. With ``all`` all of them are; without it they are full. The hash of a case's
name says of which part it is, or the number in ``@pytest.mark.rotated(number)``: cases with one number share what they
compile, and run together. Tests that are named (``file::test``) run in any tier but the full one.

``@pytest.mark.covering`` on a test with several parametrised arguments keeps few of their combinations, so that each
value of each argument is in one; ``@pytest.mark.covering(2)`` so that each is in two (where there are as many).
``@pytest.mark.sampled(n)`` keeps n of the cases of a test, evenly spaced in the order of their names; the others are
full. ``first_of_each`` does the like for one argument, by what its values have in common. ``pytest.mark.long`` on a
file begins it before others, so that no process waits for another at the end.
"""

import math
import os
import re
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any

import pytest

from scvi_codegen.methods.method import Method

QUICK, SECOND = "not full and (quick or not second)", "second and not quick and not full"
"""Expressions of the quick tier, as in pyproject.toml, and of the second, for which ``-m second`` stands."""
UNOPTIMISED_TIERS = (QUICK, SECOND, "not full")
TIERS = ("quick", "second", "full", "rotated", "tiers")
PARTS = 64
"""Number of parts of the rotated cases, of which a run with SCVI_CODEGEN_TESTS_PART takes one."""

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


def mark_later_tiers(items: Iterable[pytest.Item]) -> None:
    """Mark the cases of tests marked ``tiers`` or ``rotated`` as quick, of the second tier, or full."""
    part, seen = os.environ.get("SCVI_CODEGEN_TESTS_PART", ""), Counter[str]()
    for item in items:
        own = [marker for marker in item.own_markers if marker.name in TIERS]  # that of a case is the last
        marker = own[-1] if own else next((marker for marker in item.iter_markers() if marker.name in TIERS), None)
        if marker is None or marker.name not in ("rotated", "tiers"):
            continue
        quick, both = (*marker.args, math.inf)[:2] if marker.name == "tiers" else (0, 0)
        seen[name := item.nodeid.partition("[")[0]] += 1
        number = marker.args[0] if marker.name == "rotated" and marker.args else zlib.crc32(item.nodeid.encode())
        rotated = part == "all" or (part.isdigit() and (number - int(part)) % PARTS == 0)
        later = "second" if seen[name] <= both or rotated else "full"
        item.add_marker("quick" if seen[name] <= quick else later)


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
