"""Written-out Lagrangians of many like terms as sums over indices: what is written n times is compiled once.

Terms that differ in their coordinates, parameters and numbers alone are of one family: sum(b in B, f(q[places[b, 0]],
q[places[b, 1]], c[b])), with a table of places and arrays of numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sympy import Add, Expr, Integer, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.symbols import DOT
from scvi_codegen.kinds import of, takes
from scvi_codegen.mechanics.indexed.system import IndexedSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.like_terms import LikeTerms, like_terms

__all__ = ["GatheredSums", "gather_sums"]

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
    kinds = like_terms(Add.make_args(system.lagrangian), places, defaults, MOST_FAMILIES)
    if not kinds:
        raise SystemDefinitionError(
            f"the terms of '{system.name}' are of more than {MOST_FAMILIES} kinds: they are no sums of few"
        )
    found = [_family(str(k), kind, defaults) for k, kind in enumerate(kinds)]
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


@dataclass(frozen=True, slots=True)
class _Family:
    """Terms of one kind: the formula of an element, its places, its numbers, and those that all have in common."""

    text: str
    table: NDArray[np.int32]
    fields: dict[str, NDArray[np.float64]]
    numbers: dict[str, float]


def _family(name: str, kind: LikeTerms, defaults: dict[Symbol, float]) -> _Family:
    fields: dict[str, NDArray[np.float64]] = {}
    numbers: dict[str, float] = {}
    constants: list[str] = []
    for k, column in enumerate(zip(*kind.constants, strict=True)):
        if len(set(column)) > 1:
            fields[f"c{name}_{k}"] = np.array([float(defaults.get(each, each)) for each in column])
            constants.append(f"c{name}_{k}[b]")
        else:
            numbers |= {column[0].name: defaults[column[0]]} if column[0] in defaults else {}
            constants.append(str(column[0]) if _is_plain(column[0]) else f"({column[0]})")
    text = kind.written(lambda k: f"[at{name}[b, {k}]]", constants.__getitem__)
    table = np.array(kind.places, dtype=np.int32).reshape(len(kind.places), -1)
    return _Family(text, table, fields, numbers)


def _is_plain(constant: Expr) -> bool:
    return isinstance(constant, Symbol | Integer) and not str(constant).startswith("-")
