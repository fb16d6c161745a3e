"""Runs do not depend on the origin of coordinates or on units: failures, steps, errors, bits (docs/theory/sizes.md)."""

import pytest
from invariance import CHARTS, Cell, cells, charts_of, violations

CASES = [(cell, name) for cell in cells() for name, _ in charts_of(cell)]


def identity(cell: Cell, chart: str) -> str:
    return "-".join([cell.kind, cell.method, cell.precision, cell.stepping, chart])


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(30)
@pytest.mark.parametrize(("cell", "chart"), [pytest.param(*case, id=identity(*case)) for case in CASES])
def test_motions_are_the_same_in_all_charts(cell: Cell, chart: str) -> None:
    assert not list(violations(cell, CHARTS[chart], range(3)))
