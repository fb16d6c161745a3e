"""Heat bath beside exact results of statistical mechanics: rates, correlations, orders, degrees of freedom.

Seeds are fixed, and bounds are four standard errors of independent trajectories, whose size each test bounds: another
processor, whose rounding leads to other trajectories, fails with probability 1e-4. Exact values are matrix elements of
the Fokker-Planck operator in Hermite functions of the momentum, closed forms, or covariances by Lyapunov's equation.
"""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.sparse import csr_matrix, diags, identity, kron
from scipy.sparse.linalg import expm_multiply

import scvi_codegen as sc

BATH = {"damping": "g", "temperature": "kT"}
OSCILLATOR = {"coordinates": ["x"], "lagrangian": "x_dot**2/2 - k*x**2/2"}


def compiled(method, name, g=1.0, **arguments):
    parameters = {"kT": 1.0, "g": g, **arguments.pop("parameters", {})}
    return sc.compile_stepper(
        sc.LagrangianSystem.from_text(name, **{**BATH, "parameters": parameters, **arguments}), method
    )


def ensemble(stepper, q, p, h, steps, **arguments):
    runs = stepper.integrate_ensemble(q, p, h=h, steps=steps, seed=11, **arguments)
    assert (runs.status == "ok").all()
    return runs


def agrees(values, exact, largest_error):
    """Return whether the mean over the first axis, of independent values, is the exact one within its error."""
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    assert (error < largest_error).all(), error
    return (np.abs(values.mean(axis=0) - exact) < 4 * error).all()


def independent(values):
    """Return the means of 16 trajectories, (n, 16, ..) values in time, without the first fiftieth."""
    return values[len(values) // 50 :].mean(axis=0)


def step_of(stepper, h, **parameters):
    """Return the matrix of a linear step without noise and friction."""
    columns = [stepper.integrate(x[:1], x[1:], h=h, steps=1, parameters=parameters) for x in np.eye(2)]
    return np.array([[run.q[-1, 0], run.p[-1, 0]] for run in columns]).T


def lowering(size):
    """Return the matrix of sqrt(kT) d/dp in Hermite functions of the Gaussian of a momentum."""
    return diags([np.sqrt(np.arange(1, size))], [1])


@pytest.mark.second
@pytest.mark.parametrize(
    ("method", "bias", "order"), [("stoermer-verlet", 4.17e-2, 2), ("composition:4", 1.9e-4, 4), ("svi:1", 0, None)]
)
def test_bias_of_harmonic_averages_has_the_order_of_the_method(method, bias, order):
    # sees a step of Phi that is not of h, or a composition that contains the bath
    oscillator, found = compiled(method, "oscillator", **OSCILLATOR, parameters={"k": 1.0}), []
    for h in (0.8, 0.4, 0.2):
        step, half = step_of(oscillator, h, kT=0, g=0), np.diag([1, np.exp(-h / 2)])
        noise = np.diag([0, 1 - np.exp(-h)])
        covariance = solve_discrete_lyapunov(half @ step @ half, half @ step @ noise @ step.T @ half.T + noise)
        found.append(covariance[0, 0] - 1)
    if order is None:
        assert np.abs(found).max() < 1e-14
        return
    assert abs(abs(found[1]) - bias) < 0.03 * bias
    assert abs(np.log2(found[1] / found[2]) - order) < 0.1
    if order == 2:  # O B A B O: 1/(1 - h^2/4); steps in another order, as B A O A B, would have no bias
        assert np.abs(np.array(found) - [1 / (1 - h**2 / 4) - 1 for h in (0.8, 0.4, 0.2)]).max() < 1e-13
        rest = np.zeros((16, 1))
        x = ensemble(oscillator, rest, rest, 0.8, 20000).q[..., 0]
        assert agrees(independent(x**2), 1 / 0.84, 0.01)


@pytest.mark.second
def test_additive_noise_acts_half_before_and_half_after_a_step():
    # sees all of the noise on one side, or noise of h instead of h/2
    h, s, count = 0.8, 0.5, 40000
    system = {"temperature": None, "damping": None, "noise": {"x": "s"}, **OSCILLATOR}
    oscillators = [
        sc.compile_stepper(sc.LagrangianSystem.from_text("noisy", parameters={"s": s, "k": 1}, **system), method)
        for method in ("svi:2", "stoermer-verlet")
    ]
    rest = np.zeros((count, 1))
    runs = ensemble(oscillators[0], rest, rest, h, 1, parameters={"k": 0.0})
    x, p = runs.q[-1, :, 0], runs.p[-1, :, 0]
    exact = s**2 * np.array([h**3 / 2, h**2 / 2, h])
    assert agrees(np.stack([x * x, x * p, p * p], axis=1), exact, 0.01 * exact.max())
    energies = []
    for oscillator in oscillators:  # E H = H0 + s^2 t/2, by SVI of quadratic H, and not by Verlet's method
        step, half = step_of(oscillator, h, s=0), np.diag([0, s**2 * h / 2])
        covariance = np.zeros((2, 2))
        for _ in range(50):
            covariance = step @ (covariance + half) @ step.T + half
        energies.append(np.trace(covariance) / 2)
    assert abs(energies[0] - s**2 * 40 / 2) < 1e-12
    assert abs(energies[1] - s**2 * 40 / 2) > 0.1
    run = oscillators[0].integrate([1.0], [0.0], h=h, steps=400, seed=3)
    assert abs(run.energy()[-1] - run.energy()[0] - run.heat()) < 1e-12 * abs(run.heat())


@pytest.mark.tiers(0, 1)
def test_escape_over_a_barrier_has_the_rate_of_the_fokker_planck_operator():
    # <x x(t)> = (x, e^(L t) x), L = sqrt(kT) (a^T D - a D^T) - g a^T a, D = d/dx + V'/(2 kT) (Risken, The
    # Fokker-Planck Equation, 1989, sec. 10.3) at sinc points; sees a wrong friction: a rate with 6 % error fails
    barrier, nodes, functions, count = 3.0, 40, 20, 20000
    x, spacing = np.linspace(-2.2, 2.2, nodes, retstep=True)
    k = np.subtract.outer(np.arange(nodes), np.arange(nodes))
    sinc = np.divide((-1.0) ** k, k * spacing, out=np.zeros(k.shape), where=k != 0)
    slope, a = sinc + np.diag(2 * barrier * x * (x**2 - 1)), lowering(functions)
    operator = kron(a.T, slope) - kron(a, slope.T) - kron(a.T @ a, identity(nodes))
    root = np.exp(-barrier * (x**2 - 1) ** 2 / 2)
    moment = np.pad(x * root / np.linalg.norm(root), (0, (functions - 1) * nodes))
    exact = expm_multiply(csr_matrix(operator), moment, start=0, stop=16, num=5) @ moment
    kramers = 2 * (np.sqrt(1 / 4 + 12) - 1 / 2) / np.sqrt(12) * np.sqrt(24) / (2 * np.pi) * np.exp(-barrier)
    assert 0.7 < np.log(exact[3] / exact[4]) / 4 / kramers < 1  # 2 k in the limit of high barriers
    well = compiled("composition:4", "well", coordinates=["x"], lagrangian="x_dot**2/2 - 3*(x**2 - 1)**2")
    grid = np.linspace(-2.2, 2.2, 2001)
    weight = np.cumsum(np.exp(-barrier * (grid**2 - 1) ** 2))
    start = np.interp((np.arange(count) + 0.5) / count, weight / weight[-1], grid)[:, np.newaxis]
    runs = ensemble(well, start, np.random.default_rng(3).normal(size=start.shape), 0.1, 160, save_every=40)
    assert agrees((runs.q[1:, :, 0] * start[:, 0]).T, exact[1:], 0.006)


@pytest.mark.tiers(0, 1)
def test_rotational_diffusion_of_a_free_body():
    # E R(t) from rest: dF/dt = (L + [omega]) F, L of damped Euler equations, in Hermite functions of omega; sees a
    # noise of the wrong axes, and the inertia of quaternions instead of J
    inertia, g, size, count = np.array([1, 2, 2.5]), 1.5, 8, 16000
    a = [kron(kron(identity(size**k), lowering(size)), identity(size ** (2 - k))) for k in range(3)]
    omega = [(a[k] + a[k].T) / np.sqrt(inertia[k]) for k in range(3)]
    operator = -g * sum(x.T @ x for x in a)
    cross = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[k, i, j], cross[j, i, k] = 1, -1  # (e_i x e_j)_k
        operator += (inertia[j] - inertia[k]) / np.sqrt(inertia[i]) * omega[j] @ omega[k] @ a[i]
    operator = kron(operator, identity(3)) + sum(kron(omega[i], cross[:, i]) for i in range(3))
    at_rest = np.array([1, 0, -np.sqrt(1 / 2), 0, np.sqrt(3 / 8), 0, -np.sqrt(5 / 16), 0])  # Hermite functions at 0
    start = np.zeros((3 * size**3, 3))
    start[:3] = np.eye(3)
    motion = expm_multiply(csr_matrix(operator), start, start=0, stop=3, num=4)[1:].reshape(3, size**3, 3, 3)
    exact = np.einsum("n,tnkk->tk", np.kron(np.kron(at_rest, at_rest), at_rest), motion)
    body = compiled(
        "svi:2", "body", g, rotations={"R": "omega"}, lagrangian="(omega_1**2 + 2*omega_2**2 + 5*omega_3**2/2)/2"
    )
    q = np.tile([1.0, 0, 0, 0], (count, 1))
    squares = ensemble(body, q, 0 * q, 0.1, 30, save_every=10).q[1:] ** 2
    diagonal = 2 * (squares[..., :1] + squares[..., 1:]) - 1
    assert agrees(np.swapaxes(diagonal, 0, 1), exact, 0.005)


@pytest.mark.tiers(0, 1)
def test_axes_of_a_rigid_body_have_the_temperature():
    # <L_i^2/J_i> = kT; sees noise along the length of quaternions, which is no degree of freedom, and that of one axis
    body = compiled(
        "svi:1",
        *("dipole", 8.0),
        rotations={"R": "omega"},
        lagrangian="(omega_1**2 + 2*omega_2**2 + 5*omega_3**2/2)/2 + R_33",
    )
    q = np.tile([1.0, 0, 0, 0], (16, 1))
    runs = ensemble(body, q, 0 * q, 0.2, 30000)
    (w, v), (p, u) = ((x[..., :1], x[..., 1:]) for x in (runs.q, runs.p))
    values = independent(((w * u - v * p - np.cross(v, u)) / 2) ** 2 / [1, 2, 2.5])
    assert agrees(values, 1, 0.004)
    assert agrees(values.mean(axis=-1), 1, 0.002)
