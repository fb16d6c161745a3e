'''Model files: a TOML file with a system, a method, an initial state and a time span.

    [system]
    name = "planar pendulum"
    coordinates = ["q"]
    lagrangian = "m*l**2*q_dot**2/2 + m*g*l*cos(q)"     # several lines between """ and """
    # time_transformation = "1/(1 + sin(q)**2)"         # dt/dtau, or a name of one: the step size is then in tau,
                                                        # the span in time; default: adaptive steps

    dissipation = "c*q_dot**2/2"                        # Rayleigh's function: forces -dD/dq_dot; default: 0
    # damping = "gamma"                                 # damping rate of all momenta, or a number; default: 0
    # constraints = ["x**2 + y**2 = l**2"]              # g(q, t) = 0, or equations
    # inputs = ["u"]                                    # functions of time given as data

    [forces]                                            # on coordinates; default: 0
    q = "F*cos(w*t)"

    [inputs]                                            # of the inputs named above; see models/input_files.py
    # u = { file = "u.csv", kind = "cubic" }            # relative to this file; or constant, linear (default)
    # w = { t = [0.0, 1.0, 2.0], values = [0.0, 0.5, 0.0] }

    [parameters]                                        # default values; the section is optional
    m = 1.0
    l = 1.0
    g = 9.81
    c = 0.1
    F = 0.5
    w = 2.0

    [initial]
    q = [2.0]                                           # or by name: a table [initial.q] with a line theta = 2.0
    q_dot = [0.0]                                       # velocities, or p = [...] for momenta, not both
    t = 0.0                                             # default: 0

    [method]                                            # default: SVI(8); with constraints SVI(6)
    method = "svi"                                      # then its arguments: degree, quadrature, nodes, ...
    degree = 8

    [run]
    step = 0.5                                          # negative: backward in time
    span = 100.0                                        # time span, or steps = 200
                                                        # or tolerance = 1e-9 for adaptive steps (without both:
                                                        # errors at round-off level); then negative spans go backward
    # controller = "reversible"                         # g controls steps in physical time, by the step density
    save_every = 1                                      # stride of saved states; default: 1

A Hamiltonian is given in ``[system]`` as ``hamiltonian = "p**2/2 - cos(q)"``, with ``momenta = ["p"]`` or
the names ``p_q``; with constraints the model is that of its Lagrangian.

``[system]`` may also be ``catalogue = "kepler"`` alone; then ``[parameters]`` changes default values, and missing
entries of ``[initial]`` and ``[run]`` are the catalogue's. Written files are complete.

Arrays whose sizes are numbers, ``coordinates = ["x", "q[3]"]``, have values by entry or by name,
``q = { x = 0.0, q = [1, 2, 3] }`` and ``"m[3]" = [1, 1, 2]``. Arrays whose sizes are names, ``["q[N]"]``, are those of
:mod:`scvi_codegen.models.array_file`.

Further sections, such as command-line options, can be merged over those of a file: they add and replace entries.
'''

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from scvi_codegen.errors import ModelFileError, SystemDefinitionWarning
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.files.toml_text import read_toml
from scvi_codegen.indices import Array
from scvi_codegen.mechanics.definition_checks import warn_of_mistakes
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.legendre import lagrangian_of
from scvi_codegen.mechanics.reparametrisation import with_time_transformation
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.mechanics.time_rescaling import time_rescaling_function
from scvi_codegen.methods import fitted
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_document import document_of, motion_of
from scvi_codegen.models.problems import Problem, problem
from scvi_codegen.models.sections import (
    ALTERNATIVES,
    Document,
    Section,
    check_keys,
    check_one,
    chosen_method,
    formula_of,
    in_section,
    merged_sections,
    names_of,
    read_method,
    read_run,
    required,
    text_of,
)
from scvi_codegen.models.time_span import check_length, real
from scvi_codegen.validation.argument_types import PATH, checks_arguments, of

if TYPE_CHECKING:
    from scvi_codegen.models.array_model import ArrayModel
    from scvi_codegen.models.input_tables import InputTable

__all__ = [
    "catalogue_model",
    "dump_model",
    "load_model",
    "parse_model",
    "read_model_file",
    "save_model",
]

FORMULAS = ("lagrangian", "hamiltonian", "dissipation", "damping", "constraints")
SYSTEM_KEYS = ("name", "coordinates", "momenta", *FORMULAS, "inputs", "catalogue", "time_transformation")
RUN_KEYS = ("step", "tolerance", "error", "controller", "span", "steps", "save_every")
KEYS = {"system": SYSTEM_KEYS, "initial": ("q", "p", "q_dot", "t"), "run": RUN_KEYS}
SECTIONS = ("system", "forces", "inputs", "parameters", "initial", "method", "run")
ARRAY_SECTIONS = ("sizes", "tables")
"""Additional sections of array systems."""
NEEDED = {"system": ("name", "coordinates", "lagrangian"), "initial": ("q", "q_dot"), "run": ("span",)}
"""Required keys, or their alternatives."""


@checks_arguments(path=PATH)
def load_model(path: str | os.PathLike[str], given: Document | None = None) -> Model:
    """Read a model file, with the sections ``given`` merged over its own.

    A system with arrays whose sizes are names, ``coordinates = ["q[N]"]``, makes it an :class:`ArrayModel`.

    Raises:
        ModelFileError: beginning with the path and naming the key at fault.
    """
    return cast(Model, read_model_file(path, given))


def read_model_file(path: str | os.PathLike[str], changes: Document | None = None) -> Model | ArrayModel:
    """Read a model of either kind. Raises as :func:`load_model`."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ModelFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ModelFileError(f"{path} is not a text file in UTF-8: {error.reason} at byte {error.start}") from error
    try:
        return _parsed(text, changes, folder=Path(path).parent)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error


@checks_arguments(model=of("a Model", Model), path=PATH)
def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write a model file atomically; reading it returns an equal model.

    Raises:
        ModelFileError: if the model cannot be represented exactly (a user-defined quadrature or tableau).
    """
    text = dump_model(model)
    write_atomically(path, lambda file: file.write(text.encode()))


def catalogue_model(name: str, changes: Document | None = None) -> Model:
    """Return a catalogue entry with the sections ``changes`` merged over it. Raises as :func:`load_model`."""
    return _read_model({"system": {"catalogue": name}}, changes or {})


def parse_model(text: str, changes: Document | None = None, *, folder: str | os.PathLike[str] = ".") -> Model:
    """Return the model of TOML text; see the module's docstring. Raises as :func:`load_model`.

    Args:
        text: of the file.
        changes: sections merged over it.
        folder: base of relative paths.
    """
    return cast(Model, _parsed(text, changes, folder))


def _parsed(text: str, changes: Document | None, folder: str | os.PathLike[str]) -> Model | ArrayModel:
    document = read_toml(text)
    check_keys(document, (*SECTIONS, *ARRAY_SECTIONS), "section")
    for name, content in document.items():
        if not isinstance(content, dict):
            raise ModelFileError(f"'{name}' must be a section, [{name}], not {content!r}")
    if _has_arrays(document):
        from scvi_codegen.models.array_file import (
            read_array_model,  # imported here: other models are read without NumPy
        )

        return read_array_model(document, changes or {}, folder)
    for name in ARRAY_SECTIONS:
        if name in document:
            raise ModelFileError(f'[{name}] belongs to arrays whose sizes are names, coordinates = ["q[N]"]')
    for name, known in KEYS.items():
        check_keys(document.get(name, {}), known, "key", f"[{name}]")
    return _read_model(document, changes or {}, folder)


def _has_arrays(document: Document) -> bool:
    """Return whether coordinates are arrays whose sizes are names, ``q[N]``."""
    coordinates = document.get("system", {}).get("coordinates", ())
    return isinstance(coordinates, list) and any(
        isinstance(name, str) and re.search(r"\[.*[A-Za-z_]", name) for name in coordinates
    )


def dump_model(model: Model) -> str:
    """Return TOML text that :func:`parse_model` converts to an equal model. Raises as :func:`save_model`."""
    import tomli_w  # imported here: not needed for reading

    text = tomli_w.dumps(document_of(model), multiline_strings=True)
    again = parse_model(text)
    if again != model:
        part = "method" if again.method != model.method else "system" if again.system != model.system else "state"
        raise ModelFileError(
            f"the {part} of this model cannot be represented in a file: quadratures, nodes and "
            "tableaux must be built-in ones with a name, and abscissae binary64 numbers"
        )
    return text


def _read_model(document: Document, changes: Document, folder: str | os.PathLike[str] = ".") -> Model:
    entry = _read_catalogue(document.get("system", {}))
    if changes.get("sizes"):
        raise ModelFileError('[sizes] belongs to coordinates that are arrays, coordinates = ["q[N]"]')
    if "time_transformation" in changes.get("system", {}) and "error" in document.get("run", {}):
        _check_error_bound(document["run"]["error"], changes.get("run", {}))
    document, changes = _without_inherited_step(document), _without_inherited_step(changes)
    if entry is not None:
        names = [coordinate.name for coordinate in entry.system.coordinates]
        document = merged_sections(motion_of(Model.from_problem(entry), names), document)
    chosen = chosen_method(document, changes)
    document = {**merged_sections(document, changes), "method": chosen}
    if entry is None:
        _check_complete(document)
        _check_used(document, changes.get("parameters", {}))
    with warnings.catch_warnings():  # other formulas than that of the system may use its parameters
        warnings.simplefilter("ignore", SystemDefinitionWarning)
        plain = _with_arrays(_read_system(document, entry), document.get("parameters", {}))
    system, g = _read_time_transformation(plain, document)
    warn_of_mistakes(system, () if g is None else (time_rescaling_function(system, g, in_time=True),))
    state = _read_state(document["initial"], system)
    method = read_method(fitted(document["method"], system))
    inputs = _read_inputs(document.get("inputs", {}), folder)
    run = read_run(document["run"])
    return Model(system=system, method=method, time_transformation=g, inputs=inputs, **state, **run)


def _without_inherited_step(layer: Document) -> Document:
    """Drop an inherited step size, one in t, if a time transformation is added without a step size in tau."""
    run = layer.get("run", {})
    if "time_transformation" not in layer.get("system", {}) or {"step", "tolerance", "error"} & run.keys():
        return layer
    return {**layer, "run": {**run, "tolerance": None}}


def _check_error_bound(error: Any, run: Section) -> None:
    """Raise an error for a time transformation added to a model with ``error``, unless that is replaced."""
    if not {"step", "tolerance"} & run.keys():
        raise ModelFileError(
            f"[run] error = {error} requires adaptive steps, but a time transformation has fixed steps in tau: "
            "give --tolerance or --step with --time-transformation"
        )


def _check_complete(document: Document) -> None:
    """Raise an error that lists all missing keys."""
    missing = []
    for name, keys in NEEDED.items():
        for key in keys:
            choice = next((choice for choice in ALTERNATIVES if key in choice), {key})
            if choice.isdisjoint(document.get(name, {})):
                missing.append(f"{' or '.join(sorted(choice))} in [{name}]")
    if missing:
        rest = (
            "; for a start from rest write q_dot = [0.0, ..], or --velocity 0,.."
            if "p or q_dot in [initial]" in missing
            else ""
        )
        raise ModelFileError(f"there is no {', no '.join(missing)}{rest}")


def _check_used(document: Document, parameters: Section) -> None:
    """Raise an error for an added parameter that no formula contains."""
    section = document["system"]
    formulas = [section.get(key, "") for key in (*FORMULAS, "time_transformation")]
    formula = " ".join(map(str, (*formulas, *document.get("forces", {}).values())))
    for name in parameters:
        if name not in re.findall(r"\w+", formula):
            raise ModelFileError(f"the system has no parameter '{name}'")


def _read_catalogue(section: Section) -> Problem | None:
    if "catalogue" not in section:
        return None
    check_keys(section, ("catalogue", "time_transformation"), "key", "[system] beside catalogue")
    name = text_of(section, "catalogue", "[system]")
    return in_section("[system]", lambda: problem(name))


def _read_system(document: Document, entry: Problem | None) -> MechanicalSystem:
    section, forces = document["system"], document.get("forces", {})
    section_values = document.get("parameters", {})
    firsts = {key: (_flat(value) or [value])[0] if "[" in key else value for key, value in section_values.items()}
    values = {key: real(value, f"[parameters] {key}") for key, value in firsts.items()}
    if entry is not None:
        if forces:
            raise ModelFileError(
                "[forces] are not supported for a system of the catalogue: write the system out in [system]"
            )
        return in_section("[parameters]", lambda: entry.system.with_parameters(**values))
    check_one(section, "system", "lagrangian", "hamiltonian")
    name, coordinates = text_of(section, "name", "[system]"), names_of(section, "coordinates")
    common: dict[str, Any] = {"name": name, "coordinates": coordinates, "parameters": values}
    common["forces"] = {key: formula_of(forces, key, "[forces]") for key in forces}
    common["damping"] = formula_of(section, "damping", "[system]") if "damping" in section else None
    common["inputs"] = names_of(section, "inputs") if "inputs" in section else ()
    if "hamiltonian" in section:
        constraints = names_of(section, "constraints") if "constraints" in section else ()
        if "dissipation" in section:
            raise ModelFileError(
                "[system] has a dissipation, in velocities, and a hamiltonian: write the forces in [forces] instead"
            )
        common["hamiltonian"] = text_of(section, "hamiltonian", "[system]")
        common["momenta"] = names_of(section, "momenta") if "momenta" in section else None
        hamiltonian = in_section("[system]", lambda: HamiltonianSystem.from_text(**common))
        return (
            in_section("[system]", lambda: lagrangian_of(hamiltonian, constraints=constraints))
            if constraints
            else hamiltonian
        )
    if "momenta" in section:
        raise ModelFileError(
            "[system] has momenta and a lagrangian: momenta are names for a hamiltonian; leave them out"
        )
    common["lagrangian"] = text_of(section, "lagrangian", "[system]")
    common["dissipation"] = text_of(section, "dissipation", "[system]") if "dissipation" in section else None
    common["constraints"] = names_of(section, "constraints") if "constraints" in section else ()
    return in_section("[system]", lambda: LagrangianSystem.from_text(**common))


def _with_arrays(system: MechanicalSystem, parameters: Section) -> MechanicalSystem:
    """Return the system with the entries of arrays of parameters that are lists, ``"m[3]" = [1, 2, 3]``."""
    arrays = {array.name: array for array in system.arrays}
    values: dict[str, float] = {}
    for key, value in parameters.items():
        if isinstance(value, list):
            entries, numbers = arrays[key.partition("[")[0]].elements, _flat(value)
            check_length(numbers, entries, f"[parameters] {key}")
            values |= {name: real(each, f"[parameters] {key}") for name, each in zip(entries, numbers, strict=True)}
    return system.with_parameters(**values) if values else system


def _flat(value: Any) -> list[Any]:
    """Return the entries of nested lists in order."""
    return [entry for each in value for entry in _flat(each)] if isinstance(value, list) else [value]


def _read_time_transformation(system: MechanicalSystem, document: Document) -> tuple[MechanicalSystem, Any]:
    g, controller = document["system"].get("time_transformation"), document["run"].get("controller")
    return in_section("[system] time_transformation", lambda: with_time_transformation(system, g, controller))


def _read_state(section: Section, system: MechanicalSystem) -> dict[str, Any]:
    check_one(section, "initial", "p", "q_dot")
    names = [coordinate.name for coordinate in system.coordinates]
    keys = {"q": "q", "p": "p", "q_dot": "velocity"}
    arrays = [array for array in system.arrays if set(array.elements) <= set(names)]
    vectors = {field: _read_vector(section[key], names, key, arrays) for key, field in keys.items() if key in section}
    return {**vectors, "t": real(section.get("t", 0.0), "[initial] t")}


def _read_vector(value: Any, names: Sequence[str], key: str, arrays: Sequence[Array]) -> tuple[float, ...]:
    where = f"[initial] {key}"
    if isinstance(value, dict):
        for array in arrays:
            if array.name in value and array.axes:
                entries = _flat(value[array.name])
                entries = entries * len(array.elements) if len(entries) == 1 else entries
                check_length(entries, array.elements, f"{where}, {array.name}")
                others = {name: each for name, each in value.items() if name != array.name}
                value = others | dict(zip(array.elements, entries, strict=True))
        check_keys(value, names, "coordinate", where)
        value = [required(value, name, where) for name in names]
    if not isinstance(value, list):
        raise ModelFileError(f"{where} must be a list of numbers or a table by coordinate, not {value!r}")
    check_length(value, names, where)
    return tuple(real(item, f"{where}, {name},") for name, item in zip(names, value, strict=True))


def _read_inputs(section: Section, folder: str | os.PathLike[str]) -> dict[str, InputTable]:
    if not section:
        return {}
    from scvi_codegen.models.input_files import read_input  # imported here: other models are read without NumPy

    return {name: read_input(name, entry, folder) for name, entry in section.items()}
