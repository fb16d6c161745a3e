"""Paths between two positions: runs, other coordinates, published orbits, exact indices."""

import numpy as np
import pytest
from notation import lagrange
from scipy.special import ellipk

import scvi_codegen as sc
from scvi_codegen.common.errors import MethodError, PathError, StateError
from scvi_codegen.extras.paths import solver
from scvi_codegen.extras.paths.intervals import Intervals, ManyCoordinates

pytestmark = pytest.mark.second

KEPLER = sc.problem("kepler").system


def compiled(coordinates, lagrangian, method="svi:4", **arguments):
    return sc.compile_stepper(sc.LagrangianSystem.from_text("system", coordinates, lagrangian, **arguments), method)


@pytest.fixture(scope="module")
def kepler():
    return sc.compile_stepper(KEPLER, "svi:4")


@pytest.fixture(scope="module")
def oscillator():
    return compiled(["x"], "x_dot**2/2 - x**2/2")


@pytest.mark.quick
def test_path_is_a_run(kepler):
    path = kepler.path([1.0, 0.0], [-0.5, 0.8], 2.0, steps=12)
    run = path.run()
    assert np.allclose(run.q, path.q, rtol=0, atol=1e-12)
    assert np.allclose(run.p, path.p, rtol=0, atol=1e-12)
    assert abs(run.action() - path.action) < 1e-12
    assert path.residual < 1e-12
    assert path.index == 0
    assert np.array_equal(path.q[[0, -1]], [[1.0, 0.0], [-0.5, 0.8]])


@pytest.mark.quick
def test_lambert_problem_of_vallado(kepler):
    """Vallado, Fundamentals of Astrodynamics, example 7-5: 76 min; published v1 = (2.058913, 2.915965) km/s."""
    mu, unit = 398600.4418, 6378.137
    time = np.sqrt(unit**3 / mu)
    r1, r2 = np.array([15945.34, 0.0]) / unit, np.array([12214.83899, 10249.46731]) / unit
    coarse, fine = (kepler.path(r1, r2, 76 * 60 / time, steps=n).p[0] * unit / time for n in (10, 20))
    assert np.abs(fine - [2.058913, 2.915965]).max() < 1.5e-6
    assert np.abs(fine - coarse).max() < 1e-8


@pytest.mark.quick
def test_several_starts_lead_to_several_paths(kepler):
    ends, n = [[1.0, 0.0], [-0.5, 0.8]], 24
    angle = np.arctan2(0.8, -0.5)

    def around(turn):
        a = np.linspace(0, turn, n + 1)
        return np.stack([np.cos(a), np.sin(a)], axis=1)

    left, right = (kepler.path(*ends, 3.0, steps=n, start=around(x)) for x in (angle, angle - 2 * np.pi))
    momenta = [kepler.momentum_maps(path.q[0], path.p[0])[0] for path in (left, right)]
    assert momenta[0] > 0 > momenta[1]
    assert all(np.abs(path.run().q[-1] - ends[1]).max() < 1e-11 for path in (left, right))


def test_continuation_finds_what_the_straight_line_does_not(kepler):
    q1 = kepler.integrate([1.0, 0.0], [0.0, 1.0], h=0.1, steps=140).q[-1]
    h = np.full(56, 0.25)
    intervals = Intervals(kepler, 0.25 * np.arange(56), h, kepler.defaults, None)
    line = np.linspace([1.0, 0.0], q1, 57)
    with pytest.raises(PathError, match="no progress"):
        solver.solved(intervals, line)
    found = solver.continued(intervals, line, 14.0)
    assert np.abs(found.at.residual).max() < 1e-11
    assert np.abs(kepler.path([1.0, 0.0], q1, 14.0, steps=56).q - found.q).max() < 1e-9


def test_a_path_through_a_singularity_is_dropped(kepler):
    """Half of an ellipse with the semi-major axis a = 5/4; the mean of L over it is 3/(2 a) by the virial theorem."""
    a, T = 1.25, np.pi * 1.25**1.5
    path = kepler.path([1.0, 0.0], [-1.5, 0.0], T, steps=44)
    assert path.dropped > 0
    assert path.action == pytest.approx(1.5 * T / a, abs=1e-11)
    assert abs(path.p[0]) == pytest.approx([0.0, np.sqrt(2.0 - 1.0 / a)], abs=1e-9)
    assert path.error < 1e-9
    assert path.energy_change < 1e-9
    line = np.linspace([1.0, 0.0], [-1.5, 0.0], 45)
    with pytest.raises(PathError, match="2 stationary points of the discrete action are no motions"):
        kepler.path([1.0, 0.0], [-1.5, 0.0], T, steps=44, start=line)


@pytest.mark.rotated
def test_starts_go_around_a_centre(kepler):
    """Angles are those of the run of the path; the times of flight are those of Kepler's equation."""
    angle = np.arctan2(0.8, -0.5)
    for revolutions in (0, -1, 1, -2):
        path = kepler.path([1.0, 0.0], [-0.5, 0.8], 10.0, steps=60, revolutions=revolutions)
        run = path.run()
        turned = np.unwrap(np.arctan2(run.q[:, 1], run.q[:, 0]))[-1]
        assert turned == pytest.approx(angle + 2 * np.pi * revolutions, abs=1e-8)
        exact = kepler.integrate(path.q[0], path.p[0], t_end=10.0)
        assert np.abs(exact.q[-1] - [-0.5, 0.8]).max() < 1e-5
    with pytest.raises(PathError, match="continuation in the duration ended"):
        kepler.path([1.0, 0.0], [-0.5, 0.8], 5.0, steps=30, revolutions=1)
    with pytest.raises(StateError, match="either start or revolutions"):
        kepler.path([1.0, 0.0], [-0.5, 0.8], 5.0, steps=30, revolutions=1, start=np.zeros((31, 2)))
    with pytest.raises(StateError, match="requires a rotational symmetry"):
        compiled(["x"], "x_dot**2/2 - x**2/2").path([1.0], [0.3], 1.0, revolutions=1)


@pytest.mark.parametrize("amplitude", [1.0, 1e-9])
@pytest.mark.parametrize("origin", [0.0, 1000.0])
@pytest.mark.parametrize("gauge", ["0", "1"])
def test_error_of_a_path_depends_neither_on_the_origin_nor_on_the_gauge(amplitude, origin, gauge):
    """An oscillator about the origin, whose L has the derivative of b x^2 as a gauge: x = x0 cos t + v0 sin t."""
    stepper = compiled(["x"], "x_dot**2/2 - (x - c)**2/2 + b*x*x_dot", parameters={"b": 0.0, "c": 0.0})
    path = stepper.path(
        [origin + 0.1 * amplitude],
        [origin + 0.9 * amplitude],
        2.0,
        steps=4,
        parameters={"b": float(gauge), "c": origin},
    )
    x0, x1 = 0.1 * amplitude, 0.9 * amplitude
    v0 = (x1 - x0 * np.cos(2.0)) / np.sin(2.0)
    x, v = x0 * np.cos(path.t) + v0 * np.sin(path.t), v0 * np.cos(path.t) - x0 * np.sin(path.t)
    q, p = path.q[:, 0] - origin, path.p[:, 0] - float(gauge) * path.q[:, 0]
    true = max(np.abs(q - x).max() / np.ptp(x), np.abs(p - v).max() / np.abs(v).max())
    rounding = 2.0**-53 * (origin + amplitude) / amplitude
    assert true - 4 * rounding <= path.error <= 1.2 * true + 16 * rounding
    assert not path.at_rest


@pytest.mark.parametrize(("T", "index"), [(3.0, 0), (3.3, 1), (6.2, 1), (6.4, 2), (9.3, 2), (9.5, 3), (20.0, 6)])
def test_morse_index_of_the_oscillator(oscillator, T, index):
    path = oscillator.path([1.0], [0.3], T, steps=40)
    assert path.index == index == int(T / np.pi)
    assert len(path.conjugate_times) == index
    for k, (before, after) in enumerate(path.conjugate_times, 1):
        assert before <= k * np.pi <= after


def test_hessian_by_both_ends_is_that_of_the_run():
    stepper = sc.compile_stepper(sc.problem("henon-heiles").system, "svi:4")
    run = stepper.integrate([0.1, 0.2], [0.3, 0.1], h=0.4, steps=25)
    path = stepper.path(run.q[0], run.q[-1], 10.0, steps=25, start=run.q)
    M = run.tangent()[-1]
    A, B, D = M[:2, :2], M[:2, 2:], M[2:, 2:]
    inverse = np.linalg.inv(B)
    assert np.abs(path.hessian[:2, 2:] + inverse).max() < 1e-12
    assert np.abs(path.hessian[:2, :2] - inverse @ A).max() < 1e-12
    assert np.abs(path.hessian[2:, 2:] - D @ inverse).max() < 1e-12
    determinants = [np.linalg.det(each[:2, 2:]) for each in run.tangent()[1:]]
    assert path.index == 5 == np.count_nonzero(np.diff(np.sign(determinants)))


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("arguments", "q"),
    [
        ({"forces": {"x": "-x_dot/10 - x*y_dot", "y": "0"}}, 2),
        ({"damping": "1/10"}, 2),
        ({"inputs": ["u"]}, 2),
        ({"constraints": ["x**2 + y**2 - 1"]}, 2),
    ],
    ids=["forces", "damping", "inputs", "constraints"],
)
def test_paths_of_other_systems_are_their_runs(arguments, q):
    driven = " + u*x" if "inputs" in arguments else ""
    stepper = compiled(["x", "y"], f"(x_dot**2 + y_dot**2)/2 - x**2/2 - y{driven}", "svi:3", **arguments)
    t = np.linspace(0, 1.5, 31)
    inputs = {"inputs": {"u": (t, np.sin(3 * t))}} if driven else {}
    run = stepper.integrate([1.0, 0.0], velocity=[0.0, 0.4], h=0.05, t_end=1.5, **inputs)
    path = stepper.path(run.q[0], run.q[-1], 1.5, steps=30, **inputs)
    assert np.abs(path.q - run.q).max() < 1e-12
    assert np.abs(path.p - run.p).max() < 1e-11
    assert abs(path.action - run.action()) < 1e-12
    assert np.abs(path.run().q[-1] - run.q[-1]).max() < 1e-11
    assert path.index == (None if stepper.supports("work") else 0)


def driven():
    return compiled(["x"], "x_dot**2/2 - x**2/2 + u*x", inputs=["u"])


@pytest.mark.rotated
def test_paths_between_attitudes_are_their_runs():
    """A rigid body, and one coupled with a position; with a given duration, and with a given energy."""
    for position, coupling in (([], "1"), (["x"], "x")):
        kinetic = "(omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2" + " + x_dot**2/2 - x**2" * bool(position)
        body = compiled(position, f"{kinetic} - R_33*{coupling}", "svi:3", rotations={"R": "omega"})
        at, moving = (dict.fromkeys(position, value) for value in (0.2, 0.1))
        velocity = {**moving, "omega": [0.3, 0.2, 0.9]}
        run = body.integrate({**at, "R": [1, 0, 0, 0]}, velocity=velocity, h=0.1, steps=15)
        path = body.path({**at, "R": [1, 0, 0, 0]}, run.q[-1], 1.5, steps=15)
        free = body.path(run.q[0], run.q[-1], 1.6, steps=15, energy=float(run.energy()[0]))
        for each in (path, free):
            assert abs(each.t[-1] - 1.5) < 1e-11
            assert np.abs(each.q - run.q).max() < 1e-11
            assert np.abs(each.p - run.p).max() < 1e-10
            assert abs(each.action - run.action()) < 1e-11
        assert path.index == 0


@pytest.mark.rotated
def test_closed_paths_of_constraints_rotations_and_arrays():
    rod = compiled(["x", "y"], "(x_dot**2 + y_dot**2)/2 - y", "svi:4", constraints=["x**2 + y**2 - 1"])

    def swing(t):
        return [np.sin(1.5 * np.sin(np.pi * t / 4)), -np.cos(1.5 * np.sin(np.pi * t / 4))]

    path = rod.path(T=4.0, steps=24, closed=["-x", "y"], start=swing)
    run = path.run()
    assert np.abs(run.q[-1] - run.q[0]).max() < 1e-9
    assert abs(4 * ellipk((1 + run.energy()[0]) / 2) - 8.0) < 1e-8  # of its elliptic integral
    free = rod.path(run.q[0], run.q[9], 1.4, steps=9, energy=float(run.energy()[0]))
    assert abs(free.t[-1] - 1.5) < 1e-9
    body = compiled([], "(omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2", "svi:3", rotations={"R": "omega"})
    angle = np.linspace(0, np.pi, 25)[:, None] * [[0, 0, 0, 1]]
    start = np.cos(angle[:, 3:]) * [[1, 0, 0, 0]] + np.sin(angle) + 1e-3 * np.sin(3 * angle[:, 3:]) * [[0, 1, 1, 0]]
    turn = body.path(T=2 * np.pi, steps=24, closed=-np.eye(4), start=start)
    assert abs(turn.action - 3 * np.pi) < 1e-5  # one turn about the third axis, with omega = 1
    assert np.abs(turn.run().q[24] + turn.q[0]).max() < 1e-7
    chain = compiled(
        ["u[N]"], "sum(i in N, u_dot[i]**2/2 + u[i]**4/4) + sum(i in 0..N-2, (u[i+1] - u[i])**2/2)", "svi:3"
    )
    here = {"steps": 12, "start": lambda t: {"u": [np.cos(np.pi * t), 0.1, -0.3]}}
    rest = chain.path(T=1.0, closed=["-u[0]", "-u[1]", "-u[2]"], **here)
    assert (rest.index, rest.repetitions) == (0, 2)
    assert np.abs(rest.q["u"]).max() < 1e-6  # the minimum


@pytest.mark.tiers(0, 1)
def test_closed_paths_of_inputs():
    t = np.linspace(0, 3, 61)
    forced = driven().path(
        T=3.0, steps=60, closed=True, start=np.full((61, 1), 0.1), inputs={"u": (t, np.cos(2 * np.pi * t / 3))}
    )
    assert abs(forced.q[0, 0] - 1 / (1 - (2 * np.pi / 3) ** 2)) < 4e-4  # the input is interpolated linearly
    assert np.abs(forced.run().q[-1] - forced.q[0]).max() < 1e-12


@pytest.mark.rotated
def test_constrained_index_is_that_of_the_angle():
    """A rod without gravity, motion in the plane of a half turn and more: conjugate after half a turn on the sphere."""
    rod = compiled(["x", "y", "z"], "(x_dot**2 + y_dot**2 + z_dot**2)/2", constraints=["x**2 + y**2 + z**2 - 1"])
    n = 16
    for angle, index in ((2.0, 0), (4.0, 1)):
        a = np.linspace(0, angle, n + 1)
        curve = np.stack([np.cos(a), np.sin(a), 0.02 * np.sin(np.pi * a / angle)], axis=1)
        path = rod.path(curve[0], curve[-1], angle, steps=n, start=curve)
        assert path.index == index
        assert abs(path.action - angle / 2) < 1e-9


@pytest.mark.rotated
def test_paths_of_arrays_of_run_time_sizes():
    chain = lagrange("chain", "u[N]", "sum(i in N, u_dot[i]**2/2 - u[i]**4/4) - sum(i in 0..N-2, (u[i+1] - u[i])**2/2)")
    stepper = sc.compile_stepper(chain, "svi:3")
    ends = np.array([0.1, -0.2, 0.3]), np.array([0.4, 0.1, 0.2])
    path = stepper.path(*ends, 2.0, steps=12)
    run = stepper.integrate(ends[0], path.p[0], h=1 / 6, steps=12)
    assert np.abs(run.q[-1] - ends[1]).max() < 1e-12


@pytest.mark.rotated
def test_sparse_derivatives_of_a_lattice_are_those_of_all_columns():
    lattice = compiled(
        ["u[12]"], "sum(i in 12, u_dot[i]**2/2 + (u[i]**2 - 1)**2/4) + sum(i in 0..10, (u[i+1] - u[i])**2/4)", "svi:2"
    )
    h = np.full(6, 0.3)
    q = np.linspace(-1, 1, 7)[:, None] + 0.1 * np.random.default_rng(1).normal(size=(7, 12))
    all_of_them, some = (
        kind(lattice, 0.3 * np.arange(6), h, lattice.defaults, None).linearised(q)
        for kind in (Intervals, ManyCoordinates)
    )
    many = ManyCoordinates(lattice, 0.3 * np.arange(6), h, lattice.defaults, None)
    many.linearised(q)
    dense = np.zeros_like(all_of_them.blocks)
    dense[:, :, many.rows, many.columns] = some.blocks
    assert np.abs(dense - all_of_them.blocks).max() < 1e-4 * np.abs(all_of_them.blocks).max()
    assert some.blocks.shape[-1] < 12 * 12


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("arguments", "closed", "start", "energy", "m", "zero_modes"),
    [
        ({"coordinates": ["a"], "lagrangian": "a_dot**2/2 + cos(a)"}, ["-a"], lambda t: [np.sin(t)], 0.5, 0.75, 1),
        ({"coordinates": ["x"], "lagrangian": "x_dot**2/2 - x**2/2"}, ["-x"], lambda t: [np.cos(t)], 3.0, 0.0, 2),
        pytest.param(
            {
                "coordinates": ["x", "y"],
                "lagrangian": "(x_dot**2 + y_dot**2)/2 - y",
                "constraints": ["x**2 + y**2 - 1"],
            },
            ["-x", "y"],
            lambda t: [np.sin(np.sin(t)), -np.cos(np.sin(t))],
            -0.5,
            0.25,
            1,
            marks=pytest.mark.second,
        ),
    ],
    ids=["pendulum", "oscillator", "constraint"],
)
def test_closed_paths_of_given_energy_have_the_period_of_formulas(arguments, closed, start, energy, m, zero_modes):
    stepper = compiled(method="svi:6", **arguments)
    path = stepper.path(T=3.0, steps=12, closed=closed, start=start, energy=energy)
    assert path.period == pytest.approx(4 * ellipk(m), abs=1e-9)
    assert path.run().energy() == pytest.approx(np.full(25, energy), abs=1e-9)
    assert path.zero_modes == zero_modes


def test_refusals_name_the_remedy(kepler):
    for call, error, words in (
        (lambda: kepler.path(T=1.0, closed=["x", "x"], start=np.ones((33, 2))), StateError, "each coordinate once"),
        (lambda: kepler.path(T=1.0, closed=np.ones((2, 2)), start=np.ones((33, 2))), StateError, "orthogonal"),
        (
            lambda: compiled(["x", "y"], "(x_dot**2 + y_dot**2)/2 - x**2/2 - y", "svi:3", damping="1/10").path(
                T=6.0, closed=True, energy=1.0, start=np.ones((33, 2))
            ),
            MethodError,
            "damping takes it",
        ),
    ):
        with pytest.raises(error, match=words):
            call()
