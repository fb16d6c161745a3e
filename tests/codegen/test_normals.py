"""Normal numbers of a heat bath: the generator's published vectors, its functions in 40 digits, distribution, bits."""

import ctypes
import subprocess
from pathlib import Path

import mpmath
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from programs import needs

SUPPORT = Path(__file__).parents[2] / "templates/support/run"
CALLS = """
#include "normals.h"
void words(uint64_t seed, uint32_t *of) {
  noise_words x;
  for (int k = 0; k < 4; k++) x.of[k][0] = of[k];
  philox(seed, 1, &x);
  for (int k = 0; k < 4; k++) of[k] = (uint32_t)x.of[k][0];
}
void values(uint32_t high, uint32_t low, double *of) {
  of[0] = uniform_of_words(high, low), of[1] = log_of_uniform(of[0]), cos_and_sin_of_words(high, low, of + 2, of + 3);
}
void many(uint64_t step, int steps, int begin, int count, uint32_t trajectory, int width, double *z) {
  normals(0x123456789abcdef, step, steps, HEAT, begin, count, trajectory, width, z, z + steps * count * width);
}
"""
FLAGS = {"plain": ["-O0"], "tuned": ["-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno"]}


@pytest.fixture(scope="module", params=FLAGS)
def functions(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    needs("gcc")
    folder = tmp_path_factory.mktemp("normals")
    (folder / "calls.c").write_text(CALLS)
    command = ["gcc", "-std=c99", *FLAGS[request.param], "-shared", "-fPIC", f"-I{SUPPORT}", "calls.c", "-lm", "-o"]
    subprocess.run([*command, "calls.so"], check=True, cwd=folder)
    return ctypes.CDLL(str(folder / "calls.so"))


def drawn(functions: ctypes.CDLL, step: int, steps: int, begin: int, count: int, first: int, width: int) -> np.ndarray:
    """Return normals of shape (2, steps, count, width)."""
    z = np.empty((2, steps, count, width))
    place = z.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
    functions.many(ctypes.c_uint64(step), steps, begin, count, first, width, place)
    return z


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ("00000000 " * 4, 0, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff " * 4, 0xFFFFFFFFFFFFFFFF, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", 0x299F31D0A4093822, "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)
def test_known_answers_of_random123(functions, counter, key, words):
    """Lines `philox4x32 10` of kat_vectors."""
    x = (ctypes.c_uint32 * 4)(*(int(word, 16) for word in counter.split()))
    functions.words(ctypes.c_uint64(key), x)
    assert " ".join(f"{word:08x}" for word in x) == words


def test_logarithm_cosine_and_sine_have_errors_of_ulps(functions):
    pairs = [(0, 0), (2**32 - 1, 2**32 - 1), (2**31, 0), (2**29 - 1, 2**32 - 1), (2**29, 0)]
    pairs += np.random.default_rng(1).integers(0, 2**32, (400, 2)).tolist() + [(2**k, 7) for k in range(32)]
    for high, low in pairs:
        values, integer = (ctypes.c_double * 4)(), (high << 32 | low) >> 11
        functions.values(ctypes.c_uint32(high), ctypes.c_uint32(low), values)
        assert values[0] == (integer + 1) / 2**53
        with mpmath.workdps(40):
            turn = 2 * mpmath.mpf(integer) / 2**53
            exact = mpmath.log(mpmath.mpf(values[0])), mpmath.cospi(turn), mpmath.sinpi(turn)
            assert all(abs(x - y) <= 7 * 2**-53 * abs(y) for x, y in zip(values[1:], exact, strict=True))


def test_bits_depend_on_step_trajectory_and_index_alone(functions):
    """Lanes, several steps in one call, single numbers, both flags, and the end of the 32-bit step counter."""
    step = 2**32 - 2
    singly = np.array([drawn(functions, step + k // 40, 1, k // 8 % 5, 1, 3 + k % 8, 1).ravel() for k in range(160)])
    singly = np.moveaxis(singly.reshape(4, 5, 8, 2), -1, 0)
    for width in (1, 2, 4, 8):
        assert_array_equal(drawn(functions, step, 4, 0, 5, 3, width), singly[..., :width])
    assert_array_equal(drawn(functions, step, 1, 2, 100, 3, 1)[:, :, :3, 0], singly[:, :1, 2:, 0])
    assert len(np.unique(singly)) == singly.size
    assert singly[0, 0, 0, 0].hex() == "-0x1.78ac98b1b6bd9p-2"


def test_moments_and_distribution(functions):
    """Means of powers within 4 standard errors of 0, 1, 0, 3; Kolmogorov; no correlation of neighbours."""
    from scipy import stats  # a second of import

    z = drawn(functions, 0, 50, 0, 100, 0, 8)
    for power, mean, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert abs(np.mean(z**power) - mean) < 4 * np.sqrt(variance / z.size)
    assert stats.kstest(z.ravel(), "norm").pvalue > 0.01
    for axis in range(4):
        ahead, behind = np.take(z, range(1, z.shape[axis]), axis), np.take(z, range(z.shape[axis] - 1), axis)
        assert abs(np.mean(ahead * behind)) < 4 / np.sqrt(ahead.size)
