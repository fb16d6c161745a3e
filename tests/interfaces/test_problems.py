"""The catalogue: its Lagrangians give the known equations of motion, its entries are fit to start from."""

import numpy as np
import pytest
import sympy
from sympy import Symbol

from scvi_codegen import HamiltonianSystem, LagrangianSystem, SystemDefinitionError
from scvi_codegen.interfaces.models.problems import PROBLEMS, Problem, problem
from scvi_codegen.interfaces.models.systems import fput_chain


def accelerations(system: LagrangianSystem, values: dict[Symbol, float]) -> np.ndarray:
    """Solve d/dt dL/dv = dL/dq for the accelerations at one point: an oracle of its own, in SymPy and NumPy."""
    q, v, t, lagrangian = list(system.coordinates), list(system.velocities), system.time, system.lagrangian
    momentum = sympy.Matrix([lagrangian.diff(velocity) for velocity in v])
    force = sympy.Matrix([lagrangian.diff(coordinate) for coordinate in q])
    rest = force - momentum.jacobian(q) * sympy.Matrix(v) - momentum.diff(t)
    evaluate = sympy.lambdify(list(values), [momentum.jacobian(v), rest], "numpy")
    mass, right = evaluate(*values.values())
    return np.linalg.solve(np.array(mass, float), np.array(right, float).ravel())


def random_point(system: LagrangianSystem, seed: int = 3) -> dict[Symbol, float]:
    generator = np.random.default_rng(seed)
    state = (*system.coordinates, *system.velocities, system.time)
    return {symbol: float(generator.uniform(0.2, 0.8)) for symbol in (*state, *system.parameters)}


EQUATIONS = {
    "harmonic-oscillator": ["-k*q/m"],
    "planar-pendulum": ["-g*sin(q)/l"],
    "duffing": ["-alpha*q - beta*q**3 + gamma*cos(omega*t)"],
    "kepler": ["-mu*q1/(q1**2 + q2**2)**1.5", "-mu*q2/(q1**2 + q2**2)**1.5"],
    "spherical-pendulum": [
        "phi_dot**2*sin(theta)*cos(theta) - g*sin(theta)/l",
        "-2*theta_dot*phi_dot*cos(theta)/sin(theta)",
    ],
    "cart-pole": [
        "m*sin(theta)*(l*theta_dot**2 + g*cos(theta))/(M + m*sin(theta)**2)",
        "-(m*l*theta_dot**2*sin(theta)*cos(theta) + (M + m)*g*sin(theta))/(l*(M + m*sin(theta)**2))",
    ],
    "henon-heiles": ["-x - 2*coupling*x*y", "-y - coupling*(x**2 - y**2)"],
    "charged-particle": ["(e*B*(1 + gradient*x)*y_dot + e*E)/m", "-e*B*(1 + gradient*x)*x_dot/m", "0"],
    "relativistic-particle": ["-k*q*(1 - q_dot**2/c**2)**1.5/m"],
}


@pytest.mark.parametrize("name", EQUATIONS)
def test_equations_of_motion_of_the_catalogue(name: str) -> None:
    system = problem(name).system
    values = random_point(system)
    if name == "relativistic-particle":
        values[Symbol("c", real=True)] = 1.25
    numbers = {symbol.name: value for symbol, value in values.items()}
    expected = [eval(text, {"sin": np.sin, "cos": np.cos}, numbers) for text in EQUATIONS[name]]  # our own text
    assert accelerations(system, values) == pytest.approx(expected, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("name", PROBLEMS)
def test_every_entry_has_a_finite_state_and_a_text_round_trip(name: str) -> None:
    entry = problem(name)
    system = entry.system
    assert entry.name == name
    assert entry.title
    assert entry.reference
    assert 0 < entry.step < entry.span
    second = system.auxiliaries or system.velocities
    state = dict(zip((*system.coordinates, *second), (*entry.q, *(entry.p or entry.velocity)), strict=True))
    values = state | system.constants | {system.time: 0.0}
    assert np.isfinite(float(sympy.lambdify(list(values), system.formula)(*values.values())))
    common = {
        "name": system.name,
        "coordinates": [coordinate.name for coordinate in system.coordinates],
        "parameters": {parameter.name: value for parameter, value in system.constants.items()},
    }
    if isinstance(system, LagrangianSystem):
        assert system == LagrangianSystem.from_text(**common, lagrangian=system.to_text())
    else:
        momenta = [p.name for p in system.momenta]
        assert system == HamiltonianSystem.from_text(**common, momenta=momenta, hamiltonian=system.to_text())


def test_states_have_the_properties_in_their_titles() -> None:
    kepler, henon, relativistic = problem("kepler"), problem("henon-heiles"), problem("relativistic-particle")
    radius, speed = np.linalg.norm(kepler.q), np.linalg.norm(kepler.velocity)
    axis = 1 / (2 / radius - speed**2)
    assert axis == pytest.approx(1)
    assert 1 - radius / axis == pytest.approx(0.5)
    assert sum(v**2 for v in henon.velocity) / 2 == pytest.approx(1 / 8)
    gamma = 1 + relativistic.q[0] ** 2 / 2
    assert np.sqrt(1 - gamma**-2) == pytest.approx(0.87, abs=0.005)


def test_invalid_sizes_and_states_are_rejected() -> None:
    for size in (True, 2.0, -1):
        with pytest.raises(SystemDefinitionError, match="masses"):
            fput_chain(size)  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(SystemDefinitionError, match="initial state"):
        Problem(
            name="short",
            title="",
            system=fput_chain(2),
            q=(1.0,),
            velocity=(0.0, 0.0),
            step=1.0,
            span=1.0,
            reference="",
        )
