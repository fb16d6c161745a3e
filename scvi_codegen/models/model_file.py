'''Model files: one TOML file holds a system, a method, an initial state and the length of a run.

    [system]
    name = "planar pendulum"
    coordinates = ["q"]
    lagrangian = "m*l**2*q_dot**2/2 + m*g*l*cos(q)"     # several lines between """ and """

    [parameters]                                        # default values; the section may be left out
    m = 1.0
    l = 1.0
    g = 9.81

    [initial]
    q = [2.0]                                           # or by name: a table [initial.q] with a line theta = 2.0
    q_dot = [0.0]                                       # velocities, or p = [...] for momenta, not both
    t = 0.0                                             # left out: 0

    [method]
    method = "svi"                                      # then its arguments: degree, quadrature, nodes, ...
    degree = 8

    [run]
    step = 0.5                                          # negative: backward
    span = 100.0                                        # length of time, or steps = 200
    every = 1                                           # distance between kept states; left out: 1

A Hamiltonian stands in ``[system]`` as ``hamiltonian = "p**2/2 - cos(q)"``, with ``momenta = ["p"]`` or
the names ``p_q``.

``[system]`` may also be ``catalogue = "kepler"`` alone; then ``[parameters]`` changes default values, and each of
``[initial]``, ``[method]``, ``[run]`` that is left out is the catalogue's. Files are written complete in themselves.
'''

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import ModelFileError, ScviCodegenError, closest
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.files.toml_text import read_toml
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods import ARGUMENTS, Method, method_from_specification
from scvi_codegen.models.model import Model, check_length, real
from scvi_codegen.models.problems import Problem, problem

__all__ = ["dump_model", "load_model", "parse_model", "save_model"]

Built = TypeVar("Built")
Section = Mapping[str, Any]

SYSTEM_KEYS = ("name", "coordinates", "momenta", "lagrangian", "hamiltonian", "catalogue")
SECTIONS = ("system", "parameters", "initial", "method", "run")
SHORT_VECTOR = 4
TEXT_WIDTH = 100


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model file.

    Raises:
        ModelFileError: beginning with the path and naming the key at fault.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ModelFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ModelFileError(f"{path} is not a text file in UTF-8: {error.reason} at byte {error.start}") from error
    try:
        return parse_model(text)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error


def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write a model file, whole or not at all; reading it gives an equal model.

    Raises:
        ModelFileError: if the model has no exact text (a quadrature or tableau of the user's own).
    """
    text = dump_model(model)
    write_atomically(path, lambda file: file.write(text.encode()))


def parse_model(text: str) -> Model:
    """The model described by TOML text; see the module's docstring. Raises as :func:`load_model`."""
    document = read_toml(text)
    _check_keys(document, SECTIONS, "section")
    for name, content in document.items():
        if not isinstance(content, dict):
            raise ModelFileError(f"'{name}' must be a section, [{name}], not {content!r}")
    return _read_model(document)


def dump_model(model: Model) -> str:
    """TOML text that :func:`parse_model` reads back as an equal model. Raises as :func:`save_model`."""
    import tomli_w  # here, because reading does not need it

    text = tomli_w.dumps(_document(model), multiline_strings=True)
    again = parse_model(text)
    if again != model:
        part = "method" if again.method != model.method else "system" if again.system != model.system else "state"
        raise ModelFileError(
            f"the {part} of this model does not survive in a file: quadratures, nodes and tableaux must be found by "
            "their names, and abscissae be binary64 numbers"
        )
    return text


def _document(model: Model) -> dict[str, Any]:
    system = model.system
    names = [coordinate.name for coordinate in system.coordinates]
    kind = "hamiltonian" if system.auxiliaries else "lagrangian"
    momenta = {"momenta": [p.name for p in system.auxiliaries]} if system.auxiliaries else {}
    document: dict[str, Any] = {
        "system": {"name": system.name, "coordinates": names, **momenta, kind: _wrapped(system.to_text())}
    }
    if system.parameters:
        values = zip(system.parameters, system.defaults, strict=True)
        document["parameters"] = {parameter.name: value for parameter, value in values}
    vectors = (("q", model.q), ("p", model.p), ("q_dot", model.velocity))
    initial = {key: _named(names, vector) for key, vector in vectors if vector is not None}
    specification = model.method.specification()
    method = {key: list(value) if isinstance(value, tuple) else value for key, value in specification.items()}
    length = {"steps": model.steps} if model.span is None else {"span": model.span}
    run = {"step": model.h, **length, "every": model.every}
    return {**document, "initial": {"t": model.t, **initial}, "method": method, "run": run}


def _wrapped(formula: str) -> str:
    """A formula, on several lines if it is long."""
    lines = textwrap.wrap(formula, TEXT_WIDTH, break_long_words=False, break_on_hyphens=False)
    return lines[0] if len(lines) == 1 else "\n".join(["", *lines, ""])


def _named(names: Sequence[str], vector: Sequence[float]) -> list[float] | dict[str, float]:
    """A short vector as a list, a long one by name."""
    return list(vector) if len(vector) <= SHORT_VECTOR else dict(zip(names, vector, strict=True))


def _read_model(document: Mapping[str, Section]) -> Model:
    section = _section(document, "system")
    entry = _read_catalogue(section)
    default = Model.from_problem(entry) if entry else None
    system = _read_system(section, document.get("parameters", {}), entry)
    state = _read_state(document, system, default)
    method = default.method if default and "method" not in document else _read_method(_section(document, "method"))
    run = _read_run(document, default)
    return Model(system=system, method=method, **state, **run)


def _read_catalogue(section: Section) -> Problem | None:
    if "catalogue" not in section:
        return None
    _check_keys(section, ("catalogue",), "key", "[system] beside catalogue")
    name = _text(section, "catalogue", "[system]")
    return _in_section("[system]", lambda: problem(name))


def _read_system(section: Section, parameters: Section, entry: Problem | None) -> MechanicalSystem:
    values = {key: real(value, f"[parameters] {key}") for key, value in parameters.items()}
    if entry is not None:
        return _in_section("[parameters]", lambda: entry.system.with_parameters(**values))
    _check_keys(section, SYSTEM_KEYS, "key", "[system]")
    if ("lagrangian" in section) == ("hamiltonian" in section):
        found = "both" if "lagrangian" in section else "neither"
        raise ModelFileError(f"[system] has {found} of lagrangian and hamiltonian: give one of them")
    name, coordinates = _text(section, "name", "[system]"), _names(section, "coordinates")
    common: dict[str, Any] = {"name": name, "coordinates": coordinates, "parameters": values}
    if "hamiltonian" in section:
        common["hamiltonian"] = _text(section, "hamiltonian", "[system]")
        common["momenta"] = _names(section, "momenta") if "momenta" in section else None
        return _in_section("[system]", lambda: HamiltonianSystem.from_text(**common))
    if "momenta" in section:
        raise ModelFileError("[system] has momenta beside a lagrangian: they are names for a hamiltonian")
    common["lagrangian"] = _text(section, "lagrangian", "[system]")
    return _in_section("[system]", lambda: LagrangianSystem.from_text(**common))


def _names(section: Section, key: str) -> list[str]:
    names = _required(section, key, "[system]")
    if not isinstance(names, list) or not all(isinstance(item, str) for item in names):
        raise ModelFileError(f"[system] {key} must be a list of names, not {names!r}")
    return names


def _read_state(document: Mapping[str, Section], system: MechanicalSystem, default: Model | None) -> dict[str, Any]:
    if default and "initial" not in document:
        return {"q": default.q, "p": default.p, "velocity": default.velocity}
    section = _section(document, "initial")
    _check_keys(section, ("q", "p", "q_dot", "t"), "key", "[initial]")
    if ("p" in section) == ("q_dot" in section):
        found = "both" if "p" in section else "neither"
        raise ModelFileError(f"[initial] has {found} of p and q_dot: give momenta p or velocities q_dot")
    names = [coordinate.name for coordinate in system.coordinates]
    _required(section, "q", "[initial]")
    keys = {"q": "q", "p": "p", "q_dot": "velocity"}
    vectors = {field: _read_vector(section[key], names, key) for key, field in keys.items() if key in section}
    return {**vectors, "t": real(section.get("t", 0.0), "[initial] t")}


def _read_vector(value: Any, names: Sequence[str], key: str) -> tuple[float, ...]:
    where = f"[initial] {key}"
    if isinstance(value, dict):
        _check_keys(value, names, "coordinate", where)
        value = [_required(value, name, where) for name in names]
    if not isinstance(value, list):
        raise ModelFileError(f"{where} must be a list of numbers or a table by coordinate, not {value!r}")
    check_length(value, names, where)
    return tuple(real(item, f"{where}, {name},") for name, item in zip(names, value, strict=True))


def _read_method(section: Section) -> Method:
    name = _text(section, "method", "[method]")
    if name in ARGUMENTS:
        _check_keys(section, ("method", *ARGUMENTS[name]), "key", f"[method] for {name}")
    if not isinstance(section.get("variational", True), bool):
        raise ModelFileError(f"[method] variational must be true or false, not {section['variational']!r}")
    if not isinstance(section.get("abscissae", []), list | str):
        raise ModelFileError(f"[method] abscissae must be a list of numbers or a name, not {section['abscissae']!r}")
    return _in_section("[method]", lambda: method_from_specification(section))


def _read_run(document: Mapping[str, Section], default: Model | None) -> dict[str, Any]:
    if default and "run" not in document:
        return {"h": default.h, "span": default.span}
    section = _section(document, "run")
    _check_keys(section, ("step", "span", "steps", "every"), "key", "[run]")
    if ("span" in section) == ("steps" in section):
        found = "both" if "span" in section else "neither"
        raise ModelFileError(f"[run] has {found} of span and steps: give a length of time or a number of steps")
    step = real(_required(section, "step", "[run]"), "[run] step")
    every = checked_count(section.get("every", 1), "[run] every", least=1, error=ModelFileError)
    if "span" in section:
        return {"h": step, "span": real(section["span"], "[run] span"), "every": every}
    steps = checked_count(section["steps"], "[run] steps", least=0, error=ModelFileError)
    return {"h": step, "steps": steps, "every": every}


def _section(document: Mapping[str, Section], name: str) -> Section:
    if name not in document:
        raise ModelFileError(f"the section [{name}] is missing")
    return document[name]


def _required(section: Section, key: str, where: str) -> Any:
    if key not in section:
        raise ModelFileError(f"{where} lacks '{key}'")
    return section[key]


def _text(section: Section, key: str, where: str) -> str:
    value = _required(section, key, where)
    if not isinstance(value, str):
        raise ModelFileError(f"{where} {key} must be text between quotes, not {value!r}")
    return value


def _check_keys(section: Section, known: Iterable[str], what: str, where: str = "the file") -> None:
    names = list(known)
    for key in section:
        if key not in names:
            raise ModelFileError(f"unknown {what} '{key}' in {where}{closest(key, names)} Known: {', '.join(names)}")


def _in_section(where: str, build: Callable[[], Built]) -> Built:
    try:
        return build()
    except (ScviCodegenError, TypeError) as error:
        raise ModelFileError(f"{where}: {error}") from error
