"""Runs of array systems: slices, events, inputs, and errors of adaptive steps."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

N = 6
RANDOM = np.random.default_rng(1)
Q, V = RANDOM.normal(size=N), RANDOM.normal(size=N)


def written(system):
    return sc.compile_stepper(sc.unroll_sums(system, {"N": N}), "svi:6")


@pytest.fixture(scope="module")
def ring():
    text = "sum(i in N, q_dot[i]**2/2)- sum(i in N periodic, (q[i+1] - q[i])**2/2 + beta*(q[i+1] - q[i])**4/4)"
    return lagrange("FPUT ring", "q[N]", text, beta=0.25)


@pytest.fixture(scope="module")
def steppers(ring):
    return sc.compile_stepper(ring, "svi:6"), written(ring)


@pytest.mark.rotated
def test_slices_have_the_states_of_the_run(steppers):
    run = steppers[0].integrate(Q, velocity=V, h=0.1, steps=30, events="q[1] - q[2]")
    for rows in (slice(2, None), slice(1, -1, 3), slice(3, 4)):
        part = run[rows]
        assert len(part) == len(run.t[rows])
        for name in ("t", "energies"):
            assert np.array_equal(getattr(part, name), getattr(run, name)[rows], equal_nan=True)
        assert np.array_equal(part.q["q"], run.q["q"][rows])
        assert np.array_equal(part.p["q"], run.p["q"][rows])
        between = (part.t[0] + part.t[-1]) / 2
        assert np.abs(part.at([between])[0]["q"] - run.at([between])[0]["q"]).max() < 1e-14
        inside = (run.events[0].t >= part.t[0]) & (run.events[0].t <= part.t[-1])
        assert np.array_equal(part.events[0].q["q"], run.events[0].q["q"][inside])
    t, q, p = run[-1]
    assert (t, *q["q"], *p["q"]) == (run.t[-1], *run.q["q"][-1], *run.p["q"][-1])
    for rows in (len(run), slice(4, 4), slice(None, None, -1)):
        with pytest.raises(IndexError, match=r"out of range|must be ascending"):
            run[rows]
    observed = steppers[0].integrate(Q, velocity=V, h=0.1, steps=3, observe=lambda state: state.q["q"][0])
    with pytest.raises(sc.StateError, match="omit observe"):
        observed[0]


class TestEvents:
    @pytest.mark.rotated
    def test_invalid_events_are_rejected(self, steppers):
        stepper, _ = steppers
        for function, message in (
            ("x[0]", "not an array"),
            ("q[N]", "q\\[N\\] is behind the last|N is"),
            ("q[9]", "runs from 9 to 9"),
            ("1/(q[0] - q[0])", "not finite|division|infinit"),
        ):
            with pytest.raises(sc.EventError, match=message):
                stepper.integrate(Q, h=0.1, steps=1, events=function)


@pytest.mark.rotated
def test_error_estimate_survives_a_zero_of_one_coefficient() -> None:
    """One quartic oscillator, whose highest coefficient vanishes now and then: no step changes the energy by more."""
    system = lagrange("quartic", "x[N]", "sum(i in N, x_dot[i]**2/2 - x[i]**4/4)")
    stepper, worst = sc.compile_stepper(system, "svi:4"), 0.0
    for phase in np.linspace(0.0, 6.0, 12):
        run = stepper.integrate([np.cos(phase)], velocity=[np.sin(phase)], t_end=30.0, tolerance=1e-4)
        worst = max(worst, np.abs(np.diff(run.energy())).max() / run.energy()[0])
    assert worst < 3e-5  # 2e-4 where it is


@pytest.mark.rotated
def test_advice_solutions_and_recorded_runs_are_those_of_known_sizes(ring, steppers, tmp_path) -> None:
    """What compiles the sizes of a call gives the results of the unrolled system."""
    known = sc.unroll_sums(ring, {"N": N})
    found, expected = (sc.advise(system, "svi:4", Q, V, 1.0, 1e-5) for system in (ring, known))
    assert (found.h, found.steps) == (expected.h, expected.steps)
    y0 = np.concatenate([Q, V])
    one, other = (sc.solve_ivp(system, (0.0, 1.0), y0, method="svi:4") for system in (ring, known))
    assert one.y[:, -1] == pytest.approx(other.y[:, -1], abs=1e-13)
    named = sc.solve_ivp(steppers[0], (0.0, 1.0), {"q": Q}, velocity={"q": V})
    _, q, p = steppers[1].integrate(Q, V, t_end=1.0)[-1]
    assert named.y[:, -1] == pytest.approx(np.concatenate([q, p]), abs=1e-13)
    rest = [steppers[0].start(Q, *none, h=0.1, parameters={"beta": 0.3}) for none in ((), (None,))]
    assert all((run.p == 0.0).all() for run in rest)
    with pytest.raises(sc.StateError, match="give velocity"):
        sc.solve_ivp(ring, (0.0, 1.0), {"q": Q})
    for k, plan in enumerate(({"h": 0.1}, {"t_end": 1.0, "tolerance": 1e-8})):
        run = steppers[0].start(Q, velocity=V, t=0.5, parameters={"beta": 0.3}, **plan)
        steps = {"steps": 10} if k == 0 else {}
        recorded = sc.record_run(run, tmp_path / str(k), **steps)
        direct = sc.compile_stepper(ring, "svi:6", sizes={"N": N}).start(Q, V, t=0.5, parameters={"beta": 0.3}, **plan)
        assert np.array_equal(recorded.q, direct.record(**steps).q)
        assert run.steps == 0
