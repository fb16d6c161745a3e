"""Validation of the arguments of public functions, with errors that name the argument and suggest keywords.

Types of arguments are checked when the function is called; numbers and arrays, which may be anything convertible, when
they are converted (:func:`checked_count`, :mod:`scvi_codegen.codegen.native.options`).
"""

from __future__ import annotations

import functools
import math
import numbers
import operator
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Context, Decimal
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np

from scvi_codegen.common.errors import ArgumentError, ScviCodegenError, StateError, closest

NUMERAL = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*(/\s*\d+\s*)?", re.ASCII | re.IGNORECASE)
"""Text of a decimal number, or of a fraction with a whole denominator."""
SIXTY_DIGITS = Context(prec=60)


class ExactNumber(float):
    """Nearest double to a number in text, ``"0.1"`` or ``"1/3"``; ``low`` is the nearest double to the rest."""

    low: float = 0.0
    decimal: Decimal | None = None

    def __new__(cls, text: str) -> Self:
        """Return the number in a text; raise ``ValueError`` for other text."""
        numerator, bar, denominator = text.partition("/")
        if not math.isfinite(high := float(numerator)):
            return super().__new__(cls, high)
        exact = Decimal(numerator.strip())
        if bar:
            if not NUMERAL.fullmatch(text) or not float(denominator):
                raise ValueError(f"'{text}' is not a fraction of numbers, as in 1/3")
            exact = SIXTY_DIGITS.divide(exact, Decimal(denominator.strip()))
            high = float(exact)
        number = super().__new__(cls, high)
        number.low = float(SIXTY_DIGITS.subtract(exact, Decimal(high))) if high else 0.0
        number.decimal = SIXTY_DIGITS.plus(exact)
        return number

    def __str__(self) -> str:
        return repr(self) if self.decimal is None else str(self.decimal)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self),)


@functools.cache
def hints() -> Mapping[str, Mapping[str, str]]:
    """Return ``synonyms`` in other programs by the names used here, and ``explanations`` by keyword."""
    import tomllib  # not needed without an error

    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def likely_names(word: str) -> Iterator[str]:
    """Yield the names used here for a word, the likeliest first."""
    for here, elsewhere in hints()["synonyms"].items():
        if {word, word.lower()} & {*here.split(), *elsewhere.split()}:
            yield from here.split()


def synonym_hint(word: str, keywords: Collection[str]) -> str:
    """Return ``"; did you mean 'h'?"`` if a known word has the same meaning, else an empty string."""
    return next((f"; did you mean '{meant}'?" for meant in likely_names(word) if meant in keywords), "")


def keyword_hint(name: str, keywords: Collection[str]) -> str:
    """Return ``"; did you mean 'h'?"`` for an unknown name, or ``": "`` and an explanation, or the list of keywords."""
    if here := synonym_hint(name, keywords):
        return here
    for word in (name, *likely_names(name)):
        if word in hints()["explanations"] and word not in keywords:
            return f": {hints()['explanations'][word]}"
    hint = closest(name, keywords)
    return f": it takes {', '.join(keywords)}" if hint == "." else hint


LARGEST_COUNT = 2**53 - 1
"""Largest integer below which binary64 represents every integer."""


def checked_count(
    value: Any, name: str, *, least: int, most: int = LARGEST_COUNT, error: type[ScviCodegenError] = StateError
) -> int:
    """Return the value as an int from ``least`` to ``most``, or raise an error that names it; booleans are rejected."""
    if type(value) is int and least <= value <= most:
        return value
    try:
        count = operator.index(value)
    except TypeError:
        count = None
    if count is None or isinstance(value, bool):
        raise error(f"{name} must be a whole number, not {value!r}")
    if count < least:
        raise error(f"{name} must be at least {least}, not {count}")
    if count > most:
        raise error(f"{name} must be at most {most}, not {count}")
    return count


Called = TypeVar("Called", bound=Callable[..., Any])
MAX_SHOWN_LENGTH = 60
MOST_ARGUMENTS = 2**31
"""Position of arguments that only ``**named`` accepts."""


@dataclass(frozen=True, slots=True)
class ArgumentType:
    """Type check of an argument: its description after "must be", and a predicate."""

    words: str
    accepts: Callable[[Any], bool]


class OfRunTimeSizes:
    """Base of types that count as others, but lack features; ``REQUIRES_SIZES`` explains it and names the remedy."""

    __slots__ = ()
    REQUIRES_SIZES: ClassVar[str]


def of(words: str, *types: type) -> ArgumentType:
    """Return the check for an instance of one of the types, for :class:`OfRunTimeSizes` of one that derives from it."""
    of_run_time_sizes = tuple(kind for kind in types if issubclass(kind, OfRunTimeSizes))

    def accepts(value: Any) -> bool:
        return isinstance(value, of_run_time_sizes if isinstance(value, OfRunTimeSizes) else types)

    return ArgumentType(words, accepts)


def several(words: str, *types: type) -> ArgumentType:
    """Return the check for a list, a tuple or another sequence of such instances, except text."""
    return ArgumentType(words, lambda value: _is_sequence(value) and all(isinstance(entry, types) for entry in value))


def _is_sequence(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


TEXT = of("text", str)
FORMULA = ArgumentType(
    "a formula as text, or a number",
    lambda value: isinstance(value, str | numbers.Real) and not isinstance(value, bool),
)
TEXTS = several("a list of texts", str)
NAMES = several("a list of names, as ['x', 'y']", str)
SWITCH = of("True or False", bool, np.bool_)
WHOLE = ArgumentType("a whole number", lambda value: hasattr(value, "__index__") and not isinstance(value, bool))
REAL = of("a number", numbers.Real)
PATH = of("a path", str, os.PathLike)
PATHS = ArgumentType("a list of paths", lambda value: not isinstance(value, str | os.PathLike))
TABLES = ArgumentType(
    "a list of declarations, as ['bonds[B, 2]'], or a mapping from them to arrays",
    lambda value: (_is_sequence(value) or isinstance(value, Mapping)) and all(isinstance(text, str) for text in value),
)
MAPPING = ArgumentType(
    "a mapping from names, as {'k': 2.0}",
    lambda value: isinstance(value, Mapping) and all(isinstance(name, str) for name in value),
)
MAPPINGS = several("a list of mappings", Mapping)
NUMBERS = ArgumentType("a list of numbers", lambda value: _is_sequence(value) or isinstance(value, np.ndarray))
MAPPED = of("a mapping, as {x: 2.0}", Mapping)
FORMULAS = ArgumentType("a list of formulas", lambda value: _is_sequence(value) or hasattr(value, "shape"))
FUNCTION = ArgumentType("a function", callable)
CANVAS = ArgumentType("Matplotlib axes", lambda value: hasattr(value, "plot") and hasattr(value, "figure"))


KINDS = {
    r"str": TEXT,
    r"bool": SWITCH,
    r"str \| float": FORMULA,
    r"str \| (os\.)?PathLike\[str\]": PATH,
    r"Iterable\[str \| (os\.)?PathLike\[str\]\]": PATHS,
    r"Sequence\[str\]": NAMES,
    r"Sequence\[str\] \| Mapping\[str, Any\]": TABLES,
    r"Sequence\[Mapping\[str, Any\]\]": MAPPINGS,
    r"Sequence\[Expr( \| str)?\]": FORMULAS,
    r"Mapping\[str, str\]": of("a mapping from names to names, as {'R': 'omega'}", Mapping),
    r"Mapping\[str, [^|]+\]": MAPPING,
    r"Mapping\[(Any|Expr|Symbol)( \| str)?, [^|]+\]": MAPPED,
    r"Callable\[.*\]": FUNCTION,
}
"""Checks of arguments by patterns of their annotations."""


def kind_of(annotation: object) -> ArgumentType | None:
    """Return the check of arguments with an annotation; ``None`` if they are checked when they are converted."""
    text = str(annotation).removesuffix(" | None")
    return next((kind for pattern, kind in KINDS.items() if re.fullmatch(pattern, text)), None)


def check_kind(kind: ArgumentType, value: Any, name: str, error: type[ScviCodegenError] = ArgumentError) -> None:
    """Raise an error that names the argument if the value fails the check."""
    if not kind.accepts(value):
        shown = repr(value)
        shown = shown if len(shown) <= MAX_SHOWN_LENGTH else f"{shown[:MAX_SHOWN_LENGTH]} .."
        raise error(f"{name} must be {kind.words}, not {shown}")


def _check_sizes(kind: ArgumentType, value: Any, function: str, error: type[ScviCodegenError]) -> None:
    if isinstance(value, OfRunTimeSizes) and not kind.accepts(value):
        raise error(f"{function}() is not available for {value!r:.60}: {value.REQUIRES_SIZES}")


OF_A_CACHE = ("cache_clear", "cache_info")
"""Functions of a cached function."""
KEEPS_FRAMES = sys.flags.dev_mode
"""Whether tracebacks of the errors of this package show its frames, as with ``python -X dev``, or end at the call."""


def _as_shown(raised: ScviCodegenError) -> ScviCodegenError:
    return raised if KEEPS_FRAMES else raised.with_traceback(None)


def _check_names(function: str, keywords: Collection[str], accepted: Collection[str]) -> None:
    for name in keywords:
        if name not in accepted:
            raise ArgumentError(f"{function}() takes no {name!r}{keyword_hint(name, accepted)}")


def checks_arguments(
    error: type[ScviCodegenError] = ArgumentError, /, **kinds: ArgumentType
) -> Callable[[Called], Called]:
    """Check arguments at each call by their annotations (:data:`KINDS`), or by ``kinds``, which take precedence.

    An argument whose default is ``None`` may be ``None``.

    >>> @checks_arguments()
    ... def greet(name: str):
    ...     return f"hello {name}"
    >>> greet(3)
    Traceback (most recent call last):
    scvi_codegen.common.errors.ArgumentError: name must be text, not 3

    A keyword that the function does not have raises an error with a suggestion. A type that lacks features explains it
    as a :class:`OfRunTimeSizes`.
    """

    def decorate(function: Called) -> Called:
        parameters = signature(function).parameters
        names = tuple(parameters)
        keyword_names = dict.fromkeys(name for name in names if name not in ("self", "cls"))
        open_ended = any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters.values())
        optional = {name for name in names if parameters[name].default is None}
        annotated = {name: kind for name in names if (kind := kind_of(parameters[name].annotation))}
        checks = annotated | kinds
        positions = [
            (names.index(name) if name in names else MOST_ARGUMENTS, name, kind) for name, kind in checks.items()
        ]
        unchecked = frozenset(keyword_names).difference(checks)
        first = min((position for position, _, _ in positions), default=MOST_ARGUMENTS)

        @functools.wraps(function)
        def checked(*arguments: Any, **keywords: Any) -> Any:
            try:
                if len(arguments) > first or not unchecked.issuperset(keywords):
                    check(arguments, keywords)
                return function(*arguments, **keywords)
            except ScviCodegenError as raised:
                raise _as_shown(raised) from raised.__cause__

        def check(arguments: tuple[Any, ...], keywords: dict[str, Any]) -> None:
            _check_names(function.__qualname__, keywords, keywords if open_ended else keyword_names)
            for position, name, kind in positions:
                if position < len(arguments) or name in keywords:
                    value = arguments[position] if position < len(arguments) else keywords[name]
                    if not (value is None and name in optional):
                        _check_sizes(kind, value, function.__qualname__, error)
                        check_kind(kind, value, name, error)

        vars(checked).update({name: getattr(function, name) for name in OF_A_CACHE if hasattr(function, name)})
        return cast(Called, checked)

    return decorate
