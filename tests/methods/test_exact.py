"""The exact discrete Lagrangian and flow against closed forms, their own derivatives and another integrator."""

import oracle
import pytest
from notation import lagrange
from samples import driven_duffing, linkage, pumped_cart_pole, pushed_pendulum

from scvi_codegen.common.errors import StateError
from scvi_codegen.common.precision import mp
from scvi_codegen.extras.exact.discrete_lagrangian import exact_discrete_lagrangian, exact_map
from scvi_codegen.interfaces.models.problems import problem

OSCILLATOR = problem("harmonic-oscillator").system
PENDULUM = problem("planar-pendulum").system
KEPLER = problem("kepler").system
RELATIVISTIC = problem("relativistic-particle").system


def largest_difference(left, right):
    return max(abs(mp.convert(str(a)) - b) for a, b in zip(left, right, strict=True))


@pytest.mark.tiers(3, 3)
@pytest.mark.parametrize(("digits", "h"), [(1, "0.5"), (15, "0.5"), (30, "0.5"), (50, "0.5"), (30, "20"), (30, "-2")])
def test_harmonic_oscillator_has_the_requested_digits(digits, h):
    h, m, k, q0, q1 = mp.mpf(h), mp.mpf(2), mp.mpf(3), mp.mpf(1), mp.mpf("0.3")
    found = exact_discrete_lagrangian(OSCILLATOR, [1], ["0.3"], h, parameters={"m": 2, "k": 3}, digits=digits)
    w = mp.sqrt(k / m)
    cosine, sine = mp.cos(w * h), mp.sin(w * h)
    action = m * w * ((q0**2 + q1**2) * cosine - 2 * q0 * q1) / (2 * sine)
    p0, p1 = m * w * (q1 - q0 * cosine) / sine, m * w * (q1 * cosine - q0) / sine
    scale = 10 * mp.mpf(10) ** -digits
    assert abs(found.action - action) < scale * max(1, abs(action))
    assert largest_difference(found.p0, [p0]) < scale
    assert largest_difference(found.p1, [p1]) < scale
    assert largest_difference(found.v0, [p0 / 2]) < scale
    assert found.error < mp.mpf(10) ** -digits


@pytest.mark.rotated
def test_kepler_ellipse_agrees_with_keplers_equation():
    """q = (cos E - e, sqrt(1 - e^2) sin E) with E - e sin E = t, from perihelion."""
    e, h = mp.mpf("0.5"), mp.mpf("0.75")
    start, momenta = [1 - e, 0], [0, mp.sqrt((1 + e) / (1 - e))]
    anomaly = mp.findroot(lambda E: E - e * mp.sin(E) - h, h)
    end = [mp.cos(anomaly) - e, mp.sqrt(1 - e**2) * mp.sin(anomaly)]
    flow = exact_map(KEPLER, start, momenta, h)
    joined = exact_discrete_lagrangian(KEPLER, start, end, h)
    assert largest_difference(flow.q1, end) < mp.mpf("1e-30")
    assert largest_difference(joined.p0, momenta) < mp.mpf("1e-29")
    assert abs(joined.action - flow.action) < mp.mpf("1e-30")


def test_forced_oscillator_with_nonzero_initial_time():
    """q'' = -q + gamma cos(omega t): a particular solution and a rotation."""
    system = problem("duffing").system
    gamma, w, t, h = mp.mpf("0.7"), mp.mpf("1.3"), mp.mpf("0.4"), mp.mpf("0.9")
    values = {"alpha": 1, "beta": 0, "gamma": "0.7", "omega": "1.3"}

    def driven(time):
        return gamma / (1 - w**2) * mp.cos(w * time), -gamma * w / (1 - w**2) * mp.sin(w * time)

    (u0, du0), (u1, du1) = driven(t), driven(t + h)
    x, v = mp.mpf("0.6") - u0, mp.mpf("-0.3") - du0
    flow = exact_map(system, ["0.6"], ["-0.3"], h, t=t, parameters=values)
    assert largest_difference(flow.q1, [u1 + x * mp.cos(h) + v * mp.sin(h)]) < mp.mpf("1e-30")
    assert largest_difference(flow.p1, [du1 - x * mp.sin(h) + v * mp.cos(h)]) < mp.mpf("1e-30")


def test_generalised_forces_act_on_the_exact_flow():
    """q'' = -q - c q' + f: a damped rotation about f."""
    system = lagrange("damped", "x", "(x_dot**2 - x**2)/2", c=0.5, f=0.25, forces={"x": "f - c*x_dot"})
    c, f, h, x, v = mp.mpf("0.5"), mp.mpf("0.25"), mp.mpf("0.9"), mp.mpf("0.625"), mp.mpf("-0.375")
    w, decay = mp.sqrt(1 - c**2 / 4), mp.exp(-c * h / 2)
    a, b = x - f, (v + c * (x - f) / 2) / w
    cosine, sine = mp.cos(w * h), mp.sin(w * h)
    end = decay * (a * cosine + b * sine)
    rate = decay * w * (b * cosine - a * sine) - c / 2 * end
    flow = exact_map(system, ["0.625"], ["-0.375"], h)
    assert largest_difference(flow.q1, [f + end]) < mp.mpf("1e-30")
    assert largest_difference(flow.p1, [rate]) < mp.mpf("1e-30")


CASES = {
    "double-pendulum": (problem("double-pendulum").system, (0.9, -0.6), (0.5, 1.2), 0.2),
    "relativistic-particle": (problem("relativistic-particle").system, (0.5,), (0.6,), 0.8),
    "charged-particle": (problem("charged-particle").system, (0.2, -0.1, 0.3), (1.0, 0.4, 0.1), 0.8),
    "driven-duffing": (driven_duffing(), (0.6,), (-0.3,), 0.8),
    "pumped-cart-pole": (pumped_cart_pole(), (0.2, 0.9), (0.4, -0.7), 0.3),
}
TIME = 0.3


def all_but(long):
    """The cases, one of them in the full tier."""
    return [pytest.param(name, marks=[pytest.mark.full] if name == long else []) for name in CASES]


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", all_but("pumped-cart-pole"))
def test_flow_connects_its_end_points_and_is_reversible(name):
    system, q, v, h = CASES[name]
    momenta = oracle.Mechanics(system).momentum([oracle.mp.mpf(TIME)], *(oracle.numbers([x]) for x in (q, v)))[0]
    flow = exact_map(system, q, momenta.astype(float), h, t=TIME)
    joined = exact_discrete_lagrangian(system, flow.q0, flow.q1, h, t=TIME)
    back = exact_map(system, flow.q1, flow.p1, -mp.mpf(h), t=mp.mpf(TIME) + mp.mpf(h))
    assert largest_difference(joined.p0, flow.p0) < mp.mpf("1e-29")
    assert largest_difference(joined.p1, flow.p1) < mp.mpf("1e-29")
    assert abs(joined.action - flow.action) < mp.mpf("1e-29")
    assert abs(back.action + flow.action) < mp.mpf("1e-29")
    assert largest_difference(back.q1, flow.q0) < mp.mpf("1e-29")


@pytest.mark.tiers(1)
@pytest.mark.parametrize("name", ["double-pendulum", "pumped-cart-pole"])
def test_exact_flow_is_the_limit_of_the_oracle(name):
    """Gauss's method of 6 stages on Hamilton's equations, formulas of its own: error of order h^13."""
    system, q, v, _ = CASES[name]
    mechanics, h, t = oracle.Mechanics(system), oracle.mp.mpf(1) / 256, oracle.mp.mpf(TIME)
    q, v = oracle.numbers(q), oracle.numbers(v)
    p = mechanics.momentum([t], q[None], v[None])[0]
    flow = exact_map(system, q, p, h, t=t)
    step = oracle.runge_kutta(mechanics, t, q, p, h, **oracle.collocation_tableau(oracle.points("gauss", 6)))
    assert largest_difference(step[0], flow.q1) < mp.mpf("1e-25")
    assert largest_difference(step[1], flow.p1) < mp.mpf("1e-24")


@pytest.mark.rotated
@pytest.mark.parametrize("digits", [12, pytest.param(30, marks=pytest.mark.full)])
def test_long_steps_are_divided(digits):
    flow = exact_map(PENDULUM, [2], [0], 10, digits=digits)
    halves = exact_map(
        PENDULUM, (half := exact_map(PENDULUM, [2], [0], 5, digits=digits)).q1, half.p1, 5, digits=digits
    )
    assert largest_difference(flow.q1, halves.q1) < 100 * mp.mpf(10) ** -digits
    assert abs(flow.action - half.action - halves.action) < 100 * mp.mpf(10) ** -digits


@pytest.mark.rotated
def test_initial_guess_selects_one_of_several_solutions():
    """Start from rest at 2 radians for 5 time units; another trajectory connects the same points."""
    flow = exact_map(PENDULUM, [2], [0], 5, digits=12)
    other = exact_discrete_lagrangian(PENDULUM, [2], flow.q1, 5, digits=12)
    same = exact_discrete_lagrangian(PENDULUM, [2], flow.q1, 5, digits=12, guess=[0.01])
    assert abs(same.v0[0]) < mp.mpf("1e-11")
    assert abs(other.v0[0] + mp.mpf("0.6806201524")) < mp.mpf("1e-9")
    assert largest_difference(exact_map(PENDULUM, [2], other.p0, 5, digits=12).q1, flow.q1) < mp.mpf("1e-10")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: exact_discrete_lagrangian(OSCILLATOR, [1], ["0.3"], mp.pi), "conjugate to q0"),
        *(
            pytest.param(call, words, marks=pytest.mark.full)  # seconds
            for call, words in (
                (lambda: exact_discrete_lagrangian(KEPLER, [1, 0], [-0.7, -0.8], 5, digits=5), "give guess"),
                (lambda: exact_map(KEPLER, [1, 0], [0, 0], 2, digits=5), "use a smaller step size"),
            )
        ),
        (lambda: exact_discrete_lagrangian(RELATIVISTIC, [0], [3], 2, digits=5), "give guess"),
        (lambda: exact_map(linkage(), [0, 1, 1.9, 1.5], [0] * 4, 1), "'four-bar linkage' has constraints"),
        (lambda: exact_map(pushed_pendulum(), [0], [0], 1, parameters={"u_0": 1}), "the input w is not set"),
        (lambda: exact_discrete_lagrangian(RELATIVISTIC, [0], [0.1], 0.2, guess=[2], digits=5), "give guess"),
    ],
)
def test_errors_state_the_remedy(call, words):
    with pytest.raises(StateError, match=words):
        call()
