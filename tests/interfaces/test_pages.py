"""Pages that move: what they describe, what they refuse, and the bits of their WebAssembly."""

import base64
import gzip
import html
import importlib.util
import json
import re
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from notation import lagrange
from programs import needs

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.extras.pages import page as pages

MOTIONS = Path(__file__).parents[2] / "docs" / "motions"
OSCILLATOR = """[system]
name = "a </script><b> oscillator"
coordinates = ["x", "y"]
lagrangian = "m*(x_dot**2 + y_dot**2)/2 - k*(x**2 + y**2)/2"
[parameters]
k = 1.0
m = 1.0
[initial]
q = [1.0, 0.0]
q_dot = [0.0, 0.5]
[run]
step = 0.1
span = 20.0
"""
NODE = """
const fs = require("fs"), about = JSON.parse(process.argv[1]), m = about.m;
const code = new WebAssembly.Instance(new WebAssembly.Module(fs.readFileSync(0)), {}).exports;
code._initialize?.();
const view = (k, size) => new Float64Array(code.memory.buffer, code.memory_of(k), size);
about.parameters.forEach(({ place, value }) => { view(0, place + 1)[place] = value; });
view(1, m).set(about.q); view(about.from_momenta ? 2 : 3, m).set(about.v);
const statuses = [code.start(about.t, about.step.value), code.advance(about.steps, 1)], stored = code.stored();
const [q, p] = [1, 2].map((k) => Array.from(view(k, m)));
const [t, energy] = [code.time(), code.energy()], turned = about.causes[code.turn(-about.step.value)];
console.log(JSON.stringify({ statuses, stored, t, q, p, energy, turned }));
"""
BOX = (
    OSCILLATOR.replace("[parameters]", 'inputs = ["F"]\n[forces]\nx = "F"\n[inputs]\nF = 0.5\n[parameters]')
    + """
[[events]]
function = "4*x + 3"
direction = -1
restitution = 0.5
[[events]]
function = "y"
"""
)
TRANSFORMED = OSCILLATOR.replace("[parameters]", 'time_transformation = "1/(1 + x**2)"\n[parameters]')
FIRST_ORDER = """[system]
name = "first-order oscillator"
coordinates = ["y", "x"]
lagrangian = "y*x_dot - (x**2 + y**2)/2"
[initial]
q = [0.5, 1.0]
[run]
tolerance = 1e-12
span = 6.0
first_step = 0.5
[[events]]
function = "x + y"
terminal = true
"""

STICK_SLIP = """[system]
name = "mass on a belt"
coordinates = ["x"]
lagrangian = "x_dot**2/2 - x**2/2"
[[contacts]]
slip = "x_dot - 3/10"
limit = "F"
static_limit = 0.4
[parameters]
F = 0.25
[initial]
q = [0.0]
q_dot = [0.3]
[method]
method = "svi"
degree = 3
[run]
step = 0.05
span = 30.0
"""
BALL = """[system]
name = "ball with friction"
coordinates = ["x", "y", "a"]
lagrangian = "(x_dot**2 + y_dot**2)/2 + a_dot**2/20 - y"
[[contacts]]
gap = "y - 1/2"
slip = "x_dot - a_dot/2"
friction = 0.2
restitution = 0.5
[initial]
q = [0.0, 1.5, 0.0]
q_dot = [1.0, 0.0, 0.0]
[method]
method = "svi"
degree = 3
[run]
tolerance = 1e-10
max_step = 0.5
span = 8.0
[[events]]
function = "x - 4"
terminal = true
"""
BROWNIAN = (
    OSCILLATOR.replace("[parameters]", 'temperature = "kT"\ndamping = "k"\n[parameters]\nkT = 0.5') + "seed = 7\n"
)
STIFF_FLOOR = """[system]
name = "ball on a stiff floor"
coordinates = ["y"]
lagrangian = "y_dot**2/2 - 10*y - 50000*positive_part(-y)**2"
[initial]
q = [1.0]
q_dot = [0.0]
[run]
step = 0.1
span = 20.0
"""


def written(folder, text=OSCILLATOR):
    """Return the path of a model file."""
    path = folder / "model.toml"
    path.write_text(text, encoding="utf-8")
    return path


def described(text):
    """Return what the scripts of a page read."""
    return json.loads(re.search(r'id="description">(.*?)</script>', text, re.DOTALL)[1])


@pytest.fixture
def without_compiler(monkeypatch):
    """Replace compilation."""
    monkeypatch.setattr(pages, "check_compiler", lambda: None)
    monkeypatch.setattr(pages, "webassembly", lambda folder, sources: "")


@pytest.mark.rotated
@pytest.mark.usefixtures("without_compiler")
def test_a_page_has_no_address_no_text_as_code_and_the_licences(tmp_path):
    page = sc.page(written(tmp_path), ranges={"k": (0.5, 2.0)})
    text, data = page.html, described(page.html)
    assert "://" not in text.replace("http://www.w3.org/1998/Math/MathML", "")
    assert "<b> oscillator" not in text
    assert not re.search(r"\beval\(|new Function", text)
    assert re.search(r"default-src 'none'.*script-src 'unsafe-inline' 'wasm-unsafe-eval'", text)
    permission = (
        (Path(__file__).parents[2] / "LICENSE")
        .read_text(encoding="utf-8")
        .partition("\n\nPermission")[2]
        .partition("\n---")[0]
    )
    assert " ".join(permission.split()) in " ".join(re.sub("<.?p>", " ", text).split())
    assert all(word in text for word in ("Rich Felker, et al.", "Zig contributors", "Sun Microsystems", "Arm Limited"))
    assert [(each["low"], each["high"]) for each in data["parameters"]] == [(0.5, 2.0), (0.05, 3.0)]
    assert (data["q"], data["v"], data["step"]["value"]) == ([1.0, 0.0], [0.0, 0.5], 0.1)
    frame = page._repr_html_()
    assert frame.startswith('<iframe sandbox="allow-scripts" ')
    assert html.unescape(re.search(r'srcdoc="([^"]*)"', frame)[1]) == text
    page.save(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text(encoding="utf-8").rstrip("\n") == text.rstrip("\n")


@pytest.mark.parametrize(
    ("old", "new", "ranges", "message"),
    [
        ("step = 0.1", "error = 1e-9", {}, "requires a step size or tolerance"),
        (
            *(
                "[parameters]",
                'inputs = ["F"]\n[forces]\nx = "F"\n[inputs]\nF = { t = [0, 1], values = [0, 1] }\n[parameters]',
                {},
            ),
            "slider sets the input F of .*, which is a table: give a number",
        ),
        ("[parameters]", 'inputs = ["F"]\n[forces]\nx = "F"\n[parameters]', {"F": (1, 2)}, "1 .. 2 of F must contain"),
        ("", "", {"g": (0, 1)}, "unknown slider 'g' in page ranges. Known: k, m, x, y, x_dot"),
        ("", "", {"k": (2, 3)}, "range 2 .. 3 of k must contain its value 1: widen it"),
    ],
)
@pytest.mark.usefixtures("without_compiler")
def test_unsupported_systems_are_refused(tmp_path, old, new, ranges, message):
    with pytest.raises((sc.MethodError, sc.StateError, sc.ModelFileError), match=message):
        sc.page(written(tmp_path, OSCILLATOR.replace(old, new, 1)), ranges=ranges)


@pytest.mark.rotated
@pytest.mark.usefixtures("without_compiler")
def test_hamiltonians_start_from_momenta():
    """These need not be functions of the velocities."""
    system = sc.HamiltonianSystem.from_text("h", ["q"], hamiltonian="cos(p_q) + q**2/2")
    model = sc.Model(
        system=system, method="gauss:2", q=[1.0], p=[2.8], h=0.1, span=1.0, page={"ranges": {"p_q": (2.0, 3.0)}}
    )
    data = described(sc.page(model).html)
    assert (data["from_momenta"], data["v"], data["ranges"]["v"]) == (True, [2.8], [[2.0, 3.0]])


PAGE = """
[page]
ranges = { k = [0.5, 2.0], x = [-3.0, 3.0], y_dot = [-1.0, 1.0] }
speed = 0.5
plots = [["x", "p_x"], ["t", "energy"]]
"""


@pytest.mark.rotated
@pytest.mark.usefixtures("without_compiler")
def test_the_section_page_sets_sliders_speed_and_plots_and_arguments_replace_it(tmp_path):
    path = written(tmp_path, OSCILLATOR + PAGE)
    shown = sc.page(path, ranges={"k": (0.9, 1.1)})
    data = described(shown.html)
    assert [(each["name"], each["low"], each["high"]) for each in data["parameters"]] == [
        ("k", 0.9, 1.1),
        ("m", 0.05, 3.0),
    ]
    assert data["ranges"] == {"q": [[-3.0, 3.0], [-2.0, 2.0]], "v": [[-2.0, 2.0], [-1.0, 1.0]]}
    assert data["speed"]["value"] == 0.5
    assert data["plots"] == [["p_x", "x"], ["energy", "t"]]  # the vertical one first
    model = sc.load_model(path, {"parameters": {"k": 3.0}})  # outside its range, which is of no concern to others
    assert model.page["speed"] == 0.5
    sc.save_model(model, tmp_path / "again.toml")
    assert sc.load_model(tmp_path / "again.toml") == model
    with pytest.raises(sc.StateError, match=r"unknown variable 'p_z'; did you mean 'p_[xy]'\? Known: t, x, y"):
        sc.page(path, plots=[("t", "p_z")])
    with pytest.raises(sc.ArgumentError, match="takes h for a system alone"):
        sc.page(path, h=0.1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("speed", "sped", r"unknown key 'sped' in \[page\]; did you mean 'speed'\?"),
        ("y_dot", "z_dot", r"unknown slider 'z_dot' in \[page\] ranges; did you mean '[xy]_dot'\?"),
        ("[0.5, 2.0]", "2.0", r"ranges k must be two numbers, \[lowest, highest\], not 2.0"),
        ("[0.5, 2.0]", "[2.0, 0.5]", "k is 2 .. 0.5: the first number must be less"),
        ("[0.5, 2.0]", "[0.5, inf]", "ranges k .*finite"),
        ("0.5\n", "-0.5\n", "speed is -0.5: it must be positive"),
        ('["x", "p_x"]', '"x"', "plots must be pairs of names"),
    ],
)
def test_mistakes_in_the_section_page_are_errors(tmp_path, old, new, message):
    with pytest.raises(sc.ModelFileError, match=message):
        sc.load_model(written(tmp_path, OSCILLATOR + PAGE.replace(old, new, 1)))


@pytest.mark.usefixtures("without_compiler")
def test_a_system_with_its_motion_has_a_page(tmp_path):
    model = sc.load_model(written(tmp_path))
    motion = {"q": model.q, "velocity": model.velocity}
    ours = described(sc.page(model.system, **motion, h=0.1, method=model.method).html)
    assert ours == described(sc.page(model).html)
    for change, message in (
        ({"h": 0.1, "velocities": [0.0, 0.0]}, "takes no 'velocities'; did you mean 'velocity'"),
        ({}, "requires a step size or tolerance"),
        ({"q": [1.0], "h": 0.1}, "q"),
    ):
        with pytest.raises(sc.ScviCodegenError, match=message):
            sc.page(model.system, **motion | change)
    with pytest.raises(sc.ArgumentError, match="requires its initial state: give q"):
        sc.page(model.system, h=0.1)


def boxed():
    """Return the model of two particles in a periodic box."""
    pairs = "sum(i < j in near, (cut**2 - sum(a in 2, wrap(r[i, a] - r[j, a], box)**2))**2)"
    near, kinetic = {"of": "r", "cutoff": "cut", "box": "box"}, "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2)"
    gas = lagrange("gas", ["r[N, 2]"], f"{kinetic} - {pairs}", box=6.0, cut=2.5, neighbours={"near": near})
    q, velocity = {"r": [[0.0, 1.0], [2.0, 7.0]]}, {"r": np.zeros((2, 2))}
    return sc.Model(system=gas, method="svi:2", q=q, velocity=velocity, h=0.1, steps=1)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("model", "read", "expected"),
    [
        pytest.param(
            MOTIONS / "foucault.toml",
            lambda data: (
                [(mark["kind"], mark["points"]) for mark in data["shape"]["marks"]],
                data["shape"]["points"][0],
            ),
            ([("rod", [1, 0]), ("pivot", [1]), ("body", [0])], [1, 2, 3]),
            id="a constraint on a distance is a rod",
        ),
        pytest.param(
            MOTIONS / "lagrange_top.toml",
            lambda data: (data["rotations"], np.round(data["v"], 12).tolist(), data["shape"]["marks"][0]["kind"]),
            (
                [{"name": "R", "columns": [0, 1, 2, 3], "rates": ["omega_1", "omega_2", "omega_3"]}],
                np.round([0.0, 0.0, -4 * np.sin(0.25), 4 * np.cos(0.25)], 12).tolist(),  # q (0, omega)/2
                "top",
            ),
            id="a rotation has its columns, rates and velocity",
        ),
        pytest.param(
            MOTIONS / "kinks.toml",
            lambda data: (
                *(data[name] for name in ("initial", "q", "v", "m", "coordinates")),
                data["shape"]["mesh"]["fields"],
                [data["shape"]["mesh"]["axes"]["x"][k] for k in (0, 80, -1)],
            ),
            (True, [], [], 161, [], [{"name": "u", "columns": [0, 161]}], [-20.0, 0.0, 20.0]),
            id="a field has its nodes, and formulas instead of values",
        ),
        pytest.param(
            boxed,
            lambda data: (data["q"], data["shape"]["points"], data["shape"]["box"], data["parameters"][0]["place"]),
            ([0.0, 1.0, 2.0, 7.0], [[1, 2], [3, 4]], [9, 9], 0),  # registers: t, q, p, parameters
            id="particles have the periods of their box",
        ),
    ],
)
@pytest.mark.usefixtures("without_compiler")
def test_a_page_contains_what_its_scripts_need(model, read, expected, recwarn):
    assert read(described(sc.page(model() if callable(model) else model).html)) == expected
    assert [str(each.message) for each in recwarn] == []  # parameters of initial formulas are used


def test_a_missing_compiler_is_an_error_with_its_remedy(tmp_path, monkeypatch):
    find = importlib.util.find_spec
    absent = lambda name, *more: None if name == "ziglang" else find(name, *more)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", absent)
    with pytest.raises(sc.BuildError, match=r"pip install 'scvi-codegen\[compiler\]'"):
        sc.page(written(tmp_path))


FRAMES = """
const { cost, slower, resolution, drawing } = JSON.parse(process.argv[1]);
let time = 0, step = cost;
const clock = () => Math.floor(time / resolution) * resolution, frames = scheduler(clock), list = [];
for (let k = 0; k < 100; k++) {
  const began = time;
  if (k === 50) step *= slower;
  frames.begin();
  const done = frames.perform(() => 1e7, (now) => { time += now * step; }), drawn = clock();
  time += drawing;
  frames.drawn(clock() - drawn);
  list.push([time - began, done * step]);
  time += 4.7;
}
console.log(JSON.stringify(list));
"""


@pytest.mark.parametrize(
    ("cost", "slower", "resolution", "drawing"),
    [(0.0002, 4, 0.1, 0.5), (0.02, 4, 0.1, 3), (0.08, 4, 1, 1), (1.5, 1, 0.005, 3), (0.3, 4, 0.005, 9)],
)
def test_a_frame_takes_at_most_12_milliseconds(cost, slower, resolution, drawing):
    """The clock of the scheduler is that of the test, rounded as in browsers; steps become slower in frame 50."""
    node = needs("node")
    text = (Path(__file__).parents[2] / "templates/page/frames.js").read_text(encoding="utf-8")
    case = {"cost": cost, "slower": slower, "resolution": resolution, "drawing": drawing}
    done = subprocess.run([node, "-e", text + FRAMES, json.dumps(case)], capture_output=True, check=True)
    durations, performed = np.array(json.loads(done.stdout)).T
    assert durations[1:].max() < 12.001 + max(0.0, resolution - 0.1)
    assert durations[0] < 12.001 + drawing  # whose time is unknown
    assert performed[5:].mean() > 0.5 * max(2.0, 10.5 - drawing)


def computed(text, steps):
    """Return the state of a page after steps, in node."""
    node = needs("node")
    pytest.importorskip("ziglang", reason="pages are compiled by the extra compiler")
    about = described(text) | {"steps": steps}
    code = gzip.decompress(base64.b64decode(re.search(r'id="wasm">(.*?)</script>', text)[1]))
    done = subprocess.run([node, "-e", NODE, json.dumps(about)], input=code, capture_output=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.second
@pytest.mark.parametrize(
    ("text", "steps", "statuses"),
    [
        pytest.param(BOX, 200, [0, 0], id="impacts and inputs"),
        pytest.param(TRANSFORMED, 200, [0, 0], id="transformed time"),
        pytest.param(FIRST_ORDER, 100, [0, 100], id="first order, adaptive, until an event"),
        pytest.param(STICK_SLIP, 200, [0, 0], id="dry friction"),
        pytest.param(BALL, 60, [0, 100], id="a contact with friction, adaptive"),
        pytest.param(STIFF_FLOOR, 200, [0, 0], id="a kink"),
        pytest.param(BROWNIAN, 200, [0, 0], id="a heat bath"),
        pytest.param(BROWNIAN + "metropolis = true\n", 200, [0, 0], id="Metropolis steps"),
    ],
)
def test_the_webassembly_computes_the_bits_of_python_within_300_kilobytes(tmp_path, text, steps, statuses):
    needs("node")
    pytest.importorskip("ziglang", reason="pages are compiled by the extra compiler")
    path = written(tmp_path, text)
    page = sc.page(path)
    assert len(page.html) < 300_000  # of which the font of formulas has 68,000
    state = computed(page.html, steps)
    assert state["statuses"] == statuses
    model = sc.load_model(path)
    stepper = sc.compile_stepper(model.system, model.method, flags=PORTABLE_FLAGS, events=page.model.events or None)
    known = {"inputs": model.inputs} if model.inputs else {}
    known |= {"seed": model.seed, "metropolis": model.metropolis} if model.system.bath else {}
    adaptive = {"tolerance": model.tolerance, "max_step": model.max_step, "t_end": model.end}
    adaptive |= {"first_step": model.first_step}  # the search for it depends on t_end
    h = {"h": model.h, "steps": steps} if model.h else adaptive
    run = stepper.integrate(model.q, model.momenta(stepper), parameters=model.parameters, **h, **known)
    assert state["t"] == run.t[-1]
    assert np.array_equal(state["q"], run.q[-1])
    assert np.array_equal(state["p"], run.p[-1])
    assert state["energy"] == run.energy()[-1]
    assert state["stored"] == len(run.t) - 1
    assert ("forward only" in state["turned"]) == bool(stepper.interface.contacts or model.system.bath)


@pytest.mark.rotated
@pytest.mark.parametrize(("text", "shown"), [(STICK_SLIP, (["F"], False)), (STIFF_FLOOR, ([], True))])
@pytest.mark.usefixtures("without_compiler")
def test_modes_have_no_sliders_and_kinks_conserve_energy(tmp_path, text, shown):
    about = described(sc.page(written(tmp_path, text)).html)
    assert ([each["name"] for each in about["parameters"]], about["energy"]["conserved"]) == shown


@pytest.mark.full
def test_every_motion_of_the_site_moves_within_its_size(browser, tmp_path):
    for path in sorted(MOTIONS.glob("*.toml")):
        file, messages, view = tmp_path / f"{path.stem}.html", [], browser.new_page()
        sc.page(path).save(file)
        assert file.stat().st_size < 300_000, path
        view.on("console", lambda message, to=messages: to.append(message.text))
        view.on("pageerror", lambda error, to=messages: to.append(str(error)))
        view.goto(file.as_uri())
        for _ in range(200):
            time.sleep(0.1)
            if (state := view.evaluate("globalThis.page ? page.state() : null")) and (
                state["steps"] > 5 or state["fault"]
            ):
                break
        assert (state["steps"] > 5, state["fault"], messages) == (True, 0, []), path
        view.close()


def script(name: str, *beginnings: str) -> str:
    """Return the lines of a script of pages that begin so, with the lines of functions."""
    text = (Path(pages.__file__).parents[3] / "templates" / "page" / name).read_text(encoding="utf-8")
    ends = ["^}$" if each.startswith("function") else ";$" for each in beginnings]
    patterns = [rf"^{re.escape(each)}.*?{end}" for each, end in zip(beginnings, ends, strict=True)]
    found = [re.search(pattern, text, re.MULTILINE | re.DOTALL) for pattern in patterns]
    return "\n".join(match[0] for match in found if match)


def test_names_of_properties_of_objects_are_names_and_large_numbers_keep_their_digits():
    names = script("plots.js", "const GREEK", "const LOW_DIGITS", "function parted", "const spelled")
    numbers = script("drawing.js", "function compact")
    tables = script("engine.js", "const byName")
    program = f"""{names} {numbers} {tables}
    const ranges = byName([["mu", [0, 1]]]);
    console.log(JSON.stringify([
      ["constructor", "toString", "theta_1", "valueOf"].map(spelled), ["constructor", "mu"].map((key) => key in ranges),
      [3.986e14, 1234567, 999999, 0.0001234, -2.5e7, 0].map((x) => compact(x, 4)),
    ]));"""
    printed = subprocess.run([needs("node"), "-e", program], capture_output=True, text=True, check=True).stdout
    labels, known, numbers = json.loads(printed)
    assert labels == ["constructor", "toString", "θ₁", "valueOf"]
    assert known == [False, True]
    assert numbers == ["3.986e14", "1.235e6", "1000000", "1.234e-4", "-2.5e7", "0"]


def test_formulas_of_initial_values_are_standard_c():
    document = {"initial": {"q": {"u": "sin(pi*x) + exp(1)*x"}, "q_dot": {"u": "sqrt(2)*x/pi"}}}
    texts = pages._initial(document, ["x"])
    assert len(texts) == 2
    assert not any("M_" in text for text in texts)


def test_default_span_and_speed_follow_from_the_step_size():
    orbit = sc.problem("kepler").system
    q, velocity = [7e6, 0.0], [0.0, 7.5e3]
    slow = pages._model_of(orbit, {"q": q, "velocity": velocity, "h": 10.0, "method": "svi:2"})
    assert slow.span == 1e4
    assert pages._model_of(orbit, {"q": q, "velocity": velocity, "h": 0.1, "method": "svi:2"}).span == 30.0
