"""Input that is refused, as rows of ``tests/refusals/*.toml``: the words of the error, and arguments that cause it.

A table ``["stepper.integrate".StateError.kepler]`` states what is called, the class of its errors, and on what. Calls:
``system`` makes the subject with other arguments; ``stepper.``, ``system.`` are methods of the subject; ``sc.`` is a
function of the package, with the subject as first argument unless that is ``none``. Of several calls each is made,
those of ensembles with one trajectory. A row, ``"words" = { arguments }``, has the words of the error in their order,
with `` .. `` for what is between them; several arguments with the same error are a list. Methods of the result follow
as ``then = { name = { arguments } }``; a ``start`` is made by a function of the package from its table. ``with`` has
what the rows of a table share; ``second`` is the second tier.

``[subjects]`` are systems, as arguments of ``from_text``, and steppers, as a ``system`` with arguments of
``compile_stepper``. Other names are those of the catalogue.
"""

import json
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import scvi_codegen as sc
from scvi_codegen.methods import method_from_specification

FOLDER = Path(__file__).parent.parent / "refusals"
VALUES = {"<None>": None, "<complex>": 1j}
"""Values that TOML cannot state, by how the rows write them."""


def system_of(description: str | dict[str, Any]) -> Any:
    """Return a system of the catalogue, or one by arguments of ``from_text``, where ``in_time`` reparametrises it."""
    if isinstance(description, str):
        return sc.problem(description).system
    arguments = {"name": "system"} | {name: x for name, x in description.items() if name != "in_time"}
    kind = sc.HamiltonianSystem if "hamiltonian" in arguments else sc.LagrangianSystem
    system = (sc.FieldSystem if "space" in arguments else kind).from_text(**arguments)
    return sc.reparametrise(system, description["in_time"]) if "in_time" in description else system


@cache
def subject(description: str) -> Any:
    """Return the system or the stepper by its description as JSON, once for all rows."""
    of = json.loads(description)
    if isinstance(of, str) or "system" not in of:
        return system_of(of)
    return sc.compile_stepper(
        system_of(of["system"]), **{name: value(name, x) for name, x in of.items() if name != "system"}
    )


@cache
def start_of(description: str, made: str) -> Any:
    """Return the orbit or the equilibrium of a stepper from which a family starts."""
    ((function, arguments),) = json.loads(made).items()
    return getattr(sc, function)(subject(description), **arguments)


def value(name: str, x: Any) -> Any:
    """Return an argument as the package takes it: methods and events are made, tables of inputs are tuples."""
    if name == "method" and isinstance(x, dict) and "statements" in x:
        claims = {"name": "mine", "title": "Mine", "order": 2, "symmetric": False, "symplectic": True} | x
        step = sc.ExplicitStep.of(claims.pop("statements"), claims.pop("tables", {}))
        return sc.ExplicitMethod(**claims, step=step)
    if name == "method" and isinstance(x, dict):
        return method_from_specification(x)
    if name == "events" and isinstance(x, dict):
        return sc.impact(**x["impact"]) if "impact" in x else sc.Event(**x)
    if name == "inputs" and isinstance(x, dict):
        return {key: tuple(table) if isinstance(table, list) else table for key, table in x.items()}
    if isinstance(x, list):
        return [value("", entry) for entry in x]
    return VALUES.get(x, x) if isinstance(x, str) else x


def call(name: str, of: Any, arguments: dict[str, Any]) -> None:
    """Call a function by its name on a subject, and the methods of its result that ``then`` names."""
    kind, _, function = name.partition(".")
    first = {name: value(name, x) for name, x in arguments.items() if name != "then"}
    if name == "system":
        result = system_of(of | first)
    elif kind == "sc":
        if isinstance(first.get("start"), dict):
            first["start"] = start_of(json.dumps(of), json.dumps(first["start"]))
        result = getattr(sc, function)(*[] if of == "none" else [subject(json.dumps(of))], **first)
    else:
        result = getattr(subject(json.dumps(of)), function)(**first)
    for method, others in arguments.get("then", {}).items():
        result = getattr(result, method)(**others)


def refusals() -> Iterator[Any]:
    """Cases of all files: call, subject, arguments, class and words of the error."""
    for path in sorted(FOLDER.glob("*.toml")):
        calls = tomllib.loads(path.read_text(encoding="utf-8"))
        subjects = calls.pop("subjects")
        tables = [(names, error, of) for names, errors in calls.items() for error, its in errors.items() for of in its]
        for names, error, of in tables:
            rows = calls[names][error][of]
            of = subjects.get(of, of)
            if isinstance(of, dict) and isinstance(of.get("system"), str):
                of = of | {"system": subjects.get(of["system"], of["system"])}
            common, tier = rows.pop("with", {}), [pytest.mark.second] if rows.pop("second", False) else []
            for words, cases in rows.items():
                for changes in cases if isinstance(cases, list) else [cases]:
                    for name in names.split():
                        arguments = common | changes
                        if "ensemble" in name and " " in names:
                            arguments = {x: [y] if x in ("q", "p", "velocity") else y for x, y in arguments.items()}
                        case = name, of, arguments, getattr(sc, error), words
                        yield pytest.param(*case, marks=tier, id=f"{name}: {words}")


@pytest.mark.parametrize(("name", "of", "arguments", "error", "words"), list(refusals()))
def test_refused(name: str, of: Any, arguments: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error) as refused:
        call(name, of, arguments)
    begin = 0
    for part in words.split(" .. "):
        begin = str(refused.value).find(part, begin)
        assert begin >= 0, f"{part!r} is not in the message: {refused.value}"
