"""The table in docs/features.md: each feature works for a kind of system, or an error names it and the reason."""

import warnings
from pathlib import Path

import pytest
from features import FEATURES, KINDS, Kind

from scvi_codegen.errors import MissingLibraryError, ScviCodegenError

PAGE = (Path(__file__).parents[2] / "docs" / "features.md").read_text(encoding="utf-8")
TABLE = {
    row[0]: dict(zip(KINDS, row[1:], strict=True))
    for row in (
        [cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("| ")
    )
    if row[0] not in ("feature", "---")
}
REASONS = r"known at run time|must have (the )?shape|run\.at\(times\)|not an array of positions"
"""Beginnings of reasons: of sizes, of states whose size is known, of output times, of lists of neighbours."""


@pytest.fixture(scope="module")
def kinds():
    return {name: Kind(name) for name in KINDS}


def test_table_lists_the_features_that_are_tested():
    assert list(TABLE) == list(FEATURES)
    assert {cell for row in TABLE.values() for cell in row.values()} == {"yes", "no"}


@pytest.mark.sampled(24)
@pytest.mark.covering(times=1)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("feature", FEATURES)
def test_features_work_or_are_refused_with_a_reason(feature, kind, kinds, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if TABLE[feature][kind] == "no":
            with pytest.raises(ScviCodegenError, match=REASONS):
                FEATURES[feature](kinds[kind], tmp_path)
            return
        try:
            FEATURES[feature](kinds[kind], tmp_path)
        except MissingLibraryError as error:
            pytest.skip(str(error))
