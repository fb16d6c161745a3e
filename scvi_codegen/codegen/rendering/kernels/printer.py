"""Numbers and expressions as C: scalar types, literals, names and parentheses, without rewriting.

The numbers of a program are exact; a target determines how they are rounded and printed, and which functions of libm
take them. The support headers use the header of its name.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import TypeAlias

from scvi_codegen.codegen.ir.equations import FixedPointIteration
from scvi_codegen.codegen.ir.kernel import (
    Constant,
    Expression,
    Kernel,
    Load,
    Number,
    Operation,
    Part,
    kept_length,
    parts,
    subexpressions,
)
from scvi_codegen.codegen.rendering.text import TOLERANCE
from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import VANISHING, mp, nearest_float, settled


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A scalar type of C.

    Attributes:
        name: as in :data:`~scvi_codegen.codegen.rendering.program_source.EMBEDDED`.
        scalar: the type, and the name of its support header.
        suffix: of the functions of libm and of literals.
        digits: of a literal that reads back as the same number; 0: the shortest that does.
        tolerance: see :data:`scvi_codegen.codegen.rendering.text.TOLERANCE`.
        halvings: from 1 to the round-off unit.
        smallest, largest: numbers with full precision.
        vanishing: in place of VANISHING, whose power -3/2, in the Jacobian of a turn, is beyond single precision.
    """

    name: str
    scalar: str
    suffix: str
    digits: int
    tolerance: float
    halvings: int
    smallest: float
    largest: float
    vanishing: float = 2.0**-120

    @property
    def bytes(self) -> int:
        """Bytes of a number."""
        return 4 if self.suffix else 8

    def rounded(self, value: Number) -> float:
        """Return the number of the target nearest to ``value``; 0 below its smallest, as for low words of tables."""
        nearest = self.vanishing if value == VANISHING else nearest_float(value, self.halvings + 1)
        return 0.0 if abs(nearest) <= self.smallest and abs(mp.convert(value)) < self.smallest else nearest

    def rest(self, value: Number) -> Number:
        """Return the rounding error: the low word of a double-double number."""
        return settled(mp.convert(value) - self.rounded(value))

    def number(self, value: Number) -> str:
        """Return a literal that reads back as the number of the target nearest to ``value``."""
        nearest = self.rounded(value)
        if not self.digits:
            return repr(nearest)
        text = f"{nearest:.{self.digits}g}"
        return f"{text}{self.suffix}" if "." in text or "e" in text else f"{text}.0{self.suffix}"

    def check(self, values: Iterable[Number], names: Iterable[str] = repeat("the number")) -> None:
        """Raise :class:`MethodError` for numbers of a model outside the range of the target."""
        for value, name in zip(values, names, strict=False):
            if value != 0.0 and not self.smallest <= abs(value) <= self.largest:
                zero = ", write 0 for it if it is negligible" if abs(value) < self.smallest else ""
                raise MethodError(
                    f"{name} {float(value)!r} is outside the range of {self.name} precision: choose "
                    f"other units{zero}, or 'double'"
                )


DOUBLE = Target(
    name="double",
    scalar="double",
    suffix="",
    digits=0,
    tolerance=TOLERANCE,
    halvings=52,
    smallest=5e-324,
    largest=(2.0 - 2.0**-52) * 2.0**1023,
)

SINGLE = Target(
    name="single",
    scalar="float",
    suffix="f",
    digits=9,
    tolerance=2.0**-23,
    halvings=23,
    smallest=2.0**-126,
    largest=(2.0 - 2.0**-23) * 2.0**127,
    vanishing=2.0**-60,
)


Sources: TypeAlias = tuple[str, ...]
"""Loads that differ between lanes: ``("u", "t")`` for points, ``("u", "parameters")`` for trajectories."""

ARRAYS = ("u", "t", "parameters", "kept", "value", "derivative")
"""Arrays that a kernel and its parts may use, in the order of their arguments."""

INVERSE_ROOT, TIMES = "inverse_root_", "_times"
"""Beginning of the names of inverse roots, and end of those that have a factor as a second operand."""
IN_PAIRS = frozenset(
    "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp log pow".split()  # noqa: SIM905
)
"""Elementary functions of ``templates/support/double_double/functions.h``."""
OWN_FUNCTIONS = (INVERSE_ROOT, "lanes_")

PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2, "neg": 3}


def print_number(value: Number, target: Target = DOUBLE) -> str:
    """Return the C literal that reads back as the nearest number of the target."""
    return target.number(value)


def print_expression(expression: Expression, target: Target = DOUBLE, context: int = 0) -> str:
    """Return the C source of an expression over ``u``, ``t``, ``parameters`` and temporaries ``w<k>``.

    It has parentheses if its precedence is below ``context``.
    """
    if isinstance(expression, Constant):
        text = print_number(expression.value, target)
        return f"({text})" if text.startswith("-") and context else text
    if isinstance(expression, Load):
        return _load(expression)
    operator, operands = expression.operator, expression.operands
    if operator not in PRECEDENCE:
        name = operator if operator.startswith(OWN_FUNCTIONS) else f"{operator}{target.suffix}"
        return f"{name}({', '.join(print_expression(operand, target) for operand in operands)})"
    level = PRECEDENCE[operator]
    if operator == "neg":
        text = f"-{print_expression(operands[0], target, level + 1)}"
    else:
        left, right = (print_expression(operand, target, level + k) for k, operand in enumerate(operands))
        text = f"{left} {operator} {right}"
    return f"({text})" if level < context else text


def _load(load: Load) -> str:
    if load.source == "t":
        return "t"
    return f"w{load.index}" if load.source == "w" else f"{load.source}[{load.index}]"


def lane_functions(kernel: Kernel, sources: Sources) -> set[str]:
    """Return the functions that a kernel applies to vectors; ``sources`` names the loads that are vectors."""
    return set().union(*(_functions(part, _Vectors(part, sources).has) for part in _every_part(kernel)))


def scalar_functions(kernel: Kernel) -> set[str]:
    """Return all functions that occur in a kernel."""
    return set().union(*(_functions(part, lambda expression: True) for part in _every_part(kernel)))


def uses_functions(kernels: Iterable[Kernel]) -> bool:
    """Return whether elementary functions other than roots occur."""
    return bool(set().union(*map(scalar_functions, kernels)) & IN_PAIRS)


def inverse_roots(kernels: Iterable[Kernel]) -> list[int]:
    """Return the k of all ``inverse_root_k`` that occur in kernels."""
    names = set().union(*map(scalar_functions, kernels))
    return sorted(int(name.removeprefix(INVERSE_ROOT)) for name in names if name.startswith(INVERSE_ROOT))


def constants(kernel: Kernel) -> Iterator[Number]:
    """Return the numbers that occur in a kernel."""
    every = (expression for part in _every_part(kernel) for expression in _expressions(part))
    return (expression.value for expression in every if isinstance(expression, Constant))


def _every_part(kernel: Kernel) -> Iterator[Part]:
    return (part for function in kernel.functions for part in parts(function))


def _functions(part: Part, counts: Callable[[Expression], bool]) -> set[str]:
    """Return the functions that occur in the operations that count."""
    operations = (x for x in _expressions(part) if isinstance(x, Operation) and x.operator not in PRECEDENCE)
    return {operation.operator for operation in operations if counts(operation)}


def _expressions(part: Part) -> Iterator[Expression]:
    return subexpressions(*(expression for _, _, expression in part.statements))


def print_statements(code: Kernel | Part, target: Target = DOUBLE) -> list[str]:
    """Return the statements of a kernel of numbers, or of one of its parts."""
    cut = parts(code) if isinstance(code, Kernel) else (code,)
    if len(cut) > 1:
        return [f"{target.scalar} kept[{kept_length(cut)}];", *map(_call, cut)]
    return [
        f"const {target.scalar} w{k} = {print_expression(expression, target)};"
        if kind == "w"
        else f"{kind}[{k}] = {print_expression(expression, target)};"
        for kind, k, expression in cut[0].statements
    ]


def print_lane_statements(
    code: Kernel | Part,
    fixed_point: FixedPointIteration | None = None,
    *,
    sources: Sources,
    number: Target = DOUBLE,
    vector_type: str = "lanes",
) -> list[str]:
    """Return the statements of a kernel of vectors, or of one of its parts.

    Variables that are the same in every lane remain numbers; derivatives of an iteration are stored at their indices in
    the mass.
    """
    cut = parts(code) if isinstance(code, Kernel) else (code,)
    if len(cut) > 1:
        return [f"{vector_type} kept[{kept_length(cut)}];", *map(_call, cut)]
    vectors = _Vectors(cut[0], sources)
    statements = []
    for kind, k, expression in cut[0].statements:
        text, vector = print_expression(_with_lane_calls(expression, vectors), number), vectors.has(expression)
        if kind == "w":
            statements.append(f"const {vector_type if vector else number.scalar} w{k} = {text};")
        else:
            target = _mass_element(fixed_point, k) if kind == "derivative" else f"{kind}[{k}]"
            statements.append(f"{target} = {text};" if vector else f"{target} = {vector_type}_of({text});")
    return statements


def _call(part: Part) -> str:
    """Return the call of a part of a kernel; its arguments have the names of the kernel's."""
    return f"{part.name}({', '.join(array for array in ARRAYS if part.uses(array))});"


def _mass_element(fixed_point: FixedPointIteration | None, k: int) -> str:
    if fixed_point is None:  # of constraints, in the order of their entries
        return f"derivative[{k}]"
    i, j = fixed_point.mass_entries[k] if fixed_point.mass_entries else (k, k)
    return f"derivative[{i}]" if fixed_point.diagonal else f"derivative[{i} * M + {j}]"


class _Vectors:
    """Temporaries of a part that differ between lanes; values kept by earlier parts are vectors."""

    def __init__(self, part: Part, sources: Sources) -> None:
        self.sources, self.temporaries = (*sources, "kept"), set[int]()
        for kind, k, expression in part.statements:
            if kind == "w" and self.has(expression):
                self.temporaries.add(k)

    def has(self, expression: Expression) -> bool:
        if isinstance(expression, Load):
            return expression.source in self.sources or (
                expression.source == "w" and expression.index in self.temporaries
            )
        return isinstance(expression, Operation) and any(self.has(operand) for operand in expression.operands)


def _with_lane_calls(expression: Expression, vectors: _Vectors) -> Expression:
    """Return the expression with ``f`` of a vector renamed ``lanes_f``, and its scalar arguments made vectors."""
    if not isinstance(expression, Operation):
        return expression
    operands = tuple(_with_lane_calls(operand, vectors) for operand in expression.operands)
    if expression.operator in PRECEDENCE or not vectors.has(expression):
        return Operation(expression.operator, operands)
    return Operation(
        f"lanes_{expression.operator}",
        tuple(
            new if vectors.has(old) else Operation("lanes_of", (new,))
            for old, new in zip(expression.operands, operands, strict=True)
        ),
    )
