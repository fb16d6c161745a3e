"""The digits in which tables are computed: those of each thread, and of nobody else."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import mpmath

from scvi_codegen.common.precision import DIGITS, mp

ROOT = "1.41421356237309504880168872420969807856967187537694807317668"


def test_precision_is_local_to_a_thread():
    """Both are inside of their precision at once; afterwards each has 60 digits again."""
    both = Barrier(2)

    def root(digits: int) -> tuple[str, int]:
        with mp.workdps(digits):
            both.wait(10)
            found = mp.nstr(mp.sqrt(2), digits)
            both.wait(10)
        return found, mp.dps

    with ThreadPoolExecutor(2) as pool:
        coarse, fine = pool.map(root, (15, DIGITS))
    assert coarse == ("1.4142135623731", DIGITS)
    assert fine == (ROOT, DIGITS)
    assert mp.dps == DIGITS


def test_user_precision_is_restored():
    with mpmath.workdps(5):
        assert mp.nstr(mp.sqrt(2), DIGITS) == ROOT
    with mp.workdps(5):
        assert mpmath.mp.dps == 15


def test_constants_have_their_digits_for_all_threads():
    with ThreadPoolExecutor(8) as pool:
        found = set(pool.map(lambda _: mp.nstr(+mp.pi, DIGITS), range(64)))
    assert found == {"3.14159265358979323846264338327950288419716939937510582097494"}
