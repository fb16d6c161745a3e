"""Runs across kinks against DOP853 restarted at each of them: eight families of random cases.

Default and given tolerances, output times and dense output, orders of fixed steps, and ``error=``
(``tools/kinks.py``, which prints a table of all); bits of restored runs and of ensembles; derivatives.
"""

import numpy as np
import pytest
from kinks import KINDS, METHODS, stepper_of, wrong
from nonsmooth import FAMILIES, case_of

pytestmark = pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")


@pytest.mark.parametrize("family", FAMILIES)
def test_motions_across_kinks_are_within_tolerances(family):
    assert not wrong(family, [1], ["svi:4"])


@pytest.mark.second
@pytest.mark.parametrize("family", FAMILIES)
def test_methods_of_other_orders_are_within_tolerances(family):
    assert not wrong(family, [2, 3], ["svi:2", "svi:8"])


@pytest.mark.full
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("family", FAMILIES)
def test_two_thousand_cases_across_kinks(family, method):
    first = 84 * [*METHODS].index(method)
    assert not wrong(family, range(first, first + 84), [method])
