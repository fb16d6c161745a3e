"""Kernels: straight-line arithmetic of arguments, time and parameters, and loops around kernels.

``u[i]`` are its arguments, ``t`` the time and ``parameters[i]`` the parameters: temporaries, each used more than once,
then results. Operations are ``+ - * / neg sqrt``, ``inverse_root_k`` (x^(-k/2)) and calls of elementary functions on
numbers of the target's scalar type; there are no branches. Terms that differ only in the entries that they read are a
loop around a kernel (:class:`RolledKernel`): of a system of arrays over its indices, of a system of named coordinates
over a constant table of indices, within the kernel of the other terms.

Large kernels are divided into parts, since compile times grow faster than the length of a function: gcc 12 spends 6 of
10 seconds for five post-Newtonian bodies on register allocation in one kernel of 20,000 operations, and four minutes on
a force of 190 pairs. Divided, the time is linear. Values that later parts read are stored in an array, ``kept``; the
compiler would have spilled most of them.

Numbers of a program are exact or have 50 digits; they are rounded once, when printed, to the target's scalar type.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeAlias

import sympy

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.precision import DIGITS, Matrix, Vector, mp, settled
from scvi_codegen.systems.formulas.indices import Access, Array, Loop, Place, Size

TABLE_DIGITS = 50
"""Digits of a table; the last of the 60 that it is computed with are rounding errors, and a 1 has to be exactly 1."""

Number: TypeAlias = Any
"""A ``Fraction``, a multiprecision number (``mpf``), or a ``float`` if no more digits are intended."""

NumberTable: TypeAlias = tuple[tuple[Number, ...], ...]


def lower_vector(numbers: Vector) -> tuple[Number, ...]:
    """Return the numbers of a table to :data:`TABLE_DIGITS` digits; zeros except for rounding become 0."""
    with mp.workdps(TABLE_DIGITS):
        return tuple(settled(x) for x in numbers)


def lower_matrix(entries: Matrix) -> NumberTable:
    """Return the rows of a table to :data:`TABLE_DIGITS` digits."""
    return tuple(lower_vector(line) for line in entries)


def exact_number(constant: sympy.Expr) -> Number:
    """Return the value of an expression without symbols, a fraction or 60 digits; else SystemDefinitionError."""
    if isinstance(constant, sympy.Rational):
        value: Number = Fraction(int(constant.p), int(constant.q))
    else:
        real, imaginary = constant.evalf(DIGITS).as_real_imag()
        if imaginary != 0 or not real.is_finite:
            raise SystemDefinitionError(f"the constant {constant} is not a finite real number")
        value = mp.make_mpf(sympy.Float(real, DIGITS)._mpf_)
    try:
        beyond = abs(float(value)) == float("inf")
    except OverflowError:
        beyond = True
    if beyond:
        raise SystemDefinitionError(
            f"the constant {constant} is outside the range of double precision: choose other units"
        )
    return value


@dataclass(frozen=True, slots=True)
class Constant:
    """An exact number, or 60 digits of one."""

    value: Number


ZERO = Constant(0)


@dataclass(frozen=True, slots=True)
class Load:
    """``u[index]``, ``parameters[index]``, ``t`` (index -1) or temporary ``w[index]``, by ``source``."""

    source: str
    index: int


@dataclass(frozen=True, slots=True)
class Operation:
    """``operator`` applied to operands; anything but ``+ - * / neg`` is a call of that C function."""

    operator: str
    operands: tuple[Expression, ...]


Expression: TypeAlias = Constant | Load | Operation


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """Straight-line code: ``temporaries[k]`` defines ``w[k]``; ``results`` are stored as soon as they can be.

    Attributes:
        name: C identifier.
        arguments: length of ``u``.
        temporaries, results: expressions.
        values: number of results that are values; the rest are derivatives.
        symbols: of the elements of ``u``, as in the formulas.
        formulas: the results as expressions.
        purpose: one sentence on what it computes.
        sums: loops over constant tables that add to the values once all results are stored, in order.
        tangents: if derivatives are along unit vectors, a linear kernel from directions of the arguments to changes of
            values, by local derivatives: these are its parameters, and the results of this kernel after the values.
        entries: change, argument and index of each such derivative, in the order of the arguments.
    """

    name: str
    arguments: int
    temporaries: tuple[Expression, ...]
    results: tuple[Expression, ...]
    values: int
    symbols: tuple[sympy.Symbol, ...] = field(default=(), repr=False, compare=False)
    formulas: tuple[sympy.Expr, ...] = field(default=(), repr=False, compare=False)
    purpose: str = field(default="", repr=False, compare=False)
    sums: tuple[RolledKernel, ...] = ()
    tangents: Kernel | None = None
    entries: tuple[tuple[int, int, int], ...] = ()

    def __bool__(self) -> bool:
        return bool(self.name)

    def __hash__(self) -> int:
        """Return a hash of the name and the sizes: that of all expressions takes long."""
        return hash((self.name, self.arguments, len(self.temporaries), self.values))

    def with_sums(self, sums: tuple[RolledKernel, ...]) -> Kernel:
        """Return the kernel with further loops, whose kernels are called after it."""
        names = (f"{self.name}_{rolled.kernel.name}" for rolled in sums)
        named = (
            replace(rolled, kernel=replace(rolled.kernel, name=name)) for rolled, name in zip(sums, names, strict=True)
        )
        return replace(self, sums=(*self.sums, *named))

    @property
    def functions(self) -> tuple[Kernel, ...]:
        """The kernel and those of its loops."""
        return (self, *(rolled.kernel for rolled in self.sums), *([self.tangents] if self.tangents else []))

    @property
    def partials(self) -> int:
        """Number of derivatives of the values."""
        return len(self.entries) or len(self.results) - self.values

    @property
    def uses_time(self) -> bool:
        """True if ``t`` occurs."""
        return self.uses("t")

    def uses(self, array: str) -> bool:
        """Return whether it reads or writes ``u``, ``t``, ``parameters``, ``value`` or ``derivative``."""
        if array == "value" or (self.sums and array == "u"):
            return True
        if array == "derivative":
            return len(self.results) > self.values
        if any(rolled.kernel.uses(array) for rolled in self.sums):
            return True
        expressions = (*self.temporaries, *self.results)
        return any(load.source == array for expression in expressions for load in loads(expression))

    @property
    def added(self) -> set[int]:
        """Indices of the derivatives that loops add to."""
        tables = (table for rolled in self.sums for table in rolled.tables)
        return {k for name, rows in tables if name == "entries" for row in rows for k in row}

    @property
    def cleared(self) -> int:
        """Number of derivatives to set to 0 first, as loops add to them; 0 if they are in a matrix of zeros."""
        return self.partials if max(self.added, default=self.partials) < self.partials else 0

    def operation_counts(self) -> dict[str, int]:
        """Return the number of operations by name, in alphabetical order."""
        expressions = subexpressions(*self.temporaries, *self.results)
        counts = Counter(operation.operator for operation in expressions if isinstance(operation, Operation))
        for rolled in self.sums:
            for operator, count in (*rolled.kernel.operation_counts().items(), ("+", rolled.kernel.values)):
                counts[operator] += count * rolled.rows
        return dict(sorted(counts.items()))

    def statements(self) -> Iterator[tuple[str, int, Expression]]:
        """Yield ("w", "value" or "derivative", index, expression): each result right after its last temporary.

        Derivatives that are 0 but for what loops add are not stored: they are 0 before (:attr:`cleared`).
        """
        by_loops = bool(self.added)
        due: list[list[int]] = [[] for _ in range(len(self.temporaries) + 1)]
        for k, expression in enumerate(self.results):
            due[1 + max((load.index for load in loads(expression) if load.source == "w"), default=-1)].append(k)
        for k, ready in enumerate(due):
            if k > 0:
                yield "w", k - 1, self.temporaries[k - 1]
            for number in ready:
                derivative = number >= self.values
                if derivative and by_loops and self.results[number] == ZERO:
                    continue
                yield "derivative" if derivative else "value", number - derivative * self.values, self.results[number]


NO_KERNEL = Kernel(name="", arguments=0, temporaries=(), results=(), values=0)
"""Kernel of what a system does not have; false."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RolledKernel:
    """A kernel in loops over indices, whose values are added to entries of arrays.

    Elements, and the writes of an element, are processed in order, so that loops and their unrolled form round alike.
    The length of the code depends on the kernel, not on the number of elements.

    Attributes:
        kernel: of a potential or a force: one value per write, added to the force there (of a momentum: to the
            velocity); of a mass: one value, added to the mass of the only write.
        loops: outermost first.
        reads: entries (coordinates; for forces, velocities too) that are the kernel's arguments u.
        writes: entries that each value is added to; for a potential the reads.
        constants: other entries: the last parameters of the kernel or, if they are constants, its last arguments.
        text: the formula.
        scalar: of a potential: L itself.
        along: number of reads, the last ones, that belong to a direction instead of the state.
        circulant: axis of the reads if the term is f sum_(i<j) c[j-i] (x_i - x_j)^2 / 2 along it, or the product of its
            Jacobian and a direction, or the diagonal of that; else ``None``.
        tables, columns: constant tables of indices, and constant arrays of numbers or parameters, by name.
    """

    kernel: Kernel
    loops: tuple[Loop, ...]
    reads: tuple[Access, ...]
    writes: tuple[Access, ...]
    constants: tuple[Access, ...]
    text: str = ""
    scalar: Kernel | None = None
    along: int = 0
    circulant: int | None = None
    tables: tuple[tuple[str, tuple[tuple[int, ...], ...]], ...] = ()
    columns: tuple[tuple[str, tuple[Constant | Load, ...]], ...] = ()

    @classmethod
    def over_rows(
        cls,
        kernel: Kernel,
        table: tuple[tuple[int, ...], ...],
        constants: tuple[tuple[Constant | Load, ...], ...] = (),
        targets: tuple[tuple[int, ...], ...] = (),
        derivatives: tuple[tuple[int, ...], ...] = (),
    ) -> RolledKernel:
        """Return the loop over constant rows e: value[targets[e][a]] += kernel_a(u[table[e][..]], constants[..][e]).

        The last values of the kernel are added to derivative[derivatives[e][..]].

        Args:
            kernel: a function of as many arguments as indices and constants in a row.
            table: (rows, slots) indices of arguments of the kernel that contains the loop.
            constants: (constants, rows) numbers or parameters.
            targets: (rows, values) indices of its values; by default the table.
            derivatives: (rows, derivatives) indices of its derivatives.
        """
        end = Size("", len(table))
        written, count = "targets" if targets else "places", len(derivatives[0]) if derivatives else 0
        tables = {"places": table, "targets": targets, "entries": derivatives}

        def entries(array: str, table: str, count: int) -> tuple[Access, ...]:
            places = (Place(index="e", table=table, column=k) for k in range(count))
            return tuple(Access(array=Array(array, (Size(""),)), places=(place,)) for place in places)

        columns = {f"constant_{k}": column for k, column in enumerate(constants)}
        return cls(
            kernel=kernel,
            loops=(Loop(index="e", first=Size(""), end=end),),
            reads=entries("u", "places", len(table[0])),
            writes=(*entries("value", written, kernel.values - count), *entries("derivative", "entries", count)),
            constants=tuple(Access(array=Array(name, (end,)), places=(Place(index="e"),)) for name in columns),
            tables=tuple((name, rows) for name, rows in tables.items() if rows and rows[0]),
            columns=tuple(columns.items()),
        )

    @property
    def rows(self) -> int:
        """Number of rows of constant tables."""
        return self.loops[0].end.number


def subexpressions(*expressions: Expression) -> Iterator[Expression]:
    """Yield every expression, with its subexpressions."""
    pending = list(expressions)
    while pending:
        expression = pending.pop()
        yield expression
        if isinstance(expression, Operation):
            pending.extend(expression.operands)


def loads(expression: Expression) -> Iterator[Load]:
    """Return the loads of an expression."""
    return (part for part in subexpressions(expression) if isinstance(part, Load))


def replaced(expression: Expression, by: Mapping[Any, Expression]) -> Expression:
    """Return an expression with subexpressions replaced."""
    if expression in by or not isinstance(expression, Operation):
        return by.get(expression, expression)
    return Operation(expression.operator, tuple(replaced(operand, by) for operand in expression.operands))


class CallsApart(NamedTuple):
    """Functions that a kernel calls, the kernel of their arguments, and the rest, whose last arguments are values."""

    functions: tuple[str, ...]
    arguments: Kernel
    rest: Kernel


def calls_apart(kernel: Kernel, functions: Collection[str]) -> CallsApart | None:
    """Return a kernel with the calls of functions apart whose arguments are sums and products of u; else ``None``."""
    moving = set[Load]()

    def moves(expression: Expression) -> bool:
        return any(load.source == "u" or load in moving for load in loads(expression))

    for k, expression in enumerate(kernel.temporaries):
        if moves(expression):
            moving.add(Load("w", k))
    operations = dict.fromkeys(subexpressions(*kernel.temporaries, *kernel.results))
    calls = [x for x in operations if isinstance(x, Operation) and x.operator in functions and moves(x)]
    values = {call: Load("u", kernel.arguments + k) for k, call in enumerate(calls)}
    named = replace(kernel, name=f"{kernel.name}_arguments", purpose="Arguments of its functions.")
    arguments = _with_results(named, kernel.temporaries, [call.operands[0] for call in calls])
    if not calls or not {*arguments.operation_counts()} <= {"+", "-", "*", "neg"}:
        return None
    temporaries, results = (tuple(replaced(x, values) for x in of) for of in (kernel.temporaries, kernel.results))
    rest = _with_results(replace(kernel, arguments=kernel.arguments + len(calls)), temporaries, results)
    return CallsApart(tuple(call.operator for call in calls), arguments, rest)


def _with_results(kernel: Kernel, temporaries: Sequence[Expression], results: Sequence[Expression]) -> Kernel:
    """Return a kernel with other results, and those of the temporaries that they need."""
    needed = {load for result in results for load in loads(result)}
    for k in reversed(range(len(temporaries))):
        needed |= {*loads(temporaries[k])} if Load("w", k) in needed else set()
    left = [k for k in range(len(temporaries)) if Load("w", k) in needed]
    by = {Load("w", k): Load("w", n) for n, k in enumerate(left)}
    kept, shown = tuple(replaced(temporaries[k], by) for k in left), tuple(replaced(result, by) for result in results)
    return replace(kernel, temporaries=kept, results=shown, values=len(shown))


LARGEST_PART = 1000
"""Largest number of operations of one C function."""

Statement: TypeAlias = tuple[str, int, Expression]
"""(kind, index, expression): ``w`` is a temporary of the part, ``kept``, ``value`` and ``derivative`` are arrays."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """Consecutive statements of a kernel; loads from ``kept`` are temporaries of earlier parts.

    Attributes:
        name: C identifier.
        statements: in order.
    """

    name: str
    statements: tuple[Statement, ...]

    def uses(self, array: str) -> bool:
        """Return whether it reads or writes ``u``, ``t``, ``parameters``, ``kept``, ``value`` or ``derivative``."""
        return array in self._arrays

    @cached_property
    def _arrays(self) -> set[str]:
        written = {kind for kind, _, _ in self.statements}
        return written | {load.source for _, _, expression in self.statements for load in loads(expression)}


def kept_length(cut: Sequence[Part]) -> int:
    """Return the length of ``kept``."""
    return 1 + max((index for part in cut for kind, index, _ in part.statements if kind == "kept"), default=-1)


@lru_cache(maxsize=32)
def parts(kernel: Kernel) -> tuple[Part, ...]:
    """Return the kernel in parts of about equal size; one, if it is short enough."""
    pieces = list(_parts_of_equal_size(tuple(kernel.statements())))
    if len(pieces) == 1:
        return (Part(name=kernel.name, statements=pieces[0]),)
    used = ((n, load) for n, piece in enumerate(pieces) for _, _, expression in piece for load in loads(expression))
    last_use = {load.index: n for n, load in used if load.source == "w"}
    free: list[int] = []
    places: dict[int, int] = {}
    cut = []
    for n, piece in enumerate(pieces):
        arrived = {Load("w", index): Load("kept", place) for index, place in places.items()}
        statements: list[Statement] = []
        for kind, index, expression in piece:
            statements.append((kind, index, replaced(expression, arrived)))
            if kind == "w" and last_use.get(index, n) > n:
                places[index] = free.pop() if free else len(places)
                statements.append(("kept", places[index], Load("w", index)))
        done = [index for index in places if last_use[index] == n]
        free.extend(places[index] for index in done)
        cut.append(Part(name=f"{kernel.name}_{n + 1}", statements=tuple(statements)))
    return tuple(cut)


def is_divided(kernels: Iterable[Kernel]) -> bool:
    """Return whether one of the kernels, or a term of its loops, is divided into several functions."""
    return any(len(parts(function)) > 1 for kernel in kernels for function in kernel.functions)


def _parts_of_equal_size(statements: Sequence[Statement]) -> Iterator[tuple[Statement, ...]]:
    """Yield consecutive statements with about equal numbers of operations."""
    sizes = [sum(isinstance(x, Operation) for x in subexpressions(result)) for _, _, result in statements]
    whole = sum(sizes)
    count = max(1, -(-whole // LARGEST_PART))
    n, total, begin = 1, 0, 0
    for end, size in enumerate(sizes, 1):
        total += size
        if n < count and total * count >= n * whole:
            yield tuple(statements[begin:end])
            n, begin = n + 1, end
    yield tuple(statements[begin:])
