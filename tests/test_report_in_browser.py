"""The report in a headless Chromium: formulas, widths, colours, paper, and that it asks for nothing."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import toy_experiments
from toy_experiments import GOOD

from scvi_codegen.reproduce.experiment import Result
from scvi_codegen.reproduce.report import report_html
from scvi_codegen.reproduce.runner import run_experiments

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


@pytest.fixture(scope="module")
def page() -> str:
    outcomes = run_experiments(GOOD, 1, module=toy_experiments.__name__)
    return report_html([outcome for outcome in outcomes if isinstance(outcome, Result)])


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium."""
    if importlib.util.find_spec("playwright") is None:
        pytest.skip("playwright is not installed: pip install 'scvi-codegen[test]'")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        path = next(filter(None, map(shutil.which, (*BROWSERS, own))), None)
        if path is None:
            pytest.skip(f"there is no browser: none of {', '.join(BROWSERS)} is installed")
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield started
        started.close()


WIDTHS = {"phone": 390, "desk": 1200}
STICKING_OUT = """width => [...document.querySelectorAll('body *')].filter(element => {
    const box = element.getBoundingClientRect();
    return !element.parentElement.closest('.scroll, svg, math') && !element.closest('.unseen')
        && (box.right > width + 0.5 || box.left < -0.5);
}).map(element => element.outerHTML.slice(0, 100))"""
UNREADABLE = """() => {
    const channels = color => color.match(/[\\d.]+/g).map(Number);
    const light = c => { c /= 255; return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; };
    const luminance = ([r, g, b]) => 0.2126 * light(r) + 0.7152 * light(g) + 0.0722 * light(b);
    const behind = element => {
        for (let e = element; e; e = e.parentElement) {
            const c = channels(getComputedStyle(e).backgroundColor);
            if (c.length === 3 || c[3] === 1) return c;
        }
    };
    const found = [];
    for (const element of document.querySelectorAll('body *')) {
        if (![...element.childNodes].some(node => node.nodeType === 3 && node.data.trim())) continue;
        const style = getComputedStyle(element);
        const color = channels(element.closest('svg') ? style.fill : style.color);
        const [low, high] = [luminance(color), luminance(behind(element))].sort((a, b) => a - b);
        const contrast = (high + 0.05) / (low + 0.05);
        if (!(contrast >= 4.5)) found.push([contrast, element.outerHTML.slice(0, 100)]);
    }
    return found;
}"""
FORMULAS = """() => [...document.querySelectorAll('math')].map(math => {
    const {width, height} = math.getBoundingClientRect();
    return [width, height];
})"""
FRACTIONS = """() => [...document.querySelectorAll('mfrac')].map(fraction => {
    const [above, below] = [...fraction.children].map(child => child.getBoundingClientRect());
    return [fraction.getBoundingClientRect().height, above.bottom, below.top];
})"""


class TestInABrowser:
    @pytest.fixture(params=[(size, scheme) for size in WIDTHS for scheme in ("light", "dark")], ids="-".join)
    def view(self, request: pytest.FixtureRequest, browser: Any, page: str, tmp_path: Path) -> Iterator[Any]:
        """The page on a phone or a desk, by day or by night; ``view.asked`` is what it asked for."""
        size, scheme = request.param
        path = tmp_path / "report.html"
        path.write_text(page, encoding="utf-8")
        view = browser.new_page(color_scheme=scheme)
        phone = {"width": WIDTHS[size], "height": 844, "deviceScaleFactor": 2, "mobile": size == "phone"}
        view.context.new_cdp_session(view).send("Emulation.setDeviceMetricsOverride", phone)
        view.asked, view.said = [], []
        view.on("request", lambda request: view.asked.append(request.url))
        view.on("console", lambda message: view.said.append(message.text))
        view.goto(path.as_uri())
        view.wait_for_load_state("networkidle")
        view.own, view.width = path.as_uri(), WIDTHS[size]
        yield view
        view.close()

    def test_it_asks_for_nothing_and_complains_of_nothing(self, view):
        assert [url for url in view.asked if not url.startswith("data:")] == [view.own]
        assert view.said == []

    def test_nothing_sticks_out(self, view):
        assert view.evaluate(STICKING_OUT, view.width) == []
        assert view.evaluate("document.documentElement.scrollWidth") <= view.width
        assert view.evaluate("innerWidth") == view.width
        boxes = "[...document.querySelectorAll('.scroll')].map(e => [e.scrollWidth, e.clientWidth])"
        assert view.width > 390 or sum(inside > outside for inside, outside in view.evaluate(boxes)) > 3

    def test_formulas_are_set_by_the_browser(self, view):
        boxes = view.evaluate(FORMULAS)
        assert len(boxes) > 10
        assert all(width > 5.0 and height > 8.0 for width, height in boxes)
        fractions = view.evaluate(FRACTIONS)
        assert len(fractions) > 50
        assert all(height > 12.0 and above <= below + 0.5 for height, above, below in fractions)

    def test_all_text_is_readable(self, view):
        assert view.evaluate(UNREADABLE) == []

    def test_on_paper_it_is_light_and_figures_stay_whole(self, view):
        view.emulate_media(media="print")
        style = "e => getComputedStyle(document.querySelector(e))"
        assert view.evaluate(f"({style})('body').backgroundColor") == "rgb(255, 255, 255)"
        assert view.evaluate(f"({style})('figure').breakInside") == "avoid"
        assert view.evaluate(f"({style})('.back').display") == "none"
        assert view.evaluate(UNREADABLE) == []


def test_dark_is_dark(browser, page):
    view = browser.new_page(color_scheme="dark")
    view.set_content(page)
    assert view.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 28)"
    assert view.evaluate("getComputedStyle(document.querySelector('svg text')).fill") == "rgb(227, 228, 230)"
    view.close()
