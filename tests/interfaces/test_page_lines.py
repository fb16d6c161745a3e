"""Code of docs/frameworks.md prints known results; without a library, flows name the missing extra."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS
from scipy.special import ellipk

from scvi_codegen import SVI, MissingLibraryError, casadi_flow, compile_stepper, jax_flow, problem, torch_flow

PAGE = (Path(__file__).parents[2] / "docs" / "frameworks.md").read_text(encoding="utf-8")
LIBRARIES = {"jax": jax_flow, "casadi": casadi_flow, "torch": torch_flow}


def printed(library, capfd):
    """The numbers that the block prints last."""
    [block] = re.findall(rf"^```python\n(import {library}\n.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    exec(compile(block, "frameworks.md", "exec"), {"__name__": "page"})
    last = capfd.readouterr().out.splitlines()[-1]
    return [float(number) for number in re.findall(r"-?\d+\.\d+", last)]


@pytest.mark.parametrize("library", LIBRARIES)
def test_missing_library_is_named_with_its_extra(library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    stepper = compile_stepper(problem("planar-pendulum").system, SVI(1), flags=QUICK_FLAGS)
    with pytest.raises(MissingLibraryError, match=rf"{library}, which .* pip install 'scvi-codegen\[{library}\]'"):
        LIBRARIES[library](stepper, steps=3)


def test_code_for_jax_runs(capfd):
    jax = pytest.importorskip("jax", reason="needs the extra 'jax'")
    before = jax.config.jax_enable_x64
    try:
        found = printed("jax", capfd)
    finally:
        jax.config.update("jax_enable_x64", before)
    stepper = compile_stepper(problem("kepler").system, "svi:8", flags=QUICK_FLAGS)

    def end(mu):
        return stepper.integrate([0.5, 0.0], [0.0, 3**0.5], h=0.1, steps=63, parameters={"mu": mu})

    by_mu = (end(1.0 + 1e-5).q[-1, 0] - end(1.0 - 1e-5).q[-1, 0]) / 2e-5
    assert_allclose(found, [by_mu, 63 * end(1.0).velocity[-1, 0]], rtol=1e-5)


def test_code_for_torch_runs(capfd):
    pytest.importorskip("torch", reason="needs the extra 'torch'")
    stepper = compile_stepper(problem("kepler").system, "svi:8", flags=QUICK_FLAGS)
    run = stepper.integrate([0.5, 0.0], [0.0, 3**0.5], h=0.1, steps=63)
    partials = np.zeros((64, 4))
    partials[-1, 0] = 1.0
    assert_allclose(printed("torch", capfd), run.pullback(partials).parameters, rtol=1e-3)


def test_code_for_casadi_runs(capfd):
    pytest.importorskip("casadi", reason="needs the extra 'casadi'")
    assert_allclose(printed("casadi", capfd), [2 * np.sin(1.0), ellipk(np.sin(1.0) ** 2) / 12], rtol=1e-5)
