"""Command ``scvi-codegen doctor``: checks of libraries, the compiler, a trial run and the cache of this machine."""

import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import NamedTuple

import click

from scvi_codegen.codegen.native.building import FLAGS_VARIABLE, TUNED_FLAGS
from scvi_codegen.codegen.native.compilers import compiler_title, find_compiler, from_wheel, running
from scvi_codegen.common.cache import CACHE_VARIABLE, cache_folder, cache_info, exposed, remedy_of
from scvi_codegen.common.errors import BuildError
from scvi_codegen.interfaces.cli.command_group import CommandFailure, reporting, tell

OF_FIRST_RUNS, OF_DEVELOPERS = ("compiler", "data", "plot"), ("bench", "docs", "release", "test")
"""Extras that are listed first and last."""
OK, MISSING, FAILED = "ok", "lacks", "fails"
PACKAGE = "scvi-codegen"
REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+)(\[(?P<own>\w+)\])?\s*(>=\s*(?P<least>[\w.]+))?.*?(extra == ['\"](?P<extra>\w+)['\"])?$"
)
"""A requirement in a package's metadata: library, its own extra, least version, and the extra that requires it."""
TRIAL_SECONDS = 120
VECTOR_CALL = b"_ZGV"
"""Prefix of the names of vector functions in the vector ABI of x86-64."""
ENERGY_BOUND = 1e-6
"""Bound on the relative energy error of the trial run, which is far below it on a sound machine."""

TRIAL = f"""
import logging, os, sys
logging.getLogger("scvi_codegen").setLevel(logging.WARNING)
sys.excepthook = lambda kind, error, place: print(error, file=sys.stderr)
os.environ["{CACHE_VARIABLE}"] = os.getcwd()
sys.path.insert(0, {str(Path(__file__).parents[3])!r})
import scvi_codegen as sc
stepper = sc.compile_stepper(sc.problem("planar-pendulum").system, "svi:4")
energy = stepper.integrate([0.5], [0.0], h=0.1, steps=1000).energy()
print(abs(energy / energy[0] - 1).max())
"""
"""Source of the trial run, which has a process of its own: an instruction unknown to the processor would kill it."""


class CheckResult(NamedTuple):
    """Result of one check.

    Attributes:
        name: name of the check.
        status: ``"ok"``, ``"lacks"`` (an optional item is missing) or ``"fails"`` (a required item is missing).
        result: description of what is installed.
        remedy: what to do if the status is not ``"ok"``, else ``""``.
    """

    name: str
    status: str
    result: str
    remedy: str = ""


def run_checks() -> Iterator[CheckResult]:
    """Yield the results of all checks one by one; the trial run, which compiles a stepper, takes some seconds."""
    yield CheckResult("python", OK, f"{platform.python_version()}, {platform.platform()}")
    yield CheckResult("cores", OK, _cores())
    yield _packages("", "libraries")
    yield from _compilation()
    yield _cache()
    extras = {requirement["extra"] for requirement in _described(PACKAGE)} - {""}
    for extra in sorted(extras, key=lambda extra: (extra in OF_DEVELOPERS, extra not in OF_FIRST_RUNS, extra)):
        yield _packages(extra, f"extra {extra}")


def _cores() -> str:
    count = os.cpu_count() or 1
    with suppress(AttributeError):  # not on every system
        allowed = len(os.sched_getaffinity(0))
        return str(count) if allowed == count else f"{allowed} of {count} for this process"
    return str(count)


def _requirements(package: str, extra: str) -> Iterator[dict[str, str]]:
    """Yield the requirements of an extra of an installed package ("": the unconditional ones), recursively."""
    for requirement in _described(package):
        if requirement["extra"] == extra:
            yield requirement
            if requirement["own"]:
                yield from _requirements(requirement["name"], requirement["own"])


def _described(package: str) -> list[dict[str, str]]:
    """Return names, least versions and extras of a package's requirements; an empty list if it is not installed."""
    try:
        lines = requires(package) or []
    except PackageNotFoundError:
        return []
    return [match.groupdict("") for match in map(REQUIREMENT.match, lines) if match]


def _packages(extra: str, name: str) -> CheckResult:
    present, absent = [], []
    for requirement in _requirements(PACKAGE, extra):
        try:
            installed = version(requirement["name"])
        except PackageNotFoundError:
            absent.append(requirement["name"])
            continue
        present.append(f"{requirement['name']} {installed}")
        if _numbers(installed) < _numbers(requirement["least"]):
            absent.append(f"{requirement['name']} >= {requirement['least']}")
    if not absent:
        return CheckResult(name, OK, ", ".join(present))
    remedy = f"missing {', '.join(absent)}: pip install '{PACKAGE}{f'[{extra}]' if extra else ''}'"
    return CheckResult(name, MISSING if extra else FAILED, ", ".join(present) or "none installed", remedy)


def _numbers(text: str) -> tuple[int, ...]:
    """Return the first three numbers of a version."""
    return tuple(int(part) for part in re.findall(r"\d+", text)[:3])


def _compilation() -> Iterator[CheckResult]:
    """Check the compiler, its flags, a compiled stepper, and the vector library."""
    try:
        command = find_compiler()
        title = compiler_title()
    except (BuildError, OSError, subprocess.TimeoutExpired) as error:
        yield CheckResult("compiler", FAILED, "none", str(error))
        return
    bundled = from_wheel(command) and not os.environ.get("CC")
    reason = " (extra compiler: the PATH has no cc, gcc or clang)" if bundled else ""
    yield CheckResult("compiler", OK, f"{' '.join(command)}: {title}{reason}")
    further = [flags, f"({FLAGS_VARIABLE})"] if (flags := os.environ.get(FLAGS_VARIABLE, "")) else []
    yield CheckResult("flags", OK, " ".join([*TUNED_FLAGS, *further]))
    with tempfile.TemporaryDirectory(prefix="scvi-codegen-doctor-", ignore_cleanup_errors=True) as folder:
        trial = _trial(Path(folder))
        yield trial
        if trial.status == OK:
            yield _vectors(Path(folder))


def _trial(folder: Path) -> CheckResult:
    began = time.perf_counter()
    with running([sys.executable, "-c", TRIAL], folder) as process:
        try:
            message, errors = process.communicate(timeout=TRIAL_SECONDS)
        except subprocess.TimeoutExpired:
            return _trial_failure(f"no result within {TRIAL_SECONDS} s")
    if process.returncode:
        return _trial_failure(errors.strip() or _exit_reason(process.returncode))
    error = float(message)
    if not error < ENERGY_BOUND:
        return _trial_failure(f"relative energy error {error:.0e}: compiler or flags violate IEEE 754 arithmetic")
    took = f"compiled and run in {time.perf_counter() - began:.1f} s"
    return CheckResult("trial", OK, f"a pendulum, {took}, relative energy error {error:.0e}")


def _trial_failure(reason: str) -> CheckResult:
    remedy = [*reason.splitlines()[-12:], f"use another compiler (CC=gcc, CC=clang), or check {FLAGS_VARIABLE}"]
    return CheckResult("trial", FAILED, "a pendulum could not be compiled and run", "\n".join(remedy))


def _exit_reason(status: int) -> str:
    """Return the reason why a process without output ended; shells report a signal as 128 + its number."""
    number = -status if status < 0 else status - 128
    with suppress(ValueError):
        return f"the compiled program was ended by {signal.Signals(number).name}"
    return f"the trial run ended with status {status}"


def _vectors(folder: Path) -> CheckResult:
    """Check if the compiled library calls glibc's vector functions."""
    if any(VECTOR_CALL in library.read_bytes() for library in folder.glob("_scvi_*/*.so")):
        return CheckResult("vectors", OK, "libmvec: vectorised sines and exponentials")
    remedy = "it requires glibc 2.22 or later on x86-64 and -march=native among the flags (Debian, Ubuntu: apt install "
    return CheckResult("vectors", MISSING, "no libmvec: scalar sines and exponentials", f"{remedy}libc6-dev)")


def _cache() -> CheckResult:
    folder = cache_folder()
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        cache_text = str(cache_info()).replace("\n", ": ")
    except BuildError as error:
        return CheckResult("cache", MISSING, str(folder), str(error))
    remedy = ""
    if exposed(folder):
        remedy = f"the cache is not used, because {remedy_of(folder)}"
    elif not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        remedy = f"the folder is not writable, nothing is cached: set {CACHE_VARIABLE} to another one"
    return CheckResult("cache", MISSING if remedy else OK, cache_text, remedy)


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
        tell(f"{finding.status:{STATUS_WIDTH}} {finding.name:{NAME_WIDTH}} {finding.result}")
        for line in finding.remedy.splitlines():
            tell(" " * (STATUS_WIDTH + NAME_WIDTH + 2) + line)
    failing = [finding.name for finding in findings if finding.status == FAILED]
    tell(ok=not failing, findings=[finding._asdict() for finding in findings])
    if failing:
        raise CommandFailure(f"integrators cannot be compiled and run on this machine: {', '.join(failing)}")
