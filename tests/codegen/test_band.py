"""LU factors in a band, with room for the fill-in of row exchanges, compared with NumPy's of the full matrix."""

from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from samples import QUICK_FLAGS

from scvi_codegen.codegen.native.building import load
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.cache import template_folder

HEAD = """#include "band.h"
#include <math.h>
#include <stddef.h>
#define SUPPORT_NUMBERS_H
typedef double real;
#define MATH(f) f
static inline int least(int a, int b)
{
  return a < b ? a : b;
}
static int BAND;
#include "support/newton/band.h"
"""
DECLARATIONS = """int band_shape(int bandwidth, int sites, int blocks, int *shape);
int band_solve(int bandwidth, int sites, int blocks, double *a, double *pivot, double *x);
"""
CODE = """
int band_shape(int bandwidth, int sites, int blocks, int *shape)
{
  BAND = bandwidth;
  const band found = band_of(sites, blocks);
  shape[0] = found.reach;
  shape[1] = found.stride;
  shape[2] = found.first;
  return (int)band_size(&found);
}

int band_solve(int bandwidth, int sites, int blocks, double *a, double *pivot, double *x)
{
  BAND = bandwidth;
  const band shape = band_of(sites, blocks);
  if (!factorise(a, &shape, pivot))
    return 0;
  back_substitute(a, &shape, pivot, x);
  return 1;
}
"""
WORST = 1e8
SHAPES = [(0, 5, 2), (1, 4, 2), (1, 12, 1), (1, 12, 3), (2, 15, 2), (3, 40, 1), (5, 6, 2)]


@cache
def library() -> Any:
    text = (template_folder() / "support/newton/band.h").read_text(encoding="utf-8")
    source = Source(
        prefix="band",
        header=DECLARATIONS,
        code=HEAD + CODE,
        declarations=DECLARATIONS,
        support=(("support/newton/band.h", text), ("support/core/numbers.h", "")),
    )
    return load(source, flags=QUICK_FLAGS)


def solved(bandwidth: int, sites: int, blocks: int, matrix: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    lib, ffi, _ = library()
    rows, shape = sites * blocks, np.zeros(3, dtype=np.int32)
    size = lib.band_shape(bandwidth, sites, blocks, ffi.cast("int *", ffi.from_buffer(shape)))
    reach, stride, first = shape.tolist()
    a, pivot, x = np.zeros(size), np.zeros(rows), right.copy()
    for i, j in zip(*np.nonzero(matrix), strict=True):
        assert abs(i - j) <= reach
        a[first + j * stride + i] = matrix[i, j]
    numbers = (ffi.cast("double *", ffi.from_buffer(each)) for each in (a, pivot, x))
    return x if lib.band_solve(bandwidth, sites, blocks, *numbers) else None


def matrices(bandwidth: int, sites: int, blocks: int):
    """Return test matrices with couplings of sites: random, growing downwards (which forces pivoting), and others."""
    rows, generator = sites * blocks, np.random.default_rng(3)
    i, j = np.indices((rows, rows))
    meets = abs(i // blocks - j // blocks) <= bandwidth
    for downwards, diagonal in product((0.0, 1.0, -1.0), (1.0, 0.0)):
        whole = generator.uniform(-1, 1, (rows, rows)) * np.exp(downwards * (i - j))
        yield np.where(meets, np.where(i == j, diagonal * whole, whole), 0.0)


@pytest.mark.parametrize(("bandwidth", "sites", "blocks"), SHAPES)
def test_solutions_are_those_of_the_full_matrix(bandwidth, sites, blocks):
    regular = [each for each in matrices(bandwidth, sites, blocks) if np.linalg.cond(each) < WORST]
    assert len(regular) >= 2
    for matrix in regular:
        expected = np.cos(np.arange(sites * blocks))
        found = solved(bandwidth, sites, blocks, matrix, matrix @ expected)
        assert found is not None
        assert np.max(np.abs(found - expected)) < 1e-14 * np.linalg.cond(matrix)


def test_singular_matrix_is_reported():
    assert solved(1, 6, 1, np.diag([1.0, 2.0, 0.0, 1.0, 1.0, 1.0]), np.ones(6)) is None
