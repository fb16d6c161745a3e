"""MathML equals the expression, symbol by symbol, and browsers can read it."""

import importlib
import io
import math
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import sympy
from browsing import seen_by_firefox
from printed_formulas import mp, names, trees_of_mathml, value
from sympy import Float, Function, Matrix, Mul, Pow, Rational, Symbol, cos, exp, pi, sin, sqrt, symbols

from scvi_codegen.common.display.mathml import Typeset
from scvi_codegen.extras.derivation.writing import mathematics_font

x, y, h = symbols("x y h")


def inner(expression: sympy.Basic) -> str:
    """The MathML of an expression within ``<math>``."""
    return Typeset.whole(expression).removeprefix("<math>").removesuffix("</math>")


def read(*elements: str, **values: float) -> float:
    """The value of presentation MathML as it is printed, given the values of its names."""
    known = {"e": mp.e, "π": mp.pi} | values
    return float(value(trees_of_mathml(elements), known.__getitem__))


EXPRESSIONS = [
    -(x + y) / 2, Mul(-1, x + y, evaluate=False), x - Mul(1, x + y, evaluate=False),
    Mul(2, Mul(3, x, evaluate=False), evaluate=False), 2 * 3**x, Rational(2, 3) * 5**y * x, (x - y) / h,
    -(x - y) / h**2, 1 / x, -1 / x, x**-y, x**y / h, (-2) ** Symbol("n"), Rational(1, 3) ** x,
    Rational(-1, 3) ** Symbol("n"), sqrt(3) / 6 - Rational(1, 2), 1 / sqrt(x + y),
    (x + y) ** Rational(3, 2) + (x**2 + y**2) ** Rational(-3, 2), (x + y) ** Rational(-1, 3) * h,
    sin(x) ** 2 * cos(x + y) ** 3 - sin(x) ** -2, sin(-x) * cos(x / 2 - y), exp(-x * y) / (1 + exp(x)), pi * x / 4,
    x * y**2 * (x + y) ** 2 * (x - 2 * y),
    Symbol("Q_1") ** 2 + Symbol("Q__2_x") ** -2 + Symbol("theta1") ** 2 * Symbol("q_dot") ** 2,
    Mul(Rational(-1, 2), x + y, x - y, evaluate=False), Float("1.5e-7") * x - Float("2.25") * y + Float("-4e12"),
    Pow(x**2, y, evaluate=False), Pow(-x, 2, evaluate=False),
    h * (x + y + 3) * (x + 2 * y + 5) * sin(x + y + h) / 7, (x + y) * (x - y) / (h * (x + 3) * (y + 4)),
]  # fmt: skip


def check_read_back(expression: sympy.Expr, seed: int = 1) -> None:
    """One element, and all terms, read as the expression."""
    draws = np.random.default_rng(seed).uniform(0.5, 1.5, len(expression.free_symbols))
    values = dict(zip(sorted(expression.free_symbols, key=str), map(float, draws), strict=True))
    if Symbol("n") in values:
        values[Symbol("n")] = 3.0
    printed = {next(names(trees_of_mathml([Typeset.whole(symbol)]))): number for symbol, number in values.items()}
    expected = float(expression.xreplace({symbol: Float(value) for symbol, value in values.items()}).evalf())
    for elements in ([Typeset.whole(expression)], Typeset.terms(expression)):
        assert read(*elements, **printed) == pytest.approx(expected, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
def test_mathml_evaluates_to_the_expression(expression):
    check_read_back(expression)


@pytest.mark.parametrize(
    ("number", "text"),
    [("0.1", "0.1"), ("3.0", "3.0"), ("0.33333333333333333", "0.333333"), ("1e-12", "1.0·10\N{MINUS SIGN}12")],
)
def test_numbers_have_sensible_digits(number, text):
    assert "".join(ElementTree.fromstring(Typeset.whole(Float(number, 50))).itertext()) == text


@pytest.mark.parametrize(
    "expression",
    [
        Matrix([[1, -x], [sqrt(2) / 2, x**2 / 3]]),
        sympy.Eq(Symbol("q_dot"), Function("L_d")(Symbol("q_0"), Symbol("q_1"))),
        sympy.Derivative(Function("L")(x, y), x),
        sympy.Integral(exp(-(x**2)), (x, 0, 1)),
        sympy.Sum(Symbol("w_n"), (Symbol("n"), 1, Symbol("g"))),
        sympy.kronecker_product(sympy.MatrixSymbol("A", 2, 2), sympy.MatrixSymbol("E", 2, 2)),
        sympy.MatrixSymbol("A", 2, 2) * sympy.MatrixSymbol("Q", 2, 1) + sympy.MatrixSymbol("B", 2, 1),
        sympy.I * x + sympy.oo,
        sympy.Tuple(x, y),
    ],
    ids=lambda expression: type(expression).__name__,
)
def test_all_kinds_are_well_formed_and_without_html_entities(expression):
    for text in (Typeset.whole(expression), *Typeset.terms(expression)):
        ElementTree.fromstring(text)
        assert set(re.findall(r"&\w+;", text)) <= {"&lt;", "&gt;", "&amp;"}


class TestTerms:
    def test_a_sum_is_split_before_its_signs(self):
        terms = Typeset.terms(x - y / 2 - h * (x + y))
        signs = [re.findall(r'^<math displaystyle="true"><mo form="(\w+)">(.)</mo>', term) for term in terms]
        assert signs == [[("prefix", "\N{MINUS SIGN}")], [("infix", "+")], [("infix", "\N{MINUS SIGN}")]]

    def test_a_product_is_one_term(self):
        assert (
            len(Typeset.terms(x * (x + y + 111111) * (x - y + 222222) * sin(x + 333333 * y) * cos(y + 444444 * x))) == 1
        )

    def test_the_right_side_begins_with_the_equals_sign(self):
        terms = Typeset.terms(x + y, h - x)
        assert [('<mo form="infix">=</mo>' in term) for term in terms] == [False, False, True, False]
        assert Typeset.terms(sympy.Eq(h - x, x + y)) == terms


def test_round_trip_detects_a_wrong_sign():
    assert read(Typeset.whole(x - y), x=2.0, y=3.0) == -1.0
    assert read(Typeset.whole(x - y).replace("\N{MINUS SIGN}", "+"), x=2.0, y=3.0) == 5.0
    assert math.isclose(read(Typeset.whole(sin(x) ** 2), x=2.0), math.sin(2.0) ** 2)


@pytest.mark.parametrize(
    ("name", "latex"),
    [
        ("theta_1_dot", r"\dot{\theta}_{1}"),
        ("q1_dot_k", r"\dot{q}_{1,k}"),
        ("Q_2_x", "Q_{x}^{2}"),
        ("p_q1_k+1", "p_{q_{1},k+1}"),
        ("l_1_0", r"l_{0}(\tau_{1})"),
        ("dl_3_2", r"\dot{l}_{2}(\tau_{3})"),
        ("DD_1_0", r"(\hat{D}\tilde{D})_{1,0}"),
        ("aa_n_j", "(A^{2})_{n,j}"),
        ("bA_2", "(bA)_{2}"),
    ],
)
def test_latex_names_are_parsed_like_mathml_names(name, latex):
    assert Typeset.latex_name(name) == latex


DOCS = Path(__file__).parents[2] / "docs"
HEIGHT = 300
"""Pixels of a formula of 100 pixels an em in a screenshot."""


def pieces_of(ink):
    """Return the number of rows of ink of a picture, and the widths of the gaps between its columns in em."""
    gaps = np.diff(np.flatnonzero(ink.any(axis=0)))
    return int((np.diff(ink.any(axis=1).astype(int)) == 1).sum()), (gaps[gaps > 1] / 100).tolist()


def screenshot_by_chromium(browser, page, height):
    """Return a picture of a page whose font is loaded."""
    view = browser.new_page(viewport={"width": 1200, "height": height})
    view.goto(page.as_uri())
    view.evaluate("document.fonts.ready")
    assert view.evaluate("[...document.fonts].map(f => f.status)") == ["loaded"]
    picture = view.screenshot()
    view.close()
    return picture


@pytest.mark.second
class TestInABrowser:
    """Formulas in the font that pages bring along, whatever the machine has: ink is counted in a screenshot."""

    @pytest.fixture(params=["chromium", "firefox"])
    def pieces(self, request, tmp_path):
        """Return a function from formulas to the numbers of their rows of ink, and the widths of their gaps in em."""
        image = pytest.importorskip("PIL.Image")

        def screenshot(page: Path, height: int) -> bytes:
            if request.param == "firefox":
                return seen_by_firefox(page, height)[0]
            return screenshot_by_chromium(request.getfixturevalue("browser"), page, height)

        def look(*formulas: str) -> list[tuple[int, list[float]]]:
            style = f'{mathematics_font()} math {{ font: 100px "STIX Two Math", serif }} body {{ margin: 0 }}'
            style += f" div {{ height: {HEIGHT}px; padding: 60px; box-sizing: border-box }}"
            blocks = "".join(f"<div><math>{formula}</math></div>" for formula in formulas)
            page = tmp_path / "page.html"
            page.write_text(f'<!DOCTYPE html><meta charset="utf-8"><style>{style}</style>{blocks}', encoding="utf-8")
            shot = image.open(io.BytesIO(screenshot(page, HEIGHT * len(formulas)))).convert("L")
            return [pieces_of(np.asarray(shot)[HEIGHT * n : HEIGHT * (n + 1)] < 128) for n in range(len(formulas))]

        return look

    def test_dots_of_velocities_are_visible(self, pieces):
        names = [Symbol(name + dot) for dot in ("", "_dot") for name in ("q", "x", "theta", "m")]
        assert [rows for rows, _ in pieces(*map(Typeset.whole, names))] == [1] * 4 + [2] * 4

    def test_letters_come_from_the_font(self, browser):
        view = browser.new_page()
        view.set_content(f'<!DOCTYPE html><style>{mathematics_font()} b {{ font: 100px "STIX Two Math" }}</style>')
        width = """text => {
            const pen = document.createElement('canvas').getContext('2d');
            const shape = family => { pen.font = `100px ${family}`; const m = pen.measureText(text);
                return [m.width, m.actualBoundingBoxAscent, m.actualBoundingBoxDescent].join(); };
            const loaded = document.fonts.load('100px "STIX Two Math"', text);
            return loaded.then(() => shape('"STIX Two Math", serif') !== shape('serif'));
        }"""
        letters = [*"axyLθμωφλ∑∫∂√∞≤−·ℒ", *map(chr, range(0x1D44E, 0x1D454)), *map(chr, range(0x1D6FC, 0x1D714))]
        assert [letter for letter in letters if not view.evaluate(width, letter)] == []
        view.close()

    def test_functions_stand_apart_from_factors(self, pieces):
        product = Typeset.whole(Symbol("r") * cos(Symbol("a")))[6:-7]
        (_, close), (_, apart) = pieces("<mi>r</mi><mtext>cos</mtext>", product)
        assert apart[0] > close[0] + 0.14

    def test_formulas_of_the_site_do_as_well(self, pieces, monkeypatch):
        pytest.importorskip("sphinx", reason="the site is made by the extra docs")
        monkeypatch.syspath_prepend(str(DOCS / "_extensions"))
        monkeypatch.delitem(sys.modules, "mathml", raising=False)
        translated = importlib.import_module("mathml")._mathml
        formulas = (r"\dot q", r"\ddot q_1", r"\dot\theta_k", "q_1")
        assert [rows for rows, _ in pieces(*(translated(x, as_block=False) for x in formulas))] == [2, 2, 2, 1]
