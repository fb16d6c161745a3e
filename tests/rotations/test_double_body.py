"""Two bodies on ball joints, in two rotations and by constraints in body points: order, energy, momentum, reversal."""

import numpy as np
import pytest
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import scvi_codegen as sc

MASSES, MOMENTS = (1.0, 0.7), np.array([[0.3, 0.4, 0.2], [0.15, 0.1, 0.2]])
CENTRES, SOCKET = np.array([[0.1, 0.0, -0.5], [0.0, 0.1, -0.4]]), np.array([0.1, -0.1, -1.0])
"""Centers of mass in the bodies, from the joints at which they hang, and the joint of the second body in the first."""
GRAVITY = 2.0
ATTITUDES = Rotation.from_euler("XYZ", [[0.4, -0.3, 0.2], [-0.5, 0.2, 0.6]])
RATES = np.array([[0.5, -0.6, 1.2], [-0.8, 0.4, 0.7]])
START = {"q": {"R": ATTITUDES[0], "S": ATTITUDES[1]}, "velocity": {"omega": RATES[0], "nu": RATES[1]}}
SPAN = 2.0


def spinning(name, moments):
    return " + ".join(f"{moment}*{name}_{k}**2/2" for k, moment in enumerate(moments, 1))


def moving(rotation, rate, point):
    """Return the velocities of a body point relative to the origin of the body, in space."""
    x, y, z = map(repr, map(float, point))
    arm = f"{rate}_2*{z} - {rate}_3*{y}, {rate}_3*{x} - {rate}_1*{z}, {rate}_1*{y} - {rate}_2*{x}"
    return [f"rotate_{k}({rotation}, {arm})" for k in (1, 2, 3)]


def placed(rotation, point, k):
    return f"rotate_{k}({rotation}, {', '.join(map(repr, map(float, point)))})"


def two_rotations(gravity=GRAVITY):
    """Return the double body in minimal coordinates."""
    first = moving("R", "omega", CENTRES[0])
    second = [f"{a} + {b}" for a, b in zip(moving("R", "omega", SOCKET), moving("S", "nu", CENTRES[1]), strict=True)]
    kinetic = [f"{m}*({v})**2/2" for m, body in zip(MASSES, (first, second), strict=True) for v in body]
    kinetic += [spinning("omega", MOMENTS[0]), spinning("nu", MOMENTS[1])]
    first, second = placed("R", CENTRES[0], 3), f"({placed('R', SOCKET, 3)} + {placed('S', CENTRES[1], 3)})"
    return sc.LagrangianSystem.from_text(
        "double body",
        rotations={"R": "omega", "S": "nu"},
        lagrangian=f"{' + '.join(kinetic)} - g*({MASSES[0]}*{first} + {MASSES[1]}*{second})",
        parameters={"g": gravity},
    )


def by_constraints():
    """Return the double body with the centers of mass as coordinates and its joints as constraints."""
    names = [f"{axis}{k}" for k in (1, 2) for axis in "xyz"]
    kinetic = [f"{MASSES[i // 3]}*{name}_dot**2/2" for i, name in enumerate(names)]
    kinetic += [spinning("omega", MOMENTS[0]), spinning("nu", MOMENTS[1])]
    joints = [f"{axis}1 - {placed('R', CENTRES[0], k)} = 0" for k, axis in enumerate("xyz", 1)]
    joints += [
        f"{axis}1 + {placed('R', SOCKET - CENTRES[0], k)} = {axis}2 - {placed('S', CENTRES[1], k)}"
        for k, axis in enumerate("xyz", 1)
    ]
    return sc.LagrangianSystem.from_text(
        "double body by constraints",
        names,
        f"{' + '.join(kinetic)} - g*({MASSES[0]}*z1 + {MASSES[1]}*z2)",
        rotations={"R": "omega", "S": "nu"},
        constraints=joints,
        parameters={"g": GRAVITY},
    )


def start_by_constraints():
    """Return the initial state with the positions and velocities of the centers of mass."""
    first, second = ATTITUDES.as_matrix()
    positions = [first @ CENTRES[0], first @ SOCKET + second @ CENTRES[1]]
    arms = [np.cross(RATES[0], CENTRES[0]), np.cross(RATES[0], SOCKET), np.cross(RATES[1], CENTRES[1])]
    velocities = [first @ arms[0], first @ arms[1] + second @ arms[2]]
    names = [f"{axis}{k}" for k in (1, 2) for axis in "xyz"]
    q, v = (dict(zip(names, np.ravel(each), strict=True)) for each in (positions, velocities))
    return {"q": START["q"] | q, "velocity": START["velocity"] | v}


@pytest.fixture(scope="module")
def expected():
    """Return both matrices at the end, by the Newton-Euler equations with joint forces, and SciPy."""

    def rates(_, y):
        turns, rates = Rotation.from_quat(y[:8].reshape(2, 4)), y[8:].reshape(2, 3)
        matrices = turns.as_matrix()
        matrix, load = np.zeros((12, 12)), np.zeros(12)  # accelerations of both bodies, forces at both joints
        arms = [[(1, -CENTRES[0]), (-1, SOCKET - CENTRES[0])], [(0, np.zeros(3)), (1, -CENTRES[1])]]
        for b in (0, 1):
            matrix[3 * b : 3 * b + 3, 3 * b : 3 * b + 3] = np.diag(MOMENTS[b])
            load[3 * b : 3 * b + 3] = -np.cross(rates[b], MOMENTS[b] * rates[b])
            for f, (sign, arm) in enumerate(arms[b]):
                matrix[3 * b : 3 * b + 3, 6 + 3 * f : 9 + 3 * f] = -sign * hat(arm) @ matrices[b].T
        chains = [[(0, CENTRES[0])], [(0, SOCKET), (1, CENTRES[1])]]
        for b, chain in enumerate(chains):  # m a - forces = weight
            rows = slice(6 + 3 * b, 9 + 3 * b)
            for c, point in chain:
                matrix[rows, 3 * c : 3 * c + 3] -= MASSES[b] * matrices[c] @ hat(point)
                load[rows] -= MASSES[b] * matrices[c] @ np.cross(rates[c], np.cross(rates[c], point))
            for f, (sign, _) in enumerate(arms[b]):
                matrix[rows, 6 + 3 * f : 9 + 3 * f] -= sign * np.eye(3)
            load[rows] += MASSES[b] * np.array([0, 0, -GRAVITY])
        q = y[:8].reshape(2, 4)
        turned = np.column_stack([np.cross(q[:, :3], rates) + q[:, 3:] * rates, -np.sum(q[:, :3] * rates, axis=1)]) / 2
        return np.concatenate([turned.ravel(), np.linalg.solve(matrix, load)[:6]])

    start = np.concatenate([ATTITUDES.as_quat().ravel(), RATES.ravel()])
    end = solve_ivp(rates, (0, SPAN), start, method="DOP853", rtol=3e-14, atol=1e-15).y[:8, -1]
    return Rotation.from_quat(end.reshape(2, 4)).as_matrix()


def hat(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def order_of(system, method, counts, start, expected):
    stepper, errors = sc.compile_stepper(system, method, flags=QUICK_FLAGS), []
    for steps in counts:
        run = stepper.integrate(**start, h=SPAN / steps, steps=steps)
        errors.append(
            max(np.abs(run.rotation(name)[-1] - each).max() for name, each in zip("RS", expected, strict=True))
        )
    assert 1e-12 < errors[1] < 3e-3, errors
    return np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])


FULL = pytest.mark.full
COUNTS = {1: (400, 800), 2: (60, 120), 3: (32, 48), 4: (20, 30), 5: (5, 14), 6: (4, 12)}


@pytest.mark.full
@pytest.mark.parametrize("degree", [2, *(pytest.param(degree, marks=FULL) for degree in (1, 3, 4, 5, 6))])
def test_the_order_in_two_rotations_is_twice_the_degree(degree, expected):
    order = order_of(two_rotations(), f"svi:{degree}", COUNTS[degree], START, expected)
    assert abs(order - 2 * degree) < (0.5 if degree < 5 else 0.9)


@pytest.mark.parametrize(
    ("degree", "counts"),
    [(2, (40, 80)), *(pytest.param(*each, marks=FULL) for each in ((1, (60, 120)), (3, (16, 32)), (4, (20, 26))))],
)
def test_the_order_with_joints_as_constraints_is_twice_the_degree(degree, counts, expected):
    order = order_of(by_constraints(), f"svi:{degree}", counts, start_by_constraints(), expected)
    assert abs(order - 2 * degree) < 0.5


def momentum(run):
    """Return the angular momentum of both bodies about the fixed joint, in space."""
    rates = [run.angular_velocity(name) for name in "RS"]
    matrices = [run.rotation(name) for name in "RS"]
    total = 0.0
    chains = [[(0, CENTRES[0])], [(0, SOCKET), (1, CENTRES[1])]]
    for b, chain in enumerate(chains):
        position = sum(matrices[c] @ point for c, point in chain)
        velocity = sum(np.einsum("nij,nj->ni", matrices[c], np.cross(rates[c], point)) for c, point in chain)
        spin = np.einsum("nij,nj->ni", matrices[b], rates[b] * MOMENTS[b])
        total = total + MASSES[b] * np.cross(position, velocity) + spin
    return total


@pytest.mark.full
@pytest.mark.parametrize("steps", [10_000, pytest.param(1_000_000, marks=FULL)])
def test_energy_and_momentum_of_the_double_body_do_not_drift(steps):
    stepper = sc.compile_stepper(two_rotations(), "svi:4")
    run = stepper.integrate(**START, h=0.04, steps=steps, save_every=steps // 500)
    energy, vertical = run.energy(), momentum(run)[:, 2]
    first, last = (np.abs(each - energy[0]).max() for each in (energy[:100], energy[-100:]))
    assert last < 3 * first
    assert first < 1e-8
    assert np.abs(vertical - vertical[0]).max() < 2e-13
    assert "angular momentum z" in stepper.momentum_map_names


@pytest.mark.full
def test_without_weight_the_whole_angular_momentum_is_fixed_in_space():
    run = sc.compile_stepper(two_rotations(0.0), "svi:3", flags=QUICK_FLAGS).integrate(**START, h=0.05, steps=4000)
    total = momentum(run)
    assert np.abs(total - total[0]).max() < 1e-13


def test_steps_back_return_to_the_start():
    stepper = sc.compile_stepper(two_rotations(), "svi:4", flags=QUICK_FLAGS)
    there = stepper.integrate(**START, h=0.05, steps=200)
    back = stepper.integrate(there.q[-1], there.p[-1], h=-0.05, steps=200)
    for name in "RS":
        np.testing.assert_allclose(back.rotation(name)[-1], there.rotation(name)[0], rtol=0, atol=1e-12)
