"""Figures of pages: written by the program that measured them into one file, and equal to it."""

import copy
import json

import pytest
import remake_figures as figures

from benchmarks.contenders.ours import label_of
from scvi_codegen import SVI

RECORD = json.loads(figures.RECORD.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", figures.PAGES)
def test_pages_state_what_is_recorded(page):
    text = (figures.ROOT / page).read_text(encoding="utf-8")
    assert figures.PAGES[page](text, RECORD) == text, "run python tests/tools/remake_figures.py"


@pytest.mark.parametrize("page", figures.PAGES)
def test_another_measurement_changes_the_pages(page):
    record = copy.deepcopy(RECORD)
    row = {"method": figures.METHOD, "at_error": 4e-12, "seconds": 7.7e-3, "default": 12.3, "best": 1.21}
    report = {"machine": {"processor": "another processor"}, "cases": [{"name": figures.SOLAR, "rows": [row]}]}
    figures.update(record, report)
    assert record["trajectories"]["rows"][figures.SOLAR] == {"error": 4e-12, "ms": 7.7, "default": 12.3, "best": 1.21}
    text = (figures.ROOT / page).read_text(encoding="utf-8")
    written = figures.PAGES[page](text, record)
    assert written != text
    assert figures.PAGES[page](written, RECORD) == text


def test_reports_name_the_method_as_the_record_does():
    assert f"{figures.OURS} {label_of(SVI(8))}" == figures.METHOD
