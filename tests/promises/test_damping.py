"""Uniform damping by L exp(c t) (Caldirola, Kanai): phase area shrinks by exp(-c h) in every step, to rounding."""

import numpy as np
import pytest

from scvi_codegen import SVI, Gauss, LagrangianSystem, compile_stepper

METHODS = [SVI(1), SVI(3), Gauss(2)]


def stepped(stepper, q, v, h, t):
    """(q, v) after a step: momenta are those of L exp(c t)."""
    q1, p1 = stepper.step(q, stepper.momentum(q, v, t), h, t)
    return np.concatenate([q1, stepper.velocity(q1, p1, t + h)])


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_linear_steps_contract_area_exactly(method):
    system = LagrangianSystem.from_text(
        name="damped oscillator",
        coordinates=["q"],
        lagrangian="exp(c*t)*(q_dot**2 - k*q**2)/2",
        parameters={"c": 0.3, "k": 2.0},
    )
    stepper = compile_stepper(system, method)
    for t in (0.0, 40.0):
        columns = [stepped(stepper, [q], [v], 0.2, t) for q, v in ((1.0, 0.0), (0.0, 1.0))]
        assert np.linalg.det(columns) == pytest.approx(np.exp(-0.3 * 0.2), rel=4e-14)


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_it_is_the_motion_with_that_friction(method):
    """Two discretisations of one motion: by L exp(c t), and by the force -c v beside L."""
    free = "q_dot**2/2 + cos(q)"
    scaled = LagrangianSystem.from_text(
        name="scaled", coordinates=["q"], lagrangian=f"exp(c*t)*({free})", parameters={"c": 0.3}
    )
    forced = LagrangianSystem.from_text(
        name="forced", coordinates=["q"], lagrangian=free, parameters={"c": 0.3}, forces={"q": "-c*q_dot"}
    )
    apart = []
    for h in (0.1, 0.05):
        ends = []
        for system in (scaled, forced):
            run = compile_stepper(system, method).integrate([2.0], velocity=[0.5], h=h, steps=round(3 / h))
            ends.append(np.concatenate([run.q[-1], run.velocity[-1]]))
        apart.append(np.abs(ends[0] - ends[1]).max())
    assert apart[1] < 1e-12 or np.log2(apart[0] / apart[1]) > method.order - 0.4
