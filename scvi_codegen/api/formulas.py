"""Formulas (SymPy), their text, values and derivatives; numbers of 60 digits.

``symbol(name)``, ``TIME``, ``DOT``
    The real symbol of a name; the name of time, ``"t"``; the ending of velocities, ``"_dot"``.
``parse_expression(text, symbols)``
    Formula of a text in the symbols of a mapping; code is never evaluated. ExpressionError names the place.
``gradient_tuple(expression, variables)``, ``jacobian(expressions, variables)``
    All first derivatives; those that are not 0 by (row, column).
``Tape(expressions, symbols)``
    Straight-line program of expressions for values and derivatives in any arithmetic.
``mp``, ``Number``, ``Vector``
    mpmath's functions at 60 digits, in each thread its own; a number and a tuple of numbers of these.
``input_parameters(inputs)``
    Parameters that hold inputs by piece, with their default 0.
``Rotation(name, rate, momentum)``, ``RotationNames(members)``
    A rotation from body to space as a quaternion of any length, and the names of its entries in formulas.
``Array(name, axes, letters, is_field)``
    Declaration of an array whose sizes may be names, ``q[N, 3]``.
"""

from scvi_codegen.common.precision import Number, Vector, mp
from scvi_codegen.systems.formulas.expressions import Tape, gradient_tuple, jacobian
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.formulas.rotations import Rotation, RotationNames
from scvi_codegen.systems.formulas.symbols import DOT, TIME, input_parameters, symbol

__all__ = [
    "DOT",
    "TIME",
    "Array",
    "Number",
    "Rotation",
    "RotationNames",
    "Tape",
    "Vector",
    "gradient_tuple",
    "input_parameters",
    "jacobian",
    "mp",
    "parse_expression",
    "symbol",
]
