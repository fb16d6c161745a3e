"""Numbers that carry a unit are not taken without it."""

from types import SimpleNamespace

import numpy as np
import pytest

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.common.errors import StateError


class WithUnit(np.ndarray):
    """An array as astropy makes it."""

    unit: object = None


class OfPint(SimpleNamespace):
    """A number as pint makes it."""

    units = "second"


class Labelled(np.ndarray):
    """An array whose attributes are what users call its rows."""

    def __getattr__(self, name: str) -> str:
        if name not in ("unit", "units"):
            raise AttributeError(name)
        return "a row"


def with_unit(unit: object) -> WithUnit:
    array = np.array([1.0, 2.0]).view(WithUnit)
    array.unit = unit
    return array


def test_arrays_with_a_unit_are_rejected():
    with pytest.raises(StateError, match="q has the unit km: give plain numbers"):
        real_array(with_unit("km"), "q")
    with pytest.raises(StateError, match="h has the unit second"):
        checked_number(OfPint(), "h")


def test_labels_are_not_units():
    assert real_array(np.array([1.0]).view(Labelled), "q").tolist() == [1.0]


@pytest.mark.parametrize("unit", ["", "dimensionless", None])
def test_dimensionless_arrays_are_numbers(unit):
    assert real_array(with_unit(unit), "q").tolist() == [1.0, 2.0]


def test_quantities_of_astropy_are_rejected():
    units = pytest.importorskip("astropy.units")
    with pytest.raises(StateError, match="velocity has the unit km / s"):
        real_array([1.0, 2.0] * units.km / units.s, "velocity")
    assert real_array([1.0, 2.0] * units.one, "q").tolist() == [1.0, 2.0]
