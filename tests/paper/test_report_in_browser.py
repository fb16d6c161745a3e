"""The report in a headless Chromium: formulas, widths, colours, paper, and that it asks for nothing."""

from collections.abc import Iterator
from typing import Any

import pytest
import toy_experiments
from browsing import UNREADABLE, VIEWS, assert_it_asks_for_nothing, assert_nothing_sticks_out, opened
from toy_experiments import GOOD

from scvi_codegen.paper.experiment import Result, report_html
from scvi_codegen.paper.runner import run_experiments

pytestmark = pytest.mark.rotated


@pytest.fixture(scope="module")
def page() -> str:
    outcomes = run_experiments(GOOD, 1, module=toy_experiments.__name__)
    return report_html([outcome for outcome in outcomes if isinstance(outcome, Result)])


@pytest.fixture(scope="module", params=VIEWS, ids="-".join)
def view(
    request: pytest.FixtureRequest, browser: Any, page: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    with opened(browser, page, path, *request.param) as view:
        yield view


class TestInABrowser:
    @pytest.mark.tiers(0, 1)
    @pytest.mark.sampled(2)
    def test_page_loads_nothing_and_logs_no_error(self, view):
        assert_it_asks_for_nothing(view)

    def test_no_element_overflows_the_page(self, view):
        assert_nothing_sticks_out(view)
        boxes = "[...document.querySelectorAll('.scroll')].map(e => [e.scrollWidth, e.clientWidth])"
        assert view.width > 190 or sum(inside > outside for inside, outside in view.evaluate(boxes)) > 3

    @pytest.mark.tiers(0, 1)
    def test_single_panel_fits_a_phone_and_wider_pictures_scroll(self, view):
        figures = """[...document.querySelectorAll('figure .scroll')].map(e => {
            const width = e.querySelector('img').style.getPropertyValue('--width');
            return [parseFloat(width) * 96, e.scrollWidth, e.clientWidth, getComputedStyle(e).backgroundImage];
        })"""
        found = view.evaluate(figures)
        assert found
        for own, inside, outside, hint in found:
            assert hint.count("linear-gradient") == 4
            assert own > 640 or inside <= outside

    def test_all_text_has_sufficient_contrast(self, view):
        assert view.evaluate(UNREADABLE) == []

    @pytest.mark.tiers(0, 3)
    def test_print_style_is_light_and_does_not_split_figures(self, view):
        view.emulate_media(media="print")
        style = "e => getComputedStyle(document.querySelector(e))"
        assert view.evaluate(f"({style})('body').backgroundColor") == "rgb(255, 255, 255)"
        assert view.evaluate(f"({style})('figure').breakInside") == "avoid"
        assert view.evaluate(f"({style})('.back').display") == "none"
        assert view.evaluate(UNREADABLE) == []
        view.emulate_media(media="null")


def test_dark_mode_has_a_dark_background(browser, page):
    view = browser.new_page(color_scheme="dark")
    view.set_content(page)
    assert view.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 28)"
    shown = "getComputedStyle(document.querySelector('figure .scroll')).getPropertyValue('--behind')"
    assert view.evaluate(shown) == "#ffffff"
    view.close()
