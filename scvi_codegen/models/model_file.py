'''Model files: one TOML file holds a system, a method, an initial state and the length of a run.

    [system]
    name = "planar pendulum"
    coordinates = ["q"]
    lagrangian = "m*l**2*q_dot**2/2 + m*g*l*cos(q)"     # several lines between """ and """
    # monitor = "1/(1 + sin(q)**2)"                     # dt/dtau, or a name: steps are then of tau, the span is of
                                                        # time; without a step tolerance = 0

    dissipation = "c*q_dot**2/2"                        # Rayleigh's function: forces -dD/dq_dot; left out: 0
    # constraints = ["x**2 + y**2 = l**2"]              # g(q, t) = 0, or equations
    # inputs = ["u"]                                    # functions of time that are data

    [forces]                                            # on coordinates; left out: 0
    q = "F*cos(w*t)"

    [inputs]                                            # of the inputs named above; see models/input_files.py
    # u = { file = "u.csv", kind = "cubic" }            # beside this file; or constant, linear (left out: that)
    # w = { t = [0.0, 1.0, 2.0], values = [0.0, 0.5, 0.0] }

    [parameters]                                        # default values; the section may be left out
    m = 1.0
    l = 1.0
    g = 9.81
    c = 0.1
    F = 0.5
    w = 2.0

    [initial]
    q = [2.0]                                           # or by name: a table [initial.q] with a line theta = 2.0
    q_dot = [0.0]                                       # velocities, or p = [...] for momenta, not both
    t = 0.0                                             # left out: 0

    [method]                                            # left out: SVI(8); with constraints SVI(6)
    method = "svi"                                      # then its arguments: degree, quadrature, nodes, ...
    degree = 8

    [run]
    step = 0.5                                          # negative: backward
    span = 100.0                                        # length of time, or steps = 200
                                                        # or tolerance = 1e-9 (0, and without both: round-off): steps
                                                        # choose their length; then a negative span goes back
    # controller = "reversible"                         # of a monitor: time as it is, steps whose density it carries
    every = 1                                           # distance between kept states; left out: 1

A Hamiltonian stands in ``[system]`` as ``hamiltonian = "p**2/2 - cos(q)"``, with ``momenta = ["p"]`` or
the names ``p_q``.

``[system]`` may also be ``catalogue = "kepler"`` alone; then ``[parameters]`` changes default values, and what
``[initial]`` and ``[run]`` leave out is the catalogue's. Files are written complete in themselves.

Sections may be laid over those of a file, as the options of a command line are: they supply what it lacks and replace
what it says.
'''

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import ModelFileError, ScviCodegenError, closest
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.files.toml_text import read_toml
from scvi_codegen.kinds import PATH, of, takes
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.reparametrisation import with_monitor
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods import ARGUMENTS, Method, fitted, method_from_specification, sized, specification_of
from scvi_codegen.models.model import DEFAULT_METHOD, Model, check_length, real
from scvi_codegen.models.model_document import document_of, motion_of
from scvi_codegen.models.problems import Problem, problem

if TYPE_CHECKING:
    from scvi_codegen.models.input_tables import InputTable

__all__ = ["catalogue_model", "dump_model", "load_model", "parse_model", "save_model"]

Built = TypeVar("Built")
Section = Mapping[str, Any]
Document = Mapping[str, Section]

FORMULAS = ("lagrangian", "hamiltonian", "dissipation", "constraints")
SYSTEM_KEYS = ("name", "coordinates", "momenta", *FORMULAS, "inputs", "catalogue", "monitor")
RUN_KEYS = ("step", "tolerance", "controller", "span", "steps", "every")
KEYS = {"system": SYSTEM_KEYS, "initial": ("q", "p", "q_dot", "t"), "run": RUN_KEYS}
SECTIONS = ("system", "forces", "inputs", "parameters", "initial", "method", "run")
ALTERNATIVES = ({"lagrangian", "hamiltonian"}, {"p", "q_dot"}, {"step", "tolerance"}, {"span", "steps"})
"""One of each is given."""
NEEDED = {"system": ("name", "coordinates", "lagrangian"), "initial": ("q", "q_dot"), "run": ("span",)}
"""Keys, or their alternatives, without which there is nothing to run."""
INHERITED = ("degree", "quadrature", "nodes", "stages")
"""Arguments that a method laid over another takes from it, if it has them."""


@takes(path=PATH)
def load_model(path: str | os.PathLike[str], given: Document | None = None) -> Model:
    """Read a model file, with the sections ``given`` laid over its own.

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
        return parse_model(text, given, folder=Path(path).parent)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error


@takes(model=of("a Model", Model), path=PATH)
def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write a model file, whole or not at all; reading it gives an equal model.

    Raises:
        ModelFileError: if the model has no exact text (a quadrature or tableau of the user's own).
    """
    text = dump_model(model)
    write_atomically(path, lambda file: file.write(text.encode()))


def catalogue_model(name: str, given: Document | None = None) -> Model:
    """An entry of the catalogue, with the sections ``given`` laid over it. Raises as :func:`load_model`."""
    return _read_model({"system": {"catalogue": name}}, given or {})


def parse_model(text: str, given: Document | None = None, *, folder: str | os.PathLike[str] = ".") -> Model:
    """The model described by TOML text; see the module's docstring. Raises as :func:`load_model`.

    Args:
        text: of the file.
        given: sections laid over it.
        folder: where the tables of inputs are.
    """
    document = read_toml(text)
    _check_keys(document, SECTIONS, "section")
    for name, content in document.items():
        if not isinstance(content, dict):
            raise ModelFileError(f"'{name}' must be a section, [{name}], not {content!r}")
    for name, known in KEYS.items():
        _check_keys(document.get(name, {}), known, "key", f"[{name}]")
    return _read_model(document, given or {}, folder)


def dump_model(model: Model) -> str:
    """TOML text that :func:`parse_model` reads back as an equal model. Raises as :func:`save_model`."""
    import tomli_w  # here, because reading does not need it

    text = tomli_w.dumps(document_of(model), multiline_strings=True)
    again = parse_model(text)
    if again != model:
        part = "method" if again.method != model.method else "system" if again.system != model.system else "state"
        raise ModelFileError(
            f"the {part} of this model does not survive in a file: quadratures, nodes and tableaux must be found by "
            "their names, and abscissae be binary64 numbers"
        )
    return text


def _read_model(document: Document, given: Document, folder: str | os.PathLike[str] = ".") -> Model:
    entry = _read_catalogue(document.get("system", {}))
    document, given = _with_own_step(document), _with_own_step(given)
    if entry is not None:
        names = [coordinate.name for coordinate in entry.system.coordinates]
        document = _laid_over(motion_of(Model.from_problem(entry), names), document)
    chosen = _chosen_method(document, given)
    document = {**_laid_over(document, given), "method": chosen}
    if entry is None:
        _check_complete(document)
        _check_used(document, given.get("parameters", {}))
    system, monitor = _read_monitor(_read_system(document, entry), document)
    state = _read_state(document["initial"], system)
    method = _read_method(fitted(document["method"], system))
    inputs = _read_inputs(document.get("inputs", {}), folder)
    return Model(system=system, method=method, monitor=monitor, inputs=inputs, **state, **_read_run(document["run"]))


def _chosen_method(document: Document, given: Document) -> Section:
    """The method of a file, or the default one, with what is laid over it."""
    default: Section = DEFAULT_METHOD.specification()
    if document.get("system", {}).get("constraints"):
        default = {"method": "svi", "degree": 6}
    base = _spelt_out(document.get("method", default))
    return _changed_method(base, _spelt_out(given.get("method", {})))


def _with_own_step(layer: Document) -> Document:
    """Where time is transformed a step given for another time is of no use: one is chosen unless it is said with it."""
    run = layer.get("run", {})
    if "monitor" not in layer.get("system", {}) or "step" in run or "tolerance" in run:
        return layer
    return {**layer, "run": {**run, "tolerance": 0.0}}


def _laid_over(below: Document, above: Document) -> dict[str, Section]:
    """All sections; what one of them says above replaces what is below, and the alternatives of it."""
    document = dict(below)
    for name, section in above.items():
        replaced = {key for keys in ALTERNATIVES if not keys.isdisjoint(section) for key in keys}
        kept = {} if name == "method" else below.get(name, {})
        document[name] = {key: value for key, value in kept.items() if key not in replaced} | dict(section)
    return document


def _spelt_out(section: Section) -> Section:
    """A method whose name has its degree, ``svi:6``, with both apart."""
    name = section.get("method")
    if not isinstance(name, str) or ":" not in name:
        return section
    spelt = _in_section("[method]", lambda: specification_of(name))
    for key, value in spelt.items():
        if key != "method" and section.get(key, value) != value:
            raise ModelFileError(f"[method] method = {name!r} and {key} = {section[key]!r} contradict each other")
    return {**section, **spelt}


def _changed_method(base: Section, given: Section) -> Section:
    """A method with some arguments changed; another method takes over what it has in common with it."""
    if not given:
        return base
    kept = dict(base)
    if kept.get("quadrature") == f"gauss-legendre:{kept.get('degree')}":
        del kept["quadrature"]  # the default for its degree: another degree has another default
    name = given.get("method", kept.get("method"))
    if name != kept.get("method"):
        accepted = ARGUMENTS.get(name, ())
        kept = {key: value for key, value in kept.items() if key in INHERITED and key in accepted}
    if {"abscissae", "space"} & given.keys():
        kept.pop("nodes", None)  # they say in other words where the curve is given
    return sized({**kept, **given}) if "method" in given else {**kept, **given}


def _check_complete(document: Document) -> None:
    """Name all that is missing at once."""
    missing = []
    for name, keys in NEEDED.items():
        for key in keys:
            choice = next((choice for choice in ALTERNATIVES if key in choice), {key})
            if choice.isdisjoint(document.get(name, {})):
                missing.append(f"{' or '.join(sorted(choice))} in [{name}]")
    if missing:
        raise ModelFileError(f"there is no {', no '.join(missing)}")


def _check_used(document: Document, parameters: Section) -> None:
    """Refuse a parameter laid over a system that knows none of that name."""
    section = document["system"]
    formulas = [section.get(key, "") for key in (*FORMULAS, "monitor")]
    formula = " ".join(map(str, (*formulas, *document.get("forces", {}).values())))
    for name in parameters:
        if name not in re.findall(r"\w+", formula):
            raise ModelFileError(f"the system has no parameter '{name}'")


def _read_catalogue(section: Section) -> Problem | None:
    if "catalogue" not in section:
        return None
    _check_keys(section, ("catalogue", "monitor"), "key", "[system] beside catalogue")
    name = _text(section, "catalogue", "[system]")
    return _in_section("[system]", lambda: problem(name))


def _read_system(document: Document, entry: Problem | None) -> MechanicalSystem:
    section, forces = document["system"], document.get("forces", {})
    values = {key: real(value, f"[parameters] {key}") for key, value in document.get("parameters", {}).items()}
    if entry is not None:
        if forces:
            raise ModelFileError("[forces] act on a system that is written out, not on one of the catalogue")
        return _in_section("[parameters]", lambda: entry.system.with_parameters(**values))
    _check_one(section, "system", "lagrangian", "hamiltonian")
    name, coordinates = _text(section, "name", "[system]"), _names(section, "coordinates")
    common: dict[str, Any] = {"name": name, "coordinates": coordinates, "parameters": values}
    common["forces"] = {key: _text(forces, key, "[forces]") for key in forces}
    common["inputs"] = _names(section, "inputs") if "inputs" in section else ()
    if "hamiltonian" in section:
        if "constraints" in section:
            raise ModelFileError("[system] has constraints beside a hamiltonian: they are kept with a lagrangian")
        if "dissipation" in section:
            raise ModelFileError("[system] has a dissipation, in velocities, beside a hamiltonian: write [forces]")
        common["hamiltonian"] = _text(section, "hamiltonian", "[system]")
        common["momenta"] = _names(section, "momenta") if "momenta" in section else None
        return _in_section("[system]", lambda: HamiltonianSystem.from_text(**common))
    if "momenta" in section:
        raise ModelFileError("[system] has momenta beside a lagrangian: they are names for a hamiltonian")
    common["lagrangian"] = _text(section, "lagrangian", "[system]")
    common["dissipation"] = _text(section, "dissipation", "[system]") if "dissipation" in section else None
    common["constraints"] = _names(section, "constraints") if "constraints" in section else ()
    return _in_section("[system]", lambda: LagrangianSystem.from_text(**common))


def _read_monitor(system: MechanicalSystem, document: Document) -> tuple[MechanicalSystem, Any]:
    monitor, controller = document["system"].get("monitor"), document["run"].get("controller")
    return _in_section("[system] monitor", lambda: with_monitor(system, monitor, controller))


def _names(section: Section, key: str) -> list[str]:
    names = _required(section, key, "[system]")
    if not isinstance(names, list) or not all(isinstance(item, str) for item in names):
        raise ModelFileError(f"[system] {key} must be a list of names, not {names!r}")
    return names


def _read_state(section: Section, system: MechanicalSystem) -> dict[str, Any]:
    _check_one(section, "initial", "p", "q_dot")
    names = [coordinate.name for coordinate in system.coordinates]
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


def _read_inputs(section: Section, folder: str | os.PathLike[str]) -> dict[str, InputTable]:
    if not section:
        return {}
    from scvi_codegen.models.input_files import read_input  # here: other models are read without NumPy

    return {name: read_input(name, entry, folder) for name, entry in section.items()}


def _read_method(section: Section) -> Method:
    name = _text(section, "method", "[method]")
    if name in ARGUMENTS:
        _check_keys(section, ("method", *ARGUMENTS[name]), "key", f"[method] for {name}")
    if not isinstance(section.get("variational", True), bool):
        raise ModelFileError(f"[method] variational must be true or false, not {section['variational']!r}")
    if not isinstance(section.get("abscissae", []), list | str):
        raise ModelFileError(f"[method] abscissae must be a list of numbers or a name, not {section['abscissae']!r}")
    return _in_section("[method]", lambda: method_from_specification(section))


def _read_run(section: Section) -> dict[str, Any]:
    _check_one(section, "run", "step", "tolerance")
    _check_one(section, "run", "span", "steps")
    fields = {"step": "h", "tolerance": "tolerance", "span": "span"}
    found: dict[str, Any] = {
        field: real(section[key], f"[run] {key}") for key, field in fields.items() if key in section
    }
    if not {"step", "tolerance"} & section.keys():
        if "steps" in section:
            raise ModelFileError("[run] has steps and no step, which says how long they are")
        found["tolerance"] = 0.0
    if "steps" in section:
        found["steps"] = checked_count(section["steps"], "[run] steps", least=0, error=ModelFileError)
    found["every"] = checked_count(section.get("every", 1), "[run] every", least=1, error=ModelFileError)
    return found


def _check_one(section: Section, name: str, one: str, other: str) -> None:
    if one in section and other in section:
        raise ModelFileError(f"[{name}] has both of {one} and {other}: give one of them")


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
