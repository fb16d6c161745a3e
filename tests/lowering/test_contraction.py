"""Sweeps that contract slowly end at round-off, as fast ones do: held against the same equations in 60 digits."""

from __future__ import annotations

from contextlib import nullcontext, suppress

import numpy as np
import pytest
from samples import QUICK_FLAGS

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StepFailedError
from scvi_codegen.exact.step import derived_step
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods import SCVI, SVI, SpectralCollocation
from scvi_codegen.models.problems import problem

ROUNDING = 5e-16
Q, P, STEPS = [1.2], [0.7], 5


def scaling():
    """H = x p_x: an implicit Euler step contracts by h a sweep, in x and in p_x."""
    return HamiltonianSystem.from_text(name="scaling", coordinates=["x"], hamiltonian="x*p_x")


@pytest.mark.parametrize("h", [0.26, 0.3, 0.45, 0.6])
def test_a_slow_sweep_ends_where_newtons_iteration_does(h):
    method = SpectralCollocation(1, form="phase-space")
    exact = Q[0] / (1 - h), P[0] / (1 + h)
    found = compile_stepper(scaling(), method, flags=QUICK_FLAGS).step(Q, P, h)
    assert np.concatenate(found) == pytest.approx(exact, rel=ROUNDING)


@pytest.mark.parametrize("method", [SVI(1), SCVI(2), SVI(3, "clenshaw-curtis:4")], ids=lambda method: method.name)
def test_long_steps_of_an_oscillator_alone_and_in_an_ensemble(method):
    system = problem("harmonic-oscillator").system
    stepper, derived = compile_stepper(system, method, flags=QUICK_FLAGS), derived_step(system, method)
    for h in (0.9, 1.2, 1.5):
        q, p = np.array(Q), np.array(P)
        for _ in range(STEPS):
            exact = derived(q, p, h, 0.0)
            q, p = exact.q, exact.p
        run = stepper.integrate(Q, P, h=h, steps=STEPS)
        many = stepper.integrate_ensemble([Q] * 8, [P] * 8, h=h, steps=STEPS)
        for found in (run.q[-1, 0], many.q[-1, 0, 0]):
            assert abs(found - float(q[0])) < 2 * STEPS * ROUNDING


def test_slow_sweeps_are_not_taken_for_rounding():
    """Near its limit the iteration of a coupled system stops shrinking for a while, at 1e-9 of the state, and fails."""
    heavy = LagrangianSystem.from_text(
        name="heavy", coordinates=["x"], lagrangian="x_dot**2*(1 + x**2/100)/2 - x**2/2", parameters={}
    )
    method = SVI(8)
    sweeps, newton = (
        compile_stepper(heavy, method, solver=solver, flags=QUICK_FLAGS) for solver in ("fixed-point", "newton")
    )
    for h in (1.0, 2.0, 3.0, 3.98, 4.0, 4.02, 4.1, 4.18, 4.6, 4.64):
        with nullcontext() if h < 3.5 else suppress(StepFailedError):
            found = np.concatenate(sweeps.step([1.0], [0.3], h))
            assert found == pytest.approx(np.concatenate(newton.step([1.0], [0.3], h)), abs=1e-12)
