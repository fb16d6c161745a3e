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

SYMPLECTIC = (
    sc.SVI(1), sc.SVI(2, "gauss-legendre:3"), sc.SVI(4, "gauss-lobatto:5"), sc.SVI(3, "clenshaw-curtis:5"),
    sc.SVI(2, "gauss-radau-left:2"), *(sc.SCVI(s) for s in (1, 2, 3, 4, 5, 6)), sc.SCVI(3, "gauss-legendre:2"),
    sc.SCVI(3, abscissae="lobatto-iiia"), sc.SCVI(2, abscissae="radau-iia"), sc.SCVI(3, "gauss-lobatto:5"),
    sc.Gauss(3), sc.StoermerVerlet(),
)  # fmt: skip
FINITE_DIFFERENCES = 2e-12
"""Five times the noise of the differences (4e-13 measured); the smallest real defect below is 1e-7."""


SHOOTING = tuple(sc.SCVI(s) for s in (2, 3, 4, 5, 6))
ON_SYSTEMS = (
    *(("double-pendulum", method) for method in SYMPLECTIC),
    *(("kepler", method) for method in (sc.SVI(2, "gauss-legendre:3"), sc.SVI(3, "clenshaw-curtis:5"), *SHOOTING[:2])),
    *(("charged-particle", method) for method in (sc.SVI(4, "gauss-lobatto:5"), sc.Gauss(3), *SHOOTING[:2])),
    *(
        pytest.param(name, method, marks=pytest.mark.full)
        for name in ("kepler", "charged-particle")
        for method in SHOOTING[2:]
    ),
)


@pytest.mark.tiers(1, 3)
@pytest.mark.sampled(6)
@pytest.mark.parametrize(("name", "method"), ON_SYSTEMS, ids=lambda value: getattr(value, "name", value))
def test_symplectic_methods_preserve_the_two_form(sample, compiled, name, method):
    q, p = sample(name).state
    assert method.symplectic
    assert symplecticity_defect(compiled(name, method), q, p, 0.15, 0.4) < FINITE_DIFFERENCES


@pytest.mark.parametrize("method", [sc.SVI(3), sc.SCVI(3)], ids=lambda method: method.name)
def test_forced_time_dependent_systems_preserve_the_two_form(sample, compiled, method):
    q, p = sample("pumped-cart-pole").state
    assert symplecticity_defect(compiled("pumped-cart-pole", method), q, p, 0.15, 0.4) < FINITE_DIFFERENCES


PRINTED = {(2, 2): (0.0, 0.0), (3, 2): (4.6e-2, -2.3e-2), (5, 4): (6.6e-4, 6.7e-5), (9, 7): (1.0e-7, -1.2e-9)}
"""(points, quadrature points) -> (defect, change of angular momentum) of one Kepler step of the printed equations."""
KEPLER = np.array([0.3, 0.8]), np.array([-1.1, 0.4])


@pytest.mark.tiers(0, 2)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("size", "expected"), PRINTED.items())
def test_printed_shooting_equations_are_not_symplectic_but_variational_ones_are(compiled, size, expected):
    points, count = size
    printed = compiled("kepler", sc.SCVI(points - 1, f"gauss-legendre:{count}", variational=False))
    variational = compiled("kepler", sc.SCVI(points - 1, f"gauss-legendre:{count}"))
    before = angular_momentum(*KEPLER)
    assert angular_momentum(*printed.step(*KEPLER, 0.3)) - before == pytest.approx(expected[1], rel=0.05, abs=1e-15)
    assert abs(angular_momentum(*variational.step(*KEPLER, 0.3)) - before) < 1e-14
    assert symplecticity_defect(printed, *KEPLER, 0.3) == pytest.approx(expected[0], rel=0.05, abs=FINITE_DIFFERENCES)
    assert symplecticity_defect(variational, *KEPLER, 0.3) < FINITE_DIFFERENCES


# The properties that methods claim.

METHODS = (
    *(sc.SVI(s) for s in (1, 2, 3)),
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


@pytest.mark.parametrize("family", [sc.SCVI, sc.SpectralCollocation])
def test_asymmetry_on_chebyshev_lobatto_nodes_decreases_with_the_degree(sample, compiled, family):
    q, p = sample("planar-pendulum").state
    defects = [reversal_defect(compiled("planar-pendulum", family(s)), q, p, 0.6) for s in (2, 3, 5)]
    # 2e-5, 2e-7, 2e-12 for SCVI; 4e-3, 2e-4, 6e-7 for SC.
    assert defects[0] > 10 * defects[1] > 100 * defects[2] > 1e-10
    assert reversal_defect(compiled("planar-pendulum", sc.SVI(2)), q, p, 0.6) < 1e-15


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


@pytest.mark.quick
def test_newton_solver_conserves_angular_momentum_to_round_off(compiled):
    entry = sc.problem("kepler")
    run = compiled("kepler", sc.SVI(4), solver="newton").integrate(entry.q, entry.velocity, h=0.05, steps=STEPS)
    L = angular_momentum(run.q, run.p)
    assert np.abs(L - L[0]).max() < 2e-14


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", VARIATIONAL, ids=lambda method: method.name)
def test_spherical_pendulum_conserves_azimuthal_momentum_exactly(sample, compiled, method):
    q, p = sample("spherical-pendulum").state
    run = compiled("spherical-pendulum", method).integrate(q, p, h=0.05, steps=STEPS)
    assert np.abs(run.p[:, 1] - p[1]).max() == 0.0


@pytest.mark.parametrize("method", [sc.SVI(3), sc.SCVI(3)], ids=lambda method: method.name)
def test_free_bodies_conserve_linear_and_angular_momentum_to_round_off(sample, compiled, method):
    q, p = sample("three-bodies").state
    run = compiled("three-bodies", method).integrate(q, p, h=0.1, steps=STEPS)
    q, p = (x.reshape(len(run), 3, 2) for x in (run.q, run.p))
    linear, angular = p.sum(axis=1), angular_momentum(q, p).sum(axis=1)
    assert np.abs(linear - linear[0]).max() < 1e-14
    assert np.abs(angular - angular[0]).max() < 1e-12


def check_solar_system(compiled, method, steps):
    entry = sc.problem("outer-solar-system")
    stepper = compiled("outer-solar-system", method)
    run = stepper.integrate(
        entry.q, stepper.momentum(entry.q, entry.velocity), h=entry.step, steps=steps, save_every=10
    )
    q, p = (x.reshape(len(run), 6, 3) for x in (run.q, run.p))
    linear, angular = p.sum(axis=1), np.cross(q, p).sum(axis=1)
    scale = np.abs(np.cross(q[0], p[0])).sum(axis=0).max()
    assert np.abs(linear - linear[0]).max() < 1e-14 * np.abs(p[0]).sum()
    assert np.abs(angular - angular[0]).max() < 1e-13 * scale


def test_outer_solar_system_conserves_momenta_to_round_off(compiled):
    check_solar_system(compiled, sc.SVI(3), 1000)


@pytest.mark.full
@pytest.mark.parametrize("method", [sc.SVI(3), sc.SVI(6), sc.SCVI(4)], ids=lambda method: method.name)
def test_outer_solar_system_conserves_momenta_over_long_times(compiled, method):
    check_solar_system(compiled, method, STEPS)


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
DRIFTING = (sc.SpectralCollocation(3), sc.RadauIIA(3), sc.SCVI(3, variational=False))


@pytest.mark.tiers(2, 3)
@pytest.mark.sampled(3)
@pytest.mark.parametrize("method", DRIFTLESS, ids=lambda method: method.name)
@pytest.mark.parametrize("name", ["planar-pendulum", "henon-heiles"])
def test_symplectic_methods_show_no_energy_drift(sample, compiled, name, method):
    first, last = energy_errors(compiled, name, method, *sample(name).state, 0.3)
    assert 0.0 < last < 1.1 * first


@pytest.mark.tiers(1)
@pytest.mark.parametrize("method", DRIFTING, ids=lambda method: method.name)
def test_nonsymplectic_methods_drift(sample, compiled, method):
    first, last = energy_errors(compiled, "planar-pendulum", method, *sample("planar-pendulum").state, 0.3)
    assert last > 2.0 * first
