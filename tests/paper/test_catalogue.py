"""Every numerical figure and table of the paper is in the catalogue; checks name claims that exist."""

import re

import pytest

from scvi_codegen.extras.paper.catalogue import EXPERIMENTS
from scvi_codegen.extras.paper.experiment import CLAIMS, EVIDENCE, Verdict
from scvi_codegen.extras.paper.runner import Failure, run_experiments

PAPER = {*(f"figure-{n}" for n in range(1, 31) if n != 2), *("table-8", "table-9", "claims", "correction")}


def test_every_numerical_figure_and_table_is_there() -> None:
    assert set(EXPERIMENTS) == PAPER
    for name, experiment in EXPERIMENTS.items():
        assert experiment.name == name
        assert experiment.title
        assert re.fullmatch(r"[a-z]+(-[0-9.]+)?", name)


def test_claims_refer_to_existing_experiments() -> None:
    assert set(EVIDENCE) <= set(EXPERIMENTS)
    assert set(EXPERIMENTS["claims"].needs) == set(EVIDENCE)


@pytest.mark.full
def test_whole_paper_runs_and_every_claim_is_evaluated() -> None:
    """About two minutes. What holds, and what does not, is found in the same places as when this was written."""
    results = {result.name: result for result in run_experiments(list(EXPERIMENTS)) if not isinstance(result, Failure)}
    assert set(results) == PAPER
    for result in results.values():
        assert result.setting
        assert all(set(check.bears_on) <= set(CLAIMS) for check in result.checks)
    verdicts = [check.verdict for check in results["claims"].checks]
    assert len(verdicts) == len(CLAIMS)
    assert Verdict.SHOWN not in verdicts
    failing = {name for name, result in results.items() for check in result.checks if check.verdict is Verdict.FAILS}
    assert {"figure-29", "correction"} <= failing
    assert not failing & {"figure-5", "figure-10", "figure-12", "figure-14", "figure-15", "figure-24"}
