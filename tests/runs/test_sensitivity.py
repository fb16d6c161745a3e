"""Derivatives of steps by all they start from, by differences in 60 digits; and their transpose."""

from functools import cache

import numpy as np
import pytest
from certified_cases import Case
from certified_cases import case as certified
from notation import lagrange
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS
from scipy.linalg import block_diag

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.extras.exact.step import DerivedStep
from scvi_codegen.methods.discretise import is_symplectic, paper_equations
from scvi_codegen.runs.stepping.step_derivatives import Starts


def pushed_pendulum():
    """A damped pendulum with an input, whose five parameters are those of its piece."""
    text = "l*q_dot**2/2 + cos(q)"
    return lagrange(
        "pushed pendulum", "q", text, forces={"q": "u"}, dissipation="c*q_dot**2/2", inputs="u", l=1.2, c=0.1
    ).with_parameters(u_0=0.3, u_1=-0.2, u_2=0.5, u_3=0.1, u_t=0.05)


NAMES = [
    *("driven/svi", "kepler/svi-3", "cart/svi", "pendulum/hermite", "vortices/svi", "double/scvi", "kepler/printed"),
    *("kepler/sc-phase-space", "wire/lobatto-svi", "driven/euler", "cart/verlet", "pushed/svi", "sleigh/lobatto-svi"),
    *(
        pytest.param(name, marks=pytest.mark.full)
        for name in (
            *("double/svi", "pendulum/splines", "double/gauss", "double/radau-ia", "driven/chebyshev"),
            *("kepler/composition", "linkage/lobatto-svi", "double/gauss-position"),
        )
    ),
]
"""Systems and methods: with forces, constraints, inputs, explicit time, of Hamiltonians; of every solver."""

OWN = {"pushed/svi": Case(pushed_pendulum(), lambda: sc.SVI(2), (0.4,), (-0.8,), 0.2)}
T = 0.3
EXACT, BOUND = 1e-13, 3e-13
"""Relative; of constrained systems, whose equations h makes ill-conditioned."""
SECOND, SECOND_BOUND = 1e-13, 1e-11
"""The same of second derivatives."""


@cache
def given(name):
    """A stepper, a state, and a step."""
    case = OWN.get(name) or certified(name)
    stepper = sc.compile_stepper(case.system, case.method(), flags=QUICK_FLAGS)
    q, p = stepper.project(case.q, case.p, t=T) if case.system.constraints else (case.q, case.p)
    return case, stepper, np.array(q, dtype=float), np.array(p, dtype=float), case.h


def by_differences(case, q, p, h, t, directions):
    """(2m, n) derivatives along n directions, of the paper's equations solved in 60 digits."""
    system, width, m = case.system, mp.mpf(10) ** -15, len(q)
    step = DerivedStep(system, paper_equations(system, case.method()))

    def end(numbers):
        found = step.with_parameters(numbers[2 * m : -2])(numbers[:m], numbers[m : 2 * m], numbers[-1], numbers[-2])
        return np.array([*found.q, *found.p])

    start, columns = [mp.mpf(x) for x in (*q, *p, *system.defaults, t, h)], []
    for direction in directions:
        ends = [end([x + by * mp.mpf(d) for x, d in zip(start, direction, strict=True)]) for by in (width, -width)]
        columns.append(((ends[0] - ends[1]) / (2 * width)).astype(float))
    return np.array(columns).T


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", NAMES)
def test_derivatives_of_a_step_by_all_arguments(name):
    """Along a random direction of the state and one of the parameters, and by time and step size."""
    case, stepper, q, p, h = given(name)
    m, found = len(q), stepper.sensitivity(q, p, h, T, stepper.defaults)
    blocks = [found.state, found.parameters, found.t[:, np.newaxis], found.h[:, np.newaxis]]
    assert [block.shape for block in blocks] == [(2 * m, n) for n in (2 * m, len(stepper.defaults), 1, 1)]
    weights = [np.random.default_rng(3).normal(size=block.shape[1]) for block in blocks]
    exact = by_differences(case, q, p, h, T, block_diag(*weights))
    tolerance = BOUND if case.system.constraints else EXACT
    for block, direction, own in zip(blocks, weights, exact.T, strict=True):
        largest = np.abs(block).max(initial=0.0) * np.abs(direction).sum()
        assert np.abs(block @ direction - own).max() <= tolerance * largest
    if is_symplectic(case.method(), case.system) and not case.system.constraints:
        omega = np.kron([[0, 1], [-1, 0]], np.eye(m))
        assert np.abs(found.state.T @ omega @ found.state - omega).max() < 4e-15
    assert np.array_equal(found.state, stepper.jacobian(q, p, h, T, stepper.defaults))


def curvature(stepper, q, p, h, t, weights):
    """(given, given) second derivatives of weights . (q1, p1) of a step."""
    size, starts = stepper._input_size, Starts.chain(q, p, np.array([t]), np.array([h]))
    changes, vectors = np.zeros((2, size, size)), np.zeros((2, 2, size, size))
    changes[0], vectors[1, 0, :, : 2 * len(q)] = np.eye(size), weights
    stepper._propagate(starts, changes, stepper.defaults, None)
    stepper._second_order_adjoint(starts, changes, vectors, stepper.defaults, None)
    return vectors[0, 1]


def second_difference(case, start, direction, weights):
    """Return the second difference of weights . (q1, p1) along a direction, of equations solved in 60 digits."""
    m, width = len(weights) // 2, mp.mpf(10) ** -15
    step = DerivedStep(case.system, paper_equations(case.system, case.method()))
    ends = []
    for by in (1, 0, -1):
        x = [mp.mpf(a) + by * width * mp.mpf(b) for a, b in zip(start, direction, strict=True)]
        found = step.with_parameters(x[2 * m : -2])(x[:m], x[m : 2 * m], x[-1], x[-2])
        ends.append(mp.fdot(weights.tolist(), [*found.q, *found.p]))
    return float((ends[0] - 2 * ends[1] + ends[2]) / width**2)


@pytest.mark.rotated
@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", NAMES)
def test_second_derivatives_of_a_step_by_all_arguments(name):
    """Directions weight all entries equally; symmetry determines all of them."""
    case, stepper, q, p, h = given(name)
    rng, start = np.random.default_rng(7), np.array([*q, *p, *stepper.defaults, T, h])
    weights = rng.normal(size=2 * len(q))
    found = curvature(stepper, q, p, h, T, weights)
    sizes = 1.0 / np.sqrt(np.maximum(np.abs(found).max(axis=1), 1e-6 * np.abs(found).max()))
    scaled = sizes[:, np.newaxis] * found * sizes
    tolerance = SECOND_BOUND if case.system.constraints else SECOND
    assert np.abs(scaled - scaled.T).max() < tolerance
    for _ in range(3):
        direction = rng.normal(size=len(start))
        exact = second_difference(case, start, sizes * direction, weights)
        assert abs(direction @ scaled @ direction - exact) < tolerance * np.abs(direction).sum() ** 2


@pytest.mark.rotated
@pytest.mark.parametrize("name", NAMES)
def test_vector_products_agree_with_the_jacobian(name):
    _, stepper, q, p, h = given(name)
    at, size = (q, p, h, T, stepper.defaults), 2 * len(q)
    found, vectors = stepper.jacobian(*at), np.random.default_rng(6).normal(size=(3, size))
    pushed, pulled = stepper.jvp(*at, tangents=vectors), stepper.vjp(*at, cotangents=vectors)
    assert_allclose(pushed, vectors @ found.T, rtol=0, atol=1e-12 * np.abs(found).max())
    assert_allclose(pulled, vectors @ found, rtol=0, atol=1e-12 * np.abs(found).max())
    assert np.array_equal(stepper.vjp(*at, cotangents=vectors[0]), stepper.vjp(*at, cotangents=vectors[:1])[0])
    with pytest.raises(
        sc.StateError, match=rf"tangents must have the shape \({size},\) or \(k, {size}\), not \(2, 1\)"
    ):
        stepper.jvp(*at, tangents=np.zeros((2, 1)))
