"""Newton's method on meshes: factors of the linear part, whose corrections depend on the step size alone."""

import numpy as np
import pytest
from notation import hamilton
from samples import QUICK_FLAGS

import scvi_codegen as sc

pytestmark = pytest.mark.rotated

RANDOM = np.random.default_rng(2)
LINEAR = "u_t**2/2 - u_x**2/2 - u**2/2"
GRADED = [0, 0.02, 0.1, 0.3, 1.0, 2.0, 2.5]
MESHES = {
    "ring": ("periodic", "spectral-elements", {"degree": 5, "elements": 8}),
    "natural": (("natural", "natural"), "spectral-elements", {"degree": 8, "elements": GRADED}),
    "prescribed": ((0, "sin(t)"), "spectral-elements", {"degree": 12, "elements": 3}),
    "differences": ("periodic", "finite-differences", {"order": 6, "points": 70}),
}


def mesh_of(name, density=LINEAR, fields=("u",)):
    boundary, method, options = MESHES[name]
    field = sc.FieldSystem.from_text(name, [*fields], {"x": (0, 2.5)}, density, boundary={"x": boundary})
    return field.discretise(method, **options)


@pytest.mark.sampled(3)
@pytest.mark.covering
@pytest.mark.filterwarnings("ignore:the mesh does not resolve")
@pytest.mark.parametrize("method", ["svi:1", "svi:2", "svi:3", "svi:8", "gauss:5"])
@pytest.mark.parametrize("name", MESHES)
def test_one_correction_solves_linear_densities(name, method):
    """Random initial values contain the highest frequencies; a second correction confirms the first."""
    mesh = mesh_of(name)
    stepper = sc.compile_stepper(mesh.system, method, solver="newton", flags=QUICK_FLAGS)
    h = 30 * mesh.largest_step("svi:2")
    run = stepper.integrate({"u": RANDOM.normal(size=mesh.weights.shape)}, h=h, steps=4)
    assert run.iterations.max() <= 2
    if name != "prescribed":
        assert run.energy_error() < 1e-12


@pytest.mark.sampled(1)
@pytest.mark.parametrize("threads", [1, 2])
def test_corrections_depend_on_the_step_size_alone(threads):
    counts = []
    for degree, elements in ((4, 30), (8, 30), (8, 60), (16, 30)):
        field = sc.FieldSystem.from_text(
            "fields",
            ["u", "v"],
            {"x": (-20, 20)},
            "u_t**2/2 + v_t**2/2 - u_x**2/2 - v_x**2/2 - (1 - cos(u)) - (1 - cos(u - v))",
            boundary={"x": "periodic"},
        )
        mesh = field.discretise("spectral-elements", degree=degree, elements=elements)
        x = mesh.points["x"]
        stepper = sc.compile_stepper(mesh.system, "svi:4", solver="newton", flags=QUICK_FLAGS)
        start = {"u": np.exp(-x * x / 4), "v": 0 * x}
        run = stepper.integrate(start, h=0.2, steps=20, threads=threads)
        counts.append(run.iterations.sum())
    assert max(counts) <= 1.1 * min(counts) <= 5 * 20


def test_steps_equal_those_of_fixed_point_iteration_and_of_other_threads():
    mesh = mesh_of("natural", "u_t**2/2 - u_x**2/2 - (1 - cos(3*u))")
    start = {"u": np.cos(np.pi * mesh.points["x"] / 2.5)}
    h, ends = mesh.largest_step("svi:4") / 2, []
    for solver, threads in (("fixed-point", 1), ("newton", 1), ("newton", 3)):
        stepper = sc.compile_stepper(mesh.system, "svi:4", solver=solver, flags=QUICK_FLAGS)
        ends.append(stepper.integrate(start, h=h, steps=20, threads=threads).q["u"][-1])
    assert np.abs(ends[0] - ends[1]).max() < 1e-13
    assert ends[1].tobytes() == ends[2].tobytes()


def test_restored_runs_and_other_parameters_have_the_right_factors():
    field = sc.FieldSystem.from_text(
        "string", ["u"], {"x": (0, 1)}, "u_t**2/2 - c*u_x**2/2 - u**2", boundary={"x": (0, 0)}, parameters={"c": 1}
    )
    mesh = field.discretise("spectral-elements", degree=9, elements=5)
    stepper = sc.compile_stepper(mesh.system, "svi:4", solver="newton", flags=QUICK_FLAGS)
    run = stepper.start({"u": np.sin(np.pi * mesh.points["x"])}, h=0.2)
    run.advance(3)
    again = stepper.from_checkpoint(run.checkpoint())
    for each in (run, again):
        each.advance(3)
    assert run.q["u"].tobytes() == again.q["u"].tobytes()
    before = run.iterations
    run.update(parameters={"c": 25.0})
    run.advance(3)
    assert run.iterations - before <= 6


HAMILTONIANS = {
    "Schroedinger": ("(a_x**2 + b_x**2)/4 + cos(x)*a**2/2 + a*b_x/3", "ring"),
    "Korteweg-de Vries": ("(a_xx/2 + b_x)**2/2", "differences"),
}


def pairs_on(name, hamiltonian, method=None, end=2.5, **options):
    boundary, default, further = MESHES[name]
    field = sc.FieldSystem.from_text(
        "pairs", ["a"], {"x": (0, end)}, hamiltonian=hamiltonian, momenta=["b"], boundary={"x": boundary}
    )
    return field.discretise(method or default, **(options or further))


@pytest.mark.covering
@pytest.mark.parametrize("name", HAMILTONIANS)
def test_one_correction_solves_linear_hamiltonians(name):
    hamiltonian, place = HAMILTONIANS[name]
    mesh = pairs_on(place, hamiltonian)
    stepper = sc.compile_stepper(mesh.system, "svi:3", solver="newton", flags=QUICK_FLAGS)
    start = {"a": RANDOM.normal(size=mesh.weights.shape)}
    h = 30 * mesh.largest_step("svi:2")
    run = stepper.integrate(start, p={"a": mesh.weights * start["a"] ** 2}, h=h, steps=4)
    assert run.iterations.max() <= 2
    assert run.energy_error() < 1e-12


@pytest.mark.quick
def test_steps_of_a_lattice_equal_dense_newton_steps():
    """Gauss(2) in NumPy for a discrete nonlinear Schroedinger equation with stiff random couplings."""
    n, h, root = 6, 0.2, np.sqrt(3.0) / 6
    coupling, q, p = np.random.default_rng(1).normal(size=(3, n)) * [[20], [1], [1]]
    text = (
        "sum(i in N periodic, k[i]*(q[i]*q[i+1] + p_q[i]*p_q[i+1] + q[i]*p_q[i+1]))"
        " + sum(i in N, (q[i]**2 + p_q[i]**2)**2/9)"
    )
    lattice = hamilton("lattice", "q[N]", text, parameters={"k[N]": 1})
    stepper = sc.compile_stepper(lattice, "gauss:2", solver="newton", flags=QUICK_FLAGS)
    run = stepper.integrate({"q": q}, p={"q": p}, h=h, steps=1, parameters={"k": coupling})
    shift = coupling[:, None] * np.roll(np.eye(n), 1, axis=1)
    symmetric = shift + shift.T
    hessian = np.block([[symmetric, shift], [shift.T, symmetric]])
    turn = np.kron([[0, 1], [-1, 0]], np.eye(n))
    table, start = np.array([[0.25, 0.25 - root], [0.25 + root, 0.25]]), np.concatenate([q, p])

    def rates(x):
        size = np.tile(x[:n] ** 2 + x[n:] ** 2, 2)
        return turn @ (hessian @ x + 4 / 9 * size * x)

    def jacobian(x):
        cubic = np.diag(np.tile(x[:n] ** 2 + x[n:] ** 2, 2)) + 2 * np.outer(x, x) * np.tile(np.eye(n), (2, 2))
        return turn @ (hessian + 4 / 9 * cubic)

    points = np.tile(start, (2, 1))
    for _ in range(40):
        residual = start + h * table @ np.array([rates(x) for x in points]) - points
        matrix = np.eye(4 * n) - h * np.block([[table[i, j] * jacobian(points[j]) for j in (0, 1)] for i in (0, 1)])
        points = points + np.linalg.solve(matrix, residual.ravel()).reshape(2, -1)
    end = start + h / 2 * (rates(points[0]) + rates(points[1]))
    assert np.abs(residual).max() < 1e-12
    assert np.abs(np.concatenate([run.q["q"][-1], run.p["q"][-1]]) - end).max() < 1e-12


@pytest.mark.second
def test_one_correction_solves_linear_dissipation_and_gyroscopic_forces():
    """Damping far above the critical one, between neighbours and with a part that is not symmetric."""
    chain = sc.LagrangianSystem.from_text(
        "chain",
        coordinates=["q[N]", "r[N]"],
        parameters={"c[N]": 1},
        lagrangian="sum(i in N, q_dot[i]**2/2 + r_dot[i]**2) - sum(i in N periodic, 200*(q[i+1] - q[i])**2 + r[i]**2)",
        forces={"q[i]": "20*c[i]*r_dot[i] - q_dot[i]", "r[i]": "-20*c[i]*q_dot[i]"},
        dissipation="sum(i in N periodic, 50*(q_dot[i+1] - q_dot[i])**2/2)",
    )
    (q, r, c), h = np.random.default_rng(3).normal(size=(3, 9)), 0.25
    stepper = sc.compile_stepper(chain, "gauss:3", solver="newton", flags=QUICK_FLAGS)
    run = stepper.integrate({"q": q, "r": r}, velocity={"q": r, "r": q}, h=h, steps=5, parameters={"c": c})
    assert run.iterations.max() <= 3
    around = 2 * np.eye(9) - np.roll(np.eye(9), 1, axis=0) - np.roll(np.eye(9), -1, axis=0)
    mass, turn, zero = np.diag([1.0] * 9 + [2.0] * 9), 20 * np.diag(c), np.zeros((9, 9))
    stiffness = np.block([[400 * around, zero], [zero, 2 * np.eye(9)]])
    damping = np.block([[50 * around + np.eye(9), -turn], [turn, zero]])
    inverse = np.linalg.inv(mass)
    rate = np.block([[np.zeros((18, 18)), np.eye(18)], [-inverse @ stiffness, -inverse @ damping]])
    upper = [1, 1 / 2, 1 / 10, 1 / 120]
    above, below = (
        sum(a * np.linalg.matrix_power(sign * h * rate, k) for k, a in enumerate(upper)) for sign in (1, -1)
    )
    state = np.linalg.matrix_power(np.linalg.solve(below, above), 5) @ np.concatenate([q, r, r, q])
    assert np.abs(np.concatenate([run.q["q"][-1], run.q["r"][-1]]) - state[:18]).max() < 1e-10


def test_hamiltonians_with_too_many_couplings_are_refused():
    all_pairs = hamilton("all pairs", "q[N]", "sum(i in N, p_q[i]**2/2) + sum(i < j in N, (q[i] - q[j])**4)")
    stepper = sc.compile_stepper(all_pairs, "svi:1", solver="newton", flags=QUICK_FLAGS)
    with pytest.raises(sc.StateError, match=r"at most 400 entries per row.*use solver='fixed-point'"):
        stepper.integrate({"q": np.arange(450.0)}, h=0.01, steps=1)
