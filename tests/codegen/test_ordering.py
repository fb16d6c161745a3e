"""The order of coordinates that makes matrices narrow."""

import random

import pytest

from scvi_codegen.codegen.lowering.stage_groups import bandwidth, bandwidth_ordering


def ring(count: int) -> list[tuple[int, int]]:
    return [(i, (i + 1) % count) for i in range(count)]


def shuffled(seed: int) -> list[tuple[int, int]]:
    names = random.Random(seed).sample(range(30), 30)
    return [(names[i], names[i + 1]) for i in range(29)]


GRID = [(x * 20 + y, (x + a) * 20 + y + 1 - a) for x in range(5) for y in range(20) for a in (0, 1)]
COUPLINGS = {
    "grid": ([(i, j) for i, j in GRID if j < 100 and (j == i + 20 or j % 20)], 100, range(7)),
    "apart": ([(0, 4), (4, 2)], 6, (1,)),
    "one": ([], 1, (0,)),
    **{f"shuffled {seed}": (shuffled(seed), 30, (1,)) for seed in range(5)},
    **{f"ring of {count}": (ring(count), count, (2,)) for count in (4, 5, 64, 255)},
}
"""Pairs of coordinates, their number, and admissible bandwidths."""
UNCHANGED = {
    "chain": ([(i, i + 1) for i in range(9)], 10),
    "dense": ([(i, j) for i in range(6) for j in range(6)], 6),
    "none": ([], 3),
    "itself": ([(1, 1)], 3),
}


@pytest.mark.parametrize("name", COUPLINGS)
def test_ordering_makes_matrices_narrow(name):
    pairs, count, widths = COUPLINGS[name]
    found = bandwidth_ordering(pairs, count)
    assert sorted(found) == list(range(count))
    assert bandwidth(pairs, found) in widths


@pytest.mark.parametrize("name", UNCHANGED)
def test_order_without_a_narrower_one_remains(name):
    pairs, count = UNCHANGED[name]
    assert bandwidth_ordering(pairs, count) == tuple(range(count))
