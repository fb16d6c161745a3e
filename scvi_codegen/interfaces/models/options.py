"""Options of model files and commands: those of runs, and the rows of methods, systems, paths and families beside them.

The table of runs, and what follows from a row, is :mod:`scvi_codegen.codegen.native.option_table`.
"""

from dataclasses import dataclass, fields
from fractions import Fraction
from math import isfinite
from typing import Any

from scvi_codegen.codegen.native.option_table import (
    ADAPTIVE,
    ASSIGNMENTS,
    CHOICE,
    COUNT,
    DURATION,
    EVENTS,
    INPUTS,
    METHOD,
    NUMBER,
    NUMBERS,
    NUMBERS_OR_NAME,
    OPTION,
    SIZES,
    STATE_OPTIONS,
    STEP_SIZE,
    SWITCH,
    TEXT,
    VELOCITY,
    Option,
    RunOptions,
    option,
)
from scvi_codegen.common.errors import ModelFileError, closest
from scvi_codegen.common.validation import NUMERAL, ExactNumber
from scvi_codegen.methods.controllers import CONTROLLERS, SYMPLECTIC

IN_ENSEMBLE, WITH_INPUTS = "with --ensemble", "for systems with inputs"
"""Situations in which some options are not available."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelOptions(RunOptions):
    """Options of a run and of its time transformation."""

    time_transformation: str | None = option(
        *("system", TEXT, "G"),
        "Time transformation dt = G dtau: frequency, distance, potential, arclength or a formula.",
    )
    controller: str | None = option(
        *("run", CHOICE, ""),
        "Step-size controller. With --time-transformation: symplectic (default; energy must be conserved), or "
        "reversible (any system); without it "
        + ", ".join(f"{name}: {kind.summary}" for name, kind in CONTROLLERS.items() if not kind.in_tau)
        + ".",
        choices=(SYMPLECTIC, *CONTROLLERS),
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
    **STATE_OPTIONS,
    "limits": Option("system", CHOICE, "", "Robots: limits of joints [ignore].", choices=("contact", "ignore")),
    "friction": Option("system", CHOICE, "", "Robots: dry friction of joints [ignore].", choices=("contact", "ignore")),
    "contacts": Option("system", CHOICE, "", "MJCF: contacts with planes [ignore].", choices=("planes", "ignore")),
    "actuators": Option("system", SWITCH, "", "MJCF: actuators act; their controls are inputs, 0 by default."),
    "keyframe": Option("system", TEXT, "NAME", "MJCF: initial state and controls of a keyframe [qpos0]."),
    **{entry.name: entry.metadata["option"] for entry in fields(ModelOptions)},
    "advise": Option(
        *("", NUMBER, "X"),
        "Choose a fixed step size for this relative error of the positions at the end (of all trajectories).",
        determines=STEP_SIZE,
        unavailable={WITH_INPUTS: "use {tolerance}"},
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
ALTERNATIVE_KEYS = [
    {option.key for option in KEYED if option.determines == group} for group in (STEP_SIZE, DURATION, VELOCITY)
]
"""Groups of keys of which at most one is given, first those of the step size."""
STEP_KEYS = ALTERNATIVE_KEYS[0]
ROWS = {option.field: option for option in OPTIONS}
"""Options by field."""


def options_of(section: str) -> tuple[Option, ...]:
    """Return the options with a key of their own in a section of model files."""
    return tuple(option for option in KEYED if option.section == section)


RUN_FIELDS = tuple(ROWS[name] for name in ModelOptions.__dataclass_fields__ if ROWS[name].section in ("initial", "run"))
"""Options of runs that are fields of a model."""
OF_ADAPTIVE_STEPS = tuple(option.field for option in RUN_FIELDS if option.requires == ADAPTIVE)
"""Options of adaptive steps besides the tolerance."""
FURTHER = ("path", "family", "page", "picture")
"""Sections of commands and pictures, which are fields of a model."""
STATE = {option.key: option.field for option in options_of("initial") if option.kind == NUMBERS}
"""Field of a model by key of ``[initial]``."""


def checked_value(section: str, key: str, value: Any) -> Any:
    """Return a value of the section ``[path]`` or ``[family]``, or raise :class:`ModelFileError`."""
    options, where = {option.key: option for option in options_of(section)}, f"[{section}] {key}"
    if key not in options:
        raise ModelFileError(f"there is no key {where}{closest(key, options)} Known: {', '.join(options)}")
    if options[key].kind != TEXT:
        value = options[key].checked(value, ModelFileError, where)
        return list(value) if isinstance(value, tuple) else value
    if section == "family" and not isinstance(value, str):
        raise ModelFileError(f"{where} must be a text, not {value!r}")
    names = isinstance(value, list | tuple) and all(isinstance(entry, str) for entry in value)
    if value is not True and not names and not isinstance(value, str):
        raise ModelFileError(f"{where} must be true or a list of coordinates with signs, not {value!r}")
    return list(value) if names else value


def real(value: Any, where: str) -> float:
    """Return a finite number, also an exact one, or raise an error that begins with ``where``."""
    if isinstance(value, ExactNumber) and isfinite(value):
        return value
    number: float = OPTION["t_end"].checked(value, ModelFileError, where)
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
