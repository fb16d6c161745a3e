"""Random regular Lagrangians and random methods: the compiled step is the oracle's."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import oracle
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.methods.method import Method

TENTHS = st.integers(-9, 9).map(lambda k: k / 10)
VELOCITY_TERMS = (
    "a*cos({x} - {y})*{x}_dot*{y}_dot/8",
    "exp(-{x}**2)*{y}_dot**2/3",
    "sin(t)*{x}_dot**2/10",
    "{x}_dot**4/12",
    "sqrt(1 + {x}_dot**2 + b**2*{y}_dot**2)",
    "b*{x}*{y}_dot",
    "{x}**2*{y}_dot*cos(a*t)/2",
    "{x}_dot*{y}",
    "cosh({y}_dot/2)/3",
)
"""Each at most once: together they take less than a half from the masses below, which are at least 1 (|a|, |b| < 1)."""
POTENTIAL_TERMS = (
    "{x}*{y}", "a*{x}**4/4", "cos({x} + b*{y})", "exp(-{x}**2 - {y}**2)", "{x}*cos(2*t)", "t**2*{y}**3/10",
    "log(2 + {x}**2)", "1/(1 + ({x} - {y})**2)", "atan({x}*{y})", "sqrt(3 + {x}**2 + t**2)", "tanh(b*{y} - t)",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A Lagrangian, a method, a state and where to step from."""

    system: sc.LagrangianSystem
    method: Method
    q: tuple[float, ...]
    v: tuple[float, ...]
    h: float
    t: float
    parameters: dict[str, float]


def mass_matrix(entries, size):
    """A quadratic form F^T F + 1, regular whatever the entries."""
    F = np.reshape(entries, (3, 3))[:size, :size]
    return F.T @ F + np.eye(size)


def lagrangian(names, mass, terms):
    kinetic = [f"{mass[i, j]!s}*{x}_dot*{y}_dot/2" for (i, x), (j, y) in product(enumerate(names), repeat=2)]
    return " + ".join([*kinetic, *terms])


@st.composite
def systems(draw):
    names = draw(st.sampled_from([("x",), ("x", "y"), ("x", "y", "z")]))
    mass = mass_matrix(draw(st.lists(TENTHS, min_size=9, max_size=9)), len(names))
    pairs = st.tuples(st.sampled_from(names), st.sampled_from(names))
    choices = st.tuples(st.sampled_from((*VELOCITY_TERMS, *POTENTIAL_TERMS)), pairs)
    chosen = st.lists(choices, min_size=1, max_size=5, unique_by=lambda choice: choice[0])
    terms = [term.format(x=x, y=y) for term, (x, y) in draw(chosen)]
    return lagrange("random", names, lagrangian(names, mass, terms), a=0.7, b=-0.4)


def quadratures(least):
    families = ("gauss-legendre", "gauss-lobatto", "gauss-radau-left", "clenshaw-curtis", "fejer")
    counts = st.integers(max(2, least), least + 3)
    return st.tuples(st.sampled_from(families), counts).map(lambda pair: f"{pair[0]}:{pair[1]}")


@st.composite
def methods(draw):
    degree, form = draw(st.integers(1, 3)), draw(st.sampled_from(["position", "phase-space"]))
    quadrature = draw(quadratures(degree))
    nodes = draw(st.sampled_from(["chebyshev-lobatto", "legendre-lobatto", "equispaced"]))
    return draw(
        st.sampled_from(
            [
                sc.SVI(degree, quadrature),
                sc.SVI(degree + 1),
                sc.SCVI(degree, quadrature, nodes),
                sc.SCVI(degree, quadrature, nodes, variational=False),
                sc.SpectralCollocation(degree, nodes, form),
                sc.Gauss(degree, form=form),
                sc.RadauIIA(degree, form=form),
                sc.RadauIA(degree, form=form),
                sc.LobattoIIIA(degree + 1, form=form),
                sc.ChebyshevGauss(degree, form=form),
                sc.StoermerVerlet(),
                sc.ExplicitEuler(form=form),
            ]
        )
    )


@st.composite
def cases(draw):
    system = draw(systems())
    coordinates = st.lists(TENTHS, min_size=system.dimension, max_size=system.dimension).map(tuple)
    return Case(
        system=system,
        method=draw(methods()),
        q=draw(coordinates),
        v=draw(coordinates),
        h=draw(st.sampled_from([0.1, 0.07, -0.05])),
        t=draw(st.sampled_from([0.0, 0.6, -2.5])),
        parameters=draw(st.fixed_dictionaries({}, optional={"a": TENTHS, "b": TENTHS})),
    )


def check(case, quickly_compiled):
    mechanics = oracle.Mechanics(case.system, case.parameters)
    stepper = quickly_compiled(case.system, case.method)
    p = stepper.momentum(case.q, case.v, case.t, case.parameters)
    expected = np.array(oracle.oracle_step(mechanics, case.method.specification(), case.q, p, case.h, case.t))
    found = np.array(stepper.step(case.q, p, case.h, case.t, case.parameters))
    # Masses are between 1/2 and 10 and forces of size 1: h times the stiffness is below 1, round-off not amplified.
    assert np.abs(found - expected).max() <= 5e-14 * max(1.0, np.abs(expected).max())


COMMON = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow], "database": None}


@pytest.mark.rotated
@given(case=cases())
@settings(max_examples=12, derandomize=True, **COMMON)
def test_random_steps_agree_with_the_oracle(quickly_compiled, case):
    check(case, quickly_compiled)


@pytest.mark.full
@given(case=cases())
@settings(max_examples=300, **COMMON)
def test_many_random_steps_agree_with_the_oracle(quickly_compiled, case):
    check(case, quickly_compiled)
