"""The argument MODEL and the options that override it, converted to a :class:`Model`."""

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from scvi_codegen.cli.command_group import Command
from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.mechanics.time_transformation import CONTROLLERS
from scvi_codegen.methods import ARGUMENTS, METHODS, size_of, specification_of
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_files.model_file import catalogue_model, load_model
from scvi_codegen.models.model_files.sections import event_entry
from scvi_codegen.models.problems import PROBLEMS, problem

METHOD_CHOICES = (
    *("method", "degree", "stages", "order", "nodes", "quadrature", "space", "form", "variational", "abscissae"),
)
"""Options that specify the method."""
MOST_COORDINATES = 2000
"""Largest number of coordinates of an array model that is compiled with its sizes: its equations are unrolled."""
INITIAL = {"q": "q", "p": "p", "q_dot": "velocity", "t": "time"}
"""Options of the initial state by the key of the section."""
Choices = Mapping[str, Any]
"""Options of the command line that override MODEL, by name; ``None`` or an empty tuple for options that are absent."""
OFFERED_SIZES = range(1, 17)
"""Numbers that shell completion offers after ``svi:``."""


def sections_of(choices: Choices) -> dict[str, dict[str, Any]]:
    """Return the options as sections of a model file."""
    solver = choices.get("solver", "auto")
    named: dict[str, dict[str, Any]] = {
        "system": {"time_transformation": choices.get("time_transformation")},
        "initial": {key: choices.get(name) for key, name in INITIAL.items()},
        "method": {name: choices.get(name) for name in METHOD_CHOICES}
        | {"solver": None if solver == "auto" else solver},
        "run": {name: choices.get(name) for name in ("step", "span", "steps", "save_every", "controller")},
        "parameters": dict(choices.get("parameter", ())),
        "inputs": dict(choices.get("inputs") or ()),
        "sizes": dict(choices.get("size") or ()),
    }
    arguments = {
        name: {key: list(x) if isinstance(x, tuple) else x for key, x in section.items() if x is not None}
        for name, section in named.items()
    }
    events: dict[str, Any] = {"events": [event_entry(text) for text in choices.get("event") or ()]}
    return {name: section for name, section in (arguments | events).items() if section}


def _numbers(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        return tuple(float(word) for word in re.split(r"[,\s]+", value.strip()))
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
        name, equals, number = (part.strip() for part in text.partition("="))
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not name or not equals or not math.isfinite(value):
            raise click.BadParameter(f"'{text}' is not of the form NAME=VALUE, as in g=9.81")
        result.append((name, value))
    return tuple(result)


def _sizes(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> tuple[tuple[str, int], ...]:
    for name, value in (assignments := _assignments(context, parameter, values)):
        if not value.is_integer():
            raise click.BadParameter(f"the size {name} must be an integer, not {value:g}")
    return tuple((name, int(value)) for name, value in assignments)


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
        result.append((name, entry | {"file": str(Path(entry["file"]).absolute())}))
    return tuple(result)


def complete_method(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer names of methods for shell completion; after a colon with degree, number of stages or order."""
    name, colon, _ = incomplete.partition(":")
    offered = [f"{name}:{number}" for number in OFFERED_SIZES] if colon and size_of(name) else METHODS
    return [CompletionItem(one) for one in offered if one.startswith(incomplete)]


def complete_model(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer files and names of the catalogue for shell completion; files first, as bash requires."""
    names = [CompletionItem(name) for name in PROBLEMS if name.startswith(incomplete)]
    return [CompletionItem(incomplete, type="file"), *names]


METHOD_OPTIONS = (
    click.option(
        "--method",
        metavar="NAME",
        shell_complete=complete_method,
        help="Method, with its degree or number of stages: svi:6, gauss:3, .. (see 'scvi-codegen methods').",
    ),
    click.option("--degree", type=int, metavar="N", help="Degree of the trial curve (svi, scvi, sc), as in svi:N."),
    click.option("--stages", type=int, metavar="N", help="Number of stages (gauss, radau-iia, ..), as in gauss:N."),
    click.option("--order", type=int, metavar="N", help="Order of a composition of Stoermer-Verlet: 2, 4, 6, 8 or 10."),
    click.option("--quadrature", metavar="NAME:N", help="Quadrature, as in gauss-legendre:8 or clenshaw-curtis:9."),
    click.option("--nodes", metavar="NAME", help="Nodes: chebyshev-lobatto, legendre-lobatto or equispaced."),
    click.option(
        "--space",
        metavar="NAME",
        help="Trial space of an SVI: polynomials, trigonometric:RADIANS_A_STEP[:HARMONICS] or splines:PIECES.",
    ),
    click.option("--form", metavar="NAME", help="phase-space or position (sc and Runge-Kutta methods)."),
    click.option(
        "--variational/--printed",
        default=None,
        help="SCVI: the variational method, or the form printed in the paper, which is not symplectic.",
    ),
    click.option(
        "--abscissae",
        metavar="C1,C2,..",
        callback=_numbers_or_name,
        help="Abscissae in [0, 1] (collocation, scvi); scvi also: gauss, radau-iia, lobatto-iiia, ..",
    ),
)
STATE_OPTIONS = (
    click.option(
        "--parameter",
        multiple=True,
        metavar="NAME=VALUE",
        callback=_assignments,
        help="Value of a parameter; may be repeated.",
    ),
    click.option(
        "--input",
        "inputs",
        multiple=True,
        metavar="NAME=FILE[:KIND]",
        callback=_input_files,
        help="Tabulated input: columns t and value of a .csv or .npz file, interpolated constant, linear (default) or "
        "cubic; or a number, NAME=NUMBER; may be repeated.",
    ),
    click.option(
        "--size",
        multiple=True,
        metavar="NAME=N",
        callback=_sizes,
        help="Array size of an array model, as N=1000; may be repeated.",
    ),
    click.option(
        "--event",
        multiple=True,
        metavar="G[; NAME=VALUE]..",
        help="Zero crossing of G that changes the state, as 'y; direction=-1; p_y=-0.8*p_y', or of a wall, as "
        "'y; restitution=0.8; where=x > 0'; terminal=N ends the run at the N-th; may be repeated.",
    ),
    click.option("--q", metavar="Q1,Q2,..", callback=_numbers, help="Initial coordinates."),
    click.option("--p", metavar="P1,P2,..", callback=_numbers, help="Initial momenta."),
    click.option("--velocity", metavar="V1,V2,..", callback=_numbers, help="Initial velocities, instead of momenta."),
    click.option("--time", type=float, metavar="T", help="Initial time."),
    click.option(
        "--step", type=float, metavar="H", help="Fixed step size (of tau, if transformed); negative: backward."
    ),
    click.option("--span", type=float, metavar="T", help="Duration of the run."),
    click.option("--steps", type=int, metavar="N", help="Number of steps, instead of --span."),
    click.option("--save-every", type=int, metavar="N", help="Save every N-th state."),
    click.option(
        "--time-transformation",
        metavar="G",
        help="Time transformation dt = G dtau: frequency, distance, potential, arclength or a formula.",
    ),
    click.option(
        "--controller",
        type=click.Choice(CONTROLLERS),
        help="With --time-transformation: symplectic (default; energy must be conserved), or reversible (any system).",
    ),
)


SOLVER_OPTION = click.option(
    "--solver",
    type=click.Choice(["auto", "fixed-point", "newton", "explicit"]),
    default="auto",
    show_default=True,
    help="Solver of the stage equations; auto: explicit or fixed-point iteration if possible, Newton as fallback; "
    "by default that of the model file.",
)


def model_arguments(command: Command, *, required: bool = True) -> Command:
    """Add the argument MODEL and the options that override it to a command."""
    for option in reversed((*METHOD_OPTIONS, *STATE_OPTIONS)):
        command = option(command)
    return click.argument(
        "model_name", metavar="MODEL" if required else "[MODEL]", required=required, shell_complete=complete_model
    )(command)


def _check_method(choices: Choices) -> None:
    """Reject options that the chosen method does not take or that contradict the number in its name."""
    method = choices.get("method")
    if method is None:
        return
    message = specification_of(method)
    taken = ARGUMENTS[message["method"]]
    for option in METHOD_CHOICES[1:]:
        value = choices.get(option)
        if value is not None and option not in taken:
            takes = ", ".join(f"--{one}" for one in taken if one in METHOD_CHOICES) or "no options"
            raise click.UsageError(f"--method {method} takes no --{option}; it takes {takes}")
        if value is not None and message.get(option, value) != value:
            raise click.UsageError(
                f"--method {method} and --{option} {value} contradict each other: leave one of them out"
            )


def read_model(name: str, choices: Choices) -> Model:
    """Return the model of a file or of the catalogue, overridden by the options of the command line.

    Raises:
        click.UsageError: if options exclude or contradict each other, or are not options of the chosen method.
        ScviCodegenError: as reading and building the model do.
    """
    if choices.get("p") is not None and choices.get("velocity") is not None:
        raise click.UsageError("--p and --velocity exclude each other")
    if choices.get("span") is not None and choices.get("steps") is not None:
        raise click.UsageError("--span and --steps exclude each other")
    _check_method(choices)
    path = Path(name)
    if path.suffix.lower() == ".toml" or os.sep in name or path.is_file():
        return load_model(path, sections_of(choices))
    if name.partition(":")[0] not in PROBLEMS:
        try:
            problem(name)
        except SystemDefinitionError as error:
            raise SystemDefinitionError(f"{error} (There is no model file '{name}' either.)") from error
    return catalogue_model(name, sections_of(choices))


def with_known_sizes(model: Model, option: str) -> Model:
    """Return the model of named coordinates that an option requires.

    Raises:
        click.UsageError: if there are too many of them.
    """
    if model.array_system is not None and model.dimension > MOST_COORDINATES:
        raise click.UsageError(
            f"{option} compiles an array model with its sizes, which is limited to {MOST_COORDINATES} coordinates: "
            f"omit {option}, or reduce the sizes ({model.dimension} coordinates here)"
        )
    return model.with_known_sizes()
