"""Translation of SymPy expressions into straight-line arithmetic.

A kernel's expressions are read into one graph in which equal nodes are the same node. Three rules make sharing cheap
and complete enough that no separate search for common subexpressions is needed:

* the factors of a product are multiplied left to right in a fixed order (numbers, parameters, composites, coordinates),
  so 3 mu r^-5 x and 3 mu r^-5 y share all but the last factor;
* a sum is normalised to content 1 and a positive first term, so a - b, b - a and 2 a - 2 b are one node;
* every negative power of x is built from 1/x and every half-integer power from sqrt(x); x^(-k/2) for k = 1, 3, 5, 7,
  frequent in mechanics, are separate functions, which vector instructions evaluate faster; odd quarters are these
  times x^(1/4) or x^(-1/4), a root of a root.

Nothing here changes a value: constants are exact and rounded when they are printed.
``tests/codegen/test_lowering.py`` reads kernels back and compares.
"""

import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from functools import cmp_to_key, partial

import sympy

from scvi_codegen.codegen.ir.kernel import Constant, Expression, Kernel, Load, Operation, exact_number
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.precision import VANISHING
from scvi_codegen.systems.formulas.intermediates import Intermediate, intermediates
from scvi_codegen.systems.formulas.kinks import rint, switching_function, unit_step

CIRCULAR = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
FUNCTIONS = {getattr(sympy, name): name for name in (*CIRCULAR, "atan2", "exp", "log")} | {rint: "rint"}
INVERSE_ROOTS = {k: f"inverse_root_{k}" for k in (1, 3, 5, 7)}
OPERATIONS = {
    **{name: function for function, name in FUNCTIONS.items() if name != "rint"},
    **{name: partial(lambda x, k: x ** sympy.Rational(-k, 2), k=k) for k, name in INVERSE_ROOTS.items()},
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "sqrt": sympy.sqrt,
    "pow": operator.pow,
}
"""Differentiable operations of a kernel, as functions of SymPy."""


PLAIN = sympy.Symbol, sympy.Mul, sympy.Function, Intermediate
"""Factors of numbers that make a product of SymPy as they are."""
LARGEST_UNROLLED_POWER = 64
LARGEST_COEFFICIENT = 2**100
"""Largest coefficient in a sum without its common factor: terms with a larger one exceed single precision."""


DEEPEST_EXPRESSION = 24
"""Greatest depth of one C expression; deeper ones are cut into temporaries."""


class _Graph:
    """Hash-consed arithmetic: ``nodes[k]`` is a leaf or (operator, operand ids)."""

    def __init__(self, loads: Mapping[sympy.Symbol, Load], parameters: Sequence[sympy.Symbol], *, paired: bool) -> None:
        self.loads, self.parameters, self.paired = loads, set(parameters), paired
        self.nodes: list[Constant | Load | tuple[str, tuple[int, ...]]] = []
        self._ids: dict[Constant | Load | tuple[str, tuple[int, ...]], int] = {}
        self._read: dict[sympy.Expr, int] = {}
        self._constant: dict[sympy.Basic, bool] = {}

    def node(self, content: Constant | Load | tuple[str, tuple[int, ...]]) -> int:
        """Return the id of a node, which is created if it is new."""
        if content not in self._ids:
            self._ids[content] = len(self.nodes)
            self.nodes.append(content)
        return self._ids[content]

    def operands(self, k: int) -> tuple[int, ...]:
        """Return the ids of the operands of a node, all smaller than its own."""
        content = self.nodes[k]
        return content[1] if isinstance(content, tuple) else ()

    def read(self, expression: sympy.Expr) -> int:
        if expression not in self._read:
            self._read[expression] = self._build(expression)
        return self._read[expression]

    def is_constant(self, expression: sympy.Basic) -> bool:
        """Return whether no symbol occurs; unlike ``free_symbols``, every subexpression is examined once."""
        is_constant = self._constant.get(expression)
        if is_constant is None:
            is_constant = not expression.is_Symbol and all(map(self.is_constant, expression.args))
            self._constant[expression] = is_constant
        return is_constant

    def _build(self, expression: sympy.Expr) -> int:
        if isinstance(expression, sympy.Symbol):
            return self.node(self.loads[expression])
        if self.is_constant(expression):
            return self.node(Constant(exact_number(expression)))
        if isinstance(expression, sympy.Add):
            return self._sum(expression)
        if isinstance(expression, sympy.Mul):
            return self._product(expression)
        if isinstance(expression, Intermediate):
            return self.read(expression.definition)
        if isinstance(expression, sympy.exp):
            return self.node(("exp", (self.read(expression.args[0]),)))
        if isinstance(expression, sympy.Pow):
            return self._power(*expression.as_base_exp())
        if isinstance(expression, unit_step):  # (1 + copysign(1, x)) / 2
            sign = self.node(("copysign", (self.read(sympy.S.One), self._switching(expression.args[0]))))
            return self.node(("*", (self.read(sympy.S.Half), self.node(("+", (self.read(sympy.S.One), sign))))))
        name = FUNCTIONS.get(expression.func)
        if name is None:
            raise SystemDefinitionError(
                f"the function in '{expression}' is not supported in C: use "
                f"{', '.join(FUNCTIONS.values())}, powers or roots"
            )
        return self.node((name, tuple(self.read(argument) for argument in expression.args)))

    def _switching(self, argument: sympy.Expr) -> int:
        """Return the node of a value with the sign of an argument; 0 - u of -u, since the sign of 0 is to be +."""
        u, sign = switching_function(argument)
        node = self.read(u)
        content = self.nodes[node]
        if isinstance(content, tuple) and content[0] == "neg":
            sign, node = -sign, content[1][0]
        if sign > 0:
            return node
        content = self.nodes[node]
        if isinstance(content, tuple) and content[0] == "-":
            return self.node(("-", content[1][::-1]))
        return self.node(("-", (self.read(sympy.S.Zero), node)))

    def _sum(self, expression: sympy.Add) -> int:
        """Return the node of ``sum_i c_i x_i = c sum_i (c_i / c) x_i``, c the content of the c_i with the first sign.

        Multiples of a sum, its negative among them, share the node of the last sum. With ``paired`` c is only the sign
        if a term has a sum as a factor; so it is if a c_i / c is too large.
        """
        content, primitive = _primitive(expression)
        terms = [term.as_coeff_Mul() for term in primitive]
        terms.sort(key=lambda term: self._rank(term[1]))
        in_sums = self.paired and any(isinstance(factor, sympy.Add) for _, rest in terms for factor in rest.args)
        if in_sums or any(abs(c.p) > LARGEST_COEFFICIENT * c.q for c, _ in terms):
            content, terms = sympy.S.One, [(content * coefficient, rest) for coefficient, rest in terms]
        if terms[0][0].p < 0:
            content, terms = -content, [(-coefficient, rest) for coefficient, rest in terms]
        if self.paired:
            return self._times(content, self._in_pairs([(c.p < 0, self._scaled(abs(c), rest)) for c, rest in terms])[1])
        total = self._scaled(*terms[0])
        for coefficient, rest in terms[1:]:
            operator = "-" if coefficient.p < 0 else "+"
            total = self.node((operator, (total, self._scaled(abs(coefficient), rest))))
        return self._times(content, total)

    def _in_pairs(self, terms: Sequence[tuple[bool, int]]) -> tuple[bool, int]:
        """Return the sum of terms by pairwise summation (Higham, Accuracy and Stability, sec. 4.1).

        Terms and sum are a sign (``True`` if negative) and a node. The first sign s is taken out of both halves, which
        do not wait for each other: ``s a + s' b = s (a + b)`` for equal signs, else ``s (a - b)``.
        """
        if len(terms) == 1:
            return terms[0]
        half = (len(terms) + 1) // 4 * 2 or 1  # whole pairs; of two terms, one
        left_negative, left = self._in_pairs(terms[:half])
        right_negative, right = self._in_pairs(terms[half:])
        operation = "+" if left_negative == right_negative else "-"
        return left_negative, self.node((operation, (left, right)))

    def _scaled(self, coefficient: sympy.Rational, rest: sympy.Expr) -> int:
        if rest is sympy.S.One:
            return self.node(Constant(exact_number(coefficient)))
        factors = sympy.Mul.make_args(rest)
        if coefficient is sympy.S.One:
            return self.read(rest)
        if any(map(self.is_constant, factors)):  # roots of numbers, which may combine with the coefficient
            return self.read(sympy.Mul(coefficient, rest))
        return self._multiplied(coefficient, factors)

    def _times(self, coefficient: sympy.Rational, node: int) -> int:
        if coefficient is sympy.S.One:
            return node
        if coefficient is sympy.S.NegativeOne:
            return self.node(("neg", (node,)))
        return self.node(("*", (self.node(Constant(exact_number(coefficient))), node)))

    def _product(self, expression: sympy.Mul) -> int:
        coefficient, rest = expression.as_coeff_Mul()
        return self._multiplied(coefficient, sympy.Mul.make_args(rest))

    def _multiplied(self, coefficient: sympy.Rational, factors: Sequence[sympy.Expr]) -> int:
        ordered = sorted(factors, key=self._rank)
        negative, magnitude = coefficient.p < 0, abs(coefficient)
        nodes = [] if magnitude is sympy.S.One else [self.node(Constant(exact_number(magnitude)))]
        for factor in ordered:
            node = self.read(factor)
            content = self.nodes[node]
            if isinstance(content, tuple) and content[0] == "neg":  # exact
                negative, node = not negative, content[1][0]
            nodes.append(node)
        product = nodes[0]
        for node in nodes[1:]:
            product = self.node(("*", (product, node)))
        return self.node(("neg", (product,))) if negative else product

    def _power(self, base: sympy.Expr, exponent: sympy.Expr) -> int:
        """Return the node of a power: ``x^(n/2)`` by roots, odd quarters as one of these times a root of a root.

        ``x^(k/4) = x^(n/2) x^(1/4)`` with n = (k - 1) / 2 for k > 0; ``x^(-k/4) = x^(-n/2) x^(-1/4)``.
        """
        quarters = 4 * exponent
        if not (quarters.is_Integer and abs(quarters) <= 4 * LARGEST_UNROLLED_POWER):
            return self.node(("pow", (self.read(base), self.read(exponent))))
        x, halves = self.read(base), int(quarters / 2)
        if quarters == 2 * halves:
            return self._by_roots(x, halves)
        quarter = self.node(("sqrt", (self._by_roots(x, 1 if quarters > 0 else -1),)))
        return self.node(("*", (self._by_roots(x, halves), quarter))) if halves else quarter

    def _by_roots(self, x: int, halves: int) -> int:
        """Return the node of ``x^(n/2) = x^w sqrt(x)^r``, n = 2 w + r the ``halves``, r in (0, 1).

        ``x^w = (1/x)^-w`` for w < 0; x^(-k/2) for k = 1, 3, 5, 7 are functions of their own.
        """
        if -halves in INVERSE_ROOTS:
            return self.node((INVERSE_ROOTS[-halves], (x,)))
        whole, half = divmod(halves, 2)
        root = self.node(("sqrt", (x,))) if half else None
        if whole == 0 and root is not None:
            return root
        base = x if whole > 0 else self.node(("/", (self.node(Constant(Fraction(1))), x)))
        power = self._whole(base, abs(whole))
        return power if root is None else self.node(("*", (power, root)))

    def _whole(self, x: int, n: int) -> int:
        """Return the node of x^n by repeated squaring, n >= 1."""
        if n == 1:
            return x
        half = self._whole(x, n // 2)
        square = self.node(("*", (half, half)))
        return self.node(("*", (square, x))) if n % 2 else square

    def rounding_error(self, root: int) -> int:
        """Return the node of a bound of the rounding error of a node, relative to half a unit in the last place.

        Running error analysis (Higham, Accuracy and Stability of Numerical Algorithms, sec. 3.3): an operation of x
        adds its own size to sum_j |d result / d x_j| error_j. Arguments and times are rounded; parameters are exact.
        """
        errors: dict[int, int | None] = {}
        for k in _order(self, [root]):
            content = self.nodes[k]
            if isinstance(content, tuple) and content[0] == "neg":  # exact
                errors[k] = errors[content[1][0]]
            elif isinstance(content, tuple):
                errors[k] = self._total([self._absolute(k), *self._inherited(*content, errors)])
            else:
                is_rounded = isinstance(content, Load) and content.source in ("u", "t")
                errors[k] = self._absolute(k) if is_rounded else None
        error = errors[root]
        return self.node(Constant(Fraction(0))) if error is None else error

    def _inherited(self, operation: str, operands: tuple[int, ...], errors: Mapping[int, int | None]) -> Iterator[int]:
        """Yield the nodes of ``|d f / d x_j| error_j`` for an operation f of the operands x_j.

        Operands without an error are left out, and all of an operation that is constant but for jumps. To differentiate
        f, a symbol of SymPy stands for each operand; it is entered in the graph as a name of the operand's node.
        """
        slots = [sympy.Dummy(real=True) for _ in operands]
        value = OPERATIONS[operation](*slots) if operation in OPERATIONS else sympy.Integer(0)
        self._read.update(zip(slots, operands, strict=True))
        for slot, operand in zip(slots, operands, strict=True):
            error, rate = errors[operand], value.diff(slot)
            if operation in ("sqrt", "pow") and any("copysign" in str(self.nodes[k]) for k in _order(self, [operand])):
                rate = rate.subs(slot, slot + sympy.Rational(VANISHING))
            if error is not None and rate != 0:
                yield error if abs(rate) == 1 else self.node(("*", (self._absolute(self.read(rate)), error)))

    def _absolute(self, k: int) -> int:
        content = self.nodes[k]
        if isinstance(content, tuple) and content[0] in ("neg", "fabs"):
            return self._absolute(content[1][0])
        return k if isinstance(content, Constant) and content.value >= 0 else self.node(("fabs", (k,)))

    def _total(self, terms: Sequence[int]) -> int:
        total = terms[0]
        for term in terms[1:]:
            total = self.node(("+", (total, term)))
        return total

    def _rank(self, factor: sympy.Expr) -> tuple[int, int]:
        """Return the sort key of a factor: numbers, parameters, composites, coordinates; then the order of reading."""
        if self.is_constant(factor):
            return (0, self.read(factor))
        if isinstance(factor, sympy.Symbol):
            return (1 if factor in self.parameters else 3, self.read(factor))
        return (2, self.read(factor))


def _primitive(total: sympy.Add) -> tuple[sympy.Rational, Sequence[sympy.Expr]]:
    """Return content and terms of SymPy's ``primitive()``, which takes ten times as long for products."""
    pairs = [term.as_coeff_Mul() for term in total.args]
    divisor, multiple = math.gcd(*(c.p for c, _ in pairs)), math.lcm(*(c.q for c, _ in pairs))
    if divisor == multiple:  # 1, which has no factor in common with another one
        return sympy.S.One, total.args
    if not all(isinstance(rest, PLAIN) or rest is sympy.S.One for _, rest in pairs):
        content, primitive = total.primitive()
        return content, primitive.args
    scaled = [(sympy.Integer(c.p // divisor * (multiple // c.q)), rest) for c, rest in pairs]
    factors = [(c, *(() if rest is sympy.S.One else sympy.Mul.make_args(rest))) for c, rest in scaled]
    terms = [
        rest if c is sympy.S.One else sympy.Mul._from_args(of) for (c, rest), of in zip(scaled, factors, strict=True)
    ]
    return sympy.Rational(divisor, multiple), sorted(terms, key=cmp_to_key(sympy.Basic.compare))


def lower_kernel(
    name: str,
    *,
    arguments: Sequence[sympy.Symbol],
    time: sympy.Symbol,
    parameters: Sequence[sympy.Symbol],
    values: Sequence[sympy.Expr],
    partials: Sequence[sympy.Expr] = (),
    constants: int = 0,
    paired: bool = False,
    of_rounding: bool = False,
) -> Kernel:
    """Return the kernel of ``values`` and ``partials`` with common subexpressions shared.

    With ``of_rounding`` its values are bounds of their rounding errors (:meth:`_Graph.rounding_error`) instead.
    The last ``constants`` arguments are constant. With ``paired`` the terms of sums are added in pairs, and their
    common rational factor is not separated if they have sums as factors: a few more operations, with less latency.
    """
    loads = {symbol: Load("u", i) for i, symbol in enumerate(arguments)}
    loads |= {symbol: Load("parameters", i) for i, symbol in enumerate(parameters)}
    loads[time] = Load("t", -1)
    graph = _Graph(loads, (*parameters, *arguments[len(arguments) - constants :]), paired=paired)
    for expression in intermediates(*values, *partials):
        graph.read(expression)
    roots = [graph.read(expression) for expression in (*values, *partials)]
    if of_rounding:
        roots = [graph.rounding_error(root) for root in roots]
    temporaries, results = _linearise(graph, roots)
    return Kernel(
        name=name,
        arguments=len(arguments),
        temporaries=temporaries,
        results=results,
        values=len(values),
        symbols=tuple(arguments),
        formulas=() if of_rounding else (*values, *partials),
    )


def _linearise(graph: _Graph, roots: Sequence[int]) -> tuple[tuple[Expression, ...], tuple[Expression, ...]]:
    """Turn nodes used more than once into temporaries, each defined shortly before its use; inline the others."""
    order = _order(graph, roots)
    uses = [0] * len(graph.nodes)
    for k in order:
        for operand in graph.operands(k):
            uses[operand] += 1
    for root in roots:
        uses[root] += 1
    texts: dict[int, Expression] = {}
    depths: dict[int, int] = {}
    temporaries: list[Expression] = []
    for k in order:
        content = graph.nodes[k]
        if not isinstance(content, tuple):
            texts[k], depths[k] = content, 0
            continue
        expression = Operation(content[0], tuple(texts[operand] for operand in content[1]))
        match expression:
            case Operation("neg", (Operation("-", (Load() as a, Load() as b)),)):  # -(a - b)
                expression = Operation("-", (b, a))
        texts[k], depths[k] = expression, 1 + max(depths[operand] for operand in content[1])
        if uses[k] > 1 or depths[k] > DEEPEST_EXPRESSION:
            texts[k], depths[k] = Load("w", len(temporaries)), 0
            temporaries.append(expression)
    return tuple(temporaries), tuple(texts[root] for root in roots)


def _order(graph: _Graph, roots: Sequence[int]) -> list[int]:
    """Return the reachable nodes, operands first; results that depend on the first arguments come first.

    In a chain a result shares subexpressions with its neighbours only, so that numbers are used soon after they are
    computed, which helps compilers and processors.
    """
    first = _first_arguments(graph)
    order: list[int] = []
    seen: set[int] = set()
    for root in sorted(roots, key=lambda root: first[root]):
        stack = [(root, False)]
        while stack:
            k, finished = stack.pop()
            if finished:
                order.append(k)
            elif k not in seen:
                seen.add(k)
                stack.append((k, True))
                stack.extend((operand, False) for operand in reversed(graph.operands(k)))
    return order


def _first_arguments(graph: _Graph) -> list[float]:
    """Return the smallest index of an argument on which each node depends."""
    smallest: list[float] = []
    for k, content in enumerate(graph.nodes):  # operands have smaller ids
        if isinstance(content, Load) and content.source == "u":
            smallest.append(content.index)
        else:
            smallest.append(min((smallest[operand] for operand in graph.operands(k)), default=math.inf))
    return smallest
