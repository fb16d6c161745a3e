"""Rolling of repeated terms into loops, and unrolling for known sizes.

A system of many similar terms becomes an array system, compiled once: terms that differ only in their coordinates,
parameters and numbers form one group, sum(b in B, f(q[at[b, 0]], q[at[b, 1]], c[b])), with an index table and arrays of
numbers. For known sizes, an array system has an equivalent system of named coordinates, which has every feature; its
integrator is derived independently, so the two can be compared.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sympy import Add, Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.systems.arrays.elements import unrolled_fields
from scvi_codegen.systems.arrays.system import ARRAYS, ArrayHamiltonian, ArrayLagrangian, ArraySystem
from scvi_codegen.systems.first_order import system_of
from scvi_codegen.systems.formulas.array_statements import ArrayForce
from scvi_codegen.systems.formulas.arrays import ArrayTerm, term_of
from scvi_codegen.systems.formulas.indices import Access, Array, Loop, Place, Size
from scvi_codegen.systems.formulas.symbols import DOT, input_formulas, symbol, with_inputs
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.system import MechanicalSystem
from scvi_codegen.systems.term_groups import MAX_GROUPS, SimilarTerms, TermGroup, similar_terms


@dataclass(frozen=True, slots=True)
class RolledSums:
    """Array system with the data that make it equal to the original system.

    Attributes:
        system: with one array q[N], the coordinates in their order; named qg[Ng] or the like, as are other names, if
            a parameter or an input of the system has one of these names.
        tables: index tables by name.
        parameters: arrays of numbers, one per element, by name; both in the form that runs accept.
    """

    system: ArraySystem
    tables: dict[str, NDArray[np.int32]]
    parameters: dict[str, NDArray[np.float64]]

    __repr__ = summary("system", "tables", "parameters")


@checks_arguments(SystemDefinitionError, system=MechanicalSystem.KIND)
def roll_sums(system: MechanicalSystem) -> RolledSums:
    """Return the array system of a Lagrangian or Hamiltonian with many similar terms, and of its forces.

    Parameters that differ from term to term become arrays of their default values; the others remain parameters.

    Raises:
        SystemDefinitionError: if the system has constraints, damping or a time transformation, has more than
            ``MAX_GROUPS`` kinds of terms, or if a Lagrangian contains velocities other than as m*v**2/2.

    >>> from scvi_codegen.systems.lagrangian import LagrangianSystem
    >>> chain = LagrangianSystem.from_text(
    ...     name="chain", coordinates=["x", "y", "z"],
    ...     lagrangian="x_dot**2/2 + y_dot**2/2 + z_dot**2/2 - (x - y)**2/2 - 3*(y - z)**2/2")
    >>> print(roll_sums(chain).system)
    chain: L(q[N]) = sum(b in B0, c0_1[b]*(-q[at0[b, 0]] + q[at0[b, 1]])**2) + sum(b in B1, q_dot[at1[b, 0]]**2/2)
    """
    _check_supported(system)
    mark = _mark({*map(str, system.constants), *system.inputs})
    inputs = input_formulas(system.inputs, system.time)
    named = {formula: name for name, formula in inputs.items()}
    q, q_dot, p = (Array(f"{name}", (Size(f"N{mark}"),)) for name in (f"q{mark}", f"q{mark}{DOT}", f"p{mark}"))
    pairs = ((q, system.coordinates), (q_dot, system.velocities), (p, system.auxiliaries))
    indices = {variable: (array.name, k) for array, symbols in pairs for k, variable in enumerate(symbols)}
    function, *forces = (formula.xreplace(named) for formula in (system.formula, *system.forces))
    defaults = _defaults(system, (function, *forces))
    kinds = similar_terms(Add.make_args(function), indices, defaults)
    applied = {(k,): Add.make_args(force) for k, force in enumerate(forces) if force != 0}
    targets = (target for target, terms in applied.items() for _ in terms)
    force_kinds = similar_terms(chain(*applied.values()), indices, defaults, targets)
    if not kinds or (applied and not force_kinds):
        raise SystemDefinitionError(
            f"the terms of '{system.name}' have more than {MAX_GROUPS} different structures: "
            "systems with so few repeated terms cannot be rolled into sums"
        )
    arrays = {array.name: array for array, _ in pairs} | {"": q}
    parts = [_Rolled.of(kind, f"{mark}{k}", f"b{mark}", arrays) for k, kind in enumerate((*kinds, *force_kinds))]
    used = set[Symbol]().union(*(part.group.formula.free_symbols for part in parts))
    constants = {parameter.name: value for parameter, value in defaults.items() if parameter in used}
    numbers = with_inputs(constants, system.inputs)
    fields = dict(chain.from_iterable(part.fields(defaults) for part in parts))
    momenta = (p,) if system.auxiliaries else ()
    rolled = (ArrayHamiltonian if momenta else ArrayLagrangian)(
        name=system.name,
        coordinates=(q,),
        momenta=momenta,
        time=system.time,
        parameters=tuple(map(symbol, numbers)),
        defaults=tuple(numbers.values()),
        fields=tuple(fields),
        field_defaults=(1.0,) * len(fields),
        tables=tuple(part.table for part in parts),
        terms=tuple(part.term(inputs) for part in parts[: len(kinds)]),
        forces=tuple(part.force(inputs) for part in parts[len(kinds) :]),
        inputs=system.inputs,
    )
    rolled.check_run_time_sizes()
    tables = {part.table.name: part.places for part in parts}
    return RolledSums(rolled, tables, {array.name: values for array, values in fields.items()})


def _mark(names: set[str]) -> str:
    """Return a suffix that keeps names of arrays, indices, sizes and tables apart from those of parameters."""
    mark = ""
    while any(re.fullmatch(rf"(q|p|b|N|p_q){mark}|q{mark}{DOT}|(at|B|c){mark}\d+(_\d+)?", name) for name in names):
        mark += "g"
    return mark


def _check_supported(system: MechanicalSystem) -> None:
    for part, value in (
        ("constraints", system.constraints),
        ("contacts", system.has_contacts),
        ("damping", system.damping != 0),
        ("transformed time", system.clock),
    ):
        if value:
            raise SystemDefinitionError(f"'{system.name}' has {part}, which systems rolled into sums do not support")


def _defaults(system: MechanicalSystem, formulas: Sequence[Expr]) -> dict[Symbol, float]:
    """Return the default values of the parameters, components of inputs excluded."""
    parts = {symbol(f"{name}_{part}") for name in system.inputs for part in "0123t"}
    if any(parts & formula.free_symbols for formula in formulas):
        raise SystemDefinitionError(
            f"an input of '{system.name}' occurs in expanded form and cannot be recognised: multiply the formula out"
        )
    return {name: value for name, value in system.constants.items() if name not in parts}


@dataclass(frozen=True, slots=True)
class _Rolled:
    """Term group over the rows of an index table."""

    group: TermGroup
    loop: Loop
    table: Array
    accesses: dict[Symbol, Access]

    @classmethod
    def of(cls, kind: SimilarTerms, name: str, index: str, arrays: Mapping[str, Array]) -> _Rolled:
        """Return the group of similar terms; ``name`` distinguishes its arrays from those of others."""
        rows, accesses = Size(f"B{name}"), dict[Symbol, Access]()

        def entry(array: Array, subscript: Place) -> Symbol:
            access = Access(array=array, places=(subscript,))
            accesses[symbol(str(access))] = access
            return symbol(str(access))

        group = kind.group(
            lambda array, column: entry(arrays[array], Place(index=index, table=f"at{name}", column=column)),
            lambda k: entry(Array(f"c{name}_{k}", (rows,)), Place(index=index)),
        )
        columns = max(1, len(group.slots))  # terms without coordinates have one column, which is never read
        loop = Loop(index=index, first=Size(""), end=rows)
        return cls(group, loop, Array(f"at{name}", (rows, Size("", columns))), accesses)

    def term(self, inputs: Mapping[Symbol, Expr]) -> ArrayTerm:
        """Return the sum over the rows, with the formulas of inputs."""
        return term_of((self.loop,), self.group.formula.xreplace(inputs), self.accesses)

    def force(self, inputs: Mapping[Symbol, Expr]) -> ArrayForce:
        """Return the forces on the coordinates of the first column."""
        term = self.term(inputs)
        target = self.accesses[self.group.slots[0]]
        return ArrayForce(loops=term.loops, slots=term.slots, targets=((target, term.formula),))

    @property
    def places(self) -> NDArray[np.int32]:
        """Values of the index table."""
        table = np.zeros((len(self.group.places), self.table.axes[1].number), dtype=np.int32)
        table[:, : len(self.group.slots)] = self.group.places
        return table

    def fields(self, defaults: Mapping[Symbol, float]) -> Iterator[tuple[Array, NDArray[np.float64]]]:
        """Yield the arrays of constants with their values."""
        for slot, column in zip(self.group.constants, self.group.values, strict=True):
            yield self.accesses[slot].array, np.array([float(defaults.get(constant, constant)) for constant in column])


@checks_arguments(SystemDefinitionError, system=ARRAYS)
def unroll_sums(
    system: MechanicalSystem,
    sizes: Mapping[str, int],
    *,
    tables: Mapping[str, ArrayLike] | None = None,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> MechanicalSystem:
    """Return the system of the coordinates q_0, q_1, .. (r_0_0, r_0_1, ..), the last axis of an array running fastest.

    Args:
        system: the system of arrays to unroll.
        sizes: value of every size; those of tables may be left out.
        tables: index tables of shape (rows, columns) by name.
        parameters: numbers and arrays by name, others keep their defaults; entries of arrays become parameters k_0, ..

    Raises:
        SystemDefinitionError: for unknown names, wrong shapes, and an index outside its array.

    >>> chain = LagrangianSystem.from_text(
    ...     name="chain", coordinates=["q[N]"],
    ...     lagrangian="sum(i in N, q_dot[i]**2/2) - sum(i in 0..N-2, (q[i+1] - q[i])**2/2)")
    >>> unroll_sums(chain, {"N": 2}).formula
    q_0_dot**2/2 + q_1_dot**2/2 - (-q_0 + q_1)**2/2
    """
    assert isinstance(system, ArraySystem)
    kind = HamiltonianSystem if system.function == "Hamiltonian" else LagrangianSystem
    result: MechanicalSystem = system_of(kind, **unrolled_fields(system, sizes, tables, parameters))
    return result
