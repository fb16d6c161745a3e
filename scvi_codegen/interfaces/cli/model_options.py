"""The argument MODEL and the options that override it, converted to a :class:`Model`."""

import os
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from scvi_codegen.codegen.native.option_table import (
    ASSIGNMENTS,
    COUNT,
    EVENTS,
    INPUTS,
    METHOD,
    NUMBER,
    NUMBER_OR_NAMED,
    NUMBERS,
    NUMBERS_OR_NAME,
    SIZES,
    SWITCH,
    Option,
    check_agreement,
)
from scvi_codegen.common.atomic import NamedFile, naming_folders
from scvi_codegen.common.errors import ModelFileError, SystemDefinitionError
from scvi_codegen.common.toml_text import MAX_CHARACTERS
from scvi_codegen.common.validation import ExactNumber
from scvi_codegen.interfaces.cli.command_group import Command
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.entries import ROBOT_FILES
from scvi_codegen.interfaces.models.model_files.model_file import catalogue_model, load_model, parse_model
from scvi_codegen.interfaces.models.model_files.sections import UNUSED, Unused, event_entry
from scvi_codegen.interfaces.models.options import OPTIONS, ROWS
from scvi_codegen.interfaces.models.problems import PROBLEMS, problem
from scvi_codegen.methods import METHODS, size_of

Choices = Mapping[str, Any]
"""Options of the command line that override MODEL, by name; ``None`` or an empty tuple for options that are absent."""
OFFERED_SIZES = range(1, 17)
"""Numbers that shell completion offers after ``svi:``."""

STANDARD_INPUT = "-"
"""Name of the model whose file is read from standard input; files that it names are in the present folder."""


def sections_of(choices: Choices) -> dict[str, dict[str, Any]]:
    """Return the options as sections of a model file."""
    document: dict[str, Any] = {}
    for option in OPTIONS:
        value = choices.get(option.name)
        if value in (None, (), option.default):
            continue
        if option.kind == EVENTS:
            document[option.section] = [event_entry(text) for text in value]
        elif option.is_section:
            document[option.section] = dict(value)
        elif option.section:
            section = document.setdefault(option.section, {})
            section[option.key] = list(value) if isinstance(value, tuple) else value
    return document


def _numbers(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        return tuple(ExactNumber(word) for word in re.split(r"[,\s]+", value.strip()))
    except ValueError as error:
        raise click.BadParameter(f"{error}; give numbers separated by commas, as in 0.5,-1.2e-3") from error


def _numbers_or_name(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> tuple[float, ...] | str | None:
    if value is not None and re.fullmatch(r"[a-z]+(-[a-z]+)*", value):
        return value
    return _numbers(context, parameter, value)


def _assignments(
    context: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> tuple[tuple[str, float], ...]:
    result = []
    for text in values:
        name, _, number = (part.strip() for part in text.partition("="))
        try:
            result.append((name, ExactNumber(number)))
        except ValueError:
            name = ""
        if not name:
            raise click.BadParameter(f"'{text}' is not of the form NAME=VALUE with a number, as in g=9.81")
    return tuple(result)


def _number_or_named(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> Any:
    """Return VALUE as a number, and NAME=VALUE, NAME=VALUE as numbers by name; ``None`` without any."""
    if not values:
        return None
    if len(values) == 1 and "=" not in values[0]:
        numbers = _numbers(context, parameter, values[0]) or ()
        return numbers[0] if len(numbers) == 1 else numbers
    return dict(_assignments(context, parameter, values))


def _sizes(
    context: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> tuple[tuple[str, float], ...]:
    sizes = _assignments(context, parameter, values)
    return tuple((name, int(value) if value.is_integer() else value) for name, value in sizes)


def _input_files(
    context: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> tuple[tuple[str, float | dict[str, str]], ...]:
    """Return NAME=FILE[:KIND] and NAME=NUMBER as entries of the section [inputs]; paths are made absolute."""
    result = list[tuple[str, float | dict[str, str]]]()
    for text in values:
        name, _, arguments = (part.strip() for part in text.partition("="))
        if name and re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", arguments, re.ASCII | re.IGNORECASE):
            result.append((name, float(arguments)))
            continue
        match = re.fullmatch(r"(?P<file>.+?\.\w+)(:(?P<kind>[a-z]+))?", arguments)
        if not name or not match:
            raise click.BadParameter(f"'{text}' is not of the form NAME=FILE[:KIND] or NAME=NUMBER, as in u=u.csv")
        entry = {key: value for key, value in match.groupdict().items() if value is not None}
        result.append((name, entry | {"file": NamedFile(Path(entry["file"]).absolute())}))
    return tuple(result)


def complete_method(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer names of methods for shell completion; after a colon with degree, number of stages or order."""
    name, colon, _ = incomplete.partition(":")
    offered = [f"{name}:{number}" for number in OFFERED_SIZES] if colon and size_of(name) else METHODS
    return [CompletionItem(text) for text in offered if text.startswith(incomplete)]


def complete_model(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer files and names of the catalogue for shell completion; files first, as bash requires."""
    names = [CompletionItem(name) for name in PROBLEMS if name.startswith(incomplete)]
    return [CompletionItem(incomplete, type="file"), *names]


PARSERS: Mapping[str, Mapping[str, Any]] = {
    NUMBER: {"type": float},
    COUNT: {"type": int},
    SWITCH: {"is_flag": True, "default": None},
    METHOD: {"shell_complete": complete_method},
    NUMBERS: {"callback": _numbers},
    NUMBERS_OR_NAME: {"callback": _numbers_or_name},
    NUMBER_OR_NAMED: {"multiple": True, "callback": _number_or_named},
    ASSIGNMENTS: {"multiple": True, "callback": _assignments},
    INPUTS: {"multiple": True, "callback": _input_files},
    SIZES: {"multiple": True, "callback": _sizes},
    EVENTS: {"multiple": True},
}
"""Arguments of :func:`click.option` by kind of option."""


def _flag(option: Option) -> Callable[[Command], Command]:
    """Return the decorator that adds the flag of an option to a command."""
    further = dict(PARSERS.get(option.kind, {}))
    if option.choices:
        words = {choice.replace(" ", "-"): choice for choice in option.choices}
        further |= {"type": click.Choice([*words]), "callback": lambda _, __, value: words.get(value)}
    if option.default is not None:
        further |= {"default": option.default, "show_default": True}
    return click.option(option.flag, option.name, metavar=option.metavar or None, help=option.help, **further)


_folders = click.option(
    "--folder",
    type=click.Path(exists=True, file_okay=False),
    multiple=True,
    metavar="DIR",
    expose_value=False,
    callback=lambda context, parameter, values: context.with_resource(naming_folders(values)),
    help="Folder with files that MODEL may name (arrays, inputs, robots), besides its own; may be repeated.",
)


def model_arguments(*further: str, required: bool = True) -> Callable[[Command], Command]:
    """Return the decorator that adds the argument MODEL and the options that override it.

    ``further``: names of other options, or of the section of model files that is theirs, as ``"family"``.
    """

    def decorated(command: Command) -> Command:
        command = _folders(command)
        for option in reversed(OPTIONS):
            if option.common or not {option.name, option.section}.isdisjoint(further):
                command = _flag(option)(command)
        return click.argument(
            "model_name", metavar="MODEL" if required else "[MODEL]", required=required, shell_complete=complete_model
        )(command)

    return decorated


def by_field(choices: Choices) -> dict[str, Any]:
    """Return the options of the command line by field."""
    return {option.field: choices.get(option.name) for option in OPTIONS}


def check_exclusive(choices: Choices) -> None:
    """Reject options that exclude each other."""
    check_agreement(by_field(choices), ModelFileError, rows=ROWS, partly=True)


def read_model(
    name: str, choices: Choices, steps: Mapping[str, float] | None = None, unused: Unused | None = None
) -> Model:
    """Return the model of a file, of standard input (``-``) or the catalogue, with the options of the command line.

    Args:
        name: of the model.
        choices: the options.
        steps: entries of [run] that replace a step size, without which options of adaptive steps would be refused.
        unused: required keys that a file may lack, of its sections.
    """
    if unused is not None:
        token = UNUSED.set(unused)
        try:
            return read_model(name, choices, steps)
        finally:
            UNUSED.reset(token)
    check_exclusive(choices)
    sections = sections_of(choices)
    if steps:
        sections["run"] = {**sections.get("run", {}), **steps}
    if name == STANDARD_INPUT:
        text = sys.stdin.read(MAX_CHARACTERS + 1).removeprefix("\ufeff")
        return parse_model(text, sections, folder=Path())
    path = Path(name)
    if path.suffix.lower() in (".toml", *ROBOT_FILES) or os.sep in name or path.is_file():
        return load_model(path, sections)
    if name.partition(":")[0] not in PROBLEMS:
        try:
            problem(name)
        except SystemDefinitionError as error:
            raise SystemDefinitionError(f"{error} (There is no model file '{name}' either.)") from error
    return catalogue_model(name, sections)
