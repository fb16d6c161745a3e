"""Curves other than polynomials, and quadratures with derivatives: exactness, order, structure, and where each wins."""

import numpy as np
import pytest

from scvi_codegen import MethodError, MethodWarning, compile_stepper, problem
from scvi_codegen.common.precision import mp
from scvi_codegen.methods import SVI, method_from_specification
from scvi_codegen.methods.tables.basis import cardinal_values
from scvi_codegen.methods.tables.quadrature import Quadrature, gauss_legendre, hermite, quadrature_by_name
from scvi_codegen.methods.tables.spaces import Polynomials, Splines, Trigonometric, space_by_name

QUICK = ("-O1", "-ffp-contract=off")


def stepper(system, method, **choices):
    return compile_stepper(system, method, flags=QUICK, **choices)


def final_error(system, method, start, *, h, steps, reference):
    run = stepper(system, method).integrate(*start, h=h, steps=steps)
    return np.abs(run.q[-1] - reference).max()


# Tables.


@pytest.mark.parametrize(
    ("space", "degree", "curve", "derivative"),
    [
        (Trigonometric(0.7), 2, lambda c: mp.sin(0.7 * c), lambda c: 0.7 * mp.cos(0.7 * c)),
        (Trigonometric(0.7), 5, lambda c: mp.cos(1.4 * c) - 1 + c, lambda c: 1 - 1.4 * mp.sin(1.4 * c)),
        (Trigonometric(2.5, 1), 4, lambda c: c**2 + mp.sin(2.5 * c), lambda c: 2 * c + 2.5 * mp.cos(2.5 * c)),
        (Splines(2), 3, lambda c: max(c - mp.mpf("0.5"), 0) ** 2, lambda c: 2 * max(c - mp.mpf("0.5"), 0)),
        (Splines(4), 4, lambda c: max(c - 0.75, 0) ** 3, lambda c: 3 * max(c - 0.75, 0) ** 2),
        (Polynomials(), 3, lambda c: c**3 - c, lambda c: 3 * c**2 - 1),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_functions_of_the_space_are_interpolated_exactly(space, degree, curve, derivative) -> None:
    """A curve is determined at all points by its velocities at the points of the space, to 50 digits."""
    with mp.workdps(60):
        points = space.points(degree, gauss_legendre(degree + 2))
        assert len(points) == space.dimension(degree)
        at = tuple(mp.mpf(k) / 16 for k in range(17))
        given = [derivative(c) for c in points]
        for lines, expected in ((space.velocities(points, at), derivative), (space.positions(points, at), curve)):
            for line, c in zip(lines, at, strict=True):
                assert abs(mp.fdot(line, given) - expected(c)) < mp.mpf("1e-50")


def test_trigonometric_derivatives_along_the_curve() -> None:
    space, points = Trigonometric(0.7), gauss_legendre(4).abscissae
    given = [0.7 * mp.cos(0.7 * c) for c in points]
    (line,) = space.velocities(points, (mp.mpf("0.3"),), 2)
    assert abs(mp.fdot(line, given) + mp.mpf(0.7) ** 3 * mp.cos(mp.mpf(0.7) * mp.mpf("0.3"))) < mp.mpf("1e-15")


def test_single_interval_is_a_polynomial() -> None:
    points, at = Splines(1).points(4, gauss_legendre(4)), (mp.mpf("0.3"), mp.mpf("0.9"))
    assert Splines(1).velocities(points, at) == cardinal_values(points, at)


@pytest.mark.parametrize("name", ["polynomials", "trigonometric:0.5", "trigonometric:0.1:2", "splines:3"])
def test_names_read_back(name: str) -> None:
    space = space_by_name(name)
    assert space.name == name
    method = SVI(4, space=space)
    assert method_from_specification(method.specification()) == method


def test_too_few_points_for_the_intervals_warn() -> None:
    with pytest.warns(MethodWarning, match="use at least 7 points"):
        SVI(4, "gauss-legendre:3", space="splines:2")


# Exactness and order.


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.covering
@pytest.mark.parametrize("degree", [2, 3, 4, 5])
@pytest.mark.parametrize("turn", [0.1, 1.0, 3.0])
def test_trigonometric_curves_are_exact_on_the_oscillator(degree: int, turn: float) -> None:
    """Whatever the step, even of half a period: only round-off is left after 100 steps."""
    system = problem("harmonic-oscillator").system
    run = stepper(system, SVI(degree, space=Trigonometric(turn))).integrate([0.3], [0.8], h=turn, steps=100)
    assert np.abs(run.q[:, 0] - 0.3 * np.cos(run.t) - 0.8 * np.sin(run.t)).max() < 5e-12


@pytest.mark.rotated
def test_the_order_of_trigonometric_curves_whose_frequency_shrinks_with_the_step() -> None:
    system, start = problem("planar-pendulum").system, ([1.0], [0.3])
    fine = stepper(system, SVI(10)).integrate(*start, h=0.25, steps=16)
    errors = [
        final_error(system, SVI(3, space=Trigonometric(h)), start, h=h, steps=round(4 / h), reference=fine.q[-1])
        for h in (0.4, 0.2)
    ]
    assert abs(np.log2(errors[0] / errors[1]) - 6) < 0.45


STRUCTURED = (
    SVI(3, space=Trigonometric(0.4)),
    SVI(2, space=Trigonometric(0.4)),
    SVI(3, space="splines:2"),
    SVI(3, "gauss-radau-left:3", space="splines:2"),
    SVI(3, "hermite:3"),
    SVI(4, "hermite-3:2"),
)


@pytest.mark.tiers(2, 3)
@pytest.mark.sampled(3)
@pytest.mark.covering
@pytest.mark.parametrize("method", STRUCTURED, ids=lambda method: method.name)
@pytest.mark.parametrize("solver", ["newton", "auto"])
def test_symplecticity_momentum_and_reversibility(method: SVI, solver: str) -> None:
    system, h = problem("kepler").system, 0.3
    step = stepper(system, method, solver=solver).step
    z, width = np.array([0.3, 0.8, -1.1, 0.4]), 1e-4

    def moved(x: np.ndarray) -> np.ndarray:
        return np.concatenate(step(x[:2], x[2:], h))

    columns = []
    for unit in np.eye(4):
        near, far = ((moved(z + k * width * unit) - moved(z - k * width * unit)) / (2 * k * width) for k in (1, 2))
        columns.append((4 * near - far) / 3)
    J = np.array(columns).T
    form = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    assert np.abs(J.T @ form @ J - form).max() < 1e-10
    end = moved(z)
    assert abs((end[0] * end[3] - end[1] * end[2]) - (z[0] * z[3] - z[1] * z[2])) < 2e-15
    back = np.concatenate(step(end[:2], end[2:], -h))
    assert method.symmetric == ("radau" not in method.rule.name)
    assert (np.abs(back - z).max() < 1e-14) == method.symmetric


# Hermite quadrature.


def test_hermite_rules_integrate_polynomials_below_their_order() -> None:
    for n, derivatives in ((2, 1), (3, 1), (5, 1), (2, 2), (3, 2), (2, 3), (4, 3)):
        rule = hermite(n, derivatives)
        assert rule.symmetric
        assert rule.conditions == n * (1 + derivatives)
        assert rule.order >= rule.conditions
        for degree in range(rule.order + 1):
            values = [
                mp.fdot(weights, [mp.ff(degree, k) * x ** max(degree - k, 0) for x in rule.points])
                for k, weights in enumerate((rule.weights, *rule.derivative_weights))
            ]
            error = abs(mp.fsum(values) - (1 - (-1) ** (degree + 1)) / mp.mpf(degree + 1))
            assert (error < mp.mpf("1e-45")) == (degree < rule.order)


def test_hermite_rules_by_name() -> None:
    for name in ("hermite:2", "hermite-2:3", "hermite-3:2"):
        assert quadrature_by_name(name).name == name
    with pytest.raises(MethodError, match="2 points and 1 weights"):
        Quadrature(name="own", points=(-1, 1), weights=(1, 1), derivative_weights=((1,),))
    own = Quadrature(name="corrected trapezoid", points=(-1, 1), weights=(1, 1), derivative_weights=(("1/3", "-1/3"),))
    assert own.order == 4


# Where each wins.
