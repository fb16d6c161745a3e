"""Everything of the paper is in the catalogue, and what an experiment decides is a claim that is listed."""

import re

import pytest

from scvi_codegen.reproduce.catalogue import EXPERIMENTS
from scvi_codegen.reproduce.claims import CLAIMS, EVIDENCE
from scvi_codegen.reproduce.laboratory.experiment import Verdict
from scvi_codegen.reproduce.runner import Failure, run_experiments

PAPER = {
    *(f"figure-{n}" for n in range(1, 31)),
    *(f"table-{n}" for n in range(1, 11)),
    *("section-2.1", "theorem-2.1", "theorem-4.1", "theorem-4.2", "theorem-4.3", "section-4.3", "claims", "correction"),
}


def test_every_figure_table_theorem_and_claim_is_there() -> None:
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
    assert {"figure-29", "correction", "section-4.3", "theorem-4.1", "theorem-4.2"} <= failing
    assert not failing & {"figure-5", "figure-10", "figure-12", "figure-14", "figure-15", "figure-24", "theorem-4.3"}
