"""Pages that move: a model file as one HTML file with the generated C, compiled to WebAssembly.

:func:`page_of` generates the C of a model, compiles it with the functions of ``page_entry.c.jinja`` by the ``ziglang``
wheel, and renders ``templates/page``. The description of the drawing follows :func:`scvi_codegen.run.animate`.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jinja2
import numpy as np
import sympy

import scvi_codegen as sc
from scvi_codegen.display.mathml import mathml_terms
from scvi_codegen.mechanics.symmetry.sampling import bodies
from scvi_codegen.pictures import animation

HERE = Path(__file__).parent
TEMPLATES = HERE.parents[1] / "templates"
FLAGS = (
    *("-target", "wasm32-wasi", "-mexec-model=reactor", "-O2", "-msimd128", "-s"),
    *("-ffp-contract=off", "-std=c99", "-Wno-psabi"),
)
CAUSES = (
    "",
    "The step failed: the iteration on the stage equations did not converge. Use a smaller step size.",
    "The step failed: a matrix is singular. Check that no mass is 0.",
    "The step failed: a value is infinite or undefined. Use other values, or a smaller step size.",
    "The step size fell below machine precision, as near a collision. Use other initial values.",
    "The step failed: the iteration converged to a spurious solution. Use a smaller step size.",
)
LICENCES = (
    "The WebAssembly contains parts of musl (© 2005-2020 Rich Felker and others, MIT licence), of wasi-libc (MIT"
    " licence, Apache licence 2.0 with LLVM exception) and of compiler-rt"
    " (Apache licence 2.0 with LLVM exception)."
)
ARRAY = re.compile(r"(\w+)\[")
SECONDS = 30
"""Duration of the span of a model at the speed that a page begins with, unless time is in seconds or so."""


def page_of(path: Path, ranges: dict[str, tuple[float, float]] | None = None) -> str:
    """Return the page of a model file; ``ranges`` are those of sliders of parameters, (lowest, highest) by name.

    Raises:
        ValueError: for what a page cannot show: events, inputs, a time transformation.
    """
    model, document = (
        sc.load_model(path),
        tomllib.loads(path.read_text(encoding="utf-8")),
    )
    if model.events or model.inputs or model.time_transformation is not None:
        raise ValueError(
            f"{path}: pages have no events, inputs and time transformations"
        )
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, "motion")
        command = [
            sys.executable,
            "-m",
            "scvi_codegen",
            "generate",
            str(path),
            "-o",
            str(folder),
            "--quiet",
        ]
        subprocess.run(command, check=True, capture_output=True)
        interface = _interface(folder, model)
        adaptive = model.h is None and model.tolerance is not None
        code = _compiled(folder, model, document, interface, adaptive=adaptive)
    description = _description(
        model, document, interface, ranges or {}, adaptive=adaptive
    )
    environment = _environment(TEMPLATES)
    return environment.get_template("page/page.html.jinja").render(
        title=interface.system,
        method=interface.title.split(": ", 1)[1],
        version=sc.__version__,
        licences=LICENCES,
        lagrangian=_lagrangian(document),
        description=json.dumps(description, separators=(",", ":")).replace(
            "</", "<\\/"
        ),
        wasm=base64.b64encode(gzip.compress(code, mtime=0)).decode(),
    )


def _environment(folder: Path) -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def _interface(folder: Path, model: Any) -> SimpleNamespace:
    """Return names, sizes and titles of a generated integrator, of either kind."""
    data = json.loads((folder / "interface.json").read_text(encoding="utf-8"))
    if "interface" in data:
        return SimpleNamespace(**data["interface"], array=False)
    scalars = {
        name: value for name, value in model.parameters.items() if np.ndim(value) == 0
    }
    return SimpleNamespace(
        array=True, title=data["title"], system=model.system.name, coordinates=[], momentum_names=[], rotations=[],
        constraints=[], map_names=[], parameters=list(scalars), defaults=list(scalars.values()), conserves_energy=True,
        sizes=data["sizes"],
    )  # fmt: skip


def _compiled(
    folder: Path,
    model: Any,
    document: dict[str, Any],
    interface: Any,
    *,
    adaptive: bool,
) -> bytes:
    """Return the WebAssembly of the integrator in a folder."""
    header, size = (
        (folder / "motion.h").read_text(encoding="utf-8"),
        len(_flat(model.q)),
    )

    def listed(word: str) -> list[str]:
        found = re.search(rf"\*{word}\[\d+\]; /\* (.*?) \*/", header, re.DOTALL)
        return ARRAY.findall(found[1]) if found else []

    values = {
        name: model.parameters.get(name, value)
        for name, value in zip(interface.parameters, interface.defaults, strict=True)
    }
    numbers = [str(float(value)) for value in values.values()]
    tables = {}
    if interface.array:
        for name in listed("field"):
            numbers += (
                (folder / f"field_{name}.txt").read_text(encoding="utf-8").split()
            )
        tables = {
            name: (folder / f"table_{name}.txt").read_text(encoding="utf-8").split()
            for name in listed("table")
        }
    mesh = model.mesh
    axes = (
        {name: np.ravel(nodes).tolist() for name, nodes in mesh.points.items()}
        if mesh
        else {}
    )
    initial = _initial(document, [*axes, *values]) if mesh else ()
    source = _environment(HERE).get_template("page_entry.c.jinja").render(
        array=interface.array, m=size, capacity=256 if size < 64 else 16, maps=len(interface.map_names), values=numbers,
        sizes=list(interface.sizes.values()) if interface.array else (), tables=tables,
        constraints=interface.constraints, adaptive=adaptive, initial=initial,
        axes=axes, names={name: k for k, name in enumerate(values)},
    )  # fmt: skip
    (folder / "page.c").write_text(source, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "ziglang",
        "cc",
        *FLAGS,
        "page.c",
        "motion.c",
        "-lm",
        "-o",
        "page.wasm",
    ]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return (folder / "page.wasm").read_bytes()


def _initial(document: dict[str, Any], names: list[str]) -> tuple[str, ...]:
    """Return the formulas of the first field and its rate as C, if all its initial values are formulas."""
    symbols = {name: sympy.Symbol(name) for name in names}
    formulas = [
        next(iter(document["initial"].get(key, {}).values()), None)
        for key in ("q", "q_dot")
    ]
    if not all(isinstance(formula, str) for formula in formulas):
        return ()
    return tuple(
        sympy.ccode(sympy.sympify(formula, locals=symbols)) for formula in formulas
    )


def _lagrangian(document: dict[str, Any]) -> list[str]:
    """Return the Lagrangian or density as written, as terms of MathML; none of sums over indices."""
    text = document.get("field", {}).get("density") or document.get("system", {}).get(
        "lagrangian"
    )
    if not text or "sum(" in text:
        return []
    names = {
        name: sympy.Symbol(name) for name in re.findall(r"[A-Za-z_]\w*\b(?!\()", text)
    }
    return list(mathml_terms(sympy.sympify(text, locals=names), sympy.Symbol("L")))


def _flat(state: Any) -> list[float]:
    """Return the numbers of a state: a sequence, or arrays by name."""
    parts = state.values() if isinstance(state, dict) else [state]
    return np.concatenate([np.ravel(part) for part in parts]).astype(float).tolist()


def _description(
    model: Any,
    document: dict[str, Any],
    interface: Any,
    ranges: dict[str, tuple[float, float]],
    *,
    adaptive: bool,
) -> dict[str, Any]:
    """Return what the scripts of the page read."""
    q, v = _flat(model.q), _flat(model.velocity)
    shape = _shape(model, interface, q)
    rods = "rods" in shape["source"]
    parameters = []
    for name, default in zip(interface.parameters, interface.defaults, strict=True):
        value = float(model.parameters.get(name, default))
        size = abs(value) or 1.0
        low, high = ranges.get(
            name,
            (size / 20, 3 * size)
            if value > 0
            else (-3 * size, 3 * size if value else size),
        )
        parameters.append({"name": name, "value": value, "low": low, "high": high})
    span = abs(float(model.end - model.t))
    speed = 1.0 if 0.3 < span / SECONDS < 4 else float(f"{span / SECONDS:.0e}")
    step = model.tolerance if adaptive else float(model.h)
    energy = {"label": "Energy", "conserved": bool(interface.conserves_energy)}
    largest = [max([1.0, *(abs(x) for x in kind)]) for kind in (q, v)]
    return {
        "m": len(q), "q": q, "v": v, "t": float(model.t), "coordinates": interface.coordinates,
        "momenta": interface.momentum_names, "parameters": parameters, "quantities": interface.map_names,
        "energy": energy, "plots": [], "causes": CAUSES,
        "initial": bool(model.mesh and _initial(document, [*model.mesh.points, *interface.parameters])),
        "step": {"kind": "adaptive" if adaptive else "fixed", "value": step,
                 **({"low": 1e-15, "high": 1e-4} if adaptive else {"low": step / 20, "high": step * 8})},
        "speed": {"value": speed, "low": speed / 50, "high": speed * 20},
        "ranges": {"q": [[-np.pi, np.pi] if rods else [-2 * largest[0], 2 * largest[0]]] * len(q),
                   "v": [[-12.0, 12.0] if rods else [-2 * largest[1], 2 * largest[1]]] * len(q)},
        "shape": shape,
    }  # fmt: skip


def _named(parameters: list[str], starts: tuple[str, ...], number: Any) -> str | float:
    """Return the parameter of a body, m1 or m_1 or m; 1 if there is none."""
    names = [f"{start}{end}" for end in (number, f"_{number}", "") for start in starts]
    return next((name for name in names if name in parameters), 1.0)


def _shape(model: Any, interface: Any, q: list[float]) -> dict[str, Any]:
    """Return how states are drawn, as :func:`scvi_codegen.pictures.animation.shape_of` recognises it."""
    names = interface.coordinates
    shape: dict[str, Any] = {"dimension": 2, "marks": [], "trails": [], "movable": []}
    if (mesh := model.mesh) is not None:
        axes = {
            name: np.unique(np.round(nodes, 12)).tolist()
            for name, nodes in mesh.points.items()
        }
        fields = (
            list(model.q) if isinstance(model.q, dict) else [mesh.field_system.name]
        )
        count = len(q) // len(fields)
        columns = [
            {"name": name, "columns": [k * count, (k + 1) * count]}
            for k, name in enumerate(fields)
        ]
        return shape | {"source": {"mesh": {"axes": axes, "fields": columns}}}
    if interface.array:
        [(name, values)] = list(model.q.items())[:1]
        values = np.asarray(values)
        if values.ndim == 2 and values.shape[1] in (2, 3):
            dimension, count = values.shape[1], len(values)
            columns = np.arange(values.size).reshape(values.shape).tolist()
            marks = [{"kind": "particles", "points": list(range(count))}]
            return shape | {
                "dimension": dimension,
                "source": {"columns": columns},
                "marks": marks,
            }
        letters = [f"{letter}" for letter in "ij"[: values.ndim]]
        axes = {
            letter: list(range(size))
            for letter, size in zip(letters, values.shape, strict=True)
        }
        field = [{"name": name, "columns": [0, values.size]}]
        return shape | {
            "source": {"mesh": {"axes": axes, "fields": field}},
            "dots": values.size <= 100,
        }
    if interface.rotations:
        return shape | _solids(interface)
    if found := bodies(names):
        columns = [list(body.columns) for body in found]
        marks = [
            {
                "kind": "body",
                "points": [k],
                "mass": _named(interface.parameters, ("m",), body.name),
                "name": body.name,
            }
            for k, body in enumerate(found)
        ]
        points = list(range(len(found)))
        rods, pins = _rods(interface, found)
        return shape | {
            "dimension": len(columns[0]),
            "source": {"columns": columns, "pins": pins},
            "marks": rods + marks,
            "trails": points,
            "movable": points,
        }
    drawn = SimpleNamespace(
        stepper=model.stepper(), q=np.atleast_2d(q), t=[float(model.t)],
        parameters=[model.parameters.get(name, value) for name, value in zip(interface.parameters, interface.defaults)],  # noqa: B905
    )  # fmt: skip
    if (sign := animation._hanging(drawn)) is not None:
        numbers = animation._numbers(names) or ("",) * len(names)
        lengths = [
            _named(interface.parameters, animation.LENGTHS, number)
            for number in numbers
        ]
        ends = list(range(1, len(names) + 1))
        marks = [
            {"kind": "rod", "points": [0, *ends]},
            {"kind": "pivot", "points": [0]},
        ]
        marks += [
            {
                "kind": "bob",
                "points": [k],
                "mass": _named(interface.parameters, ("m",), number),
            }
            for k, number in zip(ends, numbers, strict=True)
        ]
        return shape | {"source": {"rods": {"sign": sign, "lengths": lengths}}, "marks": marks, "trails": ends[-1:],
                        "movable": ends}  # fmt: skip
    if len(names) <= 2:
        columns = [[0, 1] if len(names) == 2 else [-1, 0]]
        marks = [{"kind": "body", "points": [0]}]
        return shape | {
            "source": {"columns": columns},
            "marks": marks,
            "trails": [0],
            "movable": [0],
        }
    field = [{"name": "q", "columns": [0, len(q)]}]
    return shape | {
        "source": {"mesh": {"axes": {"i": list(range(len(q)))}, "fields": field}},
        "dots": True,
    }


def _rods(interface: Any, found: Any) -> tuple[list[dict[str, Any]], list[list[Any]]]:
    """Return rods of constraints on the distance of two bodies, or of one from a fixed point, and these points."""
    rods, pins = [], []
    for text in interface.constraints:
        constraint = sympy.sympify(
            text, locals={name: sympy.Symbol(name) for name in interface.parameters}
        )
        used = {symbol.name for symbol in constraint.free_symbols}
        names = [[interface.coordinates[c] for c in body.columns] for body in found]
        ends = [k for k, each in enumerate(names) if used & {*each}]
        if len(ends) == 2:
            rods.append({"kind": "rod", "points": ends})
        elif len(ends) == 1:
            place = sympy.symbols(names[ends[0]])
            centre = sympy.solve([constraint.diff(x) for x in place], place)
            values = [
                centre.get(x) if isinstance(centre, dict) else None for x in place
            ]
            if all(
                value is not None and (value.is_Symbol or value.is_number)
                for value in values
            ):
                rods.append(
                    {"kind": "rod", "points": [len(found) + len(pins), ends[0]]}
                )
                rods.append({"kind": "pivot", "points": [len(found) + len(pins)]})
                pins.append(
                    [
                        value.name if value.is_Symbol else float(value)
                        for value in values
                    ]
                )
    return rods, pins


def _solids(interface: Any) -> dict[str, Any]:
    """Return boxes of rotations, tops of symmetric ones, and arrows of directions and spins."""
    names, solids, marks, trails = interface.coordinates, [], [], []
    centre = [names.index(name) for name in "xyz" if name in names]
    for k, text in enumerate(interface.rotations):
        kind, name, rate = (
            text.split()[:3] if len(text.split()) > 2 else (*text.split(), "")
        )
        letters = "wxyz" if kind == "rotation" else "xyz"
        columns = [names.index(f"{name}_{letter}") for letter in letters]
        symmetric = f"body momentum 3 of {name}" in interface.map_names
        solid = {
            "name": name,
            "columns": columns,
            "form": "top" if symmetric else "box",
        }
        solids.append(solid | {"omega": [f"{rate}_{axis}" for axis in (1, 2, 3)]})
        if len(centre) == 3:
            solids[-1]["centre"] = centre
        mark = {"kind": "body", "points": [2 * k + 1], "mass": 0.1, "color": k + 1}
        marks += (
            [mark]
            if kind == "rotation"
            else [{"kind": "arrow", "points": [2 * k, 2 * k + 1]}]
        )
        trails.append(2 * k + 1)
    return {
        "dimension": 3,
        "source": {"solids": solids},
        "marks": marks,
        "trails": trails,
    }
