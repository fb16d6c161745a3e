"""Variables of a multibody system, and velocity constraints that are independent of other linear equations.

SymPy's functions of time and speeds are converted to plain symbols, and back.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Dummy, Expr, Matrix, Symbol
from sympy.core.function import AppliedUndef
from sympy.utilities.iterables import connected_components

from scvi_codegen.api.formulas import Rotation, Tape, jacobian, parse_expression
from scvi_codegen.api.systems import tangent_space
from scvi_codegen.common.errors import SystemDefinitionError

MOST_COUPLED = 6
"""Largest number of generalised speeds that equations with variable coefficients couple."""


class Variables:
    """Plain symbols for q(t), dq/dt and generalised speeds u(t); other functions of time get symbols when first read.

    Args:
        coordinates: functions of time.
        time: their argument.
        speeds: generalised speeds; one that equals a dq/dt gets no symbol of its own.
        auxiliary: auxiliary speeds, which are 0.
        rotations: rotations, whose entries and rates are symbols.

    Attributes:
        x, v: symbols of coordinates and velocities, m each.
        entries: entries of the matrices of rotations.
        rates: velocities and, of each rotation, the components of its angular velocity.
        u: symbols of the generalised speeds.
        time: symbol of time.
    """

    def __init__(
        self,
        coordinates: Sequence[Expr],
        time: Symbol,
        speeds: Sequence[Expr] = (),
        auxiliary: Sequence[Expr] = (),
        rotations: Sequence[Rotation] = (),
    ) -> None:
        rates = [q.diff(time) for q in coordinates]
        independent = [u for u in speeds if u not in rates]
        self.time = time
        self.x, self.v, self.u = (tuple(map(_symbol, functions)) for functions in (coordinates, rates, independent))
        self._written: dict[Expr, Expr] = dict(
            zip((*self.x, *self.v, *self.u), (*coordinates, *rates, *independent), strict=True)
        )
        self._own = len(self._written)
        self._plain: dict[Expr, Expr] = {function: symbol for symbol, function in self._written.items()}
        self._plain |= dict.fromkeys(auxiliary, sympy.S.Zero)
        self.rotations = tuple(rotations)
        self.entries = tuple(entry for rotation in rotations for entry in rotation.entries)
        self.rates = (*self.v, *(rate for rotation in rotations for rate in rotation.rates))

    @property
    def other_functions(self) -> tuple[Symbol, ...]:
        """Symbols of the functions of time that are neither coordinates nor speeds."""
        return tuple(self._written)[self._own :]

    def substitute_speeds(self, speeds: Mapping[Symbol, Expr]) -> None:
        """Replace the generalised speeds by their expressions in coordinates and velocities in all later reads."""
        self._plain |= {self._written[u]: value for u, value in speeds.items()}

    def read(self, expression: Any) -> Expr:
        """Return an expression in plain symbols, with exact numbers."""
        expression = sympy.sympify(expression)
        others = expression.atoms(sympy.Derivative, AppliedUndef) - self._plain.keys()
        for function in sorted(others, key=str):
            self._plain[function] = _symbol(function)
            self._written[self._plain[function]] = function
        return parse_expression(expression, self._plain)

    def write(self, expression: Expr) -> Expr:
        """Return an expression in the user's functions of time."""
        return expression.xreplace(self._written)

    def rate(self, function: Expr) -> Expr:
        """Return d/dt of a function of coordinates, rotations and time."""
        terms = (derivative * self.rates[j] for (_, j), derivative in self.pulls([function]).items())
        return sympy.Add(*terms, *jacobian([function], [self.time]).values())

    def pulls(self, functions: Sequence[Expr]) -> dict[tuple[int, int], Expr]:
        """Return the derivatives with respect to coordinates, and about the axes of rotations, by row and rate."""
        along = dict(jacobian(functions, self.x))
        turned = jacobian(functions, self.entries) if self.entries else {}
        for row in {row for row, _ in turned}:
            derivatives = [turned.get((row, j), sympy.S.Zero) for j in range(len(self.entries))]
            along |= {(row, len(self.x) + k): torque for k, torque in enumerate(self._torques(derivatives))}
        return along

    def _torques(self, derivatives: Sequence[Expr]) -> list[Expr]:
        """Return derivatives about the axes of rotations from those with respect to their entries."""
        torques: list[Expr] = []
        for k, rotation in enumerate(self.rotations):
            torques += rotation.torque(derivatives[9 * k : 9 * k + 9])
        return torques

    def projected(self, forces: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return forces on the rates from forces on the rates and on the entries of rotations, in this order."""
        m, n = len(self.x), len(self.rates)
        return (*forces[:m], *map(sympy.Add, forces[m:n], self._torques(forces[n:])))


def _symbol(function: Expr) -> Symbol:
    return Dummy(str(function), real=function.is_real, positive=function.is_positive)


def solved_for_speeds(equations: Sequence[Expr], variables: Variables) -> dict[Symbol, Expr]:
    """Return the generalised speeds in terms of coordinates and velocities, solved from linear equations.

    Raises:
        SystemDefinitionError: if the equations are singular or nonlinear in the speeds, or couple too many of them.
    """
    if not variables.u:
        return {}
    rows, u = Matrix(equations), variables.u
    matrix, right = rows.jacobian(u), -rows.xreplace(dict.fromkeys(u, sympy.S.Zero))
    solution: dict[Symbol, Expr] = {}
    edges = [(i, len(u) + j) for i, j in matrix.todok()]
    for block in map(sorted, connected_components((range(2 * len(u)), edges))):
        lines = [i for i in block if i < len(u)]
        unknowns = [j - len(u) for j in block if j >= len(u)]
        if matrix.has(*u) or len(lines) != len(unknowns) or (len(lines) > MOST_COUPLED and matrix.free_symbols):
            break
        own = matrix.extract(lines, unknowns)
        part = own.adjugate() / own.det(method="berkowitz") * right.extract(lines, [0])  # without pivots that vanish
        solution |= {
            u[j]: value for j, value in zip(unknowns, part, strict=True) if not value.has(sympy.nan, sympy.zoo)
        }
    if len(solution) == len(u):
        return {speed: solution[speed] for speed in u}
    names = ", ".join(str(variables.write(u)) for u in variables.u)
    raise SystemDefinitionError(
        f"the kinematic equations cannot be solved for the generalised speeds {names}: they must be an invertible "
        f"combination of the rates of the coordinates, at most {MOST_COUPLED} of which are coupled"
    )


def independent_of(earlier: Sequence[Expr], asked: Sequence[Expr], rates: Sequence[Symbol]) -> tuple[int, ...]:
    """Return the indices of ``asked`` expressions that are independent of earlier ones, by ranks at a point.

    Args:
        earlier, asked: linear in the rates.
        rates: velocities and speeds.

    Raises:
        SystemDefinitionError: if they have no value at any of the sampled points.
    """
    rows = _values((*earlier, *asked), rates)
    basis, independent = rows[: len(earlier)], []
    for k, row in enumerate(rows[len(earlier) :]):
        more = np.vstack([basis, row])
        if tangent_space(more).rank > tangent_space(basis).rank:
            independent.append(k)
            basis = more
    return tuple(independent)


def matrix_of(entries: Mapping[tuple[int, int], Any], values: Sequence[Any], shape: tuple[int, int]) -> Any:
    """Return the matrix of double precision with values at the places of entries, 0 elsewhere."""
    matrix = np.zeros(shape)
    for place, value in zip(entries, values, strict=True):
        matrix[place] = float(value)
    return matrix


def _values(expressions: Sequence[Expr], rates: Sequence[Symbol]) -> NDArray[np.float64]:
    """Return the coefficients of the rates and the remainder without rates, row by row, at a random point."""
    entries = dict(jacobian(expressions, rates))
    resting = dict.fromkeys(rates, sympy.S.Zero)
    entries |= {(k, len(rates)): expression.xreplace(resting) for k, expression in enumerate(expressions)}
    try:
        for values in Tape.samples([*entries.values()]):
            return np.asarray(matrix_of(entries, values, (len(expressions), len(rates) + 1)))
    except SystemDefinitionError as error:
        raise SystemDefinitionError(f"in the constraints: {error}") from error
    raise SystemDefinitionError(
        "the constraints have no finite value at any of the sampled points: check their domains"
    )
