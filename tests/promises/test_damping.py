"""Uniform damping: phase area shrinks by exp(-gamma h) in every step to rounding.

The references are L exp(gamma t) with momenta scaled by hand, where time occurs in a Lagrangian without damping, and
SciPy's DOP853 on the equations of motion.
"""

from fractions import Fraction

import numpy as np
import pytest
import sympy
from notation import lagrange
from samples import QUICK_FLAGS, damped_pair

import scvi_codegen as sc

GAMMA = 0.4 * 0.9
"""Rate of :func:`damped_pair`."""


@pytest.mark.rotated
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


def test_unsupported_functions_of_damping_are_rejected():
    x, c = sympy.Function("x")(sympy.Symbol("t", real=True)), sympy.Symbol("c", real=True)
    for rate in (sympy.zeta(c), sympy.I * c, sympy.oo):
        with pytest.raises(sc.SystemDefinitionError, match="in the damping of 'odd'"):
            sc.LagrangianSystem.from_sympy(
                name="odd", coordinates=[x], lagrangian=x.diff() ** 2, parameters={"c": 1.0}, damping=rate
            )
