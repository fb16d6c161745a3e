"""Bits of results: those of the C sources recorded in ``sources.json.xz``, for every kind of system, method and run.

A difference means that the arithmetic of generated C changed. If that is intended, record the sources anew by
``tools/record_golden.py``; otherwise it is an error. If the sources are equal but for comments, nothing is compiled.
"""

from pathlib import Path

import pytest
from golden_cells import CELLS, output, program, recorded

QUICK = ("damped", "forms_newton", "kepler_second", "rods_newton", "swings")
"""Of these five kinds of system and run, which include most headers, each change is compared in the quick tier."""


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(22)
@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.quick) if x in QUICK else x for x in CELLS])
def test_results_have_the_bits_of_the_recorded_source(name: str, tmp_path: Path) -> None:
    now, before = program(name), recorded()[name]
    if now == before:
        return
    folders = [tmp_path / each for each in ("now", "before")]
    for folder in folders:
        folder.mkdir()
    assert output(now, folders[0]) == output(before, folders[1])
