"""A flow in PyTorch: against runs and leapfrog written in it; its transformations, and what it refuses."""

from functools import cache

import pumped_leapfrog as pumped
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS

from scvi_codegen import SVI, MethodError, StateError, StepFailedError, compile_stepper, problem, torch_flow

torch = pytest.importorskip("torch", reason="needs the extra 'torch'")
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # PyTorch's warning of its own call

STEPS = 12
X = [0.4, 0.1, -0.2, 0.3, 0.05]
"""q, p and h of Henon and Heiles."""


@cache
def galaxy():
    return compile_stepper(problem("henon-heiles").system, "stoermer-verlet", flags=QUICK_FLAGS)


@cache
def kepler():
    return compile_stepper(problem("kepler").system, SVI(3), flags=QUICK_FLAGS)


def numbers(values):
    return torch.tensor(values, dtype=torch.float64)


def by_c(x, save_every=None):
    q, p = torch_flow(galaxy(), steps=STEPS, save_every=save_every)(x[..., :2], x[..., 2:4], h=x[..., 4])
    return torch.cat([q, p], dim=-1)


def leapfrog(x):
    """The end, which PyTorch differentiates itself."""
    q, p, h = x[:2], x[2:4], x[4]

    def force(q):
        return -torch.stack([q[0] + 2 * q[0] * q[1], q[1] + q[0] ** 2 - q[1] ** 2])

    for _ in range(STEPS):
        p = p + h / 2 * force(q)
        q = q + h * p
        p = p + h / 2 * force(q)
    return torch.cat([q, p])


def test_second_derivatives_are_those_of_leapfrog():
    """Forward and back over a gradient, and back over forward."""

    def along(flow):
        return lambda x: (flow(x)[0] ** 2 * flow(x)[3] + torch.sin(flow(x)[2])).sum()

    expected = torch.func.hessian(along(leapfrog))(numbers(X))
    for outer, inner in (("jacfwd", "jacrev"), ("jacrev", "jacrev"), ("jacrev", "jacfwd")):
        found = getattr(torch.func, outer)(getattr(torch.func, inner)(along(by_c)))(numbers(X))
        assert_allclose(found, expected, atol=1e-10)
    extra = torch.func.vmap(torch.func.hessian(along(by_c)))(torch.stack([1.01 * numbers(X), numbers(X)]))
    assert_allclose(extra[1], expected, atol=1e-10)


def test_unsupported_functions_are_rejected():
    flow, q, p = torch_flow(kepler(), steps=5), numbers([0.5, 0.0]), numbers([0.0, 1.6])
    with pytest.raises(MethodError, match="no forward-over-forward second derivatives"):
        torch.func.jacfwd(torch.func.jacfwd(lambda q: flow(q, p, h=0.05)[0].sum()))(q)
    with pytest.raises(StateError, match=r"give torch\.float64"):
        flow(q.float(), p, h=0.05)
    with pytest.raises(StateError, match=r"q must have shape \(\.\., 2\), not \(3,\)"):
        flow(numbers([0.0, 1.0, 2.0]), p, h=0.05)
    with pytest.raises(StateError, match="leading axes"):
        flow(torch.ones(3, 2, dtype=torch.float64), torch.ones(2, 2, dtype=torch.float64), h=0.05)
    with pytest.raises(StepFailedError):
        flow(numbers([0.0, 0.0]), p, h=0.05)


def test_derivatives_by_time_and_parameters_of_a_segmented_flow():
    flow = torch_flow(pumped.stepper(), steps=pumped.STEPS, save_every=pumped.EVERY)

    def along(x):
        return torch.cat(flow(x[:2], x[2:4], h=x[9], t=x[8], parameters=x[4:8]), dim=-1)

    for row in pumped.ROWS:
        assert_allclose(along(numbers(row)), pumped.states(row), rtol=0, atol=2e-12)
        for derivative in (torch.func.jacfwd, torch.func.jacrev):
            assert_allclose(derivative(along)(numbers(row)), pumped.partials(row), rtol=1e-11, atol=1e-11)
