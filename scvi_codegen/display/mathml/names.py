"""Parser of names of symbols: ``theta_1_dot`` is a letter with an accent and an index, ``l_1_0`` is l_0(tau_1)."""

import re
from dataclasses import dataclass, field

import sympy
from sympy.printing.pretty.pretty_symbology import greek_unicode

ACCENTS = {"dot": "˙", "ddot": "¨", "hat": "^", "tilde": "~", "bar": "¯"}
LATEX_ACCENT = re.compile(r"\\(dot|ddot|hat|tilde|bar)\{?(\w+?)\}?(?=[_^]|$)")
RAISED = ("Q", "V", "P")
"""Letters whose first index counts nodes: Q_1_x is component x of Q at node 1, as the paper has it."""
CARDINAL = {"l": "", "dl": "dot"}
"""Tables of cardinal functions at points, with their accent: l_1_0 is l_0(tau_1)."""
PRODUCTS = {"DD": ("D_hat", "D_tilde"), "aa": ("A__2",), "bA": ("b", "A")}
"""Tables that are products of matrices: DD_1_0 is entry (1, 0) of the product, DD_n_j any."""
RUNNING = ("i", "j", "n")
"""Indices of sums."""
TOKEN = re.compile(r"[^\W\d]+\d*|\d+|\S")
"""Pieces of an index: letters with their digits, a number, or a sign."""
GREEK = {letter: name for name, letter in greek_unicode.items()}


@dataclass(frozen=True, slots=True)
class Name:
    """Parts of a symbol's name: ``theta_1_dot`` is θ with an accent and one index."""

    letter: str
    accent: str = ""
    below: tuple[str, ...] = field(default=())
    above: tuple[str, ...] = field(default=())


def parsed(name: str) -> Name:
    """Return the parts of names as the package makes them (q_dot, p_q1_k, Q_2_x) and as SymPy does (Q__2_x, theta1)."""
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


@dataclass(frozen=True, slots=True)
class TableName:
    """An entry of a derived table: a cardinal function at a point, or matrices with the indices of their product."""

    factors: tuple[Name, ...]
    point: Name | None
    indices: tuple[str, ...]


def table_name(name: str) -> TableName | None:
    """Return the entry of a table that a symbol denotes if its name is that of one."""
    prefix, *indices = name.lstrip("_").split("_")
    if prefix in CARDINAL and len(indices) == 2 and all(map(str.isdigit, indices)):
        return TableName((Name("l", CARDINAL[prefix], below=(indices[1],)),), Name("τ", below=(indices[0],)), ())
    if prefix in PRODUCTS and indices and all(index.isdigit() or index in RUNNING for index in indices):
        return TableName(tuple(map(parsed, PRODUCTS[prefix])), None, tuple(indices))
    return None


def latex_name(name: str) -> str:
    """Return the name in LaTeX: ``l_1_0`` as l_0(tau_1), ``Q_2_x`` with 2 above and x below."""
    entry = table_name(name)
    if entry is None:
        return _latex(parsed(name))
    factors = "".join(map(_latex, entry.factors))
    return f"{factors}({_latex(entry.point)})" if entry.point else f"({factors}){_script('_', entry.indices)}"


def _latex(name: Name) -> str:
    letter = str(sympy.latex(sympy.Symbol(GREEK.get(name.letter, name.letter))))
    accented = rf"\{name.accent}{{{letter}}}" if name.accent else letter
    return f"{accented}{_script('_', name.below)}{_script('^', name.above)}"


def _script(sign: str, parts: tuple[str, ...]) -> str:
    written = ",".join("".join(_latex(parsed(t)) if t[0].isalpha() else t for t in TOKEN.findall(p)) for p in parts)
    return f"{sign}{{{written}}}" if parts else ""
