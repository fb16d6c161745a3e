"""Claims of the paper, each with all measurements that concern it and one verdict."""

from collections.abc import Mapping

from scvi_codegen.files.toml_text import package_table
from scvi_codegen.reproduce.experiment import Comparison, Experiment, Result, Verdict, common_verdict

CLAIMS: Mapping[str, str] = package_table("reproduce/paper.toml")["claims"]
"""Claims by the keys that checks name in ``bears_on``."""

EVIDENCE = ("figure-1", *(f"figure-{k}" for k in range(3, 31)), "table-8", "table-9", "correction")
"""Experiments whose checks are collected."""


def claims(results: Mapping[str, Result]) -> Result:
    """Return a row for each claim, with the checks that decide it."""
    checks, rows = [(name, check) for name in EVIDENCE if name in results for check in results[name].checks], []
    for key, claim in CLAIMS.items():
        evidence = [(name, check) for name, check in checks if key in check.bears_on]
        counted = {verdict: [name for name, check in evidence if check.verdict is verdict] for verdict in Verdict}
        parts = [f"{len(n)} {verdict.value} ({', '.join(dict.fromkeys(n))})" for verdict, n in counted.items() if n]
        measured = f"Of {len(evidence)} checks: {'; '.join(parts)}." if parts else "No check bears on it."
        rows.append(Comparison(claim=claim, measured=measured, verdict=common_verdict(check for _, check in evidence)))
    missing = ", ".join(name for name in EVIDENCE if name not in results)
    return Result(
        setting=(
            "Every check of a figure or table names the claims that it bears on; here they are collected.",
            "A claim holds if all its checks hold, does not hold if none does, and holds in part otherwise; a claim "
            "without a check is only shown.",
            f"Collected from {len(results)} of {len(EVIDENCE)} experiments{'; without ' if missing else ''}{missing}.",
        ),
        checks=tuple(rows),
    )


EXPERIMENTS = (
    Experiment(name="claims", title="The claims of the paper, one verdict each", run=claims, needs=EVIDENCE),
)
