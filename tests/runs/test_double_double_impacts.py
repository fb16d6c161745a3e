"""Events that change the state of double-double runs, against flights and impacts computed here in 50 digits."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpmath import mp
from notation import hamilton, lagrange

import scvi_codegen as sc
from scvi_codegen.common.errors import EventError, EventWarning, MethodError
from scvi_codegen.runs.states.words import as_mpmath

BALL = lagrange("ball", "x y", "(x_dot**2 + y_dot**2)/2 - y", e=0.8, b=8.0)
FLOOR = sc.impact("y + x**2/b - sin(2*t)/20", restitution="e")
KICK = sc.Event("t - 1/3", then={"y_dot": "y_dot + 1/7", "x": "x - 1/9"})
PARAMETERS = {"e": "0.8", "b": 8}
START = {"q": ["-1", "1.1"], "p": ["0.3", "0"], "parameters": PARAMETERS}


def compiled(system: Any, method: str = "svi:4", **more: Any) -> sc.Stepper:
    return sc.compile_stepper(system, method, precision="double-double", **more)


def largest(values: Any) -> float:
    return float(max(map(abs, values)))


def end_of_ball(times: list, end: Any, kick: Any) -> tuple[list, list]:
    """Return the times of impacts near ``times`` and the kick, and the state at the end, by parabolas between them."""
    t, x, y, v, w = mp.mpf(0), mp.mpf(-1), mp.mpf("1.1"), mp.mpf("0.3"), mp.mpf(0)
    e, found = mp.mpf("0.8"), []

    def moved(s: Any) -> tuple:
        d = s - t
        return x + v * d, y + w * d - d * d / 2, v, w - d

    def height(s: Any) -> Any:
        at = moved(s)
        return at[1] + at[0] ** 2 / 8 - mp.sin(2 * s) / 20

    for near in sorted([*times, *([kick] if kick else [])]):
        at = kick if near is kick else mp.findroot(height, (near, near + mp.mpf(10) ** -8))
        x, y, v, w = moved(at)
        t = at
        if near is kick:
            x, w = x - mp.mpf(1) / 9, w + mp.mpf(1) / 7
            continue
        found.append(at)
        nx, ny, rate = x / 4, mp.one, -mp.cos(2 * at) / 10
        impulse = -(1 + e) * (v * nx + w * ny + rate) / (nx * nx + ny * ny)
        v, w = v + impulse * nx, w + impulse * ny
    return found, list(moved(end))


@pytest.mark.rotated
@pytest.mark.parametrize("steps", [{"h": 0.125, "t_end": 4.1}, {"t_end": 4.1, "tolerance": 1e-28}])
def test_ball(steps: dict[str, float]) -> None:
    """Times of impacts on a curved, moving floor with restitution, and the states after them, have both words."""
    stepper = compiled(BALL)
    for events, kick in (([FLOOR], False), ([FLOOR, KICK], True)):
        run = stepper.integrate(**START, **steps, events=events)
        with mp.workdps(50):
            times = list(run.events[0].t.mp())
            exact, state = end_of_ball(times, mp.mpf(4.1), mp.mpf(1) / 3 if kick else None)
            assert len(times) >= 2
            assert largest(a - b for a, b in zip(times, exact, strict=True)) < 2e-30
            assert largest(a - b for a, b in zip([*run.mp("q")[-1], *run.mp("p")[-1]], state, strict=True)) < 1e-29
            if kick:
                assert abs(run.events[1].t[0].mp() - mp.mpf(1) / 3) < 1e-32
            rows = np.isin(np.asarray(run.t), np.asarray(run.events[0].t))
            assert rows.sum() == len(times)  # states after impacts are saved
            before, after = run.events[0].p.mp(), run.mp("p")[rows]
            assert (after[:, 1] > before[:, 1]).all()
            inside = as_mpmath(run.at([4.0])[0][0])
            assert largest(inside - end_of_ball(times, mp.mpf(4), mp.mpf(1) / 3 if kick else None)[1][:2]) < 1e-29


@pytest.mark.rotated
def test_edge() -> None:
    """Inelastic impacts on two walls alternate, to 31 digits, and leave the velocity along their edge, (1, 1, 1).

    A pass leaves 1/(1 + 3 a^2) of the rate of approach, 0.1 or 0.2. The second is too slow for 31 digits, not for 16.
    """
    point = lagrange("point", "x y z", "(x_dot**2 + y_dot**2 + z_dot**2)/2 + 2*x - 2*z", a=1.0)
    walls = [sc.impact("x - y", restitution=0), sc.impact("a*(x + y - 2*z) - x + y", restitution=0)]
    stepper = compiled(point, "svi:2", events=walls)
    with mp.workdps(50):
        met, force, w = mp.mpf(1) / 3, np.array([2, 0, -2]), np.array([mp.mpf(4) / 10, mp.mpf(9) / 10, mp.one])
        start = {"q": force * met**2 / 2 - w * met, "p": w - force * met, "h": 0.25, "t_end": 1.0}
        run = stepper.integrate(**start, parameters={"a": "1.7"})
        assert list(map(len, run.events)) == [1, 1]
        assert largest(run.mp("p")[-1] - (sum(w) / 3 + force * (1 - met))) < 1e-29
    with pytest.raises(EventError, match=r"by 'x - y' do not end in the step from t = 0.25: a point is jammed"):
        stepper.integrate(**start, parameters={"a": "1.17"})
    assert (
        sc.compile_stepper(point, "svi:2", events=walls)
        .integrate(*(np.array(start[name], float) for name in "qp"), h=0.25, t_end=1.0, parameters={"a": 1.17})
        .events[1]
    )


@pytest.mark.second
@pytest.mark.parametrize("steps", [{"h": 0.125}, {"t_end": 4.0}])
def test_recordings(steps: dict[str, float], tmp_path: Path) -> None:
    """Recorded, resumed and pickled runs have the crossings of runs in memory, in both words."""
    stepper = compiled(BALL, events=[FLOOR, KICK, sc.Event("x_dot - y_dot")])
    count: dict[str, Any] = {"steps": 32} if "h" in steps else {}
    expected = pickle.loads(pickle.dumps(stepper)).integrate(**START, **steps, **count)
    run = stepper.start(**START, **steps)
    part = sc.record_run(run, tmp_path / "a.run", **count, rows=6, checkpoint_steps=4, stop=lambda: run.steps >= 12)
    assert part.finished == ("t_end" in steps)  # by one step between impacts
    recorded = sc.resume_run(tmp_path / "a.run")
    assert (recorded[-1:].mp("q")[0] == expected.mp("q")[-1]).all()
    for found, each in zip(recorded.events, expected.events, strict=True):
        assert len(found) == len(each) > 0
        for name in ("t", "q", "p"):
            assert (as_mpmath(getattr(found, name)) == as_mpmath(getattr(each, name))).all(), name


@pytest.mark.rotated
def test_energies_of_impacts() -> None:
    """Impacts conserve energies that are not quadratic in p, also with constraints, to 31 digits."""
    fast = hamilton("fast", "x y", "sqrt(1 + a**2 + 2*b**2) + y", momenta="a b")
    run = compiled(fast, "svi:6").integrate(
        ["0", "1"], ["0.7", "0.2"], h=0.125, steps=60, events=sc.impact("y + x/3 + 1/10")
    )
    assert len(run.events[0]) > 1
    after = np.isin(np.asarray(run.t), np.asarray(run.events[0].t))
    with mp.workdps(50):
        for q, p, new in zip(run.events[0].q.mp(), run.events[0].p.mp(), run.mp("p")[after], strict=True):
            energies = [mp.sqrt(1 + a * a + 2 * b * b) + q[1] for a, b in (p, new)]
            assert abs(energies[0] - energies[1]) < 1e-30
            change = new - p
            assert abs(change[0] - change[1] / 3) < 1e-31  # along the normal
            assert abs(change[1]) > 0.01


@pytest.mark.rotated
def test_errors() -> None:
    """Accumulating impacts end the run with a warning, a start behind a wall and transformed time are errors."""
    dead = sc.LagrangianSystem.from_text(name="dead", coordinates=["y"], lagrangian="y_dot**2/2 - y")
    stepper = compiled(dead, "svi:2", events=sc.impact("y", restitution="0.5"))
    with pytest.warns(EventWarning, match="accumulate"):
        run = stepper.integrate(["1"], ["0"], h=0.25, t_end=6.0)
    with mp.workdps(50):
        end = 3 * mp.sqrt(2)  # sqrt(2) (1 + 2 (1/2 + 1/4 + ..))
        assert 0 < end - run.mp("t")[-1] < 1e-6
        times = run.events[0].t.mp()
        fall = mp.sqrt(2)
        assert abs(times[5] - fall * (1 + 2 * (1 - mp.mpf(2) ** -5))) < 1e-30
    with pytest.raises(EventError, match="starts behind the wall"):
        stepper.integrate(["-1"], ["0"], h=0.25, steps=3)
    orbit = sc.reparametrise(
        sc.LagrangianSystem.from_text(name="o", coordinates=["x"], lagrangian="x_dot**2/2 - x**2/2"), "1/(1 + x**2)"
    )
    with pytest.raises(EventError, match="impossible in transformed time"):
        compiled(orbit).integrate(["0.5"], ["0"], h=0.1, steps=3, events=sc.impact("x"))
    loaded = sc.Stepper(stepper.source, stepper.interface)
    with pytest.raises(MethodError, match="require the integrator in double"):
        loaded.integrate(["1"], ["0"], h=0.25, steps=3, events=sc.impact("y"))
