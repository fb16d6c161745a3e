"""What is public, a line each: names with their signatures, options of the command line.

python tests/tools/public.py      writes it to tests/corpus/public.txt, which test_public.py compares.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

import scvi_codegen
from scvi_codegen.cli import main

__all__ = ["KEPT", "public"]

KEPT = Path(__file__).parents[1] / "corpus" / "public.txt"
PACKAGE = "scvi_codegen."
PLAIN = (int, float, str, type, type(None))
"""Defaults that are told; "there is none" is a type."""


def public() -> str:
    """All lines, sorted."""
    return "\n".join(sorted([*_python(), *_command_line(main, "$ scvi-codegen")])) + "\n"


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
    """In place of a default that is no number or text."""

    def __repr__(self) -> str:
        return "..."


def _signature(thing: Any) -> str:
    """Names, kinds and plain defaults of what it takes; types are for the type checker."""
    if inspect.isclass(thing) and not _is_ours(thing, "__init__", {}):
        return ""  # of an exception that is as Python made it
    signature = inspect.signature(thing)
    bare = [p.replace(annotation=inspect.Parameter.empty) for p in signature.parameters.values()]
    told = [p if p.default == () or isinstance(p.default, PLAIN) else p.replace(default=_Something()) for p in bare]
    return str(signature.replace(parameters=told, return_annotation=inspect.Signature.empty))


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


if __name__ == "__main__":
    KEPT.write_text(public(), encoding="utf-8")
    print(KEPT.relative_to(Path.cwd()) if KEPT.is_relative_to(Path.cwd()) else KEPT, file=sys.stderr)
