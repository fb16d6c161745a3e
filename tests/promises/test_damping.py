"""Uniform damping: phase area shrinks by exp(-gamma h) in every step to rounding.

The references are L exp(gamma t) with momenta scaled by hand, where time occurs in a Lagrangian without damping, and
SciPy's DOP853 on the equations of motion.
"""

from fractions import Fraction

import numpy as np
import pytest
import sympy
from notation import hamilton, lagrange
from samples import QUICK_FLAGS, damped_pair
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.model_file import parse_model

GAMMA = 0.4 * 0.9
"""Rate of :func:`damped_pair`."""


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.covering
@pytest.mark.parametrize("solver", ["auto", "newton"])
@pytest.mark.parametrize(
    "method",
    [
        sc.SVI(1),
        sc.SVI(3),
        sc.SVI(2, "gauss-lobatto:3"),
        sc.SVI(2, "gauss-legendre:4"),
        sc.Gauss(2),
        sc.RadauIIA(2),
        sc.StoermerVerlet(),
    ],
    ids=lambda method: method.name,
)
def test_a_step_is_that_of_the_scaled_lagrangian(method, solver):
    """At any time: exp(gamma t) of the start is a unit of action."""
    scaled = lagrange("scaled", "x y", f"exp(c*m*t)*({damped_pair().lagrangian})", c=0.4, m=0.9)
    own = sc.compile_stepper(damped_pair(), method, solver=solver, flags=QUICK_FLAGS)
    other = sc.compile_stepper(scaled, method, solver=solver, flags=QUICK_FLAGS)
    for t, h in ((0.0, 0.1), (7.0, -0.07)):
        grown = np.exp(GAMMA * t)
        q, p = own.step([0.3, -0.4], [0.5, 0.7], h, t)
        same_q, grown_p = other.step([0.3, -0.4], np.multiply([0.5, 0.7], grown), h, t)
        assert np.abs(q - same_q).max() < 1e-15
        assert np.abs(p - grown_p / np.exp(GAMMA * (t + h))).max() < 4e-15


@pytest.mark.tiers(1)
@pytest.mark.parametrize(
    "method", [sc.SVI(1), sc.SVI(3), sc.Gauss(2), sc.StoermerVerlet()], ids=lambda method: method.name
)
def test_linear_steps_contract_area_exactly(method):
    system = lagrange("damped oscillator", "q", "q_dot**2/2 - k*q**2/2", c=0.3, k=2.0, damping="c")
    stepper = sc.compile_stepper(system, method)
    for t in (0.0, 1e6):
        columns = [np.concatenate(stepper.step([q], [p], 0.2, t)) for q, p in ((1.0, 0.0), (0.0, 1.0))]
        assert np.linalg.det(columns) == pytest.approx(np.exp(-0.3 * 0.2), rel=5e-16)


@pytest.mark.second
def test_momentum_maps_decay_exactly_and_work_is_reported():
    """The angular momentum of a body about a centre; damping takes energy to the order of the method."""
    system = lagrange(
        "slowed body", "x y", "m*(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)", m=2.0, c=0.2, damping="c"
    )
    assert system.changes_energy
    stepper = sc.compile_stepper(system, sc.SVI(3))
    assert not stepper.interface.map_names
    assert stepper.impulse_names == ("angular momentum",)
    apart = []
    for h in (0.1, 0.05):
        run = stepper.integrate([1.0, 0.0], velocity=[0.1, 0.9], h=h, steps=round(3 / h))
        angular = run.q[:, 0] * run.p[:, 1] - run.q[:, 1] * run.p[:, 0]
        assert np.abs(angular / angular[0] - np.exp(-0.2 * run.t)).max() < 4e-15
        apart.append(np.abs(run.energy() - run.energy()[0] - run.work()).max())
        taken = np.abs(angular - angular[0] - run.impulses()[:, 0]).max()
    assert np.log2(apart[0] / apart[1]) > 5.6
    assert taken < 1e-9


@pytest.mark.second
def test_damping_with_adaptive_steps_ensembles_and_hamiltonians():
    """Lanes with different rates; H, its Lagrangian, additional forces; constrained systems."""
    hamiltonian = hamilton(
        "damped from H", "x", "p**2/(2*m) - cos(x)", momenta="p", m=1.5, c=0.3, forces={"x": "cos(t)/2"}, damping="c"
    )

    def pendulum(t, z, rate):
        return [z[1] / 1.5, -np.sin(z[0]) + np.cos(t) / 2 - rate * z[1]]

    for system in (hamiltonian, sc.lagrangian_of(hamiltonian)):
        stepper = sc.compile_stepper(system, sc.SVI(4), flags=QUICK_FLAGS)
        values = np.array([[1.5, 0.3], [1.5, 1.2], [1.5, -0.1]])
        ends = [
            solve_ivp(pendulum, (0, 3), [1.0, 0.2], args=(c,), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            for c in values[:, 1]
        ]
        run = stepper.integrate([1.0], [0.2], t_end=3.0)
        assert np.abs([run.q[-1, 0], run.p[-1, 0]] - ends[0]).max() < 1e-10
        q, p = np.full((3, 1), 1.0), np.full((3, 1), 0.2)
        many = stepper.integrate_ensemble(q, p, h=0.05, steps=60, parameters={"c": values[:, 1]})
        assert np.abs(np.concatenate([many.q[-1], many.p[-1]], axis=1) - ends).max() < 1e-8


@pytest.mark.second
def test_constrained_motion_is_that_of_the_angle():
    rod = lagrange(
        "damped rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", c=0.5, damping="c", constraints=["x**2 + y**2 = 1"]
    )
    angle = lagrange("damped angle", "a", "a_dot**2/2 + cos(a)", c=0.5, damping="c")
    exact = sc.compile_stepper(angle, "svi:8").integrate([1.0], [0.0], h=0.1, steps=20).q[-1, 0]
    stepper, errors = sc.compile_stepper(rod, sc.SVI(2, "gauss-lobatto:3"), flags=QUICK_FLAGS), []
    for steps in (20, 40):
        run = stepper.integrate([np.sin(1), -np.cos(1)], velocity=[0, 0], h=2 / steps, steps=steps)
        errors.append(np.abs(run.q[-1] - [np.sin(exact), -np.cos(exact)]).max())
        assert np.abs(run.constraint_values()).max() < 4e-15
    assert np.log2(errors[0] / errors[1]) > 3.7


@pytest.mark.rotated
def test_certificate_reports_damping():
    certificate = sc.verify(damped_pair(), sc.SVI(2), [0.3, -0.4], [0.5, 0.7], h=0.1)
    assert certificate.passed, certificate.to_text()
    assert not certificate.not_measured
    names = {check.name for check in certificate.checks}
    assert "conformal symplecticity" in names
    assert "symplecticity" not in names


@pytest.mark.parametrize(
    "given", [0.25, "0.25", np.float64(0.25), Fraction(1, 4), sympy.Rational(1, 4)], ids=lambda x: type(x).__name__
)
def test_damping_rate_may_be_a_number(given):
    """Text, SymPy and model files are equivalent; other types are rejected by name."""
    x = sympy.Function("x")(sympy.Symbol("t", real=True))
    systems = []
    if not isinstance(given, str):
        systems += [sc.LagrangianSystem.from_sympy(name="a", coordinates=[x], lagrangian=x.diff() ** 2, damping=given)]
    if not isinstance(given, sympy.Expr):
        one = {"name": "a", "coordinates": ["x"], "damping": given}
        systems += [
            sc.LagrangianSystem.from_text(lagrangian="x_dot**2", **one),
            sc.HamiltonianSystem.from_text(hamiltonian="p_x**2", **one),
        ]
    assert [system.damping for system in systems] == [sympy.Rational(1, 4)] * len(systems)
    with pytest.raises(sc.SystemDefinitionError, match=r"damping must be a formula as text, or a number, not \['c'\]"):
        sc.LagrangianSystem.from_text(name="a", coordinates=["x"], lagrangian="x_dot**2", damping=["c"])


@pytest.mark.parametrize("written", ["0.25", '"0.25"', "'1/4'"])
def test_damping_rate_may_be_a_number_in_a_model_file(written):
    text = f"""
        system = {{ name = "a", coordinates = ["x"], lagrangian = "x_dot**2/2", damping = {written} }}
        initial = {{ q = [0.0], q_dot = [1.0] }}
        run = {{ step = 0.1, steps = 10 }}
        forces = {{ x = 0.5 }}
    """
    model = parse_model(text)
    assert (model.system.damping, model.system.forces) == (sympy.Rational(1, 4), (sympy.Rational(1, 2),))
    with pytest.raises(sc.ModelFileError, match="damping must be a formula between quotes or a number, not"):
        parse_model(text.replace(f"damping = {written}", "damping = true"))


def test_unsupported_functions_of_damping_are_rejected():
    x, c = sympy.Function("x")(sympy.Symbol("t", real=True)), sympy.Symbol("c", real=True)
    for rate in (sympy.zeta(c), sympy.I * c, sympy.oo):
        with pytest.raises(sc.SystemDefinitionError, match="in the damping of 'odd'"):
            sc.LagrangianSystem.from_sympy(
                name="odd", coordinates=[x], lagrangian=x.diff() ** 2, parameters={"c": 1.0}, damping=rate
            )
