"""Model files: a TOML file with a system, a method, an initial state and a time span (docs/model_files.md).

Further sections, such as command-line options, can be merged over those of a file: they add and replace entries.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from scvi_codegen.codegen.rendering.source import DOUBLE_DOUBLE
from scvi_codegen.common.atomic import naming_folders, write_text
from scvi_codegen.common.errors import ModelFileError, SystemDefinitionWarning, speaking
from scvi_codegen.common.registry import homes, part
from scvi_codegen.common.toml_text import read_toml
from scvi_codegen.common.validation import ExactNumber, checks_arguments, of
from scvi_codegen.interfaces.models.input_tables import InputTable
from scvi_codegen.interfaces.models.model import DEFAULT_METHOD, Model
from scvi_codegen.interfaces.models.model_files.document import document_of, with_files
from scvi_codegen.interfaces.models.model_files.entries import FORMAT_KEYS, ROBOT_KEYS, Entry, is_robot, read_entry
from scvi_codegen.interfaces.models.model_files.sections import (
    FORMULAS,
    LISTS,
    TORQUES,
    TURNING,
    Document,
    Section,
    check_complete,
    check_keys,
    check_used,
    chosen_method,
    has_arrays,
    in_section,
    merged_sections,
    read_events,
    read_method,
    read_run,
    read_system,
    text_in,
    words_of,
)
from scvi_codegen.interfaces.models.model_files.values import read_values
from scvi_codegen.interfaces.models.options import FURTHER, OF_ADAPTIVE_STEPS, STEP_KEYS, options_of, with_exact_numbers
from scvi_codegen.methods import fitted
from scvi_codegen.methods.controllers import SYMPLECTIC, check_controller, default_controller, with_time_transformation
from scvi_codegen.systems.checks.definition import warn_of_mistakes
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.time_transformation import time_rescaling_function

SYSTEM_KEYS = (
    *("name", "coordinates", *TURNING, "momenta", *FORMULAS, "inputs", "neighbours", "point_forces"),
    *("temperature", "noise"),
    *("catalogue", *ROBOT_KEYS, *chain(*FORMAT_KEYS.values())),
)
KEYS = {"system": SYSTEM_KEYS} | {
    section: tuple(option.key for option in options_of(section)) for section in ("initial", "run", "path", "family")
}
SECTIONS = (
    *("system", "field", "forces", *TORQUES, "functions", "inputs", "sizes", "parameters", "tables", "initial"),
    *("contacts", "events", "method", "run", *FURTHER),
)
ARRAY_SECTIONS = ("sizes", "tables")
"""Sections of systems with arrays."""


@checks_arguments()
def load_model(
    path: str | os.PathLike[str], changes: Document | None = None, *, folders: Iterable[str | os.PathLike[str]] = ()
) -> Model:
    """Read a model file, with the sections ``changes`` merged over its own.

    ``folders``: further ones with files that it may name (arrays, inputs, robots), besides its own.

    Raises:
        ModelFileError: beginning with the path and naming the key at fault.
    """
    if folders := [*folders]:
        with naming_folders(folders):
            return load_model(path, changes)
    text, folder = "" if is_robot(path) else text_in(path), Path(path).parent
    try:
        if is_robot(path):
            return _read_model(document_in(path), changes or {}, folder)
        return parse_model(text, changes, folder=folder)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error
    except MemoryError as error:
        raise ModelFileError(f"{path}: its arrays do not fit in memory: reduce the sizes") from error


def document_in(path: str | os.PathLike[str]) -> Document:
    """Return the sections of a model file or a robot's file."""
    return {"system": {"robot": Path(path).name}} if is_robot(path) else read_toml(text_in(path))


@checks_arguments(model=of("a Model", Model))
def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write a model file atomically; reading it returns an equal model.

    Arrays of more than 1000 numbers are written to CSV files beside it, ``NAME_q.csv``.

    Raises:
        ModelFileError: if the model cannot be represented exactly (a user-defined quadrature or tableau).
    """
    target = Path(path)
    name, *others = (texts := _written(model, target.stem))
    for other in others:
        write_text(target.with_name(other), texts[other])
    write_text(target, texts[name])


def catalogue_model(name: str, changes: Document | None = None) -> Model:
    """Return a catalogue entry with the sections ``changes`` merged over it. Raises as :func:`load_model`."""
    return _read_model({"system": {"catalogue": name}}, changes or {})


def parse_model(text: str, changes: Document | None = None, *, folder: str | os.PathLike[str] = ".") -> Model:
    """Return the model of TOML text, sections ``changes`` merged over it; raises as :func:`load_model`."""
    document = read_toml(text)
    if DOUBLE_DOUBLE in (_precision(document), _precision(changes or {})):
        document = read_toml(text, ExactNumber)
    check_keys(document, SECTIONS, "section")
    for name, content in document.items():
        if not isinstance(content, dict) and name not in LISTS:
            raise ModelFileError(f"'{name}' must be a section, [{name}], not {content!r}")
    initial = document.get("initial", {})
    if "velocity" in initial:
        if "q_dot" in initial:
            raise ModelFileError("[initial] velocity and q_dot are two names of one key: give one of them")
        initial["q_dot"] = initial.pop("velocity")
    for name, content in document.items():
        if name in KEYS or name in homes("sections"):
            check_keys(content, KEYS[name] if name in KEYS else part("sections", name).keys, "key", f"[{name}]")
    return _read_model(document, changes or {}, folder)


def _precision(document: Document) -> Any:
    run = document.get("run")
    return run.get("precision") if isinstance(run, dict) else None


def dump_model(model: Model) -> str:
    """Return TOML text that :func:`parse_model` converts to an equal model. Raises as :func:`save_model`."""
    return next(iter(_written(model, None).values()))


def model_texts(model: Model) -> dict[str, str]:
    """Return the model file and the CSV files of its long arrays, by file name; none if it cannot be represented."""
    with suppress(ModelFileError):
        return _written(model, "model")
    return {}


def _written(model: Model, stem: str | None) -> dict[str, str]:
    """Return the model file, and with a stem of file names the tables of long arrays."""
    import tomli_w  # imported here: not needed for reading

    part = "system"
    for as_arrays in (True,) if model.system.sizes else (True, False):  # a derived system has another form
        document = in_section("[system]", partial(document_of, model, as_arrays=as_arrays))
        shortened, files = (document, {}) if stem is None else with_files(document, stem)
        text = tomli_w.dumps(shortened, multiline_strings=True)
        with warnings.catch_warnings():  # formulas of initial values, which used parameters, are numbers now
            warnings.simplefilter("ignore", SystemDefinitionWarning)
            again = _read_model(document, {}) if files else parse_model(text)
        if again == model:
            return {f"{stem}.toml": text, **files}
        differing = [name for name in ("method", "system") if getattr(again, name) != getattr(model, name)]
        part = next(iter(differing), "state")
    if part == "system" and model.system.drawn_links:
        raise ModelFileError(
            f"the formulas of the robot {model.system.name} cannot be written to a file: write [system] robot = FILE"
        )
    raise ModelFileError(
        f"the {part} of this model cannot be represented in a file: quadratures, nodes and "
        "tableaux must be built-in ones with a name, and abscissae binary64 numbers"
    )


@speaking("file")
def _read_model(document: Document, changes: Document, folder: str | os.PathLike[str] = ".") -> Model:
    entry = read_entry({**document.get("system", {}), **changes.get("system", {})}, folder)
    for name in ARRAY_SECTIONS:
        if (name in document or name in changes) and not has_arrays(document):
            raise ModelFileError(f'[{name}] belongs to coordinates that are arrays, coordinates = ["q[N]"]')
    if "functions" in document and "field" in document:
        raise ModelFileError("[functions] belongs to [system]: densities of fields contain no tables")
    if "error" not in document.get("run", {}):
        changes = _without_inherited_step(changes)
    document = _without_inherited_step(document)
    is_named = any(_without_solver(layer).get("method") for layer in (document, changes))
    document, specification, solver = _merged(document, changes, entry)
    run = read_run(document["run"])
    numbers = {name: document[name] for name in ("parameters", "initial") if name in document}
    document = {**document, **with_exact_numbers(numbers, exact=_precision(document) == DOUBLE_DOUBLE)}
    with warnings.catch_warnings():  # other formulas than that of the system may use its parameters
        warnings.simplefilter("ignore", SystemDefinitionWarning)
        if "field" in document:
            system = part("sections", "field").system(document)
        else:
            system = read_system(document, entry and entry.system)
        system, values = read_values(document, system, folder)
    method = read_method(fitted(specification, system))
    values |= {"inputs": _read_inputs(document.get("inputs", {}), folder), "solver": solver}
    events = read_events(document.get("events", []))
    values |= {name: document.get(name, {}) for name in FURTHER} | run
    method = DEFAULT_METHOD if not is_named and method == DEFAULT_METHOD else method
    model = Model(system=system, method=method, events=events, **values)
    for name in homes("sections"):
        if getattr(model, name, None):
            part("sections", name).check(model)
    return _with_time_transformation(model, document, specification)


def _merged(document: Document, changes: Document, entry: Entry | None) -> tuple[Document, Section, str]:
    """Return all sections with the changes merged over them, the specification of the method, and the solver."""
    solver: str = {"solver": "auto", **document.get("method", {}), **changes.get("method", {})}["solver"]
    document, changes = _without_solver(document), _without_solver(changes)
    if entry is not None:
        document = merged_sections(entry.motion, document)
    declared = {key.partition("[")[0]: key for key in document.get("parameters", {})}
    parameters = {declared.get(name, name): value for name, value in changes.get("parameters", {}).items()}
    merged: dict[str, Section] = merged_sections(
        document, {**changes, "parameters": parameters} if parameters else changes
    )
    if entry is None:
        check_complete(merged)
        check_used(merged, changes.get("parameters", {}))
    else:
        merged["initial"] = entry.completed(merged["initial"])
    return merged, chosen_method(document, changes), solver


def _without_solver(layer: Document) -> Document:
    method = {key: value for key, value in layer.get("method", {}).items() if key != "solver"}
    others = {name: section for name, section in layer.items() if name != "method"}
    return {**others, "method": method} if method else others


def _with_time_transformation(model: Model, document: Document, specification: Section) -> Model:
    """Return the model with the time transformation of its file; warn of probable mistakes in the formulas."""
    g, controller = document.get("system", {}).get("time_transformation"), document["run"].get("controller")
    if g is not None or controller is not None:
        in_section("[run] controller", partial(check_controller, controller, transformed=g is not None))
        if g is not None:
            model = model.with_known_sizes()
        system, g = in_section(
            "[system] time_transformation", lambda: with_time_transformation(model.system, g, controller)
        )
        default = default_controller(in_tau=g is not None)
        controller = None if controller in (SYMPLECTIC, default) else controller
        method = model.method
        if method is not DEFAULT_METHOD:
            method = read_method(fitted(specification, system))
        model = replace(model, system=system, method=method, time_transformation=g, controller=controller)
    others = map(symbol, words_of(document))
    rescaling = [] if g is None else [time_rescaling_function(model.system, g, in_time=True)]
    if model.array_system is not None:
        model.array_system.warn_of_mistakes(others)
    else:
        warn_of_mistakes(model.system, (*others, *rescaling))
    return model


def _without_inherited_step(layer: Document) -> Document:
    """Drop an inherited step size, one in t, if a time transformation is added without a step size in tau.

    Inherited options of adaptive steps are dropped if the step size is fixed now.
    """
    run = layer.get("run", {})
    if run.get("step") is not None:
        return {**layer, "run": {**dict.fromkeys(OF_ADAPTIVE_STEPS), **run}}
    if "time_transformation" not in layer.get("system", {}) or STEP_KEYS & run.keys():
        return layer
    return {**layer, "run": {**run, **dict.fromkeys(STEP_KEYS)}}


def _read_inputs(section: Section, folder: str | os.PathLike[str]) -> Mapping[str, InputTable | float]:
    if not section:
        return {}
    from scvi_codegen.interfaces.models.input_tables import read_input  # imported here: it imports the runtime

    return {name: read_input(name, entry, folder) for name, entry in section.items()}
