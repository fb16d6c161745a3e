"""Steps, runs, transforms and errors of a compiled stepper, as a user meets them."""

import numpy as np
import pytest
from notation import hamilton, lagrange

import scvi_codegen as sc

WITH_ACTION = (sc.SVI(2, "gauss-legendre:3"), sc.SCVI(3), sc.Gauss(2), sc.StoermerVerlet())
each_action = pytest.mark.parametrize("method", WITH_ACTION, ids=lambda method: method.name)
KEPLER = sc.problem("kepler")
STATE = KEPLER.q, KEPLER.velocity


def same(left, right):
    """Bit for bit."""
    return all(np.array_equal(getattr(left, name), getattr(right, name)) for name in ("t", "q", "p", "iterations"))


@pytest.fixture
def kepler(compiled):
    return compiled("kepler", sc.SVI(3))


# Steps and runs.


# Saving and restoring.


def test_checkpoints_contain_the_parameters(kepler):
    run = kepler.start(*STATE, h=0.05, parameters={"mu": 0.9})
    saved = run.checkpoint()
    expected = run.record(5)
    assert same(kepler.from_checkpoint(saved).record(5), expected)
    assert same(kepler.from_checkpoint(saved, parameters=[0.9]).record(5), expected)
    assert not same(kepler.from_checkpoint(saved, parameters={"mu": 1.0}).record(5), expected)


@pytest.mark.rotated
def test_checkpoints_of_other_systems_are_rejected(kepler):
    """Their memory may have the same size."""
    text = "a_dot**2/2 + b_dot**2/2 - (a - b)**4/4 - mu*a**2"
    for name, coordinates in (("kepler", ["a", "b"]), ("other", [*kepler.coordinates])):
        lagrangian = text.replace("a", coordinates[0]).replace("b", coordinates[1])
        other = sc.LagrangianSystem.from_text(name, coordinates, lagrangian, parameters={"mu": 1.0})
        saved = sc.compile_stepper(other, "svi:2").start([1.0, 0.5], [0.0, 0.0], h=0.1).checkpoint()
        with pytest.raises(sc.StateError, match=r"the saved run is one of .*, not of"):
            kepler.from_checkpoint(saved)


def test_damaged_checkpoints_are_rejected(kepler):
    """One bit anywhere, a missing end, or bytes of another kind."""
    saved, random = kepler.start(*STATE, h=0.05).checkpoint(), np.random.default_rng(5)
    places = map(int, random.integers(0, len(saved), 300))
    damaged = [saved[:i] + bytes([saved[i] ^ 1 << int(random.integers(8))]) + saved[i + 1 :] for i in places]
    for each in (*damaged, saved[:-1], saved + b"x", b"abc", b""):
        with pytest.raises(sc.StateError, match=r"invalid saved run: the checksum .* save the run again"):
            kepler.from_checkpoint(each)
    with pytest.raises(sc.StateError, match="must be bytes, not int"):
        kepler.from_checkpoint(3)
    with pytest.raises(sc.StateError, match="it has 3 bytes"):
        kepler.start(*STATE, h=0.05).rollback(b"abc")


# Parameters.


def test_parameters_may_be_given_by_name_or_in_order(compiled, sample):
    stepper, state = compiled("pumped-cart-pole", sc.SVI(3)), sample("pumped-cart-pole").state
    values = stepper.defaults
    values[stepper.parameters.index("k")] = 0.7
    assert np.array_equal(stepper.step(*state, 0.1, 0.2, {"k": 0.7}), stepper.step(*state, 0.1, 0.2, values))
    assert not np.array_equal(stepper.step(*state, 0.1, 0.2), stepper.step(*state, 0.1, 0.2, values))


# Steps that fail.


def test_step_beyond_the_domain_fails_with_a_message(compiled):
    """Leapfrog falls into the centre, where the potential is infinite."""
    stepper = compiled("kepler", sc.StoermerVerlet())
    with pytest.raises(sc.StepFailedError, match=r"infinite or NaN.*undefined there.*no mass is 0") as caught:
        stepper.step([0.0, 0.0], [1.0, 0.0], 0.1)
    assert (caught.value.status, caught.value.step, caught.value.t) == ("not finite", 0, 0.0)
    assert caught.value.trajectory is None


@pytest.mark.second
def test_a_step_without_solution_fails_with_advice(compiled):
    """q'' = q^2 by the midpoint rule requires a root of h^2 x^2 / 2 - 2 x + 2 q + h v: none exists for this h."""
    with pytest.raises(sc.StepFailedError, match=r"step 0 at t = 1\.5 with h = 2 failed: .*smaller step") as caught:
        compiled("runaway", sc.SVI(1)).step([1.0], [1.0], 2.0, 1.5)
    assert caught.value.status in ("not converged", "singular")
    assert caught.value.residual > 0.0
    assert caught.value.trajectory is None


def test_failed_run_continues_with_other_options(compiled):
    state = compiled("kepler", sc.SVI(4)), STATE
    run = state[0].start(*STATE, h=0.3, options=sc.SolverOptions(max_iterations=1))
    with pytest.raises(sc.StepFailedError, match=r"did not converge.*larger max_iterations") as failed:
        run.record(3)
    assert (failed.value.step, failed.value.t) == (run.steps, run.t)
    assert str(failed.value).startswith(
        f"step {run.steps} at t = {run.t:.17g} with h = 0.3 failed: the iteration on the stage equations did not "
        f"converge (last update {failed.value.residual:.3g}; "
    )
    assert state[0].from_checkpoint(run.checkpoint()).record(3).q[-1] == pytest.approx(
        state[0].integrate(*STATE, h=0.3, steps=3).q[-1], abs=1e-14
    )


# Convergence.


def test_looser_tolerance_needs_fewer_iterations_and_loses_digits(kepler):
    tight = kepler.integrate(*STATE, h=0.2, steps=50)
    loose = kepler.integrate(*STATE, h=0.2, steps=50, options=sc.SolverOptions(tolerance=1e-4))
    assert loose.iterations.sum() < tight.iterations.sum()
    assert 1e-13 < np.abs(loose.q - tight.q).max() < 1e-2
    q, _ = kepler.step(*STATE, 0.2, options=sc.SolverOptions(tolerance=1e-4))
    assert q == pytest.approx(loose.q[1], abs=1e-15)  # but for the low words of runs
    assert np.abs(q - tight.q[1]).max() > 1e-13
    exact, rough = (
        kepler.discrete_legendre_minus(STATE[0], q, 0.2, options=options)[1]
        for options in (None, sc.SolverOptions(tolerance=0.1))
    )
    assert 1e-13 < np.abs(exact - rough).max() < 0.1


def test_absolute_tolerance_bounds_the_update(kepler):
    """Lengths in units 2^30 times smaller make the same update 2^30 times larger, and a given bound harder to meet."""
    scale = 2.0**30
    large = {"q": np.multiply(scale, STATE[0]), "p": np.multiply(scale, STATE[1]), "parameters": {"mu": scale**3}}

    def iterations(options, q=STATE[0], p=STATE[1], parameters=None):
        return kepler.integrate(q, p, h=0.1, steps=20, parameters=parameters, options=options).iterations.sum()

    relative, absolute = (sc.SolverOptions(tolerance=1e-6, absolute=absolute) for absolute in (False, True))
    assert iterations(relative) == iterations(relative, **large)
    assert iterations(absolute) < iterations(absolute, **large)
    exact = kepler.step(large["q"], large["p"], 0.1, 0.0, large["parameters"])
    for bound in (1e3, 1e-3):
        options = sc.SolverOptions(tolerance=bound, absolute=True)
        found = kepler.step(large["q"], large["p"], 0.1, 0.0, large["parameters"], options=options)
        assert np.abs(np.array(found) - exact).max() < bound


# Legendre transforms and energy.


@pytest.mark.rotated
def test_velocity_is_found_where_momenta_cancel(quickly_compiled):
    """p = v + 5 sin(q) in which the terms cancel, as of charges in magnetic fields."""
    system = lagrange("driven pivot", "q", "q_dot**2/2 + 5.345*sin(q)*q_dot")
    stepper = quickly_compiled(system, sc.SVI(2))
    q = np.linspace(0.05, 3.0, 500)[:, None]
    for p in (np.zeros_like(q), -0.0024 * q):
        assert stepper.velocity(q, p) == pytest.approx(p - 5.345 * np.sin(q), abs=2e-15)


@pytest.mark.rotated
def test_velocity_is_undefined_beyond_the_range_of_the_momenta(compiled, sample):
    """A momentum that no velocity below c gives in a system where there is one to find; and one given as nan."""
    stepper = compiled("relativistic-particle", sc.SVI(3))
    v = stepper.velocity([0.0], [3.0])
    assert v == pytest.approx(3.0 / np.sqrt(10.0), abs=1e-12)
    with pytest.raises(sc.StateError, match="is nan"):
        stepper.velocity([0.0], [np.nan])
    with pytest.raises(sc.StateError, match=r"momentum at q = .*cannot be computed"):
        stepper.momentum([0.0], [1.5])


# The discrete Lagrangian.


@pytest.mark.rotated
@pytest.mark.covering
@each_action
@pytest.mark.parametrize("name", ["kepler", "pumped-cart-pole"])
def test_step_is_the_plus_transform_after_the_inverse_of_the_minus_transform(sample, compiled, name, method):
    stepper, (q0, p0) = compiled(name, method), sample(name).state
    q1, p1 = stepper.step(q0, p0, 0.1, 0.3)
    minus = stepper.discrete_legendre_minus(q0, q1, 0.1, 0.3)
    plus = stepper.discrete_legendre_plus(q0, q1, 0.1, 0.3)
    # A change of q1 by round-off changes the momenta by (mass / h) times as much.
    assert np.array_equal(minus[0], q0)
    assert np.array_equal(plus[0], q1)
    assert minus[1] == pytest.approx(p0, abs=1e-13)
    assert plus[1] == pytest.approx(p1, abs=1e-13)


@pytest.mark.rotated
@each_action
def test_two_point_form_gives_the_same_positions(sample, compiled, method):
    stepper, state = compiled("pumped-cart-pole", method), sample("pumped-cart-pole").state
    run = stepper.integrate(*state, h=0.1, steps=2, t=0.3)
    following = stepper.step_positions(run.q[0], run.q[1], 0.1, 0.3)
    assert following == pytest.approx(run.q[2], abs=1e-13)


@pytest.mark.parametrize(
    "system",
    [lagrange("L", "x", "x_dot**2 - x**4/4 + x*cos(t)"), hamilton("H", "x", "y**2/4 + x**4/4 - x*cos(t)", momenta="y")],
    ids=["lagrangian", "hamiltonian"],
)
def test_the_discrete_lagrangian_of_an_explicit_step_is_the_trapezoidal_sum(system):
    stepper = sc.compile_stepper(system, sc.StoermerVerlet())
    x, h, t = np.array([0.7, 0.75]), 0.1, np.array([0.3, 0.4])
    v, force = (x[1] - x[0]) / h, np.cos(t) - x**3
    action = h / 2 * np.sum(v**2 - x**4 / 4 + x * np.cos(t))
    assert stepper.discrete_lagrangian(x[:1], x[1:], h, t[0]) == pytest.approx(action, rel=1e-14)
    start, end = (
        f(x[:1], x[1:], h, t[0])[1] for f in (stepper.discrete_legendre_minus, stepper.discrete_legendre_plus)
    )
    assert [*start, *end] == pytest.approx([2 * v - h / 2 * force[0], 2 * v + h / 2 * force[1]], rel=1e-14)
    assert "newton_solver" not in stepper.source.code


@pytest.mark.rotated
def test_methods_without_a_discrete_lagrangian_are_reported(compiled):
    for method in (sc.SpectralCollocation(2), sc.RadauIIA(2), sc.ExplicitEuler(), sc.SCVI(3, variational=False)):
        stepper = compiled("kepler", method)
        for call in (stepper.discrete_lagrangian, stepper.discrete_legendre_minus, stepper.step_positions):
            with pytest.raises(sc.MethodError, match="discrete_lagrangian is not available without an action"):
                call([1.0, 0.0], [1.0, 0.1], 0.1)
