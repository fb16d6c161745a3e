"""Fourier meshes by fast Fourier transforms: products with circulant matrices in place of sums over pairs."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

RING = sc.LagrangianSystem.from_text(
    "ring",
    ["q[N]"],
    "sum(i in N, q_dot[i]**2/2 - q[i]**4/4) - k*cos(t)*sum(i < j in N, c[j-i]*(q[i] - q[j])**2/2)",
    parameters={"k": 0.5, "c[N]": 1.0},
)
RANDOM = np.random.default_rng(4)


def leapfrog(force, q, h, steps):
    v, now = 0 * q, force(q, 0.0)
    for k in range(1, steps + 1):
        q = q + h * (v + h / 2 * now)
        v, now = v + h / 2 * now, force(q, k * h)
        v += h / 2 * now
    return q


def even(count):
    c = RANDOM.normal(size=count)
    return c + np.roll(c[::-1], 1)


def test_sums_over_pairs_of_any_size_and_coefficients():
    """Sizes are transformed with radices 2, 3, 4, 5, 7, 11; pairs with coefficients that are not even are summed."""
    stepper = sc.compile_stepper(RING, "stoermer-verlet", flags=QUICK_FLAGS)
    for c in (even(4), even(12), even(22), even(120), even(9), even(21), RANDOM.normal(size=12)):
        n, q = len(c), RANDOM.normal(size=len(c))
        matrix = c[np.abs(np.subtract.outer(range(n), range(n)))]
        np.fill_diagonal(matrix, 0.0)

        def force(q, t, matrix=matrix):
            return 0.5 * np.cos(t) * (matrix @ q - matrix.sum(1) * q) - q**3

        run = stepper.integrate({"q": q}, parameters={"c": c}, h=0.02, steps=5)
        potential = 0.25 * np.sum(q**4) - 0.25 * q @ (matrix @ q - matrix.sum(1) * q)
        assert run.energy()[0] == pytest.approx(potential, rel=1e-13)
        np.testing.assert_allclose(run.q["q"][-1], leapfrog(force, q, 0.02, 5), rtol=0, atol=2e-13)


def test_two_axes_are_transformed_as_by_numpy():
    """Waves on a rectangle; the axis y has an odd number of points and a matrix."""
    box, sizes = {"x": (0, "2*pi"), "y": (0, 3)}, {"x": 12, "y": 5}
    density = "u_t**2/2 - a*u_x**2/2 - u_y**2/2 - u**4/4"
    periodic = dict.fromkeys(box, "periodic")
    field = sc.FieldSystem.from_text("waves", ["u"], box, density, parameters={"a": 2.0}, boundary=periodic)
    mesh = field.discretise("fourier", points=sizes, derivative={"x": "fft", "y": "dense"})
    k, m = (2 * np.pi * np.fft.fftfreq(n, length / n) for n, length in ((12, 2 * np.pi), (5, 3)))
    symbol = 2.0 * k[:, None] ** 2 + m**2
    u = RANDOM.normal(size=(12, 5))
    stepper = sc.compile_stepper(mesh.system, "stoermer-verlet", flags=QUICK_FLAGS)
    runs = [stepper.integrate({"u": u}, h=0.02, steps=10, threads=threads).q["u"][-1] for threads in (1, 2)]
    expected = leapfrog(lambda q, _: -np.fft.ifft2(symbol * np.fft.fft2(q)).real - q**3, u, 0.02, 10)
    np.testing.assert_allclose(runs[0], expected, rtol=0, atol=2e-13)
    np.testing.assert_array_equal(*runs)


@pytest.mark.rotated
@pytest.mark.filterwarnings("ignore:the mesh does not resolve")
def test_transforms_equal_matrices_for_first_order_fields_and_adaptive_steps():
    hamiltonian = "u_x**2/2 + p_x**2/2 - (u**2 + p**2)**2/2 + (u_xx**2 + p_xx**2)/100"
    space, boundary = {"x": (-4, 4)}, {"x": "periodic"}
    field = sc.FieldSystem.from_text("nls", ["u"], space, hamiltonian=hamiltonian, momenta=["p"], boundary=boundary)
    ends, energies = [], []
    for derivative in ("fft", "dense"):
        mesh = field.discretise("fourier", points=16, derivative=derivative)
        stepper = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS)
        assert stepper.source.code.count("*matrix = ") == 4 * (derivative == "fft")
        wave = np.exp(-(mesh.points["x"] ** 2) + 2j * mesh.points["x"])
        start = {"u": wave.real}, {"p": mesh.weights * wave.imag}
        fixed = stepper.integrate(*start, h=0.005, steps=20)
        energies.append(fixed.energy())
        charge = mesh.conserved(fixed, "charge")["charge"]
        assert np.ptp(charge) < 1e-13 * charge[0]
        ends += [fixed.q["u"][-1], stepper.integrate(*start, t_end=0.1, tolerance=1e-10).q["u"][-1]]
    np.testing.assert_allclose(ends[:2], ends[2:], rtol=0, atol=1e-13)
    np.testing.assert_allclose(*energies, rtol=1e-13)


CONVOLVED = sc.LagrangianSystem.from_text(
    "convolved",
    ["q[M, N]"],
    "sum(a in M, i in N, q_dot[a, i]**2/2 - k*cosh(sum(j in N, c[j-i]*q[a, j]))"
    " - q[a, i]**2*sum(j in N, c[j-i]*sum(l in N, c[l-j]*sum(b in M, d[b-a]*q[b, l])))**2/4)",
    parameters={"k": 0.5, "c[N]": 1.0, "d[M]": 1.0},
)


METHODS = [("stoermer-verlet", None), pytest.param("svi:2", None, marks=pytest.mark.full), ("svi:2", "newton")]


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize(("method", "solver"), METHODS)
def test_convolutions_of_any_size_and_coefficients(method, solver):
    """Energies and forces of functions of convolutions and of their powers, along one axis and both, are NumPy's."""
    options = {} if solver is None else {"solver": solver}
    stepper = sc.compile_stepper(CONVOLVED, method, flags=QUICK_FLAGS, **options)
    random = np.random.default_rng(4)
    for m, n in ((1, 2), (2, 9), (3, 8)):
        c, d, q = random.normal(size=n) / n, random.normal(size=m), random.normal(size=(m, n))
        c -= (n == 8) * np.roll(c[::-1], 1)  # antisymmetric
        C, D = (np.array([np.roll(each, k) for k in range(len(each))]) for each in (c, d))

        def potential(q, C=C, D=D):
            return np.sum(0.5 * np.cosh(q @ C.T) + q**2 * (D @ q @ C.T @ C.T) ** 2 / 4)

        def force(q, t, C=C, D=D):
            g, w = q @ C.T, D @ q @ C.T @ C.T
            return -0.5 * np.sinh(g) @ C - q * w**2 / 2 - D.T @ (q**2 * w) @ C @ C / 2

        run, shared = (
            stepper.integrate({"q": q}, parameters={"c": c, "d": d}, h=1e-3, steps=3, threads=each) for each in (1, 2)
        )
        np.testing.assert_array_equal(run.q["q"], shared.q["q"])
        assert run.energy()[0] == pytest.approx(potential(q), rel=1e-13)
        np.testing.assert_allclose(run.q["q"][-1], leapfrog(force, q, 1e-4, 30), rtol=0, atol=1e-7)
        assert np.ptp(run.energy()) < (1e-5 if solver is None and "svi" not in method else 1e-12) * potential(q)
        if solver == "newton":  # a wrong product of the matrix takes 4 to 8 iterations
            assert stepper.integrate({"q": q}, parameters={"c": c, "d": d}, h=0.1, steps=1).iterations[1] <= 3


def test_convolutions_are_unrolled_and_verified():
    small = sc.unroll_sums(CONVOLVED, {"M": 1, "N": 3})
    values = dict(zip(["q_0_0", "q_0_1", "q_0_2"], (0.3, -0.2, 0.5), strict=True))
    values |= {"k": 0.5, "d_0": 1.0, "c_0": 0.1, "c_1": 0.4, "c_2": -0.3}
    value = -small.lagrangian.subs({each: 0 for each in small.lagrangian.free_symbols if str(each) not in values})
    C, q = np.array([np.roll((0.1, 0.4, -0.3), k) for k in range(3)]), np.array((0.3, -0.2, 0.5))
    expected = np.sum(0.5 * np.cosh(C @ q) + q**2 * (C @ C @ q) ** 2 / 4)
    at = value.subs({each: values[str(each)] for each in value.free_symbols})
    assert float(at) == pytest.approx(expected, rel=1e-14)
    for summand in ("c[j-i]*q[j]**2", "q[j]", "c[j-i]*q[i]", "c[i-j]*q[j]", "c[j-i]*c[j-i]*q[j]"):
        with pytest.raises(sc.ExpressionError, match=r"difference of a pair|convolution"):
            lagrange("ring", "q[N]", f"sum(i in N, q_dot[i]**2 - sum(j in N, {summand}))", parameters={"c[N]": 1.0})


DENSITIES = {
    "membrane": ("u_t**2/2 - sqrt(1 + u_x**2) - u_xx**4/100", 11),
    "variable": ("u_t**2/2 - (1 + sin(x)/2)*u_x**2/2 - u*u_x**2/10", 12),
}


@pytest.mark.full
@pytest.mark.parametrize("name", DENSITIES)
def test_densities_not_quadratic_in_derivatives_by_transforms_equal_those_by_matrices(name):
    density, points = DENSITIES[name]
    field = sc.FieldSystem.from_text(name, ["u"], {"x": (0, "2*pi")}, density, boundary={"x": "periodic"})
    runs = []
    for derivative in ("fft", "dense"):
        mesh = field.discretise("fourier", points=points, derivative=derivative)
        stepper = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS)
        runs.append(stepper.integrate({"u": 0.3 * np.sin(mesh.points["x"])}, h=0.02, steps=20))
    np.testing.assert_allclose(*(run.q["u"][-1] for run in runs), rtol=0, atol=1e-14)
    np.testing.assert_allclose(*(run.energy() for run in runs), rtol=1e-14)


def test_differences_of_indices_are_those_of_pairs():
    unrolled = sc.unroll_sums(RING, {"N": 3})
    assert {str(each) for each in unrolled.parameters} == {"k", "c_0", "c_1", "c_2"}


def test_derivatives_by_transforms_or_matrices_are_chosen_by_size():
    field = sc.FieldSystem.from_text("kg", ["u"], {"x": (0, 1)}, "u_t**2/2 - u_x**2/2", boundary={"x": "periodic"})
    chosen = {n: field.discretise("fourier", points=n).axes[0].pairs[0].ndim for n in (31, 32, 63, 65, 200, 16, 16384)}
    assert chosen == {31: 2, 32: 1, 63: 2, 65: 1, 200: 1, 16: 2, 16384: 1}
    with pytest.raises(sc.SystemDefinitionError, match='is "fft" or "dense"'):
        field.discretise("fourier", points=32, derivative="fast")
