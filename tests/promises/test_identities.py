"""Methods that must be one and the same map, to round-off, and near relatives that must not.

The other side of each identity is the oracle, or a stepper compiled from another stage system.
"""

from itertools import combinations

import numpy as np
import oracle
import pytest
from notation import lagrange

from scvi_codegen import hamiltonian_of
from scvi_codegen.methods import (
    SCVI,
    SVI,
    CollocationRK,
    Gauss,
    LobattoIIIA,
    RadauIIA,
    SpectralCollocation,
    StoermerVerlet,
)

H, T = 0.13, 0.4
ROUND_OFF = 2e-14
CONSTANT_MASS = ("kepler", "driven-duffing")
SOME = ("kepler", "pumped-cart-pole", "relativistic-particle")
ANY = (*SOME, "double-pendulum", "charged-particle")
FAMILIES = ("chebyshev-lobatto", "legendre-lobatto", "equispaced")


def distance(left, right):
    return np.abs(np.array(left) - np.array(right)).max()


def by_oracle(function, **arguments):
    """A step of the oracle, as a function of a sample."""

    def step(case):
        q, p = map(oracle.numbers, case.state)
        return np.array(function(case.mechanics, oracle.mp.mpf(T), q, p, oracle.mp.mpf(H), **arguments)).astype(float)

    return step


def galerkin(nodes):
    c, w = oracle.rule("gauss-legendre:4")
    return by_oracle(oracle.svi, nodes=nodes, c=c, w=w)


def shooting(function, quadrature):
    c, w = oracle.rule(quadrature)
    return by_oracle(function, nodes=oracle.points("chebyshev-lobatto", 2), c=c, w=w)


def collocation(c, function=oracle.runge_kutta):
    return by_oracle(function, **oracle.collocation_tableau(c))


def lobatto_pair(s):
    return by_oracle(oracle.partitioned, **oracle.lobatto_pair(s))


def later_nodes(s, form, nodal, stages):
    """Spectral collocation is collocation Runge-Kutta on all nodes but the first."""
    nodes = oracle.points("chebyshev-lobatto", s + 1)
    return SpectralCollocation(s, form=form), by_oracle(nodal, nodes=nodes), collocation(nodes[1:], stages)


def same_maps():
    """Systems and methods of one map, by name; each kind of SVI depends on degree and quadrature only."""
    node_sets = [oracle.points(family, 4) for family in ("chebyshev-lobatto", "lobatto", "equispaced")]
    galerkins = map(galerkin, [*node_sets, oracle.numbers([0, 0.2, 0.3, 1])])
    yield "svi on any nodes", ANY, (*(SVI(3, "gauss-legendre:4", nodes) for nodes in FAMILIES), *galerkins)
    for s in (1, 2, 4):  # floats of Gauss's abscissae change the map by less than round-off
        c = oracle.points("gauss", s)
        yield f"svi:{s} is gauss:{s}", SOME, (SVI(s), Gauss(s), CollocationRK(c.astype(float).tolist()), collocation(c))
    for s in (2, 3, 4):
        yield f"svi:{s} with {s} lobatto points", SOME, (SVI(s, f"gauss-lobatto:{s}"), lobatto_pair(s))
        yield f"scvi:{s} on gauss points", CONSTANT_MASS, (SCVI(s, abscissae="gauss"), SVI(s))
    for s in (1, 2, 3):
        more = SVI(s, f"gauss-lobatto:{s + 1}"), lobatto_pair(s + 1)
        yield f"svi:{s} with {s + 1} lobatto points", CONSTANT_MASS + ("relativistic-particle",) * (s == 1), more
        yield (
            f"sc:{s} by positions",
            SOME[:2],
            later_nodes(s, "position", oracle.sc_position, oracle.runge_kutta_position),
        )
        yield (
            f"sc:{s} in phase space",
            SOME[:2],
            later_nodes(s, "phase-space", oracle.sc_phase_space, oracle.runge_kutta),
        )
    yield "leapfrog", CONSTANT_MASS, (SVI(1, "gauss-lobatto:2"), StoermerVerlet(), by_oracle(oracle.leapfrog))
    for rule in ("gauss-legendre:1", "gauss-lobatto:2"):  # with two nodes
        oracles = (shooting(function, rule) for function in (oracle.scvi, oracle.scvi_printed))
        yield f"scvi:1 with {rule}", SOME, (SVI(1, rule), SCVI(1, rule), SCVI(1, rule, variational=False), *oracles)
    abscissae = [(1 + x) / 2 for x in SCVI(3).node_set.points[1:]]
    yield "scvi:3 on its abscissae", SOME, (SCVI(3), SCVI(3, abscissae=abscissae))
    for one in FORMS:
        yield f"{one[0].name} of a constant mass", ("kepler",), one


FORMS = (
    (SpectralCollocation(2), SpectralCollocation(2, form="phase-space")),
    (LobattoIIIA(3, form="position"), LobattoIIIA(3)),
    (RadauIIA(2, form="position"), RadauIIA(2)),
)
"""Equations of positions and of phase space: of a vector potential p is no constant multiple of v."""


def different_maps():
    """Systems, methods, no two of which are the same map, and their least distance."""
    for family in (SCVI, SpectralCollocation):
        yield (
            f"{family.__name__} on other nodes",
            ("kepler",),
            1e-11,
            [family(3, nodes=nodes) for nodes in FAMILIES[:2]],
        )
        yield f"{family.__name__} on equal ones", ("kepler",), 1e-11, [family(3, nodes=x) for x in FAMILIES[::2]]
    yield "a further gauss point", ANY, 1e-9, [SVI(2, f"gauss-legendre:{g}") for g in (2, 3)]
    for s, least in ((1, 1e-5), (2, 1e-9), (3, 1e-12)):
        yield f"svi:{s} of variable masses", ANY[3:], least, (SVI(s, f"gauss-lobatto:{s + 1}"), lobatto_pair(s + 1))
    more = SVI(2, "gauss-lobatto:3"), lobatto_pair(3)  # of L = T(v) - V(q), two velocities make a difference
    yield "svi:2 of a kinetic energy that is not quadratic", ("relativistic-particle",), 1e-8, more
    three = [method(2, "gauss-legendre:3") for method in (SVI, SCVI)]
    yield "three nodes", ("kepler",), 1e-8, [*three, SCVI(2, "gauss-legendre:3", variational=False)]
    yield "scvi collocates second-order equations", ("double-pendulum",), 1e-7, (SCVI(2, abscissae="gauss"), SVI(2))
    for one in FORMS:
        yield f"{one[0].name} of a vector potential", ("charged-particle",), 1e-9, one


CASES = [(name, system, ways, None) for name, systems, ways in same_maps() for system in systems]
CASES += [(name, system, ways, least) for name, systems, least, ways in different_maps() for system in systems]


BETWEEN = (
    "svi:2 is gauss:2",
    "svi:3 with 3 lobatto points",
    "scvi:3 on gauss points",
    "svi:2 with 3 lobatto points",
    "sc:2 by positions",
    "sc:2 in phase space",
)
"""Degrees whose neighbours are in the default tier."""


@pytest.mark.tiers(0, 2)
@pytest.mark.parametrize(
    ("name", "system", "ways", "least"),
    [
        pytest.param(
            *case, id=f"{case[0]}-{case[1]}", marks=pytest.mark.full if case[0] == before or case[0] in BETWEEN else []
        )
        for case, (before, *_) in zip(CASES, [("",), *CASES], strict=False)
    ],
)
def test_methods_are_one_map_or_different_ones(sample, compiled, name, system, ways, least):
    case = sample(system)
    maps = [way(case) if callable(way) else compiled(system, way).step(*case.state, H, T) for way in ways]
    if least is None:
        assert max(distance(maps[0], each) for each in maps[1:]) < ROUND_OFF
    else:
        assert min(distance(*each) for each in combinations(maps, 2)) > least


@pytest.mark.tiers(1, 4)
@pytest.mark.parametrize("name", ANY)
def test_svi_of_degree_one_with_one_gauss_point_is_the_midpoint_rule(sample, compiled, name):
    """The midpoint rule on (q, p): q1 = q0 + h v, p1 = p0 + h L_q, both at the mean of the states."""
    case = sample(name)
    q, p = case.state
    q1, p1 = compiled(name, SVI(1)).step(q, p, H, T)
    middle = [oracle.numbers([T + H / 2]), oracle.numbers([(q + q1) / 2]), oracle.numbers([(q1 - q) / H])]
    assert distance(case.mechanics.momentum(*middle)[0].astype(float), (p + p1) / 2) < ROUND_OFF
    assert distance(case.mechanics.force(*middle)[0].astype(float), (p1 - p) / H) < 10 * ROUND_OFF  # divided by H


def with_gauge(name, order):
    """Duffing's oscillator with d/dt (q^order (1 + t)) added to L, and the gradient of that function."""
    lagrangian = "q_dot**2/2 + alpha*q**2/2 - q**4/4 + q*cos(t)/3"
    gauge = f" + {order}*q**{order - 1}*q_dot*(1 + t) + q**{order}"
    return lagrange(name, "q", lagrangian + (gauge if order else ""), alpha=1.2)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("method", "order", "exact"),
    [
        (SVI(3), 1, True),
        (SVI(3, "gauss-lobatto:4"), 1, True),
        (SVI(3, "gauss-legendre:4"), 2, True),
        (SVI(3), 2, False),
        (SCVI(3, "gauss-legendre:5"), 3, True),
        (SCVI(3), 3, False),
    ],
    ids=lambda value: getattr(value, "name", str(value)),
)
def test_a_total_derivative_moves_momenta_only_if_the_quadrature_is_exact_for_it(
    quickly_compiled, method, order, exact
):
    """Along a curve of degree s, d/dt (q^n (1 + t)) is a polynomial of degree n s."""
    plain = quickly_compiled(with_gauge("plain", 0), method)
    shifted = quickly_compiled(with_gauge("gauged", order), method)
    assert exact == (order * method.degree < method.rule.order)

    def gradient(q, t):
        return order * q ** (order - 1) * (1 + t)

    q, p, h = np.array([0.7]), np.array([-0.4]), 0.4
    q1, p1 = plain.step(q, p, h, T)
    q2, p2 = shifted.step(q, p + gradient(q, T), h, T)
    difference = distance((q2, p2 - gradient(q2, T + h)), (q1, p1))
    assert difference < 1e-13 if exact else difference > 1e-9


@pytest.mark.full
@pytest.mark.parametrize(
    "method", [SVI(3), Gauss(3), SpectralCollocation(4, form="phase-space")], ids=lambda method: method.name
)
def test_hamiltonian_with_forces_has_the_same_step(sample, quickly_compiled, method):
    case = sample("radial-friction")
    steps = [
        quickly_compiled(system, method).step(*case.state, 0.1) for system in (case.system, hamiltonian_of(case.system))
    ]
    np.testing.assert_allclose(*steps, rtol=3e-15)
