"""Sections of the derivation page: exact table entries, and the stationary function of methods with multipliers."""

import pytest
import sympy

import scvi_codegen as sc
from scvi_codegen.derivation.notation import table_entries
from scvi_codegen.derivation.page.curve import curve_section, tables_section
from scvi_codegen.derivation.page.document import paper_equations
from scvi_codegen.display.page.blocks import Formula, TableBlock

THIRD = sympy.sqrt(3) / 3
POINTS = {"gauss-legendre:2": (-THIRD, THIRD), "gauss-lobatto:3": (-1, 0, 1)}


@pytest.mark.parametrize("quadrature", POINTS)
def test_table_entries_are_the_exact_values_of_cardinal_functions(quadrature):
    """Of the control points -1, 0, 1; entries that are 0, 1 or -1 have no name."""
    method, tau = sc.SVI(2, quadrature), sympy.Symbol("tau")
    nodes = (-1, 0, 1)
    basis = [
        sympy.Mul(*((tau - other) / sympy.Integer(node - other) for other in nodes if other != node)) for node in nodes
    ]
    expected = {"Slopes": [f.diff(tau) for f in basis], "l_j": basis}
    entries = table_entries(paper_equations(sc.problem("kepler").system, method), method)
    blocks = [each for each in tables_section(method, entries).contents if isinstance(each, TableBlock)]
    compared = 0
    for block in blocks:
        functions = expected.get(block.name.replace("(", " ").split()[0], [])
        for point, (_, *cells) in zip(POINTS[quadrature], block.rows if functions else [], strict=False):
            columns = [int(column.removeprefix("j = ")) for column in block.columns[1:]]
            for column, cell in zip(columns, cells, strict=True):
                exact = sympy.expand(functions[column].subs(tau, point))
                assert exact in (0, 1, -1) if cell is None else sympy.expand(cell) == exact
                compared += 1
    assert compared >= 8


@pytest.mark.parametrize(
    ("method", "has_multipliers"),
    [
        (sc.SCVI(1), False),
        (sc.SCVI(2), True),
        (sc.SCVI(2, variational=False), False),
        (sc.SCVI(1, variational=False), False),
        (sc.SpectralCollocation(2), False),
    ],
)
def test_stationary_function_is_shown_for_variational_curves_with_inner_nodes(method, has_multipliers):
    formulas = [each for each in curve_section(method).contents if isinstance(each, Formula)]
    assert any(each.left == sympy.Symbol("G") for each in formulas) == has_multipliers
