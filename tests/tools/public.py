"""Public names, one per line: names and signatures, options, keys of model files, C names, variables of FMUs.

python tests/tools/public.py      writes it to tests/corpus/public.txt, which test_public.py compares.
"""

import inspect
import re
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import click

import scvi_codegen
from scvi_codegen.cli import main
from scvi_codegen.methods import ARGUMENTS
from scvi_codegen.models.model_files import model_file
from scvi_codegen.runtime import distributed

RECORDED = Path(__file__).parents[1] / "corpus" / "public.txt"
PACKAGE = "scvi_codegen."
METHOD = scvi_codegen.SVI(2, "gauss-lobatto:3")
"""Of headers: one that keeps constraints."""
PLAIN = (int, float, str, type, type(None))
"""Defaults that are printed; "there is none" is a type."""


def public() -> str:
    """All lines, sorted."""
    found = (*_python(), *_command_line(main, "$ scvi-codegen"), *_model_files(), *_headers(), *_fmus())
    return "\n".join(sorted(found)) + "\n"


def _python() -> Iterator[str]:
    for name in scvi_codegen.__all__:
        thing = getattr(scvi_codegen, name)
        if inspect.isclass(thing):
            bases = ", ".join(base.__name__ for base in thing.__bases__ if base is not object)
            yield f"{name}{_signature(thing)} of {bases}" if bases else name + _signature(thing)
            yield from _members(name, thing)
        elif callable(thing):
            yield name + _signature(thing)
        else:
            yield f"{name}: {type(thing).__name__}"
    for name in distributed.__all__:
        yield f"{distributed.__name__}.{name}{_signature(getattr(distributed, name))}"


def _members(name: str, kind: type) -> Iterator[str]:
    """Methods, properties and fields without an underscore, also inherited, but for what others' classes have."""
    fields = getattr(kind, "__dataclass_fields__", {})
    for member in sorted({*dir(kind), *fields}):
        if member.startswith("_") or not _is_ours(kind, member, fields):
            continue
        value = inspect.getattr_static(kind, member, None)
        function = getattr(value, "__func__", value)
        if inspect.isfunction(function):
            yield f"{name}.{member}{_signature(function)}"
        else:
            yield f"{name}.{member}"


def _is_ours(kind: type, member: str, fields: dict[str, Any]) -> bool:
    homes = (base.__module__ for base in kind.__mro__ if member in vars(base))
    return member in fields or next(homes, "").startswith(PACKAGE)


class _Something:
    """Placeholder of a default that is neither a number nor text."""

    def __repr__(self) -> str:
        return "..."


def _signature(thing: Any) -> str:
    """Names, kinds and plain defaults of what it takes; types are for the type checker."""
    if inspect.isclass(thing) and not _is_ours(thing, "__init__", {}):
        return ""  # of an exception that is as Python made it
    signature = inspect.signature(thing)
    bare = [p.replace(annotation=inspect.Parameter.empty) for p in signature.parameters.values()]
    reported = [p if p.default == () or isinstance(p.default, PLAIN) else p.replace(default=_Something()) for p in bare]
    return str(signature.replace(parameters=reported, return_annotation=inspect.Signature.empty))


def _command_line(command: click.Command, words: str) -> Iterator[str]:
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            below = command.get_command(context, name)
            assert below is not None
            yield from _command_line(below, f"{words} {name}")
    for parameter in command.params:
        for option in (*parameter.opts, *parameter.secondary_opts):
            yield f"{words} {option}" if option.startswith("-") else f"{words} {option.upper()}"


def _model_files() -> Iterator[str]:
    """Sections and their keys; in brackets of a method those that it takes."""
    for section in model_file.SECTIONS:
        yield from (f"[{section}] {key}".rstrip() for key in ("", *model_file.KEYS.get(section, ())))
    for method, keys in ARGUMENTS.items():
        yield f"[method] {method} {' '.join(keys)}".rstrip()


def _headers() -> Iterator[str]:
    """Names in generated headers: of a free motion, a held one, one with an input, and one in a time of its own."""
    kepler = scvi_codegen.problem("kepler").system
    given: tuple[dict[str, Any], ...] = ({"constraints": ["x**2 + y**2 = 1"]}, {"forces": {"x": "u"}, "inputs": ["u"]})
    falling = "(x_dot**2 + y_dot**2)/2 - y"
    others = [
        scvi_codegen.LagrangianSystem.from_text(name="falling", coordinates=["x", "y"], lagrangian=falling, **more)
        for more in given
    ]
    names = set()
    for system in (kepler, scvi_codegen.reparametrise(kepler, "distance"), *others):
        source, _ = scvi_codegen.generate_source(system, METHOD, prefix="one", controlled=True)
        names |= set(re.findall(r"\b(?:one|ONE)_\w+", source.header))
    yield from (f"in C: {name}" for name in names - {"ONE_H"})


def _fmus() -> Iterator[str]:
    """Variables of FMUs that start by velocities and by momenta, with what an importer sees of each."""
    pushed = scvi_codegen.LagrangianSystem.from_text(
        name="pushed",
        coordinates=["x"],
        lagrangian="m*x_dot**2/2",
        parameters={"m": 2.0},
        forces={"x": "u"},
        inputs=["u"],
    )
    for started in ("velocity", "p"):
        given: dict[str, Any] = {started: (0.5,)}
        model = scvi_codegen.Model(system=pushed, method=METHOD, q=(1.0,), h=0.1, steps=1, **given)
        for variable in _variables(model):
            reported = {
                name: variable.attrib[name] for name in variable.attrib.keys() - {"valueReference", "description"}
            }
            words = " ".join(f"{key}={value}" for key, value in sorted(reported.items()) if key != "name")
            yield f"in an FMU from {started}: {reported['name']} {variable.tag} {words}"


def _variables(model: scvi_codegen.Model) -> list[ElementTree.Element]:
    with tempfile.TemporaryDirectory() as folder:
        made = scvi_codegen.generate_fmu(model, Path(folder) / "one.fmu")
        described = zipfile.ZipFile(made).read("modelDescription.xml")
    variables = ElementTree.fromstring(described).find("ModelVariables")
    assert variables is not None
    return variables[:]


if __name__ == "__main__":
    RECORDED.write_text(public(), encoding="utf-8")
    print(RECORDED.relative_to(Path.cwd()) if RECORDED.is_relative_to(Path.cwd()) else RECORDED, file=sys.stderr)
