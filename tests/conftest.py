"""Fixtures of all tests; what they are made from is in ``tools/samples.py``."""

import gc
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import programs
import pytest
from browsing import chromium
from samples import UNOPTIMISED, Sample, compile_quickly, sample_named, stepper_for
from tiers import QUICK, SECOND, UNOPTIMISED_TIERS, long_ones_first, mark_later_tiers, mark_the_rest_full

from scvi_codegen import LagrangianSystem, Stepper
from scvi_codegen.codegen.native.building import FLAGS_VARIABLE
from scvi_codegen.common import validation
from scvi_codegen.methods.method import Method

validation.KEEPS_FRAMES = True
logging.getLogger("scvi_codegen").setLevel(logging.WARNING)  # slow compilations are not announced on stderr
sys.addaudithook(programs.audit)
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background of a shell


def pytest_configure(config: pytest.Config) -> None:
    """Lower the optimisation of compilers in most tests, whose random examples are the same in every run.

    The results of the C code do not depend on the optimisation. New examples are drawn with ``-m full`` or a seed.
    """
    if config.option.markexpr == QUICK and _are_named(config):
        config.option.markexpr = "not full"
    if config.option.markexpr == "second":
        config.option.markexpr = SECOND
    if config.option.markexpr in UNOPTIMISED_TIERS:
        os.environ.setdefault(FLAGS_VARIABLE, " ".join(UNOPTIMISED))
        hypothesis.settings.register_profile("default", derandomize=config.getoption("hypothesis_seed", None) is None)
        hypothesis.settings.load_profile("default")


def _are_named(config: pytest.Config) -> bool:
    return any("::" in argument for argument in config.args)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Forget what other tests declared; skip a test with a compiler that is not installed before it does anything."""
    programs.forget()
    if (callspec := getattr(item, "callspec", None)) and (compiler := callspec.params.get("compiler")):
        programs.needs(compiler)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Append the processor time of each test, of the processes that it starts, too, to a file: for its tier."""
    begin = sum(os.times()[:4])
    result = yield
    if path := os.environ.get(COSTS_VARIABLE):
        with Path(path).open("a", encoding="utf-8") as file:
            print(f"{sum(os.times()[:4]) - begin:.2f} {item.nodeid}", file=file)
    return result


COSTS_VARIABLE = "SCVI_CODEGEN_TESTS_COSTS"
"""Name of the file to which processor seconds and names of tests are appended."""
SKIPPED_VARIABLE = "SCVI_CODEGEN_TESTS_SKIPPED"
"""Name of a file to which the tests that were skipped are appended, one a line, for a later run with more programs."""


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _record_skipped(report)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    _record_skipped(report)


def _record_skipped(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Record it in the process that writes the summary, not in the workers of a distributed run."""
    path = os.environ.get(SKIPPED_VARIABLE)
    if path and report.skipped and "PYTEST_XDIST_WORKER" not in os.environ:
        with Path(path).open("a", encoding="utf-8") as file:
            print(report.nodeid, file=file)


@pytest.hookimpl(tryfirst=True)  # before those of other tiers are left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    mark_the_rest_full(items)
    if not _are_named(config):
        mark_later_tiers(items)
    long_ones_first(items)


def pytest_collection_finish() -> None:
    """Freeze collected objects, so that the garbage collector does not visit them repeatedly."""
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Distribute the quick and the second tier by file, so that shared fixtures are made once."""
    if config.option.markexpr not in UNOPTIMISED_TIERS or config.args_source is not config.ArgsSource.TESTPATHS:
        return None
    from distribution import FilesOnce

    config.option.loadscopereorder = False  # the order of `long_ones_first`
    return FilesOnce(config, log)


@pytest.fixture(scope="module")
def as_users_compile() -> Iterator[None]:
    """Compile with the default flags, for tests of bits, round-off, long runs and documentation."""
    with pytest.MonkeyPatch.context() as patch:
        if os.environ.get(FLAGS_VARIABLE) == " ".join(UNOPTIMISED):  # and not those of `test_builds.py`
            patch.delenv(FLAGS_VARIABLE)
        yield


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A new folder, which is the working folder of the test."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def sample() -> Callable[[str], Sample]:
    return sample_named


@pytest.fixture(scope="session")
def compiled() -> Callable[..., Stepper]:
    return stepper_for


@pytest.fixture(scope="session")
def quickly_compiled() -> Callable[[LagrangianSystem, Method], Stepper]:
    """Compile with little optimisation, for systems without a name."""
    return compile_quickly


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium, for a module: its event loop is in the way of other tests that have one."""
    with chromium() as started:
        yield started
