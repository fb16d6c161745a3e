"""C text in double precision to the same text in single precision, for processors whose registers hold 32 bits.

The two differ in the names of types, limits and functions and in the spelling of literals, and in nothing else: the
text is translated token by token. Comments and strings stay as they are.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from itertools import chain

from scvi_codegen.errors import MethodError

__all__ = ["SINGLE_UNIT", "check_single", "to_single"]

SINGLE_UNIT = 2.0**-23
"""The round-off unit of binary32, relative to which 2**-52 is that of binary64."""

SMALLEST = 2.0**-126
"""Smallest number with all 24 digits."""

LARGEST = (2.0 - 2.0**-23) * 2.0**127

TOKEN = re.compile(
    r"""
      (?P<kept> /\*.*?\*/ | "(?:[^"\\\n]|\\.)*" | ^\#include[^\n]* )
    | (?P<name> [A-Za-z_]\w* )
    | (?P<real> (?: \d+\.\d* | \.\d+ ) (?: [eE][+-]?\d+ )? | \d+[eE][+-]?\d+ )
    | (?P<other> \d\w* | . )
    """,
    re.DOTALL | re.MULTILINE | re.VERBOSE,
)

FUNCTIONS = """
    fabs sqrt cbrt pow exp log sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh fma
""".split()  # noqa: SIM905  (a paragraph of words reads better)
SPELLING = dict(
    chain(
        [("double", "float")],
        ((f"DBL_{name}", f"FLT_{name}") for name in ("EPSILON", "MIN", "MAX")),
        ((name, f"{name}f") for name in FUNCTIONS),
    )
)


def to_single(text: str) -> str:
    """The same program in single precision; what is left of a zero in tables of sixty digits becomes 0."""
    return TOKEN.sub(_translate, text)


def check_single(values: Iterable[float]) -> None:
    """Raise :class:`MethodError` for numbers of a model that single precision cannot hold."""
    for value in values:
        if value != 0.0 and not SMALLEST <= abs(value) <= LARGEST:
            raise MethodError(f"single precision cannot hold the number {value!r}: choose other units, or 'double'")


def _translate(token: re.Match[str]) -> str:
    word = token[0]
    if token.lastgroup == "name":
        return SPELLING.get(word, word)
    return _literal(word) if token.lastgroup == "real" else word


def _literal(word: str) -> str:
    """A C float literal of nine digits, which reads back as the nearest binary32 number."""
    (nearest,) = struct.unpack("f", struct.pack("f", float(word)))
    digits = f"{nearest:.9g}"
    return f"{digits}f" if "." in digits or "e" in digits else f"{digits}.0f"
