"""Measure what tests cost, and write ``second_tier.txt``, the tests that the quick tier leaves out.

::

    $ SCVI_CODEGEN_CACHE=$(mktemp -d) SCVI_CODEGEN_TESTS_COSTS=costs.txt pytest -n auto -m 'not full'
    $ python tests/tools/record_tiers.py costs.txt --seconds 260

Costs are processor seconds, of the processes that a test starts, too. All cases of a test that together cost at most a
threshold are quick, of others the first cases within the threshold. The threshold is the largest for which all quick
cases together cost at most the given seconds.
"""

import argparse
from collections import defaultdict
from itertools import accumulate
from pathlib import Path

from tiers import SECOND_TIER, function_of

COSTS_VARIABLE = "SCVI_CODEGEN_TESTS_COSTS"
"""Name of the file to which costs are appended."""


def read_costs(path: Path) -> dict[str, list[float]]:
    """Return the costs of the cases of each test function, in their order."""
    costs = defaultdict(list)
    for line in path.read_text(encoding="utf-8").splitlines():
        cost, _, name = line.partition(" ")
        costs[function_of(name)].append(float(cost))
    return costs


def quick_counts(costs: dict[str, list[float]], threshold: float) -> dict[str, int]:
    """Return the numbers of leading cases that cost at most ``threshold`` together."""
    return {name: sum(total <= threshold for total in accumulate(cases)) for name, cases in costs.items()}


def main() -> None:
    """Write the file for the given budget."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("costs", type=Path)
    parser.add_argument("--seconds", type=float, required=True, help="processor time of the quick tier")
    arguments = parser.parse_args()
    costs = read_costs(arguments.costs)
    thresholds = sorted({total for cases in costs.values() for total in accumulate(cases)})

    def seconds(threshold: float) -> float:
        counts = quick_counts(costs, threshold)
        return sum(sum(cases[: counts[name]]) for name, cases in costs.items())

    low, high = 0, len(thresholds) - 1
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if seconds(thresholds[middle]) <= arguments.seconds else (low, middle - 1)
    counts = quick_counts(costs, thresholds[low])
    lines = [f"{counts[name]} {name}\n" for name, cases in sorted(costs.items()) if counts[name] < len(cases)]
    SECOND_TIER.write_text("".join(lines), encoding="utf-8")
    quick = sum(counts.values())
    cases = sum(map(len, costs.values()))
    print(f"threshold {thresholds[low]:.2f} s: {quick} of {cases} cases, {seconds(thresholds[low]):.0f} s")


if __name__ == "__main__":
    main()
