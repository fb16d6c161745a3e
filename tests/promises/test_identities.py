"""Methods that must be one and the same map, to round-off, and near relatives that must not.

The other side of each identity is the oracle, or a stepper compiled from another stage system.
"""

import numpy as np
import oracle
import pytest

from scvi_codegen.errors import MethodError
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
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
ANY = ("kepler", "double-pendulum", "charged-particle", "pumped-cart-pole", "relativistic-particle")
SOME = ("kepler", "pumped-cart-pole", "relativistic-particle")
CONSTANT_MASS = ("kepler", "driven-duffing")


def distance(left, right):
    return np.abs(np.array(left) - np.array(right)).max()


def oracle_map(sample, name, function, h=H, **arguments):
    case = sample(name)
    q, p = map(oracle.numbers, case.state)
    return np.array(function(case.mechanics, oracle.mp.mpf(T), q, p, oracle.mp.mpf(h), **arguments)).astype(float)


def compiled_map(sample, compiled, name, method, h=H):
    return np.array(compiled(name, method).step(*sample(name).state, h, T))


# 1. SVI depends on degree and quadrature only.


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", ANY)
def test_svi_does_not_depend_on_its_nodes(sample, compiled, name):
    c, w = oracle.rule("gauss-legendre:4")
    node_sets = [oracle.points(family, 4) for family in ("chebyshev-lobatto", "lobatto", "equispaced")]
    node_sets.append(oracle.numbers([0, 0.2, 0.3, 1]))
    found = [
        *(oracle_map(sample, name, oracle.svi, nodes=nodes, c=c, w=w) for nodes in node_sets),
        *(
            compiled_map(sample, compiled, name, SVI(3, "gauss-legendre:4", nodes))
            for nodes in ("chebyshev-lobatto", "legendre-lobatto", "equispaced")
        ),
    ]
    assert max(distance(one, found[0]) for one in found) < ROUND_OFF


def test_scvi_and_collocation_do_depend_on_their_nodes(sample, compiled):
    for family in (SCVI, SpectralCollocation):
        maps = [
            compiled_map(sample, compiled, "kepler", family(3, nodes=nodes))
            for nodes in ("chebyshev-lobatto", "legendre-lobatto", "equispaced")
        ]
        assert min(distance(maps[0], maps[1]), distance(maps[0], maps[2])) > 1e-11


# 2. SVI with s Gauss points is Gauss collocation.


@pytest.mark.covering
@pytest.mark.parametrize("name", SOME)
@pytest.mark.parametrize("s", [1, 2, 4])
def test_svi_with_as_many_gauss_points_as_its_degree_is_gauss_collocation(sample, compiled, name, s):
    """Three ways: Galerkin, the oracle's tableau, and general collocation on abscissae that only a reader knows to be
    Gauss's (rounded to floats, which changes the map by less than round-off)."""
    svi = compiled_map(sample, compiled, name, SVI(s))
    c = oracle.points("gauss", s)
    expected = oracle_map(sample, name, oracle.runge_kutta, **oracle.collocation_tableau(c))
    assert distance(svi, expected) < ROUND_OFF
    assert distance(compiled_map(sample, compiled, name, Gauss(s)), expected) < ROUND_OFF
    assert distance(compiled_map(sample, compiled, name, CollocationRK(c.astype(float).tolist())), expected) < ROUND_OFF


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ANY)
def test_additional_gauss_point_changes_the_map(sample, compiled, name):
    two, three = (compiled_map(sample, compiled, name, SVI(2, f"gauss-legendre:{g}")) for g in (2, 3))
    assert distance(two, three) > 1e-9


# 3. SVI with Lobatto points and the Lobatto IIIA-IIIB pairs.


@pytest.mark.covering
@pytest.mark.parametrize("name", SOME)
@pytest.mark.parametrize("s", [2, 3, 4])
def test_svi_with_as_many_lobatto_points_as_its_degree_is_the_lobatto_pair(sample, compiled, name, s):
    expected = oracle_map(sample, name, oracle.partitioned, **oracle.lobatto_pair(s))
    assert distance(compiled_map(sample, compiled, name, SVI(s, f"gauss-lobatto:{s}")), expected) < ROUND_OFF


@pytest.mark.covering
@pytest.mark.parametrize("name", CONSTANT_MASS)
@pytest.mark.parametrize("s", [1, 2, 3])
def test_constant_mass_additional_lobatto_point_is_the_next_pair(sample, compiled, name, s):
    expected = oracle_map(sample, name, oracle.partitioned, **oracle.lobatto_pair(s + 1))
    assert distance(compiled_map(sample, compiled, name, SVI(s, f"gauss-lobatto:{s + 1}")), expected) < ROUND_OFF


@pytest.mark.full
@pytest.mark.parametrize("name", ["double-pendulum", "charged-particle", "pumped-cart-pole"])
def test_other_lagrangians_additional_lobatto_point_is_not_the_next_pair(sample, compiled, name):
    differences = [
        distance(
            compiled_map(sample, compiled, name, SVI(s, f"gauss-lobatto:{s + 1}")),
            oracle_map(sample, name, oracle.partitioned, **oracle.lobatto_pair(s + 1)),
        )
        for s in (1, 2, 3)
    ]
    assert differences[0] > 1e-5
    assert differences[0] > differences[1] > differences[2] > 1e-12


def test_nonquadratic_kinetic_energy_distinguishes_methods_from_degree_two(sample, compiled):
    """For L = T(v) - V(q) the single velocity of degree 1 makes no difference; two velocities do."""
    name = "relativistic-particle"
    one, two = (
        distance(
            compiled_map(sample, compiled, name, SVI(s, f"gauss-lobatto:{s + 1}")),
            oracle_map(sample, name, oracle.partitioned, **oracle.lobatto_pair(s + 1)),
        )
        for s in (1, 2)
    )
    assert one < ROUND_OFF
    assert two > 1e-8


@pytest.mark.parametrize("name", CONSTANT_MASS)
def test_svi_of_degree_one_with_the_trapezoidal_rule_is_leapfrog(sample, compiled, name):
    expected = oracle_map(sample, name, oracle.leapfrog)
    assert distance(compiled_map(sample, compiled, name, SVI(1, "gauss-lobatto:2")), expected) < ROUND_OFF
    assert distance(compiled_map(sample, compiled, name, StoermerVerlet()), expected) < ROUND_OFF


@pytest.mark.parametrize("name", ANY)
def test_svi_of_degree_one_with_one_gauss_point_is_the_midpoint_rule(sample, compiled, name):
    """The midpoint rule on (q, p): q1 = q0 + h v, p1 = p0 + h L_q, both at the mean of the states."""
    case = sample(name)
    q, p = case.state
    q1, p1 = compiled(name, SVI(1)).step(q, p, H, T)
    middle = [oracle.numbers([T + H / 2]), oracle.numbers([(q + q1) / 2]), oracle.numbers([(q1 - q) / H])]
    assert distance(case.mechanics.momentum(*middle)[0].astype(float), (p + p1) / 2) < ROUND_OFF
    assert distance(case.mechanics.force(*middle)[0].astype(float), (p1 - p) / H) < 10 * ROUND_OFF  # divided by H


# 4. With two nodes the shooting methods are the Galerkin one.


@pytest.mark.covering
@pytest.mark.parametrize("name", SOME)
@pytest.mark.parametrize("quadrature", ["gauss-legendre:1", "gauss-lobatto:2"])
def test_scvi_of_degree_one_is_svi_of_degree_one(sample, compiled, name, quadrature):
    c, w = oracle.rule(quadrature)
    two = oracle.points("chebyshev-lobatto", 2)
    svi = compiled_map(sample, compiled, name, SVI(1, quadrature))
    for function in (oracle.scvi, oracle.scvi_printed):
        assert distance(oracle_map(sample, name, function, nodes=two, c=c, w=w), svi) < ROUND_OFF
    for variational in (True, False):
        scvi = compiled_map(sample, compiled, name, SCVI(1, quadrature, variational=variational))
        assert distance(scvi, svi) < ROUND_OFF


def test_three_nodes_give_three_maps(sample, compiled):
    methods = SVI(2, "gauss-legendre:3"), SCVI(2, "gauss-legendre:3"), SCVI(2, "gauss-legendre:3", variational=False)
    svi, scvi, printed = (compiled_map(sample, compiled, "kepler", method) for method in methods)
    assert min(distance(svi, scvi), distance(svi, printed), distance(scvi, printed)) > 1e-8


# 5. Spectral collocation is collocation Runge-Kutta.


@pytest.mark.covering
@pytest.mark.parametrize("name", ["kepler", "pumped-cart-pole"])
@pytest.mark.parametrize("s", [1, 2, 3])
@pytest.mark.parametrize("form", ["position", "phase-space"])
def test_spectral_collocation_is_collocation_runge_kutta_on_its_later_nodes(sample, compiled, name, s, form):
    nodes = oracle.points("chebyshev-lobatto", s + 1)
    nodal, stages = {
        "position": (oracle.sc_position, oracle.runge_kutta_position),
        "phase-space": (oracle.sc_phase_space, oracle.runge_kutta),
    }[form]
    by_nodes = oracle_map(sample, name, nodal, nodes=nodes)
    by_stages = oracle_map(sample, name, stages, **oracle.collocation_tableau(nodes[1:]))
    assert distance(by_nodes, by_stages) < 1e-15
    assert distance(compiled_map(sample, compiled, name, SpectralCollocation(s, form=form)), by_nodes) < ROUND_OFF


@pytest.mark.full
@pytest.mark.parametrize(("name", "same"), [("kepler", True), ("charged-particle", False)])
def test_position_and_phase_space_form_agree_only_for_constant_mass(sample, compiled, name, same):
    """A vector potential is enough to part them: p is not a constant multiple of v."""
    for one, other in (
        (SpectralCollocation(2), SpectralCollocation(2, form="phase-space")),
        (LobattoIIIA(3, form="position"), LobattoIIIA(3)),
        (RadauIIA(2, form="position"), RadauIIA(2)),
    ):
        difference = distance(compiled_map(sample, compiled, name, one), compiled_map(sample, compiled, name, other))
        assert difference < ROUND_OFF if same else difference > 1e-9


# 6. SCVI on abscissae.


@pytest.mark.parametrize("name", SOME)
def test_the_abscissae_of_nodes_give_the_scvi_on_those_nodes(sample, compiled, name):
    nodes = SCVI(3)
    abscissae = SCVI(3, abscissae=[(1 + x) / 2 for x in nodes.node_set.points[1:]])
    maps = [compiled_map(sample, compiled, name, method) for method in (nodes, abscissae)]
    assert distance(*maps) < 1e-15


@pytest.mark.covering
@pytest.mark.parametrize("s", [2, 3, 4])
@pytest.mark.parametrize("name", CONSTANT_MASS)
def test_constant_mass_scvi_on_gauss_points_is_svi(sample, compiled, name, s):
    maps = [compiled_map(sample, compiled, name, method) for method in (SCVI(s, abscissae="gauss"), SVI(s))]
    assert distance(*maps) < ROUND_OFF


def test_variable_mass_scvi_on_gauss_points_is_not_svi(sample, compiled):
    """SCVI collocates the second-order equations, Gauss methods the first-order equations."""
    maps = [
        compiled_map(sample, compiled, "double-pendulum", method) for method in (SCVI(2, abscissae="gauss"), SVI(2))
    ]
    assert distance(*maps) > 1e-7


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"abscissae": "gauss", "nodes": "chebyshev-lobatto"}, "not both"),
        ({"abscissae": "gauss", "variational": False}, "requires nodes at both ends"),
        ({"abscissae": "radau-ia"}, "there are no abscissae called 'radau-ia'"),
        ({"abscissae": [0.2, 0.8]}, "a curve of degree 3 requires 3 abscissae, not 2"),
        ({"abscissae": [0.2, 0.2, 0.8]}, "not greater than the one before"),
    ],
)
def test_invalid_abscissae_are_rejected(arguments, message):
    with pytest.raises(MethodError, match=message):
        SCVI(3, **arguments)


# 7. Total time derivatives.


def with_gauge(name, order):
    """Duffing's oscillator with d/dt (q^order (1 + t)) added to L, and the gradient of that function."""
    lagrangian = "q_dot**2/2 + alpha*q**2/2 - q**4/4 + q*cos(t)/3"
    gauge = f" + {order}*q**{order - 1}*q_dot*(1 + t) + q**{order}"
    return LagrangianSystem.from_text(
        name=name, coordinates=["q"], parameters={"alpha": 1.2}, lagrangian=lagrangian + (gauge if order else "")
    )


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
