"""Ensembles with inputs: each trajectory is that of ``integrate``, with values of its own or common ones."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import pushed_pendulum
from scipy.interpolate import CubicSpline

from scvi_codegen import (
    SCVI,
    SVI,
    Gauss,
    LagrangianSystem,
    StateError,
    StepFailedError,
    StoermerVerlet,
    compile_stepper,
)

KNOTS = np.array([0.0, 0.37, 0.9, 1.41, 2.05, 2.6])
VALUES = np.array([0.0, 1.2, -0.7, 0.4, 1.9, -1.0])
COUNT = 11
"""More than a block of lanes, and no multiple of one."""


@pytest.fixture(scope="module")
def pendulum():
    return pushed_pendulum()


@pytest.fixture(scope="module")
def coupled():
    """Return a system with position-dependent masses, whose iterations start with velocities."""
    return LagrangianSystem.from_text(
        name="coupled",
        coordinates=["x", "y"],
        lagrangian="(1 + x**2/4)*x_dot**2/2 + x_dot*y_dot/3 + (1 + w/5)*y_dot**2 - x**4/4 - (x - y)**2/2",
        parameters={"c": 0.2},
        forces={"x": "u - c*x_dot"},
        inputs=["u", "w"],
    )


def own_values(seed=1):
    """(COUNT, 6) of u, and (COUNT,) of c."""
    generator = np.random.default_rng(seed)
    return VALUES * generator.uniform(0.5, 1.5, (COUNT, 1)), generator.uniform(0.1, 0.3, COUNT)


@pytest.mark.parametrize("length", [{"h": 0.1, "steps": 7}, {"t_end": 0.7}], ids=["fixed", "adaptive"])
def test_constants_are_parameters(pendulum, length):
    stepper, constants = compile_stepper(pendulum, SVI(2)), np.array([0.3, -1.2, 0.3])
    start, others = (np.full((3, 1), 0.2), np.full((3, 1), 0.1)), {"c": 0.1, "w_0": 0.5}
    runs = stepper.integrate_ensemble(*start, inputs={"u": constants, "w": 0.5}, parameters={"c": 0.1}, **length)
    for j, constant in enumerate(constants):
        one = stepper.integrate(start[0][j], start[1][j], parameters=others | {"u_0": constant}, **length)
        driven = stepper.integrate(
            start[0][j], start[1][j], inputs={"u": constant, "w": 0.5}, parameters={"c": 0.1}, **length
        )
        assert (driven.q == one.q).all()
        assert_allclose(runs.ends[1][j], one.q[-1], rtol=0, atol=1e-14)
    with pytest.raises(StateError, match=r"the input 'u' must be a number, \(t, values\)"):
        stepper.integrate_ensemble(*start, inputs={"u": constants[:2], "w": 0.5}, **length)


def of_one(inputs, j):
    """The inputs of a trajectory."""
    return {
        name: (t, values[j] if np.ndim(values) == 2 else values, *kind) for name, (t, values, *kind) in inputs.items()
    }


def check_against_integrate(stepper, start, inputs, tolerance, **given):
    """Times equal those of single runs, states to round-off."""
    _, c = own_values()
    runs = stepper.integrate_ensemble(*start, inputs=inputs, parameters={"c": c}, **given)
    assert runs.ok.all()
    for j in range(COUNT):
        run = stepper.integrate(start[0][j], start[1][j], inputs=of_one(inputs, j), parameters={"c": c[j]}, **given)
        assert (runs.t == run.t).all()
        assert runs.steps[j] == run.steps
        assert_allclose(runs.q[:, j], run.q, rtol=0, atol=tolerance)
        assert_allclose(runs.p[:, j], run.p, rtol=0, atol=tolerance)
        assert_allclose(runs.energy()[:, j], run.energy(), rtol=0, atol=4 * tolerance)
    return runs


def starts(m):
    return np.random.default_rng(2).uniform(-1, 1, (2, COUNT, m))


@pytest.mark.sampled(3)
@pytest.mark.filterwarnings("ignore::scvi_codegen.errors.AccuracyWarning")
@pytest.mark.parametrize("kind", ["constant", "linear", "cubic"])
@pytest.mark.parametrize("method", [SVI(3), StoermerVerlet(), Gauss(2)], ids=lambda method: method.name)
def test_each_trajectory_equals_integrate(pendulum, method, kind):
    stepper = compile_stepper(pendulum, method)
    assert stepper.ensemble is not None
    inputs = {"u": (KNOTS, own_values()[0], kind), "w": ([0.0, 3.0], [0.0, 0.3])}
    check_against_integrate(stepper, starts(1), inputs, 2e-15, h=0.1, t_end=2.3)
    check_against_integrate(stepper, starts(1), inputs, 2e-15, h=-0.1, t=2.55, t_end=0.02, save_every=3)


@pytest.mark.filterwarnings("ignore::scvi_codegen.errors.AccuracyWarning")
def test_other_iterations_restart_after_a_shorter_step(coupled):
    stepper = compile_stepper(coupled, SVI(3))
    assert stepper.ensemble is not None
    assert "_NEEDS_VELOCITIES = 1" in stepper.ensemble.header
    inputs = {"u": (KNOTS, own_values()[0]), "w": ([0.0, 3.0], [0.0, 0.3])}
    check_against_integrate(stepper, starts(2), inputs, 2e-14, h=0.05, t_end=2.3)


def test_methods_without_lanes_are_bitwise_equal(pendulum):
    stepper = compile_stepper(pendulum, SCVI(2), solver="newton")
    assert stepper.ensemble is None
    inputs = {"u": (KNOTS, own_values()[0]), "w": ([0.0, 3.0], [0.0, 0.3])}
    check_against_integrate(stepper, starts(1), inputs, 0.0, h=0.02, t_end=2.3, save_every=4)


@pytest.mark.parametrize("tolerance", [None, 1e-6])
def test_adaptive_trajectories_equal_integrate_bitwise(pendulum, tolerance):
    """Times, ends, energies; two inputs of their own and a common one; also back."""
    stepper, (values, c) = compile_stepper(pendulum, SVI(4)), own_values()
    inputs = {"u": (KNOTS, values), "w": ([0.0, 1.0, 3.0], [0.0, 0.5, 0.0], "cubic")}
    ends, (q, p) = np.linspace(0.2, 2.5, COUNT), starts(1)
    there = stepper.integrate_ensemble(q, p, inputs=inputs, t_end=ends, tolerance=tolerance, parameters={"c": c})
    assert there.ok.all()
    for j, (t, q_j, p_j, _, steps) in enumerate(there.each()):
        given = {"inputs": of_one(inputs, j), "tolerance": tolerance, "parameters": {"c": c[j]}}
        run = stepper.integrate(q[j], p[j], t_end=ends[j], **given)
        assert steps == run.steps
        for found, expected in ((t, run.t), (q_j, run.q), (p_j, run.p)):
            assert np.array_equal(found, expected)
        assert np.array_equal(there.energy()[: len(t), j], run.energy())
    back = stepper.integrate_ensemble(
        there.ends[1], there.ends[2], inputs=inputs, t=2.5, t_end=0.0, parameters={"c": c}, save_every=5
    )
    assert_allclose(back.ends[1][-1], q[-1], rtol=0, atol=1e-4 if tolerance else 1e-11)
    assert len(pickle.loads(pickle.dumps(back))) == COUNT


def test_diverging_trajectory_retains_its_previous_states():
    singular = LagrangianSystem.from_text(
        name="falling", coordinates=["x"], lagrangian="x_dot**2/2 + 1/x", forces={"x": "u"}, inputs=["u"]
    )
    inputs = {"u": ([0.0, 0.5, 3.0], [0.0, 0.1, 0.1])}
    stepper = compile_stepper(singular, SVI(4))
    runs = stepper.integrate_ensemble([[1.0], [9.0]], [[0.0], [0.0]], inputs=inputs, t_end=2.5)
    assert runs.status.tolist() == ["step size underflow", "ok"]
    t = next(runs.each())[0]
    assert (t[0], 0.5 in t) == (0.0, True)
    assert 0.9 < t[-1] < 1.3
    assert (np.diff(t) >= 0).all()
    with pytest.raises(StepFailedError) as failed:
        stepper.integrate([1.0], [0.0], inputs=inputs, t_end=2.5)
    assert np.array_equal(failed.value.trajectory.t, t)


def test_velocities_use_the_inputs_at_the_start(coupled):
    stepper = compile_stepper(coupled, SVI(3))
    q, v = starts(2)
    inputs = {"u": (KNOTS, VALUES), "w": ([0.0, 3.0], np.outer(np.arange(COUNT), [1.0, 0.0]))}
    runs = stepper.integrate_ensemble(q, velocity=v, inputs=inputs, h=0.1, t_end=0.2)
    assert_allclose(runs.p[0, :, 1], v[:, 0] / 3 + 2 * (1 + np.arange(COUNT) / 5) * v[:, 1])


def test_splines_of_scipy_are_accepted(pendulum):
    stepper, (u, _) = compile_stepper(pendulum, SVI(3)), own_values()
    w, given = ([0.0, 3.0], [0.0, 0.3]), {"h": 0.05, "steps": 40}
    by_values = stepper.integrate_ensemble(*starts(1), inputs={"u": (KNOTS, u, "cubic"), "w": w}, **given)
    by_spline = stepper.integrate_ensemble(*starts(1), inputs={"u": CubicSpline(KNOTS, u, axis=1), "w": w}, **given)
    assert by_values.t[-1] == 2.0
    assert (by_values.q == by_spline.q).all()


def test_failed_trajectory_does_not_affect_others():
    """The third pendulum's push has no square root in the fourth piece."""
    system = LagrangianSystem.from_text(
        name="root", coordinates=["q"], lagrangian="q_dot**2/2 + cos(q)", forces={"q": "sqrt(u)"}, inputs=["u"]
    )
    stepper, u = compile_stepper(system, SVI(3)), np.abs(own_values()[0]) + 0.1
    fine = stepper.integrate_ensemble(*starts(1), inputs={"u": (KNOTS, u)}, h=0.1, t_end=2.3)
    u[2, 4] = -3.0
    runs = stepper.integrate_ensemble(*starts(1), inputs={"u": (KNOTS, u)}, h=0.1, t_end=2.3)
    others = np.arange(COUNT) != 2
    assert runs.ok.tolist() == others.tolist()
    assert (runs.q[:, others] == fine.q[:, others]).all()
    good = np.isfinite(runs.q[:, 2, 0])
    assert 1.4 < runs.t[good][-1] < 2.05
    assert good[: good.sum()].all()


@pytest.mark.filterwarnings("ignore::scvi_codegen.errors.AccuracyWarning")
def test_lane_with_failed_iteration_continues_as_scalar_across_breakpoints():
    """Stiff from the second piece on, where Newton's iteration alone leads on."""
    system = LagrangianSystem.from_text(
        name="stiffening", coordinates=["q"], lagrangian="q_dot**2/2 - (1 + u)*q**2/2 - q**4/4", inputs=["u"]
    )
    stepper, u = compile_stepper(system, SVI(2)), np.tile(VALUES**2, (COUNT, 1))
    u[4, 2:] = 4000.0
    q, p = starts(1)
    runs = stepper.integrate_ensemble(q, p, inputs={"u": (KNOTS, u)}, h=0.1, t_end=2.3)
    assert runs.ok.all()
    run = stepper.integrate(q[4], p[4], inputs={"u": (KNOTS, u[4])}, h=0.1, t_end=2.3)
    assert_allclose(runs.q[:, 4], run.q, rtol=0, atol=1e-11)
    assert_allclose(runs.energy()[:, 4], run.energy(), rtol=1e-10)


def test_threads_chunks_and_save_every_do_not_change_results(pendulum):
    stepper = compile_stepper(pendulum, SVI(3))
    inputs, reported = {"u": (KNOTS, own_values()[0]), "w": ([0.0, 3.0], [0.0, 0.3])}, []
    given = {"inputs": inputs, "h": 0.001, "t_end": 2.3}
    full = stepper.integrate_ensemble(*starts(1), **given, progress=reported.append)
    fewer = stepper.integrate_ensemble(*starts(1), **given, save_every=100, threads=1)
    assert reported[-1] == full.steps[0]
    rows = np.isin(full.t, fewer.t)
    assert rows.sum() == len(fewer.t) == 24 + 3  # breakpoints that fall between hundreds of steps
    assert (full.q[rows] == fewer.q).all()
    assert_allclose(full.energy()[rows], fewer.energy(), rtol=0, atol=0)


def test_files_contain_the_energies_of_each_segment(pendulum, tmp_path):
    stepper = compile_stepper(pendulum, SVI(3))
    w = np.outer(np.arange(COUNT), [0.0, 0.1])
    runs = stepper.integrate_ensemble(
        *starts(1), inputs={"u": (KNOTS, VALUES), "w": ([0.0, 3.0], w)}, h=0.05, t_end=2.3
    )
    table = runs.to_xarray()
    rising = 1 + np.outer(runs.t, np.arange(COUNT)) / 30
    assert_allclose(table["energy"], runs.p[:, :, 0] ** 2 / 2 - rising * np.cos(runs.q[:, :, 0]), rtol=0, atol=1e-14)
    runs.save(tmp_path / "runs.csv")
    assert (tmp_path / "runs.csv").read_text().splitlines()[0] == "trajectory,t,q,p_q"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"inputs": {"u": (KNOTS, np.tile(VALUES, (COUNT - 1, 1))), "w": (KNOTS, VALUES)}},
            "for each of 11 trajectories",
        ),
        ({"inputs": {"u": (KNOTS, VALUES), "w": (KNOTS, VALUES, "quintic")}}, "constant or linear or cubic"),
        ({"inputs": {"u": (KNOTS, VALUES)}}, "the input 'w' is not set"),
        ({"t_end": 4.0}, "covers t = 0 to 2.6"),
        ({"t_end": None}, "t_end"),
        ({"save_every": 0}, "save_every"),
        ({"h": 0.0}, "h"),
    ],
)
def test_invalid_arguments_are_rejected(pendulum, change, message):
    given = {"inputs": {"u": (KNOTS, VALUES), "w": (KNOTS, VALUES)}, "h": 0.1, "t_end": 2.3} | change
    with pytest.raises(StateError, match=message):
        compile_stepper(pendulum, SVI(3)).integrate_ensemble(*starts(1), **given)


def test_runs_without_steps_and_pickled_results(pendulum):
    stepper, given = (
        compile_stepper(pendulum, SVI(3)),
        {"inputs": {"u": (KNOTS, VALUES), "w": (KNOTS, VALUES)}, "h": 0.1},
    )
    still = stepper.integrate_ensemble(*starts(1), **given, t=0.4, t_end=0.4)
    assert still.t.tolist() == [0.4]
    assert still.ok.all()
    assert still.energy().shape == (1, COUNT)
    runs = stepper.integrate_ensemble(*starts(1), **given, t_end=1.0)
    again = pickle.loads(pickle.dumps(runs))
    assert (again.energy() == runs.energy()).all()
