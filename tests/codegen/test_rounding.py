"""Numbers are exact until printing; exact zeros of a table are zeros in C."""

import re
from fractions import Fraction

import numpy as np
import pytest
import sympy

from scvi_codegen import SCVI, SVI, RadauIIA, SpectralCollocation, SystemDefinitionError, problem
from scvi_codegen.codegen.ir.kernel import exact_number, lower_matrix, lower_vector
from scvi_codegen.codegen.pipeline import generate_source, program_of
from scvi_codegen.codegen.rendering.kernels.printer import DOUBLE, SINGLE
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.tables.basis import cardinal_derivatives, cardinal_integrals, next_step
from scvi_codegen.methods.tables.nodes import chebyshev_lobatto, nodes_by_name

DOUBLE_PENDULUM, KEPLER = (problem(name).system for name in ("double-pendulum", "kepler"))

METHODS = (SCVI(3), SCVI(2, "gauss-lobatto:3"), SVI(4, "clenshaw-curtis:5"), SpectralCollocation(3), RadauIIA(3))


def test_tables_have_the_documented_digits_and_exact_zeros_and_ones():
    third, small = mp.one / 3, mp.mpf(10) ** -39
    zero, near_third, near_small, one = lower_vector((mp.mpf(10) ** -41, third, small, 1 - mp.mpf(10) ** -58))
    assert (zero, one) == (0, 1)
    assert abs(near_third - third) < mp.mpf(10) ** -50
    assert abs(near_small / small - 1) < mp.mpf(10) ** -49
    assert lower_matrix(((-(mp.mpf(10) ** -60),), (mp.mpf(-2),))) == ((0,), (-2,))


def test_constants_are_exact_until_rounded_for_a_target():
    assert exact_number(sympy.Rational(2, 3)) == Fraction(2, 3)
    assert abs(exact_number(sympy.sqrt(2) * sympy.pi) - mp.sqrt(2) * mp.pi) < mp.mpf(10) ** -57
    for wrong in (sympy.I, sympy.Integer(10) ** 400, sympy.zoo):
        with pytest.raises(SystemDefinitionError):
            exact_number(wrong)


def test_coefficients_are_rounded_once_to_nearest():
    generator = np.random.default_rng(7)
    numerators, denominators = (generator.integers(1, 10**9, 500) for _ in range(2))
    for p, q in zip(numerators.tolist(), denominators.tolist(), strict=True):
        assert DOUBLE.rounded(Fraction(p, q)) == p / q
        assert DOUBLE.rounded(mp.mpf(p) / q) == p / q
        single, exact = Fraction(SINGLE.rounded(-Fraction(p, q))), -Fraction(p, q)
        assert float(np.float32(single)) == single
        assert all(
            abs(single - exact) <= abs(Fraction(float(np.nextafter(np.float32(single), np.float32(end)))) - exact)
            for end in (-np.inf, np.inf)
        )
        high = DOUBLE.rounded(Fraction(p, q))
        assert (
            abs(high + mp.mpf(DOUBLE.rounded(DOUBLE.rest(Fraction(p, q)))) - mp.mpf(p) / q) <= mp.mpf(2) ** -105 * p / q
        )
    halfway = 1 + Fraction(1, 2**24) + Fraction(1, 2**60)  # rounded to a double first it would be even, 1
    assert SINGLE.rounded(halfway) == 1 + 2.0**-23


def test_program_has_more_digits_than_a_double():
    fixed_point = program_of(KEPLER, SVI(3)).fixed_point
    product = [x for row in fixed_point.numbers("PRODUCT") for x in row[: fixed_point.points]]
    assert all(mp.mpf(DOUBLE.rounded(x)) != x for x in product)


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
@pytest.mark.parametrize("system", [KEPLER, DOUBLE_PENDULUM], ids=lambda system: system.name)
def test_generated_tables_contain_no_spurious_zeros(system, method):
    source, _ = generate_source(system, method)
    assert re.findall(r"\b\d[\d.]*e-(?:[4-9]\d|[12]\d\d)\b", source.code) == []


@pytest.mark.parametrize("degree", [2, 3, 4, 6, 8])
def test_tables_of_60_digits_have_exact_zeros(degree):
    for nodes in (chebyshev_lobatto(degree), nodes_by_name("legendre-gauss", degree)):
        c = nodes.abscissae
        for table in (cardinal_integrals(c, (*c, 1), 0), cardinal_derivatives(c, c), next_step(c)):
            assert all(entry == 0 or abs(entry) > mp.mpf(10) ** -40 for row in table for entry in row)
