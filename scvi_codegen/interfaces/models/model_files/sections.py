"""Sections of model files: merging, validation of keys, methods, systems with their forces, hints for unknown keys."""

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final, TypeVar

from scvi_codegen.codegen.native.option_table import check_agreement
from scvi_codegen.common.atomic import read_text
from scvi_codegen.common.errors import ModelFileError, ScviCodegenError, closest
from scvi_codegen.common.validation import FORMULA, checked_count, likely_names, synonym_hint
from scvi_codegen.interfaces.models.model import DEFAULT_METHOD
from scvi_codegen.interfaces.models.options import ALTERNATIVE_KEYS, KEYED, ROWS, options_of, real
from scvi_codegen.methods import ARGUMENTS, Method, method_from_specification, sized, specification_of
from scvi_codegen.systems.event import Event
from scvi_codegen.systems.first_order import FirstOrderSystem
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.transform import lagrangian_of
from scvi_codegen.systems.system import MechanicalSystem

KEYS: Final = {
    "system": "lagrangian hamiltonian damping dissipation temperature noise constraints time_transformation inputs",
    "field": "density space boundary discretisation",
}
LISTS: Final = ("events", "contacts")
"""Sections that are lists of tables, ``[[events]]``."""
EVENT_KEYS: Final = ("function", "direction", "terminal", "then", "where", "restitution")
NAMED_SECTIONS: Final = ("parameters", "forces", "torques", "torques_space", "initial", "run")
SECTION_OF_KEY: Final = {
    **{option.key: option.section for option in KEYED},
    **{key: section for section, keys in KEYS.items() for key in keys.split()},
    **{section: section for section in NAMED_SECTIONS},
}
"""Section of each key in a model file; of the name of a section that section."""


def key_hint(key: str, names: Iterable[str], section: str) -> str:
    """Return ``"; did you mean 'step'?"``, ``"; 'step' belongs in [run]."`` or ``"; there is a section [run]."``.

    Else a full stop, also where the key belongs in this section, but not with the present method.

    Args:
        key: the unknown key.
        names: known keys of its section.
        section: this section, as in ``"[run]"``.
    """
    names = list(names)
    if synonym := synonym_hint(key, names):
        return synonym
    if key not in SECTION_OF_KEY and (similar := closest(key, names)) != ".":
        return similar
    likely = [key] if key in SECTION_OF_KEY else likely_names(key)
    known_key = next((name for name in likely if name in SECTION_OF_KEY), None)
    if known_key is None:
        return "."
    if known_key in NAMED_SECTIONS:
        return f"; there is a section [{known_key}]."
    if section == f"[{SECTION_OF_KEY[known_key]}]":
        return "."
    return f"; '{known_key}' belongs in [{SECTION_OF_KEY[known_key]}]."


Built = TypeVar("Built")
Section = Mapping[str, Any]
Document = Mapping[str, Section]

ALTERNATIVES = ({"lagrangian", "hamiltonian"}, {"density", "hamiltonian"}, *ALTERNATIVE_KEYS)
"""Groups of alternative keys, of which one is given."""
INHERITED = ("degree", "quadrature", "nodes", "stages")
"""Arguments of a method that are inherited when another method is merged over it, if that accepts them."""


def chosen_method(document: Document, changes: Document) -> Section:
    """Return the method of a file, or the default one, with the given changes."""
    default: Section = DEFAULT_METHOD.specification()
    section = {**document.get("system", {}), **changes.get("system", {})}
    if section.get("constraints") or document.get("contacts") or changes.get("contacts"):
        default = {"method": "svi", "degree": 6}
    base = _split_method_name(document.get("method", default))
    return _changed_method(base, _split_method_name(changes.get("method", {})))


def merged_sections(below: Document, above: Document) -> dict[str, Section]:
    """Return all sections merged; keys in ``above`` replace those in ``below`` and their alternatives."""
    document: dict[str, Any] = dict(below)
    for name, section in above.items():
        if name in LISTS:
            document[name] = [*below.get(name, ()), *section]
            continue
        replaced = {key for keys in ALTERNATIVES if not keys.isdisjoint(section) for key in keys}
        base_section = {} if name == "method" else below.get(name, {})
        document[name] = {key: value for key, value in base_section.items() if key not in replaced} | dict(section)
    return document


def _split_method_name(section: Section) -> Section:
    """Return a method section with a name such as ``svi:6`` split into name and degree."""
    name = section.get("method")
    if not isinstance(name, str) or ":" not in name:
        return section
    spelt = in_section("[method]", lambda: specification_of(name))
    for key, value in spelt.items():
        if key != "method" and section.get(key, value) != value:
            raise ModelFileError(f"[method] method = {name} and [method] {key} = {section[key]} contradict each other")
    return {**section, **spelt}


def _changed_method(base: Section, changes: Section) -> Section:
    """Return a method with some arguments changed; another method inherits common arguments."""
    if not changes:
        return base
    base_section = dict(base)
    if base_section.get("quadrature") == f"gauss-legendre:{base_section.get('degree')}":
        del base_section["quadrature"]  # the default for its degree; another degree has another default
    name = changes.get("method", base_section.get("method"))
    if name != base_section.get("method"):
        accepted = ARGUMENTS.get(name, ())
        base_section = {key: value for key, value in base_section.items() if key in INHERITED and key in accepted}
    if {"abscissae", "space"} & changes.keys():
        base_section.pop("nodes", None)  # alternatives to nodes
    return sized({**base_section, **changes}) if "method" in changes else {**base_section, **changes}


def text_in(path: str | os.PathLike[str]) -> str:
    """Return the text of a file in UTF-8; :class:`ModelFileError` begins with its path."""
    try:
        return read_text(path, "utf-8-sig")
    except OSError as error:
        raise ModelFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        problem = f"is not a text file in UTF-8: {error.reason} at byte {error.start}"
        raise ModelFileError(f"{path} {problem}") from error


def read_method(section: Section) -> Method:
    """Return the method of the section ``[method]``."""
    if "method" not in section:
        check_keys(section, dict.fromkeys(["method", *chain.from_iterable(ARGUMENTS.values())]), "key", "[method]")
    name = text_of(section, "method", "[method]")
    taken = ("method", *ARGUMENTS.get(name, section))
    for option in options_of("method"):
        if option.key in section:
            option.checked(section[option.key], ModelFileError)
            if option.key not in taken:
                takes = ", ".join(row.word for row in options_of("method") if row.key in taken[1:]) or "no options"
                raise ModelFileError(f"{option} is not for the method {name}, which takes {takes}: omit it")
    check_keys(section, taken, "key", f"[method] for {name}")
    if not isinstance(section.get("abscissae", []), list | str):
        raise ModelFileError(f"[method] abscissae must be a list of numbers or a name, not {section['abscissae']!r}")
    return in_section("[method]", lambda: method_from_specification(section))


def names_of(section: Section, key: str) -> list[str]:
    """Return a list of names in ``[system]``."""
    names = required(section, key, "[system]")
    if not isinstance(names, list) or not all(isinstance(item, str) for item in names):
        raise ModelFileError(f"[system] {key} must be a list of names, not {names!r}")
    return names


def check_one(section: Section, name: str, key: str, alternative: str) -> None:
    """Raise an error if two alternative keys are both given."""
    if key in section and alternative in section:
        raise ModelFileError(f"[{name}] has both {key} and {alternative}: give one of them")


def required(section: Section, key: str, where: str) -> Any:
    """Return the value of a key."""
    if key not in section:
        raise ModelFileError(f"{where} lacks '{key}'")
    return section[key]


def text_of(section: Section, key: str, where: str) -> str:
    """Return the text value of a key."""
    value = required(section, key, where)
    if not isinstance(value, str):
        raise ModelFileError(f"{where} {key} must be text between quotes, not {value!r}")
    return value


def formula_of(section: Section, key: str, where: str) -> str:
    """Return the formula value of a key, which is text or a number."""
    if not FORMULA.accepts(required(section, key, where)):
        raise ModelFileError(f"{where} {key} must be a formula between quotes or a number, not {section[key]!r}")
    return str(section[key])


def check_keys(section: Section, names: Iterable[str], kind: str, where: str = "the file") -> None:
    """Raise an error for unknown keys."""
    names = list(names)
    for key in section:
        if key not in names:
            hint = key_hint(key, names, where.split(" ")[0]) if kind in ("key", "section") else closest(key, names)
            raise ModelFileError(f"unknown {kind} '{key}' in {where}{hint} Known: {', '.join(dict.fromkeys(names))}")


def in_section(where: str, build: Callable[[], Built]) -> Built:
    """Return ``build()``, with errors prefixed by the location in the file."""
    try:
        return build()
    except (ScviCodegenError, TypeError) as error:
        raise ModelFileError(f"{where}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class ModelSection:
    """A section of model files that an extra adds.

    Attributes:
        keys: known ones.
        system: function of the document, with an exact (m,) state; returns the system that the section defines.
        initial: function of ``[initial]`` and this system; returns it with numbers instead of formulas.
        check: function of the model; raises ModelFileError, naming the key at fault.

    For these functions ``check_keys(section, names, kind, where)`` raises the error of unknown keys, ``real(value,
    where)`` returns a finite number, and ``within(where, build)`` returns ``build()``, whose errors name the place.
    """

    keys: tuple[str, ...]
    system: Callable[[Document], Any] | None = None
    initial: Callable[[Section, Any], Section] | None = None
    check: Callable[[Any], None] | None = None
    check_keys = staticmethod(check_keys)
    real = staticmethod(real)
    within = staticmethod(in_section)


def read_run(section: Section) -> dict[str, Any]:
    """Return the fields of a model in ``[run]``; adaptive steps without a step size."""
    stated = {option: section[option.key] for option in options_of("run") if section.get(option.key) is not None}
    check_agreement({option.field: value for option, value in stated.items()}, ModelFileError, rows=ROWS)
    numbers = {option.field: option.checked(value, ModelFileError) for option, value in stated.items()}
    return {name: value for name, value in numbers.items() if name != "controller"}


FORMULAS = ("lagrangian", "hamiltonian", "dissipation", "damping", "constraints")
TURNING = ("rotations", "directions", "spins")
"""Keys of [system] that declare coordinates of another kind."""
TORQUES = ("torques", "torques_space")
"""Sections with three formulas by rotation, in the body frame and in the space frame."""
REQUIRED = {
    "field": ("name", "fields", "space", "density", "discretisation"),
    "system": ("name", "coordinates", "lagrangian"),
    "initial": ("q", "q_dot"),
    "run": ("span",),
}
"""Required keys, or their alternatives; [field] is in the place of [system]."""


def has_arrays(document: Document, sizes: str = r"\w") -> bool:
    """Return whether coordinates, rotations, directions or spins are arrays, with sizes that contain a pattern."""
    groups = [document.get("system", {}).get(key) for key in ("coordinates", *TURNING)]
    names = chain(*(group for group in groups if isinstance(group, list | dict)))
    return any(isinstance(name, str) and re.search(rf"\[.*{sizes}", name) for name in names)


def is_number(value: Any) -> bool:
    """Return whether the value of an array is one number for all entries."""
    return not isinstance(value, str | list | dict)


Unused = Callable[[Document], Collection[str]]
UNUSED: ContextVar[Unused] = ContextVar("unused", default=lambda document: ())
"""Function of a document that returns the required keys that a command does not use."""


def check_complete(document: dict[str, Section]) -> None:
    """Raise an error that lists all missing keys; arrays whose sizes are names are at rest by default.

    Keys that the command does not use get a value: a duration of 1, coordinates and velocities of 0.
    """
    missing, unused = [], UNUSED.get()(document)
    replaced = "system" if "field" in document else "field"
    for name, keys in REQUIRED.items():
        for key in () if name == replaced else keys:
            choice = next((choice for choice in ALTERNATIVES if key in choice), {key})
            if not choice.isdisjoint(section := document.get(name, {})) or _is_optional(document, key):
                continue
            if key in unused:
                zeros = [0.0] * len(document.get("system", {}).get("coordinates", ()))
                document[name] = {**section, key: 1.0 if key == "span" else zeros}
            else:
                missing.append(f"{' or '.join(sorted(choice))} in [{name}]")
    if missing == ["p or q_dot in [initial]"] and isinstance(read_system(document), FirstOrderSystem):
        return
    if missing:
        at_rest = "p or q_dot in [initial]" in missing
        rest = "; for a start from rest write q_dot = [0.0, ..], or --velocity 0,.." if at_rest else ""
        raise ModelFileError(f"there is no {', no '.join(missing)}{rest}")


def _is_optional(document: Document, key: str) -> bool:
    """Return whether a required key may be missing: velocities of arrays and spins, coordinates beside rotations."""
    section = document.get("system", {})
    if key == "coordinates":
        return not section.keys().isdisjoint(TURNING)
    return key == "q_dot" and ("field" in document or has_arrays(document, "[A-Za-z_]") or "spins" in section)


def check_used(document: Document, parameters: Section) -> None:
    """Raise an error for an added parameter that no formula contains."""
    used = words_of(document)
    for name in parameters:
        if name not in used:
            raise ModelFileError(f"the system has no parameter '{name}'")


def words_of(document: Document) -> set[str]:
    """Return the names in all formulas of a model file, also of events, the initial state, inputs and parameters."""

    def texts(value: Any) -> Iterator[str]:
        if isinstance(value, str):
            yield value
        elif isinstance(value, dict | list | tuple):
            for entry in value.values() if isinstance(value, dict) else value:
                yield from texts(entry)

    without = ("method", "run", "path", "family", "page")
    sections = {name: section for name, section in document.items() if name not in without}
    for name in {"system", "field"} & sections.keys():
        sections[name] = {key: value for key, value in sections[name].items() if key != "name"}
    return {word for text in texts(sections) for word in re.findall(r"[A-Za-z_]\w*", text)}


def tables_in(entries: Any, name: str) -> list[dict[str, Any]]:
    """Return the tables ``[[name]]``."""
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ModelFileError(f"{name} must be tables, [[{name}]], not {entries!r}")
    return entries


def read_events(entries: Any) -> tuple[Event, ...]:
    """Return the events of the tables ``[[events]]``."""
    events = []
    for entry in tables_in(entries, "events"):
        check_keys(entry, EVENT_KEYS, "key", "[[events]]")
        direction = {"direction": -1} if "restitution" in entry else {}
        where = f"[[events]] function = {required(entry, 'function', '[[events]]')!r}"
        events.append(in_section(where, lambda entry=entry, direction=direction: Event(**direction | entry)))  # type: ignore[misc]
    return tuple(events)


def event_entry(text: str) -> dict[str, Any]:
    """Return the table of an event on one line, ``"y; direction=-1; where=x > 1; p_y=-e*p_y"``."""
    function, *settings = map(str.strip, text.split(";"))
    entry: dict[str, Any] = {"function": function}
    for setting in settings:
        name, equals, value = map(str.strip, setting.partition("="))
        if not equals or not value:
            raise ModelFileError(f"'{setting}' in the event '{text}' is not of the form NAME=VALUE, as in p_y=-p_y")
        if name in ("direction", "terminal"):
            entry[name] = checked_count(int(value) if value.lstrip("-").isdigit() else value, name, least=-1)
        elif name in EVENT_KEYS:
            entry[name] = value
        else:
            entry.setdefault("then", {})[name] = value
    return entry


def read_system(document: Document, named: MechanicalSystem | None = None) -> MechanicalSystem:
    """Return the system of a file, ``named`` if it names one, with the values of its scalar parameters."""
    forces, values = document.get("forces", {}), _scalars(document)
    if named is not None:
        if further := [name for name in ("forces", "contacts", "functions") if document.get(name)]:
            part = "[[contacts]]" if further[0] == "contacts" else f"[{further[0]}]"
            raise ModelFileError(
                f"{part} are not supported for a system of the catalogue or of a robot: write it out in [system]"
            )
        return in_section("[parameters]", lambda: named.with_parameters(**values))
    section = document["system"]
    check_one(section, "system", "lagrangian", "hamiltonian")
    if document.get("contacts") and "hamiltonian" in section:
        raise ModelFileError("[[contacts]] require a lagrangian in [system]: write the Lagrangian")
    arguments: dict[str, Any] = {
        "name": text_of(section, "name", "[system]"),
        "coordinates": names_of(section, "coordinates") if "coordinates" in section else (),
        **_turning(document),
        "parameters": values,
        "forces": {key: formula_of(forces, key, "[forces]") for key in forces},
        "damping": formula_of(section, "damping", "[system]") if "damping" in section else None,
        "inputs": names_of(section, "inputs") if "inputs" in section else (),
        "tables": list(document.get("tables", {})),
        "neighbours": section.get("neighbours"),
        "functions": document.get("functions"),
    }
    constraints = names_of(section, "constraints") if "constraints" in section else ()
    if "hamiltonian" in section:
        if "dissipation" in section:
            raise ModelFileError(
                "[system] has a dissipation, in velocities, and a hamiltonian: write the forces in [forces] instead"
            )
        arguments["hamiltonian"] = text_of(section, "hamiltonian", "[system]")
        arguments["momenta"] = names_of(section, "momenta") if "momenta" in section else None
        hamiltonian = in_section("[system]", lambda: HamiltonianSystem.from_text(**arguments))
        if not constraints:
            return hamiltonian
        return in_section("[system]", lambda: lagrangian_of(hamiltonian, constraints=constraints))
    if "momenta" in section:
        raise ModelFileError(
            "[system] has momenta and a lagrangian: momenta are names for a hamiltonian; leave them out"
        )
    arguments["lagrangian"] = text_of(section, "lagrangian", "[system]")
    arguments["point_forces"] = section.get("point_forces", ())
    arguments["dissipation"] = text_of(section, "dissipation", "[system]") if "dissipation" in section else None
    arguments["temperature"] = formula_of(section, "temperature", "[system]") if "temperature" in section else None
    arguments["noise"] = section.get("noise")
    arguments["contacts"] = tables_in(document.get("contacts", []), "contacts")
    return in_section("[system]", lambda: LagrangianSystem.from_text(**arguments, constraints=constraints))


def _turning(document: Document) -> dict[str, Any]:
    """Return the arguments that declare rotations, directions, spins and torques."""
    arguments = {key: document["system"][key] for key in TURNING if key in document["system"]}
    for key in TORQUES:
        if document.get(key):
            arguments[key] = {name: list(map(str, formulas)) for name, formulas in document[key].items()}
    return arguments


def _scalars(document: Document) -> dict[str, float]:
    """Return the values of scalar parameters and of uniform arrays; 1 for other arrays, which are read separately."""
    parameters = document.get("parameters", {})
    return {
        key: real(value, f"[parameters] {key}") if "[" not in key or is_number(value) else 1.0
        for key, value in parameters.items()
    }
