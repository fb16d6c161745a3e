"""Shapes: pictures from formulas, their errors, and equal points in NumPy and in the JavaScript of pages."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from notation import lagrange
from programs import needs

import scvi_codegen as sc
from scvi_codegen.extras.pages.section import drawn_system_of_model
from scvi_codegen.extras.pictures.recognition import shape_of
from scvi_codegen.extras.pictures.shape import shape_of_picture
from scvi_codegen.interfaces.models.model_files.model_file import parse_model
from scvi_codegen.systems.formulas.expressions import ARGUMENTS, FUNCTIONS

ROOT = Path(__file__).parents[2]
MOTIONS = ROOT / "docs" / "motions"
CART = """[system]
name = "cart and pendulum"
coordinates = ["x", "theta"]
lagrangian = "x_dot**2 + theta_dot**2/2 + x_dot*theta_dot*cos(theta) + g*cos(theta) - k*x**2/2"
[parameters]
g = 9.81
k = 2.0
l = 1.5
[initial]
q = [0.1, 0.5]
q_dot = [0.0, 0.0]
[run]
step = 0.05
span = 5.0
[picture]
points.left = [-2, -1]
points.wall = [-2, 1]
points.end = [-2, 0]
points.cart = ["x", 0]
points.bob = ["x + l*sin(theta)", "-l*cos(theta)"]
rods = [["cart", "bob"]]
springs = [["end", "cart"]]
walls = [["left", "wall"]]
"""


@pytest.mark.rotated
def test_a_picture_is_drawn_in_films_and_written_to_files(tmp_path):
    pytest.importorskip("matplotlib")
    (tmp_path / "cart.toml").write_text(CART, encoding="utf-8")
    model = sc.load_model(tmp_path / "cart.toml")  # l is used by the picture alone
    sc.save_model(model, tmp_path / "again.toml")
    assert sc.load_model(tmp_path / "again.toml") == model
    film = model.integrate().animate(picture=model.picture, seconds=0.2)
    (shape,) = film.shapes
    assert [(mark["kind"], mark["points"]) for mark in shape.marks] == [
        ("wall", [0, 1]),
        ("rod", [3, 4]),
        ("spring", [2, 3]),
        ("pivot", [2]),
        ("body", [3]),
        ("body", [4]),
    ]
    state = shape.positions(0.0, np.array([[0.1, 0.5]]), np.zeros((1, 2)), [9.81, 2.0, 1.5])[0]
    assert np.allclose(state[2:], [[-2, 0], [0.1, 0], [0.1 + 1.5 * np.sin(0.5), -1.5 * np.cos(0.5)]])
    film.animation._init_draw()
    spring = max((line.get_xydata() for line in film.animation._fig.axes[0].lines), key=len)
    assert np.allclose(spring[[0, -1]], [state[2], [film.trajectory.q[0, 0], 0]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('cart = ["x", 0]', 'cart = ["y", 0]', r"\[picture\] points cart: .*'y'"),
        ('cart = ["x", 0]', 'cart = ["x_dot", 0]', r"\[picture\] points cart: .*'x_dot'"),
        ('cart = ["x", 0]', 'cart = "x"', r"points cart must be two or three formulas or numbers"),
        ('cart = ["x", 0]', 'cart = ["x", 0, 0]', "must all have two components, in the plane, or all three"),
        ('cart = ["x", 0]', 'cart = ["x", true]', "points cart: True must be a formula or a number"),
        ('cart = ["x", 0]', '"cart[k in 0]" = ["x", "k"]', "must be formulas of 1 to 1000 points"),
        ("springs", "strings", r"unknown key 'strings' in \[picture\]; did you mean 'springs'"),
        ('["end", "cart"]', '["end", "card"]', "springs: there is no 'card'; did you mean 'cart'"),
        ('["end", "cart"]', '["end"]', r"springs: \['end'\] must be two points"),
        ('[["end", "cart"]]', '"end"', "springs must be a list, not 'end'"),
        ('[["end", "cart"]]', '["end", "cart"]', r"springs must be lists of points, .* not 'end'"),
    ],
)
def test_mistakes_in_a_picture_are_errors(old, new, message):
    with pytest.raises(sc.ModelFileError, match=message):
        parse_model(CART.replace(old, new))


def test_pictures_of_arrays_and_rotations_use_entries():
    chain = lagrange("chain", "q[N]", "sum(i in N, q_dot[i]**2/2)-sum(i in 0..N-2, (q[i+1]-q[i])**2)")
    model = sc.Model(system=chain, method="svi:2", q={"q": np.arange(4.0)}, h=0.1, steps=1)
    shape = shape_of_picture(drawn_system_of_model(model), {"points": {"mean": ["sum(i in 4, q[i])/4", "q[2]"]}})
    assert np.allclose(shape.positions(0.0, np.arange(4.0)[np.newaxis], np.zeros((1, 4)), ()), [[[1.5, 2.0]]])
    body = sc.LagrangianSystem.from_text("b", rotations={"R": "omega"}, lagrangian="omega_1**2+omega_2**2+omega_3**2")
    model = sc.Model(system=body, method="svi:2", q=[0.5, 0.5, 0.5, 0.5], velocity=[0.0] * 4, h=0.1, steps=1)
    shape = shape_of_picture(drawn_system_of_model(model), {"points": {"a": ["R_11", "R_21", "R_31"], "o": [0, 0, 0]}})
    assert np.allclose(shape.positions(0.0, np.array([[0.5] * 4]), np.zeros((1, 4)), ())[0, 0], [0, 1, 0])
    pair = lagrange("pair", (), "sum(i in 2, w_1[i]**2 + w_2[i]**2 + w_3[i]**2)", rotations={"R[2]": "w"})
    model = sc.Model(system=pair, method="svi:2", q=[0.5] * 8, velocity=[0.0] * 8, h=0.1, steps=1)
    shape = shape_of(drawn_system_of_model(model))
    (state,) = shape.positions(0.0, np.array([[0.5] * 8]), np.zeros((1, 8)), ())
    assert np.allclose(state[4:], np.add(state[:4], [1.5, 0, 0]))  # side by side
    assert np.allclose(state[:4], [[0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]])


@pytest.mark.rotated
def test_bonds_of_a_table_are_lines_and_momenta_of_a_field_are_drawn():
    model = sc.load_model(MOTIONS / "cloth.toml")
    shape = shape_of(drawn_system_of_model(model))
    bonds = shape.marks[0]
    assert (bonds["kind"], bonds["points"][:4], len(bonds["points"])) == ("bonds", [10, 0, 11, 1], 2 * 342)
    pytest.importorskip("matplotlib")
    film = replace(model, span=None, steps=2).integrate().animate(seconds=0.2)
    assert film.shapes[0].marks[0] == bonds
    film.animation._init_draw()
    line = film.animation._fig.axes[0].lines[0].get_data_3d()
    assert np.isnan(line).sum(axis=1).tolist() == [342] * 3
    kdv = sc.load_model(MOTIONS / "kdv.toml")
    shape = shape_of_picture(drawn_system_of_model(kdv), kdv.picture)
    q, p = (np.ravel(each["q"])[np.newaxis] for each in (kdv.q, kdv.p))
    x, values = shape.positions(np.zeros(1), q, p, ())[0].T
    assert x[values.argmax()] == pytest.approx(-4.3, abs=0.3)  # the high soliton, of height one half, of u/2 1.2
    assert np.allclose(values, p / 32 * 63, rtol=1e-12)
    for picture, message in (
        ({"fields": ["r"]}, r"fields: there is no 'r'.* Known: q, p"),
        ({"fields": ["p"], "rods": []}, "without other keys: omit it"),
    ):
        with pytest.raises(sc.ModelFileError, match=message):
            shape_of_picture(drawn_system_of_model(kdv), picture)


NODE = """
const { about, states } = JSON.parse(require("fs").readFileSync(0)), { m } = about;
const memory_parameters = about.parameters;
SOURCE
console.log(JSON.stringify(states.map(([t, q, p]) => pointsOf(q, p, t))));
"""


def shapes():
    """Return models with their shapes: every function, solids, a robot with fixed and moving base, a periodic box."""
    further = {2: ", theta**2", 3: " > 0, theta, theta**2"}
    formulas = [f"{name}(0.3*sin(x + t){further.get(ARGUMENTS.get(name), '')} + l - 1)" for name in FUNCTIONS]
    formulas = [each.replace(" - 1", "") if each.startswith("acosh") else each for each in formulas]
    points = {f"p{k}": [each, "-theta**3/p_x"] for k, each in enumerate(formulas)}
    model = parse_model(CART)
    yield model, shape_of_picture(drawn_system_of_model(model), {"points": points})
    top = sc.load_model(MOTIONS / "lagrange_top.toml")
    for name in ("figure.xml", "ball.xml"):
        system = sc.LagrangianSystem.from_mjcf(ROOT / "tests" / "systems" / "robots" / name)
        q = [0.4 + 0.1 * k for k in range(system.dimension)]
        robot = sc.Model(system=system, method="svi:2", q=q, velocity=[0.0] * len(q), h=0.1, steps=1)
        yield robot, shape_of(drawn_system_of_model(robot))
    yield top, shape_of(drawn_system_of_model(top))


@pytest.mark.rotated
def test_pages_and_films_have_the_same_points():
    node = needs("node")
    text = (ROOT / "templates" / "page" / "drawing.js").read_text(encoding="utf-8")
    source = text[text.index("// ---- points of a shape") : text.index("// ---- views")]
    rng = np.random.default_rng(5)
    for model, shape in shapes():
        values = [value for value in model.parameters.values() if np.ndim(value) == 0]
        m = model.dimension
        t, (q, p) = np.array([0.0, 0.7, -2.0]), 0.3 + rng.random((2, 3, m))
        about = {"m": m, "parameters": values, "values": len(values), "shape": shape.to_data()}
        given = json.dumps({"about": about, "states": list(zip(t.tolist(), q.tolist(), p.tolist(), strict=True))})
        done = subprocess.run(
            [node, "-e", NODE.replace("SOURCE", source)], input=given, capture_output=True, check=False, text=True
        )
        assert not done.returncode, done.stderr[-400:]
        expected = shape.positions(t, q, p, values)
        assert np.isfinite(expected).all()
        assert np.allclose(json.loads(done.stdout), expected, rtol=1e-12, atol=1e-12), model.system.name
