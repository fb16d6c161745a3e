"""The argument MODEL and the options that override it, converted to a :class:`Model`."""

import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.mechanics.time_transformation import CONTROLLERS
from scvi_codegen.methods import ARGUMENTS, METHODS, size_of, specification_of
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_files.model_file import catalogue_model, load_model
from scvi_codegen.models.model_files.sections import event_entry
from scvi_codegen.models.problems import PROBLEMS, problem

Command = TypeVar("Command", bound=Callable[..., Any])

METHOD_CHOICES = (
    *("method", "degree", "stages", "order", "nodes", "quadrature", "space", "form", "variational", "abscissae"),
)
"""Options that specify the method."""
MOST_COORDINATES = 2000
"""Largest number of coordinates of an array model that is compiled with its sizes: its equations are unrolled."""
OFFERED_SIZES = range(1, 17)
"""Numbers that shell completion offers after ``svi:``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelOptions:
    """Options of the command line that override MODEL; ``None`` or an empty tuple for options that are absent."""

    method: str | None
    degree: int | None
    stages: int | None
    order: int | None
    nodes: str | None
    quadrature: str | None
    space: str | None
    form: str | None
    variational: bool | None
    abscissae: tuple[float, ...] | str | None
    parameter: tuple[tuple[str, float], ...]
    q: tuple[float, ...] | None
    p: tuple[float, ...] | None
    velocity: tuple[float, ...] | None
    time: float | None
    step: float | None
    span: float | None
    steps: int | None
    save_every: int | None
    time_transformation: str | None = None
    controller: str | None = None
    inputs: tuple[tuple[str, dict[str, str]], ...] | None = None
    size: tuple[tuple[str, int], ...] | None = None
    event: tuple[str, ...] | None = None
    solver: str = "auto"

    def sections(self) -> dict[str, dict[str, Any]]:
        """Return the options as sections of a model file."""
        named: dict[str, dict[str, Any]] = {
            "system": {"time_transformation": self.time_transformation},
            "initial": {"q": self.q, "p": self.p, "q_dot": self.velocity, "t": self.time},
            "method": {
                **{name: getattr(self, name) for name in METHOD_CHOICES},
                "solver": None if self.solver == "auto" else self.solver,
            },
            "run": {name: getattr(self, name) for name in ("step", "span", "steps", "save_every", "controller")},
            "parameters": dict(self.parameter),
            "inputs": dict(self.inputs or ()),
            "sizes": dict(self.size or ()),
        }
        arguments = {
            name: {key: _plain(x) for key, x in section.items() if x is not None} for name, section in named.items()
        }
        events: dict[str, Any] = {"events": [event_entry(text) for text in self.event or ()]}
        return {name: section for name, section in (arguments | events).items() if section}


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


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
) -> tuple[tuple[str, dict[str, str]], ...]:
    """Return NAME=FILE[:KIND] as entries of the section [inputs]; paths are relative to the working directory."""
    result = []
    for text in values:
        name, _, arguments = (part.strip() for part in text.partition("="))
        match = re.fullmatch(r"(?P<file>.+?\.\w+)(:(?P<kind>[a-z]+))?", arguments)
        if not name or not match:
            raise click.BadParameter(f"'{text}' is not of the form NAME=FILE[:KIND], as in u=u.csv:cubic")
        entry = {key: value for key, value in match.groupdict().items() if value is not None}
        result.append((name, entry | {"file": str(Path(entry["file"]).absolute())}))
    return tuple(result)


def _option(*names: str, **settings: Any) -> Callable[[Command], Command]:
    return click.option(*names, **settings)


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
    _option(
        "--method",
        metavar="NAME",
        shell_complete=complete_method,
        help="Method, with its degree or number of stages: svi:6, gauss:3, .. (see 'scvi-codegen methods').",
    ),
    _option(
        "--degree",
        type=int,
        metavar="N",
        help="Degree of the trial curve (svi, scvi, sc), as in svi:N.",
    ),
    _option("--stages", type=int, metavar="N", help="Number of stages (gauss, radau-iia, ..), as in gauss:N."),
    _option(
        "--order",
        type=int,
        metavar="N",
        help="Order of a composition of Stoermer-Verlet: 2, 8 or 10.",
    ),
    _option("--quadrature", metavar="NAME:N", help="Quadrature, as in gauss-legendre:8 or clenshaw-curtis:9."),
    _option("--nodes", metavar="NAME", help="Nodes: chebyshev-lobatto, legendre-lobatto or equispaced."),
    _option(
        "--space",
        metavar="NAME",
        help="Trial space of an SVI: polynomials, trigonometric:RADIANS_A_STEP[:HARMONICS] or splines:PIECES.",
    ),
    _option("--form", metavar="NAME", help="phase-space or position (sc and Runge-Kutta methods)."),
    _option(
        "--variational/--printed",
        default=None,
        help="SCVI: the variational method, or the form printed in the paper, which is not symplectic.",
    ),
    _option(
        "--abscissae",
        metavar="C1,C2,..",
        callback=_numbers_or_name,
        help="Abscissae in [0, 1] (collocation, scvi); scvi also: gauss, radau-iia, lobatto-iiia, ..",
    ),
)
STATE_OPTIONS = (
    _option(
        "--parameter",
        multiple=True,
        metavar="NAME=VALUE",
        callback=_assignments,
        help="Value of a parameter; may be repeated.",
    ),
    _option(
        "--input",
        "inputs",
        multiple=True,
        metavar="NAME=FILE[:KIND]",
        callback=_input_files,
        help="Tabulated input: columns t and value of a .csv or .npz file, interpolated constant, linear (default) or "
        "cubic; may be repeated.",
    ),
    _option(
        "--size",
        multiple=True,
        metavar="NAME=N",
        callback=_sizes,
        help="Array size of an array model, as N=1000; may be repeated.",
    ),
    _option(
        "--event",
        multiple=True,
        metavar="G[; NAME=VALUE]..",
        help="Zero crossing of G that changes the state, as 'y; direction=-1; p_y=-0.8*p_y', or of a wall, as "
        "'y; restitution=0.8; where=x > 0'; terminal=N ends the run at the N-th; may be repeated.",
    ),
    _option("--q", metavar="Q1,Q2,..", callback=_numbers, help="Initial coordinates."),
    _option("--p", metavar="P1,P2,..", callback=_numbers, help="Initial momenta."),
    _option("--velocity", metavar="V1,V2,..", callback=_numbers, help="Initial velocities, instead of momenta."),
    _option("--time", type=float, metavar="T", help="Initial time."),
    _option("--step", type=float, metavar="H", help="Fixed step size (of tau, if transformed); negative: backward."),
    _option("--span", type=float, metavar="T", help="Duration of the run."),
    _option("--steps", type=int, metavar="N", help="Number of steps, instead of --span."),
    _option("--save-every", type=int, metavar="N", help="Save every N-th state."),
    _option(
        "--time-transformation",
        metavar="G",
        help="Time transformation dt = G dtau: frequency, distance, potential, arclength or a formula.",
    ),
    _option(
        "--controller",
        type=click.Choice(CONTROLLERS),
        help="With --time-transformation: symplectic (default; energy must be conserved), or reversible (any system).",
    ),
)


SOLVER_OPTION = _option(
    "--solver",
    type=click.Choice(["auto", "fixed-point", "newton", "explicit"]),
    default="auto",
    show_default=True,
    help="Solver of the stage equations; auto: explicit or fixed-point iteration if possible, Newton as fallback; "
    "by default that of the model file.",
)


def model_arguments(command: Command, *, required: bool = True) -> Command:
    """Add the argument MODEL and the options of :class:`ModelOptions` to a command."""
    for option in reversed((*METHOD_OPTIONS, *STATE_OPTIONS)):
        command = option(command)
    return click.argument(
        "model_name",
        metavar="MODEL" if required else "[MODEL]",
        required=required,
        shell_complete=complete_model,
    )(command)


def _check_method(choices: ModelOptions) -> None:
    """Reject options that the chosen method does not take or that contradict the number in its name."""
    if choices.method is None:
        return
    message = specification_of(choices.method)
    taken = ARGUMENTS[message["method"]]
    for option in METHOD_CHOICES[1:]:
        value = getattr(choices, option)
        if value is not None and option not in taken:
            takes = ", ".join(f"--{one}" for one in taken if one in METHOD_CHOICES) or "no options"
            raise click.UsageError(f"--method {choices.method} takes no --{option}; it takes {takes}")
        if value is not None and message.get(option, value) != value:
            raise click.UsageError(
                f"--method {choices.method} and --{option} {value} contradict each other: leave one of them out"
            )


def read_model(name: str, choices: ModelOptions) -> Model:
    """Return the model of a file or of the catalogue, overridden by the options of the command line.

    Raises:
        click.UsageError: if options exclude or contradict each other, or are not options of the chosen method.
        ScviCodegenError: as reading and building the model do.
    """
    if choices.p is not None and choices.velocity is not None:
        raise click.UsageError("--p and --velocity exclude each other")
    if choices.span is not None and choices.steps is not None:
        raise click.UsageError("--span and --steps exclude each other")
    _check_method(choices)
    path = Path(name)
    if path.suffix.lower() == ".toml" or os.sep in name or path.is_file():
        return load_model(path, choices.sections())
    if name.partition(":")[0] not in PROBLEMS:
        try:
            problem(name)
        except SystemDefinitionError as error:
            raise SystemDefinitionError(f"{error} (There is no model file '{name}' either.)") from error
    return catalogue_model(name, choices.sections())


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
