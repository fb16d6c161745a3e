"""The digits of the tables are each thread's own."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from scvi_codegen.tables.precision import DIGITS, mp


def third() -> tuple[int, object]:
    return mp.dps, mp.mpf(1) / 3


def test_a_thread_has_the_digits_of_the_tables_whatever_another_works_with():
    expected = third()
    assert expected[0] == DIGITS
    for digits in (16, 100):
        with mp.workdps(digits), ThreadPoolExecutor(1) as pool:
            assert pool.submit(third).result() == expected
            assert third()[0] == digits
            assert third()[1] != expected[1]
    assert third() == expected


def test_contexts_that_end_out_of_order_leave_the_digits_as_they_were():
    with ThreadPoolExecutor(1) as pool:
        first, second = mp.workdps(100), mp.workdps(80)
        first.__enter__()
        pool.submit(second.__enter__).result()
        first.__exit__(None, None, None)
        pool.submit(second.__exit__, None, None, None).result()
        assert mp.dps == pool.submit(lambda: mp.dps).result() == DIGITS
