"""Action of runs and shadow energy: identities, other coordinates, drifts that the energy does not show."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.results.joining import compensated_sums

pytestmark = pytest.mark.rotated

HENON_HEILES = sc.problem("henon-heiles").system
START = np.array([0.0, -0.25, 0.42, 0.0])


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(HENON_HEILES, "svi:4")


def central(function, h=1e-3):
    """Return the derivative at 0, by differences of order 6."""
    return sum(w * (function(k * h) - function(-k * h)) for k, w in ((1, 0.75), (2, -0.15), (3, 1 / 60))) / h


def test_action_is_the_sum_of_discrete_lagrangians(stepper):
    run = stepper.integrate(START[:2], START[2:], h=0.2, steps=40)
    each = [stepper.discrete_lagrangian(*run.q[k : k + 2], 0.2) for k in range(40)]
    assert np.allclose(np.diff(run.action(cumulative=True)), each, rtol=0, atol=1e-16)
    every_tenth = stepper.integrate(START[:2], START[2:], h=0.2, steps=40, save_every=10)
    assert abs(every_tenth.action() - run.action()) < 1e-15


def test_discrete_legendre_transforms_of_explicit_steps_clear_the_report():
    spring = lagrange("spring", "x", "x_dot**2/2 - x**2/2")
    binding = sc.compile_stepper(spring, "stoermer-verlet").binding.with_function("discrete_legendre")
    report, numbers = binding.new("report *"), np.array([[0.0], [0.1], [0.0], [0.0], [0.0]])
    report.iterations = 7
    q0, q1, *results = map(binding.pointer, numbers)
    arguments = q0, q1, binding.null, binding.null, *results, report, binding.workspace()
    assert (binding.function("discrete_legendre")(0.0, 0.1, *arguments), report.iterations) == (0, 0)
    assert numbers[2:4, 0] == pytest.approx([1.0, 0.995])  # p0 = v + h/2 q0, p1 = v - h/2 q1


def test_variation_of_the_action_is_that_of_the_ends(stepper):
    """dS = p1 . dq1 - p0 . dq0 - sum E_d dh with E_d = -dL_d/dh at fixed ends."""

    def run(z, h=0.2):
        return stepper.integrate(z[:2], z[2:], h=h, steps=30)

    def action(z, h=0.2):
        return stepper.integrate(z[:2], z[2:], h=h, steps=30, action=True).action()

    base = run(START)
    derivatives = base.sensitivity()
    for i, e in enumerate(np.eye(4)):
        expected = base.p[-1] @ derivatives.state[-1, :2, i] - base.p[0] @ e[:2]
        assert abs(central(lambda x, e=e: action(START + x * e)) - expected) < 2e-11
    energies = [
        -central(lambda x, k=k: stepper.discrete_lagrangian(base.q[k], base.q[k + 1], 0.2 + x)) for k in range(30)
    ]
    expected = base.p[-1] @ derivatives.h[-1, :2] - np.sum(energies)
    assert abs(central(lambda x: action(START, 0.2 + x), 2e-4) - expected) < 2e-11
    assert np.ptp(energies) < 1e-7  # conserved to the order of the method


QUARTIC = "(x_dot**2 + y_dot**2)/2 - x**4 - x**2*y - y**2"
SUMMED = [
    ({"lagrangian": QUARTIC}, "gauss:2", {"h": 0.1, "t_end": 2.33}),
    ({"lagrangian": QUARTIC}, "svi:4", {"t_end": 9.0}),
    (
        {"lagrangian": "(x_dot**2*(1 + x**2) + y_dot**2)/2 - x**2*y*t", "forces": {"x": "-y_dot*x_dot", "y": "0"}},
        sc.SVI(3, quadrature="gauss-legendre:5"),
        {"h": -0.1, "steps": 20},
    ),
    (
        {"lagrangian": "(x_dot**2 + y_dot**2)/2 + u*x - y**2", "inputs": ["u"]},
        "svi:2",
        {"h": 0.07, "t_end": 1.0, "inputs": {"u": ([0.0, 0.4, 1.0], [0.0, 1.0, 0.0])}},
    ),
    (
        {"lagrangian": "(x_dot**2 + y_dot**2)/2 + u*x - y**2", "inputs": ["u"]},
        "stoermer-verlet",
        {"h": 0.07, "t_end": 1.0, "inputs": {"u": 0.5}},
    ),
    ({"lagrangian": QUARTIC}, "stoermer-verlet", {"h": 0.05, "steps": 30, "save_every": 3}),
    ({"lagrangian": QUARTIC}, "scvi:3", {"t_end": 3.0}),
    ({"lagrangian": f"{QUARTIC} + t*x*x_dot", "damping": "1/10"}, "svi:4", {"t_end": 3.0}),
    (
        {
            "lagrangian": QUARTIC,
            "constraints": ["(x + 0.7)**2 + (y - 0.6)**2 - 1.25"],
            "forces": {"x": "-x_dot", "y": "0"},
        },
        "svi:2",
        {"t_end": 2.0},
    ),
]
KINDS = ["gauss", "adaptive", "forces", "inputs", "constant input", "explicit", "scvi", "damping", "rod"]


@pytest.mark.parametrize(("arguments", "method", "steps"), SUMMED, ids=KINDS)
def test_action_summed_by_the_run_is_that_of_its_steps(arguments, method, steps):
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text("system", ["x", "y"], **arguments), method)
    without, run = (stepper.integrate([0.3, 0.1], velocity=[0.1, 0.2], action=x, **steps) for x in (False, True))
    assert without.actions is None
    assert np.array_equal(run.actions, run.action(cumulative=True))
    assert np.allclose(without.q, run.q, rtol=0, atol=1e-14 if "explicit" in run.stepper.interface.solver else 0)
    assert np.allclose(run.action(cumulative=True), without.action(cumulative=True), rtol=0, atol=1e-14)
    assert abs(run[2:].action() - without[2:].action()) < 1e-14 if not run.pieces else True


def test_action_is_summed_for_hamiltonians_rotations_and_arrays():
    top = lagrange("top", [], "(omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2 - R_33", rotations={"R": "omega"})
    oscillator = sc.HamiltonianSystem.from_text("oscillator", ["x"], "p_x**2/2 + p_x**4/8 + x**2/2 + x*p_x/5")
    chain = lagrange("chain", "u[N]", "sum(i in N, u_dot[i]**2/2 - u[i]**4/4) - sum(i in 0..N-2, (u[i+1] - u[i])**2/2)")
    for system, q, start in (
        (top, {"R": [1, 0, 0, 0]}, {"velocity": {"omega": [0.1, 0.2, 2]}}),
        (oscillator, [1.0], {"p": [0.2]}),
        (chain, {"u": [0.1, 0.2, 0.3]}, {}),
    ):
        stepper = sc.compile_stepper(system, "svi:3")
        without, run = (stepper.integrate(q, h=0.05, steps=30, action=x, **start) for x in (False, True))
        assert np.isfinite(run.actions).all()
        assert abs(run.action() - without.action()) < 1e-14


def test_actions_of_constraints_forces_damping_and_ensembles(stepper):
    rod = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 - 1"])
    angle = sc.LagrangianSystem.from_text("angle", ["a"], "a_dot**2/2 - sin(a)")
    both = [
        sc.compile_stepper(system, "svi:4").integrate(q, np.zeros(len(q)), h=0.05, steps=40).action()
        for system, q in ((rod, [1.0, 0.0]), (angle, [0.0]))
    ]
    assert abs(both[0] - both[1]) < 1e-11
    drag = lagrange("drag", "x", "x_dot**2/2 - x**2/2", forces={"x": "-c*x_dot"}, c=0.1)
    damped = sc.LagrangianSystem.from_text("damped", ["x"], "x_dot**2/2 - x**2/2", damping="1/10")
    t, w = 2.0, np.sqrt(1 - 0.05**2)
    s = np.linspace(0, t, 20001)  # x = exp(-t/20) (cos w t + sin w t / (20 w)), without work of the drag
    x = np.exp(-s / 20) * (np.cos(w * s) + 0.05 / w * np.sin(w * s))
    v = -np.exp(-s / 20) * (0.05**2 / w + w) * np.sin(w * s)
    expected = np.trapezoid((v**2 - x**2) / 2, s)
    for system in (drag, damped):
        run = sc.compile_stepper(system, "svi:4").integrate([1.0], [0.0], h=0.05, steps=40)
        assert abs(run.action() - expected) < 1e-8
    runs = stepper.integrate_ensemble([START[:2], [0.0, 0.1]], [START[2:], [0.3, 0.1]], h=0.2, steps=20)
    assert np.allclose(runs.action(), [runs[j].action() for j in range(2)], rtol=0, atol=1e-15)
    assert runs.action(cumulative=True).shape == (21, 2)


@pytest.mark.quick
def test_sums_are_compensated():
    terms = np.concatenate([[1.0], np.full(10_000, 1e-17)])
    assert np.cumsum(terms)[-1] == 1.0
    assert compensated_sums(terms)[-1] == 1.0 + 1e-13


@pytest.mark.parametrize(("method", "h"), [("svi:1", 0.05), ("stoermer-verlet", 0.05), ("composition:4", 0.05)])
def test_shadow_energy_is_constant_and_shows_a_drift(method, h):
    stepper = sc.compile_stepper(HENON_HEILES, method)
    run = stepper.integrate(START[:2], START[2:], h=h, steps=1000)
    shadow = run.shadow_energy()[6:-6]
    assert np.ptp(shadow) < 5e-14 < np.ptp(run.energy()) / 100
    q, p = START[:2], START[2:]
    states = [(q, p)]
    for _ in range(1000):
        q, p = stepper.step(q, p, h)
        p = p * (1 - 1e-11)
        states.append((q, p))
    run.q[:], run.p[:] = (np.array(each) for each in zip(*states, strict=True))
    drifting = run.shadow_energy()[6:-6]
    lost = 1e-11 * np.cumsum(np.einsum("ij,ij->i", run.p, run.p))[6:-6]
    assert abs(drifting[-1] - drifting[0] + lost[-1] - lost[0]) < 0.1 * lost[-1]
    assert np.ptp(run.energy()) > 10 * lost[-1]  # hidden there
