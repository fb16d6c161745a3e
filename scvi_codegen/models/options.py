"""Table of the options of a run: keys of model files, flags of the command line and fields of a :class:`Model`.

Model files are read, checked and written, and the flags of the commands with an argument MODEL are made, from this
table: an option that a model has as a field is added here and in that class.
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import combinations
from numbers import Real
from typing import Any

from scvi_codegen.controllers import CONTROLLERS, SYMPLECTIC
from scvi_codegen.errors import ModelFileError
from scvi_codegen.validation import checked_count

NUMBER, COUNT, TEXT, CHOICE, SWITCH, METHOD = "number", "count", "text", "choice", "switch", "method"
NUMBERS, NUMBERS_OR_NAME = "numbers", "numbers or name"
ASSIGNMENTS, INPUTS, SIZES, EVENTS = "assignments", "inputs", "sizes", "events"
"""Kinds of values of an option; those of the last four are a section of a model file."""
STEP_SIZE, DURATION, VELOCITY = "the step size", "the duration", "the velocity"
"""What alternative options determine."""


@dataclass(frozen=True, slots=True)
class Option:
    """Option of a run.

    Attributes:
        name: parameter of commands; the flag is ``--name`` with hyphens unless ``flag`` is another.
        section: section of model files, "" for an option of the command line alone.
        kind: of its value.
        metavar, help: description of the flag.
        key, field: key in the section and field of a model, by default the name.
        determines: what this option and its alternatives determine: at most one of them is given.
        least: smallest value of a count.
        choices: values of a choice.
        default: value that means the same as no value.
        common: whether all commands with an argument MODEL have it.
    """

    name: str
    section: str
    kind: str
    metavar: str
    help: str
    key: str = ""
    field: str = ""
    flag: str = ""
    determines: str = ""
    least: int = 0
    choices: tuple[str, ...] = ()
    default: str | None = None
    common: bool = True

    def __post_init__(self) -> None:
        flag = f"--{self.name.replace('_', '-')}"
        for name, default in (("key", self.name), ("field", self.name), ("flag", flag)):
            if not getattr(self, name):
                object.__setattr__(self, name, default)

    @property
    def is_section(self) -> bool:
        """Return whether the values of the option are a section of a model file."""
        return self.kind in (ASSIGNMENTS, INPUTS, SIZES, EVENTS)

    def read(self, value: Any, where: str) -> Any:
        """Return a number of the kind of the option, or raise :class:`ModelFileError` that begins with ``where``."""
        if self.kind == COUNT:
            return checked_count(value, where, least=self.least, error=ModelFileError)
        return real(value, where)


OPTIONS = (
    Option(
        *("method", "method", METHOD, "NAME"),
        "Method, with its degree or number of stages: svi:6, gauss:3, .. (see 'scvi-codegen methods').",
    ),
    Option("degree", "method", COUNT, "N", "Degree of the trial curve (svi, scvi, sc), as in svi:N."),
    Option("stages", "method", COUNT, "N", "Number of stages (gauss, radau-iia, ..), as in gauss:N."),
    Option("order", "method", COUNT, "N", "Order of a composition of Stoermer-Verlet: 2, 4, 6, 8 or 10."),
    Option("quadrature", "method", TEXT, "NAME:N", "Quadrature, as in gauss-legendre:8 or clenshaw-curtis:9."),
    Option("nodes", "method", TEXT, "NAME", "Nodes: chebyshev-lobatto, legendre-lobatto or equispaced."),
    Option(
        *("space", "method", TEXT, "NAME"),
        "Trial space of an SVI: polynomials, trigonometric:RADIANS_A_STEP[:HARMONICS] or splines:PIECES.",
    ),
    Option("form", "method", TEXT, "NAME", "phase-space or position (sc and Runge-Kutta methods)."),
    Option(
        *("variational", "method", SWITCH, ""),
        "SCVI: the variational method, or the form printed in the paper, which is not symplectic.",
        flag="--variational/--printed",
    ),
    Option(
        *("abscissae", "method", NUMBERS_OR_NAME, "C1,C2,.."),
        "Abscissae in [0, 1] (collocation, scvi); scvi also: gauss, radau-iia, lobatto-iiia, ..",
    ),
    Option("parameter", "parameters", ASSIGNMENTS, "NAME=VALUE", "Value of a parameter; may be repeated."),
    Option(
        *("inputs", "inputs", INPUTS, "NAME=FILE[:KIND]"),
        "Tabulated input: columns t and value of a .csv or .npz file, interpolated constant, linear (default) or "
        "cubic; or a number, NAME=NUMBER; may be repeated.",
        flag="--input",
    ),
    Option("size", "sizes", SIZES, "NAME=N", "Array size of an array model, as N=1000; may be repeated."),
    Option(
        *("event", "events", EVENTS, "G[; NAME=VALUE].."),
        "Zero crossing of G that changes the state, as 'y; direction=-1; p_y=-0.8*p_y', or of a wall, as "
        "'y; restitution=0.8; where=x > 0'; terminal=N ends the run at the N-th; may be repeated.",
    ),
    Option("q", "initial", NUMBERS, "Q1,Q2,..", "Initial coordinates."),
    Option("p", "initial", NUMBERS, "P1,P2,..", "Initial momenta.", determines=VELOCITY),
    Option(
        *("velocity", "initial", NUMBERS, "V1,V2,..", "Initial velocities, instead of momenta."),
        key="q_dot",
        determines=VELOCITY,
    ),
    Option("time", "initial", NUMBER, "T", "Initial time.", key="t", field="t"),
    Option(
        *("step", "run", NUMBER, "H", "Fixed step size (of tau, if transformed); negative: backward."),
        field="h",
        determines=STEP_SIZE,
    ),
    Option(
        *("tolerance", "run", NUMBER, "X"),
        "Adaptive step size with this relative local error (1e-16: round-off). With --time-transformation: a fixed "
        "step of tau is chosen for it.",
        determines=STEP_SIZE,
        common=False,
    ),
    Option(
        *("error", "run", NUMBER, "X"),
        "Adaptive step size with this bound on the relative global error, confirmed by runs with other step sizes.",
        determines=STEP_SIZE,
        common=False,
    ),
    Option(
        *("advise", "", NUMBER, "X"),
        "Choose a fixed step size for this relative error of the positions at the end.",
        determines=STEP_SIZE,
        common=False,
    ),
    Option(
        *("time_transformation", "system", TEXT, "G"),
        "Time transformation dt = G dtau: frequency, distance, potential, arclength or a formula.",
    ),
    Option(
        *("controller", "run", CHOICE, ""),
        "Step-size controller. With --time-transformation: symplectic (default; energy must be conserved), or "
        "reversible (any system); without it "
        + ", ".join(f"{name}: {each.summary}" for name, each in CONTROLLERS.items() if not each.in_tau)
        + ".",
        choices=(SYMPLECTIC, *CONTROLLERS),
    ),
    Option("span", "run", NUMBER, "T", "Duration of the run.", determines=DURATION),
    Option("steps", "run", COUNT, "N", "Number of steps, instead of --span.", determines=DURATION),
    Option("save_every", "run", COUNT, "N", "Save every N-th state.", least=1),
    Option(
        *("solver", "method", CHOICE, ""),
        "Solver of the stage equations; auto: explicit or fixed-point iteration if possible, Newton as fallback; "
        "by default that of the model file.",
        choices=("auto", "fixed-point", "newton", "explicit"),
        default="auto",
        common=False,
    ),
)


KEYED = tuple(option for option in OPTIONS if option.section and not option.is_section)
"""Options with a key of their own in a section of model files."""
ALTERNATIVE_KEYS = tuple(
    {option.key for option in KEYED if option.determines == result} for result in (VELOCITY, STEP_SIZE, DURATION)
)
"""Groups of keys of which at most one is given."""


def options_of(section: str) -> tuple[Option, ...]:
    """Return the options with a key of their own in a section of model files."""
    return tuple(option for option in KEYED if option.section == section)


FIELDS = tuple(option for option in (*options_of("run"), *options_of("initial")) if option.kind != CHOICE)
"""Options that are fields of a model."""
METHOD_KEYS = tuple(option.name for option in options_of("method") if option.common)
"""Options that specify the method."""
STATE = {option.key: option.field for option in options_of("initial") if option.kind == NUMBERS}
"""Field of a model by key of ``[initial]``."""


def alternatives(*sections: str) -> Iterator[tuple[Option, Option]]:
    """Yield the pairs of options of these sections of which at most one is given."""
    for one, other in combinations(OPTIONS, 2):
        if one.determines and one.determines == other.determines and {one.section, other.section} <= {*sections}:
            yield one, other


def excluded(given: Collection[str], *sections: str) -> Iterator[tuple[Option, Option]]:
    """Yield the pairs of :func:`alternatives` whose names are both given."""
    return (pair for pair in alternatives(*sections) if all(option.name in given for option in pair))


def real(value: Any, where: str) -> float:
    """Return a finite number, or raise an error that begins with ``where``."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ModelFileError(f"{where} must be a number, not {value!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ModelFileError(f"{where} is {number}: it must be a finite number")
    return number
