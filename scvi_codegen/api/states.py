"""States, their checks, steps and rounding.

``Array``
    ``numpy.ndarray`` of binary64.
``States``, ``Parameters``
    (m,) or (k, m) numbers or a mapping from names; numbers in the order of the system or a mapping from names.
``checked_number(value, name)``, ``checked_step(h)``
    Finite number; finite step other than 0, in units of time. StateError.
``real_array(value, name)``
    Contiguous copy of real numbers of any shape, possibly not finite. StateError.
``check_inputs_given(interface, parameters)``
    StateError if an input has no value.
``require(stepper, operation, *together)``
    MethodError that names the remedy if a stepper lacks an operation (``runs/stepping/features.py`` lists them).
``Starts(t, h, q, p, chained)``
    Times (n,), steps (n,), positions and momenta (n, m) of n steps whose derivatives are computed together.
``Fixed(h)``
    Plan of fixed steps, as many as a call requests.
``Reduction(interface)``
    Maps between tangent vectors (.., 2m) of (q, p) and canonical ones of the space reduced by norms of quaternions.
``roundoff(words)``, ``RESOLVED``
    Largest relative rounding error of numbers of one or two words, 2^-53 or 2^-106; the number of them from which a
    difference counts as resolved.
"""

from scvi_codegen.codegen.native.arguments import checked_number, checked_step, real_array
from scvi_codegen.runs.accuracy.size import RESOLVED, roundoff
from scvi_codegen.runs.states.reduction import Reduction
from scvi_codegen.runs.states.validation import Array, Parameters, States, check_inputs_given
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.step_derivatives import Starts
from scvi_codegen.runs.stepping.step_plan import Fixed

__all__ = [
    "RESOLVED",
    "Array",
    "Fixed",
    "Parameters",
    "Reduction",
    "Starts",
    "States",
    "check_inputs_given",
    "checked_number",
    "checked_step",
    "real_array",
    "require",
    "roundoff",
]
