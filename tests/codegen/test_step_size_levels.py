"""Predictor tables of adaptive steps and the precision of their coefficients."""

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.codegen.ir.equations import StoredValues
from scvi_codegen.codegen.lowering.control import predictor_of
from scvi_codegen.codegen.pipeline import program_of
from scvi_codegen.codegen.rendering.kernels.printer import DOUBLE
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.tables.basis import legendre_functional
from scvi_codegen.methods.tables.quadrature import gauss_legendre

KEPLER = sc.problem("kepler").system


@pytest.mark.parametrize("method", [sc.SVI(3), sc.SVI(8), sc.Gauss(5), sc.SVI(4, sc.gauss_lobatto(5))])
def test_coefficients_have_106_bits(method):
    fixed_point = program_of(KEPLER, method).fixed_point

    def printed(numbers):
        return [mp.mpf(DOUBLE.rounded(x)) + mp.mpf(DOUBLE.rounded(DOUBLE.rest(x))) for x in numbers]

    c, b, q = (
        printed(fixed_point.numbers(name)[0])[: fixed_point.points]
        for name in ("DRIFT", "POINT_END_MOMENTUM", "POINT_END_POSITION")
    )
    product = list(map(printed, fixed_point.numbers("PRODUCT")))[: fixed_point.points]
    for k in range(method.degree if isinstance(method, sc.SVI) else 5):
        powers = [x**k for x in c]
        assert abs(mp.fdot(b, powers) - mp.mpf(1) / (k + 1)) < 1e-31
        assert abs(mp.fdot(q, powers) - mp.mpf(1) / (k + 1) / (k + 2)) < 1e-31
    for line, x in zip(product, c, strict=True):
        assert abs(mp.fsum(line) - x * x / 2) < 1e-31


@pytest.mark.tiers(2, 3)
@pytest.mark.parametrize(
    ("method", "lanes"),
    [(sc.SVI(6), 8), (sc.SpectralCollocation(6), 8), (sc.SVI(18), 24), (sc.SpectralCollocation(18), 32)],
)
def test_predictor_follows_a_polynomial_across_step_size_changes(method, lanes):
    system = sc.problem("double-pendulum").system
    fixed_point = program_of(system, method).fixed_point
    assert fixed_point.lanes == lanes
    predictor, points = predictor_of(fixed_point), np.array(fixed_point.guess.abscissae, dtype=float)
    accelerations = fixed_point.kept is StoredValues.ACCELERATIONS  # z = h a is stored

    def curve(t):
        return 1.0 + t - 2.0 * t**3 + t**5

    for into_last in range(-2, 3):
        for into_next in range(-2, 3):
            h_before, h_last, h_next = 1.0, 2.0 ** (into_last / 4), 2.0 ** ((into_last + into_next) / 4)
            scales = (h_before, h_last, h_next) if accelerations else (1.0, 1.0, 1.0)
            before, last = scales[0] * curve(points - 1.0), scales[1] * curve(h_last * points)
            wanted = scales[2] * curve(h_last + h_next * points)
            tables = [np.array(each[into_last + 2][into_next + 2]) for each in (predictor.last, predictor.before)]
            padded = [np.pad(values, (0, fixed_point.lanes - len(points))) for values in (last, before)]
            found = sum(table @ values for table, values in zip(tables, padded, strict=True))
            assert np.allclose(found[: len(points)], wanted, rtol=1e-8, atol=1e-8)


def test_leading_legendre_coefficient_of_a_curve():
    points = gauss_legendre(5).abscissae
    functional = legendre_functional(points, 4)
    values = [3 * mp.legendre(4, 2 * x - 1) - mp.legendre(3, 2 * x - 1) + 1 for x in points]
    assert abs(mp.fdot(functional, values) - 3) < 1e-50
    assert abs(mp.fsum(functional)) < 1e-50
