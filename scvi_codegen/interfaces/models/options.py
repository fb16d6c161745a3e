"""Options of a run, one entry each: key of model files, flag of the command line, field of models, check and messages.

From an entry come the fields of a :class:`Model`, their checks, the reading and writing of model files, the flags of
the commands with an argument MODEL, the JSON of ``run`` and the arguments of runs (docs/extending.md).
"""

import dataclasses
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from itertools import combinations
from numbers import Real
from typing import Any, NamedTuple

from scvi_codegen.codegen.rendering.source import AUTO, DOUBLE_DOUBLE, PRECISIONS
from scvi_codegen.codegen.variants import SUMS
from scvi_codegen.common.errors import ModelFileError
from scvi_codegen.common.validation import LARGEST_COUNT, NUMERAL, TOLERANCE_RANGE, ExactNumber, checked_count
from scvi_codegen.methods.controllers import CONTROLLERS, SYMPLECTIC
from scvi_codegen.runs.ensembles.observation import OBSERVED
from scvi_codegen.runs.stepping.noise import LARGEST_SEED

NUMBER, COUNT, TEXT, CHOICE, SWITCH, METHOD = "number", "count", "text", "choice", "switch", "method"
NUMBERS, NUMBERS_OR_NAME, NUMBER_OR_NAMED = "numbers", "numbers or name", "number, or numbers by name"
ASSIGNMENTS, INPUTS, SIZES, EVENTS = "assignments", "inputs", "sizes", "events"
"""Kinds of values of an option; those of the last four are a section of a model file."""
LARGEST_TOLERANCE = 0.1
"""Largest relative update with which the iteration of a step may end: beyond it, the equations are not solved."""


class Alternatives(NamedTuple):
    """Group of options of which at most one is given, or exactly one, and what they determine."""

    purpose: str
    required: bool = True


STEP_SIZE = Alternatives("the step size", required=False)
DURATION, VELOCITY = Alternatives("the duration"), Alternatives("the velocity")
IN_ENSEMBLE, WITH_INPUTS = "with --ensemble", "for systems with inputs"
"""Situations in which some options are not available."""


@dataclass(frozen=True, slots=True)
class Option:
    """Option of a run.

    Attributes:
        section: section of model files, "" for an option of the command line alone.
        kind: of its value.
        metavar, help: description of the flag.
        name: parameter of commands; the flag is ``--name`` with hyphens unless ``flag`` is another.
        key, field: key in the section and field of a model, by default the name.
        determines: what this option and its alternatives determine.
        brief: its name among alternatives in messages, by default the field.
        least, most: smallest and largest value of a count.
        choices: values of a choice.
        default: value that means the same as no value.
        valid, invalid: condition on a number, and the message with ``{value:g}`` if it is not met.
        unavailable: situations in which the option is not available, with a remedy or the reason.
        solver_option: field of :class:`~scvi_codegen.SolverOptions` that it sets.
        common: whether all commands with an argument MODEL have it.
    """

    section: str
    kind: str
    metavar: str
    help: str
    name: str = ""
    key: str = ""
    field: str = ""
    flag: str = ""
    determines: Alternatives | None = None
    brief: str = ""
    least: int = 0
    most: int = LARGEST_COUNT
    choices: tuple[str, ...] = ()
    default: str | None = None
    valid: Callable[[float], bool] = math.isfinite
    invalid: str = ""
    unavailable: Mapping[str, str] = dataclasses.field(default_factory=dict, hash=False)
    solver_option: str = ""
    common: bool = True

    def named(self, name: str) -> "Option":
        """Return the option with this field, which is also the default of its other names."""
        name, attribute = self.name or name, self.field or name
        flag = self.flag or f"--{name.replace('_', '-')}"
        return replace(self, name=name, field=attribute, key=self.key or name, flag=flag, brief=self.brief or attribute)

    @property
    def is_section(self) -> bool:
        """Return whether the values of the option are a section of a model file."""
        return self.kind in (ASSIGNMENTS, INPUTS, SIZES, EVENTS)

    def read(self, value: Any, where: str) -> Any:
        """Return a value of the kind of the option, or raise :class:`ModelFileError` that begins with ``where``."""
        if self.kind == COUNT:
            return checked_count(value, where, least=self.least, most=self.most, error=ModelFileError)
        if self.kind == SWITCH:
            if not isinstance(value, bool):
                raise ModelFileError(f"{where} must be true or false, not {value!r}")
            return value
        if self.kind == NUMBER_OR_NAMED and isinstance(value, Mapping):
            return {str(name): float(real(number, f"{where} of {name}")) for name, number in value.items()}
        return float(real(value, where))

    def checked(self, value: Any) -> Any:
        """Return a value of a field, or raise :class:`ModelFileError` with the message of the option."""
        value = self.read(value, self.field)
        for number in value.values() if isinstance(value, Mapping) else (value,):
            if not self.valid(number):
                raise ModelFileError(self.invalid.format(value=number))
        return value


def run_option(section: str, kind: str, metavar: str, help: str, *, default: Any = None, **further: Any) -> Any:  # noqa: A002
    """Return a field of :class:`RunOptions` with the description of its option."""
    return dataclasses.field(default=default, metadata={"option": Option(section, kind, metavar, help, **further)})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunOptions:
    """Options of a run that are fields of a :class:`Model`: the entries of the table for steps and saved states."""

    t: float = run_option("initial", NUMBER, "T", "Initial time.", name="time", key="t", default=0.0)
    h: float | None = run_option(
        *("run", NUMBER, "H", "Fixed step size (of tau, if transformed); negative: backward."),
        name="step",
        determines=STEP_SIZE,
        brief="h (step: fixed step size)",
        valid=bool,
        invalid="the step size is 0: it must be positive, or negative for a run backward in time",
    )
    tolerance: float | None = run_option(
        *("run", NUMBER, "X"),
        "Adaptive step size with this relative local error (1e-16: round-off). With --time-transformation: a fixed "
        "step of tau is chosen for it.",
        determines=STEP_SIZE,
        brief="tolerance (error of each adaptive step)",
        valid=lambda value: 0.0 < value < 1.0,
        invalid=TOLERANCE_RANGE,
        common=False,
    )
    absolute_tolerance: float | Mapping[str, float] | None = run_option(
        *("run", NUMBER_OR_NAMED, "[NAME=]VALUE"),
        "Size below which errors of adaptive steps do not matter, of all coordinates, or of a coordinate, array or "
        "rotation [0]; may be repeated.",
        valid=lambda value: value >= 0.0,
        invalid="absolute_tolerance is {value:g}: it must not be negative; give 0 or a size below which errors do not "
        "matter",
        common=False,
    )
    max_step: float | None = run_option(
        *("run", NUMBER, "H", "Largest size of adaptive steps."),
        valid=lambda value: value > 0.0,
        invalid="max_step is {value:g}: it must be positive, also for a run backward in time",
        common=False,
    )
    first_step: float | None = run_option(
        *("run", NUMBER, "H", "Size of the first adaptive step, reduced if its error is too large."),
        valid=lambda value: value > 0.0,
        invalid="first_step is {value:g}: it must be positive, also for a run backward in time",
        common=False,
    )
    error: float | None = run_option(
        *("run", NUMBER, "X"),
        "Adaptive step size with this bound on the relative global error, confirmed by runs with other step sizes.",
        determines=STEP_SIZE,
        brief="error (error of the whole run)",
        valid=lambda value: 0.0 < value < 1.0,
        invalid="error is {value:g}: the bound of the relative global error must be between 0 and 1",
        unavailable={IN_ENSEMBLE: "give a tolerance"},
        common=False,
    )
    time_transformation: str | None = run_option(
        *("system", TEXT, "G"),
        "Time transformation dt = G dtau: frequency, distance, potential, arclength or a formula.",
    )
    controller: str | None = run_option(
        *("run", CHOICE, ""),
        "Step-size controller. With --time-transformation: symplectic (default; energy must be conserved), or "
        "reversible (any system); without it "
        + ", ".join(f"{name}: {kind.summary}" for name, kind in CONTROLLERS.items() if not kind.in_tau)
        + ".",
        choices=(SYMPLECTIC, *CONTROLLERS),
    )
    precision: str | None = run_option(
        *("run", CHOICE, "", f"Arithmetic [double]; {DOUBLE_DOUBLE}: 31 digits; {AUTO}: this if --error requires it."),
        choices=PRECISIONS,
        common=False,
    )
    sums: str | None = run_option(
        *("run", CHOICE, "", "Sums of explicit steps of an array model [compensated]; plain: faster, rounded."),
        choices=SUMS,
        common=False,
    )
    observe: str | None = run_option(
        *("run", CHOICE, "", "With --ensemble: record extremes of the state or of the energy over all fixed steps."),
        choices=OBSERVED[:2],
        common=False,
    )
    span: float | None = run_option("run", NUMBER, "T", "Duration of the run.", determines=DURATION)
    steps: int | None = run_option("run", COUNT, "N", "Number of steps, instead of --span.", determines=DURATION)
    save_every: int = run_option("run", COUNT, "N", "Save every N-th state.", least=1, default=1)
    solver_tolerance: float | None = run_option(
        *("run", NUMBER, "X", "Convergence criterion: relative update of the stages [round-off]."),
        valid=lambda value: 0.0 < value <= LARGEST_TOLERANCE,
        invalid=f"solver_tolerance must be positive and at most {LARGEST_TOLERANCE:g}, not {{value:g}}",
        solver_option="tolerance",
        common=False,
    )
    max_iterations: int | None = run_option(
        *("run", COUNT, "N", "Iterations after which a step fails [50]."),
        least=1,
        solver_option="max_iterations",
        common=False,
    )
    threads: int | None = run_option(
        *("run", COUNT, "N", "Worker threads per step of an array model [1]."),
        least=1,
        unavailable={IN_ENSEMBLE: "its trajectories are distributed over all cores"},
        common=False,
    )
    action: bool = run_option("run", SWITCH, "", "Sum the action along the run.", default=False, common=False)
    seed: int = run_option(
        *("run", COUNT, "N", "Key of the noise of a heat bath [0]."), default=0, most=LARGEST_SEED, common=False
    )
    metropolis: bool = run_option(
        "run", SWITCH, "", "Accept or reject each step in a heat bath.", default=False, common=False
    )


_TABLE: dict[str, Option] = {
    "method": Option(
        *("method", METHOD, "NAME"),
        "Method, with its degree or number of stages: svi:6, gauss:3, .. (see 'scvi-codegen methods'). By default "
        "svi:8, in runs of a tolerance from 1e-4 on svi:4.",
    ),
    "degree": Option("method", COUNT, "N", "Degree of the trial curve (svi, scvi, sc), as in svi:N."),
    "stages": Option("method", COUNT, "N", "Number of stages (gauss, radau-iia, ..), as in gauss:N."),
    "order": Option("method", COUNT, "N", "Order of a composition of Stoermer-Verlet: 2, 4, 6, 8 or 10."),
    "quadrature": Option("method", TEXT, "NAME:N", "Quadrature, as in gauss-legendre:8 or clenshaw-curtis:9."),
    "nodes": Option("method", TEXT, "NAME", "Nodes: chebyshev-lobatto, legendre-lobatto or equispaced."),
    "space": Option(
        *("method", TEXT, "NAME"),
        "Trial space of an SVI: polynomials, trigonometric:RADIANS_A_STEP[:HARMONICS] or splines:PIECES.",
    ),
    "form": Option("method", TEXT, "NAME", "phase-space or position (sc and Runge-Kutta methods)."),
    "variational": Option(
        *("method", SWITCH, ""),
        "SCVI: the variational method, or the form printed in the paper, which is not symplectic.",
        flag="--variational/--printed",
    ),
    "abscissae": Option(
        *("method", NUMBERS_OR_NAME, "C1,C2,.."),
        "Abscissae in [0, 1] (collocation, scvi); scvi also: gauss, radau-iia, lobatto-iiia, ..",
    ),
    "parameter": Option("parameters", ASSIGNMENTS, "NAME=VALUE", "Value of a parameter; may be repeated."),
    "inputs": Option(
        *("inputs", INPUTS, "NAME=FILE[:KIND]"),
        "Tabulated input: columns t and value of a .csv or .npz file, interpolated constant, linear (default) or "
        "cubic; or a number, NAME=NUMBER; may be repeated.",
        flag="--input",
    ),
    "size": Option("sizes", SIZES, "NAME=N", "Array size of an array model, as N=1000; may be repeated."),
    "event": Option(
        *("events", EVENTS, "G[; NAME=VALUE].."),
        "Zero crossing of G that changes the state, as 'y; direction=-1; p_y=-0.8*p_y', or of a wall, as "
        "'y; restitution=0.8; where=x > 0'; terminal=N ends the run at the N-th; may be repeated.",
    ),
    "q": Option("initial", NUMBERS, "Q1,Q2,..", "Initial coordinates."),
    "p": Option("initial", NUMBERS, "P1,P2,..", "Initial momenta.", determines=VELOCITY),
    "velocity": Option(
        *("initial", NUMBERS, "V1,V2,..", "Initial velocities, instead of momenta."),
        key="q_dot",
        brief="velocity (q_dot)",
        determines=VELOCITY,
    ),
    "limits": Option("system", CHOICE, "", "Robots: limits of joints [ignore].", choices=("contact", "ignore")),
    "friction": Option("system", CHOICE, "", "Robots: dry friction of joints [ignore].", choices=("contact", "ignore")),
    "contacts": Option("system", CHOICE, "", "MJCF: contacts with planes [ignore].", choices=("planes", "ignore")),
    "actuators": Option("system", SWITCH, "", "MJCF: actuators act; their controls are inputs, 0 by default."),
    "keyframe": Option("system", TEXT, "NAME", "MJCF: initial state and controls of a keyframe [qpos0]."),
    **{entry.name: entry.metadata["option"] for entry in fields(RunOptions)},
    "advise": Option(
        *("", NUMBER, "X"),
        "Choose a fixed step size for this relative error of the positions at the end (of all trajectories).",
        determines=STEP_SIZE,
        unavailable={WITH_INPUTS: "use --tolerance"},
        common=False,
    ),
    "solver": Option(
        *("method", CHOICE, ""),
        "Solver of the stage equations; auto: explicit or fixed-point iteration if possible, Newton as fallback; "
        "by default that of the model file.",
        choices=("auto", "fixed-point", "newton", "explicit"),
        default="auto",
        common=False,
    ),
}
_TABLE |= {
    "start": Option(
        "path", NUMBERS, "Q1,Q2,..", "Position at the start [that of MODEL].", key="from", flag="--from", common=False
    ),
    "to": Option("path", NUMBERS, "Q1,Q2,..", "Position at the end.", common=False),
    "energy": Option("path", NUMBER, "E", "Energy of the path; --span is an estimate of its duration.", common=False),
    "closed": Option(
        "path", TEXT, "NAMES", "Closed path: true, or the coordinates that follow, x2,-y2,..", common=False
    ),
    "starts": Option("path", COUNT, "N", "Number of further starts at random [0].", common=False),
    "revolutions": Option(
        "path", COUNT, "N", "Start around the centre, too, both ways, with up to N whole revolutions.", common=False
    ),
}
_OF_FAMILIES = {
    "amplitude": (NUMBER, "A", "Begin at the equilibrium near --q, with this deviation."),
    "mode": (COUNT, "N", "Oscillation of the equilibrium, by descending frequency [0]."),
    "period": (TEXT, "T", "Period of an orbit near --q, or its formula (2*pi/w)."),
    "vary": (TEXT, "NAME", "Parameter of the system along which the family is continued."),
    "fixed": (TEXT, "NAMES", "Coordinates and momenta that keep their values, y,p_x."),
    "reversor": (TEXT, "FORMULAS", "Symmetry of the orbits, x,-y,z or detect: half a period is computed."),
    "until": (TEXT, "CONDITION", "Condition that ends the family, 'energy > -1.57'."),
    "backward": (SWITCH, "", "Towards smaller values of the parameter, or of the energy."),
    "stride": (NUMBER, "S", "Largest step, relative to the motion [0.1]."),
    "count": (COUNT, "N", "Largest number of orbits [50]."),
}
_TABLE |= {name: Option("family", *option, common=False) for name, option in _OF_FAMILIES.items()}
OPTIONS = tuple(option.named(name) for name, option in _TABLE.items())
KEYED = tuple(option for option in OPTIONS if option.section and not option.is_section)
"""Options with a key of their own in a section of model files."""
STEP_KEYS, *OTHER_ALTERNATIVES = (
    {option.key for option in KEYED if option.determines == group} for group in (STEP_SIZE, DURATION, VELOCITY)
)
ALTERNATIVE_KEYS = (STEP_KEYS, *OTHER_ALTERNATIVES)
"""Groups of keys of which at most one is given, first those of the step size."""


def options_of(section: str) -> tuple[Option, ...]:
    """Return the options with a key of their own in a section of model files."""
    return tuple(option for option in KEYED if option.section == section)


FIELDS = tuple(option for option in (*options_of("run"), *options_of("initial")) if option.kind != CHOICE)
"""Options that are fields of a model."""
RUN_FIELDS = tuple(option for option in FIELDS if option.kind != NUMBERS)
"""Those of them that are fields of :class:`RunOptions`."""
METHOD_KEYS = tuple(option.name for option in options_of("method") if option.common)
"""Options that specify the method."""
OF_ADAPTIVE_STEPS = ("absolute_tolerance", "max_step", "first_step")
"""Options of adaptive steps besides the tolerance."""
FURTHER = ("path", "family", "page", "picture")
"""Sections of commands and pictures, which are fields of a model."""
STATE = {option.key: option.field for option in options_of("initial") if option.kind == NUMBERS}
"""Field of a model by key of ``[initial]``."""


def checked_value(section: str, key: str, value: Any) -> Any:
    """Return a value of the section ``[path]`` or ``[family]``, or raise :class:`ModelFileError`."""
    options, where = {option.key: option for option in options_of(section)}, f"[{section}] {key}"
    if key not in options:
        raise ModelFileError(f"there is no key {where}: use {', '.join(options)}")
    if options[key].kind == NUMBERS:
        if not isinstance(value, list | tuple):
            raise ModelFileError(f"{where} must be a list of numbers, not {value!r}")
        return [real(entry, where) for entry in value]
    if options[key].kind != TEXT:
        return options[key].read(value, where)
    if section == "family" and not isinstance(value, str):
        raise ModelFileError(f"{where} must be a text, not {value!r}")
    names = isinstance(value, list | tuple) and all(isinstance(entry, str) for entry in value)
    if value is not True and not names and not isinstance(value, str):
        raise ModelFileError(f"{where} must be true or a list of coordinates with signs, not {value!r}")
    return list(value) if names else value


def alternatives(*sections: str) -> Iterator[tuple[Option, Option]]:
    """Yield the pairs of options of these sections of which at most one is given."""
    options = [option for option in OPTIONS if option.determines and option.section in sections]
    for option, alternative in combinations(options, 2):
        if option.determines == alternative.determines:
            yield option, alternative


def excluded(names: Collection[str], *sections: str) -> Iterator[tuple[Option, Option]]:
    """Yield the pairs of :func:`alternatives` whose names are both given."""
    return (pair for pair in alternatives(*sections) if all(option.name in names for option in pair))


def check_alternatives(values: Any, *groups: Alternatives) -> None:
    """Raise an error unless at most one field of each group is set, and one of those that are required."""
    for group in groups:
        options = [option for option in OPTIONS if option.determines == group and option.section]
        count = sum(getattr(values, option.field) is not None for option in options)
        if count > 1 or (group.required and not count):
            *names, last = (option.brief for option in options)
            number = "exactly one of" if group.required else "only one of"
            raise ModelFileError(f"give {number} {', '.join(names)} and {last}")


def check_available(values: Any, situation: str) -> None:
    """Raise an error if a field is set whose option is not available in a situation."""
    for option in FIELDS:
        if situation in option.unavailable and (value := getattr(values, option.field)) is not None:
            shown = f"[{option.section}] {option.key} = {value:g} ({option.flag})"
            raise ModelFileError(f"{shown} is not available {situation}: {option.unavailable[situation]}")


def real(value: Any, where: str) -> float:
    """Return a finite number, also an exact one, or raise an error that begins with ``where``."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ModelFileError(f"{where} must be a number, not {value!r:.60}")
    try:
        number = value if isinstance(value, ExactNumber) else float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ModelFileError(f"{where} is {number}: it must be a finite number")
    return number


def with_exact_numbers(value: Any, *, exact: bool = True) -> Any:
    """Return a number, or a list or table of numbers, with text and fractions as exact numbers, or all as doubles."""
    if isinstance(value, dict):
        return {key: with_exact_numbers(entry, exact=exact) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [with_exact_numbers(entry, exact=exact) for entry in value]
    if not exact:
        return float(value) if isinstance(value, ExactNumber) else value
    numeral = isinstance(value, str) and NUMERAL.fullmatch(value)
    try:
        return ExactNumber(str(value)) if numeral or isinstance(value, Fraction) else value
    except ValueError as error:
        raise ModelFileError(str(error)) from error
