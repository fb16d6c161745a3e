"""Pages that move: a model as one HTML file with its generated C, compiled to WebAssembly, and controls.

:func:`page` generates the C of a model, compiles it with the functions of ``templates/page/entry.c.jinja``, and renders
``templates/page``. The file needs no network, and evaluates no text as code.
"""

from __future__ import annotations

import html
import json
import math
import os
import re
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import sympy

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.api.formulas import Rotation, RotationNames, input_parameters, parse_expression, symbol
from scvi_codegen.api.program import Interface, Source, checked_integrator
from scvi_codegen.api.systems import ArraySystem, MechanicalSystem
from scvi_codegen.api.text import Typeset, summary, write_text
from scvi_codegen.common.errors import ArgumentError, ExpressionError, MethodError, StateError, closest
from scvi_codegen.extras.derivation.writing import mathematics_font, plain_template
from scvi_codegen.extras.orbits.family import Family
from scvi_codegen.extras.orbits.picture import indices_of
from scvi_codegen.extras.orbits.solver import ERROR, PeriodicOrbit
from scvi_codegen.extras.pages.section import check_page, check_picture, drawn_system_of_model, starts_from_momenta
from scvi_codegen.extras.pages.webassembly import LICENCES, check_compiler, webassembly
from scvi_codegen.extras.pictures.recognition import shape_of
from scvi_codegen.extras.pictures.shape import DrawnSystem, shape_of_picture
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.model_file import load_model
from scvi_codegen.version import __version__

CAUSES = (
    "",
    "The step failed: the iteration on the stage equations did not converge. Use a smaller step size.",
    "The step failed: a matrix is singular. Check that no mass is 0.",
    "The step failed: a value is infinite or undefined. Use other values, or a smaller step size.",
    "The step size fell below machine precision, as near a collision. Use other initial values.",
    "The step failed: the iteration converged to a spurious solution. Use a smaller step size.",
    "",
    "The step failed: a wall is passed without an impact. Use a smaller step size.",
    "The step failed: the changes of the state by events do not end. Use other initial values.",
    "The initial state is behind a wall. Use other initial values.",
    "The step failed: it has too many events. Use a smaller step size.",
    "The contacts have no motion, as in Painlevé's paradox: use less friction, or other initial values.",
    "With contacts or a heat bath time goes forward only: restart.",
    "The motion slides on a surface where a force jumps: use dry friction of a contact instead.",
)
"""Text of each status of the generated C, then of ``entry.c.jinja``."""
PREFIX = "motion"
"""Prefix of the C names, as in ``entry.c.jinja``."""
NAME = re.compile(r"[A-Za-z_]\w*\b(?!\()")
INDENTED = re.compile(r"^[ \t]+|^[ \t]*//.*\n|^[ \t]*/\*\* .* \*/\n", re.MULTILINE)
"""Indentation and comments of the scripts, which a page omits."""
LONG_NUMBER = re.compile(r"\d{12}")
"""Numbers of robots from files, with which a Lagrangian is not shown."""
SECONDS = 30
"""Duration of the span of a model at the speed that a page begins with, unless time is in seconds or so."""
SECONDS_OF_ORBIT, STEPS_OF_ORBIT = 6, 64
"""Duration of the first orbit of a family, and its least number of adaptive steps, by default."""
STEPS = 1000
"""Default number of steps of the span, from which the speed follows, of step sizes far from seconds."""
HEIGHT = 760
"""Height of a page in a notebook, in pixels."""
WHOLE = 24
"""Number of coordinates up to which plots show each of them; of more, two nodes."""
FAMILY = Kind.of("a family of periodic orbits, of scvi_codegen.family", Family)
MODEL = Kind(
    "a Model, a system or the path of a model file",
    lambda value: isinstance(value, Model | str | os.PathLike) or MechanicalSystem.OR_ARRAYS.accepts(value),
)


@checks_arguments(model=MODEL, family=FAMILY)
def page(
    model: Any,
    *,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    speed: float | None = None,
    plots: Sequence[tuple[str, str]] | None = None,
    picture: Mapping[str, Any] | None = None,
    family: Family | None = None,
    **motion: Any,
) -> Page:
    """Return a page that computes the motion of a model in the browser, with sliders and plots.

    The generated C is compiled to WebAssembly by the extra ``compiler``; its first use takes a minute or two, since it
    compiles its C library. The file of a field contains the formulas of its initial values if ``model`` is a path.
    ``ranges``, ``speed`` and ``plots`` replace those of ``[page]`` in a model file, ``picture`` its ``[picture]``.

    Args:
        model: model, path of a model file, or system (of a field, that of its mesh); steps are fixed, or adaptive
            with a tolerance.
        ranges: lowest and highest value of sliders by name: of parameters, coordinates (``x``) and initial velocities
            (``x_dot``); by default up to three times the value of a parameter.
        speed: time of the model per second, with which the page begins; by default the span takes 30 s if it is not
            of that order.
        plots: names of the variables of each plot, the horizontal one first: t, energy, coordinates, momenta, and
            conserved quantities; of arrays and fields nodes, as ``q.40``.
        picture: what is drawn instead of what is recognised: ``points``, two or three formulas or numbers by name, in
            coordinates, momenta, parameters, entries of rotations and t; ``rods``, ``springs`` and ``walls``, lists of
            points; ``bodies``, points that are drawn and dragged, by default those that move; ``trails``, points whose
            paths are drawn, by default those of the bodies.
        family: periodic orbits of the system, along which a slider moves; the page has their periods, energies and
            stability indices, and begins at the first one, by default with steps of the tolerance 1e-9.
        motion: of a system, the arguments of :class:`Model`: ``q``, ``velocity`` or ``p``, ``h`` or ``tolerance``, and
            also ``method`` (default SVI(8)) and others; default of ``span``: 30, or 1000 steps of
            a size below 0.001 or above 1.

    Returns:
        The page, which a notebook displays.

    Raises:
        MethodError: without a step size or tolerance, and for inputs that are tables instead of numbers.
        StateError: for a parameter outside of its range, an unknown variable of a plot, and another system's family.
        ModelFileError: for an invalid model file, unknown sliders and values of the wrong form.
        ArgumentError: for unknown arguments, and those of a motion beside a model.
        BuildError: without the extra ``compiler``, or if compilation fails.
    """
    arguments = {"ranges": ranges, "speed": speed, "plots": plots, "picture": picture, "family": family}
    settings = {name: value for name, value in arguments.items() if value is not None}
    if MechanicalSystem.OR_ARRAYS.accepts(model):
        if family is not None:
            _check_names(model)
        model = _model_of(model, motion if family is None else {"q": family[0].q, "p": family[0].p, **motion})
    elif motion:
        raise ArgumentError(f"page() takes {', '.join(motion)} for a system alone: change them in the model")
    if isinstance(model, Model):
        return page_of(model, sections_of(model), settings)
    return page_of(load_model(model), as_written(model), settings)


def sections_of(model: Model) -> Mapping[str, Any]:
    """Return the sections of a model file with the density, or with L or H as the system was read from."""
    if model.system.mesh is not None:
        return {"field": model.system.mesh.to_section()}
    system = model.system.in_time
    kind = "hamiltonian" if system.auxiliaries else "lagrangian"
    return {"system": {kind: system.definition.get(kind) or system.text_of(system.formula)}}


def as_written(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    """Return the sections of a model file that was read before; none of a robot's file."""
    is_robot = Path(path).suffix.lower() in (".urdf", ".xml", ".mjcf")
    return {} if is_robot else tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))


def _model_of(system: Any, motion: Mapping[str, Any]) -> Model:
    """Return the model of a system with the arguments of its motion."""
    if "q" not in motion:
        raise ArgumentError(f"a page of the system {system.name} requires its initial state: give q, and velocity or p")
    arguments = dict(motion)
    if "steps" not in motion:
        h = abs(motion.get("h") or 1.0)
        arguments.setdefault("span", float(SECONDS) if 1e-3 <= h <= 1.0 else STEPS * h)
    return Model.of_arguments("page", system, arguments)


def page_of(model: Model, document: Mapping[str, Any], settings: Mapping[str, Any]) -> Page:
    """Return the page of a model whose formulas are those of a document. Raises as :func:`page`.

    Args:
        model: with the settings of its file.
        document: sections of the file, or of :func:`sections_of`.
        settings: ranges, speed, plots and the picture, which replace those of the file, and the family of orbits.
    """
    settings = dict(settings)
    if (family := settings.pop("family", None)) is not None:
        model = _begun_at(model, family)
    model = replace(model, picture=settings.pop("picture", model.picture))
    ranges = {**model.page.get("ranges", {}), **settings.get("ranges", {})}
    model = replace(model, page={**model.page, **settings, "ranges": ranges})
    model._check_double("a page")
    _check(model, ranges)
    check_compiler()  # before the equations are derived
    adaptive = model.h is None or model.time_transformation is not None
    acting = tuple(event for event in model.events if event.changes_state or event.terminal)
    model = replace(model, events=acting)  # others do not affect the motion
    of_fixed_sizes = adaptive or acting or model.system.has_contacts
    result = Page(model.with_known_sizes() if of_fixed_sizes else model, document, adaptive=adaptive, family=family)
    result.html  # noqa: B018  (reports errors here)
    return result


def _check_names(system: Any) -> None:
    """Raise :class:`StateError` for a system with arrays of run-time sizes, whose families are not shown."""
    if isinstance(system, ArraySystem):
        raise StateError(
            f"a page with family= requires named coordinates, and '{system.name}' has arrays of run-time sizes: give "
            "unroll_sums(system, sizes) and a family of this system, or omit family="
        )


def _begun_at(model: Model, family: Family) -> Model:
    """Return a model that begins at the first orbit of a family, with its speed and the range of its parameter."""
    first, page, name = family[0], dict(model.page), model.system.name
    _check_names(model.system)
    if first.stepper.interface.system != name:
        raise StateError(f"the family is one of '{first.stepper.interface.system}', not of '{name}'")
    if family.parameter is not None:
        values = [*family.values.tolist(), model.parameters[family.parameter]]
        page["ranges"] = {family.parameter: (min(values), max(values)), **page.get("ranges", {})}
    page.setdefault("speed", float(f"{first.period / SECONDS_OF_ORBIT:.1g}"))
    if model.h is None and model.tolerance is None:
        model = replace(model, tolerance=ERROR, error=None, max_step=first.period / STEPS_OF_ORBIT)
    return replace(model, q=first.q, p=first.p, velocity=None, t=first.t, page=page)


def _orbits(family: Family, *, from_momenta: bool) -> dict[str, Any]:
    """Return the orbits and bifurcations of a family in their order, as the scripts of the page read them."""
    places = [(k, "", orbit) for k, orbit in enumerate(family)]
    places += [(point.after, point.kind, point.orbit) for point in family.bifurcations]
    _, kinds, orbits = zip(*sorted(places, key=lambda place: place[0]), strict=True)  # stable
    name, indices = indices_of(orbits)

    def entry(kind: str, orbit: PeriodicOrbit, signed: Any) -> dict[str, Any]:
        q, p, names, parameters = orbit.q, orbit.p, orbit.stepper.parameters, orbit.parameters
        v = p if from_momenta else np.asarray(orbit.stepper.velocity(q, p, orbit.t, parameters))
        return {
            "q": q.tolist(), "p": p.tolist(), "v": v.tolist(), "value": family.value_of(orbit), "period": orbit.period,
            "energy": orbit.energy, "parameters": dict(zip(names, parameters.tolist(), strict=False)),
            "indices": signed.tolist(), "stability": "stable" if orbit.stable else "unstable", "bifurcation": kind,
        }  # fmt: skip

    entries = [*map(entry, kinds, orbits, indices.real)]
    return {"value": family.parameter or "energy", "indices": f"Real part of the {name}", "orbits": entries}


def _check(model: Model, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Raise an error for what a page does not have."""
    name = model.system.name
    for input_name, value in model.inputs.items():
        if isinstance(value, tuple):
            raise MethodError(f"a slider sets the input {input_name} of {name}, which is a table: give a number")
    if model.h is None and model.tolerance is None:
        raise MethodError(f"a page requires a step size or tolerance; {name} has neither: give [run] step or tolerance")
    if model.h is None and model.has_time_transformation:
        raise MethodError(f"a page requires the step size in tau of {name}, not a tolerance: give [run] step")
    check_page(model.page, model, "page")
    check_picture(model)
    values = model.parameters | {input_name: model.inputs.get(input_name, 0.0) for input_name in model.system.inputs}
    for parameter in ranges.keys() & values.keys():
        (low, high), value = ranges[parameter], values[parameter]
        if not low <= value <= high:
            raise StateError(f"the range {low:g} .. {high:g} of {parameter} must contain its value {value:g}: widen it")


@dataclass(frozen=True, eq=False)
class Page:
    """Page of a model, which a notebook displays.

    Attributes:
        model: system, method, initial state, step size, and the settings of the page.
        document: sections of its model file.
        adaptive: whether the step size is adaptive.
        family: periodic orbits along which a slider moves.
    """

    model: Model
    document: Mapping[str, Any] = field(repr=False)
    adaptive: bool = False
    family: Family | None = field(default=None, repr=False)

    __repr__ = summary("model")

    @cached_property
    def html(self) -> str:
        """Text of the file."""
        model, document = self.model, self.document
        source, interface = _integrator(model)
        initial = _initial(document, [*model.mesh.points, *interface.parameters]) if model.mesh else ()
        with tempfile.TemporaryDirectory(prefix="scvi-codegen-") as temporary:
            folder = Path(temporary)
            source.write(folder)
            (folder / "page.c").write_text(_entry(model, interface, initial, self.adaptive), encoding="utf-8")
            code = webassembly(folder, ("page.c", *(f"{part.prefix}.c" for part in source.sources)))
        if model.array_system is not None:  # entries have no names
            interface = replace(interface, coordinates=(), conserves_energy=not model.array_system.changes_energy)
        description = _description(self, interface, initial=bool(initial))
        text = plain_template("page/page.html.jinja").render(
            title=html.escape(interface.system), method=html.escape(interface.title.split(": ", 1)[-1]),
            version=__version__, licences=LICENCES, lagrangian=_lagrangian(document, model), font=mathematics_font(),
            description=json.dumps(description, separators=(",", ":")).replace("<", "\\u003c"), wasm=code,
        )  # fmt: skip
        return INDENTED.sub("", text)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, atomically."""
        write_text(path, self.html)

    def _repr_html_(self) -> str:
        title = html.escape(f"{self.model.system.name}: a page that moves")
        return (
            f'<iframe sandbox="allow-scripts" title="{title}" srcdoc="{html.escape(self.html)}"'
            f' style="width: 100%; height: {HEIGHT}px; border: 0"></iframe>'
        )


def _integrator(model: Model) -> tuple[Source, Interface]:
    """Return the C of the integrator, and its interface; of arrays without conserved quantities."""
    source, interface = checked_integrator(model, PREFIX)
    if model.array_system is not None:
        interface = replace(interface, momentum_names=(), map_names=(), constraints=())
    return source, interface


def _entry(model: Model, interface: Interface, initial: Sequence[str], adaptive: bool) -> str:
    """Return the C of the functions that the page calls."""
    size = len(_flat(model.q))
    numbers = [*_values(model, interface).values()]
    sizes, tables = list[int](), dict[str, list[int]]()
    if model.array_system is not None:
        arrays = model.arrays(interface)
        sizes = [arrays.sizes[name] for name in interface.layout.sizes]
        numbers += [x for values in arrays.fields.values() for x in values.ravel().tolist()]
        tables = {name: places.ravel().tolist() for name, places in arrays.places.items()}
    if model.system.bath:
        model.start()  # checks the seed and the rule of Metropolis
    events = interface.searched(model.events)
    points = model.mesh.points if model.mesh else {}
    return (
        plain_template("page/entry.c.jinja").render(
            array=model.array_system is not None, m=size, capacity=256 if size < 64 else 16,
            maps=len(interface.map_names), values=map(repr, numbers), sizes=sizes, tables=tables,
            constraints=interface.constraints, adaptive=adaptive, initial=initial,
            transformed=model.time_transformation is not None,
            max_step=model.max_step or abs(float(model.end - model.t)),
            first_step=model.first_step,
            absolute_tolerances=model.absolute_tolerances(interface), events=events,
            acting=any(event.changes_state for event in events), contacts=interface.contacts, modes=interface.modes,
            velocities=not starts_from_momenta(model),
            level=interface.energy_index if interface.in_tau else None,
            noise=model if model.system.bath else None,
            axes={f"at_{name}": np.ravel(nodes).tolist() for name, nodes in points.items()},
            names={f"at_{name}": k for k, name in enumerate(interface.parameters)},
        )
    )  # fmt: skip


def _values(model: Model, interface: Interface) -> dict[str, float]:
    """Return the scalar parameters by name, in order, with those that contain inputs and the energy of the state."""
    values = model.parameters | {f"{name}_0": value for name, value in model.inputs.items()}
    pairs = zip(interface.parameters, interface.defaults, strict=True)
    return {name: float(values.get(name, default)) for name, default in pairs}


def _initial(document: Mapping[str, Any], names: Sequence[str]) -> tuple[str, ...]:
    """Return the formulas of the only field and its rate as C, or none if an initial value is no formula."""
    symbols = {name: symbol(f"at_{name}") for name in names}
    tables = [document.get("initial", {}).get(key) for key in ("q", "q_dot")]
    formulas = [
        next(iter(table.values())) if isinstance(table, dict) and len(table) == 1 else table for table in tables
    ]
    if not all(isinstance(formula, str) for formula in formulas):
        return ()
    try:
        texts = tuple(_c_text(parse_expression(str(formula), symbols)) for formula in formulas)
    except ExpressionError:
        return ()
    return () if any("\n" in text for text in texts) else texts  # of functions that C does not have


def _c_text(formula: sympy.Expr) -> str:
    """Return a formula as C without the constants of math.h that are no standard C, such as ``M_PI``."""
    constants = {number: sympy.Float(number, 17) for number in (sympy.pi, sympy.E)}
    return str(sympy.ccode(formula.xreplace(constants), math_macros={}))


def _lagrangian(document: Mapping[str, Any], model: Model) -> list[str]:
    """Return the Lagrangian, density or Hamiltonian as written, as terms of MathML; none of arrays and robots."""
    if model.system.drawn_links:
        return []
    source = document.get("field") or document.get("system", {})
    text = str(source.get("density") or source.get("lagrangian") or source.get("hamiltonian") or "")
    try:
        density = parse_expression(text, {name: symbol(name) for name in NAME.findall(text)})
    except ExpressionError:
        return []
    name = sympy.Symbol("H" if "hamiltonian" in source else "L")
    return [] if LONG_NUMBER.search(str(density)) else list(Typeset.terms(density, name))


def _flat(state: Any) -> list[float]:
    """Return the numbers of a state: a sequence, or arrays by name."""
    parts = state.values() if isinstance(state, Mapping) else [state]
    result: list[float] = np.concatenate([np.ravel(part) for part in parts]).astype(float).tolist()
    return result


def _rates(model: Model) -> list[float]:
    """Return the initial velocities, or momenta: see :func:`starts_from_momenta`."""
    from_momenta = starts_from_momenta(model)
    rates = model.p if from_momenta else model.velocity
    if rates is not None:
        return _flat(rates)
    if model.p is None and model.velocity is None:
        return [0.0] * model.dimension
    model._check_double("a page")
    stepper = model.stepper()
    if from_momenta:
        return _flat(model.momenta(stepper))
    return _flat(stepper.velocity(model.q, model.p, model.t, model.parameters))


def _drawn_system(model: Model, interface: Interface) -> DrawnSystem:
    """Return what the recognition of a shape reads of a model; a stepper is compiled where it needs the energy."""

    def energy(q: Any, p: Any) -> Any:
        return np.asarray(model.stepper().energy(q, p, model.t, model.parameters), dtype=float)

    system = drawn_system_of_model(model)
    if model.array_system is not None:
        return system
    names = {name: getattr(interface, name) for name in ("coordinates", "parameters", "rotations")}
    return replace(system, **names, constraints=interface.constraints, map_names=interface.map_names, energy=energy)


def _description(shown: Page, interface: Interface, *, initial: bool) -> dict[str, Any]:
    """Return what the scripts of the page read."""
    model, adaptive = shown.model, shown.adaptive
    orbits = None if shown.family is None else _orbits(shown.family, from_momenta=starts_from_momenta(model))
    q, v = (orbits["orbits"][0][name] for name in "qv") if orbits else (_flat(model.q), _rates(model))
    system = _drawn_system(model, interface)
    shape = (shape_of_picture(system, model.picture) if model.picture else shape_of(system)).to_data()
    span = abs(float(model.end - model.t))
    speed = model.page.get("speed", 1.0 if 0.3 < span / SECONDS < 4 else float(f"{span / SECONDS:.0e}"))
    changes = {event.restitution for event in model.events if event.changes_state}
    conserved = interface.conserves_energy and not interface.contacts and changes <= {1.0}
    variables = _variables(interface, shape, len(q))
    plots = [[_variable(name, variables) for name in reversed(pair)] for pair in model.page.get("plots", ())]
    return {
        "m": len(q), "q": [] if initial else q, "v": [] if initial else v, "t": float(model.t),
        "coordinates": interface.coordinates, "rotations": _rotations(interface),
        "momenta": interface.momentum_names, "parameters": _parameter_sliders(model, interface),
        "quantities": interface.map_names,
        "energy": {"label": "Energy", "conserved": bool(conserved)}, "plots": plots,
        "causes": CAUSES, "events": [str(event.function) for event in interface.searched(model.events)],
        "from_momenta": starts_from_momenta(model), "values": len(interface.parameters),
        "initial": initial, "whole": WHOLE, "family": orbits,
        "step": {"adaptive": adaptive or model.has_time_transformation, **_step_slider(model)},
        "speed": {"value": speed, "low": speed / 50, "high": speed * 20},
        "ranges": _start_sliders(model, interface, q, v, are_angles=len(shape["angles"]) == len(q)), "shape": shape,
    }  # fmt: skip


def _start_sliders(
    model: Model, interface: Interface, q: list[float], v: list[float], *, are_angles: bool
) -> dict[str, Any]:
    """Return the ranges of the sliders of the initial positions and of the velocities or momenta."""
    ranges = model.page.get("ranges", {})
    limits = [math.pi, 12.0] if are_angles else [2 * max([1.0, *map(abs, numbers)]) for numbers in (q, v)]
    names = interface.coordinates or [""] * len(q)
    rates = interface.momentum_names if starts_from_momenta(model) else [f"{name}_dot" for name in names]
    return {
        kind: [ranges.get(name, [-limit, limit]) for name in names_of_kind]
        for kind, names_of_kind, limit in zip("qv", (names, rates or names), limits, strict=True)
    }


def _parameter_sliders(model: Model, interface: Interface) -> list[dict[str, Any]]:
    """Return name, value, range and index of each parameter that a slider sets; an input is its first coefficient."""
    inputs, ranges = {f"{name}_0": name for name in interface.inputs}, model.page.get("ranges", {})
    unchanged = {interface.energy_parameter, *input_parameters(interface.inputs), *interface.mode_names} - inputs.keys()
    sliders: list[dict[str, Any]] = []
    for index, (name, value) in enumerate(_values(model, interface).items()):
        if name in unchanged:
            continue
        size, shown = abs(value) or 1.0, inputs.get(name, name)
        low, high = -3 * size, 3 * size if value or name in inputs else size
        if value > 0 and name not in inputs:
            low = size / 20
        low, high = ranges.get(shown, (low, high))
        slider = {"name": shown, "value": value, "low": low, "high": high, "place": index}
        sliders.append(slider | {"input": True} if name in inputs else slider)
    return sliders


def _step_slider(model: Model) -> dict[str, Any]:
    """Return label, value and range of the slider of the step size, or of the tolerance of adaptive steps."""
    if model.h is None:
        return {"label": "Tolerance", "value": model.tolerance, "low": 1e-15, "high": 1e-4}
    step, label = float(model.h), "Step size in tau" if model.has_time_transformation else "Step size"
    return {"label": label, "value": step, "low": step / 20, "high": step * 8}


def _rotations(interface: Interface) -> list[dict[str, Any]]:
    """Return the columns and the names of the angular velocity of each rotation, and the columns of each spin."""
    return [
        {
            "name": member.name,
            "columns": [interface.coordinates.index(name) for name in member.coordinates],
            "rates": [rate.name for rate in member.rates] if isinstance(member, Rotation) else [],
        }
        for member in RotationNames.members_of(interface.rotations)
        if not member.declaration.startswith("direction")
    ]


def _variables(interface: Interface, shape: Mapping[str, Any], size: int) -> list[str]:
    """Return the names of the variables of plots, as in ``plots.js``."""
    if size <= WHOLE and interface.coordinates:
        solids = [f"{solid['name']}.{axis}" for solid in shape["solids"] for axis in "xyz"]
        names = [*interface.coordinates, *interface.momentum_names, *solids]
    else:
        nodes = range(size) if size <= WHOLE else (size // 4, size // 2)
        names = [f"{kind}.{node}" for node in nodes for kind in "qp"]
    return ["t", *names, "energy", *interface.map_names]


def _variable(name: str, variables: Sequence[str]) -> str:
    """Return the name of a variable of plots, if it is known."""
    if name not in variables:
        raise StateError(
            f"page plots: unknown variable {name!r}{closest(name, variables)} Known: {', '.join(variables)}"
        )
    return name
