"""Time and number of a failed step, in every kind of run: the force is undefined after t = stop."""

import numpy as np
import pytest

import scvi_codegen as sc

START, H, STOP = 1.25, 0.125, 2.05
"""The seventh step, from t = 2 to t = 2.125, contains the end of the domain."""
PARAMETERS = {"stop": 1e9, "k": 1.0, "sign": 1.0}
POTENTIAL = "k*{x}**2/2 + {x}*sqrt(sign*(stop - t))/8"
SCALAR = {"svi:3": "fixed-point", "svi:4": "newton", "gauss:2": "newton", "stoermer-verlet": "auto", "scvi:3": "newton"}
ARRAY = {"svi:3": "fixed-point", "svi:2": "newton", "gauss:2": "fixed-point", "stoermer-verlet": "fixed-point"}


def stepper(kind: str, method: str):
    given = {"name": f"{kind} that ends", "parameters": PARAMETERS}
    if kind == "scalar":
        text = f"x_dot**2/2 - {POTENTIAL.format(x='x')}"
        system = sc.LagrangianSystem.from_text(coordinates=["x"], lagrangian=text, **given)
        return sc.compile_stepper(system, method, solver=SCALAR[method])
    text = f"sum(i in N, q_dot[i]**2/2 - {POTENTIAL.format(x='q[i]')})"
    system = sc.LagrangianSystem.from_text(coordinates=["q[N]"], lagrangian=text, **given)
    return sc.compile_stepper(system, method, solver=ARRAY[method])


@pytest.mark.tiers(0, 4)
@pytest.mark.sampled(9)
@pytest.mark.parametrize("sign", [1, -1], ids=["forward", "backward"])
@pytest.mark.parametrize(
    ("kind", "method"), [*(("scalar", method) for method in SCALAR), *(("array", method) for method in ARRAY)]
)
def test_failed_step_reports_its_number_and_the_time_at_which_it_started(kind, method, sign):
    made = stepper(kind, method)
    given = {"t": START, "parameters": {"stop": START + sign * (STOP - START), "k": 1.3, "sign": sign}}
    q, p = np.array([0.4]), np.array([0.2])
    for steps_before in ((), (2, 3)):
        run = made.start(q, p, h=sign * H, **given)
        for steps in steps_before:
            run.advance(steps)
        with pytest.raises(sc.StepFailedError) as failed:
            run.advance(100)
        assert (failed.value.t, failed.value.step) == (START + sign * 6 * H, 6)
        assert (run.t, run.steps) == (START + sign * 6 * H, 6)
    with pytest.raises(sc.StepFailedError) as failed:
        made.integrate(q, p, h=sign * H, steps=100, save_every=4, **given)
    assert (failed.value.t, failed.value.step) == (START + sign * 6 * H, 6)


@pytest.mark.parametrize(("h", "status", "words"), [(H, "not finite", ""), (4.0, "not converged", "last update")])
@pytest.mark.parametrize("kind", ["scalar", "array"])
def test_message_reports_the_last_update_of_an_iteration_that_did_not_converge(kind, h, status, words):
    """Steps of 4 are too long for the fixed-point iteration of a unit oscillator."""
    stop = START + 0.5 * H if words == "" else 1e9
    run = stepper(kind, "svi:3").start([0.4], [0.2], h=h, t=START, parameters={"stop": stop, "k": 4.0})
    with pytest.raises(sc.StepFailedError) as failed:
        run.advance(1)
    assert failed.value.status == status
    assert ("last update" in str(failed.value)) == bool(words)
    assert f"last update {failed.value.residual:.3g}" in str(failed.value) or not words
