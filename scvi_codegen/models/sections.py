"""Sections of model files, of every kind of system: laid over each other, keys checked, methods read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from scvi_codegen.errors import ModelFileError, ScviCodegenError, closest
from scvi_codegen.given.counts import checked_count
from scvi_codegen.given.kinds import FORMULA
from scvi_codegen.methods import ARGUMENTS, Method, method_from_specification, sized, specification_of
from scvi_codegen.models.meant import meant_by
from scvi_codegen.models.model import DEFAULT_METHOD, real

__all__ = [
    "Document",
    "Section",
    "check_keys",
    "check_one",
    "chosen_method",
    "formula_of",
    "in_section",
    "laid_over",
    "names_of",
    "read_method",
    "read_run",
    "required",
    "text_of",
]

Built = TypeVar("Built")
Section = Mapping[str, Any]
Document = Mapping[str, Section]

ALTERNATIVES = ({"lagrangian", "hamiltonian"}, {"p", "q_dot"}, {"step", "tolerance", "error"}, {"span", "steps"})
"""One of each is given."""
INHERITED = ("degree", "quadrature", "nodes", "stages")
"""Arguments that a method laid over another takes from it, if it has them."""


def chosen_method(document: Document, given: Document) -> Section:
    """The method of a file, or the default one, with what is laid over it."""
    default: Section = DEFAULT_METHOD.specification()
    if document.get("system", {}).get("constraints"):
        default = {"method": "svi", "degree": 6}
    base = _spelt_out(document.get("method", default))
    return _changed_method(base, _spelt_out(given.get("method", {})))


def laid_over(below: Document, above: Document) -> dict[str, Section]:
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
    spelt = in_section("[method]", lambda: specification_of(name))
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


def read_method(section: Section) -> Method:
    """The method of ``[method]``."""
    name = text_of(section, "method", "[method]")
    if name in ARGUMENTS:
        check_keys(section, ("method", *ARGUMENTS[name]), "key", f"[method] for {name}")
    if not isinstance(section.get("variational", True), bool):
        raise ModelFileError(f"[method] variational must be true or false, not {section['variational']!r}")
    if not isinstance(section.get("abscissae", []), list | str):
        raise ModelFileError(f"[method] abscissae must be a list of numbers or a name, not {section['abscissae']!r}")
    return in_section("[method]", lambda: method_from_specification(section))


def names_of(section: Section, key: str) -> list[str]:
    """A list of names in ``[system]``."""
    names = required(section, key, "[system]")
    if not isinstance(names, list) or not all(isinstance(item, str) for item in names):
        raise ModelFileError(f"[system] {key} must be a list of names, not {names!r}")
    return names


def check_one(section: Section, name: str, one: str, other: str) -> None:
    """Refuse two keys of which one is to be given."""
    if one in section and other in section:
        raise ModelFileError(f"[{name}] has both of {one} and {other}: give one of them")


def required(section: Section, key: str, where: str) -> Any:
    """What stands under a key."""
    if key not in section:
        raise ModelFileError(f"{where} lacks '{key}'")
    return section[key]


def text_of(section: Section, key: str, where: str) -> str:
    """A text under a key."""
    value = required(section, key, where)
    if not isinstance(value, str):
        raise ModelFileError(f"{where} {key} must be text between quotes, not {value!r}")
    return value


def formula_of(section: Section, key: str, where: str) -> str:
    """A formula under a key, as text or a number."""
    if not FORMULA.holds(required(section, key, where)):
        raise ModelFileError(f"{where} {key} must be a formula between quotes or a number, not {section[key]!r}")
    return str(section[key])


def check_keys(section: Section, known: Iterable[str], what: str, where: str = "the file") -> None:
    """Refuse keys that are not known."""
    names = list(known)
    hint = meant_by if what in ("key", "section") else closest
    for key in section:
        if key not in names:
            raise ModelFileError(f"unknown {what} '{key}' in {where}{hint(key, names)} Known: {', '.join(names)}")


def in_section(where: str, build: Callable[[], Built]) -> Built:
    """What is built, with the place in the file before its errors."""
    try:
        return build()
    except (ScviCodegenError, TypeError) as error:
        raise ModelFileError(f"{where}: {error}") from error


def read_run(section: Section) -> dict[str, Any]:
    """The fields of a model that ``[run]`` gives; without a step its steps choose their length."""
    section = {key: value for key, value in section.items() if value is not None}
    for one, other in (("step", "tolerance"), ("step", "error"), ("tolerance", "error")):
        check_one(section, "run", one, other)
    check_one(section, "run", "span", "steps")
    fields = {"step": "h", "tolerance": "tolerance", "error": "error", "span": "span"}
    found: dict[str, Any] = {
        field: real(section[key], f"[run] {key}") for key, field in fields.items() if key in section
    }
    if not {"step", "tolerance", "error"} & section.keys() and "steps" in section:
        raise ModelFileError("[run] has steps and no step, which says how long they are")
    if "steps" in section:
        found["steps"] = checked_count(section["steps"], "[run] steps", least=0, error=ModelFileError)
    found["save_every"] = checked_count(section.get("save_every", 1), "[run] save_every", least=1, error=ModelFileError)
    return found
