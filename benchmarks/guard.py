"""Command ``python -m benchmarks guard``: is one checkout slower than another?

A process of each checkout (:mod:`benchmarks.guard_cases`) takes turns of about 2 ms. Processor time of the same work
varies by tens of percent on a busy machine, in favour of neither: a case is slower only if three estimates of the ratio
new/old agree - of the least times, of the means of the quickest quarter, and the median of the ratios of adjacent
turns - and a second measurement in fresh processes, in the other order and with twice the turns, confirms it. Counts
(lines and operations of the C that a checkout makes) do not vary; seconds of making a stepper are least values.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click

from benchmarks.guard_cases import CASES, WHOLE

TURN, TURNS = 0.002, 24
"""Seconds of a turn; turns of a first measurement."""
QUARTER = 4
"""The quickest turns, one in so many, are averaged."""
WHOLE_TURNS = 5
"""Processes of a case that takes a whole process; a case that makes a stepper in more than a second takes one."""
SLOWER, MUCH_SLOWER, MORE = 1.15, 1.5, 1.3
"""Ratios of times that are printed as slower, and that fail; ratio of a count that fails.

Five comparisons of a checkout with itself on a busy machine had no three estimates above 1.15.
"""
OF_CI = (
    "kepler fixed",
    "anisotropic kepler",
    "forced duffing",
    "rods adaptive 1e-8",
    "contact",
    "ensemble adaptive",
    "call",
    "make a pendulum",
)
"""Cases of ``--quick``."""
PROCESS = Path(__file__).with_name("guard_cases.py")


class Ratios(NamedTuple):
    """Estimates of the time of the new checkout relative to that of the old one, and its least time in seconds."""

    least: float
    quickest: float
    median: float
    seconds: float

    @property
    def agreed(self) -> float:
        """The ratio that all three estimates reach."""
        return min(self[:3])


class Side:
    """Process of one checkout, in the environment of this one: its package is that on PYTHONPATH."""

    def __init__(self, checkout: Path, folder: Path) -> None:
        self.checkout, self.folder = checkout.resolve(), folder
        folder.mkdir()
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(self.checkout),
            "SCVI_CODEGEN_CACHE": str(folder / "cache"),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        self.process: subprocess.Popen[str] | None = None

    def _popen(self, *arguments: str, **environment: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-P", str(PROCESS), *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=self.folder,
            env={**self.environment, **environment},
        )  # fmt: skip

    def stop(self) -> None:
        """End the process, if there is one."""
        if self.process:
            self.process.communicate()
            self.process = None

    def send(self, **request: Any) -> None:
        """Send a request, to a new process if there is none."""
        self.process = self.process or self._popen()
        assert self.process.stdin
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def receive(self) -> float | str:
        """Return the answer to the last request."""
        assert self.process
        assert self.process.stdout
        line = self.process.stdout.readline()
        return json.loads(line) if line else "the process ended"

    def whole(self, name: str) -> dict[str, float] | str:
        """Return the measurements of a process that does nothing else."""
        with tempfile.TemporaryDirectory(dir=self.folder) as empty:
            cache = {"SCVI_CODEGEN_CACHE": empty} if name.startswith("make ") else {}
            text, _ = self._popen(name, **cache).communicate()
        return json.loads(text) if text else "the process failed"


def in_turns(name: str, new: Side, others: Sequence[Side], turns: int) -> list[Ratios] | str:
    """Return the ratios of ``new`` to each of the others that can run the case, or why the first of these cannot."""
    sides = [*others, new]
    for side in sides:  # they prepare at once
        side.send(case=name)
    answers = [side.receive() for side in sides]
    for side, seconds in ((sides[0], answers[0]), (sides[-1], answers[-1])):
        if isinstance(seconds, str):
            return f"{side.checkout.name}: {seconds}"
    sides = [side for side, seconds in zip(sides, answers, strict=True) if isinstance(seconds, float)]
    first = [seconds for seconds in answers if isinstance(seconds, float)]
    calls, slowest = max(1, round(TURN / min(first))), max(TURN, *first)
    turns = max(8, min(turns, round(1.5 * turns * TURN / slowest)))
    times: list[list[float]] = [[] for _ in sides]
    for turn in range(turns):
        for i in range(len(sides)) if turn % 2 else reversed(range(len(sides))):
            sides[i].send(case=name, calls=calls)
            times[i].append(float(sides[i].receive()))
    return [_ratios(old, times[-1]) for old in times[:-1]]


def _ratios(old: list[float], new: list[float]) -> Ratios:
    def quickest(times: list[float]) -> float:
        return statistics.fmean(sorted(times)[: max(2, len(times) // QUARTER)])

    pairs = statistics.median(b / a for a, b in zip(old, new, strict=True))
    return Ratios(min(new) / min(old), quickest(new) / quickest(old), pairs, min(new))


def of_processes(name: str, new: Side, others: Sequence[Side]) -> tuple[list[dict[str, float]], dict[str, float]] | str:
    """Return, for each other side, the ratios of the least values of a case of ``WHOLE``, and those of ``new``."""
    sides = [*others, new]
    least: list[dict[str, float]] = []
    for turn in range(WHOLE_TURNS):
        for i, side in enumerate(sides):
            measured = side.whole(name)
            if isinstance(measured, str):
                return f"{side.checkout.name}: {measured}"
            if turn == 0:
                least.append(measured)
            least[i] = {key: min(value, measured[key]) for key, value in least[i].items()}
        if name.startswith("make ") and max(of["seconds"] for of in least) > 1.0:
            break
    return [{key: least[-1][key] / value for key, value in old.items() if value} for old in least[:-1]], least[-1]


class Guard:
    """Comparison of a checkout with an old one, and with further ones that are printed only."""

    def __init__(self, new: Path, others: Sequence[Path], folder: Path, tell: Callable[[str], None]) -> None:
        self.new = Side(new, folder / "new")
        self.others = [Side(path, folder / f"old{i}") for i, path in enumerate(others)]
        self.tell, self.measured = tell, 0
        self.slower: dict[str, float] = {}
        self.more: list[str] = []

    def compare(self, names: Sequence[str], seconds: float) -> None:
        """Measure the cases, and those that seem slower once more in fresh processes, for about so many seconds."""
        began = time.monotonic()
        suspects = [name for name in names if self._is_in_time(began, seconds, name) and self._seems_slower(name)]
        for name in suspects:
            self._stop()
            ratios = in_turns(name, self.new, self.others[:1], 2 * TURNS)
            if not isinstance(ratios, str):
                if ratios[0].agreed > SLOWER:
                    self.slower[name] = ratios[0].agreed
                self.tell(f"{name:28s} again: {_told(ratios)}" + ("  SLOWER" if name in self.slower else ""))
        self._stop()

    def _is_in_time(self, began: float, seconds: float, name: str) -> bool:
        if time.monotonic() - began < seconds:
            return True
        self.tell(f"{name:28s} not measured: the time of the comparison is over")
        return False

    def _seems_slower(self, name: str) -> bool:
        if name in WHOLE:
            self._compare_processes(name)
            return False
        ratios = in_turns(name, self.new, self.others, TURNS)
        if isinstance(ratios, str):
            self.tell(f"{name:28s} not measured: {ratios}")
            return False
        self.measured += 1
        self.tell(f"{name:28s} {1e6 * ratios[0].seconds:10.1f} us  {_told(ratios)}")
        return ratios[0].agreed > SLOWER

    def _compare_processes(self, name: str) -> None:
        result = of_processes(name, self.new, self.others)
        if isinstance(result, str):
            self.tell(f"{name:28s} not measured: {result}")
            return
        self.measured += 1
        ratios, values = result
        for key, value in values.items():
            told = "  ".join(f"{ratio[key]:5.2f}" if key in ratio else "    -" for ratio in ratios)
            self.tell(f"{name + ', ' + key:28s} {value:10.4g}     {told}")
            if key in ("lines", "operations") and ratios[0].get(key, 1.0) > MORE:
                self.more.append(f"{name}, {key}")

    def _stop(self) -> None:
        for side in (self.new, *self.others):
            side.stop()


def _told(ratios: Sequence[Ratios]) -> str:
    return "   ".join(f"{of.least:5.2f} {of.quickest:5.2f} {of.median:5.2f}" for of in ratios)


@click.command("guard", context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("old", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("new", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--also", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="CHECKOUT",
              help="A third checkout, with which NEW is compared, too, without consequence.")  # fmt: skip
@click.option(
    "--cases", default="", metavar="TEXT,..", help="Cases whose names contain one of the texts; default: all."
)
@click.option("--quick", is_flag=True, help="The eight cases of .ci/run.")
@click.option(
    "--minutes", type=click.FloatRange(min=0.1), default=30.0, show_default=True, help="No case begins later."
)
def guard(old: Path, new: Path, also: Path | None, cases: str, quick: bool, minutes: float) -> None:
    """Compare the speed of two checkouts of scvi_codegen, both in this environment.

    Columns are ratios NEW/OLD: of the least times, of the means of the quickest quarter, the median of adjacent turns;
    then the same beside --also. Exit code 1 if both measurements of a case exceed 1.5, or a count of what is made 1.3;
    2 if nothing could be measured.
    """
    names = OF_CI if quick else tuple(CASES) + tuple(WHOLE)
    names = tuple(name for name in names if not cases or any(part in name for part in cases.split(",")))
    with tempfile.TemporaryDirectory() as folder:
        comparison = Guard(new, [old, also] if also else [old], Path(folder), click.echo)
        comparison.compare(names, 60.0 * minutes)
    slow = ", ".join(f"{name} ({ratio:.2f})" for name, ratio in comparison.slower.items())
    more = ", ".join(comparison.more)
    click.echo(f"slower than {SLOWER}: {slow or 'none'}; counts above {MORE}: {more or 'none'}")
    if not comparison.measured:
        sys.exit(2)
    sys.exit(bool(comparison.more) or any(ratio > MUCH_SLOWER for ratio in comparison.slower.values()))
