"""Rolling of repeated terms into loops: a system of many similar terms becomes an indexed system, compiled once.

Terms that differ only in their coordinates, parameters and numbers form one group, sum(b in B, f(q[at[b, 0]],
q[at[b, 1]], c[b])), with an index table and arrays of numbers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sympy import Add, Expr, Integer, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.inputs import input_formulas
from scvi_codegen.formulas.symbols import DOT, symbol
from scvi_codegen.mechanics.indexed.system import IndexedSystem
from scvi_codegen.mechanics.similar_terms import SimilarTerms, similar_terms
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem
from scvi_codegen.representation import summary
from scvi_codegen.validation.argument_types import checks_arguments

__all__ = ["RolledSums", "roll_sums"]

MAX_TERM_GROUPS = 64
"""Maximum number of term groups; systems with more are rejected."""


@dataclass(frozen=True, slots=True)
class RolledSums:
    """Indexed system with the data that make it equal to the original system.

    Attributes:
        system: with one array q[N], the coordinates in their order; named qg[Ng] or the like, as are other names, if
            a parameter or an input of the system has one of these names.
        tables: index tables by name.
        parameters: arrays of numbers, one per element, by name; both in the form that runs accept.
    """

    system: IndexedSystem
    tables: dict[str, NDArray[np.int32]]
    parameters: dict[str, NDArray[np.float64]]

    __repr__ = summary("system", "tables", "parameters")


@checks_arguments(SystemDefinitionError, system=SYSTEM)
def roll_sums(system: MechanicalSystem) -> RolledSums:
    """Return the indexed system of a Lagrangian or Hamiltonian with many similar terms, and of its forces.

    Parameters that differ from term to term become arrays of their default values; the others remain parameters.

    Raises:
        SystemDefinitionError: if the system has constraints, damping or a time transformation, has more than
            ``MAX_TERM_GROUPS`` kinds of terms, or if a Lagrangian contains velocities other than as m*v**2/2.

    >>> from scvi_codegen.mechanics.lagrangian import LagrangianSystem
    >>> chain = LagrangianSystem.from_text(
    ...     name="chain", coordinates=["x", "y", "z"],
    ...     lagrangian="x_dot**2/2 + y_dot**2/2 + z_dot**2/2 - (x - y)**2/2 - 3*(y - z)**2/2")
    >>> print(roll_sums(chain).system)
    chain: L(q[N]) = sum(b in B0, c0_1[b]*(-q[at0[b, 0]] + q[at0[b, 1]])**2) + sum(b in B1, q_dot[at1[b, 0]]**2/2)
    """
    _check_supported(system)
    mark = _mark({*map(str, system.constants), *system.inputs})
    q, p, b, n = (f"{name}{mark}" for name in "qpbN")
    places = {each: (q, k) for k, each in enumerate(system.coordinates)}
    places |= {each: (f"{q}{DOT}", k) for k, each in enumerate(system.velocities)}
    places |= {each: (p, k) for k, each in enumerate(system.auxiliaries)}
    named = {formula: name for name, formula in input_formulas(system.inputs, system.time).items()}
    function, *forces = (each.xreplace(named) for each in (system.formula, *system.forces))
    acting = [(term, (k,)) for k, force in enumerate(forces) if force != 0 for term in Add.make_args(force)]
    defaults = _defaults(system, (function, *forces))
    kinds = similar_terms(Add.make_args(function), places, defaults, MAX_TERM_GROUPS)
    force_kinds = similar_terms(
        (term for term, _ in acting), places, defaults, MAX_TERM_GROUPS, (target for _, target in acting)
    )
    if not kinds or (acting and not force_kinds):
        raise SystemDefinitionError(
            f"the terms of '{system.name}' have more than {MAX_TERM_GROUPS} different structures: "
            "systems with so few repeated terms cannot be rolled into sums"
        )
    found = [_term_group(f"{mark}{k}", b, kind, defaults) for k, kind in enumerate((*kinds, *force_kinds))]
    used = {name: value for each in found for name, value in each.numbers.items()}
    fields = {f"{name}[B{mark}{k}]": 1.0 for k, each in enumerate(found) for name in each.fields}
    written = " + ".join(f"sum({b} in B{mark}{k}, {each.text})" for k, each in enumerate(found[: len(kinds)]))
    given = {"hamiltonian": written, "momenta": [f"{p}[{n}]"]} if system.auxiliaries else {"lagrangian": written}
    return RolledSums(
        IndexedSystem.from_text(
            name=system.name,
            coordinates=[f"{q}[{n}]"],
            parameters={**used, **fields},
            tables=[f"at{mark}{k}[B{mark}{k}, {each.table.shape[1]}]" for k, each in enumerate(found)],
            forces={f"{q}[at{mark}{k}[{b}, 0]]": each.text for k, each in enumerate(found) if k >= len(kinds)},
            inputs=system.inputs,
            **given,
        ),
        {f"at{mark}{k}": each.table for k, each in enumerate(found)},
        {name: values for each in found for name, values in each.fields.items()},
    )


def _mark(names: set[str]) -> str:
    """Return a suffix that keeps names of arrays, indices, sizes and tables apart from those of parameters."""
    mark = ""
    while any(re.fullmatch(rf"(q|p|b|N|p_q){mark}|q{mark}{DOT}|(at|B|c){mark}\d+(_\d+)?", name) for name in names):
        mark += "g"
    return mark


def _check_supported(system: MechanicalSystem) -> None:
    for what, given in (
        ("constraints", system.constraints),
        ("damping", system.damping != 0),
        ("transformed time", system.clock),
    ):
        if given:
            raise SystemDefinitionError(f"'{system.name}' has {what}, which systems rolled into sums do not support")


def _defaults(system: MechanicalSystem, formulas: Sequence[Expr]) -> dict[Symbol, float]:
    """Return the default values of the parameters, components of inputs excluded."""
    parts = {symbol(f"{name}_{part}") for name in system.inputs for part in "0123t"}
    if any(parts & formula.free_symbols for formula in formulas):
        raise SystemDefinitionError(
            f"an input of '{system.name}' occurs in expanded form and cannot be recognised: multiply the formula out"
        )
    return {name: value for name, value in system.constants.items() if name not in parts}


@dataclass(frozen=True, slots=True)
class _TermGroup:
    """Group of similar terms: formula of an element, index table, arrays of numbers, and numbers common to all."""

    text: str
    table: NDArray[np.int32]
    fields: dict[str, NDArray[np.float64]]
    numbers: dict[str, float]


def _term_group(name: str, index: str, kind: SimilarTerms, defaults: dict[Symbol, float]) -> _TermGroup:
    fields: dict[str, NDArray[np.float64]] = {}
    numbers: dict[str, float] = {}
    constants: list[str] = []
    for k, column in enumerate(zip(*kind.constants, strict=True)):
        if len(set(column)) > 1:
            fields[f"c{name}_{k}"] = np.array([float(defaults.get(each, each)) for each in column])
            constants.append(f"c{name}_{k}[{index}]")
        else:
            numbers |= {column[0].name: defaults[column[0]]} if column[0] in defaults else {}
            constants.append(str(column[0]) if _is_plain(column[0]) else f"({column[0]})")
    text = kind.written(lambda k: f"[at{name}[{index}, {k}]]", constants.__getitem__)
    width = max(1, *map(len, kind.places))  # terms without coordinates have one column, which is never read
    table = np.zeros((len(kind.places), width), dtype=np.int32)
    table[:, : len(kind.places[0])] = kind.places
    return _TermGroup(text, table, fields, numbers)


def _is_plain(constant: Expr) -> bool:
    return isinstance(constant, Symbol | Integer) and not str(constant).startswith("-")
