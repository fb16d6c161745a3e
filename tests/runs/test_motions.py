"""Orders of convergence and reversal of motions of rigid bodies, directions and spins: motions x methods.

References integrate Newton's and Euler's equations in (x, v, q, omega), or those of directions and spins, by SciPy's
DOP853, or are elliptic functions (``tops``). Nothing of the package occurs in them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from tops import free_top, lagrange_top

import scvi_codegen as sc

ATTITUDE, TURNED = (Rotation.from_euler(axes, [[0.3, 0.8, -0.4]]) for axes in ("zxz", "ZXZ"))
OMEGA, FAST = np.array([0.7, -0.4, 1.5]), np.array([0.7, -0.4, 4.5])


def solve(rates, start, t_end):
    return solve_ivp(rates, (0, t_end), start, method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1]


def euler(torque, omega, inertia):
    return (torque - np.cross(omega, inertia * omega)) / inertia


def bodies(loads, attitudes, omega, x=(), v=(), t_end=2.0):
    """Positions, rotation matrices and angular velocities at the end; loads returns the accelerations."""
    n, b = len(x), len(attitudes)

    def parts(y):
        return y[:n], y[n : 2 * n], y[2 * n : 2 * n + 4 * b].reshape(b, 4), y[2 * n + 4 * b :].reshape(b, 3)

    def rates(t, y):
        x, v, q, w = parts(y)
        linear, angular = loads(t, x, Rotation.from_quat(q).as_matrix(), w)
        turned = np.column_stack([np.cross(q[:, :3], w) + q[:, 3:] * w, -np.sum(q[:, :3] * w, axis=1)]) / 2
        return np.concatenate([v, linear, turned.ravel(), np.ravel(angular)])

    x, _, q, w = parts(solve(rates, np.concatenate([x, v, attitudes.as_quat().ravel(), np.ravel(omega)]), t_end))
    return [x, *Rotation.from_quat(q).as_matrix(), *w]


@dataclass(frozen=True, eq=False)
class Motion:
    system: object
    expected: Callable[[], list]
    q: dict
    velocity: dict | None
    t_end: float = 2.0
    names: tuple[str, ...] = ("R",)
    coordinates: int = 0
    read: Callable[[object, int], object] | None = None

    def run(self, stepper, steps):
        return stepper.integrate(self.q, velocity=self.velocity, h=self.t_end / steps, steps=steps)

    def state(self, run, row=-1):
        if self.read:
            return np.ravel(self.read(run, row))
        turning = [function(name)[row] for function in (run.rotation, run.angular_velocity) for name in self.names]
        return np.concatenate([run.q[row, : self.coordinates], *map(np.ravel, turning)])


def body(name, lagrangian, coordinates=(), **more):
    return sc.LagrangianSystem.from_text(
        name, coordinates=list(coordinates), **{"rotations": {"R": "omega"}} | more, lagrangian=lagrangian
    )


def top(moments, potential="0", name="top", **more):
    energy = " + ".join(f"{moment}*omega_{k}**2/2" for k, moment in enumerate(moments, 1))
    return body(name, f"{energy} - ({potential})", **more)


INERTIA, CENTRE, ROTOR = np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 1.0]), np.array([0.3, -0.2, 0.9])
TOP = top((1, 2, 3), "1.3*rotate_3(R, 0.1, 0.2, 1)", "heavy top")
DRIVEN = {
    "torques": {"R": ["cos(t)", "0", "-omega_3/5"]},
    "torques_space": {"R": ["0", "1/2", "0"]},
    "dissipation": "omega_1**2/20 + omega_2**2/20",
}


def one_body(torque):
    """Reference of a body with a torque (t, R, omega) in the body frame."""

    def loads(t, x, R, w):
        return [], euler(torque(t, R[0], w[0]), w[0], INERTIA)

    return lambda: bodies(loads, ATTITUDE, OMEGA)


def driving_torque(t, R, w):
    return np.array([np.cos(t), 0, -w[2] / 5]) + R.T @ [0, 0.5, 0] - np.array([w[0], w[1], 0]) / 10


def gravity(t, R, w):
    return np.cross(CENTRE, -1.3 * R.T @ [0, 0, 1])


def by_elliptic_functions(kind):
    def expected():
        if kind == "free":
            return [[], *free_top((1, 2, 3), OMEGA, TURNED.as_matrix()[0], 4.0)]
        return [[], *lagrange_top((2, 1), 1.5, (0.3, 0.8, -0.4), FAST, 4.0)]

    return expected


def distance(sign):
    entries = " + ".join(f"({x} {sign} R_{k}3/10)**2" for k, x in enumerate("xyz", 1))
    return f"1/(2*sqrt({entries}))"


DUMBBELL = body(
    "dumbbell in a central field",
    "(x_dot**2 + y_dot**2 + z_dot**2)/2 + (omega_1**2 + omega_2**2)/200 + omega_3**2/400"
    f" + {distance('+')} + {distance('-')}",
    "xyz",
)


def dumbbell_loads(t, x, R, w):
    force, torque = np.zeros(3), np.zeros(3)
    for end in ([0, 0, 0.1], [0, 0, -0.1]):
        place = x + R[0] @ end
        pull = -place / np.linalg.norm(place) ** 3 / 2
        force, torque = force + pull, torque + np.cross(end, R[0].T @ pull)
    return force, euler(torque, w[0], np.array([0.01, 0.01, 0.005]))


BALL = body(
    "Chaplygin's ball",
    "(x_dot**2 + y_dot**2)/2 + (omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/10",
    "xy",
    constraints=["x_dot = rotate_2(R, omega_1, omega_2, omega_3)", "y_dot = -rotate_1(R, omega_1, omega_2, omega_3)"],
)
"""Ball with unequal moments of inertia that rolls without slipping."""
ROLLING = np.array([0.5, 1.0, -0.3])


def ball_loads(t, x, R, w):
    """The angular momentum about the contact, (I + 1 - e e') omega with the vertical e, is fixed in space."""
    (w,), e = w, R[0][2]
    moment, rate = np.diag([1.2, 1.4, 1.6]) - np.outer(e, e), np.cross(e, w)
    changing = np.outer(rate, e) + np.outer(e, rate)
    return [], np.linalg.solve(moment, changing @ w - np.cross(w, moment @ w))


def rolling():
    sideways = ATTITUDE.apply(ROLLING)[0]
    return {"x": sideways[1], "y": -sideways[0], "omega": ROLLING}


MASSES, MOMENTS = (1.0, 0.7), np.array([[0.3, 0.4, 0.2], [0.15, 0.1, 0.2]])
CENTRES, SOCKET = np.array([[0.1, 0.0, -0.5], [0.0, 0.1, -0.4]]), np.array([0.1, -0.1, -1.0])
"""Two bodies on ball joints: centers of mass from their joints, and the joint of the second in the first."""
CHAINS = [[(0, CENTRES[0])], [(0, SOCKET), (1, CENTRES[1])]]
PAIR = Rotation.from_euler("XYZ", [[0.4, -0.3, 0.2], [-0.5, 0.2, 0.6]])
RATES = np.array([[0.5, -0.6, 1.2], [-0.8, 0.4, 0.7]])
FRAMES = {"rotations": {"R": "omega", "S": "nu"}, "parameters": {"g": 2.0}}
SPINNING = " + ".join(f"{MOMENTS[b][k]}*{w}_{k + 1}**2/2" for b, w in enumerate(["omega", "nu"]) for k in range(3))


def placed(chain, k):
    return " + ".join(f"rotate_{k}({'RS'[c]}, {', '.join(map(repr, map(float, point)))})" for c, point in chain)


def moving(chain, k):
    """Velocity of the end of a chain of points: sum R (omega x point)."""
    terms = []
    for c, point in chain:
        w, (x, y, z) = ("omega", "nu")[c], map(repr, map(float, point))
        terms.append(f"rotate_{k}({'RS'[c]}, {w}_2*{z} - {w}_3*{y}, {w}_3*{x} - {w}_1*{z}, {w}_1*{y} - {w}_2*{x})")
    return " + ".join(terms)


KINETIC = " + ".join(
    f"{m}*({moving(chain, k)})**2/2" for m, chain in zip(MASSES, CHAINS, strict=True) for k in (1, 2, 3)
)
WEIGHT = " + ".join(f"{m}*({placed(chain, 3)})" for m, chain in zip(MASSES, CHAINS, strict=True))
DOUBLE = body("double body", f"{KINETIC} + {SPINNING} - g*({WEIGHT})", **FRAMES)
NAMES = [f"{axis}{b}" for b in (1, 2) for axis in "xyz"]
JOINTED = body(
    "double body by constraints",
    " + ".join(f"{MASSES[i // 3]}*{name}_dot**2/2" for i, name in enumerate(NAMES))
    + f" + {SPINNING} - g*({MASSES[0]}*z1 + {MASSES[1]}*z2)",
    NAMES,
    constraints=[
        *(f"{axis}1 - {placed(CHAINS[0], k)} = 0" for k, axis in enumerate("xyz", 1)),
        *(
            f"{axis}1 + {placed([(0, SOCKET - CENTRES[0])], k)} = {axis}2 - {placed([(1, CENTRES[1])], k)}"
            for k, axis in enumerate("xyz", 1)
        ),
    ],
    **FRAMES,
)


def double_loads(t, x, R, w):
    """Newton's and Euler's equations of both bodies, with the forces of both joints as unknowns."""
    matrix, load = np.zeros((12, 12)), np.zeros(12)
    arms = [[(1, -CENTRES[0]), (-1, SOCKET - CENTRES[0])], [(0, np.zeros(3)), (1, -CENTRES[1])]]
    for b, chain in enumerate(CHAINS):
        turning, rows = slice(3 * b, 3 * b + 3), slice(6 + 3 * b, 9 + 3 * b)
        matrix[turning, turning], load[turning] = np.diag(MOMENTS[b]), -np.cross(w[b], MOMENTS[b] * w[b])
        for f, (sign, arm) in enumerate(arms[b]):
            matrix[turning, 6 + 3 * f : 9 + 3 * f] = -sign * hat(arm) @ R[b].T
            matrix[rows, 6 + 3 * f : 9 + 3 * f] = -sign * np.eye(3)
        for c, point in chain:
            matrix[rows, 3 * c : 3 * c + 3] -= MASSES[b] * R[c] @ hat(point)
            load[rows] -= MASSES[b] * R[c] @ np.cross(w[c], np.cross(w[c], point))
        load[rows] += MASSES[b] * np.array([0, 0, -2.0])
    return [], np.linalg.solve(matrix, load)[:6]


def hat(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def double_body(system, q=None, velocity=None):
    start = {"R": PAIR[0], "S": PAIR[1]} | (q or {}), {"omega": RATES[0], "nu": RATES[1]} | (velocity or {})
    return Motion(system, lambda: bodies(double_loads, PAIR, RATES), *start, names=("R", "S"))


def centres_of_mass():
    R = PAIR.as_matrix()
    positions = [sum(R[c] @ point for c, point in chain) for chain in CHAINS]
    velocities = [sum(R[c] @ np.cross(RATES[c], point) for c, point in chain) for chain in CHAINS]
    return (dict(zip(NAMES, np.ravel(each), strict=True)) for each in (positions, velocities))


N, V = np.array([1.0, 0, 0]), np.array([0, 0.8, 0.3])
SPINS = np.random.default_rng(3).normal(size=(3, 3))
ALL_SPINS = np.random.default_rng(2).normal(size=(5, 3))
WEIGHTS = np.array([1.0, 1.0, 1.3])


def pendulum_rates(t, y):
    n, v, pull = y[:3], y[3:], np.array([0, 0, -2.0])
    return np.concatenate([v, pull - n * (n @ pull) - n * (v @ v)])


def spin_rates(t, y):
    """ds/dt = grad H x s with the brackets {s_1, s_2} = s_3, of a chain with ends."""
    s = y.reshape(3, 3)
    gradient = np.array([[0, 0, 0.2], [0, 0.25, 0], [0, 0, 0]])
    gradient[:-1] += WEIGHTS * s[1:]
    gradient[1:] += WEIGHTS * s[:-1]
    return np.cross(gradient, s).ravel()


def ring_rates(t, y):
    s = y.reshape(5, 3)
    field = np.roll(s, 1, axis=0) + np.roll(s, -1, axis=0) + np.array([0, 0, 0.8]) * s + [0.7, 0, 0]
    return np.cross(s, field).ravel()


PAIRS = " + ".join(f"a{i}_1*a{i + 1}_1 + a{i}_2*a{i + 1}_2 + 1.3*a{i}_3*a{i + 1}_3" for i in (0, 1))
NEIGHBOURS = " + ".join(f"s_{k}[i]*s_{k}[i+1]" for k in (1, 2, 3))
CHAIN = sc.HamiltonianSystem.from_text("spin chain", spins=["a0", "a1", "a2"], hamiltonian=f"{PAIRS} + a0_3/5 + a1_2/4")
RING = sc.HamiltonianSystem.from_text(
    "anisotropic chain",
    hamiltonian=f"-sum(i in 5 periodic, {NEIGHBOURS}) - sum(i in 5, 0.4*s_3[i]**2 + 0.7*s_1[i])",
    spins=["s[5]"],
)
START = {"R": ATTITUDE[0]}, {"omega": OMEGA}
POINT = {"x": 1, "y": 0, "z": 0}
MOTIONS = {
    "heavy top": Motion(TOP, one_body(gravity), *START),
    "driven top": Motion(top((1, 2, 3), **DRIVEN), one_body(driving_torque), *START),
    "gyrostat": Motion(
        top((1, 2, 3), "-0.3*omega_1 + 0.2*omega_2 - 0.9*omega_3"), one_body(lambda t, R, w: np.cross(ROTOR, w)), *START
    ),
    "free top": Motion(top((1, 2, 3)), by_elliptic_functions("free"), {"R": TURNED[0]}, {"omega": OMEGA}, 4.0),
    "Lagrange top": Motion(
        top((2, 2, 1), "3*R_33/2"), by_elliptic_functions("lagrange"), {"R": TURNED[0]}, {"omega": FAST}, 4.0
    ),
    "dumbbell": Motion(
        DUMBBELL,
        lambda: bodies(dumbbell_loads, ATTITUDE, [0.6, 0.4, 1.3], [1, 0, 0], [0, 1, 0.1]),
        POINT | START[0],
        {"x": 0, "y": 1, "z": 0.1, "omega": [0.6, 0.4, 1.3]},
        coordinates=3,
    ),
    "ball": Motion(BALL, lambda: bodies(ball_loads, ATTITUDE, ROLLING), {"x": 0, "y": 0} | START[0], rolling()),
    "double body": double_body(DOUBLE),
    "jointed bodies": double_body(JOINTED, *centres_of_mass()),
    "direction": Motion(
        lagrange("spherical pendulum", (), "(n_1_dot**2 + n_2_dot**2 + n_3_dot**2)/2 - 2*n_3", directions=["n"]),
        lambda: [solve(pendulum_rates, np.r_[N, V], 2)[:3]],
        {"n": N},
        {"n": V},
        read=lambda run, row: run.direction()[row],
    ),
    "spins": Motion(
        CHAIN,
        lambda: solve(spin_rates, SPINS.ravel(), 1).reshape(3, 3),
        {f"a{i}": s for i, s in enumerate(SPINS)},
        None,
        1.0,
        read=lambda run, row: [run.spin(f"a{i}")[row] for i in range(3)],
    ),
    "spin array": Motion(
        RING,
        lambda: [solve(ring_rates, ALL_SPINS.ravel(), 2).reshape(5, 3)],
        {"s": ALL_SPINS},
        None,
        read=lambda run, row: run.spin("s")[row],
    ),
}
COUNTS = {
    "heavy top": {1: (160, 320), 2: (40, 80), 3: (16, 32), 4: (10, 16), 5: (5, 8), 6: (3, 5), 7: (2, 3), 8: (2, 3)},
    "driven top": {2: (40, 80)},
    "gyrostat": {3: (16, 32)},
    "free top": {1: (200, 400), 2: (40, 80), 3: (16, 32), 4: (10, 16), 5: (8, 12), 6: (6, 8), 7: (4, 6), 8: (3, 4)},
    "dumbbell": {1: (64, 128), 2: (20, 40), 3: (12, 24), 4: (10, 20), 5: (4, 10), 6: (3, 8), 7: (3, 5), 8: (2, 4)},
    "ball": {1: (80, 160), 2: (20, 40), 3: (8, 16), 4: (6, 10), 5: (2, 5), 6: (2, 4), 7: (1, 3), 8: (1, 2)},
    "double body": {1: (400, 800), 2: (60, 120), 3: (32, 48), 4: (20, 30), 5: (5, 14), 6: (4, 12)},
    "jointed bodies": {1: (60, 120), 2: (40, 80), 3: (16, 32), 4: (20, 26)},
    "direction": {3: (20, 40)},
    "spins": {2: (20, 40)},
    "spin array": {1: (200, 400), 2: (40, 80), 3: (16, 32), 4: (10, 16), 5: (8, 12), 6: (5, 8), 7: (3, 5), 8: (3, 4)},
}
"""Numbers of steps by degree whose errors are far above those of the references, 1e-14."""
COUNTS["Lagrange top"] = COUNTS["free top"] | {7: (6, 8)}
SHORT = {("heavy top", 2), ("free top", 3), ("Lagrange top", 4), ("ball", 2), ("jointed bodies", 2), ("spin array", 2)}
"""Cases of the default tier, beside those of motions with one degree."""
OTHERS = [
    ("heavy top", "scvi:3", (24, 36), 6),
    ("driven top", "scvi:3", (24, 36), 6),
    ("gyrostat", "scvi:3", (16, 32), 6),
    ("Lagrange top", "stoermer-verlet", (120, 240), 2),
    ("Lagrange top", "composition:8", (16, 24), 8),
    ("heavy top", sc.SVI(2, sc.gauss_legendre(3)), (40, 80), 4),
]
OTHERS_FULL = [
    ("heavy top", "stoermer-verlet", (160, 320), 2),
    ("heavy top", "sc:4", (24, 48), 4),
    ("heavy top", "gauss:2", (40, 80), 4),
    ("heavy top", "composition:4", (40, 80), 4),
    ("heavy top", "composition:8", (14, 20), 8),
]
CASES = [
    *(
        pytest.param(
            name, f"svi:{d}", counts, 2 * d, marks=() if (name, d) in SHORT or len(by) == 1 else pytest.mark.full
        )
        for name, by in COUNTS.items()
        for d, counts in by.items()
    ),
    *OTHERS,
    *(pytest.param(*each, marks=pytest.mark.full) for each in OTHERS_FULL),
]


@cache
def expected_of(name):
    return np.concatenate([np.ravel(each) for each in MOTIONS[name].expected()])


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("name", "method", "counts", "order"), CASES)
def test_motions_converge_with_the_order_of_the_method_and_reverse(name, method, counts, order):
    motion, errors = MOTIONS[name], []
    stepper = sc.compile_stepper(motion.system, sc.as_method(method, motion.system), flags=QUICK_FLAGS)
    for steps in counts:
        run = motion.run(stepper, steps)
        errors.append(np.abs(motion.state(run) - expected_of(name)).max())
    assert 1e-13 < errors[1] < 3e-3, errors
    found = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert order - (0.5 if order < 10 else 2.7) < found < order + (0.5 if order < 10 else 2.1)
    if not sc.as_method(method, motion.system).symmetric:
        return
    back = stepper.integrate(run.q[-1], run.p[-1], h=-motion.t_end / steps, steps=steps, t=motion.t_end)
    np.testing.assert_allclose(motion.state(back), motion.state(run, 0), rtol=0, atol=3e-12)


def energy(run):
    return run.energy()


@pytest.mark.second
def test_states_by_name_are_projected_and_constraints_are_reported_as_written():
    stepper, turning = sc.compile_stepper(BALL, "svi:4", flags=QUICK_FLAGS), ATTITUDE[0].apply(ROLLING)
    assert stepper.constraints[0] == "-R_21*omega_1 - R_22*omega_2 - R_23*omega_3 + x_dot"
    start = {"x": 0, "y": 0, "R": ATTITUDE[0]}
    q, p = stepper.project(start, velocity={"x": 0, "y": 0, "omega": ROLLING})
    assert np.abs(stepper.constraint_values(q, p)[1]).max() < 1e-15
    assert turning[1] * stepper.velocity(q, p)[0] > 0  # it rolls to the same side, more slowly
    with pytest.raises(sc.StateError, match=r"R_13\*omega_3 .* is .*, not 0. Use stepper.project"):
        stepper.integrate(start, {"x": 0, "y": 0, "R": [1, 1, 1]}, h=0.1, steps=1)


@pytest.mark.rotated
def test_a_bound_of_the_global_error_is_confirmed_for_attitudes():
    motion = MOTIONS["heavy top"]
    stepper = sc.compile_stepper(motion.system, "svi:6", flags=QUICK_FLAGS)
    run = stepper.integrate(motion.q, velocity=motion.velocity, t_end=2.0, error=1e-9)
    assert np.abs(motion.state(run) - expected_of("heavy top")).max() < 3e-9
    assert run.confirmed_digits >= 9


@pytest.mark.rotated
def test_the_fast_top_of_bruels_and_cardona_has_the_published_attitude():
    """O. Bruels, A. Cardona, J. Comput. Nonlinear Dyn. 5 (2010) 031002; quaternion at 0.2 s of Exudyn's heavyTop.py."""
    stepper = sc.compile_stepper(top((15.234375, 0.46875, 15.234375), "15*9.81*R_32"), "svi:8", flags=QUICK_FLAGS)
    run = stepper.integrate({"R": [1, 0, 0, 0]}, velocity={"omega": [0, 150, -4.61538]}, h=0.005, steps=40)
    np.testing.assert_allclose(np.abs(run.quaternion()[-1]), [0.70828, 0.43878, 0.54573, 0.0894], rtol=0, atol=6e-6)
    # The third axis of the same top with symmetry axis 3 is the second axis of this one.
    matrix, _ = lagrange_top((15.234375, 0.46875), 15 * 9.81, (np.pi, np.pi / 2, np.pi), [0, 4.61538, 150], 0.2)
    np.testing.assert_allclose(run.rotation()[-1][:, 1], matrix[:, 2], rtol=0, atol=1e-9)
