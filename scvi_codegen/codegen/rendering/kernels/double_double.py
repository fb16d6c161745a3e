"""Kernels in double-double arithmetic as C, and the headers of this arithmetic for numbers and for vectors.

A kernel becomes calls of functions of pairs, ``dd_multiply(w0, w1)``: pairs of numbers are ``dd``, pairs of vectors
``ddl``. Constants that one double represents are single words. Arguments are arrays of pairs; parameters are an array
of numbers, all high words before all low words.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain

from scvi_codegen.codegen.ir.kernel import Constant, Expression, Kernel, Load, Number, Operation
from scvi_codegen.codegen.rendering.kernels.simd import Lanes
from scvi_codegen.codegen.rendering.text import table, wrapped, wrapped_comment, wrapped_prototype
from scvi_codegen.common.cache import template_folder
from scvi_codegen.common.precision import mp

OPERATORS = {"+": "sum", "-": "difference", "/": "divide", "neg": "negative"}
SUMS = ("+", "-", "neg")
PRODUCTS, SETTLED_PRODUCTS = ("squared", "multiple", "product"), ("square", "scale", "multiply")
"""Functions of ``templates/support/double_double/pairs.h``: square, product with one word, and of pairs."""

PER_TURN, PER_BINADE, NEAR = 128, 64, 64
"""Rows of the tables of sines and cosines, of powers of 2, and of powers less 1."""


@dataclass(frozen=True, slots=True)
class _Printed:
    """C source of a pair, or of one word: ``kind`` is ``"dd"``, ``"ddl"`` or ``"word"``.

    ``form`` is that of its low word: ``"settled"``; ``"product"`` if it is a few units of the high word; ``"sum"``
    if it may be of any size relative to it, as after cancellation.
    """

    text: str
    kind: str
    form: str = "settled"

    def as_pair(self, kind: str, *, summed: bool = False) -> str:
        """Return the source of a pair of this kind; of a sum a settled one, unless it is summed further."""
        if self.kind == "word":
            return f"{kind}_word({self.text if kind == 'dd' else f'lanes_of({self.text})'})"
        text = self.text if self.kind == kind else f"ddl_of({self.text})"
        return f"{kind}_settled({text})" if self.form == "sum" and not summed else text

    def settled(self, kind: str) -> str:
        """Return the source of a settled pair of this kind."""
        return replace(self, form="settled" if self.form == "settled" else "sum").as_pair(kind)


class _PairPrinter:
    """Printer of the expressions of a kernel, whose temporaries are pairs of numbers or of vectors."""

    def __init__(self, lanes: Lanes | None) -> None:
        self.sources = lanes.sources if lanes else ()
        self.temporaries: dict[int, tuple[str, str]] = {}  # kind and form

    def kind_of(self, source: str) -> str:
        """Return the kind of pairs of an argument."""
        return "ddl" if source in self.sources else "dd"

    def printed(self, expression: Expression) -> _Printed:
        """Return the source of an expression, and the form of its low word.

        A sum of pairs adds high words without error and low words as they are, so its operands need not be settled:
        ``a + b = two_sum(a, b) + (a' + b')`` (Lange & Rump 2020). A sign keeps the form of its operand. Quotients,
        roots and functions take settled sums and return settled pairs.
        """
        if isinstance(expression, Constant):
            high, low = _words(mp.convert(expression.value), 2)  # of small constants as well, unlike Target.rest
            return _Printed(f"dd_of({high}, {low})", "dd") if float(low) else _Printed(high, "word")
        if isinstance(expression, Load):
            return self._load(expression)
        operands = [self.printed(operand) for operand in expression.operands]
        kind = "ddl" if any(operand.kind == "ddl" for operand in operands) else "dd"
        operator = expression.operator
        if operator == "*":
            return self._product(expression, operands, kind)
        is_sum = operator in SUMS
        arguments = ", ".join(operand.as_pair(kind, summed=is_sum) for operand in operands)
        call = f"{kind}_{OPERATORS.get(operator, operator)}({arguments})"
        if operator == "neg":
            return _Printed(call, kind, operands[0].form)
        return _Printed(call, kind, "sum" if is_sum else "settled")

    def _product(self, expression: Operation, operands: list[_Printed], kind: str) -> _Printed:
        """Return a product, settled at once if a factor is itself an unsettled product.

        ``(a + a') (b + b') = a b + (a b' + a' b)`` to a' b': the low word of a product of settled pairs is up to 3 u of
        the high one (``templates/support/double_double/pairs.h``), and a product of such products is settled.
        """
        settles = any(operand.form == "product" for operand in operands)
        square, by_word, by_pair = SETTLED_PRODUCTS if settles else PRODUCTS
        form = "settled" if settles else "product"
        if len(set(expression.operands)) == 1:
            return _Printed(f"{kind}_{square}({operands[0].as_pair(kind)})", kind, form)
        if all(operand.kind != "word" for operand in operands):
            factors = ", ".join(operand.as_pair(kind) for operand in operands)
            return _Printed(f"{kind}_{by_pair}({factors})", kind, form)
        word, pair = operands if operands[0].kind == "word" else reversed(operands)
        factor = word.text if kind == "dd" else f"lanes_of({word.text})"
        mantissa, _ = math.frexp(abs(float(word.text)))
        if mantissa == 0.5:  # a power of two: exact, so that the form stays
            return _Printed(f"{kind}_times_power({pair.as_pair(kind, summed=True)}, {factor})", kind, pair.form)
        return _Printed(f"{kind}_{by_word}({pair.as_pair(kind)}, {factor})", kind, form)

    def _load(self, load: Load) -> _Printed:
        if load.source == "w":
            return _Printed(f"w{load.index}", *self.temporaries[load.index])
        kind = self.kind_of(load.source)
        if load.source == "parameters":
            parameter = "PARAMETER_OF_LANES" if kind == "ddl" else "PARAMETER"
            return _Printed(f"{parameter}({load.index})", kind)
        return _Printed("t" if load.source == "t" else f"u[{load.index}]", kind)


def pair_kernel_text(kernel: Kernel, lanes: Lanes | None = None) -> str:
    """Return the function ``<name>_pairs`` of numbers, or with ``lanes`` of vectors, and its comment."""
    kind, printer, statements = "ddl" if lanes else "dd", _PairPrinter(lanes), []
    for array, k, expression in kernel.statements():
        value = printer.printed(expression)
        if array == "w":
            own = "dd" if value.kind == "word" else value.kind
            printer.temporaries[k] = own, value.form.replace("sum", "settled")
            statements.append(f"const {own} w{k} = {value.as_pair(own)};")
        elif array == "value":
            statements.append(f"value[{k}] = {value.settled(kind)};")
    parameters = "lanes" if printer.kind_of("parameters") == "ddl" else "double"
    arguments = f"const {kind} *u, {printer.kind_of('t')} t, const {parameters} *parameters, {kind} *value"
    body = "\n".join(map(wrapped, statements))
    purpose = wrapped_comment(f"{kernel.purpose} In pairs.".strip())
    head = wrapped_prototype(f"static inline void {kernel.name}_pairs({arguments})")
    return f"{purpose}\n{head}\n{{\n  /* clang-format off */\n{body}\n  /* clang-format on */\n}}"


@cache
def arithmetic_headers() -> dict[str, str]:
    """Return the headers of pairs of numbers and of vectors, by name."""
    folder = template_folder() / "support" / "double_double"
    pairs, functions = ((folder / f"{name}.h").read_text(encoding="utf-8") for name in ("pairs", "functions"))
    of_numbers = {
        "NUMBER": "double",
        "PAIR": "dd",
        "OF(name)": "dd_##name",
        "FMA(a, b, c)": "fma(a, b, c)",
        "BROADCAST(x)": "(x)",
        "INLINE": "static inline",
        "PICK(k, table, column)": "table[dd_row(k, (int)(sizeof table / sizeof table[0]))][column]",
    }
    of_vectors = {
        "NUMBER": "lanes",
        "PAIR": "ddl",
        "OF(name)": "ddl_##name",
        "FMA(a, b, c)": "multiply_add(a, b, c)",
        "BROADCAST(x)": "lanes_of(x)",
        "INLINE": "static inline __attribute__((always_inline))",  # in long kernels as well
        "PICK(k, table, column)": "ddl_entries(k, &table[0][column], (int)(sizeof table / sizeof table[0]), "
        "(int)(sizeof table[0] / sizeof table[0][0]))",
    }
    texts = {}
    for kind, macros in (("number", of_numbers), ("vector", of_vectors)):
        defined = "".join(f"#define {name} {value}\n" for name, value in macros.items())
        undefined = "".join(f"#undef {name.partition('(')[0]}\n" for name in macros)
        for name, text in (("pairs", pairs), ("functions", functions)):
            texts[f"support/double_double/{kind}_{name}.h"] = f"{defined}\n{text}\n{undefined}"
    texts["support/double_double/tables_of_functions.h"] = _tables_of_functions()
    return texts


def _words(value: Number, count: int) -> list[str]:
    """Return the literals of a number in words, each the rest of those before."""
    words = []
    for _ in range(count):
        words.append(float(value))
        value -= words[-1]
    return [repr(word) for word in words]


def _pairs(numbers: Iterable[Number]) -> list[list[str]]:
    return [_words(number, 2) for number in numbers]


def _tables_of_functions() -> str:
    """Return the tables and coefficients of the elementary functions of pairs."""
    with mp.workdps(80):
        angle, exponent = mp.pi / 64, mp.log(2) / PER_BINADE
        sines = [(-1) ** (n + 1) / mp.factorial(2 * n + 3) for n in range(7)]
        cosines = [(-1) ** (n + 1) / mp.factorial(2 * n + 2) for n in range(7)]
        exponential = [1 / mp.factorial(n + 2) for n in range(11)]
        circle = [map(mp.chop, (mp.sin(k * angle), mp.cos(k * angle))) for k in range(PER_TURN)]
        turn = [[*chain(*_pairs(both))] for both in circle]
        powers = _pairs(mp.exp(k * exponent) for k in range(PER_BINADE))
        signed = [k if k < NEAR else k - 2 * NEAR for k in range(2 * NEAR)]  # row of k: k modulo the number of rows
        near = _pairs(mp.expm1(k * exponent) for k in signed)
        scalars = {"PER_UNIT_OF_ANGLE": 1 / angle, "PER_UNIT_OF_EXPONENT": 1 / exponent}
        units = {"UNIT_OF_ANGLE": _words(angle, 3), "UNIT_OF_EXPONENT": _words(exponent, 3)}
        rows = {
            "SINE": _pairs(sines),
            "COSINE": _pairs(cosines),
            "EXPONENTIAL": _pairs(exponential),
            "CIRCLE": turn,
            "POWERS": powers,
            "POWERS_LESS_1": near,
        }
    lines = [
        "/* Tables of the elementary functions of pairs: units pi/64 and log(2)/64 in three words; Taylor series;",
        " * sine and cosine of k pi/64, 2^(k/64), and 2^(k/64) - 1 for |k| <= 32, row k modulo the number of rows. */",
        *(f"static const double {name} = {float(value)!r};" for name, value in scalars.items()),
        *(table(f"static const double {name}[3]", words) for name, words in units.items()),
        *(table(f"static const double {name}[{len(x)}][{len(x[0])}]", x) for name, x in rows.items()),
    ]
    return "\n".join(lines) + "\n"
