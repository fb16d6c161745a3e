"""Equations and table entries as data, as plain text, LaTeX and HTML; numbers as short radicals (PSLQ)."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import sympy

from scvi_codegen.api.formulas import TIME, Number, mp, parse_expression, symbol
from scvi_codegen.api.methods import Method, StageSystem
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.api.text import Html, Typeset
from scvi_codegen.common.errors import ExpressionError
from scvi_codegen.systems.event import Event
from scvi_codegen.systems.symmetry.symmetry import Symmetry

LARGEST_BASIS = 8
LARGEST_COEFFICIENT = 10**5
SLACK = 6
"""Number of digits excluded from the comparison, so that 54 must agree."""


def radical_basis(expressions: Iterable[sympy.Expr]) -> tuple[sympy.Expr, ...]:
    """Return 1, the square roots in the expressions and their pairwise products; () if these are too many."""
    roots: set[sympy.Expr] = set()
    for expression in expressions:
        roots |= {atom for atom in expression.atoms(sympy.Pow) if atom.exp in (sympy.S.Half, -sympy.S.Half)}
    roots = {sympy.sqrt(root.base) if root.base.is_Rational else root for root in roots}
    squares = sorted({square_free(root) for root in roots}, key=str)
    basis = [sympy.S.One, *squares, *(sympy.sqrtdenest(a * b) for a, b in combinations(squares, 2))]
    return tuple(basis) if len(basis) <= LARGEST_BASIS else ()


def recognised(value: Number, basis: tuple[sympy.Expr, ...]) -> sympy.Expr | None:
    """Return the combination of basis elements with small rational coefficients that equals ``value``, or ``None``."""
    if value == 0:
        return sympy.S.Zero
    if not basis:
        return None
    tolerance = mp.mpf(10) ** (SLACK - mp.dps)
    relation = mp.pslq([value, *in_digits(basis)], tol=tolerance, maxcoeff=LARGEST_COEFFICIENT, maxsteps=10**5)
    if not relation or relation[0] == 0:
        return None
    terms = [sympy.Rational(-int(c), int(relation[0])) * e for c, e in zip(relation[1:], basis, strict=True)]
    return sympy.Add(*terms)


@lru_cache(maxsize=64)
def in_digits(basis: tuple[sympy.Expr, ...]) -> tuple[Number, ...]:
    """Return the elements in 60 digits."""
    return tuple(mp.mpf(str(sympy.N(element, mp.dps + 5))) for element in basis)


def square_free(root: sympy.Expr) -> sympy.Expr:
    """Return the square root of n without its rational factor."""
    coefficient, rest = sympy.sqrt(root.base).as_coeff_Mul()
    return rest if coefficient.is_Rational else root


LARGEST_DENOMINATOR = 10**6
"""Largest denominator that is shown; other rational numbers, as those of robots, are shown in 17 digits."""


def readable(expression: sympy.Expr) -> sympy.Expr:
    """Return an expression for display, with decimals instead of rational numbers of large denominators."""
    numbers = [number for number in expression.atoms(sympy.Rational) if number.q > LARGEST_DENOMINATOR]
    return expression.xreplace({number: sympy.Float(number, 17) for number in numbers})


def formula_text(expression: sympy.Expr) -> str:
    """Return a formula in the grammar of model files, unless decimals replace numbers in it."""
    shown = readable(expression)
    return MechanicalSystem.formula_text(expression) if shown == expression else str(shown)


LARGEST_SHOWN = 400
"""Largest number of operations of an equation that a notebook shows."""

End = Mapping[sympy.Symbol, "Equation"]
"""State at the end of a step, by the symbol of the state at its start."""


@dataclass(frozen=True, slots=True)
class TableEntry:
    """A number of a table: its symbol and name, its value in 60 digits, and a short exact form or ``None``."""

    symbol: sympy.Symbol
    name: Any
    value: Number
    exact: sympy.Expr | None

    def __str__(self) -> str:
        form = f" = {self.exact}" if self.exact is not None else ""
        return f"{self.symbol}{form} = {mp.nstr(self.value, 20)}"


@dataclass(frozen=True, slots=True)
class Equation:
    """Equation 0 = residual.

    Attributes:
        number: the paper's number, or the variable with respect to which a generating function is stationary.
        kind: ``"stage"``, ``"IDEL"`` (implicit discrete Euler-Lagrange), ``"multiplier"`` or ``"Legendre"``.
        residual: in the unknowns, (q_k, p_k, t_k, h), parameters and table entries.
    """

    number: str
    kind: str
    residual: sympy.Expr

    def __str__(self) -> str:
        return f"({self.number}) 0 = {readable(self.residual)}"


def text_lines(
    equations: Iterable[Equation], end: End, guess: Mapping[sympy.Symbol, sympy.Expr], entries: Sequence[TableEntry]
) -> Iterator[str]:
    """Yield the equations of a step in plain text."""
    yield "\nequations"
    yield from (f"  {equation}" for equation in equations)
    yield "\nend of the step"
    yield from (f"  ({e.number}) {symbol.name[:-2]}_(k+1) = {readable(e.residual)}" for symbol, e in end.items())
    yield "\nfirst guess (q_dot_k: the velocity that belongs to p_k)"
    yield from (f"  {symbol} = {value}" for symbol, value in guess.items())
    if entries:
        yield "\ntable entries"
        yield from (f"  {entry}" for entry in entries)


def latex(
    equations: Sequence[Equation], end: End, entries: Sequence[TableEntry], symmetries: Sequence[Symmetry]
) -> str:
    """Return an ``align*`` environment with numbers as tags, one for the tables, one for the momentum maps."""
    shown = [*(equation.residual for equation in (*equations, *end.values())), *(s.momentum_map for s in symmetries)]
    symbols = set(end).union(*(expression.free_symbols for expression in shown), (entry.symbol for entry in entries))
    names = {symbol: Typeset.latex_name(symbol.name) for symbol in symbols}

    def written(expression: sympy.Expr) -> str:
        return str(sympy.latex(readable(expression), symbol_names=names))

    def exact(entry: TableEntry) -> str:
        return written(entry.exact) + " = " if entry.exact is not None else ""

    lines = [rf"0 &= {written(e.residual)} \tag{{{_tag(e.number)}}}" for e in equations]
    for start, equation in end.items():
        new = Typeset.latex_name(f"{start.name}+1")
        lines.append(rf"{new} &= {written(equation.residual)} \tag{{{_tag(equation.number)}}}")
    tables = [rf"{names[entry.symbol]} &= {exact(entry)}{mp.nstr(entry.value, 17)}" for entry in entries]
    maps = [rf"J &= {written(s.momentum_map)} \tag{{{_tag(s.name)}}}" for s in symmetries]
    blocks = [block for block in (lines, tables, maps) if block]
    return "\n".join("\\begin{align*}\n" + " \\\\\n".join(block) + "\n\\end{align*}" for block in blocks)


def html(equation: Equation) -> Html:
    """Return an equation for a notebook, or its size if that is large."""
    size = sympy.count_ops(equation.residual)
    if size > LARGEST_SHOWN:
        return Html(f"<div>{Html.plain(f'({equation.number}) {size} operations')}</div>")
    terms = " ".join(Typeset.terms(readable(equation.residual), sympy.S.Zero))
    return Html(f"<div>{Html.plain(f'({equation.number})')} {terms}</div>")


def _tag(number: str) -> str:
    if not number.startswith("dG"):
        return number.replace("_", r"\_")
    return "$" + number.replace("dG", r"\partial G").replace("/d", r"/\partial ") + "$"


def entries(values: Mapping[sympy.Symbol, tuple[Any, Number]], method: Method) -> tuple[TableEntry, ...]:
    """Return numbers of a method's tables by symbol, sorted by name and index, with their radicals."""
    basis = _basis(method)
    result = [TableEntry(symbol, name, value, recognised(value, basis)) for symbol, (name, value) in values.items()]
    return tuple(sorted(result, key=lambda entry: (entry.name.of, entry.name.indices)))


def table_entries(stages: StageSystem, method: Method) -> tuple[TableEntry, ...]:
    """Return the named numbers of all tables of a method's equations, also those that do not occur in the equations."""
    tables = [stages.end_position]
    values: dict[Any, Number] = {}
    for group in stages.stage_groups:
        tables += [gather.table for gather in group.gathers] + [scatter.table for scatter in group.scatters]
        values |= {name: weight for name, weight in zip(group.weight_names, group.weights, strict=True) if name}
    for table in tables:
        for names, numbers in zip(table.names, table.entries, strict=True):
            for name, value in zip(names, numbers, strict=True):
                if name:
                    values[name] = value / name.factor.numerator * name.factor.denominator
    return entries({sympy.Symbol(name.number, real=True): (name, value) for name, value in values.items()}, method)


@lru_cache(maxsize=64)
def _basis(method: Method) -> tuple[sympy.Expr, ...]:
    """Return 1 and the roots in the method's nodes and points with their products; () if one has no closed form."""
    forms = method.closed_forms
    return () if None in forms else radical_basis(x for form in forms for x in form or ())


IMPULSE = "p := p + (1 + e)/2 lambda n, H(q, p + lambda n) - H(q, p) + lambda g_t = 0"
MODES = """Modes of contacts: open, 0 <= g; stick, g = 0 and w = 0; slip in the direction d = w/|w|, g = 0.
Forces (G - mu d T)^T lambda + T^T tau with G = g_q, T = w_v; without gap - limit d T^T + T^T tau.
Transitions: g = 0 closes; lambda = 0 lifts; w = 0 stops; |tau| = mu_s lambda, or the static limit, begins to slip."""
SALTATION = """Derivatives by saltation matrices (scvi_codegen.runs.events.saltation): of z = (q, p) := R(z, t)
    dz := R_z (dz + X- dt) + R_t dt - X+ dt, dt = -g_z dz/(g_z X- + g_t)
    X-, X+: derivatives of the steps before and after the event with respect to their sizes"""


def contact_lines(system: MechanicalSystem) -> list[str]:
    """Return the formulas of the contacts of a system, and the conditions of their modes, in lines."""
    lines = []
    for k, contact in enumerate(getattr(system, "contacts", ()), 1):
        formulas = (f"{name} = {value}" for name, value in contact.table.items())
        lines.append(f"contact {k}: {', '.join(formulas)}")
    if lines:
        lines.append(MODES)
    return lines


def events_text(events: Iterable[Event], system: MechanicalSystem) -> str:
    """Return the formulas of events in lines; of an impact its impulse, normal n = g_q, g_t and restitution e."""
    return "\n".join(["Events:", *(line for event in events for line in _lines(event, system)), SALTATION])


def _lines(event: Event, system: MechanicalSystem) -> Iterator[str]:
    conditions = event.where if isinstance(event.where, tuple) else (event.where,)
    yield f"  g = {event.function} = 0" + "".join(f", {condition}" for condition in conditions if condition is not None)
    yield from (f"    {name} := {value}" for name, value in event.changes)
    if event.restitution is None:
        return
    yield f"    {IMPULSE}"
    names = [*map(str, system.coordinates)]
    symbols = {name: symbol(name) for name in (*names, *map(str, system.parameters), TIME)}
    with suppress(ExpressionError):  # entries of arrays, components of rotations
        g = parse_expression(str(event.function), symbols)
        yield f"    n = ({', '.join(str(g.diff(symbols[name])) for name in names)}), g_t = {g.diff(symbols[TIME])}"
    yield f"    e = {event.restitution}"
