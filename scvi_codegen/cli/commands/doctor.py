"""Command ``scvi-codegen doctor``: report what this machine has and lacks."""

from __future__ import annotations

from dataclasses import asdict

import click

from scvi_codegen.cli.command_group import FAILURE, CommandFailure, reporting, tell
from scvi_codegen.cli.diagnostics import FAILED, CheckResult, run_checks

STATUS_WIDTH, NAME_WIDTH = 5, 17


@click.command()
@reporting
def doctor() -> None:
    """Check that integrators can be compiled and run on this machine, and report what to install.

    A small integrator is compiled in a temporary folder and run. Exit status 1 if that fails; other missing items are
    optional.

    \b
    Examples:
      scvi-codegen doctor
      CC=clang scvi-codegen doctor --json
    """
    findings = []
    for finding in run_checks():
        findings.append(finding)
        tell(_lines(finding))
    failing = [finding.name for finding in findings if finding.status == FAILED]
    tell(ok=not failing, findings=[asdict(finding) for finding in findings])
    if failing:
        raise CommandFailure(f"integrators cannot be compiled and run on this machine: {', '.join(failing)}", FAILURE)


def _lines(finding: CheckResult) -> str:
    """Return a line with status, name and description of a check, and indented lines with the remedy."""
    indent = " " * (STATUS_WIDTH + NAME_WIDTH + 2)
    first = f"{finding.status:{STATUS_WIDTH}} {finding.name:{NAME_WIDTH}} {finding.result}"
    return "\n".join([first, *(f"{indent}{line}" for line in finding.remedy.splitlines())])
