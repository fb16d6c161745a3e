"""Written-out Lagrangians of many like terms as sums over indices: what is written n times is compiled once.

Terms that differ in their coordinates, parameters and numbers alone are of one family: sum(b in B, f(q[places[b, 0]],
q[places[b, 1]], c[b])), with a table of places and arrays of numbers. That two terms are of one family is read off
their trees: arguments of sums and products in the order of what they are without names, leaves in the order of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from sympy import Add, Expr, Integer, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.symbols import DOT
from scvi_codegen.formulas.vocabulary import NAME_OF
from scvi_codegen.kinds import of, takes
from scvi_codegen.mechanics.indexed.system import IndexedSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

__all__ = ["GatheredSums", "gather_sums"]

Item = TypeVar("Item")
MOST_FAMILIES = 64
"""More are no few kinds of terms."""


@dataclass(frozen=True, slots=True)
class GatheredSums:
    """A system as sums over indices, and the data with which it is the system that was written out.

    Attributes:
        system: of one array q[N], the coordinates in their order.
        tables: places by name; parameters: numbers, one an element, by name; both as runs take them.
    """

    system: IndexedSystem
    tables: dict[str, NDArray[np.int32]]
    parameters: dict[str, NDArray[np.float64]]


@takes(SystemDefinitionError, system=of("a LagrangianSystem", LagrangianSystem))
def gather_sums(system: LagrangianSystem) -> GatheredSums:
    """Recognise the families of terms of a Lagrangian.

    Parameters that differ from term to term become data with the values that they have as defaults; others stay.

    Raises:
        SystemDefinitionError: where forces, constraints or inputs stand beside the Lagrangian, where its terms are of
            many kinds, and for velocities in other forms than m*v**2/2.

    >>> chain = LagrangianSystem.from_text(
    ...     name="chain", coordinates=["x", "y", "z"],
    ...     lagrangian="x_dot**2/2 + y_dot**2/2 + z_dot**2/2 - (x - y)**2/2 - 3*(y - z)**2/2")
    >>> print(gather_sums(chain).system)
    chain: L(q[N]) = sum(b in B0, q_dot[at0[b, 0]]**2/2) + sum(b in B1, c1_0[b]*(q[at1[b, 0]] - q[at1[b, 1]])**2)
    """
    for what, given in (("forces", any(system.forces)), ("constraints", system.constraints), ("inputs", system.inputs)):
        if given:
            raise SystemDefinitionError(f"{what} beside the Lagrangian of '{system.name}' are not gathered into sums")
    places = {q: ("q", k) for k, q in enumerate(system.coordinates)}
    places |= {v: (f"q{DOT}", k) for k, v in enumerate(system.velocities)}
    defaults = dict(zip(system.parameters, system.defaults, strict=True))
    families: dict[str, list[_Term]] = {}
    for term in Add.make_args(system.lagrangian):
        read = _Term(places, set(defaults))
        families.setdefault(read.write(term), []).append(read)
        if len(families) > MOST_FAMILIES:
            raise SystemDefinitionError(
                f"the terms of '{system.name}' are of more than {MOST_FAMILIES} kinds: they are no sums of few"
            )
    found = [_family(str(k), text, terms, defaults) for k, (text, terms) in enumerate(sorted(families.items()))]
    used = {name: value for each in found for name, value in each.numbers.items()}
    fields = {f"{name}[B{k}]": 1.0 for k, each in enumerate(found) for name in each.fields}
    return GatheredSums(
        IndexedSystem.from_text(
            name=system.name,
            coordinates=["q[N]"],
            parameters={**used, **fields},
            tables=[f"at{k}[B{k}, {max(1, each.table.shape[1])}]" for k, each in enumerate(found)],
            lagrangian=" + ".join(f"sum(b in B{k}, {each.text})" for k, each in enumerate(found)),
        ),
        {f"at{k}": each.table for k, each in enumerate(found)},
        {name: values for each in found for name, values in each.fields.items()},
    )


@dataclass(slots=True)
class _Term:
    """A term as text with numbered leaves.

    Attributes:
        places: array and place of each coordinate and velocity.
        names: of parameters.
        rows: the places that occur, in order.
        constants: numbers and parameters, in order, those of one name once.
    """

    places: dict[Symbol, tuple[str, int]]
    names: set[Symbol]
    rows: list[int] = field(default_factory=list)
    constants: list[Expr] = field(default_factory=list)

    def write(self, formula: Expr) -> str:
        """Its text; a place is {0}, a constant [0]."""
        if formula.is_Pow:
            return f"({self.write(formula.base)})**({formula.exp})"
        if formula.is_Add or formula.is_Mul:
            parts = [self.write(part) for part in sorted(formula.args, key=self.shape)]
            return f"({(' + ' if formula.is_Add else '*').join(parts)})"
        if formula.args:
            return f"{NAME_OF[formula.func]}({', '.join(self.write(part) for part in formula.args)})"
        if formula in self.places:
            array, place = self.places[formula]
            return f"{array}{{{_number(self.rows, place)}}}"
        if formula.is_Number or formula in self.names:
            return f"[{_number(self.constants, formula)}]"
        return str(formula)

    def shape(self, formula: Expr) -> str:
        """The same without numbers of leaves."""
        if formula.is_Pow:
            return f"({self.shape(formula.base)})**({formula.exp})"
        if formula.args:
            return f"{formula.func.__name__}({', '.join(sorted(map(self.shape, formula.args)))})"
        if formula in self.places:
            return self.places[formula][0]
        return "c" if formula.is_Number or formula in self.names else str(formula)


def _number(known: list[Item], item: Item) -> int:
    """The place of an item in a list, at whose end it is put if it is not there."""
    if item not in known:
        known.append(item)
    return known.index(item)


@dataclass(frozen=True, slots=True)
class _Family:
    """Terms of one kind: the formula of an element, its places, its numbers, and those that all have in common."""

    text: str
    table: NDArray[np.int32]
    fields: dict[str, NDArray[np.float64]]
    numbers: dict[str, float]


def _family(name: str, text: str, terms: Sequence[_Term], defaults: dict[Symbol, float]) -> _Family:
    fields: dict[str, NDArray[np.float64]] = {}
    numbers: dict[str, float] = {}
    for k, column in enumerate(zip(*(term.constants for term in terms), strict=True)):
        if len(set(column)) > 1:
            fields[f"c{name}_{k}"] = np.array([float(defaults.get(each, each)) for each in column])
            text = text.replace(f"[{k}]", f"c{name}_{k}<b>")
        else:
            numbers |= {column[0].name: defaults[column[0]]} if column[0] in defaults else {}
            text = text.replace(f"[{k}]", str(column[0]) if _is_plain(column[0]) else f"({column[0]})")
    for k in range(len(terms[0].rows)):
        text = text.replace(f"{{{k}}}", f"[at{name}<b, {k}>]")
    table = np.array([term.rows for term in terms], dtype=np.int32).reshape(len(terms), -1)
    return _Family(text.replace("<", "[").replace(">", "]"), table, fields, numbers)


def _is_plain(constant: Expr) -> bool:
    return isinstance(constant, Symbol | Integer) and not str(constant).startswith("-")
