"""What all commands share: the group that finds them, errors as one line and an exit status, files to be written.

A command whose result is of use to a program has :func:`reporting` above it and tells by :func:`tell` what it finds, in
words and in numbers: people read the words, ``--json`` prints the numbers, ``--quiet`` neither.
"""

from __future__ import annotations

import json
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from scvi_codegen.errors import (
    AccuracyWarning,
    BuildError,
    MethodWarning,
    RecordingError,
    ScviCodegenError,
    StepFailedError,
    closest,
)
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.models.meant import EVENTS
from scvi_codegen.native.waiting import told_to

__all__ = [
    "FAILURE",
    "INTERRUPTED",
    "USAGE",
    "CommandFailure",
    "Commands",
    "check_writable",
    "emit",
    "is_quiet",
    "note",
    "reporting",
    "tell",
]

Command = TypeVar("Command", bound=Callable[..., Any])
REPORT, QUIET = f"{__name__}.report", f"{__name__}.quiet"
"""Where a command keeps what ``--json`` is to print, and whether it is to be silent."""

FAILURE, USAGE, INTERRUPTED = 1, 2, 130
"""Exit statuses: numerical failure or no compiler; faulty input; Ctrl-C."""


class CommandFailure(click.ClickException):
    """A message for people, and the exit status of the command."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status

    @property
    def exit_code(self) -> int:  # type: ignore[override]  # click's is a class variable
        """The status."""
        return self.status


class Commands(click.Group):
    """A command NAME is the function of that name in the module NAME of a folder, imported when it is called.

    So a module imports what its command needs in plain words, and the overview waits for none of it. Whatever error a
    user can meet becomes one message and an exit status.
    """

    def __init__(self, *words: Any, folder: str, about: Mapping[str, str], **settings: Any) -> None:
        super().__init__(*words, **settings)
        self.folder, self.about = folder, about

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in alphabetical order."""
        return sorted(self.about)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of a name, imported here."""
        if cmd_name not in self.about:
            return None
        command: click.Command = getattr(import_module(f"{self.folder}.{cmd_name}"), cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that the words name; one that is misspelt is told the nearest."""
        if args and args[0] not in self.about and not args[0].startswith("-"):
            hint = closest(args[0], self.about)
            ctx.fail(f"there is no command '{args[0]}'{hint} Known: {', '.join(sorted(self.about))}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The part of the overview that lists the commands."""
        with formatter.section("Commands"):
            formatter.write_dl(sorted(self.about.items()))

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """What a shell offers for the beginning of a name."""
        names = [name for name in sorted(self.about) if name.startswith(incomplete)]
        found = [CompletionItem(name, help=self.about[name]) for name in names]
        return [*found, *click.Command.shell_complete(self, ctx, incomplete)]

    def main(self, *given: Any, **named: Any) -> Any:
        """Run with streams that can be written, also where a shell closed them (``2>&-``)."""
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:
                nowhere = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  (as long as the process)
                setattr(sys, name, nowhere)
        return super().main(*given, **named)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; errors become messages."""
        try:
            with _warnings_as_lines():
                return super().invoke(ctx)
        except click.NoSuchOption as error:
            if error.option_name not in ("--event", "--events"):
                raise
            raise click.UsageError(f"there is no option '{error.option_name}': {EVENTS}", error.ctx) from error
        except (StepFailedError, BuildError, RecordingError) as error:
            raise CommandFailure(str(error), FAILURE) from error
        except ScviCodegenError as error:
            cause = error.__cause__
            unwritten = isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError)
            raise CommandFailure(str(error), FAILURE if unwritten else USAGE) from error
        except BrokenPipeError:
            raise
        except OSError as error:
            raise CommandFailure(str(error), FAILURE) from error
        except MemoryError as error:
            raise CommandFailure("there is not enough memory for that", FAILURE) from error
        except KeyboardInterrupt as error:
            raise CommandFailure("interrupted", INTERRUPTED) from error


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """Show the warnings of this package as one line each, once."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            click.echo(f"Warning: {message}", err=True)

    with warnings.catch_warnings():
        for kind in (MethodWarning, AccuracyWarning):
            warnings.simplefilter("always", kind)
        warnings.showwarning = show
        yield


def reporting(command: Command) -> Command:
    """Give a command the options ``--json`` and ``--quiet``, which :func:`tell` obeys."""
    options = (
        click.option(
            *("--json", "as_json"),
            is_flag=True,
            expose_value=False,
            callback=_begin_report,
            help="Print one JSON document in place of text.",
        ),
        click.option(
            *("--quiet", "quiet"),
            is_flag=True,
            expose_value=False,
            callback=_be_quiet,
            help="Print nothing but errors and warnings; the exit status tells.",
        ),
    )
    for option in options:
        command = option(command)
    return command


def _begin_report(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    if not wanted:
        return
    report: dict[str, Any] = {}
    context.meta[REPORT] = report

    def print_report() -> None:
        if report:
            click.echo(json.dumps(_plain(report), indent=1))

    context.call_on_close(print_report)


def _be_quiet(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    context.meta[QUIET] = wanted
    if wanted:
        context.with_resource(told_to(lambda _: None))


def is_quiet() -> bool:
    """Whether the command that runs, if one does, was told to be."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(QUIET))


def note(text: str) -> None:
    """Say on stderr what goes on beside the result."""
    if not is_quiet():
        click.echo(text, err=True)


def tell(text: str = "", /, *, nl: bool = True, **numbers: Any) -> None:
    """Say a text, or with ``--json`` have the numbers in the document printed at the end, also after an error."""
    meta = click.get_current_context().meta
    if REPORT in meta:
        meta[REPORT] |= numbers
    elif text and not is_quiet():
        click.echo(text, nl=nl)


def _plain(value: Any) -> Any:
    """As JSON has it, which knows no NaN, infinity or number of NumPy's: ``None`` where there is no number."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def check_writable(path: Path, hint: str) -> None:
    """Find out before long work whether its result can be written; ``hint`` names the option that wants it."""
    if path.is_dir() and path.suffix.lower() != ".zarr":
        raise click.BadParameter(f"'{path}' is a folder", param_hint=hint)
    if not path.parent.is_dir():
        raise click.BadParameter(f"there is no folder '{path.parent}'", param_hint=hint)
    if not os.access(path.parent, os.W_OK):
        raise click.BadParameter(f"the folder '{path.parent}' cannot be written", param_hint=hint)


def emit(text: str, /, output: str | None, **numbers: Any) -> None:
    """Print a text, or write it to a file whole or not at all; ``numbers`` as for :func:`tell`."""
    if output is None:
        tell(text, **numbers)
        return
    check_writable(Path(output), "'-o'")
    data = (text.rstrip("\n") + "\n").encode()
    write_atomically(output, lambda file: file.write(data))
    tell(**numbers, written=[output])
    note(f"wrote {output}")
