"""Names of symbols taken apart: ``theta_1_dot`` is a letter with an accent and an index."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from sympy.printing.pretty.pretty_symbology import greek_unicode

__all__ = ["ACCENTS", "Name", "parsed"]

ACCENTS = {"dot": "˙", "ddot": "¨", "hat": "^", "tilde": "~", "bar": "¯"}
LATEX_ACCENT = re.compile(r"\\(dot|ddot|hat|tilde|bar)\{?(\w+?)\}?(?=[_^]|$)")
RAISED = ("Q", "V", "P")
"""Letters whose first index counts nodes: Q_1_x is component x of Q at node 1, as the paper has it."""


@dataclass(frozen=True, slots=True)
class Name:
    """What a symbol's name is made of: ``theta_1_dot`` is θ with an accent and one index."""

    letter: str
    accent: str = ""
    below: tuple[str, ...] = field(default=())
    above: tuple[str, ...] = field(default=())


def parsed(name: str) -> Name:
    """Names as the package makes them (q_dot, p_q1_k, Q_2_x) and as SymPy knows them (Q__2_x, theta1)."""
    plain = LATEX_ACCENT.sub(r"\2_\1", name.strip("_") or name)
    head, *raised = re.split(r"__|\^", plain)
    above: list[str] = []
    letter, *below = head.split("_")
    for part in raised:
        first, *rest = part.split("_")
        above.append(first)
        below += rest
    accent = next((part for part in below if part in ACCENTS), "")
    if accent:
        below.remove(accent)
    if letter in RAISED and not above and below and below[0].isdigit():
        above.append(below.pop(0))
    if match := re.fullmatch(r"([^\W\d]+)(\d+)", letter):
        letter, below = match[1], [match[2], *below]
    return Name(str(greek_unicode.get(letter, letter)), accent, tuple(filter(None, below)), tuple(above))
