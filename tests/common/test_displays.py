"""Notebook displays of systems, methods, equations, steppers and trajectories."""

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from browsing import UNREADABLE, VIEWS, assert_it_asks_for_nothing, opened
from html_page import Page
from notation import lagrange
from samples import compile_quickly

import scvi_codegen as sc
from scvi_codegen.common.display.cards import card, listed, plain, sparkline
from scvi_codegen.extras.verification.certificate import Check, Outcome
from scvi_codegen.methods.tables.number_tables import number_table

METHODS = [
    sc.SVI(3), sc.SVI(2, "hermite:2"), sc.SVI(2, space="splines:2"), sc.SCVI(3), sc.SCVI(2, abscissae="gauss"),
    sc.SpectralCollocation(8), sc.SpectralCollocation(2, form="phase-space"), sc.Gauss(2), sc.RadauIIA(5),
    sc.StoermerVerlet(), sc.Composition(10), sc.ExplicitEuler(),
]  # fmt: skip


@cache
def falling() -> sc.LagrangianSystem:
    return lagrange("falling", "x y", "(x_dot**2 + y_dot**2)/2 - g*y", g=9.81)


@cache
def trajectory() -> sc.Trajectory:
    kepler = sc.problem("kepler")
    stepper = compile_quickly(kepler.system, sc.SVI(2))
    return stepper.integrate(kepler.q, stepper.momentum(kepler.q, kepler.velocity), h=0.1, steps=1000)


@cache
def advice() -> sc.Advice:
    kepler = sc.problem("kepler")
    return sc.advise(kepler.system, sc.StoermerVerlet(), kepler.q, [0.0, 1.7], 5.0, 1e-3)


def certificate(outcome: Outcome = Outcome.SATISFIED) -> sc.Certificate:
    check = Check(name="order", statement="it is <4>", outcome=outcome, measured=3.98, bound=3.7, remark="from 4 steps")
    unknown = Check(name="drift", statement="none", outcome=Outcome.NOT_MEASURED, remark="no symmetry")
    return sc.Certificate(
        title="Kepler problem by SVI",
        system="Kepler problem",
        method="svi-2",
        version="0",
        checksum="ab" * 32,
        flags=("-O3",),
        q=(0.5, 0.0),
        p=(0.0, 1.7),
        t=0.0,
        h=0.1,
        parameters={"mu": 1.0},
        checks=(check, unknown),
        seconds=1.0,
    )


DISPLAYED: dict[str, Callable[[], Any]] = {
    "lagrangian": lambda: sc.problem("double-pendulum").system,
    "hamiltonian": lambda: sc.problem("point-vortices").system,
    "large system": lambda: sc.problem("outer-solar-system").system,
    "equations": lambda: sc.derive(sc.problem("planar-pendulum").system, sc.SVI(2)),
    "radicals": lambda: sc.derive(sc.problem("kepler").system, sc.SCVI(2), radicals=True),
    "stepper": lambda: trajectory().stepper,
    "trajectory": trajectory,
    "problem": lambda: sc.problem("kepler"),
    "model": lambda: sc.Model.from_problem(sc.problem("kepler")),
    "ensemble": lambda: trajectory().stepper.integrate_ensemble(np.eye(2), np.eye(2)[::-1], h=0.1, steps=100),
    "model of arrays": lambda: sc.Model(
        system=lagrange("ring", "q[N]", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)"),
        method="svi:2",
        q={"q": np.ones(4)},
        h=0.1,
        steps=3,
    ),
    "certificate": certificate,
    "advice": advice,
    "symmetry": lambda: sc.symmetries(falling())[-1],
} | {method.name: lambda method=method: method for method in METHODS}


@pytest.mark.tiers(5, 16)
@pytest.mark.parametrize("name", DISPLAYED)
def test_every_display_is_well_formed_and_short(name):
    shown = DISPLAYED[name]()._repr_html_()
    parsed = Page(shown)
    assert parsed.elements[0] == ("div", {"class": "scvi-codegen", "style": "overflow-x:auto"})
    assert parsed.all("script") == parsed.all("style") == []
    assert len(shown) < 60_000


class TestMethod:
    def test_coefficients_are_exact_where_they_are_short(self):
        shown = sc.SVI(3)._repr_html_()
        assert "<msqrt><mn>15</mn></msqrt>" in shown
        assert "0.77459666924148338" in shown
        assert "msqrt" not in sc.SVI(9, "gauss-legendre:9", nodes="legendre-lobatto")._repr_html_()


def test_rows_of_numbers_are_numbered_as_in_the_formulas():
    """Nodes from 0, points of a quadrature and stages from 1."""
    tables = [number_table(part) for part in (sc.chebyshev_lobatto(2), sc.gauss_legendre(3), sc.RadauIIA(2).tableau)]
    assert [[row[0] for row in table.rows] for table in tables] == [list("012"), list("123"), ["1", "2", "b"]]
    assert "of order 3" in tables[2].name


class TestTrajectory:
    def test_trajectory_display_shows_facts_curves_and_the_energy_range(self):
        shown = trajectory()._repr_html_()
        assert "0 to 100, h = 0.1" in shown
        assert "1001; q and p of shape (1001, 2)" in shown
        assert re.search(r">iterations</th><td[^>]*>(\d+)<", shown)[1] == str(sum(trajectory().iterations))
        energies = trajectory().energy()[::3]
        assert f"{energies.min():.10g} to {energies.max():.10g}" in shown
        pictures = Page(shown).all("svg")
        assert [picture["aria-label"] for picture in pictures] == ["q1", "q2", "energy"]


def test_sparkline_spans_the_range_and_skips_non_finite_values():
    points = [
        tuple(map(float, pair.split(",")))
        for pair in re.findall(r"[\d.]+,[\d.]+", sparkline([0.0, float("nan"), 2.0], ""))
    ]
    assert len(points) == 2
    assert points[0][0] < points[1][0]
    assert points[0][1] > points[1][1]
    assert Page(sparkline([], "<none>"))
    assert Page(sparkline([1.0, 1.0], "flat"))


def test_cards_escape_text():
    assert "&lt;i&gt;" in card("<i>", [("<i>", plain("<i>"))])
    assert "<i>" not in card("<i>", [("<i>", plain("<i>"))])
    assert listed([]) == "none"


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("size", "scheme"), VIEWS)
def test_displays_render_in_a_browser(browser, tmp_path, size, scheme):
    displays = "\n".join(display()._repr_html_() for display in DISPLAYED.values())
    colors = ":root{color-scheme:light dark} body{color:CanvasText;background:Canvas}"
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><link rel="icon" href="data:,">'
    page = f"<!DOCTYPE html><html><head>{head}<style>{colors}</style></head><body>{displays}</body></html>"
    with opened(browser, page, tmp_path / "notebook.html", size, scheme) as view:
        assert_it_asks_for_nothing(view)
        assert view.evaluate("document.documentElement.scrollWidth") <= view.width
        assert view.evaluate(UNREADABLE) == []
        boxes = view.evaluate("[...document.querySelectorAll('polyline')].map(e => e.getBoundingClientRect().width)")
        assert len(boxes) == 7  # of three runs, and two coordinates each of two trajectories of an ensemble
        assert min(boxes) > 100.0
