"""Free bodies with a small moment of inertia: adaptive steps by the iteration, and by Newton's method in its place.

Velocities follow from momenta by the inverse moments, so that the fixed-point iteration contracts for short steps
alone, and rounding errors of the velocities are those of the momenta times the ratio of the moments.
"""

from functools import cache

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS

OMEGA = np.array([0.3, 0.8, 0.5])
T_END = 10.0
LIGHT = 1e-6


@cache
def stepper(method, solver="auto"):
    return sc.compile_stepper(body(), method, solver=solver)


def body():
    text = "(A*omega_1**2 + B*omega_2**2 + C*omega_3**2)/2"
    return lagrange("body", (), text, rotations={"R": "omega"}, A=1.0, B=1.0, C=1.0)


def turn(vector):
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def attitude(axis, moment):
    """Attitude of a body with this moment about an axis, 1 about the others: turns about its momentum and the axis."""
    moments = np.where(np.arange(3) == axis, moment, 1.0)
    about_axis = (OMEGA - moments * OMEGA) * T_END
    return turn(moments * OMEGA * T_END) @ (turn(about_axis) if about_axis.any() else np.eye(3))


def motion(of, moments, **more):
    parameters = dict(zip("ABC", moments, strict=True))
    return of.integrate({"R": np.eye(3)}, velocity={"omega": OMEGA}, parameters=parameters, t_end=T_END, **more)


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("method", "axis"),
    [
        pytest.param(method, axis, marks=() if (method, axis) == ("svi:4", 1) else pytest.mark.full)
        for method in ("svi:4", "svi:6", "svi:8")
        for axis in range(3)
    ],
)
def test_errors_are_those_of_newtons_method(method, axis):
    """The rounding errors of momenta, times the ratio of the moments, are in both.

    Steps of Newton's method are up to 75 times as long as those of the iteration, and each takes as many times longer.
    """
    moments = np.where(np.arange(3) == axis, LIGHT, 1.0).tolist()
    run, other = (motion(stepper(method, solver), moments) for solver in ("auto", "newton"))
    assert run.fallback_steps < run.steps < 100 * other.steps
    for solved in (run, other):
        assert np.abs(solved.rotation("R")[-1] - attitude(axis, LIGHT)).max() < 2e-6
        assert np.ptp(solved.energy()) < 1e-9


@pytest.mark.second
def test_ordinary_bodies_need_no_newton_steps():
    for moments in ((1.0, 1.0, 1.0), (1.0, 2.0, 2.5), (0.1, 1.0, 1.0)):
        run = motion(stepper("svi:4"), moments)
        assert run.fallback_steps == 0
    assert np.abs(run.rotation("R")[-1] - attitude(0, 0.1)).max() < 1e-11


@pytest.mark.rotated
def test_newtons_method_in_the_same_library_gives_the_same_bits():
    source, interface = sc.generate_source(body(), sc.SVI(4), controlled=True)
    own = sc.Stepper(source, interface, flags=PORTABLE_FLAGS)
    loaded = sc.compile_stepper(body(), sc.SVI(4), flags=PORTABLE_FLAGS)
    runs = [motion(of, (LIGHT, 1.0, 1.0)) for of in (own, loaded)]
    assert runs[0].fallback_steps == runs[1].fallback_steps > 0
    assert np.array_equal(runs[0].t, runs[1].t)
    assert np.array_equal(runs[0].q, runs[1].q)


@pytest.mark.rotated
def test_ensembles_have_the_bits_of_single_runs():
    moments = np.array([[LIGHT, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, LIGHT, 1.0]])
    of = stepper("svi:4")
    runs = [motion(of, of_body) for of_body in moments]
    q, p = (np.array([getattr(run, name)[0] for run in runs]) for name in ("q", "p"))
    ensemble = of.integrate_ensemble(q, p, parameters=moments, t_end=T_END)
    for k, run in enumerate(runs):
        assert np.array_equal(ensemble.q[: len(run.t), k], run.q)
        assert ensemble.fallback_steps[k] == run.fallback_steps
