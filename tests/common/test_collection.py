"""The search for cyclic garbage is off during a derivation alone, also after errors and within another."""

import gc

import pytest

from scvi_codegen.common.collection import without_collection


def test_collection_is_off_during_derivations_alone():
    inner = without_collection(gc.isenabled)
    assert without_collection(lambda: (inner(), gc.isenabled()))() == (False, False)
    assert gc.isenabled()
    with pytest.raises(ZeroDivisionError):
        without_collection(lambda: 1 / 0)()
    assert gc.isenabled()
