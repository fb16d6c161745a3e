"""Rigid bodies, directions and spins: order, invariants and symplecticity on T*SO(3), against independent integrations.

References integrate Euler's equations for (q, omega), in which nothing of the package occurs, by SciPy's DOP853.
"""

import numpy as np
import pytest
import sympy
from notation import hamilton
from samples import QUICK_FLAGS
from scipy.spatial.transform import Rotation

import scvi_codegen as sc
from scvi_codegen.methods.discretise import discretised_form
from scvi_codegen.runs.states.rotation_quantities import spins
from scvi_codegen.runs.states.rotations import state_by_name
from scvi_codegen.systems.formulas.rotations import RotationNames

INERTIA = np.array([1.0, 2.0, 3.0])
TOP = sc.LagrangianSystem.from_text(
    "heavy top",
    rotations={"R": "omega"},
    parameters={"A": 1.0, "B": 2.0, "C": 3.0, "g": 1.3},
    lagrangian="(A*omega_1**2 + B*omega_2**2 + C*omega_3**2)/2 - g*rotate_3(R, 0.1, 0.2, 1)",
)
CENTRE = np.array([0.1, 0.2, 1.0])
ATTITUDE = Rotation.from_euler("zxz", [0.3, 0.8, -0.4])
OMEGA = np.array([0.7, -0.4, 1.5])


def compiled(system, method, **more):
    return sc.compile_stepper(system, method, flags=QUICK_FLAGS, **more)


def test_methods_with_as_many_points_as_degree_take_the_hamiltonian():
    methods = {name: sc.as_method(name) for name in ("svi:3", "gauss:2", "scvi:3", "sc:3", "stoermer-verlet")}
    forms = {name: isinstance(discretised_form(TOP, method), sc.HamiltonianSystem) for name, method in methods.items()}
    assert forms == {"svi:3": True, "gauss:2": True, "scvi:3": False, "sc:3": False, "stoermer-verlet": True}


@pytest.mark.second
def test_the_quaternion_is_continuous_where_its_sign_is_not_that_of_the_attitude():
    run = compiled(TOP, "svi:4").integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1, steps=400)
    q = run.quaternion()
    assert (np.linalg.norm(np.diff(q, axis=0), axis=1) < 0.2).all()
    assert q[:, 0].min() < 0 < q[:, 0].max()


def test_velocities_are_rejected_where_there_are_spins():
    """The momenta of spins follow from the spins, not from velocities."""
    system = sc.HamiltonianSystem.from_text("cavity", ["x"], spins=["s"], hamiltonian="(p_x**2 + x**2)/2 + x*s_1 + s_3")
    q, p, _ = state_by_name(system, {"x": 0.1, "s": [0.3, 0.6, 0.8]}, {"x": 0.2}, None)
    np.testing.assert_allclose(spins(q[1:], p[1:]), [0.3, 0.6, 0.8], rtol=0, atol=1e-15)
    with pytest.raises(sc.StateError, match="spins have no velocities: give p"):
        state_by_name(system, {"x": 0.1, "s": [0.3, 0.6, 0.8]}, None, {"x": 0.2})


@pytest.mark.second
def test_a_hamiltonian_in_body_momenta_is_that_of_the_lagrangian():
    text = "(Pi_1**2/A + Pi_2**2/B + Pi_3**2/C)/2 + g*rotate_3(R, 0.1, 0.2, 1)"
    system = hamilton("heavy top", (), text, rotations={"R": "Pi"}, A=1.0, B=2.0, C=3.0, g=1.3)
    by_momentum = compiled(system, "svi:4").integrate({"R": ATTITUDE}, {"Pi": INERTIA * OMEGA}, h=0.1, steps=20)
    by_velocity = compiled(TOP, "svi:4").integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1, steps=20)
    np.testing.assert_allclose(by_momentum.rotation(), by_velocity.rotation(), rtol=0, atol=1e-14)


def test_initial_velocities_and_momenta_are_those_of_either_frame():
    stepper = compiled(TOP, "svi:4")
    turned, spin = ATTITUDE.apply(OMEGA), ATTITUDE.apply(INERTIA * OMEGA)
    starts = [
        {"velocity": {"omega": OMEGA}},
        {"velocity": {"omega_space": turned}},
        {"p": {"R": INERTIA * OMEGA}},
        {"p": {"R_space": spin}},
    ]
    ends = [stepper.integrate({"R": ATTITUDE.as_matrix()}, h=0.1, steps=5, **each).rotation()[-1] for each in starts]
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], rtol=0, atol=1e-14)


def test_events_can_set_rates_of_rotations_according_to_the_message():
    event = sc.Event("R_33", then={"omega_4": "0"})
    with pytest.raises(sc.EventError, match="An event can set: omega_1, omega_2, omega_3, p_R_1, p_R_2, p_R_3, "):
        compiled(TOP, "svi:4").integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1, steps=2, events=event)


def test_states_by_name_are_those_of_numbers_in_every_function_of_a_state():
    """Energy and momenta against the formulas of a rigid body; a step, and a solution, against those of numbers."""
    stepper, state = compiled(TOP, "svi:4"), ({"R": ATTITUDE}, {"R": INERTIA * OMEGA})
    start = stepper.start({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1)
    height = (ATTITUDE.as_matrix() @ CENTRE)[2]
    assert stepper.energy(*state) == pytest.approx(OMEGA @ (INERTIA * OMEGA) / 2 + 1.3 * height, rel=1e-14)
    np.testing.assert_allclose(stepper.momentum({"R": ATTITUDE}, {"omega": OMEGA}), start.p, rtol=0, atol=1e-14)
    np.testing.assert_allclose(stepper.velocity(*state), start.velocity, rtol=0, atol=1e-14)
    vertical = ATTITUDE.apply(INERTIA * OMEGA)[2]
    assert stepper.momentum_maps(*state)[0] == pytest.approx(vertical, rel=1e-14)
    np.testing.assert_allclose(stepper.step(*state, 0.1), stepper.step(start.q, start.p, 0.1), rtol=0, atol=1e-14)
    mixed = stepper.integrate(start.q, velocity={"omega": OMEGA}, t_end=0.2)
    solution = sc.solve_ivp(stepper, (0, 0.2), {"R": ATTITUDE}, velocity={"omega": OMEGA})
    np.testing.assert_allclose(solution.y[:, -1], np.concatenate([mixed.q[-1], mixed.p[-1]]), rtol=0, atol=1e-14)


EVENTS = ["R_33 - 0.5", "omega_1", "p_R_1", "rotate_3(R, 0, 0, 2) - 1"]


@pytest.mark.full
def test_an_event_sets_an_angular_momentum():
    event = sc.Event("t - 0.15", then={"p_R_2": "-p_R_2"})
    start = {"q": {"R": ATTITUDE}, "velocity": {"omega": OMEGA}, "h": 0.1}
    run = compiled(TOP, "svi:6").integrate(**start, t_end=0.15 + 1e-9, events=event)
    before = compiled(TOP, "svi:6").integrate(**start, t_end=0.15).body_momentum()[-1]
    np.testing.assert_allclose(run.body_momentum()[-1], before * [1, -1, 1], rtol=0, atol=1e-7)


@pytest.mark.rotated
def test_events_are_found_in_the_names_of_rotations():
    run = compiled(TOP, "svi:6").integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1, steps=60, events=EVENTS)
    tilt, rate, momentum, point = run.events
    np.testing.assert_allclose(momentum.t, rate.t, rtol=0, atol=1e-14)
    np.testing.assert_allclose(point.t, tilt.t, rtol=0, atol=1e-14)
    assert len(tilt.t) > 0
    assert len(rate.t) > 0
    by_states = compiled(TOP, "svi:6")
    for t in tilt.t:
        end = by_states.integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, t_end=float(t))
        assert abs(end.rotation()[-1, 2, 2] - 0.5) < 1e-9
    for t in rate.t:
        end = by_states.integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, t_end=float(t))
        assert abs(end.angular_velocity()[-1, 0]) < 1e-9


def test_unrotate_is_the_inverse_of_rotate():
    names = RotationNames.declared({"R": "omega"})
    inner = ", ".join(f"unrotate_{k}(R, 1, 2, 3)" for k in (1, 2, 3))
    rng = np.random.default_rng(6)
    for k in (1, 2, 3):
        formula = names.in_coordinates(names.read(f"rotate_{k}(R, {inner})", names.symbols))
        values = dict(zip(sorted(formula.free_symbols, key=str), rng.normal(size=4), strict=True))
        assert float(formula.subs(values)) == pytest.approx(k, abs=1e-13)


def test_a_system_in_sympy_is_that_in_text():
    t = sympy.Symbol("t")
    x = sympy.Function("x")(t)
    omega = sympy.symbols("omega_1:4")
    R_33, k = sympy.Symbol("R_33"), sympy.Symbol("k")
    by_sympy = sc.LagrangianSystem.from_sympy(
        name="top on a spring",
        coordinates=[x],
        rotations={"R": "omega"},
        lagrangian=x.diff(t) ** 2 / 2
        - k * x**2
        + (omega[0] ** 2 + 2 * omega[1] ** 2 + 3 * omega[2] ** 2) / 2
        - x * R_33,
        parameters={k: 1.5},
        torques={"R": (0, 0, -omega[2] / 5)},
        forces={x: -x.diff(t)},
    )
    by_text = sc.LagrangianSystem.from_text(
        "top on a spring",
        ["x"],
        "x_dot**2/2 - k*x**2 + (omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2 - x*R_33",
        rotations={"R": "omega"},
        parameters={"k": 1.5},
        torques={"R": ["0", "0", "-omega_3/5"]},
        forces={"x": "-x_dot"},
    )
    assert by_sympy == by_text


DIRECTED = ("spherical", ["q"], "(q_dot**2 + n_1_dot**2 + n_2_dot**2 + n_3_dot**2 - q**2)/2 - n_3*q")


@pytest.mark.rotated
def test_spins_and_directions_of_all_lengths_are_read():
    """Directions have any length, spins keep theirs; a small radial part of typed digits is removed."""
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text(*DIRECTED, directions=["n"]), "svi:1")
    for length in (1e-310, 1e-200, 1.0, 1e200):
        q = {"q": 0, "n": [3 * length, 0, 4 * length]}
        run = stepper.integrate(q, velocity={"q": 0, "n": [0.8, 0, -0.6000001]}, h=0.1, steps=0)
        assert run.direction("n")[0] == pytest.approx([0.6, 0, 0.8], rel=1e-12)
        assert abs(run.velocity[0, 1:] @ run.q[0, 1:]) < 1e-15
    tops = sc.HamiltonianSystem.from_text("spin", ["q"], "(p_q**2 + q**2)/2 + q*s_3 + s_1", spins=["s"])
    stepper = sc.compile_stepper(tops, "svi:1")
    for length in (1e-200, 1.0, 1e200):
        run = stepper.integrate({"q": 0.1, "s": [length, 0, -2 * length]}, {"q": 0}, h=0.1, steps=0)
        assert run.spin("s")[0] == pytest.approx([length, 0, -2 * length], rel=1e-14)
    with pytest.raises(sc.StateError, match="the spin 's' must be finite"):
        stepper.integrate({"q": 0.1, "s": [0, np.nan, 0]}, {"q": 0}, h=0.1, steps=1)
