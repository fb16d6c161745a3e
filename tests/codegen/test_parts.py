"""Kernels cut into several functions compute, to the bit, what they compute in one."""

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.codegen.ir import kernel as cutting
from scvi_codegen.codegen.ir.kernel import Constant, Kernel, Load, Operation
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.common.cache import CACHE_VARIABLE

pytestmark = pytest.mark.usefixtures("as_users_compile")


@pytest.fixture
def cut_after(monkeypatch):
    """A function that sets how many operations a part has."""

    def largest(operations: int) -> None:
        cutting.parts.cache_clear()
        monkeypatch.setattr(cutting, "LARGEST_PART", operations)

    yield largest
    cutting.parts.cache_clear()


def kernel(temporaries, results):
    return Kernel(name="k", arguments=1, temporaries=tuple(temporaries), results=tuple(results), values=len(results))


def test_functions_have_similar_sizes_and_return_only_needed_values(cut_after):
    cut_after(10)
    u, w = Load("u", 0), [Load("w", k) for k in range(40)]
    sums = [Operation("+", (w[k - 1] if k else u, Constant(1.0))) for k in range(40)]
    cut = cutting.parts(kernel(sums, [w[-1]]))
    assert [sum(kind == "w" for kind, _, _ in part.statements) for part in cut] == [10, 10, 10, 10]
    assert [part.uses("u") for part in cut] == [True, False, False, False]
    assert cutting.kept_length(cut) == 2  # the one that is read, and the one that is written meanwhile


def test_short_kernel_is_not_split():
    whole = kernel([], [Operation("*", (Load("u", 0), Load("u", 0)))])
    (part,) = cutting.parts(whole)
    assert (part.name, part.statements) == ("k", tuple(whole.statements()))


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.covering
@pytest.mark.parametrize("solver", ["newton", "fixed-point"])
@pytest.mark.parametrize("name", ["double-pendulum", "charged-particle", "fput-chain"])
def test_split_kernels_give_bitwise_equal_trajectories(name, solver, cut_after, monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    chosen = sc.problem(name)
    found = []
    for operations, prefix in ((1000, "whole"), (7, "cut")):
        cut_after(operations)
        stepper = sc.compile_stepper(chosen.system, sc.SVI(3), solver=solver, flags=PORTABLE_FLAGS, prefix=prefix)
        p = stepper.momentum(chosen.q, chosen.velocity)
        many = stepper.integrate_ensemble([chosen.q] * 2, [p] * 2, h=0.1, steps=5) if solver == "fixed-point" else None
        found.append([stepper.integrate(chosen.q, p, h=0.1, steps=10), many, stepper.source])
    (whole, many, text), (cut, many_cut, cut_text) = found
    assert ("kept[" in text.code, "kept[" in cut_text.code) == (False, True)
    np.testing.assert_array_equal(whole.q, cut.q)
    np.testing.assert_array_equal(whole.p, cut.p)
    np.testing.assert_array_equal(whole.energy(), cut.energy())
    if many is not None:
        np.testing.assert_array_equal(many.q, many_cut.q)
