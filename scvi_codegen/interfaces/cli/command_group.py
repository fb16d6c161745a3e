"""Framework shared by all commands: command group, error handling, exit status, reports and output files.

A command whose result a program can use is decorated with :func:`reporting` and reports with :func:`tell`, as text and
as numbers: by default the text is printed, with ``--json`` the numbers, with ``--quiet`` neither. The document of
``--json`` also contains the error that ended a command.
"""

import json
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from scvi_codegen.codegen.native.announcements import announce_to
from scvi_codegen.common.errors import (
    AccuracyWarning,
    BuildError,
    MethodWarning,
    PathError,
    RecordingError,
    ScviCodegenError,
    StepFailedError,
    SystemDefinitionWarning,
    UnresolvedError,
    closest,
    speaking,
)
from scvi_codegen.common.registry import EXTRAS, part

Command = TypeVar("Command", bound=Callable[..., Any])
REPORT, QUIET = f"{__name__}.report", f"{__name__}.quiet"
"""Keys of click's context for the document of ``--json`` and for the flag of ``--quiet``."""

FAILURE, USAGE, INTERRUPTED = 1, 2, 130
"""Exit statuses: numerical failure, no compiler or no file written; invalid input; Ctrl-C."""


class CommandFailure(click.ClickException):
    """Error of a command: a message for the user and an exit status."""

    def __init__(self, message: str, status: int = FAILURE) -> None:
        super().__init__(message)
        self.status = status

    @property
    def exit_code(self) -> int:  # type: ignore[override]  # click's is a class variable
        """Exit status of the command."""
        return self.status


class Commands(click.Group):
    """Command group that imports the module ``folder``.NAME, or that of an extra, for the function NAME of a command.

    The module of a command can therefore import what it needs at the top, while ``--help`` imports none of them. Every
    error that a user can cause becomes one message and an exit status.
    """

    def __init__(self, *words: Any, folder: str, about: Mapping[str, str], **settings: Any) -> None:
        super().__init__(*words, **settings)
        added = {name: text for extra in EXTRAS.values() for name, text in extra.commands.items()}
        self.folder, self.own, self.about = folder, about, {**about, **added}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in alphabetical order."""
        return sorted(self.about)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a name; imports its module."""
        if cmd_name not in self.about:
            return None
        if cmd_name not in self.own:
            return part("commands", cmd_name)  # type: ignore[no-any-return]
        command: click.Command = getattr(import_module(f"{self.folder}.{cmd_name}"), cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the arguments name; propose the closest name for an unknown one."""
        if args and args[0] not in self.about and not args[0].startswith("-"):
            hint = closest(args[0], self.about)
            ctx.fail(f"there is no command '{args[0]}'{hint} Known: {', '.join(sorted(self.about))}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands of the overview."""
        with formatter.section("Commands"):
            formatter.write_dl(sorted(self.about.items()))

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Offer names of commands for shell completion."""
        names = [name for name in sorted(self.about) if name.startswith(incomplete)]
        result = [CompletionItem(name, help=self.about[name]) for name in names]
        return [*result, *click.Command.shell_complete(self, ctx, incomplete)]

    def main(self, *arguments: Any, **named: Any) -> Any:
        """Run with writable streams, also if a shell closed them (``2>&-``)."""
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:
                nowhere = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  (as long as the process)
                setattr(sys, name, nowhere)
        return super().main(*arguments, **named)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; convert errors into messages and exit statuses, with ``--json`` also into a document."""
        arguments = [*ctx.args]
        if "--json" in arguments:  # before arguments are read, whose errors it contains
            _begin_report(ctx, None, as_json=True)
        try:
            with errors_as_messages(arguments):
                return super().invoke(ctx)
        except click.ClickException as error:
            if REPORT in ctx.meta:
                ctx.meta[REPORT]["error"] = _described(error)
            raise


def _in_flags(message: str, arguments: Sequence[str]) -> str:
    """Return a message that names options by the flags of the command line, where these have set them.

    ``[run] save_every`` is ``--save-every``.
    """
    flags = {word.partition("=")[0] for word in arguments if word.startswith("--")}
    if not flags:
        return message
    from scvi_codegen.codegen.native.option_table import METHOD
    from scvi_codegen.interfaces.models.options import OPTIONS

    for option in reversed(OPTIONS):  # the name of a method last, whose section has other options
        if option.section and not flags.isdisjoint(option.flag.split("/")):
            key = "" if option.is_section else r"( method\b)?" if option.kind == METHOD else rf" {option.key}\b"
            message = re.sub(rf"\[{option.section}\]{key}", option.flag, message)
    return re.sub(r"(--[\w-]+) (?=[,.;:)])", r"\1", message)


def _described(error: click.ClickException) -> dict[str, Any]:
    """Return the type, the message, the exit status, and the numbers and texts that are attributes of its causes."""
    fields: dict[str, Any] = {}
    cause = error.__cause__
    while cause is not None:
        fields = {name: value for name, value in vars(cause).items() if isinstance(value, str | int | float)} | fields
        cause = cause.__cause__
    kind = type(error.__cause__ or error).__name__
    return {"type": kind, "message": error.format_message(), "exit_status": error.exit_code} | fields


@contextmanager
def errors_as_messages(arguments: Sequence[str] = ()) -> Iterator[None]:
    """Convert errors that a user can cause into one message and an exit status, and warnings into lines.

    Messages name options by the flags among the arguments of the command line.
    """
    try:
        with _warnings_as_lines(), speaking("command"):
            yield
    except (StepFailedError, UnresolvedError, PathError, BuildError, RecordingError) as error:
        raise CommandFailure(str(error)) from error
    except click.ClickException as error:
        if type(error) is click.ClickException:  # of an extra
            raise CommandFailure(error.message) from None
        raise
    except ScviCodegenError as error:
        cause = error.__cause__
        unwritten = isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError)
        raise CommandFailure(_in_flags(str(error), arguments), FAILURE if unwritten else USAGE) from error
    except BrokenPipeError:
        raise
    except OSError as error:
        raise CommandFailure(str(error)) from error
    except MemoryError as error:
        raise CommandFailure("not enough memory") from error
    except KeyboardInterrupt as error:
        raise CommandFailure(str(error) or "interrupted", INTERRUPTED) from error


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """Print each warning of this package once, as one line."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *location: Any, **more: Any) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            click.echo(f"Warning: {message}", err=True)

    with warnings.catch_warnings():
        for kind in (MethodWarning, AccuracyWarning, SystemDefinitionWarning):
            warnings.simplefilter("always", kind)
        warnings.showwarning = show
        yield


def reporting(command: Command) -> Command:
    """Add the options ``--json`` and ``--quiet``, which :func:`tell` obeys, to a command."""
    flag = partial(click.option, is_flag=True, expose_value=False)
    as_json = flag("--json", callback=_begin_report, help="Print one JSON document instead of text.")
    quiet = flag("--quiet", callback=_be_quiet, help="Print only errors and warnings; see the exit status.")
    return quiet(as_json(command))


def _begin_report(context: click.Context, parameter: click.Parameter | None, as_json: bool) -> None:
    if not as_json or REPORT in context.meta:
        return
    report: dict[str, Any] = {}
    context.meta[REPORT] = report

    def print_report() -> None:
        if report:
            click.echo(json.dumps(_plain(report), indent=1))

    context.call_on_close(print_report)


def _be_quiet(context: click.Context, parameter: click.Parameter, quiet: bool) -> None:
    context.meta[QUIET] = quiet
    if quiet:
        context.with_resource(announce_to(lambda _: None))


def is_quiet() -> bool:
    """Return True if the running command, if any, has the option ``--quiet``."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(QUIET))


def note(text: str) -> None:
    """Print a remark to stderr, unless ``--quiet``."""
    if not is_quiet():
        click.echo(text, err=True)


def tell(text: str = "", /, *, nl: bool = True, **numbers: Any) -> None:
    """Print a text; with ``--json`` add the numbers to the document that is printed at the end, also after an error."""
    meta = click.get_current_context().meta
    if REPORT in meta:
        meta[REPORT] |= numbers
    elif text and not is_quiet():
        click.echo(text, nl=nl)


def _plain(value: Any) -> Any:
    """Return a value in the types of JSON: NaN and infinity as ``None``, arrays as lists, paths as strings."""
    if hasattr(value, "tolist"):  # of NumPy, which is not imported here
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def check_writable(path: Path, hint: str, *, states: bool = False) -> None:
    """Raise an error of usage unless a file can be written; ``hint`` names the option that requires it.

    Called before long computations; of a file of ``states`` format and library are checked, too.
    """
    if states:
        from scvi_codegen.runs.results.export import check_format  # not needed for --help

        check_format(path)
    if path.is_dir() and path.suffix.lower() != ".zarr":
        raise click.BadParameter(f"'{path}' is a folder", param_hint=hint)
    if not path.parent.is_dir():
        raise click.BadParameter(f"there is no folder '{path.parent}'", param_hint=hint)
    if not os.access(path.parent, os.W_OK):
        raise click.BadParameter(f"the folder '{path.parent}' is not writable", param_hint=hint)
