"""Rigid bodies, directions and spins: order, invariants and symplecticity on T*SO(3), against independent integrations.

References integrate Euler's equations for (q, omega), in which nothing of the package occurs, by SciPy's DOP853.
"""

import numpy as np
import pytest
import sympy
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import scvi_codegen as sc
from scvi_codegen.errors import ExpressionError, StateError, SystemDefinitionError
from scvi_codegen.formulas.rotations import RotationNames
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.methods import SVI, as_method
from scvi_codegen.methods.discretise import discretised_form
from scvi_codegen.runtime.rotations.quantities import spins
from scvi_codegen.runtime.rotations.states import state_by_name
from scvi_codegen.tables.quadrature import gauss_legendre

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


def reference(torque, t_end, omega=OMEGA, attitude=ATTITUDE, inertia=INERTIA):
    """Rotation matrix and angular velocity of Euler's equations with a torque (R, omega, t) in the body frame."""

    def rates(t, y):
        q, rate = y[:4], y[4:]
        w, v = q[0], q[1:]
        turned = np.concatenate([[-v @ rate], w * rate + np.cross(v, rate)]) / 2
        matrix = Rotation.from_quat(np.roll(q, -1)).as_matrix()
        return np.concatenate([turned, (torque(matrix, rate, t) - np.cross(rate, inertia * rate)) / inertia])

    start = np.concatenate([np.roll(attitude.as_quat(), 1), omega])
    end = solve_ivp(rates, (0, t_end), start, method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1]
    return Rotation.from_quat(np.roll(end[:4], -1)).as_matrix(), end[4:]


def gravity(matrix, rate, t):
    return np.cross(CENTRE, -1.3 * matrix.T @ [0.0, 0.0, 1.0])


def error_of(run, expected):
    matrix, omega = expected
    return max(np.abs(run.rotation()[-1] - matrix).max(), np.abs(run.angular_velocity()[-1] - omega).max())


def orders(stepper, counts, t_end, expected):
    errors = [
        error_of(stepper.integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=t_end / n, steps=n), expected)
        for n in counts
    ]
    assert errors[-1] > 5e-13, errors
    return np.log(errors[-2] / errors[-1]) / np.log(counts[-1] / counts[-2])


COUNTS = {1: (160, 320), 2: (40, 80), 3: (16, 32), 4: (10, 16), 5: (5, 8), 6: (3, 5), 7: (2, 3), 8: (2, 3)}
"""Numbers of steps whose errors are far above that of the reference, 1e-14."""


@pytest.mark.parametrize(
    "degree", [2, *(pytest.param(degree, marks=pytest.mark.full) for degree in (1, 3, 4, 5, 6, 7, 8))]
)
def test_order_is_twice_the_degree_on_the_heavy_top(degree):
    order = orders(compiled(TOP, f"svi:{degree}"), COUNTS[degree], 2.0, reference(gravity, 2.0))
    assert 2 * degree - (0.15 if degree < 5 else 0.8) < order < 2 * degree + 0.3


@pytest.mark.parametrize(
    ("method", "counts", "order"),
    [
        ("scvi:3", (24, 36), 6),
        pytest.param("stoermer-verlet", (160, 320), 2, marks=pytest.mark.full),
        pytest.param("sc:4", (24, 48), 4, marks=pytest.mark.full),
        pytest.param("gauss:2", (40, 80), 4, marks=pytest.mark.full),
    ],
)
def test_other_methods_have_their_order_on_the_heavy_top(method, counts, order):
    assert abs(orders(compiled(TOP, method), counts, 2.0, reference(gravity, 2.0)) - order) < 0.35


def test_methods_with_as_many_points_as_degree_take_the_hamiltonian():
    methods = {name: as_method(name) for name in ("svi:3", "gauss:2", "scvi:3", "sc:3", "stoermer-verlet")}
    forms = {name: isinstance(discretised_form(TOP, method), HamiltonianSystem) for name, method in methods.items()}
    assert forms == {"svi:3": True, "gauss:2": True, "scvi:3": False, "sc:3": False, "stoermer-verlet": True}


def test_the_lagrangian_and_the_hamiltonian_form_agree():
    start = {"q": {"R": ATTITUDE}, "velocity": {"omega": OMEGA}, "h": 0.05, "steps": 40}
    runs = [compiled(TOP, method).integrate(**start) for method in (SVI(6), SVI(6, gauss_legendre(7)))]
    assert np.abs(runs[0].rotation() - runs[1].rotation()).max() < 1e-8


def test_energy_and_vertical_angular_momentum_do_not_drift():
    run = compiled(TOP, "svi:6").integrate(
        {"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1, steps=20_000, save_every=20
    )
    energy, vertical = run.energy(), run.angular_momentum()[:, 2]
    assert np.abs(energy - energy[0]).max() < 2e-11
    assert np.abs(vertical - vertical[0]).max() < 3e-13
    assert run.stepper.momentum_map_names == ("angular momentum z",)
    np.testing.assert_allclose(run.momentum_maps()[:, 0], vertical, rtol=0, atol=1e-13)


def test_angular_momentum_of_a_free_body_is_fixed_in_space():
    free = TOP.with_parameters(g=0.0)
    run = compiled(free, "svi:4").integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.2, steps=5000, save_every=5)
    momentum = run.angular_momentum()
    expected = ATTITUDE.apply(INERTIA * OMEGA)
    assert np.abs(momentum - expected).max() < 2e-13


def test_the_quaternion_is_continuous_where_its_sign_is_not_that_of_the_attitude():
    run = compiled(TOP, "svi:4").integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1, steps=400)
    q = run.quaternion()
    assert (np.linalg.norm(np.diff(q, axis=0), axis=1) < 0.2).all()
    assert q[:, 0].min() < 0 < q[:, 0].max()


def test_a_step_back_returns_to_the_attitude():
    stepper = compiled(TOP, "svi:5")
    there = stepper.integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.3, steps=50)
    back = stepper.integrate(there.q[-1], there.p[-1], h=-0.3, steps=50)
    assert np.abs(back.rotation()[-1] - ATTITUDE.as_matrix()).max() < 1e-12


def rates_matrix(q):
    w, x, y, z = q
    return np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


@pytest.mark.parametrize("method", ["svi:4", pytest.param("scvi:3", marks=pytest.mark.full)])
def test_a_step_is_symplectic_on_the_cotangent_bundle_of_rotations(method):
    """The derivative in (rotation vector of the body frame, body momentum) keeps the form [[-Pi x, 1], [-1, 0]]."""
    stepper = compiled(TOP, method)
    run = stepper.integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.3, steps=1)
    q, p = run.q / np.linalg.norm(run.q, axis=1, keepdims=True), run.p * np.linalg.norm(run.q, axis=1, keepdims=True)
    full = stepper.jacobian(run.q[0], run.p[0], 0.3)

    def form(momentum):
        cross = np.cross(np.eye(3), momentum)  # rows e_k x Pi: the transpose of -hat(Pi)
        return np.block([[cross.T, np.eye(3)], [-np.eye(3), np.zeros((3, 3))]])

    inward = np.zeros((8, 6))
    momentum = run.body_momentum()
    for k, axis in enumerate(np.eye(3)):
        moved = rates_matrix(q[0]) @ axis / 2
        inward[:4, k], inward[4:, k] = moved, 2 * rates_matrix(moved) @ momentum[0]
        inward[4:, 3 + k] = 2 * rates_matrix(q[0]) @ axis
    outward, length = np.zeros((6, 8)), np.linalg.norm(run.q[1])
    outward[:3, :4] = 2 * rates_matrix(q[1]).T / length
    for k, axis in enumerate(np.eye(4)):
        outward[3:, k] = rates_matrix(axis).T @ run.p[1] / 2
    outward[3:, 4:] = rates_matrix(run.q[1]).T / 2
    reduced = outward @ full @ inward
    assert np.abs(reduced.T @ form(momentum[1]) @ reduced - form(momentum[0])).max() < 3e-14
    assert p[0] @ q[0] == pytest.approx(0, abs=1e-15)


def test_torques_in_the_body_and_in_the_space_frame_and_dissipation_act():
    system = sc.LagrangianSystem.from_text(
        "driven top",
        rotations={"R": "omega"},
        lagrangian="(omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2",
        torques={"R": ["cos(t)", "0", "-omega_3/5"]},
        torques_space={"R": ["0", "1/2", "0"]},
        dissipation="omega_1**2/20 + omega_2**2/20",
    )

    def torque(matrix, rate, t):
        return np.array([np.cos(t), 0, -rate[2] / 5]) + matrix.T @ [0, 0.5, 0] - np.array([rate[0], rate[1], 0]) / 10

    for method, counts in (("svi:2", (40, 80)), ("scvi:3", (24, 36))):
        order = orders(compiled(system, method), counts, 2.0, reference(torque, 2.0))
        assert abs(order - (4 if method == "svi:2" else 6)) < 0.4


DUMBBELL = sc.LagrangianSystem.from_text(
    "dumbbell in a central field",
    ["x", "y", "z"],
    "(x_dot**2 + y_dot**2 + z_dot**2)/2 + (omega_1**2 + omega_2**2)/200 + omega_3**2/400"
    " + 1/(2*sqrt((x + rotate_1(R, 0, 0, 1/10))**2 + (y + rotate_2(R, 0, 0, 1/10))**2"
    " + (z + rotate_3(R, 0, 0, 1/10))**2))"
    " + 1/(2*sqrt((x - R_13/10)**2 + (y - R_23/10)**2 + (z - R_33/10)**2))",
    rotations={"R": "omega"},
)


@pytest.fixture(scope="module")
def orbiting():
    """Position, rotation matrix and angular velocity of the dumbbell at t = 2, of Newton's and Euler's equations."""
    moments = np.array([0.01, 0.01, 0.005])

    def rates(_, y):
        x, q, rate = y[:3], y[6:10], y[10:]
        matrix, force, torque = Rotation.from_quat(np.roll(q, -1)).as_matrix(), np.zeros(3), np.zeros(3)
        for end in ([0, 0, 0.1], [0, 0, -0.1]):
            place = x + matrix @ end
            pull = -place / np.linalg.norm(place) ** 3 / 2
            force, torque = force + pull, torque + np.cross(end, matrix.T @ pull)
        turned = np.append(-q[1:] @ rate, q[0] * rate + np.cross(q[1:], rate)) / 2
        return np.concatenate([y[3:6], force, turned, (torque - np.cross(rate, moments * rate)) / moments])

    start = np.concatenate([[1, 0, 0, 0, 1, 0.1], np.roll(ATTITUDE.as_quat(), 1), [0.6, 0.4, 1.3]])
    y = solve_ivp(rates, (0, 2), start, method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1]
    return y[:3], Rotation.from_quat(np.roll(y[6:10], -1)).as_matrix(), y[10:]


DUMBBELL_COUNTS = {1: (64, 128), 2: (20, 40), 3: (12, 24), 4: (10, 20), 5: (4, 10), 6: (3, 8), 7: (3, 5), 8: (2, 4)}


@pytest.mark.full
@pytest.mark.parametrize("degree", range(1, 9))
def test_the_order_on_a_dumbbell_in_a_central_field_is_twice_the_degree(degree, orbiting):
    stepper, errors, counts = compiled(DUMBBELL, f"svi:{degree}"), [], DUMBBELL_COUNTS[degree]
    for steps in counts:
        run = stepper.integrate(
            {"x": 1, "y": 0, "z": 0, "R": ATTITUDE},
            velocity={"x": 0, "y": 1, "z": 0.1, "omega": [0.6, 0.4, 1.3]},
            h=2 / steps,
            steps=steps,
        )
        errors.append(max(np.abs(run.q[-1, :3] - orbiting[0]).max(), error_of(run, orbiting[1:])))
    order = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert errors[1] > 1e-13
    assert abs(order - 2 * degree) < (0.5 if degree < 5 else 1.2)


def test_the_whole_angular_momentum_of_a_dumbbell_in_a_central_field_is_constant():
    stepper = compiled(DUMBBELL, "svi:6")
    run = stepper.integrate(
        {"x": 1, "y": 0, "z": 0, "R": ATTITUDE},
        velocity={"x": 0, "y": 1, "z": 0.1, "omega": [0.2, 0.4, 0.3]},
        h=0.05,
        steps=2000,
        save_every=10,
    )
    assert stepper.momentum_map_names == (*(f"angular momentum {axis}" for axis in "xyz"), "body momentum 3 of R")
    total = np.cross(run.q[:, :3], run.p[:, :3]) + run.angular_momentum()
    assert np.abs(total - total[0]).max() < 1e-13
    assert np.abs(run.energy() - run.energy()[0]).max() < 1e-11


BALL = sc.LagrangianSystem.from_text(
    "Chaplygin's ball",
    ["x", "y"],
    "(x_dot**2 + y_dot**2)/2 + (omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/10",
    rotations={"R": "omega"},
    constraints=["x_dot = rotate_2(R, omega_1, omega_2, omega_3)", "y_dot = -rotate_1(R, omega_1, omega_2, omega_3)"],
)
"""Ball with unequal moments of inertia that rolls without slipping."""
ROLLING = np.array([0.5, 1.0, -0.3])


def rolled(stepper, h, steps, save_every=1):
    turning = ATTITUDE.apply(ROLLING)
    velocity = {"x": turning[1], "y": -turning[0], "omega": ROLLING}
    return stepper.integrate(
        {"x": 0, "y": 0, "R": ATTITUDE}, velocity=velocity, h=h, steps=steps, save_every=save_every
    )


@pytest.mark.parametrize("steps", [1000, pytest.param(100_000, marks=pytest.mark.full)])
def test_first_integrals_of_chaplygins_ball_are_constant(steps):
    """The angular momentum about the contact point is fixed in space."""
    run = rolled(compiled(BALL, "svi:4"), 0.1, steps, steps // 100)
    omega_in_space = run.angular_velocity(space=True)
    centre = np.stack([omega_in_space[:, 1], -omega_in_space[:, 0], 0 * run.t], axis=1)
    spin = np.einsum("nij,nj->ni", run.rotation(), run.angular_velocity() * [0.2, 0.4, 0.6])
    about_contact = spin + np.cross([0.0, 0.0, 1.0], centre)
    assert np.abs(about_contact - about_contact[0]).max() < 1e-12
    assert np.abs(run.energy() - run.energy()[0]).max() < 1e-13


@pytest.mark.parametrize(
    ("degree", "counts"),
    [
        (2, (20, 40)),
        *(
            pytest.param(*each, marks=pytest.mark.full)
            for each in ((1, (80, 160)), (3, (8, 16)), (4, (6, 10)), (5, (2, 5)), (6, (2, 4)), (7, (1, 3)), (8, (1, 2)))
        ),
    ],
)
def test_the_order_on_chaplygins_ball_is_twice_the_degree(degree, counts):
    stepper, expected = compiled(BALL, f"svi:{degree}"), rolling(ROLLING)
    errors = [error_of(rolled(stepper, 2.0 / steps, steps), expected) for steps in counts]
    assert errors[1] > 2e-13
    bound = 0.5 if degree < 5 else 2.1
    assert abs(np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0]) - 2 * degree) < bound


def rolling(omega):
    """Chaplygin's ball at t = 2: I omega + e x (omega x e) with e the vertical in the body frame is fixed in space."""
    inertia = np.array([0.2, 0.4, 0.6])

    def moment(vertical):
        return np.diag(inertia) + np.eye(3) - np.outer(vertical, vertical)

    start = ATTITUDE.as_matrix()
    fixed = start @ moment(start[2]) @ omega

    def rate_at(matrix):
        return np.linalg.solve(moment(matrix[2]), matrix.T @ fixed)

    def rates(_, y):
        matrix = y.reshape(3, 3)
        return np.cross(matrix, rate_at(matrix)).ravel() * 1.0

    end = solve_ivp(rates, (0, 2), start.ravel(), method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1].reshape(3, 3)
    return end, rate_at(end)


def test_a_direction_is_the_spherical_pendulum():
    system = sc.LagrangianSystem.from_text(
        "spherical pendulum", directions=["n"], lagrangian="(n_1_dot**2 + n_2_dot**2 + n_3_dot**2)/2 - 2*n_3"
    )

    def rates(_, y):
        n, v = y[:3], y[3:]
        pull = np.array([0, 0, -2.0])
        return np.concatenate([v, pull - n * (n @ pull) - n * (v @ v)])

    n0, v0 = np.array([1.0, 0, 0]), np.array([0, 0.8, 0.3])
    expected = solve_ivp(rates, (0, 2), np.r_[n0, v0], method="DOP853", rtol=3e-14, atol=1e-15).y[:3, -1]
    stepper, errors = compiled(system, "svi:3"), []
    for steps in (20, 40):
        run = stepper.integrate({"n": n0}, velocity={"n": v0}, h=2 / steps, steps=steps)
        errors.append(np.abs(run.direction()[-1] - expected).max())
    assert 5.7 < np.log2(errors[0] / errors[1]) < 6.4
    assert stepper.momentum_map_names == ("angular momentum z",)


def test_spins_precess_and_keep_their_length():
    """Heisenberg chain with anisotropy: ds/dt = grad H x s with the brackets {s_1, s_2} = s_3."""
    weights, count = np.array([1.0, 1.0, 1.3]), 3
    pairs = "+".join(f"(a{i}_1*a{i + 1}_1 + a{i}_2*a{i + 1}_2 + 1.3*a{i}_3*a{i + 1}_3)" for i in range(count - 1))
    chain = sc.HamiltonianSystem.from_text(
        "spin chain", spins=[f"a{i}" for i in range(count)], hamiltonian=f"{pairs} + a0_3/5 + a1_2/4"
    )
    rng = np.random.default_rng(3)
    start = rng.normal(size=(count, 3))

    def rates(_, y):
        s = y.reshape(count, 3)
        gradient = np.zeros_like(s)
        gradient[:-1] += weights * s[1:]
        gradient[1:] += weights * s[:-1]
        gradient[0, 2] += 0.2
        gradient[1, 1] += 0.25
        return np.cross(gradient, s).ravel()

    expected = solve_ivp(rates, (0, 1), start.ravel(), method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1].reshape(-1, 3)
    stepper, errors = compiled(chain, "svi:2"), []
    for steps in (20, 40):
        run = stepper.integrate({f"a{i}": s for i, s in enumerate(start)}, h=1 / steps, steps=steps)
        errors.append(max(np.abs(run.spin(f"a{i}")[-1] - expected[i]).max() for i in range(count)))
        for i, s in enumerate(start):
            np.testing.assert_allclose(np.linalg.norm(run.spin(f"a{i}"), axis=1), np.linalg.norm(s), rtol=0, atol=1e-14)
    assert 3.8 < np.log2(errors[0] / errors[1]) < 4.2


def test_velocities_are_rejected_where_there_are_spins():
    """The momenta of spins follow from the spins, not from velocities."""
    system = sc.HamiltonianSystem.from_text("cavity", ["x"], spins=["s"], hamiltonian="(p_x**2 + x**2)/2 + x*s_1 + s_3")
    q, p, _ = state_by_name(system, {"x": 0.1, "s": [0.3, 0.6, 0.8]}, {"x": 0.2}, None)
    np.testing.assert_allclose(spins(q[1:], p[1:]), [0.3, 0.6, 0.8], rtol=0, atol=1e-15)
    with pytest.raises(StateError, match="spins have no velocities: give p"):
        state_by_name(system, {"x": 0.1, "s": [0.3, 0.6, 0.8]}, None, {"x": 0.2})


def test_the_total_spin_of_an_isotropic_pair_is_found():
    pair = sc.HamiltonianSystem.from_text("pair", spins=["a", "b"], hamiltonian="a_1*b_1 + a_2*b_2 + a_3*b_3")
    assert [each.name for each in sc.symmetries(pair)] == [f"angular momentum {axis}" for axis in "xyz"]


def test_a_hamiltonian_in_body_momenta_is_that_of_the_lagrangian():
    system = sc.HamiltonianSystem.from_text(
        "heavy top",
        rotations={"R": "Pi"},
        parameters={"A": 1.0, "B": 2.0, "C": 3.0, "g": 1.3},
        hamiltonian="(Pi_1**2/A + Pi_2**2/B + Pi_3**2/C)/2 + g*rotate_3(R, 0.1, 0.2, 1)",
    )
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rotations": {"R": "omega"}, "lagrangian": "rotate_4(R, 1, 0, 0)"}, "rotate_4' is not a function"),
        ({"rotations": {"R": "omega"}, "lagrangian": "rotate_1(S, 1, 0, 0)"}, "needs a rotation first, not 'S'"),
        ({"rotations": {"R": "omega"}, "lagrangian": "rotate_1(R, 1, 0)"}, "three components, not 2"),
        ({"rotations": {"R": "omega", "S": "omega"}, "lagrangian": "omega_1**2"}, "'omega_1' has two meanings"),
        ({"rotations": ["R"], "lagrangian": "omega_1**2"}, r"rotations must be a mapping .* \{'R': 'omega'\}"),
        ({"rotations": {"R": "omega"}, "lagrangian": "omega**2"}, "'omega' is not a scalar: write .* as omega_1"),
        ({"rotations": {"R": "omega"}, "lagrangian": "omega_1**2 - R"}, "'R' is not a scalar: write .* as R_11"),
        (
            {"rotations": {"R": "omega"}, "lagrangian": "rotate(R, 0, 0, 1)"},
            "'rotate' is not a function: known are rotate_1",
        ),
        (
            {"rotations": {"R": "omega"}, "lagrangian": "R_33", "parameters": {"R_33": 1}},
            "'R_33' is the name of both an entry of a rotation, direction or spin and parameter 'R_33'",
        ),
        (
            {"rotations": {"R": "omega"}, "lagrangian": "R_33", "coordinates": ["R_w"]},
            "'R_w' is the name of both an entry of a rotation, direction or spin and coordinate 'R_w'",
        ),
        (
            {"rotations": {"R": "omega"}, "lagrangian": "omega_1**2", "forces": {"R": "1"}},
            r"force on 'R': write torques=\{'R': \[..\]\}",
        ),
        ({"rotations": {"R": "omega"}, "lagrangian": "omega_1**2", "torques": {"Q": ["1", "0", "0"]}}, "torque on 'Q'"),
        ({"rotations": {"R": "omega"}, "lagrangian": "omega_1**2", "torques": {"R": ["1"]}}, "three components"),
    ],
)
def test_wrong_rotations_are_rejected_by_name(arguments, message):
    with pytest.raises((SystemDefinitionError, ExpressionError), match=message):
        sc.LagrangianSystem.from_text("top", **arguments)


@pytest.mark.parametrize(
    ("q", "velocity", "message"),
    [
        ({"Q": [1, 0, 0, 0]}, {"omega": OMEGA}, "no 'Q' in q"),
        ({}, {"omega": OMEGA}, "'R' is missing in q"),
        ({"R": [1, 0, 0, 0]}, {}, "'omega' is missing in velocity"),
        ({"R": [1, 0, 0, 0]}, {"omega": [1, 2]}, "three finite components"),
        ({"R": [1, 0, 0, 0]}, {"omega": [1, np.nan, 2]}, "'omega' must have three finite components"),
        ({"R": [1, 0, 0, 0]}, {"omega": OMEGA, "omega_space": OMEGA}, "both 'omega' and 'omega_space'"),
        ([1, 0, 0], {"omega": OMEGA}, "require q by name"),
        ({"R": [1, 0, 0, 0]}, {"R": [1, 2, 3]}, "no 'R' in velocity"),
    ],
)
def test_wrong_states_are_rejected_by_name(q, velocity, message):
    with pytest.raises(StateError, match=message):
        compiled(TOP, "svi:4").integrate(q, velocity=velocity, h=0.1, steps=2)


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
    mixed = stepper.integrate(start.q, velocity={"omega": OMEGA}, h=0.1, steps=2)
    solution = sc.solve_ivp(stepper, (0, 0.2), {"R": ATTITUDE}, velocity={"omega": OMEGA}, h=0.1)
    np.testing.assert_allclose(solution.y[:, -1], np.concatenate([mixed.q[-1], mixed.p[-1]]), rtol=0, atol=1e-14)


def test_states_by_name_are_projected_and_constraints_are_reported_as_written():
    stepper, turning = compiled(BALL, "svi:4"), ATTITUDE.apply(ROLLING)
    assert stepper.constraints[0] == "-R_21*omega_1 - R_22*omega_2 - R_23*omega_3 + x_dot"
    q, p = stepper.project({"x": 0, "y": 0, "R": ATTITUDE}, velocity={"x": 0, "y": 0, "omega": ROLLING})
    assert np.abs(stepper.constraint_values(q, p)[1]).max() < 1e-15
    assert turning[1] * stepper.velocity(q, p)[0] > 0  # it rolls to the same side, more slowly
    with pytest.raises(StateError, match=r"R_13\*omega_3 .* is .*, not 0. Use stepper.project"):
        stepper.integrate({"x": 0, "y": 0, "R": ATTITUDE}, {"x": 0, "y": 0, "R": [1, 1, 1]}, h=0.1, steps=1)


def test_quaternions_of_bodies_that_also_move_have_constant_norms():
    """The Hamiltonian of a body and a coordinate, whose velocities and forces are evaluated in turn."""
    system = sc.LagrangianSystem.from_text(
        "body on a spring",
        ["x"],
        "(x_dot**2 - x**2)/2 + (omega_1**2 + 1.3*omega_2**2 + 0.5*omega_3**2)/2 + 0.3*x*R_33",
        rotations={"R": "omega"},
    )
    run = compiled(system, "svi:2").integrate(
        {"x": 0.3, "R": ATTITUDE}, velocity={"x": 0, "omega": OMEGA}, h=0.1, steps=200
    )
    q, p = run.q[:, 1:], run.p[:, 1:]
    np.testing.assert_allclose((q**2).sum(axis=1), 1, rtol=0, atol=1e-14)
    assert np.abs((q * p).sum(axis=1)).max() < 1e-13
    assert np.ptp(run.angular_momentum()[:, 2]) < 1e-13


def test_an_ensemble_has_the_attitudes_of_single_runs():
    stepper = compiled(TOP, "svi:4")
    attitudes = Rotation.random(5, random_state=4)
    rates = np.random.default_rng(5).normal(size=(5, 3))
    together = stepper.integrate_ensemble({"R": attitudes}, velocity={"omega": rates}, h=0.1, steps=20)
    for k in range(5):
        alone = stepper.integrate({"R": attitudes[k]}, velocity={"omega": rates[k]}, h=0.1, steps=20)
        np.testing.assert_allclose(together.rotation()[:, k], alone.rotation(), rtol=0, atol=1e-13)
        np.testing.assert_allclose(together.angular_momentum()[:, k], alone.angular_momentum(), rtol=0, atol=1e-13)
        np.testing.assert_allclose(together.angular_velocity()[:, k], alone.angular_velocity(), rtol=0, atol=1e-13)


EVENTS = ["R_33 - 0.5", "omega_1", "p_R_1", "rotate_3(R, 0, 0, 2) - 1"]


@pytest.mark.full
def test_an_event_sets_an_angular_momentum():
    event = sc.Event("t - 0.15", then={"p_R_2": "-p_R_2"})
    start = {"q": {"R": ATTITUDE}, "velocity": {"omega": OMEGA}, "h": 0.1}
    run = compiled(TOP, "svi:6").integrate(**start, t_end=0.15 + 1e-9, events=event)
    before = compiled(TOP, "svi:6").integrate(**start, t_end=0.15).body_momentum()[-1]
    np.testing.assert_allclose(run.body_momentum()[-1], before * [1, -1, 1], rtol=0, atol=1e-7)


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


def test_a_bound_of_the_global_error_is_confirmed_for_attitudes():
    run = compiled(TOP, "svi:6").integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, t_end=2.0, error=1e-9)
    assert error_of(run, reference(gravity, 2.0)) < 3e-9
    assert run.confirmed_digits >= 9


def test_the_derivation_shows_the_form_that_is_stepped():
    by_momenta = sc.derive(TOP, "svi:1").to_text()
    by_velocities = sc.derive(TOP, SVI(1, gauss_legendre(2))).to_text()
    for text in (by_momenta, by_velocities):
        assert "rotation R = R(q), quaternion q = (R_w, R_x, R_y, R_z) of any length" in text
    assert "\nH = " in by_momenta
    assert "\nL = " in by_velocities


def test_unrotate_is_the_inverse_of_rotate():
    names = RotationNames.declared({"R": "omega"})
    inner = ", ".join(f"unrotate_{k}(R, 1, 2, 3)" for k in (1, 2, 3))
    rng = np.random.default_rng(6)
    for k in (1, 2, 3):
        formula = names.in_coordinates(names.read(f"rotate_{k}(R, {inner})", names.symbols))
        values = dict(zip(sorted(formula.free_symbols, key=str), rng.normal(size=4), strict=True))
        assert float(formula.subs(values)) == pytest.approx(k, abs=1e-13)


@pytest.mark.parametrize("method", ["svi:3", "scvi:3"])
def test_terms_linear_in_the_angular_velocity_act(method):
    """A gyrostat: a rotor with the angular momentum s in the body adds s . omega, and the torque s x omega."""
    rotor = np.array([0.3, -0.2, 0.9])
    system = sc.LagrangianSystem.from_text(
        "gyrostat",
        rotations={"R": "omega"},
        lagrangian="(omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2 + 0.3*omega_1 - 0.2*omega_2 + 0.9*omega_3",
    )
    expected = reference(lambda matrix, rate, t: np.cross(rotor, rate), 2.0)
    assert orders(compiled(system, method), (16, 32), 2.0, expected) == pytest.approx(6, abs=0.3)


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


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (
            {"velocity": {"q": 0, "n": [0, 0.1, 0.3]}},
            r"velocity: 'n' = \[0\.0, 0\.1, 0\.3\] is not tangent .* is 0\.3\.",
        ),
        ({"p": {"q": 0, "n": [0, 0, 1e-200]}}, r"p: 'n' .* not tangent .* give an orthogonal vector"),
        ({"q": {"q": 0, "n": [0, 0, np.nan]}}, "the direction 'n' must be finite"),
        ({"q": {"q": 0, "n": [0, 0, 0]}}, "the direction 'n' must not be zero"),
        ({"q": {"q": 0, "n": [0, 1]}}, "the direction 'n' must have three components"),
    ],
)
def test_states_of_directions_that_are_refused(state, message):
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text(*DIRECTED, directions=["n"]), "svi:1")
    rest = {"velocity": {"q": 0, "n": [0.0, 0, 0]}} if "p" not in state else {}
    with pytest.raises(StateError, match=message):
        stepper.integrate(**{"q": {"q": 0, "n": [0, 0, 1]}, **rest, **state}, h=0.1, steps=1)


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
    with pytest.raises(StateError, match="the spin 's' must be finite"):
        stepper.integrate({"q": 0.1, "s": [0, np.nan, 0]}, {"q": 0}, h=0.1, steps=1)
