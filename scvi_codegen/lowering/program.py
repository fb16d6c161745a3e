"""Symbolic to program: expressions become straight-line arithmetic, tables are rounded, loops are listed.

A kernel's expressions are read into one graph in which equal nodes are the same node. Three rules make sharing cheap
and complete enough that no separate search for common subexpressions is needed:

* the factors of a product are multiplied left to right in a fixed order (numbers, parameters, composites, coordinates),
  so 3 mu r^-5 x and 3 mu r^-5 y share all but the last factor;
* a sum is normalised to content 1 and a positive first term, so a - b, b - a and 2 a - 2 b are one node;
* every negative power of x is built from 1/x and every half-integer power from sqrt(x); x^(-k/2) for k = 1, 3, 5, 7,
  frequent in mechanics, are functions of their own, for which vectors have something faster.

Nothing here changes a value but by rounding; ``tests/test_lowering.py`` reads kernels back and compares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import sympy

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.derivatives import jacobian
from scvi_codegen.ir.program import (
    Constant,
    Expression,
    Family,
    GatherLoop,
    Kernel,
    Load,
    MomentumMap,
    Operation,
    Program,
    ScatterLoop,
    SlopeBlock,
    Splitting,
    Sweep,
)
from scvi_codegen.lowering.ordering import bandwidth, places
from scvi_codegen.mechanics.forms import auxiliary_multipliers, curve_rates, legendre_map, multipliers
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.symmetry.symmetry import Symmetry
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.exactness import is_exact
from scvi_codegen.methods.method import Method, check_regular
from scvi_codegen.methods.phase_space import with_auxiliaries
from scvi_codegen.methods.stage_system import Gather, PointFamily, StageSystem
from scvi_codegen.tables.precision import Matrix, Vector

__all__ = ["argument_name", "lower", "lower_kernel", "lower_matrix", "lower_vector"]

FUNCTIONS = {
    sympy.sin: "sin",
    sympy.cos: "cos",
    sympy.tan: "tan",
    sympy.asin: "asin",
    sympy.acos: "acos",
    sympy.atan: "atan",
    sympy.atan2: "atan2",
    sympy.sinh: "sinh",
    sympy.cosh: "cosh",
    sympy.tanh: "tanh",
    sympy.asinh: "asinh",
    sympy.acosh: "acosh",
    sympy.atanh: "atanh",
    sympy.exp: "exp",
    sympy.log: "log",
}
INVERSE_ROOTS = {-k: f"inverse_root_{k}" for k in (1, 3, 5, 7)}
LARGEST_UNROLLED_POWER = 64
CONSTANT_DIGITS = 30
DEEPEST_EXPRESSION = 24
"""Longest chain of operations written as one C expression; longer sums are cut into temporaries."""


class _Graph:
    """Hash-consed arithmetic: ``nodes[k]`` is a leaf or (operator, operand ids)."""

    def __init__(self, loads: Mapping[sympy.Symbol, Load]) -> None:
        self.loads = loads
        self.nodes: list[Constant | Load | tuple[str, tuple[int, ...]]] = []
        self._ids: dict[Constant | Load | tuple[str, tuple[int, ...]], int] = {}
        self._read: dict[sympy.Expr, int] = {}

    def node(self, content: Constant | Load | tuple[str, tuple[int, ...]]) -> int:
        """The id of a node, new or not."""
        if content not in self._ids:
            self._ids[content] = len(self.nodes)
            self.nodes.append(content)
        return self._ids[content]

    def operands(self, k: int) -> tuple[int, ...]:
        """Ids of the operands of a node, all smaller than its own."""
        content = self.nodes[k]
        return content[1] if isinstance(content, tuple) else ()

    def read(self, expression: sympy.Expr) -> int:
        """The id of a SymPy expression."""
        if expression not in self._read:
            self._read[expression] = self._build(expression)
        return self._read[expression]

    def _build(self, expression: sympy.Expr) -> int:
        if isinstance(expression, sympy.Symbol):
            return self.node(self.loads[expression])
        if not expression.free_symbols:
            return self.node(Constant(_double(expression)))
        if isinstance(expression, sympy.Add):
            return self._sum(expression)
        if isinstance(expression, sympy.Mul):
            return self._product(expression)
        if isinstance(expression, sympy.exp):
            return self.node(("exp", (self.read(expression.args[0]),)))
        if isinstance(expression, sympy.Pow):
            return self._power(*expression.as_base_exp())
        name = FUNCTIONS.get(expression.func)
        if name is None:
            raise SystemDefinitionError(f"the function in '{expression}' has no C counterpart")
        return self.node((name, tuple(self.read(argument) for argument in expression.args)))

    def _sum(self, expression: sympy.Add) -> int:
        content, primitive = expression.primitive()
        terms = [term.as_coeff_Mul() for term in primitive.args]
        terms.sort(key=lambda term: self._rank(term[1]))
        if terms[0][0] < 0:
            content, terms = -content, [(-coefficient, rest) for coefficient, rest in terms]
        total = self._scaled(*terms[0])
        for coefficient, rest in terms[1:]:
            operator = "-" if coefficient < 0 else "+"
            total = self.node((operator, (total, self._scaled(abs(coefficient), rest))))
        return self._times(content, total)

    def _scaled(self, coefficient: sympy.Rational, rest: sympy.Expr) -> int:
        if rest == 1:
            return self.node(Constant(_double(coefficient)))
        if coefficient == 1:
            return self.read(rest)
        return self.read(sympy.Mul(coefficient, rest, evaluate=not isinstance(rest, sympy.Add)))

    def _times(self, coefficient: sympy.Rational, node: int) -> int:
        if coefficient == 1:
            return node
        if coefficient == -1:
            return self.node(("neg", (node,)))
        return self.node(("*", (self.node(Constant(_double(coefficient))), node)))

    def _product(self, expression: sympy.Mul) -> int:
        coefficient, rest = expression.as_coeff_Mul()
        factors = sorted(sympy.Mul.make_args(rest), key=self._rank)
        negative = coefficient < 0
        magnitude = abs(coefficient)
        nodes = [] if magnitude == 1 else [self.node(Constant(_double(magnitude)))]
        for factor in factors:
            node = self.read(factor)
            content = self.nodes[node]
            if isinstance(content, tuple) and content[0] == "neg":
                negative, node = not negative, content[1][0]
            nodes.append(node)
        product = nodes[0]
        for node in nodes[1:]:
            product = self.node(("*", (product, node)))
        return self.node(("neg", (product,))) if negative else product

    def _power(self, base: sympy.Expr, exponent: sympy.Expr) -> int:
        doubled = 2 * exponent
        if not (doubled.is_Integer and abs(doubled) <= 2 * LARGEST_UNROLLED_POWER):
            return self.node(("pow", (self.read(base), self.read(exponent))))
        x = self.read(base)
        whole = int(doubled // 2)
        if doubled in INVERSE_ROOTS:
            return self.node((INVERSE_ROOTS[doubled], (x,)))
        if not doubled % 2:
            return self._whole(x, whole) if whole > 0 else self._whole(self._inverse(x), -whole)
        root = self.node(("sqrt", (x,)))
        if whole == 0:
            return root
        power = self._whole(x, whole) if whole > 0 else self._whole(self._inverse(x), -whole)
        return self.node(("*", (power, root)))

    def _inverse(self, x: int) -> int:
        return self.node(("/", (self.node(Constant(1.0)), x)))

    def _whole(self, x: int, n: int) -> int:
        """x^n by halving, n >= 1."""
        if n == 1:
            return x
        half = self._whole(x, n // 2)
        square = self.node(("*", (half, half)))
        return self.node(("*", (square, x))) if n % 2 else square

    def _rank(self, factor: sympy.Expr) -> tuple[int, int]:
        """Numbers, parameters, composites, coordinates; among equals the order of first reading."""
        if not factor.free_symbols:
            return (0, self.read(factor))
        if isinstance(factor, sympy.Symbol):
            return (1 if self.loads[factor].source == "parameters" else 3, self.read(factor))
        return (2, self.read(factor))


def _double(number: sympy.Expr) -> float:
    """The nearest binary64 number to a constant expression."""
    if isinstance(number, sympy.Rational):
        try:
            return int(number.p) / int(number.q)
        except OverflowError:
            raise SystemDefinitionError(f"the constant {number} does not fit a double") from None
    value = complex(number.evalf(CONSTANT_DIGITS))
    if value.imag or value.real != value.real or value.real in (float("inf"), -float("inf")):
        raise SystemDefinitionError(f"the constant {number} is not a finite real number")
    return value.real


def lower_kernel(
    name: str,
    *,
    arguments: Sequence[sympy.Symbol],
    time: sympy.Symbol,
    parameters: Sequence[sympy.Symbol],
    values: Sequence[sympy.Expr],
    slopes: Sequence[sympy.Expr] = (),
) -> Kernel:
    """One kernel with all its results sharing their common parts."""
    loads = {symbol: Load("u", i) for i, symbol in enumerate(arguments)}
    loads |= {symbol: Load("parameters", i) for i, symbol in enumerate(parameters)}
    loads[time] = Load("t", -1)
    graph = _Graph(loads)
    roots = [graph.read(expression) for expression in (*values, *slopes)]
    temporaries, results = _linearise(graph, roots)
    return Kernel(
        name=name,
        arguments=len(arguments),
        temporaries=temporaries,
        results=results,
        values=len(values),
        symbols=tuple(arguments),
        formulas=(*values, *slopes),
    )


def _linearise(graph: _Graph, roots: Sequence[int]) -> tuple[tuple[Expression, ...], tuple[Expression, ...]]:
    """Nodes used more than once become temporaries, each defined shortly before its use; others stand in place."""
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
        texts[k], depths[k] = expression, 1 + max(depths[operand] for operand in content[1])
        if uses[k] > 1 or depths[k] > DEEPEST_EXPRESSION:
            texts[k], depths[k] = Load("w", len(temporaries)), 0
            temporaries.append(expression)
    return tuple(temporaries), tuple(texts[root] for root in roots)


def _order(graph: _Graph, roots: Sequence[int]) -> list[int]:
    """Reachable nodes, operands first: those of the results that use the first arguments before those of others.

    In a chain a result shares parts with its neighbours only; numbers then are needed soon after they are computed,
    which compilers and processors reward.
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
    """Of each node, the smallest index of an argument that it depends on."""
    first: list[float] = []
    for k, content in enumerate(graph.nodes):  # operands have smaller numbers
        if isinstance(content, Load) and content.source == "u":
            first.append(content.index)
        else:
            first.append(min((first[operand] for operand in graph.operands(k)), default=math.inf))
    return first


def lower(
    system: MechanicalSystem,
    method: Method,
    *,
    prefix: str,
    sweep: Sweep | None = None,
    splitting: Splitting | None = None,
    newton: bool = True,
    symmetries: Sequence[Symmetry] = (),
) -> Program:
    """The program of one step of ``method`` for ``system``; exported C names begin with ``prefix``.

    Args:
        system, method: what is lowered.
        prefix: a C identifier.
        sweep: the fixed-point iteration to try first (:func:`scvi_codegen.lowering.solvers.choice.sweep_of`).
        splitting: the explicit solver that replaces both
        (:func:`scvi_codegen.lowering.solvers.splitting.splitting_of`). newton: whether Newton's iteration is emitted;
        with it the discrete Legendre transforms. symmetries: whose momentum maps are emitted.
    """
    check_regular(method, system)
    stages = with_auxiliaries(system, method.stage_system(system))
    common: dict[str, Any] = {"time": system.time, "parameters": system.parameters}
    state, transformed = legendre_map(system)
    mass = jacobian(transformed, state[system.dimension :])
    legendre = lower_kernel("legendre", arguments=state, values=transformed, slopes=tuple(mass.values()), **common)
    energy = "hamiltonian" if system.auxiliaries else "lagrangian"
    families = tuple(_family(system, family) for family in stages.families)
    met = [*mass, *_meetings(families if newton else ())]
    order = places(met, system.dimension)
    return Program(
        prefix=prefix,
        title=_comment(f"{system.name}: {method.title}"),
        notes=_notes(method),
        coordinate_names=tuple(q.name for q in system.coordinates),
        parameter_names=tuple(parameter.name for parameter in system.parameters),
        parameter_defaults=system.defaults,
        blocks=len(stages.blocks),
        families=families,
        places=order,
        bandwidth=bandwidth(met, order),
        momentum_rows=lower_vector(tuple(row.momentum for row in stages.rows)),
        end_position=lower_vector(stages.end_position.entries[0][1:]),
        straight=tuple(int(block.straight[1]) for block in stages.blocks),
        momentum_blocks=tuple(block.momentum for block in stages.blocks),
        moving_blocks=tuple(int(block.moves) for block in stages.blocks),
        extrapolation=lower_matrix(_required_extrapolation(stages)),
        legendre=legendre,
        mass_entries=tuple(mass),
        energy=lower_kernel(energy, arguments=state, values=(system.formula,), **common),
        hamiltonian=bool(system.auxiliaries),
        momentum_maps=tuple(
            MomentumMap(name=_comment(each.name), formula=_comment(each.formula), exact=is_exact(each, method))
            for each in symmetries
        ),
        momentum_kernel=_momentum_kernel(symmetries, common),
        sweep=sweep,
        splitting=splitting,
        newton=newton,
    )


def _momentum_kernel(symmetries: Sequence[Symmetry], common: dict[str, Any]) -> Kernel | None:
    """Momentum maps, then the sums of the squares of their terms."""
    if not symmetries:
        return None
    maps = [symmetry.momentum_map for symmetry in symmetries]
    squares = [sympy.Add(*(term**2 for term in sympy.Add.make_args(J))) for J in maps]
    arguments = (*symmetries[0].coordinates, *symmetries[0].momenta)
    return lower_kernel("momentum_maps", arguments=arguments, values=(*maps, *squares), **common)


def _is_regular(system: MechanicalSystem) -> bool:
    """Whether both ends of a curve determine it; where velocities say nothing of momenta, L_d does not exist."""
    return not isinstance(system, HamiltonianSystem) or system.is_regular


def _meetings(families: Sequence[Family]) -> list[tuple[int, int]]:
    """Pairs of coordinates with a non-zero slope."""
    return [pair for family in families for block in family.blocks for pair in block.entries]


def _comment(text: str) -> str:
    """One printable line that neither ends nor begins a C comment."""
    line = "".join(character if character.isprintable() else "?" for character in " ".join(text.split()))
    return line.replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ? /")


def _notes(method: Method) -> tuple[str, ...]:
    order = "no order claimed" if method.order is None else f"order {method.order}"
    return (
        order,
        "symplectic" if method.symplectic else "not symplectic",
        "symmetric" if method.symmetric else "not symmetric",
    )


def _required_extrapolation(stages: StageSystem) -> Matrix:
    if stages.extrapolation is None or any(block.power != 1 for block in stages.blocks):
        raise TypeError("only stage systems with velocities as unknowns can be lowered")
    return stages.extrapolation


def _family(system: MechanicalSystem, family: PointFamily) -> Family:
    common: dict[str, Any] = {
        "arguments": family.arguments,
        "time": system.time,
        "parameters": system.parameters,
    }
    slopes, blocks = _slope_blocks(family)
    return Family(
        name=family.name,
        arguments=tuple(argument_name(system, gather) for gather in family.gathers),
        abscissae=lower_vector(family.abscissae),
        weights=lower_vector(family.weights),
        gathers=tuple(_gather_loop(family, g) for g in range(len(family.gathers))),
        scatters=tuple(_scatter_loop(family, s) for s in range(len(family.scatters))),
        value=lower_kernel(f"{family.name}_value", values=family.results, **common),
        slope=lower_kernel(f"{family.name}_slope", values=family.results, slopes=slopes, **common),
        blocks=blocks,
        action=_action(family, common) if family.in_action and _is_regular(system) else None,
        action_power=family.scalar_power,
    )


def _action(family: PointFamily, common: dict[str, Any]) -> Kernel:
    """The scalar of a family; that of the values is called after the function it is."""
    name = "lagrangian" if family.name == "quadrature" else f"{family.name}_action"
    return lower_kernel(name, values=(family.scalar,), **common)


def argument_name(system: MechanicalSystem, gather: Gather) -> str:
    """What a gather gives, as the formulas call it."""
    names = {
        system.coordinates: "q",
        system.velocities: "v",
        **dict(zip(curve_rates(system, 3), ("a", "j", "s"), strict=True)),
        multipliers(system): "lambda",
        system.auxiliaries: "p",
        auxiliary_multipliers(system): "nu",
    }
    return names[gather.arguments]


def _slope_blocks(family: PointFamily) -> tuple[tuple[sympy.Expr, ...], tuple[SlopeBlock, ...]]:
    """Non-zero slopes, grouped by scatter and gather."""
    slopes: list[sympy.Expr] = []
    blocks = []
    for s, scatter in enumerate(family.scatters):
        for g, gather in enumerate(family.gathers):
            entries = jacobian(scatter.results, gather.arguments)
            if entries:
                blocks.append(SlopeBlock(scatter=s, gather=g, first=len(slopes), entries=tuple(entries)))
                slopes.extend(entries.values())
    return tuple(slopes), tuple(blocks)


def _gather_loop(family: PointFamily, index: int) -> GatherLoop:
    gather = family.gathers[index]
    return GatherLoop(
        name=f"{family.name}_gather_{index}",
        offset=sum(len(other.arguments) for other in family.gathers[:index]),
        from_state=bool(gather.table.entries[0][0]),
        power=gather.power + 1,
        table=lower_matrix(tuple(line[1:] for line in gather.table.entries)),
    )


def _scatter_loop(family: PointFamily, index: int) -> ScatterLoop:
    scatter = family.scatters[index]
    return ScatterLoop(
        name=f"{family.name}_scatter_{index}",
        offset=sum(len(other.results) for other in family.scatters[:index]),
        power=scatter.power,
        table=lower_matrix(scatter.table.entries),
    )


def lower_vector(numbers: Vector) -> tuple[float, ...]:
    """Each number rounded to the nearest double."""
    return tuple(float(x) for x in numbers)


def lower_matrix(entries: Matrix) -> tuple[tuple[float, ...], ...]:
    """The same for the rows of a table."""
    return tuple(lower_vector(line) for line in entries)
