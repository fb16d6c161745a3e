"""Preserved quantities: dq ^ dp, momentum maps, reversibility, energy without drift; and counterexamples."""

import numpy as np
import pytest
from tiers import family, first_of_each

import scvi_codegen as sc

pytestmark = pytest.mark.second

DERIVATIVE_WEIGHTS = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
"""Central differences of order six."""
WIDTH = 2e-3
"""Where round-off (1e-16 / WIDTH) and truncation (WIDTH^6 f^(7) / 140) both stay near 1e-13 at the states used here."""


def step_jacobian(step, state):
    """d step(z) / dz by sixth-order differences."""
    columns = [
        sum(w / WIDTH * (step(state + k * unit) - step(state - k * unit)) for k, w in DERIVATIVE_WEIGHTS.items())
        for unit in np.eye(len(state)) * WIDTH
    ]
    return np.array(columns).T


def symplecticity_defect(stepper, q, p, h, t=0.0):
    """Max |J^T Omega J - Omega|."""
    m = len(q)
    J = step_jacobian(lambda z: np.concatenate(stepper.step(z[:m], z[m:], h, t)), np.concatenate([q, p]))
    omega = np.kron([[0, 1], [-1, 0]], np.eye(m))
    return np.abs(J.T @ omega @ J - omega).max()


def reversal_defect(stepper, q, p, h, t=0.0):
    """Return the distance between the start and the result of a step followed by a step with -h."""
    back = stepper.step(*stepper.step(q, p, h, t), -h, t + h)
    return np.abs(np.array(back) - [q, p]).max()


def angular_momentum(q, p):
    return q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]


# Symplecticity.

FINITE_DIFFERENCES = 2e-12
"""Five times the noise of the differences (4e-13 measured); the smallest real defect below is 1e-7."""


# The properties that methods claim.

METHODS = (
    *(sc.SVI(s) for s in (1, 2, 3)),
    sc.SVI(4, "gauss-lobatto:5"),
    sc.SVI(2, "gauss-lobatto:3"),
    sc.SVI(2, "gauss-radau-right:2"),
    sc.SVI(2, "gauss-radau-left:3"),
    *(sc.SCVI(s) for s in (1, 2, 3)),
    sc.SCVI(1, "gauss-radau-left:2"),
    sc.SCVI(2, nodes="equispaced"),
    *(sc.SCVI(s, variational=False) for s in (1, 2, 3)),
    *(sc.SVI(3, rule) for rule in ("gauss-lobatto:3", "clenshaw-curtis:4", "fejer:5")),
    *(sc.SCVI(2, abscissae=family) for family in ("gauss", "radau-iia", "lobatto-iiia", "chebyshev-gauss")),
    *(sc.SCVI(3, abscissae=family) for family in ("gauss", "lobatto-iiia", "chebyshev-gauss", "chebyshev-lobatto")),
    sc.SCVI(2, "gauss-radau-left:3", abscissae="gauss"),
    *(sc.SpectralCollocation(s, form=form) for s in (1, 2, 3) for form in ("position", "phase-space")),
    *(family(2, form="position") for family in (sc.Gauss, sc.RadauIIA, sc.LobattoIIIA, sc.ChebyshevGauss)),
    *(family(2) for family in (sc.Gauss, sc.RadauIIA, sc.LobattoIIIA, sc.ChebyshevGauss)),
    sc.Gauss(1),
    sc.Gauss(1, form="position"),
    sc.LobattoIIIA(3),
    sc.ChebyshevGauss(3),
    sc.ChebyshevLobatto(4),
    sc.RadauIA(1),
    sc.RadauIA(2),
    sc.CollocationRK([0.5]),
    sc.CollocationRK([0.2, 0.9]),
    sc.CollocationRK([0.25, 0.75]),
    sc.StoermerVerlet(),
    sc.ExplicitEuler(),
    sc.ExplicitEuler(form="position"),
)


@pytest.mark.tiers(0, 4)
@pytest.mark.sampled(12)
@pytest.mark.parametrize("name", ["pumped-cart-pole", pytest.param("double-pendulum", marks=pytest.mark.full)])
@pytest.mark.parametrize("method", first_of_each(METHODS, family), ids=lambda method: method.name)
def test_claims_of_symmetry_and_symplecticity_agree_with_measurement(sample, compiled, method, name):
    """Both ways: what is claimed holds, and what is not claimed fails by far more than noise."""
    stepper, (q, p) = compiled(name, method), sample(name).state
    reversal, defect = reversal_defect(stepper, q, p, 0.15, 0.4), symplecticity_defect(stepper, q, p, 0.15, 0.4)
    assert reversal < 1e-12 if method.symmetric else reversal > 1e-10
    assert defect < FINITE_DIFFERENCES if method.symplectic else defect > 1e-7


# Momentum maps over long runs.

VARIATIONAL = (sc.SVI(4), sc.SVI(2, "gauss-legendre:3"), sc.SCVI(4), sc.StoermerVerlet())
STEPS = 10_000


@pytest.mark.quick
@pytest.mark.parametrize("method", VARIATIONAL, ids=lambda method: method.name)
def test_kepler_conserves_angular_momentum_to_round_off(compiled, method):
    entry = sc.problem("kepler")
    run = compiled("kepler", method).integrate(entry.q, entry.velocity, h=0.05, steps=STEPS)
    L = angular_momentum(run.q, run.p)
    assert np.abs(L - L[0]).max() < 2e-14


@pytest.mark.rotated
def test_methods_without_a_discrete_lagrangian_do_not_conserve_angular_momentum(compiled):
    """Counterexample to the tests above: these methods do not conserve the quantity."""
    entry = sc.problem("kepler")
    for method in (sc.SpectralCollocation(4), sc.SCVI(4, variational=False), sc.RadauIIA(3)):
        run = compiled("kepler", method).integrate(entry.q, entry.velocity, h=0.05, steps=1000)
        assert abs(angular_momentum(run.q, run.p)[-1] - angular_momentum(run.q, run.p)[0]) > 1e-9


# Energy.


def energy_errors(compiled, name, method, q, p, h):
    """Largest |energy error| in the first and in the last tenth of a long run."""
    run = compiled(name, method).integrate(q, p, h=h, steps=STEPS)
    error = np.abs(run.energy() - run.energy()[0])
    return error[: STEPS // 10].max(), error[-STEPS // 10 :].max()


DRIFTLESS = (sc.SVI(3), sc.SVI(3, "gauss-legendre:4"), sc.SCVI(3), sc.StoermerVerlet())


@pytest.mark.tiers(2, 3)
@pytest.mark.sampled(3)
@pytest.mark.parametrize("method", DRIFTLESS, ids=lambda method: method.name)
@pytest.mark.parametrize("name", ["planar-pendulum", "henon-heiles"])
def test_symplectic_methods_show_no_energy_drift(sample, compiled, name, method):
    first, last = energy_errors(compiled, name, method, *sample(name).state, 0.3)
    assert 0.0 < last < 1.1 * first
