"""The order of coordinates that makes matrices narrow."""

import random

import pytest

from scvi_codegen.lowering.stage_groups import bandwidth, bandwidth_ordering


def ring(count: int) -> list[tuple[int, int]]:
    return [(i, (i + 1) % count) for i in range(count)]


def test_chain_is_not_reordered():
    pairs = [(i, i + 1) for i in range(9)]
    assert bandwidth_ordering(pairs, 10) == tuple(range(10))
    assert bandwidth(pairs, bandwidth_ordering(pairs, 10)) == 1


@pytest.mark.parametrize("seed", range(5))
def test_shuffled_chain_is_restored(seed):
    names = random.Random(seed).sample(range(30), 30)
    pairs = [(names[i], names[i + 1]) for i in range(29)]
    assert bandwidth(pairs, tuple(range(30))) > 2
    assert bandwidth(pairs, bandwidth_ordering(pairs, 30)) == 1


@pytest.mark.parametrize("count", [4, 5, 64, 255])
def test_a_ring_is_folded(count):
    found = bandwidth_ordering(ring(count), count)
    assert sorted(found) == list(range(count))
    assert bandwidth(ring(count), found) == 2


def test_bandwidth_of_a_grid_is_its_shorter_side():
    pairs = [(x * 20 + y, (x + a) * 20 + y + 1 - a) for x in range(5) for y in range(20) for a in (0, 1)]
    pairs = [(i, j) for i, j in pairs if j < 100 and (j == i + 20 or j % 20)]
    assert bandwidth(pairs, bandwidth_ordering(pairs, 100)) <= 6


def test_dense_coupling_is_not_reordered():
    assert bandwidth_ordering([(i, j) for i in range(6) for j in range(6)], 6) == tuple(range(6))


def test_uncoupled_coordinates_are_ordered():
    assert bandwidth_ordering([], 3) == (0, 1, 2)
    assert bandwidth_ordering([(1, 1)], 3) == (0, 1, 2)
    assert sorted(bandwidth_ordering([(0, 4), (4, 2)], 6)) == list(range(6))
    assert bandwidth([], (0,)) == 0
