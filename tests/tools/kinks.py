"""Errors of runs across kinks: ``python tests/tools/kinks.py [cases of a family] [number of the first] [families]``."""

import math
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1] / "oracles"), str(Path(__file__).parent)]

from nonsmooth import FAMILIES, Case, case_of

import scvi_codegen as sc

METHODS = {"svi:2": (1, 0.2), "svi:4": (2, 0.5), "svi:8": (4, 1.2)}
"""Degrees whose orders are measured in place of those of adaptive runs, and the longest of their steps, in radians."""
ROUNDOFF, LOOSE, BOUND = 2e-14, 1e-6, 1e-8
"""Relative errors of a run by default, a given tolerance, and the bound of ``error=``."""
EPSILON, ROUNDING_AT_KINK = 2.0**-52, 50
"""Rounding error of steps and of positions, and by how much those at kinks exceed it, in the reference, too."""
UNSEEN = {"svi:2": 8.0}
"""By which local errors of curves of one coefficient exceed their estimates."""
KINDS = ("round-off", "tolerance", "at", "error=", "order")
ALLOWED = {"round-off": 10.0, "tolerance": 10.0, "at": 10.0, "error=": 1.0, "order": 0.0}
"""Largest errors in tolerances, and by how much a measured order may be too low."""
SLACK = {1: 0.3, 2: 0.4, 4: 1.0}
"""By which orders from three step sizes may be lower than 2 s, by degrees."""


@cache
def stepper_of(family: str, method: str) -> Any:
    return sc.compile_stepper(FAMILIES[family].system(family), method)


def error_of(case: Case, q: Any) -> float:
    """Return the largest error of positions relative to the size of the motion and the growth of errors."""
    return float(np.abs(np.asarray(q) - case.q).max() / case.ranges.max() / max(1.0, case.growth))


def rounding_of(case: Case, steps: int) -> float:
    """Return the rounding error of a run relative to the size of the motion, which may be far from the origin."""
    far = float(np.abs(case.q).max() / case.ranges.max())
    return ROUNDOFF + EPSILON * (steps + far + ROUNDING_AT_KINK * len(case.kinks))


def lacking_order(family: str, case: Case, degree: int, angle: float) -> float:
    """Return by how much the order between steps h, h/2 and h/4 is below 2 s, less ``SLACK[s]``; 0 at round-off.

    h is at most a quarter of the time between two kinks, not less than 1e-3 of the run; those at one time are one.
    """
    stepper, span, errors = stepper_of(family, f"svi:{degree}"), case.t[-1] - case.t[0], []
    between = np.diff([0.0, *case.kinks])
    least = between[between > 1e-9].min(initial=math.inf)
    if least < 1e-3 * case.motion.span:
        return 0.0
    fewest = math.ceil(case.motion.span * max(case.motion.rate / angle, 4.0 / least))
    for factor in (1, 2, 4):
        run = stepper.integrate(**case.arguments, h=span / (factor * fewest), t_eval=case.t)
        errors.append(error_of(case, run.q))
    above = [e for e in errors if e > 10 * rounding_of(case, fewest)]
    return 2 * degree - SLACK[degree] - math.log2(above[0] / above[-1]) / (len(above) - 1) if len(above) > 1 else 0.0


def outcome(family: str, case: Case, method: str, kind: str) -> tuple[float, int]:
    """Return error / tolerance, infinite if the run fails and NaN if it is not confirmed, and the number of steps."""
    stepper = stepper_of(family, method)
    try:
        if kind == "order":
            return lacking_order(family, case, *METHODS[method]), 0
        if kind == "error=":
            run = stepper.integrate(**case.arguments, error=BOUND)
            error = np.abs(run.at(case.t)[0] - case.q) / np.where(case.ranges > 0.0, case.ranges, 1.0)
            return (float(error.max() / BOUND) if run.confirmation.confirmed else math.nan), run.steps
        if kind == "round-off":
            run = stepper.integrate(**case.arguments, t_eval=case.t)
            return error_of(case, run.q) / rounding_of(case, run.steps) / UNSEEN.get(method, 1.0), run.steps
        times = {"t_eval": case.t} if kind == "tolerance" else {}
        run = stepper.integrate(**case.arguments, tolerance=LOOSE, **times)
        return error_of(case, run.q if times else run.at(case.t)[0]) / LOOSE / UNSEEN.get(method, 1.0), run.steps
    except Exception as failure:  # noqa: BLE001  (any failure is one to report)
        print(f"{family} {method} {kind}: {type(failure).__name__}: {failure}", file=sys.stderr)
        return math.inf, 0


def wrong(family: str, numbers: Iterable[int], methods: Iterable[str], kinds: Iterable[str] = KINDS) -> list[str]:
    """Return the outcomes that are not as guaranteed."""
    found = []
    for number in numbers:
        case = case_of(family, number)
        for method in methods:
            for kind in kinds:
                with warnings.catch_warnings(action="ignore"):
                    ratio, _ = outcome(family, case, method, kind)
                if ratio > ALLOWED[kind]:
                    found.append(f"{family} {number} {method} {kind}: {ratio:.1e}")
    return found


def print_table(count: int, first: int, families: list[str]) -> None:
    """Print worst and median error / tolerance, failures and steps of each family, a method for each case in turn."""
    for family in families:
        begin, rows = time.time(), defaultdict(list)
        for number in range(first, first + count):
            case, method = case_of(family, number), [*METHODS][number % len(METHODS)]
            for kind in KINDS:
                with warnings.catch_warnings(action="ignore"):
                    rows[method, kind].append((*outcome(family, case, method, kind), number))
        print(f"{family}: {(time.time() - begin) / count:.2f} s a case")
        for (method, kind), outcomes in sorted(rows.items()):
            ratios, steps, numbers = map(np.array, zip(*outcomes, strict=True))
            far, worst, median = ratios > ALLOWED[kind], np.nanmax(ratios), np.nanmedian(ratios)
            print(f"  {method} {kind:10} worst {worst:8.1e} median {median:8.1e} steps {np.median(steps):6.0f}", end="")
            print(
                f" wrong {far.sum():3d} of {count}, {np.isnan(ratios).sum()} not confirmed {numbers[far]}", flush=True
            )


if __name__ == "__main__":
    count, first, *families = [*sys.argv[1:], "60", "0"][: max(2, len(sys.argv) - 1)]
    print_table(int(count), int(first), families or [*FAMILIES])
