"""Options of runs: one row each, of which keywords of Python, keys of model files and flags of commands are the faces.

From a row follow the check of a value, its messages in the words of the face that a user has, the field of a
:class:`~scvi_codegen.Model`, the key of a section of model files, the flag of commands, the JSON of ``run`` and the
arguments of runs (docs/extending.md). Neither SymPy nor click is imported.
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations
from math import isfinite
from typing import Any, NamedTuple

from scvi_codegen.codegen.ir.variants import BY_STEPS, SUMS
from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.rendering.source import AUTO, DOUBLE_DOUBLE, PRECISIONS
from scvi_codegen.common.errors import FACE, ScviCodegenError, StateError
from scvi_codegen.common.validation import LARGEST_COUNT, checked_count

NUMBER, COUNT, TEXT, CHOICE, SWITCH, METHOD = "number", "count", "text", "choice", "switch", "method"
NUMBERS, NUMBERS_OR_NAME, NUMBER_OR_NAMED = "numbers", "numbers or name", "number, or numbers by name"
ASSIGNMENTS, INPUTS, SIZES, EVENTS = "assignments", "inputs", "sizes", "events"
"""Kinds of values of an option; those of the last four are a section of a model file."""

LARGEST_TOLERANCE = 0.1
"""Largest relative update with which the iteration of a step may end: beyond it, the equations are not solved."""
MOST_ITERATIONS = 10**6
LARGEST_SEED = 2**64 - 1
"""The key of the noise has 64 bits."""


class Range(NamedTuple):
    """Numbers that an option may have: words after "must", and whether one is among them."""

    words: str
    contains: Callable[[float], bool]


FINITE = Range("be finite", isfinite)
NOT_ZERO = Range("be positive, or negative for a run backward in time", bool)
POSITIVE = Range("be positive", lambda value: value > 0.0)
NOT_NEGATIVE = Range("not be negative", lambda value: value >= 0.0)
BELOW_ONE = Range("be positive and below 1", lambda value: 0.0 < value < 1.0)
SOLVED = Range(f"be positive and at most {LARGEST_TOLERANCE:g}", lambda value: 0.0 < value <= LARGEST_TOLERANCE)

LOCATED = "located"
"""How transitions of contacts are treated by default."""
STEP_SIZE, DURATION, VELOCITY = "the step size", "the duration", "the velocity"
"""What alternatives determine, of which at most one is given."""
ADAPTIVE, FIXED = "adaptive steps", "a fixed step size"
"""Kinds of steps that an option may require."""


@dataclass(frozen=True, slots=True)
class Option:
    """Option of a run.

    Attributes:
        section: section of model files, "" for an option of the command line alone.
        kind: of its value.
        metavar, help: description of the flag.
        name: parameter of commands; the flag is ``--name`` with hyphens unless ``flag`` is another.
        key, field: key in the section; field of a model and keyword of Python, by default the name.
        determines: what this option and its alternatives determine.
        requires: the kind of steps without which it has no effect.
        least, most: smallest and largest value of a count.
        choices: values of a choice.
        default: value that means the same as no value.
        range, remedy: of a number, and what to do about one that is not in it.
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
    determines: str = ""
    requires: str = ""
    least: int = 0
    most: int = LARGEST_COUNT
    choices: tuple[str, ...] = ()
    default: str | None = None
    range: Range = FINITE
    remedy: str = ""
    unavailable: Mapping[str, str] = dataclasses.field(default_factory=dict, hash=False)
    solver_option: str = ""
    common: bool = True

    def named(self, name: str) -> "Option":
        """Return the option with this field, which is also the default of its other names."""
        name, attribute = self.name or name, self.field or name
        flag = self.flag or f"--{name.replace('_', '-')}"
        return replace(self, name=name, field=attribute, key=self.key or name, flag=flag)

    def __str__(self) -> str:
        if FACE.get() in ("python", "model"):
            return self.field
        return f"[{self.section}] {self.key}" if self.section else self.flag

    @property
    def word(self) -> str:
        """The option as a remedy names it, which need not be set."""
        end = self.determines == DURATION and self.kind == NUMBER
        python, model = ("t_end", "span") if end else (self.field, self.field)
        return {"python": python, "model": model, "file": self.key, "command": self.flag}[FACE.get()]

    @property
    def is_section(self) -> bool:
        """Return whether the values of the option are a section of a model file."""
        return self.kind in (ASSIGNMENTS, INPUTS, SIZES, EVENTS)

    def checked(self, value: Any, error: type[ScviCodegenError] = StateError, name: str = "") -> Any:
        """Return a value of the kind and in the range of the option, or raise an error that names it."""
        shown = name or str(self)
        if self.kind == COUNT:
            return checked_count(value, shown, least=self.least, most=self.most, error=error)
        if self.kind == SWITCH and not isinstance(value, bool):
            raise error(f"{shown} must be true or false, not {value!r}")
        if self.kind == CHOICE and value not in self.choices:
            raise error(f"unknown {shown} {value!r}: use {' or '.join(map(repr, self.choices))}")
        if self.kind == NUMBER_OR_NAMED and isinstance(value, Mapping):
            return {str(part): self._number(number, f"{shown} of {part}", error) for part, number in value.items()}
        if self.kind == NUMBERS:
            if not isinstance(value, Iterable) or isinstance(value, str):
                raise error(f"{shown} must be a list of numbers, not {value!r}")
            return tuple(self._number(number, f"{shown}[{k}]", error) for k, number in enumerate(value))
        return self._number(value, shown, error) if self.kind in (NUMBER, NUMBER_OR_NAMED) else value

    def _number(self, value: Any, shown: str, error: type[ScviCodegenError]) -> float:
        try:
            number = checked_number(value, shown)
        except StateError as wrong:
            raise error(str(wrong)) from wrong.__cause__
        if not self.range.contains(number):
            raise error(f"{shown} = {number:g} must {self.range.words}{in_words(self.remedy and f': {self.remedy}')}")
        return number


def option(section: str, kind: str, metavar: str, help: str, *, default: Any = None, **further: Any) -> Any:  # noqa: A002
    """Return a field of :class:`RunOptions` with the description of its option."""
    return dataclasses.field(default=default, metadata={"option": Option(section, kind, metavar, help, **further)})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunOptions:
    """Options of a run that are fields of a :class:`Model`: the entries of the table for steps and saved states."""

    t: float = option("initial", NUMBER, "T", "Initial time.", name="time", key="t", default=0.0)
    h: float | None = option(
        *("run", NUMBER, "H", "Fixed step size (of tau, if transformed); negative: backward."),
        name="step",
        determines=STEP_SIZE,
        range=NOT_ZERO,
    )
    tolerance: float | None = option(
        *("run", NUMBER, "X"),
        "Adaptive step size with this relative local error (1e-16: round-off). With --time-transformation: a fixed "
        "step of tau is chosen for it.",
        determines=STEP_SIZE,
        range=BELOW_ONE,
        remedy="it is the relative error of each step; omit it for errors at round-off level",
        common=False,
    )
    absolute_tolerance: float | Mapping[str, float] | None = option(
        *("run", NUMBER_OR_NAMED, "[NAME=]VALUE"),
        "Size below which errors of adaptive steps do not matter, of all coordinates, or of a coordinate, array or "
        "rotation [0]; may be repeated.",
        requires=ADAPTIVE,
        range=NOT_NEGATIVE,
        remedy="give the size below which errors do not matter, or omit it",
        common=False,
    )
    max_step: float | None = option(
        *("run", NUMBER, "H", "Largest size of adaptive steps."),
        requires=ADAPTIVE,
        range=POSITIVE,
        remedy="give a size, or omit it ({t_end} determines the direction)",
        common=False,
    )
    first_step: float | None = option(
        *("run", NUMBER, "H", "Size of the first adaptive step, reduced if its error is too large."),
        requires=ADAPTIVE,
        range=POSITIVE,
        remedy="give a size, or omit it ({t_end} determines the direction)",
        common=False,
    )
    error: float | None = option(
        *("run", NUMBER, "X"),
        "Adaptive step size with this bound on the relative global error, confirmed by runs with other step sizes.",
        determines=STEP_SIZE,
        range=BELOW_ONE,
        remedy="it bounds the relative global error",
        unavailable={"with --ensemble": "give a {tolerance}"},
        common=False,
    )
    precision: str | None = option(
        *("run", CHOICE, "", f"Arithmetic [double]; {DOUBLE_DOUBLE}: 31 digits; {AUTO}: this if --error requires it."),
        choices=PRECISIONS,
        common=False,
    )
    sums: str | None = option(
        *("run", CHOICE, "", "Sums of explicit steps of an array model [compensated]; plain: faster, rounded."),
        choices=SUMS,
        common=False,
    )
    observe: str | None = option(
        *("run", CHOICE, "", "With --ensemble: record extremes of the state or of the energy over all fixed steps."),
        choices=("extremes", "energy"),
        common=False,
    )
    span: float | None = option("run", NUMBER, "T", "Duration of the run.", determines=DURATION, range=NOT_ZERO)
    steps: int | None = option(
        "run", COUNT, "N", "Number of steps, instead of --span.", determines=DURATION, requires=FIXED
    )
    save_every: int = option("run", COUNT, "N", "Save every N-th state.", least=1, default=1)
    t_eval: Sequence[float] | None = option(
        *("run", NUMBERS, "T1,T2,..", "Times at which states are saved, instead of every N-th."),
        unavailable={"for a run recorded in a folder": "write it to a file (-o NAME.npz)"},
        common=False,
    )
    solver_tolerance: float | None = option(
        *("run", NUMBER, "X", "Convergence criterion: relative update of the stages [round-off]."),
        range=SOLVED,
        remedy="omit it for round-off",
        solver_option="tolerance",
        common=False,
    )
    max_iterations: int | None = option(
        *("run", COUNT, "N", "Iterations after which a step fails [50]."),
        least=1,
        most=MOST_ITERATIONS,
        solver_option="max_iterations",
        common=False,
    )
    threads: int | None = option(
        *("run", COUNT, "N", "Worker threads per step of an array model [1]."),
        least=1,
        unavailable={"with --ensemble": "its trajectories are distributed over all cores"},
        common=False,
    )
    action: bool = option("run", SWITCH, "", "Sum the action along the run.", default=False, common=False)
    seed: int = option(
        *("run", COUNT, "N", "Key of the noise of a heat bath [0]."), default=0, most=LARGEST_SEED, common=False
    )
    transitions: str = option(
        *("run", CHOICE, "", "Contacts [located]; by steps: of a fixed size, by svi:1, for feet and piles."),
        choices=(LOCATED, BY_STEPS),
        default=LOCATED,
        common=False,
    )
    strict_energy: bool = option(
        "run", SWITCH, "", "Shrink velocities where a step by steps raises energy.", default=False, common=False
    )
    metropolis: bool = option(
        "run", SWITCH, "", "Accept or reject each step in a heat bath.", default=False, common=False
    )


STATE_OPTIONS = {
    "q": Option("initial", NUMBERS, "Q1,Q2,..", "Initial coordinates."),
    "p": Option("initial", NUMBERS, "P1,P2,..", "Initial momenta.", determines=VELOCITY),
    "velocity": Option(
        *("initial", NUMBERS, "V1,V2,..", "Initial velocities, instead of momenta."), key="q_dot", determines=VELOCITY
    ),
}
"""Options of the initial state, whose values are checked with the coordinates of a system."""
OPTION = {
    name: row.named(name)
    for name, row in (STATE_OPTIONS | {row.name: row.metadata["option"] for row in fields(RunOptions)}).items()
}
OPTION["t_end"] = replace(OPTION["span"], field="t_end", range=FINITE)
"""Options of runs by field of models and keyword of Python, whose runs end at a time instead of after a duration."""


def in_words(text: str) -> str:
    """Return a text with the options ``{t_end}`` in the words of the face; ``{error=}``: in Python with this sign."""
    sign = "=" if FACE.get() in ("python", "model") else ""
    return re.sub(r"{(\w+)(=?)}", lambda match: OPTION[match[1]].word + (match[2] and sign), text)


def excluding(first: Option, second: Option) -> str:
    """Return the message on two options that determine the same."""
    return f"{first} and {second} exclude each other: each determines {first.determines}; omit one"


def lacking(determined: str) -> str:
    """Return the message on a quantity that no option determines."""
    words = dict.fromkeys(row.word for row in OPTION.values() if row.determines == determined)
    return f"give either {' or '.join(words)}, which determines {determined}; got neither"


def check_agreement(
    values: Mapping[str, Any],
    error: type[ScviCodegenError] = StateError,
    *,
    required: str = "",
    rows: Mapping[str, Option] = OPTION,
    partly: bool = False,
) -> None:
    """Raise an error for two values, by field, that exclude each other; ``None``: not given.

    Args:
        values: by field.
        error: type of the error.
        required: what one of them must determine.
        rows: options by field.
        partly: others may be given elsewhere, by a file that flags supplement, so that an absent step size says
            nothing about the kind of the steps.
    """
    named = {name for name, value in values.items() if value is not None}
    stated = [row for name, row in rows.items() if name in named]
    for first, second in combinations(stated, 2):
        if first.determines and first.determines == second.determines:
            raise error(excluding(first, second))
    size = next((row for row in stated if row.determines == STEP_SIZE), None)
    fixed = size is not None and size.field == "h"
    for row in stated:
        if row.requires == ADAPTIVE and fixed:
            raise error(in_words(f"{row} requires {ADAPTIVE}: give {{t_end}} without {{h}} and {{steps}}, or omit it"))
        if row.requires == FIXED and not fixed and not (partly and size is None):
            raise error(in_words(f"{row} requires {FIXED}: give {{h}}, or omit it and give {{t_end}}"))
    if required and required not in {row.determines for row in stated}:
        raise error(lacking(required))


def check_available(values: Mapping[str, Any], situation: str, rows: Mapping[str, Option]) -> None:
    """Raise :class:`StateError` for a value, by field, whose option is not available in a situation."""
    for name, value in values.items():
        if value is not None and situation in rows[name].unavailable:
            raise StateError(
                f"{rows[name]} is not available {situation}: {in_words(rows[name].unavailable[situation])}"
            )


def checked_step(h: Any) -> float:
    """Return a finite step size other than 0."""
    if type(h) is float and h and isfinite(h):
        return h
    return OPTION["h"].checked(h)  # type: ignore[no-any-return]
