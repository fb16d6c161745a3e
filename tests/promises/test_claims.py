"""Claims of README and documentation agree with recorded measurements."""

import json

import pytest
from remake_claims import PAGE, RECORD, TITLES, page, rows_of, stated

RECORDED = json.loads(RECORD.read_text(encoding="utf-8"))
CHANCE = 1.6
"""Largest factor between a stated and a recorded number: the record is from a machine that was not idle."""


def test_the_page_is_made_from_the_record():
    assert PAGE.read_text(encoding="utf-8") == page(RECORDED)


@pytest.mark.parametrize("name", rows_of(RECORDED))
def test_stated_times_and_ratios_are_those_recorded(name):
    row = rows_of(RECORDED)[name]
    error, time, *ratios = stated()[TITLES[name]]
    assert row["at_error"] < 3 * float(error)
    measured = [1e3 * row["seconds"], row["default"], row["best"]]
    for claim, value in zip([float(time.removesuffix(" ms")), *map(float, ratios)], measured, strict=True):
        assert 1 / CHANCE < value / claim < CHANCE
