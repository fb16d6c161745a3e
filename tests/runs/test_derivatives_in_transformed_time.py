"""Derivatives in transformed time, of steps and runs, by differences in 60 digits; the energy goes with the start."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.extras.exact.solution import exact_motion
from scvi_codegen.extras.exact.step import compiled_equations
from scvi_codegen.methods.discretise import is_symplectic
from scvi_codegen.systems.formulas.expressions import Tape

KEPLER = sc.problem("kepler").system
Q, P, H, T0 = np.array([0.5, 0.1]), np.array([-0.2, 1.7]), 0.15, 0.4
FORMS = {
    "L": ("frequency", sc.SVI(3)),
    "L, other points": ("distance", sc.SVI(2, "gauss-lobatto:4")),
    "K": ("frequency", sc.LobattoIIIA(3)),
    "K, momenta": ("arclength", sc.Gauss(2)),
    "pendula": ("1/(2 + cos(theta1 - theta2))", sc.SVI(2)),
}
EXACT = 1e-13
WIDTH = mp.mpf(10) ** -15


@cache
def system_of(form):
    plain = sc.problem("double-pendulum").system if form == "pendula" else KEPLER
    return sc.reparametrise(sc.hamiltonian_of(plain) if form.startswith("K") else plain, FORMS[form][0])


@cache
def stepper(form):
    return sc.compile_stepper(system_of(form), FORMS[form][1], flags=QUICK_FLAGS)


class Digits:
    """Steps of tau in 60 digits, their time, and the energy of a state from the formula of the system itself."""

    def __init__(self, form):
        self.system = system_of(form)
        self.step = compiled_equations(self.system, FORMS[form][1])
        plain = self.system.clock.plain
        self.plain = exact_motion(plain)
        arguments = (*plain.coordinates, *(plain.auxiliaries or plain.velocities), *plain.parameters)
        self.formula = Tape([plain.formula], arguments)

    def energy(self, q, p, parameters):
        motion = self.plain.with_parameters(parameters)
        if self.system.auxiliaries:
            return self.formula([*q, *p, *parameters])[0]
        v = motion.velocity(np.array(q), np.array(p), mp.zero)
        return mp.fdot(p, v) - self.formula([*q, *v, *parameters])[0]

    def end(self, given, steps, t_end=None):
        """(q, p, t) after so many steps from (q, p, parameters, t, h); then to a time, that moves with the start."""
        q, p, parameters, (t, h) = given[:2], given[2:4], given[4:-2], given[-2:]
        level = self.energy(q, p, parameters[:-1]) + parameters[-1]
        made = self.step.with_parameters([*parameters[:-1], level])
        for _ in range(steps):
            found = made(q, p, h)
            t += made.duration(found, q, p, h)
            q, p = found.q, found.p
        if t_end is None:
            return [*q, *p, t]

        def late(part):
            return t + made.duration(made(q, p, part), q, p, part) - (given[-2] + t_end - T0)

        found = made(q, p, mp.findroot(late, (0.5 * h, 0.7 * h), tol=mp.mpf(10) ** -70))
        return [*found.q, *found.p, given[-2] + t_end - T0]

    def partials(self, values, directions, steps, t_end=None):
        """(5, n) along n directions; the energy, last of the parameters, is what is added to that of the state."""
        columns = []
        for direction in directions.T:
            ends = []
            for by in (WIDTH, -WIDTH):
                moved = [mp.mpf(x) + by * mp.mpf(d) for x, d in zip(values, direction, strict=True)]
                ends.append(np.array(self.end(moved, steps, t_end), dtype=object))
            columns.append(((ends[0] - ends[1]) / (2 * WIDTH)).astype(float))
        return np.array(columns).T


def columns_of(found):
    """(n, 5, given) from a sensitivity, without h where there is none."""

    def row(each):
        last = [each.t] if each.h is None else [each.t, each.h]
        return np.concatenate([each.state, each.parameters, np.stack(last, axis=-1)], axis=-1)

    return np.concatenate([row(found), row(found.times)[..., np.newaxis, :]], axis=-2)


def values_of(form):
    """Return the initial data of a run, with no parameter but the energy."""
    return [*Q, *P, *stepper(form).defaults[:-1], 0.0, T0, H]


def directions_of(form):
    """Return three random directions of length 1, which weight all initial data."""
    found = np.random.default_rng(4).normal(size=(len(values_of(form)), 3))
    return found / np.linalg.norm(found, axis=0)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("form", FORMS)
def test_derivatives_of_a_step_by_all_arguments(form):
    """At the energy of its state; and at one that is given, where it is symplectic."""
    made, directions = stepper(form), directions_of(form)
    found, exact = columns_of(made.sensitivity(Q, P, H, T0)), Digits(form).partials(values_of(form), directions, 1)
    assert np.abs(found @ directions - exact).max() < EXACT * np.abs(found).max()
    assert_allclose(made.jacobian(Q, P, H, T0), found[:4, :4], rtol=0, atol=1e-15)
    assert_allclose(made.jvp(Q, P, H, T0, tangents=np.eye(4)).T, found[:4, :4], rtol=0, atol=1e-15)
    assert_allclose(made.vjp(Q, P, H, T0, cotangents=np.eye(4)), found[:4, :4], rtol=0, atol=1e-14)
    projected = made.jacobian(Q, P, H, T0, {"E": made.energy(Q, P)})
    if is_symplectic(FORMS[form][1], system_of(form)):
        omega = np.kron([[0, 1], [-1, 0]], np.eye(2))
        assert np.abs(projected.T @ omega @ projected - omega).max() < 1e-14
    assert np.abs(found[:4, :4] - projected).max() > 1e-4


@pytest.mark.rotated
@pytest.mark.parametrize(
    "form", [form if form == "L" else pytest.param(form, marks=pytest.mark.full) for form in FORMS]
)
def test_derivatives_of_runs_by_steps_and_to_an_end_time(form):
    made, values, directions = stepper(form), values_of(form), directions_of(form)
    run = made.integrate(Q, P, h=H, steps=3, t=T0)
    exact, found = Digits(form).partials(values, directions, 3), columns_of(run.sensitivity())[-1]
    assert np.abs(found @ directions - exact).max() < 3 * EXACT * np.abs(found).max()
    t_end = float(run.t[2] + 0.6 * (run.t[3] - run.t[2]))
    ended = made.integrate(Q, P, h=H, t_end=t_end, t=T0)
    exact = Digits(form).partials(values, np.vstack([directions[:-1], np.zeros(3)]), 2, t_end)
    found = columns_of(ended.sensitivity())[-1]
    assert np.abs(found @ directions[:-1] - exact).max() < 3 * EXACT * np.abs(found).max()
    assert ended.sensitivity().h is None


WAYS = {
    "all": {"steps": 12},
    "checkpoints": {"steps": 12, "save_every": 4},
    "to a time": {"t_end": 2.7},
    "backward": {"t_end": -1.5, "h": -H},
    "to an event": {"t_end": 9.0, "events": sc.Event(KEPLER.coordinates[1].name, terminal=1)},
}


@pytest.mark.rotated
@pytest.mark.parametrize("way", WAYS)
def test_gradients_are_the_transpose_of_derivatives(way):
    """Functions of states, and of states and times."""
    run = stepper("L").integrate(Q, P, **({"h": H, "t": T0} | WAYS[way]))
    forward = run.sensitivity()
    weights = np.random.default_rng(1).normal(size=(len(run), 5, 3))
    whole = columns_of(forward)
    expected = np.einsum("nic,nij->jc", weights, whole)
    found = run.pullback(weights)
    got = np.concatenate([found.q, found.p, found.parameters, found.t[np.newaxis]])
    if found.h is not None:
        got = np.concatenate([got, found.h[np.newaxis]])
    assert_allclose(got, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())
    assert_allclose(run.pullback(weights[:, :4, 0]).q, np.einsum("ni,nij->j", weights[:, :4, 0], whole[:, :4, :2]))
    assert_allclose(run.tangent(), forward.state, rtol=0, atol=1e-13 * np.abs(forward.state).max())
    assert (found.h is None) == ("steps" not in WAYS[way])


@pytest.mark.second
def test_run_that_ends_at_a_step_ends_at_its_time():
    made = stepper("L")
    t_end = float(made.integrate(Q, P, h=H, steps=7).t[-1])
    run, before = made.integrate(Q, P, h=H, t_end=t_end), made.integrate(Q, P, h=H, t_end=t_end - 1e-9)
    if len(run) == 8:
        pytest.skip("the time of the last step has no low word here: no step of zero length remains")
    assert np.ptp(run.t[-2:]) == 0.0
    found = run.sensitivity()
    assert_allclose(found.state[-1], before.sensitivity().state[-1], rtol=0, atol=1e-7)
    assert np.abs(found.times.state[-1]).max() < 1e-14 < np.abs(found.times.state[-2]).max()
    weights = np.random.default_rng(2).normal(size=(9, 5))
    assert_allclose(run.pullback(weights).q, np.einsum("ni,nij->j", weights, columns_of(found))[:2], rtol=1e-11)
    still = made.integrate(Q, P, h=H, t_end=0.0)
    assert_allclose(still.tangent(), np.stack([np.eye(4)] * 2))
