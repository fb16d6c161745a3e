"""Measure what tests cost, and write ``second_tier.txt``, the tests that the quick tier leaves out.

::

    $ export SCVI_CODEGEN_CACHE=$(mktemp -d) SCVI_CODEGEN_TESTS_COSTS=quick.txt
    $ pytest -n auto
    $ SCVI_CODEGEN_TESTS_COSTS=second.txt pytest -n auto -m second
    $ python tests/tools/record_tiers.py quick.txt second.txt --quick 200 --both 900

Costs are processor seconds, of the processes that a test starts, too. All cases of a test that together cost at most a
threshold are quick, of others the first cases within the threshold. The threshold is the largest for which all quick
cases together cost at most the given seconds. A second threshold limits the cases of both tiers in the same way. The
second tier finds programs compiled by the first, so that with two files tiers only lose cases. With one file of a run
of all cases (``-m 'not full'``, ``SCVI_CODEGEN_TESTS_PART=all``) they are chosen anew.
"""

import argparse
from bisect import bisect_right
from collections import defaultdict
from itertools import accumulate
from pathlib import Path

from tiers import SECOND_TIER, function_of

COSTS_VARIABLE = "SCVI_CODEGEN_TESTS_COSTS"
"""Name of the file to which costs are appended."""


def read_costs(*paths: Path) -> dict[str, list[float]]:
    """Return the costs of the cases of each test function, in their order."""
    costs = defaultdict(list)
    for line in "".join(path.read_text(encoding="utf-8") for path in paths).splitlines():
        cost, _, name = line.partition(" ")
        costs[function_of(name)].append(float(cost))
    return costs


def leading_cases(costs: dict[str, list[float]], seconds: float) -> dict[str, int]:
    """Return the numbers of leading cases under the largest threshold by which all cost at most ``seconds``."""
    thresholds = sorted({total for cases in costs.values() for total in accumulate(cases)})
    totals = {name: list(accumulate(cases)) for name, cases in costs.items()}

    def counts(threshold: float) -> dict[str, int]:
        return {name: bisect_right(cases, threshold) for name, cases in totals.items()}

    def cost(threshold: float) -> float:
        return sum(totals[name][count - 1] for name, count in counts(threshold).items() if count)

    largest = bisect_right(thresholds, seconds, key=cost)
    print(f"at most {thresholds[largest - 1]:.2f} s a test: {cost(thresholds[largest - 1]):.0f} s")
    return counts(thresholds[largest - 1])


def main() -> None:
    """Write the file for the given budgets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("costs", type=Path, nargs="+", help="costs of the quick tier; of the second tier")
    parser.add_argument("--quick", type=float, required=True, help="processor time of the quick tier in seconds")
    parser.add_argument("--both", type=float, required=True, help="processor time of the quick and the second tier")
    arguments = parser.parse_args()
    costs = read_costs(*arguments.costs)
    quick = dict.fromkeys(costs, 0) | leading_cases(read_costs(arguments.costs[0]), arguments.quick)
    both = leading_cases(costs, arguments.both)
    limits = {name: (quick[name], both[name]) for name, cases in costs.items() if quick[name] < len(cases)}
    if len(arguments.costs) > 1:  # of limited tests not all cases ran
        for line in SECOND_TIER.read_text(encoding="utf-8").splitlines():
            *numbers, name = line.split(" ", 2)
            limits[name] = tuple(map(min, limits.get(name, former := [*map(int, numbers)]), former))
    lines = [f"{first} {last} {name}\n" for name, (first, last) in sorted(limits.items())]
    SECOND_TIER.write_text("".join(lines), encoding="utf-8")
    numbers = (sum(each.values()) for each in (quick, both))
    print("quick: {}, both: {}, all: {} cases".format(*numbers, sum(map(len, costs.values()))))


if __name__ == "__main__":
    main()
