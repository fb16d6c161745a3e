"""The decision which conditions are independent, on random rows of known rank and of any size."""

import numpy as np
import pytest

from scvi_codegen.common.tangent_space import tangent_space

CASES = 300


def test_rank_basis_and_determined_coordinates_of_random_rows():
    random = np.random.default_rng(20)
    for _ in range(CASES):
        coordinates = random.integers(1, 7)
        rank = random.integers(0, coordinates + 1)
        count = random.integers(max(rank, 1), 8)
        rows = random.normal(size=(count, rank)) @ random.normal(size=(rank, coordinates))
        rows *= 10.0 ** random.uniform(-300.0, 300.0, size=(count, 1))  # in any unit, squares beyond doubles
        space = tangent_space(rows)
        assert space.rank == rank
        assert space.basis.shape == (coordinates, coordinates - rank)
        assert space.rows @ space.basis == pytest.approx(0.0, abs=1e-12)
        assert space.conditions.T @ space.rows == pytest.approx(0.0, abs=1e-12)
        free = np.setdiff1d(np.arange(coordinates), space.determined)
        assert len(free) == coordinates - rank
        # the free coordinates alone fix a vector of the space: their rows of the basis are regular
        assert np.linalg.matrix_rank(space.basis[free]) == coordinates - rank if len(free) else True


@pytest.mark.parametrize("shape", [(0, 3), (2, 3), (0, 0)])
def test_no_rows_and_rows_of_zeros_are_no_conditions(shape):
    space = tangent_space(np.zeros(shape))
    assert (space.rank, space.basis.shape, len(space.determined)) == (0, (shape[1], shape[1]), 0)
