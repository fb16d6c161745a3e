"""The derivation page: its equations are those that are compiled, its counts are counted, and browsers set it."""

import re
from functools import cache
from typing import Any, get_args

import pytest
import sympy
from browsing import (
    FORMULAS,
    FRACTIONS,
    UNREADABLE,
    VIEWS,
    assert_it_asks_for_nothing,
    assert_nothing_sticks_out,
    opened,
)
from html_page import Page
from notation import hamilton, lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.ir.equations import IterationName
from scvi_codegen.codegen.lowering.program import step_texts
from scvi_codegen.codegen.pipeline import program_of
from scvi_codegen.codegen.rendering.program_source import render
from scvi_codegen.extras.derivation.equations import derive
from scvi_codegen.extras.derivation.notation import table_entries
from scvi_codegen.extras.derivation.page.document import ITERATIONS, derivation_html, kernels_of
from scvi_codegen.extras.derivation.page.drawings import curve_section, jacobian_pattern
from scvi_codegen.extras.derivation.writing import Formula
from scvi_codegen.methods.discretise import paper_equations
from scvi_codegen.methods.tables.number_tables import positions

TILTED = """m*(1 + q**2/3)*q_dot**2/2 + a*q*q_dot*sin(t) - k*q**4/4 + q_dot**4/40"""
METHODS = [
    sc.SVI(3), sc.SVI(2, "gauss-lobatto:3"), sc.SVI(2, "hermite:2"), sc.SVI(2, space="splines:2"), sc.SCVI(3),
    sc.SCVI(1), sc.SCVI(2, variational=False), sc.SCVI(2, abscissae="gauss"), sc.SpectralCollocation(3),
    sc.SpectralCollocation(2, form="phase-space"), sc.Gauss(3), sc.LobattoIIIA(3), sc.RadauIIA(2, form="position"),
    sc.ExplicitEuler(), sc.StoermerVerlet(),
]  # fmt: skip


def tilted() -> sc.LagrangianSystem:
    """Everything a Lagrangian of one coordinate can have: a mass that varies, a magnetic term, time, a quartic term."""
    return lagrange("tilted", "q", TILTED, m=1.3, a=0.4, k=0.7)


class TestEquations:
    @pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
    def test_one_name_denotes_one_number(self, method):
        stages = method.paper_form(tilted())
        values: dict[str, Any] = {}
        for group in stages.stage_groups:
            for part in (*group.gathers, *group.scatters):
                for names, numbers in zip(part.table.names, part.table.entries, strict=True):
                    for name, number in zip(names, numbers, strict=True):
                        if name:
                            number = number / name.factor.numerator * name.factor.denominator
                            assert values.setdefault(name.number, number) == number
        shown = {entry.symbol.name: entry.value for entry in table_entries(stages, method)}
        assert values.keys() <= shown.keys()

    @pytest.mark.parametrize(
        "method", [sc.SVI(2), sc.SCVI(2), sc.SpectralCollocation(3), sc.Gauss(2)], ids=lambda m: m.name
    )
    def test_the_pattern_is_that_of_the_jacobian(self, method):
        system = sc.problem("henon-heiles").system
        assert_pattern_is_of_jacobian(system, method)

    def test_pattern_with_fewer_multipliers_than_coordinates(self):
        assert_pattern_is_of_jacobian(swing(constraints=["x**2 + y**2 - 1"]), sc.SVI(2, "gauss-lobatto:3"))


NUMBERED = {
    sc.SVI(3): ["25"],
    sc.SCVI(2): ["33"],
    sc.SpectralCollocation(2): ["18"],
    sc.SpectralCollocation(2, form="phase-space"): ["21", "21"],
    sc.Gauss(2): [],
}


@pytest.mark.parametrize("method", NUMBERED, ids=lambda method: method.name)
def test_curves_are_drawn_to_scale_and_numbered_as_in_the_paper(method):
    """Points are at MARGIN + c (WIDTH - 2 MARGIN), and as high as their weights."""
    *contents, drawing = curve_section(method).contents
    assert [each.number for each in contents if isinstance(each, Formula) and each.number] == NUMBERED[method]
    circles = [float(x) for x in re.findall(r'<circle cx="([^"]*)"', drawing.svg)]
    assert circles == pytest.approx([30 + 580 * float(c) for part in method.parts for c in positions(part)], abs=0.051)
    stems = [float(y) - float(top) for y, top in re.findall(r"M[\d.]+ (\d+)V([\d.]+)", drawing.svg)]
    weights = [float(w) for part in method.parts for w in getattr(part, "weights", ())]
    assert stems == pytest.approx([30 * w / max(weights) for w in weights], abs=0.051)


def assert_pattern_is_of_jacobian(system: sc.LagrangianSystem, method: Any) -> None:
    pattern = jacobian_pattern(paper_equations(system, method), system.dimension)
    found = {(r, c) for r, row in enumerate(pattern.rows) for c in row}
    derived = derive(system, method)
    assert pattern.size == len(derived.unknowns)
    assert found == set(derived.jacobian.todok())


def swing(**more: Any) -> sc.LagrangianSystem:
    """A falling point with a further force."""
    formula = "(x_dot**2 + y_dot**2)/2 - y"
    return sc.LagrangianSystem.from_text(
        name="swing", coordinates=["x", "y"], lagrangian=formula, parameters={"c": 0.1}, **more
    )


@cache
def kepler_page(method: Any) -> str:
    return derivation_html(sc.problem("kepler").system, method)


class TestPage:
    @pytest.mark.tiers(2, 3)
    @pytest.mark.sampled(5)
    @pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
    def test_every_method_has_a_well_formed_self_contained_page(self, method):
        page = derivation_html(system := sc.problem("planar-pendulum").system, method)
        parsed = Page(page)
        assert len(parsed.all("h1")) == 1
        assert len(parsed.all("section")) == len(parsed.all("h2")) == 11 + bool(step_texts(system, method))
        identifiers = [attributes["id"] for _, attributes in parsed.elements if "id" in attributes]
        assert len(identifiers) == len(set(identifiers))
        assert set(re.findall(r'href="#([^"]*)"', page)) <= set(identifiers)
        assert parsed.all("script") == []
        assert not re.search(r"https?:|@import|url\((?!data:)", page)

    def test_every_kind_of_iteration_is_explained(self):
        assert set(ITERATIONS) == set(get_args(IterationName))
        singular = hamilton("hyperbolic", "q", "q*p + q**2*p**2", momenta="p")
        page = derivation_html(singular, sc.Gauss(2))
        assert "in turn to convergence" in page

    @pytest.mark.second
    def test_operations_are_counted(self):
        program = program_of(sc.problem("kepler").system, sc.SVI(2), prefix="kepler_problem")
        functions = render(program).functions
        page = kepler_page(sc.SVI(2))
        for kernel in kernels_of(program):
            row = re.search(
                rf'<td class="word">{kernel.name}</td>(?:<td class="number">(\d+)</td>)'
                + r'<td class="number">(\d+)</td>' * 3,
                page,
            )
            results, before, after, temporaries = map(int, row.groups())
            body = functions[kernel.name].body
            signs = re.findall(r"(?<=[\w\])]) [-+] |\*|/", body)
            calls = re.findall(r"\b[a-z]\w*\(", body)
            negatives = re.findall(r"-(?=[\w(])", body)
            assert after == len(signs) + len(calls) + len(negatives)
            assert temporaries == body.count("const")
            assert results == len(re.findall(r"^  (?:value|derivative)\[", body, re.MULTILINE))
            assert before == sum(sympy.count_ops(formula) for formula in kernel.formulas)


@pytest.mark.rotated
@pytest.mark.parametrize(("size", "scheme"), VIEWS)
def test_page_renders_in_a_browser(browser, tmp_path, size, scheme):
    with opened(browser, kepler_page(sc.SCVI(2)), tmp_path / "kepler.html", size, scheme) as view:
        assert_it_asks_for_nothing(view)
        assert_nothing_sticks_out(view)
        view.evaluate("document.querySelectorAll('details').forEach(pair => pair.open = true)")
        assert_nothing_sticks_out(view)
        boxes = view.evaluate(FORMULAS)
        assert len(boxes) > 200
        assert all(width > 4.0 and height > 8.0 for width, height in boxes)
        fractions = view.evaluate(FRACTIONS)
        assert len(fractions) > 50
        assert all(height > 12.0 and above <= below + 0.5 for height, above, below in fractions)
        assert view.evaluate(UNREADABLE) == []
        sides = view.evaluate(
            "[...document.querySelectorAll('.sides')].map(sides => [...sides.children].map(side => {"
            " const box = side.getBoundingClientRect(); return [box.left, box.top, box.bottom]; }))"
        )
        assert len(sides) > 20
        for left, right in sides:
            extra = left[1] == right[1] and left[0] < right[0]
            below = left[2] <= right[1] and left[0] == right[0]
            assert extra if size == "desk" else below
        assert view.evaluate("[...document.querySelectorAll('svg')].every(e => e.getBoundingClientRect().width > 200)")
