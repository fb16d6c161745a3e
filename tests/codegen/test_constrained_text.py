"""The C text of constrained systems: the same in 60 digits, alone with its own main."""

import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import linkage

import scvi_codegen as sc
from scvi_codegen.extras.exact.step import compiled_equations, derived_step
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model

pytestmark = pytest.mark.rotated

LINKAGE = linkage()
NEAR = [0.0, 1.0, 1.94, 1.5]


def lobatto(s):
    return sc.SVI(s, f"gauss-lobatto:{s + 1}")


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("s", [1, 2, 3])
def test_steps_are_those_of_the_equations_in_60_digits(s):
    stepper = sc.compile_stepper(LINKAGE, lobatto(s))
    q, p = stepper.project(NEAR)
    q, p = stepper.integrate(q, p, h=0.02, steps=7).q[-1], stepper.integrate(q, p, h=0.02, steps=7).p[-1]
    found = stepper.step(q, p, 0.05, 0.3)
    for equations in (derived_step(LINKAGE, lobatto(s)), compiled_equations(LINKAGE, lobatto(s))):
        exact = equations(q, p, 0.05, 0.3)
        assert_allclose(found[0], np.array(exact.q, dtype=float), rtol=0, atol=4e-16)
        assert_allclose(found[1], np.array(exact.p, dtype=float), rtol=0, atol=4e-15)


def test_model_files_select_compatible_points():
    stepper = sc.compile_stepper(LINKAGE, "svi:3")
    q, _ = stepper.project(NEAR)
    model = sc.Model(system=LINKAGE, method="svi:3", q=tuple(q), velocity=(0.0,) * 4, h=0.01, span=1.0)
    assert model.method == lobatto(3)
    assert parse_model(dump_model(model)) == model
    text = dump_model(model).partition("[method]")[0]
    assert parse_model(f"{text}\n[run]\nspan = 1.0\n").method == lobatto(6)


def made_and_run(folder, q, *, precision=None, system=LINKAGE, exit_status=0):
    """Generate a folder, build it with ``make``, run it and return the example's states and output."""
    model = sc.Model(system=system, method="svi:3", q=tuple(q), velocity=(0.0,) * 4, h=0.05, steps=40)
    sc.generate_package(model, folder, embedded=precision)
    found = subprocess.run(["make", "-s", "-C", str(folder)], capture_output=True, text=True)
    assert (found.returncode != 0) == exit_status
    return np.array([line.split() for line in found.stdout.splitlines() if line[0] != "#"], dtype=float), found


def test_states_that_cannot_be_projected_are_rejected_in_c(tmp_path):
    """States far off the constraints and stretched linkages with dependent constraints are rejected."""
    states, found = made_and_run(tmp_path / "far", [0.3, 1.0, 1.94, 1.5], exit_status=1)
    assert "violates the constraints" in found.stderr
    stretched = LINKAGE.with_parameters(d=4.5)
    other, also = made_and_run(tmp_path / "stretched", [1.0, 0.0, 3.0, 0.0], system=stretched, exit_status=1)
    assert "the projection of the initial state onto the constraints failed (status 2)" in also.stderr
    assert not len(states)
    assert not len(other)
