"""What a table says is zero stands as zero in C: no 6.8e-63 where the 60th digit of the points was cut."""

import re

import pytest

from scvi_codegen.compiler import generate_source
from scvi_codegen.ir.rounding import lower_matrix, lower_vector
from scvi_codegen.methods import SCVI, SVI, RadauIIA, SpectralCollocation
from scvi_codegen.models.systems import double_pendulum, kepler
from scvi_codegen.tables.basis import cardinal_integrals, cardinal_slopes, next_step
from scvi_codegen.tables.nodes import chebyshev_lobatto, legendre_gauss
from scvi_codegen.tables.precision import mp

METHODS = (SCVI(3), SCVI(2, "gauss-lobatto:3"), SVI(4, "clenshaw-curtis:5"), SpectralCollocation(3), RadauIIA(3))


def test_small_numbers_are_zero_and_others_the_nearest_double():
    assert lower_vector((mp.mpf(10) ** -41, mp.one / 3, mp.mpf(10) ** -39)) == (0.0, 1 / 3, 1e-39)
    assert lower_matrix(((-(mp.mpf(10) ** -60),), (mp.mpf(-2),))) == ((0.0,), (-2.0,))


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
@pytest.mark.parametrize("system", [kepler(), double_pendulum()], ids=lambda system: system.name)
def test_no_generated_table_holds_a_zero_that_is_none(system, method):
    source, _ = generate_source(system, method)
    assert re.findall(r"\b\d[\d.]*e-(?:[4-9]\d|[12]\d\d)\b", source.code) == []


@pytest.mark.parametrize("degree", [2, 3, 4, 6, 8])
def test_tables_of_60_digits_have_exact_zeros(degree):
    for nodes in (chebyshev_lobatto(degree), legendre_gauss(degree)):
        c = nodes.abscissae
        for table in (cardinal_integrals(c, (*c, 1), 0), cardinal_slopes(c, c), next_step(c)):
            assert all(entry == 0 or abs(entry) > mp.mpf(10) ** -40 for row in table for entry in row)
