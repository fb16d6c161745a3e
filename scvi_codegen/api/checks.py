"""Checks of arguments, whose errors name the argument, the value and what is required.

``checks_arguments(error, /, **kinds)``
    Decorator: raises ``error`` for an argument that its annotation, or its :class:`Kind`, does not accept.
``checked_count(value, name, *, least, most, error)``
    Whole number in a range; booleans are rejected.
"""

from typing import ClassVar

from scvi_codegen.common.validation import (
    CANVAS,
    MAPPING,
    NAMES,
    NUMBERS,
    REAL,
    SWITCH,
    TEXTS,
    WHOLE,
    ArgumentType,
    check_kind,
    checked_count,
    checks_arguments,
    of,
)

__all__ = ["Kind", "checked_count", "checks_arguments"]


class Kind(ArgumentType):
    """Check of an argument: ``Kind("a path or None", predicate)``; the words follow "must be" in the error.

    Its attributes are kinds of this sort; ``Kind.of("a family", Family)`` accepts instances of types, and
    ``Kind.check(kind, value, name, error)`` raises the error.
    """

    __slots__ = ()
    REAL: ClassVar[ArgumentType] = REAL
    WHOLE: ClassVar[ArgumentType] = WHOLE
    SWITCH: ClassVar[ArgumentType] = SWITCH
    NUMBERS: ClassVar[ArgumentType] = NUMBERS
    NAMES: ClassVar[ArgumentType] = NAMES
    TEXTS: ClassVar[ArgumentType] = TEXTS
    MAPPING: ClassVar[ArgumentType] = MAPPING
    CANVAS: ClassVar[ArgumentType] = CANVAS
    of = staticmethod(of)
    check = staticmethod(check_kind)
