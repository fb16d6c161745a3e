"""Tests of pages in a headless Chromium: open a file in the size of a phone or a desk, and inspect its layout.
Firefox shows a page once: its picture and what it writes to the console.
"""

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from programs import needs

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
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
    for (const element of document.querySelectorAll('body *:not(title)')) {
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
VIEWS = [(size, scheme) for size in WIDTHS for scheme in ("light", "dark")]


@contextmanager
def chromium() -> Iterator[Any]:
    """A headless Chromium; the test is skipped where there is none."""
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


@contextmanager
def looked_at(browser: Any, size: str, scheme: str) -> Iterator[Any]:
    """A phone or a desk, by day or by night, to go to pages with; ``view.asked`` is what these asked for."""
    view = browser.new_page(color_scheme=scheme)
    phone = {"width": WIDTHS[size], "height": 844, "deviceScaleFactor": 2, "mobile": size == "phone"}
    view.context.new_cdp_session(view).send("Emulation.setDeviceMetricsOverride", phone)
    view.asked, view.console, view.width = [], [], WIDTHS[size]
    view.on("request", lambda request: view.asked.append(request.url))
    view.on("console", lambda message: view.console.append(message.text))
    yield view
    view.close()


@contextmanager
def opened(browser: Any, page: str, path: Path, size: str, scheme: str) -> Iterator[Any]:
    """The page, looked at."""
    path.write_text(page, encoding="utf-8")
    with looked_at(browser, size, scheme) as view:
        view.goto(path.as_uri())
        view.wait_for_load_state("networkidle")
        view.own = path.as_uri()
        yield view


def assert_it_asks_for_nothing(view: Any) -> None:
    """No request leaves the page, and the browser complains of nothing."""
    assert [url for url in view.asked if not url.startswith("data:")] == [view.own]
    assert view.console == []


def assert_nothing_sticks_out(view: Any) -> None:
    """Everything is within the width of the screen, or scrolls within what is."""
    assert view.evaluate(STICKING_OUT, view.width) == []
    assert view.evaluate("document.documentElement.scrollWidth") <= view.width
    assert view.evaluate("innerWidth") == view.width


def seen_by_firefox(
    page: Path, height: int = 900, address: str = "", *, width: int = 1200, slower: int = 1
) -> tuple[bytes, list[str]]:
    """The picture of a page in a Firefox of its own profile, and the messages of the page's scripts and policies.

    A processor that is ``slower`` times slower: all processes of the browser stand still for the rest of each 30 ms.
    """
    needs("firefox")
    picture, profile = page.with_suffix(".png"), page.parent / "firefox"
    profile.mkdir(exist_ok=True)
    values = {"devtools.console.stdout.content": "true", "browser.dom.window.dump.enabled": "true"}
    values["ui.prefersReducedMotion"] = "1"
    prefs = "".join(f'user_pref("{name}", {value});\n' for name, value in values.items())
    (profile / "user.js").write_text(prefs, encoding="utf-8")
    options = ["--headless", "--profile", str(profile), f"--window-size={width},{height}"]
    command = ["firefox", *options, "--screenshot", str(picture), page.as_uri() + address]
    environment = {**os.environ, "HOME": str(profile)}
    with (page.parent / "shown").open("w+", encoding="utf-8") as shown:
        own = {"stdout": shown, "stderr": subprocess.STDOUT, "env": environment, "start_new_session": True}
        browser, until = subprocess.Popen(command, **own), time.monotonic() + 240.0
        while browser.poll() is None and time.monotonic() < until:
            time.sleep(0.03 / slower)
            with suppress(ProcessLookupError):  # ended meanwhile
                if slower > 1:
                    os.killpg(browser.pid, signal.SIGSTOP)
                    time.sleep(0.03 - 0.03 / slower)
                    os.killpg(browser.pid, signal.SIGCONT)
        with suppress(ProcessLookupError):
            os.killpg(browser.pid, signal.SIGKILL)
        assert browser.wait() == 0
        shown.seek(0)
        text = shown.read()
    # Others are of Firefox itself, which also ends scripts when it quits.
    lines = r"^(?:console\.\w+: (?!services|Remote).*|JavaScript \w+: file:(?!.*terminated by timeout).*)$"
    return picture.read_bytes(), re.findall(lines, text, re.MULTILINE)
