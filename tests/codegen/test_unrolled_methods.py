"""Equations written out are those with tables, to the bit where the compiler fuses nothing, and those of the paper."""

import math

import pytest
from notation import hamilton

from scvi_codegen import SCVI, SVI, Gauss, StoermerVerlet, compile_stepper, generate_source, problem
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.codegen.rendering.kernels import functions
from scvi_codegen.runs.stepper import Stepper

PENDULUM = problem("planar-pendulum").system

pytestmark = pytest.mark.usefixtures("as_users_compile")

TWO_POINTS = SCVI(1, "gauss-legendre:2")
HAMILTONIAN = hamilton("pendulum", "x", "y**2*(1 + x**2/5)/2 - cos(x)", momenta="y")
CASES = {
    "pendulum, two points": (PENDULUM, TWO_POINTS),
    "pendulum, trapezium": (PENDULUM, StoermerVerlet()),
    "double pendulum": (problem("double-pendulum").system, SVI(1)),
    "Kepler": (problem("kepler").system, TWO_POINTS),
    "driven": (problem("duffing").system.with_parameters(gamma=0.7, omega=1.3), TWO_POINTS),
    "Hamiltonian": (HAMILTONIAN, SVI(1)),
    "Hamiltonian, Gauss": (HAMILTONIAN, Gauss(1)),
}


def both(case, monkeypatch, flags):
    """The stepper written out, and that with tables."""
    steppers = []
    for most in (functions.MOST_TERMS, -1):
        monkeypatch.setattr(functions, "MOST_TERMS", most)
        source, interface = generate_source(*CASES[case], solver="newton", prefix="p")
        assert ("#define UNROLLED_EQUATIONS" in source.code) == (most >= 0)
        steppers.append(Stepper(source, interface, **flags))
    return steppers


@pytest.mark.rotated
@pytest.mark.sampled(3)
@pytest.mark.parametrize("case", CASES)
def test_unrolled_and_tabulated_methods_are_equal(case, monkeypatch):
    m = CASES[case][0].dimension
    q, p = [0.9, 0.4][:m], [0.3, 0.8][:m]
    ours, theirs = (
        each.integrate(q, p, h=0.05, steps=100) for each in both(case, monkeypatch, {"flags": PORTABLE_FLAGS})
    )
    assert (ours.q == theirs.q).all()
    assert (ours.p == theirs.p).all()


@pytest.mark.second
def test_example_of_the_paper_is_solved():
    """Equation (37) and (34e), with the numbers that the paper prints, at the states of the compiled step."""
    h, q0, p0 = 0.1, 0.5, 0.2
    stepper = compile_stepper(PENDULUM, TWO_POINTS, solver="newton")
    q1, p1 = (float(x[0]) for x in stepper.step([q0], [p0], h, parameters={"m": 1.0, "l": 1.0, "g": 1.0}))
    near, far = (3 + math.sqrt(3)) / 6, (3 - math.sqrt(3)) / 6
    first, second = math.sin(near * q0 + far * q1), math.sin(far * q0 + near * q1)
    assert -q1 / h + q0 / h - h / 2 * (near * first + far * second) + p0 == pytest.approx(0, abs=1e-14)
    assert (q1 - q0) / h - h / 2 * (far * first + near * second) == pytest.approx(p1, abs=1e-14)
