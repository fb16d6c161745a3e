r"""The mechanical system: coordinates, velocities, time, parameters with default values, and the Lagrangian.

Inside, every symbol is ``Symbol(name, real=True)`` with a plain identifier as name: coordinate ``q`` has the velocity
``q_dot``, time is ``t``. Names given by the user are mapped as follows.

* ``\theta_1``, ``\theta_{1}`` and ``θ_1`` become ``theta_1``; spaces become underscores.
* Refused, with the name: what is no identifier even then, keywords of C, functions and constants of the grammar,
  ``t`` for anything but time, ``q_dot`` for anything but the velocity of ``q``, two symbols that end up the same.
"""

from __future__ import annotations

import math
import random
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from sympy import Expr, Matrix, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.derivatives import hessian
from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.expression_text import (
    FUNCTIONS,
    closest,
    evaluate,
    evaluated,
    format_expression,
    parse_expression,
    unsupported_part,
)
from scvi_codegen.precision import Number, mp

if TYPE_CHECKING:
    from sympy.physics.mechanics import LagrangesMethod

__all__ = ["C_KEYWORDS", "LagrangianSystem"]

C_KEYWORDS = frozenset(
    """
    alignas alignof auto bool break case char const constexpr continue default do double else enum extern false float
    for goto if inline int long nullptr register restrict return short signed sizeof static static_assert struct switch
    thread_local true typedef typeof typeof_unqual union unsigned void volatile while asm fortran
    """.split()  # noqa: SIM905  (a paragraph of words reads better than fifty quoted ones)
)

_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_TIME = "t"
_DOT = "_dot"

Entries = Mapping[tuple[int, int], Expr]


@dataclass(frozen=True, slots=True, kw_only=True)
class LagrangianSystem:
    """A Lagrangian L(q, q_dot, t; parameters) in m coordinates, checked on construction.

    Build one with ``from_text``, ``from_sympy`` or ``from_lagranges_method``. Equality is structural.

    Attributes:
        name: what the system is called.
        coordinates: the m coordinates, in order.
        velocities: the m velocities, parallel to ``coordinates``.
        time: the symbol ``t``.
        parameters: the symbols that stay adjustable in the compiled integrator; one may be absent from L.
        defaults: their default values, parallel to ``parameters``.
        lagrangian: L, exact: no floating-point number occurs in it.

    Raises:
        SystemDefinitionError: naming the symbol at fault, if a name is unfit or used twice, L contains an unknown
            symbol or an unsupported function, a default value is not a finite number, a velocity does not occur in L,
            or the mass matrix d2L/dv2 is singular at every point tried.
    """

    name: str
    coordinates: tuple[Symbol, ...]
    velocities: tuple[Symbol, ...]
    time: Symbol
    parameters: tuple[Symbol, ...]
    defaults: tuple[float, ...]
    lagrangian: Expr

    def __post_init__(self) -> None:
        _check_symbols(self)
        _check_defaults(self)
        _check_lagrangian(self)
        _check_mass_matrix(self)

    @property
    def dimension(self) -> int:
        """The number m of coordinates."""
        return len(self.coordinates)

    @classmethod
    def from_text(
        cls, *, name: str, coordinates: Sequence[str], lagrangian: str, parameters: Mapping[str, float] | None = None
    ) -> LagrangianSystem:
        """Read L from text of the grammar in ``expression_text``.

        Args:
            name: what the system is called.
            coordinates: names of the coordinates; the velocity of ``q`` is written ``q_dot``, time ``t``.
            lagrangian: the formula; it may span several lines.
            parameters: default value by name.

        >>> LagrangianSystem.from_text(
        ...     name="oscillator", coordinates=["x"], lagrangian="m*x_dot**2/2 - k*x**2/2", parameters={"m": 1, "k": 2}
        ... ).lagrangian
        -k*x**2/2 + m*x_dot**2/2
        """
        if isinstance(coordinates, str):
            raise SystemDefinitionError(f"coordinates is a sequence of names: write ['{coordinates}']")
        values = dict(parameters or {})
        _check_names(coordinates, tuple(values))
        velocities = [coordinate + _DOT for coordinate in coordinates]
        symbols = {symbol_name: _symbol(symbol_name) for symbol_name in [*coordinates, *velocities, _TIME, *values]}
        return cls(
            name=name,
            coordinates=tuple(symbols[coordinate] for coordinate in coordinates),
            velocities=tuple(symbols[velocity] for velocity in velocities),
            time=symbols[_TIME],
            parameters=tuple(symbols[parameter] for parameter in values),
            defaults=tuple(_number(parameter, value) for parameter, value in values.items()),
            lagrangian=parse_expression(lagrangian, symbols),
        )

    @classmethod
    def from_sympy(
        cls,
        *,
        name: str,
        lagrangian: Expr,
        coordinates: Sequence[Expr],
        velocities: Sequence[Expr] | None = None,
        time: Symbol | None = None,
        parameters: Mapping[Symbol | str, float] | None = None,
    ) -> LagrangianSystem:
        """Take L from a SymPy expression, in plain symbols or in functions of time.

        Floating-point numbers become the rationals their shortest decimal form says (``0.1`` is 1/10); symbols become
        canonical as the module describes.

        Args:
            name: what the system is called.
            lagrangian: L.
            coordinates: symbols, or functions of time such as ``dynamicsymbols`` gives.
            velocities: parallel to ``coordinates``; by default ``Derivative(q(t), t)`` for a function of time, the
                symbol called ``q_dot`` for a symbol ``q``.
            time: the symbol for time; by default the argument of the coordinates, or the symbol called ``t``.
            parameters: default value by symbol or by name.
        """
        if not isinstance(lagrangian, Expr):
            raise SystemDefinitionError(
                f"the Lagrangian is a {type(lagrangian).__name__}, not a SymPy expression (text goes to from_text)"
            )
        given = {_given_name(key): value for key, value in (parameters or {}).items()}
        if len(given) < len(parameters or {}):
            raise SystemDefinitionError("two parameters have the same name: rename one of them")
        translation = _Translation(lagrangian, coordinates, velocities, time, tuple(given))
        return cls(
            name=name,
            coordinates=translation.coordinates,
            velocities=translation.velocities,
            time=_symbol(_TIME),
            parameters=translation.parameters,
            defaults=tuple(_number(parameter, value) for parameter, value in given.items()),
            lagrangian=translation.apply(lagrangian),
        )

    @classmethod
    def from_lagranges_method(
        cls, method: LagrangesMethod, *, name: str, parameters: Mapping[Symbol | str, float] | None = None
    ) -> LagrangianSystem:
        """Take over a ``sympy.physics.mechanics.LagrangesMethod`` without forces and constraints.

        Raises:
            SystemDefinitionError: if it has a force list or constraints; they are refused, never dropped.
        """
        if len(method.forcelist):
            raise SystemDefinitionError(
                "this LagrangesMethod has a forcelist: a variational integrator of L alone would drop the forces. "
                "Put conservative forces into the potential; nonconservative ones are not supported"
            )
        if len(method.coneqs):
            raise SystemDefinitionError(
                "this LagrangesMethod has constraints (hol_coneqs or nonhol_coneqs), which are not supported: use as "
                "many independent coordinates as there are degrees of freedom"
            )
        lagrangian = method._L[0]  # LagrangesMethod has no public name for it
        return cls.from_sympy(name=name, lagrangian=lagrangian, coordinates=list(method.q), parameters=parameters)

    def to_text(self) -> str:
        """L as text that ``from_text`` reads back."""
        return format_expression(self.lagrangian)

    def with_parameters(self, **values: float) -> LagrangianSystem:
        """Copy the system with other default values for the parameters named."""
        names = [parameter.name for parameter in self.parameters]
        for key in values:
            if key not in names:
                raise SystemDefinitionError(
                    f"'{self.name}' has no parameter '{key}'{closest(key, names)} It has: {', '.join(names) or 'none'}"
                )
        changed = dict(zip(names, self.defaults, strict=True)) | values
        return replace(self, defaults=tuple(_number(key, value) for key, value in changed.items()))

    def _repr_latex_(self) -> str:
        dotted = {
            velocity: rf"\dot{{{sympy.latex(coordinate)}}}"
            for coordinate, velocity in zip(self.coordinates, self.velocities, strict=True)
        }
        return rf"$\displaystyle L = {sympy.latex(self.lagrangian, symbol_names=dotted)}$"


def _symbol(name: str) -> Symbol:
    return Symbol(name, real=True)


def _number(name: str, value: Any) -> float:
    """Convert a default value; text and complex numbers are refused, not converted."""
    try:
        number = math.nan if isinstance(value, (str, bytes, complex)) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise SystemDefinitionError(f"the default value of parameter '{name}' is not a finite real number: {value!r}")
    return number


def _identifier(name: str) -> str:
    r"""Spell a name with letters, digits and underscores where that is harmless: ``\theta_{1}`` -> ``theta_1``."""
    spelled = "".join(_letter(character) for character in name.strip())
    return re.sub(r"\s+", "_", spelled.replace("{", "").replace("}", "").replace("\\", ""))


def _letter(character: str) -> str:
    words = unicodedata.name(character, "").split()
    if words[:1] != ["GREEK"] or words[2:3] != ["LETTER"] or len(words) != 4:
        return character
    letter = words[3].replace("LAMDA", "LAMBDA")
    return letter.lower() if words[1] == "SMALL" else letter.capitalize()


def _given_name(key: object) -> str:
    if isinstance(key, Symbol):
        return str(key.name)
    if isinstance(key, str):
        return key
    raise SystemDefinitionError(f"a parameter is a symbol or a name, not {key!r} ({type(key).__name__})")


class _Translation:
    """The map from a user's symbols, functions of time and derivatives to canonical symbols."""

    def __init__(
        self,
        lagrangian: Expr,
        coordinates: Sequence[Expr],
        velocities: Sequence[Expr] | None,
        time: Symbol | None,
        parameters: tuple[str, ...],
    ) -> None:
        self.rules: dict[Expr, Expr] = {}
        self.free = sorted(lagrangian.free_symbols, key=lambda symbol: str(symbol.name))
        self.user_time = self._time(coordinates, time, parameters)
        if self.user_time is not None:
            self._add(self.user_time, _TIME)
        if velocities is not None and len(velocities) != len(coordinates):
            raise SystemDefinitionError(
                f"{len(coordinates)} coordinates, but {len(velocities)} velocities: list one each"
            )
        self.coordinates = tuple(self._coordinate(coordinate) for coordinate in coordinates)
        for index, coordinate in enumerate(coordinates):
            self._velocity(coordinate, None if velocities is None else velocities[index])
        self.velocities = tuple(_symbol(coordinate.name + _DOT) for coordinate in self.coordinates)
        self.parameters = tuple(self._parameter(parameter) for parameter in parameters)
        for symbol in self.free:
            if symbol not in self.rules:
                self._add(symbol, _identifier(symbol.name))

    def apply(self, lagrangian: Expr) -> Expr:
        unfolded = {derivative: derivative.doit() for derivative in lagrangian.atoms(sympy.Derivative)}
        result = evaluated(lagrangian.xreplace(unfolded), self.rules)
        leftover = sorted(result.atoms(sympy.Derivative) or result.atoms(AppliedUndef), key=str)
        if leftover:
            raise SystemDefinitionError(
                f"'{leftover[0]}' in the Lagrangian is neither a coordinate nor the velocity of one: list it among the "
                "coordinates, or write a given function of time with the functions of the grammar (accelerations and "
                "other higher derivatives are not supported)"
            )
        return result

    def _add(self, source: Expr, name: str) -> Symbol:
        target = _symbol(name)
        if self.rules.get(source, target) != target:
            raise SystemDefinitionError(f"'{source}' is used both as '{self.rules[source]}' and as '{name}'")
        for other, taken in self.rules.items():
            if taken == target and other != source and not isinstance(other, sympy.Derivative):
                raise SystemDefinitionError(
                    f"'{other}' and '{source}' are different symbols that would both be called '{name}': rename one "
                    "(two symbols of one name and different assumptions are different, too)"
                )
        self.rules[source] = target
        return target

    def _time(self, coordinates: Sequence[Expr], time: Symbol | None, parameters: tuple[str, ...]) -> Symbol | None:
        if time is not None:
            return time
        functions = [coordinate for coordinate in coordinates if isinstance(coordinate, AppliedUndef)]
        if functions:
            return functions[0].args[0]
        candidates = [symbol for symbol in self.free if symbol.name == _TIME and symbol not in coordinates]
        return candidates[0] if candidates and _TIME not in parameters else None

    def _coordinate(self, coordinate: Expr) -> Symbol:
        if isinstance(coordinate, AppliedUndef):
            if coordinate.args != (self.user_time,):
                raise SystemDefinitionError(
                    f"coordinate '{coordinate}' is not a function of time '{self.user_time}' alone"
                )
            return self._add(coordinate, _identifier(coordinate.func.__name__))
        if not isinstance(coordinate, Symbol):
            raise SystemDefinitionError(f"coordinate {coordinate!r} is neither a symbol nor a function of time")
        return self._add(coordinate, _identifier(coordinate.name))

    def _velocity(self, coordinate: Expr, velocity: Expr | None) -> None:
        name = self.rules[coordinate].name + _DOT
        if isinstance(coordinate, AppliedUndef):
            self.rules[sympy.Derivative(coordinate, self.user_time)] = _symbol(name)
        if velocity is not None:
            if not isinstance(velocity, (Symbol, AppliedUndef, sympy.Derivative)):
                raise SystemDefinitionError(f"velocity {velocity!r} is neither a symbol nor a derivative")
            self._add(velocity, name)
        elif isinstance(coordinate, Symbol):
            for symbol in self.free:
                if symbol.name == coordinate.name + _DOT:
                    self._add(symbol, name)

    def _parameter(self, parameter: str) -> Symbol:
        name = _identifier(parameter)
        for symbol in self.free:
            if symbol.name == parameter and symbol not in self.rules:
                self._add(symbol, name)
        return _symbol(name)


def _check_name(name: object) -> None:
    if not isinstance(name, str) or not _IDENTIFIER.fullmatch(name):
        raise SystemDefinitionError(
            f"{name!r} is not a name: use letters a-z, A-Z, digits and underscores, beginning with a letter"
        )
    if name in C_KEYWORDS:
        raise SystemDefinitionError(f"'{name}' is a keyword of C: rename the symbol, for instance to '{name}_'")
    if name in FUNCTIONS or name == "pi":
        raise SystemDefinitionError(f"'{name}' has a meaning in formulas: rename the symbol, for instance to '{name}_'")


def _check_names(coordinates: Sequence[str], parameters: Sequence[str]) -> None:
    if not coordinates:
        raise SystemDefinitionError("a system needs at least one coordinate: coordinates is empty")
    roles: dict[str, str] = {_TIME: "time"}
    for name in (*coordinates, *parameters):
        _check_name(name)
    described = [
        *((name, f"coordinate '{name}'") for name in coordinates),
        *((name + _DOT, f"the velocity of '{name}'") for name in coordinates),
        *((name, f"parameter '{name}'") for name in parameters),
    ]
    for name, role in described:
        if roles.get(name) == role:
            raise SystemDefinitionError(f"{role} is listed twice: list it once")
        if name in roles:
            shadowed = role.startswith("parameter") and roles[name].startswith("coordinate")
            hint = " (a coordinate is used as a parameter: take it out of the parameters)" if shadowed else ""
            raise SystemDefinitionError(f"'{name}' is the name of both {roles[name]} and {role}: rename one{hint}")
        roles[name] = role


def _check_symbols(system: LagrangianSystem) -> None:
    if not isinstance(system.name, str) or not system.name.strip():
        raise SystemDefinitionError(f"a system needs a name, not {system.name!r}")
    for symbol in (*system.coordinates, *system.velocities, system.time, *system.parameters):
        if not isinstance(symbol, Symbol) or symbol != _symbol(symbol.name):
            raise SystemDefinitionError(f"{symbol!r} is not a real symbol: build systems with from_sympy or from_text")
    _check_names([symbol.name for symbol in system.coordinates], [symbol.name for symbol in system.parameters])
    expected = tuple(_symbol(coordinate.name + _DOT) for coordinate in system.coordinates)
    if system.velocities != expected or system.time.name != _TIME:
        raise SystemDefinitionError(f"velocities are called {expected}, time '{_TIME}': build systems with from_sympy")


def _check_defaults(system: LagrangianSystem) -> None:
    if len(system.defaults) != len(system.parameters):
        raise SystemDefinitionError(
            f"{len(system.parameters)} parameters, but {len(system.defaults)} default values: give one each"
        )
    for parameter, value in zip(system.parameters, system.defaults, strict=True):
        _number(parameter.name, value)


def _check_lagrangian(system: LagrangianSystem) -> None:
    problem = unsupported_part(system.lagrangian)
    if problem:
        raise SystemDefinitionError(f"in the Lagrangian of '{system.name}': {problem}")
    free = system.lagrangian.free_symbols
    known = [*system.coordinates, *system.velocities, system.time, *system.parameters]
    unknown = sorted(symbol.name for symbol in free.difference(known))
    if unknown:
        hint = closest(unknown[0], [symbol.name for symbol in known])
        raise SystemDefinitionError(
            f"'{unknown[0]}' in the Lagrangian is neither a coordinate, a velocity, time nor a parameter{hint} "
            "Give it a default value among the parameters, or list it as a coordinate"
        )
    for coordinate, velocity in zip(system.coordinates, system.velocities, strict=True):
        if velocity not in free:
            raise SystemDefinitionError(
                f"velocity '{velocity}' does not occur in the Lagrangian: coordinate '{coordinate}' has no kinetic "
                f"energy. Add a term such as {velocity}**2/2, or take the coordinate out (a known function of it can "
                "be a parameter)"
            )


_REMEDY = (
    "A variational integrator needs a regular Lagrangian: add the missing kinetic energy, use fewer coordinates "
    "(independent ones, if there is a constraint), or choose coordinates that are not redundant"
)


def _check_mass_matrix(system: LagrangianSystem) -> None:
    entries = hessian(system.lagrangian, system.velocities)
    if all((index, index) in entries for index in range(system.dimension)):
        structurally_regular = True
    else:
        structurally_regular = _structural_rank(entries, system.dimension) == system.dimension
    if not structurally_regular:
        rows = {row for row, _ in entries}
        missing = [velocity.name for index, velocity in enumerate(system.velocities) if index not in rows]
        reason = (
            f"no second derivative by {', '.join(missing)} is left (it occurs only linearly)"
            if missing
            else "some velocities occur only in products with too few others"
        )
        raise SystemDefinitionError(f"the mass matrix d2L/dv2 of '{system.name}' is singular: {reason}. {_REMEDY}")
    for block in _blocks(entries, system.dimension):
        _check_block(system, entries, block)


def _structural_rank(entries: Entries, size: int) -> int:
    # Imported here because SciPy is slow to import and most systems do not come here.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import structural_rank

    rows, columns = np.array(list(entries), dtype=np.int64).reshape(-1, 2).T
    return int(structural_rank(csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(size, size))))


def _blocks(entries: Entries, size: int) -> list[list[int]]:
    """Indices of velocities that are coupled with each other, block by block."""
    neighbours: list[list[int]] = [[] for _ in range(size)]
    for row, column in entries:
        neighbours[row].append(column)
    blocks, seen = [], [False] * size
    for start in range(size):
        block, pending = [], [start]
        while pending:
            index = pending.pop()
            if not seen[index]:
                seen[index] = True
                block.append(index)
                pending.extend(neighbours[index])
        if block:
            blocks.append(sorted(block))
    return blocks


def _check_block(system: LagrangianSystem, entries: Entries, block: Sequence[int]) -> None:
    """Accept a block that is regular at one point at least, or that no point could be evaluated at."""
    local = {
        (i, j): entries[row, column]
        for i, row in enumerate(block)
        for j, column in enumerate(block)
        if (row, column) in entries
    }
    if len(block) == 1 and local[0, 0].is_Rational:
        return
    evaluated = False
    for point in _points(system):
        known: dict[Expr, Number] = {}
        try:
            matrix = {place: evaluate(entry, point, known) for place, entry in local.items()}
        except ArithmeticError:
            continue
        evaluated = True
        if _regular(matrix, len(block)):
            return
    if evaluated:
        velocities = [system.velocities[index] for index in block]
        names = ", ".join(velocity.name for velocity in velocities)
        values = (
            " with the default parameters" if any(entry.has(*system.parameters) for entry in local.values()) else ""
        )
        raise SystemDefinitionError(
            f"the mass matrix d2L/dv2 of '{system.name}' in {names} is singular at every point tried{values}"
            f"{_null_direction(local, velocities)}. {_REMEDY}"
        )


def _points(system: LagrangianSystem) -> Iterator[dict[Symbol, Number]]:
    """Random points, always the same ones: coordinates of order 1/2, 1 and 10, velocities from 1/1000 to 1."""
    generator = random.Random(20250101)
    parameters = dict(zip(system.parameters, map(mp.mpf, system.defaults), strict=True))

    def spread(symbols: Sequence[Symbol], scale: float) -> dict[Symbol, Number]:
        return {symbol: mp.mpf(scale * generator.uniform(-1, 1)) for symbol in symbols}

    for velocity_scale in (0.1, 1e-3, 1.0):
        for scale in (1.0, 0.5, 10.0):
            coordinates, velocities = spread(system.coordinates, scale), spread(system.velocities, velocity_scale)
            yield parameters | coordinates | velocities | spread([system.time], scale)


def _regular(matrix: dict[tuple[int, int], Number], size: int) -> bool:
    """Eliminate with complete pivoting in 60 digits, each row scaled by its largest entry, zeros left out."""
    rows: list[dict[int, Number]] = [{} for _ in range(size)]
    for (row, column), value in matrix.items():
        rows[row][column] = value
    rows = [{column: value / scale for column, value in row.items()} for row in rows if (scale := _largest(row))]
    if len(rows) < size:
        return False
    while rows:
        best = max(range(len(rows)), key=lambda index: _largest(rows[index]))
        pivot_row = rows.pop(best)
        if _largest(pivot_row) < _NEGLIGIBLE:
            return False
        pivot = max(pivot_row, key=lambda column: abs(pivot_row[column]))
        rows = [_eliminated(row, pivot_row, pivot) if pivot in row else row for row in rows]
    return True


_NEGLIGIBLE = mp.mpf(10) ** -40


def _largest(row: Mapping[int, Number]) -> Number:
    return max(map(abs, row.values()), default=mp.zero)


def _eliminated(row: Mapping[int, Number], pivot_row: Mapping[int, Number], pivot: int) -> dict[int, Number]:
    factor = row[pivot] / pivot_row[pivot]
    result = dict(row)
    for column, value in pivot_row.items():
        result[column] = result.get(column, mp.zero) - factor * value
    del result[pivot]
    return result


def _null_direction(entries: Entries, velocities: Sequence[Symbol]) -> str:
    """Name a combination of velocities without kinetic energy, where that is cheap: few of them, rational entries."""
    size = len(velocities)
    if size > 8 or not all(entry.is_Rational for entry in entries.values()):
        return ""
    vectors = Matrix(size, size, lambda row, column: entries.get((row, column), 0)).nullspace()
    direction = ", ".join(f"{velocity} = {value}" for velocity, value in zip(velocities, vectors[0], strict=True))
    return f": a motion with ({direction}) has no kinetic energy"
