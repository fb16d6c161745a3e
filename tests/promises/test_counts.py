"""Whole numbers from users: one checker, one wording, whatever is counted."""

import numpy as np
import pytest
import sympy

from scvi_codegen import MethodError, StateError, methods
from scvi_codegen.common.validation import LARGEST_COUNT, checked_count


@pytest.mark.parametrize("value", [True, np.True_, 3.0, "3", None, [3]])
def test_non_integers_are_rejected(value):
    with pytest.raises(StateError, match="n must be a whole number, not"):
        checked_count(value, "n", least=0)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (1, "n must be at least 2, not 1"),
        (6, "n must be at most 5, not 6"),
        (LARGEST_COUNT + 1, "n must be at most 5, not 9007199254740992"),
    ],
)
def test_out_of_range_values_are_named_with_the_bound(value, message):
    with pytest.raises(MethodError, match=message):
        checked_count(value, "n", least=2, most=5, error=MethodError)


COUNTED = (
    *("SVI", "SCVI", "SpectralCollocation", "Gauss", "RadauIA", "RadauIIA", "LobattoIIIA", "ChebyshevGauss"),
    *("ChebyshevLobatto", "Composition"),
)


@pytest.mark.parametrize("value", [True, 2.0, "2", None, 0, -1, 1000])
@pytest.mark.parametrize("name", COUNTED)
def test_numbers_of_stages_degrees_and_orders_are_checked_by_every_method(name, value):
    method = getattr(methods, name)
    with pytest.raises(MethodError, match=r"must be|there (is|are) no"):
        method(value)
    for number in (np.int64(2), sympy.Integer(2)):
        assert method(number) == method(2)
        assert repr(method(number)) == repr(method(2))
