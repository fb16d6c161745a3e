"""Formulas (SymPy), their text, values and derivatives; numbers of 60 digits.

``symbol(name)``, ``TIME``, ``DOT``
    The real symbol of a name; the name of time, ``"t"``; the ending of velocities, ``"_dot"``.
``parse_expression(text, symbols)``
    Formula of a text in the symbols of a mapping; code is never evaluated. ExpressionError names the place. Also of a
    SymPy expression, whose parts the mapping replaces: its numbers become exact and its constructors are evaluated.
``Intermediate``
    Quantity that is computed once and differentiated by its own name: ``named(expression)``; those ``within``
    expressions; ``written_out(expression)`` without; ``sum_of_products(*factors)``, in a third of SymPy's time.
``check_names(coordinates, parameters)``
    SystemDefinitionError for names that formulas or C cannot have, and for one name of two things.
``array_value(expression, values)``
    Values of a formula for numbers and NumPy arrays by symbol, in their broadcast shape; NaN where undefined.
``jacobian(expressions, variables)``
    First derivatives that are not 0, by (row, column).
``Tape(expressions, symbols)``
    Straight-line program of expressions for values in 60 digits; ``Tape.samples`` are those at random points.
``mp``, ``Number``
    mpmath's functions at 60 digits, in each thread its own; a number of these.
``input_parameters(inputs)``
    Parameters that hold inputs by piece, with their default 0.
``Rotation(name, rate, momentum)``, ``RotationNames(members)``
    A rotation from body to space as a quaternion of any length, and the names of its entries in formulas.
``Array(name, axes, letters, is_field)``
    Declaration of an array whose sizes may be names, ``q[N, 3]``.
"""

from scvi_codegen.common.precision import Number, mp
from scvi_codegen.systems.formulas.expressions import Tape, jacobian
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.formulas.intermediates import Intermediate
from scvi_codegen.systems.formulas.numpy_values import array_value
from scvi_codegen.systems.formulas.rotations import Rotation, RotationNames
from scvi_codegen.systems.formulas.symbols import DOT, TIME, check_names, input_parameters, symbol

__all__ = [
    "DOT",
    "TIME",
    "Array",
    "Intermediate",
    "Number",
    "Rotation",
    "RotationNames",
    "Tape",
    "array_value",
    "check_names",
    "input_parameters",
    "jacobian",
    "mp",
    "parse_expression",
    "symbol",
]
