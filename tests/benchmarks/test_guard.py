"""The guard: it sees a checkout that is slower or that makes more C, and none that is equal."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from benchmarks import guard as guarding
from benchmarks.guard_cases import CASES, WHOLE

ROOT = Path(guarding.__file__).parents[1]
PACKAGE = """
class LagrangianSystem:
    def from_text(name, coordinates, lagrangian, **options):
        return name


class Stepper:
    def __init__(self):
        self.source = type("Source", (), {{"code": "x = a + b;\\n" * {lines}}})

    def integrate(self, *state, **options):
        return sum(bytes({work}))


def compile_stepper(system, method):
    {missing}
    return Stepper()
"""


@pytest.fixture
def checkout(tmp_path):
    """Return a function that makes a package whose runs take some work, and whose C has some lines.

    The work sums bytes: it allocates nothing in its loop, so that its time does not depend on where in a pool of
    memory a process stands.
    """

    def made(name, work=100_000, lines=100, missing=""):
        (tmp_path / name / "scvi_codegen").mkdir(parents=True)
        text = PACKAGE.format(work=work, lines=lines, missing=missing)
        (tmp_path / name / "scvi_codegen" / "__init__.py").write_text(text)
        return str(tmp_path / name)

    return made


def guard(*arguments):
    return CliRunner().invoke(guarding.guard, [*map(str, arguments), "--minutes", "2"])


def test_slower_checkout_fails_and_equal_one_passes(checkout):
    old, same, slow = checkout("old"), checkout("same"), checkout("slow", work=300_000)
    result = guard(old, slow, "--cases", "kepler fixed")
    assert result.exit_code == 1, result.output
    assert "SLOWER" in result.output
    assert "slower than 1.15: kepler fixed (" in result.output
    result = guard(slow, old, "--also", same, "--cases", "kepler fixed")
    assert result.exit_code == 0, result.output
    assert "slower than 1.15: none" in result.output


@pytest.mark.second
def test_more_lines_of_c_fail(checkout):
    result = guard(checkout("old"), checkout("new", lines=140), "--cases", "make a pendulum")
    assert result.exit_code == 1, result.output
    assert "counts above 1.3: make a pendulum, lines, make a pendulum, operations" in result.output


@pytest.mark.second
def test_cases_that_a_checkout_lacks_are_not_measured(checkout):
    old, new = checkout("old"), checkout("new", missing="raise NotImplementedError('none')")
    result = guard(old, new, "--cases", "kepler fixed")
    assert result.exit_code == 2, result.output
    assert "not measured: new: NotImplementedError: none" in result.output
    result = guard(old, checkout("other"), "--also", new, "--cases", "kepler fixed")
    assert result.exit_code == 0, result.output


def test_cases_of_ci_exist_and_baseline_names_commits():
    assert set(guarding.OF_CI) <= {*CASES, *WHOLE}
    lines = (ROOT / ".ci" / "baseline").read_text().splitlines()
    assert len(lines) == 2
    assert all(len(line.split()[0]) == 8 and int(line.split()[0], 16) for line in lines)


@pytest.mark.full
@pytest.mark.parametrize("name", [*CASES, *WHOLE])
def test_every_case_runs(name):
    result = guard(ROOT, ROOT, "--cases", name)
    assert "not measured" not in result.output, result.output
