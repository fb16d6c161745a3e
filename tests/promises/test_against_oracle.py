"""Compiled steps equal those of the slow oracle, for every kind of Lagrangian and every family of methods."""

import numpy as np
import oracle
import pytest
from samples import UNOPTIMISED_FLAGS
from tiers import family, first_of_each

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import FLAGS_VARIABLE, TUNED_FLAGS

pytestmark = pytest.mark.long

SEPARABLE = ("planar-pendulum", "kepler")
COUPLED = ("double-pendulum", "cart-pole")
SYSTEMS = (*SEPARABLE, *COUPLED, "charged-particle", "driven-duffing", "pumped-cart-pole", "relativistic-particle")
FEW = (
    sc.SVI(2, "gauss-legendre:3"),
    sc.SCVI(3),
    sc.SCVI(2, abscissae="chebyshev-gauss"),
    sc.SCVI(2, variational=False),
    sc.SpectralCollocation(2),
    sc.RadauIIA(2),
)
MANY = (
    sc.SVI(1, "gauss-lobatto:2"), *(sc.SVI(s) for s in (1, 2, 3, 4, 5)),
    *(sc.SVI(s, f"gauss-lobatto:{s + 1}") for s in (2, 3, 4, 5)), sc.SVI(3, "clenshaw-curtis:6"),
    sc.SVI(2, "fejer:5"), sc.SVI(3, "gauss-radau-left:4"), sc.SVI(2, "gauss-radau-right:3"),
    *(sc.SCVI(s, f"gauss-legendre:{s}") for s in (1, 2, 4, 5)),
    *(sc.SCVI(s, f"gauss-legendre:{s + 1}") for s in (2, 3)), sc.SCVI(3, "gauss-lobatto:6"),
    sc.SCVI(3, nodes="legendre-lobatto"), sc.SCVI(2, "gauss-legendre:1"), sc.SCVI(2, abscissae="gauss"),
    sc.SCVI(3, abscissae="radau-iia"), sc.SCVI(3, abscissae="lobatto-iiia"),
    sc.SCVI(2, "gauss-lobatto:4", abscissae=(0.125, 0.75)), sc.SCVI(4, "gauss-legendre:3", variational=False),
    sc.SCVI(1, "gauss-lobatto:2", variational=False),
    *(sc.SpectralCollocation(s, form=form) for s in (1, 3, 5) for form in ("position", "phase-space")),
    sc.SpectralCollocation(4, nodes="equispaced"), sc.Gauss(1), sc.Gauss(4), sc.Gauss(2, form="position"),
    sc.RadauIIA(3, form="position"), sc.RadauIA(1), sc.RadauIA(2), sc.RadauIA(3), sc.RadauIA(1, form="position"),
    sc.RadauIA(3, form="position"), sc.LobattoIIIA(2), sc.LobattoIIIA(4), sc.LobattoIIIA(3, form="position"),
    sc.ChebyshevGauss(3), sc.ChebyshevLobatto(4), sc.CollocationRK([0.1, 0.35, 0.8]),
    sc.CollocationRK([0.2, 0.9], form="position"), sc.StoermerVerlet(), sc.ExplicitEuler(),
    sc.ExplicitEuler(form="position"),
)  # fmt: skip
H, T = 0.11, 0.37
TOLERANCE = 2e-14
"""Of the state: a step rounds its answer once (1e-16), and its kernels and Newton's last update some tens of times."""


def relative(found, expected):
    """The largest difference, relative to the size of the state (never less than 1)."""
    return np.abs(np.array(found) - expected).max() / max(1.0, np.abs(expected).max())


def check(sample, compiled, name, method, *, h=H, t=T, **how):
    case = sample(name)
    q, p = case.state
    assert relative(compiled(name, method, **how).step(q, p, h, t), case.oracle(method, q, p, h, t)) < TOLERANCE


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.covering
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("method", FEW, ids=lambda method: method.name)
def test_every_kind_of_lagrangian_agrees_with_the_oracle(sample, compiled, name, method, monkeypatch):
    """Compiled as users do."""
    monkeypatch.delenv(FLAGS_VARIABLE, raising=False)
    check(sample, compiled, name, method, flags=TUNED_FLAGS)


SOLVED_BOTH_WAYS = (
    ("kepler", sc.SVI(3)),
    ("kepler", sc.SVI(2, "gauss-legendre:4")),
    ("kepler", sc.SpectralCollocation(3)),
    ("double-pendulum", sc.SVI(3)),
    ("double-pendulum", sc.RadauIIA(2)),
    ("pumped-cart-pole", sc.SVI(2, "gauss-lobatto:2")),
    ("relativistic-particle", sc.Gauss(2)),
    ("driven-duffing", sc.RadauIA(3)),
    ("charged-particle", sc.StoermerVerlet()),
    ("double-pendulum", sc.SpectralCollocation(3)),
    ("pumped-cart-pole", sc.SCVI(3, "gauss-legendre:4", variational=False)),
    ("kepler", sc.SCVI(2, variational=False)),
    ("charged-particle", sc.RadauIA(2, form="position")),
    ("relativistic-particle", sc.LobattoIIIA(3, form="position")),
)


@pytest.mark.tiers(1, 3)
@pytest.mark.sampled(6)
@pytest.mark.parametrize("solver", ["newton", "fixed-point"])
@pytest.mark.parametrize(("name", "method"), SOLVED_BOTH_WAYS, ids=lambda value: getattr(value, "name", value))
def test_both_solvers_agree_with_the_oracle(sample, compiled, name, method, solver):
    check(sample, compiled, name, method, solver=solver)


@pytest.mark.tiers(1, 3)
@pytest.mark.sampled(18)
@pytest.mark.parametrize("method", first_of_each(MANY, family), ids=lambda method: method.name)
def test_every_family_of_methods_agrees_with_the_oracle(sample, compiled, method):
    """The Lagrangian is coupled, has masses depending on angle and time, and velocity-dependent terms."""
    check(sample, compiled, "pumped-cart-pole", method)


@pytest.mark.full
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("method", MANY, ids=lambda method: method.name)
def test_every_method_on_every_system_agrees_with_the_oracle(sample, compiled, name, method):
    check(sample, compiled, name, method, flags=UNOPTIMISED_FLAGS)


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("degree", [20, *(pytest.param(s, marks=pytest.mark.full) for s in (17, 24, 28, 32))])
@pytest.mark.parametrize("name", ["kepler", "pumped-cart-pole"])
def test_steps_of_more_than_16_points_agree_with_the_oracle(sample, compiled, name, degree):
    """They are padded to whole vectors of 8. The flow is that of 8 points to round-off: fixed, adaptive, linearised."""
    case, stepper = sample(name), compiled(name, sc.SVI(degree))
    q, p = case.state
    exact = case.oracle(sc.SVI(8), q, p, H, T)
    for steps in ({"h": H, "steps": 1}, {"h": H / 4, "steps": 4}, {"t_end": T + H}):
        run = stepper.integrate(q, p, t=T, **steps)
        assert relative((run.q[-1], run.p[-1]), exact) < TOLERANCE
    moves = 1e-5 * np.reshape(np.eye(2 * len(q)), (-1, 2, len(q)))
    after, before = ([np.ravel(stepper.step(*(np.array([q, p]) + s * x), H, T)) for x in moves] for s in (1, -1))
    assert relative(stepper.jacobian(q, p, H, T), np.subtract(after, before).T / 2e-5) < 1e-8


@pytest.mark.parametrize("name", ["planar-pendulum", "kepler", "driven-duffing"])
def test_verlet_is_the_leapfrog_of_separable_systems(sample, compiled, name):
    case = sample(name)
    q, p = case.state
    arguments = (oracle.mp.mpf(T), oracle.numbers(q), oracle.numbers(p), oracle.mp.mpf(H))
    expected = np.array(oracle.leapfrog(case.mechanics, *arguments)).astype(float)
    assert relative(compiled(name, sc.StoermerVerlet()).step(q, p, H, T), expected) < TOLERANCE


@pytest.mark.rotated
def test_oracle_distinguishes_neighbouring_methods_and_times(sample):
    """The comparison has teeth: neighbouring methods and a slightly other time are far outside the tolerance."""
    case = sample("pumped-cart-pole")
    q, p = case.state
    right = case.oracle(sc.SVI(3), q, p, H, T)
    assert relative(case.oracle(sc.SVI(3, "gauss-legendre:4"), q, p, H, T), right) > 1e3 * TOLERANCE
    assert relative(case.oracle(sc.SCVI(3), q, p, H, T), right) > 1e3 * TOLERANCE
    assert relative(case.oracle(sc.SVI(3), q, p, H, T + 1e-9), right) > 1e3 * TOLERANCE


def test_the_oracles_radau_ia_satisfies_its_simplifying_condition():
    """D(s): sum_i b_i c_i^(k-1) a_ij = b_j (1 - c_j^k) / k, and b integrates polynomials below degree 2 s - 1."""
    for s in (1, 2, 3):
        A, b, c = oracle.radau_ia(s).values()
        for k in range(1, s + 1):
            assert max(abs((b * c ** (k - 1)) @ A - b * (1 - c**k) / k)) < 1e-45
        for k in range(2 * s - 1):
            assert abs(b @ c**k - oracle.mp.mpf(1) / (k + 1)) < 1e-45
