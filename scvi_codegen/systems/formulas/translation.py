"""Translation of SymPy expressions to the canonical symbols of a system, and of expressions to text of the grammar.

Functions of time and their derivatives become coordinates and velocities. The text is that of
:mod:`scvi_codegen.systems.formulas.grammar`.
"""

from collections.abc import Sequence
from typing import Any

import sympy
from sympy import Expr, Integer, Pow, S, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.formulas.expressions import NAME_OF, evaluated, parts_of_type, unsupported_part
from scvi_codegen.systems.formulas.intermediates import Intermediate
from scvi_codegen.systems.formulas.symbols import DOT, TIME, identifier, symbol
from scvi_codegen.systems.formulas.tables import Tabulated


def sympy_expression(value: Any, role: str) -> Expr:
    """Return a SymPy expression, also of a number; SystemDefinitionError for text, where SymPy's E is 2.718.."""
    try:
        expression = sympy.sympify(value, strict=True)
    except sympy.SympifyError:
        expression = value
    if not isinstance(expression, Expr) or expression.is_Matrix:
        raise SystemDefinitionError(
            f"the {role} is a {type(value).__name__}, not a SymPy expression (text goes to from_text)"
        )
    return expression


class Translation:
    """Map from a user's symbols, functions of time and derivatives to canonical symbols.

    Args:
        expression: main expression to translate.
        coordinates: symbols or functions of time.
        others: further expressions to translate.
        velocities, momenta: parallel to the coordinates.
        time: symbol of time.
        parameters, inputs: names, also of functions of time.

    Attributes:
        coordinates, momenta, parameters: canonical symbols.
        rules: canonical symbols by the user's expressions.
    """

    def __init__(
        self,
        expression: Expr,
        coordinates: Sequence[Expr],
        others: Sequence[Expr] = (),
        *,
        velocities: Sequence[Expr] | None = None,
        momenta: Sequence[Expr] = (),
        time: Symbol | None,
        parameters: tuple[str, ...],
        inputs: tuple[str, ...] = (),
    ) -> None:
        self.rules: dict[Expr, Expr] = {}
        free = expression.free_symbols.union(*(other.free_symbols for other in others))
        self.free = sorted(free, key=lambda variable: str(variable.name))
        self.user_time = self._time(coordinates, time, parameters)
        if self.user_time is not None:
            self._add(self.user_time, TIME)
        if velocities is not None and len(velocities) != len(coordinates):
            raise SystemDefinitionError(
                f"there are {len(coordinates)} coordinates, but {len(velocities)} velocities: list "
                "one velocity per coordinate"
            )
        self.coordinates = tuple(self._coordinate(coordinate) for coordinate in coordinates)
        for index, coordinate in enumerate(coordinates):
            self._velocity(coordinate, None if velocities is None else velocities[index])
        self.momenta = tuple(self._coordinate(momentum, "momentum") for momentum in momenta)
        self.parameters = tuple(self._parameter(parameter) for parameter in parameters)
        functions = parts_of_type(AppliedUndef, *(expression, *others)) - self.rules.keys()
        for function in sorted(functions, key=str):
            if function.func.__name__ in {*parameters, *inputs} and function.args == (self.user_time,):
                self._add(function, identifier(function.func.__name__))
        for free in self.free:
            if free not in self.rules:
                self._add(free, identifier(free.name))

    def apply(self, expression: Expr, role: str = "Lagrangian") -> Expr:
        """Return the expression in canonical symbols, with exact numbers."""
        unfolded = {derivative: derivative.doit() for derivative in parts_of_type(sympy.Derivative, expression)}
        result = evaluated(expression.xreplace(unfolded), self.rules)
        leftover = sorted(parts_of_type(sympy.Derivative, result) or parts_of_type(AppliedUndef, result), key=str)
        if leftover:
            raise SystemDefinitionError(
                f"'{leftover[0]}' in the {role} is neither a coordinate nor the velocity of one: list it among the "
                "coordinates, or among the inputs if it is data, or write it with the functions of the grammar "
                "(accelerations and other higher derivatives are not supported)"
            )
        return result

    def _add(self, source: Expr, name: str) -> Symbol:
        """Map a symbol, function or derivative of the user to the canonical symbol of a name."""
        target = symbol(name)
        if self.rules.get(source, target) != target:
            raise SystemDefinitionError(f"'{source}' is used both as '{self.rules[source]}' and as '{name}'")
        for other, taken in self.rules.items():
            if taken == target and other != source and not isinstance(other, sympy.Derivative):
                raise SystemDefinitionError(
                    f"'{other}' and '{source}' are different symbols that would both be called "
                    f"'{name}': rename one (symbols with equal names but different assumptions are "
                    "different)"
                )
        self.rules[source] = target
        return target

    def _time(self, coordinates: Sequence[Expr], time: Symbol | None, parameters: tuple[str, ...]) -> Symbol | None:
        if time is not None:
            return time
        functions = [coordinate for coordinate in coordinates if isinstance(coordinate, AppliedUndef)]
        if functions:
            return functions[0].args[0]
        candidates = [free for free in self.free if free.name == TIME and free not in coordinates]
        return candidates[0] if candidates and TIME not in parameters else None

    def _coordinate(self, coordinate: Expr, role: str = "coordinate") -> Symbol:
        if isinstance(coordinate, AppliedUndef):
            if coordinate.args != (self.user_time,):
                raise SystemDefinitionError(f"{role} '{coordinate}' is not a function of time '{self.user_time}' alone")
            return self._add(coordinate, identifier(coordinate.func.__name__))
        if not isinstance(coordinate, Symbol):
            raise SystemDefinitionError(f"{role} {coordinate!r} is neither a symbol nor a function of time")
        return self._add(coordinate, identifier(coordinate.name))

    def _velocity(self, coordinate: Expr, velocity: Expr | None) -> None:
        """Map the velocity of a coordinate: its derivative, the one given, or the symbol ``q_dot``."""
        name = self.rules[coordinate].name + DOT
        if isinstance(coordinate, AppliedUndef):
            self.rules[sympy.Derivative(coordinate, self.user_time)] = symbol(name)
        if velocity is not None:
            if not isinstance(velocity, (Symbol, AppliedUndef, sympy.Derivative)):
                raise SystemDefinitionError(f"velocity {velocity!r} is neither a symbol nor a derivative")
            self._add(velocity, name)
        elif isinstance(coordinate, Symbol):
            for free in self.free:
                if free.name == coordinate.name + DOT:
                    self._add(free, name)

    def _parameter(self, parameter: str) -> Symbol:
        name = identifier(parameter)
        for free in self.free:
            if free.name == parameter and free not in self.rules:
                self._add(free, name)
        return symbol(name)


def format_expression(expression: Expr) -> str:
    """Return an expression as text of the grammar, from which ``parse_expression`` rebuilds it node by node.

    The expression is taken as SymPy's constructors leave it; one built with ``evaluate=False`` comes back evaluated.
    SystemDefinitionError for an expression outside the grammar.

    >>> import sympy
    >>> x, y = sympy.symbols("x y", real=True)
    >>> format_expression(sympy.sqrt(x) / (3 * y) - sympy.exp(-y))
    'sqrt(x)/(3*y) - exp(-y)'
    """
    problem = unsupported_part(expression)
    if problem:
        raise SystemDefinitionError(problem)
    return _sum_text(expression)


def _sum_text(expression: Expr) -> str:
    if isinstance(expression, Tabulated):
        return _atom_text(expression)
    if isinstance(expression, Intermediate):
        return _sum_text(expression.definition)
    if not expression.is_Add:
        return _product_text(expression)
    first, *others = (_product_text(term) for term in expression.as_ordered_terms())
    return first + "".join(f" - {term[1:]}" if term.startswith("-") else f" + {term}" for term in others)


def _product_text(expression: Expr) -> str:
    """Return a product with its divisors after a slash."""
    coefficient, rest = expression.as_coeff_Mul(rational=True)
    factors = [factor for factor in rest.as_ordered_factors() if factor is not S.One]
    below = [factor for factor in factors if factor.is_Pow and factor.exp.is_Rational and factor.exp < 0]
    above = [_power_text(factor) for factor in factors if factor not in below]
    divisors = [_power_text(Pow(factor.base, -factor.exp)) for factor in below]
    if coefficient.q != 1:
        divisors.insert(0, str(coefficient.q))
    if abs(coefficient.p) != 1 or not above:
        above.insert(0, str(abs(coefficient.p)))
    text = ("-" if coefficient < 0 else "") + "*".join(above)
    if len(divisors) < 2:
        return text + "".join(f"/{divisor}" for divisor in divisors)
    # A rational factor in front of a sum in brackets would be expanded by the parser: divide factor by factor.
    return (
        f"{text}/{'/'.join(divisors)}"
        if any(factor.base.is_Add for factor in below)
        else f"{text}/({'*'.join(divisors)})"
    )


def _power_text(expression: Expr) -> str:
    if not expression.is_Pow:
        return _atom_text(expression)
    base, exponent = expression.as_base_exp() if expression.exp.is_Rational else expression.args
    if exponent == S.Half:
        return f"sqrt({_sum_text(base)})"
    return f"{_atom_text(base)}**{_atom_text(exponent)}"


def _atom_text(expression: Expr) -> str:
    if isinstance(expression, Tabulated):
        return f"{expression.function.name}({', '.join(map(_sum_text, expression.arguments))})"
    if isinstance(expression, Intermediate):
        return f"({_sum_text(expression)})"
    if expression.is_Symbol:
        return str(expression.name)
    if expression is S.Exp1:
        return "exp(1)"
    if expression is S.Pi or (isinstance(expression, Integer) and expression >= 0):
        return str(expression)
    if expression.func in NAME_OF:
        return f"{NAME_OF[expression.func]}({', '.join(map(_sum_text, expression.args))})"
    return f"({_sum_text(expression)})"
