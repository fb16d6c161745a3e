"""Classical tops: orders against elliptic functions, invariants of integrable cases, two bodies, published numbers."""

import numpy as np
import pytest
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from tops import free_top, lagrange_top

import scvi_codegen as sc

ATTITUDE = Rotation.from_euler("ZXZ", [0.3, 0.8, -0.4])
COUNTS = {1: (200, 400), 2: (40, 80), 3: (16, 32), 4: (10, 16), 5: (8, 12), 6: (6, 8), 7: (4, 6), 8: (3, 4)}
SPAN = 4.0


def top(moments, potential):
    energy = " + ".join(f"{moment}*omega_{k}**2/2" for k, moment in enumerate(moments, 1))
    return sc.LagrangianSystem.from_text("top", rotations={"R": "omega"}, lagrangian=f"{energy} - ({potential})")


def compiled(system, method):
    return sc.compile_stepper(system, method, flags=QUICK_FLAGS)


def vertical(run):
    """Return the vertical of the space frame in the body frame."""
    return run.rotation()[:, 2]


@pytest.mark.parametrize(
    ("kind", "degree"),
    [
        ("free", 3),
        ("lagrange", 4),
        *(
            pytest.param(kind, degree, marks=pytest.mark.full)
            for kind in ("free", "lagrange")
            for degree in range(1, 9)
            if (kind, degree) not in (("free", 3), ("lagrange", 4))
        ),
    ],
)
def test_the_order_is_twice_the_degree_against_elliptic_functions(kind, degree):
    if kind == "free":
        system, omega = top((1, 2, 3), 0), np.array([0.7, -0.4, 1.5])
        matrix, rates = free_top((1, 2, 3), omega, ATTITUDE.as_matrix(), SPAN)
    else:
        system, omega = top((2, 2, 1), "3*R_33/2"), np.array([0.7, -0.4, 4.5])
        matrix, rates = lagrange_top((2, 1), 1.5, (0.3, 0.8, -0.4), omega, SPAN)
    stepper, errors = compiled(system, f"svi:{degree}"), []
    for steps in COUNTS[degree]:
        run = stepper.integrate({"R": ATTITUDE}, velocity={"omega": omega}, h=SPAN / steps, steps=steps)
        errors.append(max(np.abs(run.rotation()[-1] - matrix).max(), np.abs(run.angular_velocity()[-1] - rates).max()))
    order = np.log(errors[0] / errors[1]) / np.log(COUNTS[degree][1] / COUNTS[degree][0])
    assert errors[1] < 3e-3
    assert 2 * degree - (0.4 if degree < 7 else 2.7) < order < 2 * degree + 0.3


def test_kovalevskayas_and_goryachevs_invariants_do_not_drift():
    start = {"q": {"R": ATTITUDE}, "h": 0.1, "steps": 4000, "save_every": 20}
    run = compiled(top((2, 2, 1), "R_31"), "svi:6").integrate(velocity={"omega": [0.7, -0.4, 1.5]}, **start)
    z, gamma = (each[:, 0] + 1j * each[:, 1] for each in (run.angular_velocity(), vertical(run)))
    invariant = np.abs(z**2 - gamma) ** 2
    assert np.abs(invariant - invariant[0]).max() < 2e-12
    assert np.ptp(np.abs(z)) > 0.1
    up = ATTITUDE.as_matrix()[2]
    momentum = np.cross(up, [0.7, -0.4, 1.5])  # no angular momentum about the vertical
    run = compiled(top((4, 4, 1), "R_31"), "svi:6").integrate(p={"R": momentum}, **start)
    omega = run.angular_velocity()
    invariant = omega[:, 2] * (omega[:, 0] ** 2 + omega[:, 1] ** 2) - omega[:, 0] * vertical(run)[:, 2]
    assert np.abs(invariant - invariant[0]).max() < 2e-12
    assert np.ptp(omega[:, 2]) > 0.1


def test_the_fast_top_of_bruels_and_cardona_has_the_published_attitude():
    """O. Bruels, A. Cardona, J. Comput. Nonlinear Dyn. 5 (2010) 031002; quaternion at 0.2 s of Exudyn's heavyTop.py."""
    system = top((15.234375, 0.46875, 15.234375), "15*9.81*R_32")
    omega = np.array([0, 150, -4.61538])
    stepper = compiled(system, "svi:8")
    run = stepper.integrate({"R": [1, 0, 0, 0]}, velocity={"omega": omega}, h=0.005, steps=40)
    np.testing.assert_allclose(np.abs(run.quaternion()[-1]), [0.70828, 0.43878, 0.54573, 0.0894], rtol=0, atol=6e-6)
    # The third axis of the same top with symmetry axis 3 is the second axis of this one.
    matrix, _ = lagrange_top((15.234375, 0.46875), 15 * 9.81, (np.pi, np.pi / 2, np.pi), [0, 4.61538, 150], 0.2)
    np.testing.assert_allclose(run.rotation()[-1][:, 1], matrix[:, 2], rtol=0, atol=1e-9)


PAIR_COUNTS = {1: (64, 128), 2: (20, 40), 3: (12, 24), 4: (12, 20), 5: (5, 8), 6: (4, 8), 7: (2, 4), 8: (2, 4)}
"""Numbers of steps by degree, whose errors are far above that of the reference."""


def pair_of_dumbbells():
    ends = [
        f"(x{i} + {s}*rotate_{i + 1}(R, 0, 0, 1/5) - ({c})*rotate_{i + 1}(S, 1/4, 0, 0))"
        for i in range(3)
        for s in (1, -1)
        for c in (1, -1)
    ]
    distances = [f"sqrt({ends[k]}**2 + {ends[4 + k]}**2 + {ends[8 + k]}**2)" for k in range(4)]
    kinetic = "(x0_dot**2 + x1_dot**2 + x2_dot**2)/4"
    for rate in ("u", "w"):
        kinetic += f" + (2*{rate}_1**2 + 3*{rate}_2**2 + 4*{rate}_3**2)/100"
    return sc.LagrangianSystem.from_text(
        "two bodies",
        ["x0", "x1", "x2"],
        f"{kinetic} + {' + '.join(f'1/(4*{each})' for each in distances)}",
        rotations={"R": "u", "S": "w"},
    )


OTHER = Rotation.from_euler("ZYX", [1.0, 0.2, 0.5])
X, V, U, W = [1.2, 0, 0], [0, 1.3, 0.1], [0.2, 0.4, -0.3], [-0.1, 0.3, 0.6]


@pytest.fixture(scope="module")
def attracted():
    """Distance and rotation matrices of the two dumbbells at t = 2, of Newton's and Euler's equations."""
    moments = np.array([0.04, 0.06, 0.08])

    def rates(_, y):
        turned = [Rotation.from_quat(np.roll(y[6 + 7 * k : 10 + 7 * k], -1)).as_matrix() for k in (0, 1)]
        arms = [np.array([0, 0, 0.2]), np.array([0.25, 0, 0])]
        force, torques = np.zeros(3), [np.zeros(3), np.zeros(3)]
        for s in (1, -1):
            for c in (1, -1):
                between = y[:3] + s * turned[0] @ arms[0] - c * turned[1] @ arms[1]
                pull = -between / 4 / np.linalg.norm(between) ** 3
                force += pull
                torques[0] += np.cross(s * arms[0], turned[0].T @ pull)
                torques[1] -= np.cross(c * arms[1], turned[1].T @ pull)
        result = [y[3:6], 2 * force]
        for k, torque in enumerate(torques):
            q, omega = y[6 + 7 * k : 10 + 7 * k], y[10 + 7 * k : 13 + 7 * k]
            result.append(np.append(-q[1:] @ omega, q[0] * omega + np.cross(q[1:], omega)) / 2)
            result.append((torque - np.cross(omega, moments * omega)) / moments)
        return np.concatenate(result)

    quaternions = [np.roll(each.as_quat(), 1) for each in (ATTITUDE, OTHER)]
    start = np.concatenate([X, V, quaternions[0], U, quaternions[1], W])
    end = solve_ivp(rates, (0, 2), start, method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1]
    return end[:3], *(Rotation.from_quat(np.roll(end[6 + 7 * k : 10 + 7 * k], -1)).as_matrix() for k in (0, 1))


def attraction(stepper, steps):
    return stepper.integrate(
        {"x0": X[0], "x1": X[1], "x2": X[2], "R": ATTITUDE, "S": OTHER},
        velocity={"x0": V[0], "x1": V[1], "x2": V[2], "u": U, "w": W},
        h=2 / steps,
        steps=steps,
    )


def attraction_error(run, expected):
    found = run.q[-1, :3], run.rotation("R")[-1], run.rotation("S")[-1]
    return max(np.abs(one - other).max() for one, other in zip(found, expected, strict=True))


@pytest.mark.full
@pytest.mark.parametrize(("degree", "counts"), PAIR_COUNTS.items())
def test_the_order_on_two_rigid_bodies_is_twice_the_degree(degree, counts, attracted):
    """Full two-body problem of two dumbbells, against Euler's and Newton's equations in (x, v, q, omega)."""
    stepper = compiled(pair_of_dumbbells(), f"svi:{degree}")
    runs = [attraction(stepper, steps) for steps in counts]
    errors = [attraction_error(run, attracted) for run in runs]
    order = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert errors[1] > 2e-13
    assert abs(order - 2 * degree) < (0.5 if degree < 5 else 1.5)
    run = runs[1]
    total = np.cross(run.q[:, :3], run.p[:, :3]) + run.angular_momentum("R") + run.angular_momentum("S")
    np.testing.assert_allclose(total, total[:1].repeat(len(total), 0), rtol=0, atol=1e-14)
