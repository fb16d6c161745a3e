"""Newton's iteration for array systems agrees with that of the unrolled system where fixed-point iterations fail."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

RANDOM = np.random.default_rng(1)


def molecules():
    """Stiff bonds between soft ones, in the plane, by a table."""
    text = (
        "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2) - sum(b in B, k[b]/2"
        "*(sqrt(sum(a in 2, (r[bonds[b, 0], a] - r[bonds[b, 1], a])**2)) - length[b])**2)"
    )
    return lagrange("molecules", ["r[N, 2]"], text, parameters={"k[B]": 1, "length[B]": 1}, tables=["bonds[B, 2]"])


@pytest.mark.rotated
def test_stiff_bonds_at_rest_do_not_limit_the_step_size():
    count, stiff = 40, 1e6
    chain = np.array([(i, i + 1) for i in range(count - 1)])
    k = np.where(np.arange(count - 1) % 2 == 0, stiff, 1.0)
    start = np.stack([np.arange(count), np.zeros(count)], axis=1)
    velocity = np.stack([np.zeros(count), np.repeat(np.sin(np.arange(count // 2) / 3.0), 2) / 10], axis=1)
    data = {"tables": {"bonds": chain}, "parameters": {"k": k}}
    newton = sc.compile_stepper(molecules(), "svi:4", solver="newton")
    iterations = sc.compile_stepper(molecules(), "svi:4")
    with pytest.raises(sc.StepFailedError, match="solver='newton'"):
        iterations.integrate(start, velocity=velocity, h=0.05, steps=1, **data)
    run = newton.integrate(start, velocity=velocity, h=0.05, steps=20, **data)
    exact = iterations.integrate(start, velocity=velocity, h=0.001, steps=1000, save_every=1000, **data)
    assert np.abs(run.q["r"][-1] - exact.q["r"][-1]).max() < 1e-6
    assert run.energy_error() < 1e-9
    assert run.iterations.sum() < 6 * run.steps
    assert np.abs(np.ptp(run.momentum_maps(), axis=0)).max() < 1e-9


@pytest.mark.rotated
def test_step_without_convergence_fails():
    system = lagrange(
        "long waves", "q[N]", "sum(i in N, q_dot[i]**2/2) - 1e12*sum(i in N periodic, (q[i+1] - q[i])**2/2 - cos(q[i]))"
    )
    stepper, q = sc.compile_stepper(system, "svi:4", solver="newton"), RANDOM.normal(size=800)
    run = stepper.start(q, h=1.0)
    with pytest.raises(sc.StepFailedError, match="GMRES"):
        run.advance(1)
    assert (run.q["q"] == q).all()
