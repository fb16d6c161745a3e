"""Tests of pages that move, in a headless Chromium: bits, controls, address, errors, layout."""

import html
import importlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import UNREADABLE, seen_by_firefox

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS

DOCS = Path(__file__).parents[2] / "docs"
ROBOT = Path(__file__).parents[1] / "systems" / "robots" / "ball.xml"
pytestmark = pytest.mark.second


def extension(name: str) -> Any:
    """Return a module of the site's extensions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS / "_extensions"))
        patch.delitem(sys.modules, name, raising=False)  # of the tests
        return importlib.import_module(name)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the files of three pages: one without calls of the C library, a field, and a robot with a ball joint."""
    pytest.importorskip("ziglang", reason="pages are compiled by the extra compiler")
    folder, result = tmp_path_factory.mktemp("pages"), {}
    for name, plots in (("figure_eight", [("x3", "y3"), ("t", "energy")]), ("kinks", [("q.80", "t")])):
        result[name] = folder / f"{name}.html"
        sc.page(DOCS / "motions" / f"{name}.toml", plots=plots).save(result[name])
    robot, result["robot"] = sc.LagrangianSystem.from_mjcf(ROBOT), folder / "robot.html"
    sc.page(robot, q=[0.4, 2.0, 0.0, 0.0, 0.0], velocity=[0.0] * 5, h=0.01, method="svi:2").save(result["robot"])
    return result


@pytest.fixture
def view(browser: Any) -> Iterator[Any]:
    """Return a page of the browser with touch, which collects messages and requests."""
    context = browser.new_context(viewport={"width": 1000, "height": 900}, has_touch=True)
    page = context.new_page()
    page.messages, page.asked = [], []
    page.on("console", lambda message: page.messages.append(message.text))
    page.on("pageerror", lambda error: page.messages.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    yield page
    context.close()


def opened(view: Any, path: Path, address: str = "#.n=0", steps: int = 0) -> Any:
    """Open a page, and return its state when it has performed the steps of the address."""
    view.goto("about:blank")
    view.goto(path.as_uri() + address)
    return state_when(view, lambda state: state["steps"] >= steps)


def state_when(view: Any, condition: Any) -> Any:
    """Return the first state that satisfies a condition; the policy of the page forbids playwright's own waiting."""
    for _ in range(200):
        state = view.evaluate("globalThis.page ? page.state() : null")
        if state and condition(state):
            return state
        time.sleep(0.02)
    raise AssertionError(state)


def at_rest(view: Any, path: Path) -> Any:
    """Open a page that is paused at its first state, and return this when it is drawn."""
    opened(view, path)
    for _ in range(200):
        if view.inner_text("#clock") == "t = 0.00":
            return view.evaluate("page.state()")
        time.sleep(0.02)
    raise AssertionError(view.inner_text("#clock"))


def middle_of(view: Any) -> tuple[float, float]:
    """Return the pixels of the middle of the drawing."""
    box = view.locator("#motion").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_a_page_computes_the_bits_of_python_and_asks_for_nothing(view, pages):
    state = opened(view, pages["figure_eight"], "#.n=1000", 1000)
    model = sc.load_model(DOCS / "motions" / "figure_eight.toml")
    stepper = sc.compile_stepper(model.system, model.method, flags=PORTABLE_FLAGS)
    run = stepper.integrate(model.q, model.momenta(stepper), h=model.h, steps=1000)
    assert np.array_equal(state["q"], run.q[-1])
    assert np.array_equal(state["p"], run.p[-1])
    kinks = opened(view, pages["kinks"], "#.n=200", 200)
    model = sc.load_model(DOCS / "motions" / "kinks.toml")
    stepper = model.stepper()
    run = stepper.integrate(model.q, velocity=model.velocity, h=model.h, steps=200)
    assert np.abs(np.array(kinks["q"]) - np.ravel(run.q["u"][-1])).max() < 1e-11
    assert view.messages == []
    assert all(url.startswith(("file:", "about:", "data:")) for url in view.asked)
    text = pages["kinks"].read_text(encoding="utf-8").replace("http://www.w3.org/1998/Math/MathML", "")
    assert "://" not in text


LOADED_WHEN = """<script>
const pending = document.body.appendChild(document.createElement('iframe')).contentDocument;
pending.open();  // the page is loaded when this is closed
const waiting = setInterval(() => {
    if (!(CONDITION)) return;
    console.log("loaded");
    clearInterval(waiting);
    requestAnimationFrame(() => requestAnimationFrame(() => pending.close()));
}, 20);
</script></body>"""


def seen_when(condition: str, page: Path, folder: Path, *more: Any, **options: Any) -> tuple[bytes, list[str]]:
    """Return what Firefox shows of a page, which is loaded when a condition holds, and the messages."""
    text = page.read_text(encoding="utf-8").replace("</body>", LOADED_WHEN.replace("CONDITION", condition))
    (folder / "page.html").write_text(text, encoding="utf-8")
    return seen_by_firefox(folder / "page.html", *more, **options)


@pytest.mark.parametrize("name", ["figure_eight", "kinks", "robot"])
def test_a_page_runs_in_firefox_without_a_message(pages, tmp_path, name):
    condition = "globalThis.page?.state().steps === 100"
    picture, messages = seen_when(condition, pages[name], tmp_path, address="#.n=100")
    assert len(picture) > 10_000
    assert messages == ['console.log: "loaded"']


def test_a_link_reproduces_the_bits_after_reversal_and_a_change_of_parameters(view, pages):
    opened(view, pages["figure_eight"], "#m2=1.01&.n=300", 300)
    view.keyboard.press("b")
    view.keyboard.press(" ")
    view.evaluate("page.advance(123)")
    state, address = view.evaluate("[page.state(), page.address()]")
    assert state["t"] < 15
    assert "m2=1.01" in address
    again = opened(view, pages["figure_eight"], address, state["steps"])
    assert {key: again[key] for key in ("t", "q", "p")} == {key: state[key] for key in ("t", "q", "p")}


def test_bodies_are_dragged_by_mouse_and_touch(view, pages):
    view.add_init_script(
        "performance.now = () => 0"
    )  # the frame follows all of the motion ahead, however long it takes
    before = at_rest(view, pages["figure_eight"])
    middle = middle_of(view)  # body 3 is at the origin
    view.mouse.move(*middle)
    view.mouse.down()
    view.mouse.move(middle[0] + 40, middle[1] - 20, steps=4)
    view.mouse.up()
    after = view.evaluate("page.state()")
    assert after["settings"]["q"][:4] == before["settings"]["q"][:4]
    x, y = after["settings"]["q"][4:]
    assert x == pytest.approx(2 * y, rel=0.03)
    assert y > 0.02
    at_rest(view, pages["figure_eight"])
    session = view.context.new_cdp_session(view)
    for kind, at in (("touchStart", 0), ("touchMove", 20), ("touchMove", 40), ("touchEnd", None)):
        points = [] if at is None else [{"x": middle[0] + at, "y": middle[1]}]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    touched = view.evaluate("page.state()")["settings"]["q"]
    assert touched[4] == pytest.approx(x, rel=0.3)  # the frame follows the motion that is ahead
    assert touched[5] == pytest.approx(0, abs=1e-3)
    assert view.messages == []


@pytest.mark.parametrize(
    ("name", "shown", "count"),
    [
        ("figure_eight", ["y\N{SUBSCRIPT THREE}", "x\N{SUBSCRIPT THREE}", "energy", "t"], 19),
        ("kinks", ["t", "u, node 80"], 6),
    ],
)
def test_plots_are_those_given_and_offer_all_variables(view, pages, name, shown, count):
    """Those of three bodies are t, the state, energy, momentum, centre of mass and angular momentum."""
    opened(view, pages[name])
    chosen = view.evaluate("[...document.querySelectorAll('.choices select')].map((s) => s.selectedOptions[0].text)")
    assert chosen == shown
    assert view.evaluate("document.querySelector('.choices select').length") == count


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "address", "message"),
    [
        ("figure_eight", "#.q=0,0,0,0,0,0&.n=5", "infinite or undefined"),
        ("figure_eight", "#.q=0,0", "this system needs 6"),
        ("figure_eight", "#m1=x", "is not a number"),
        ("figure_eight", "#.step=-1", "must be positive"),
        ("kinks", "#v=1.5", "v must be between 0.05 and 0.95; the address has 1.5"),
    ],
)
def test_an_error_is_one_line_in_the_page(view, pages, name, address, message):
    opened(view, pages[name], address)
    view.wait_for_timeout(100)
    assert message in view.inner_text("#fault")
    assert view.messages == []


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation of a quaternion of any length."""
    w, v = quaternion[0], quaternion[1:]
    turned = (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * np.cross(np.eye(3), v)
    return turned / (quaternion @ quaternion)


def test_sliders_of_a_ball_joint_are_angles_and_angular_velocities(view, pages):
    """An angle turns the joint with its velocity in the body, which sliders set in any order."""
    opened(view, pages["robot"])
    angles = {"x": 2.5, "y": -1.2, "z": 0.7}
    names = {f"Angle of R_ball about {axis}": angle for axis, angle in angles.items()}
    for name, value in [*[*names.items()][:2], ("omega_ball_2", 1.5), *[*names.items()][2:]]:
        view.fill(f"input[aria-label='{name}, value']", str(value))
        view.keyboard.press("Enter")
    settings = view.evaluate("page.state().settings")
    q, v = (np.array(settings[kind][1:]) for kind in "qv")
    expected = np.eye(3)
    for axis, angle in enumerate(angles.values()):
        plane, turn = [(axis + 1) % 3, (axis + 2) % 3], np.eye(3)
        turn[np.ix_(plane, plane)] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        expected = turn @ expected
    assert np.allclose(matrix_of(q), expected, atol=1e-12)
    assert np.linalg.norm(q) == pytest.approx(2.0)
    spin = matrix_of(q).T @ (matrix_of(q + 1e-6 * v) - matrix_of(q - 1e-6 * v)) / 2e-6
    assert np.allclose([spin[2, 1], spin[0, 2], spin[1, 0]], [0.0, 1.5, 0.0], atol=1e-8)
    assert view.locator("input[aria-label*='R_ball_']").count() == 0


def test_a_page_in_a_frame_without_address_shows_its_link(view, pages):
    source = html.escape(pages["figure_eight"].read_text(encoding="utf-8"))
    view.set_content(f'<iframe sandbox="allow-scripts" width="380" height="600" srcdoc="{source}"></iframe>')
    frame = view.frames[1]
    state_when(frame, lambda state: state["steps"] > 2)
    frame.click("#play")
    frame.click("#share")
    assert frame.input_value("#link_text") == frame.evaluate("page.address()")
    assert view.messages == []


@pytest.mark.rotated
def test_a_slider_moves_along_a_family_whose_orbits_close(view, tmp_path):
    pytest.importorskip("ziglang", reason="pages are compiled by the extra compiler")
    system, path = sc.problem("planar-pendulum").system, tmp_path / "family.html"
    stepper = sc.compile_stepper(system, "svi:4")
    family = sc.family(stepper, sc.equilibrium(stepper, [0.0]), amplitude=0.5, step=0.3, count=5)
    sc.page(system, family=family, h=family[3].period / 64).save(path)
    opened(view, path)
    slider = view.locator("input[aria-label='Orbit']")
    slider.press("End")
    assert slider.get_attribute("aria-valuetext") == str(len(family) - 1)
    for _ in range(len(family) - 4):
        slider.press("ArrowLeft")
    view.evaluate("page.advance(64)")
    state, address = view.evaluate("[page.state(), page.address()]")
    assert state["energy"] == pytest.approx(family[3].energy, abs=1e-12)
    assert [*state["q"], *state["p"]] == pytest.approx([*family[3].q, *family[3].p], abs=1e-9)
    opened(view, path, address, 64)
    view.wait_for_timeout(100)
    assert slider.get_attribute("aria-valuetext") == "3"
    assert f"{family[3].period:.6g} at" in view.inner_text("#plots")
    assert view.messages == []


@pytest.mark.rotated
@pytest.mark.parametrize("width", [390, 1280])
def test_a_slow_machine_draws_the_whole_orbit_too(browser, tmp_path, width):
    pytest.importorskip("ziglang", reason="pages are compiled by the extra compiler")
    system, path = sc.problem("planar-pendulum").system, tmp_path / "family.html"
    stepper = sc.compile_stepper(system, "svi:4")
    family = sc.family(stepper, sc.equilibrium(stepper, [0.0]), amplitude=0.5, step=0.3, count=5)
    sc.page(system, family=family, h=family[-1].period / 2000).save(path)
    pictures, address = [], ""
    for slower in (1, 6):
        page = browser.new_page(viewport={"width": width, "height": 800}, reduced_motion="reduce")
        page.context.new_cdp_session(page).send("Emulation.setCPUThrottlingRate", {"rate": slower})
        opened(page, path, "")
        page.locator("input[aria-label='Orbit']").press("End")
        page.wait_for_timeout(500)
        pictures.append(page.locator("#motion").screenshot())
        address = page.evaluate("page.address()")
        page.close()
    assert pictures[0] == pictures[1]
    drawn = "document.querySelector('#clock').textContent === 't = 0.00'"
    pictures = [seen_when(drawn, path, tmp_path, 800, address, width=width, slower=slower)[0] for slower in (1, 6)]
    assert pictures[0] == pictures[1]


@pytest.mark.parametrize("width", [360, 800, 1600])
def test_a_page_fits_the_screen_is_readable_and_named(browser, pages, width):
    for name, scheme in (("figure_eight", "light"), ("kinks", "dark")):
        page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme, reduced_motion="reduce")
        opened(page, pages[name], "")
        assert page.inner_text("#play") == "Play"  # nothing moves by itself
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(UNREADABLE) == []
        unnamed = """() => [...document.querySelectorAll('button, input, select, canvas')].filter(each =>
            !(each.getAttribute('aria-label') || each.textContent.trim() || each.labels?.length)).length"""
        assert page.evaluate(unnamed) == 0
        page.close()


@pytest.mark.rotated
def test_the_form_writes_a_model_file_that_is_read(view, tmp_path):
    pytest.importorskip("sphinx", reason="the form is a directive of the site")
    view.set_content(extension("motions").OWN)
    view.add_script_tag(path=DOCS / "_static" / "motions.js")
    view.evaluate("document.dispatchEvent(new Event('DOMContentLoaded'))")
    view.fill("#own-lagrangian", "m*(x_dot**2 + y_dot**2)/2 - k*(x**2 + y**2 - 1)**2")
    view.fill("[data-name=k] input", "2.5")
    path = tmp_path / "model.toml"
    path.write_text(view.inner_text("#own pre"), encoding="utf-8")
    model = sc.load_model(path)
    assert [str(name) for name in model.system.coordinates] == ["x", "y"]
    assert model.parameters == {"k": 2.5, "m": 1.0}
    assert model.integrate().energy_error() < 1e-9
    view.fill("#own-lagrangian", "x_dot^2")
    assert "**" in view.inner_text("#own .note")
    assert view.is_disabled("#own button")
