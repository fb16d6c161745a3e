"""States, their checks, steps and rounding.

``Array``
    ``numpy.ndarray`` of binary64.
``States``, ``Parameters``
    (m,) or (k, m) numbers or a mapping from names; numbers in the order of the system or a mapping from names.
``checked_number(value, name)``
    Finite number. StateError.
``real_array(value, name)``
    Contiguous copy of real numbers of any shape, possibly not finite. StateError.
``Starts(t, h, q, p, chained)``
    Times (n,), steps (n,), positions and momenta (n, m) of n steps whose derivatives are computed together.
``Fixed(h)``, ``Fixed.checked(h)``
    Plan of fixed steps of h, as many as a call requests; ``times(t, numbers)``, ``number_in(spans)``, ``Fixed.SAME``.
``Reduction(interface)``
    Maps between tangent vectors (.., 2m) of (q, p) and canonical ones of the space reduced by norms of quaternions.
"""

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.runs.states.reduction import Reduction
from scvi_codegen.runs.states.validation import Array, Parameters, States
from scvi_codegen.runs.stepping.step_derivatives import Starts
from scvi_codegen.runs.stepping.step_plan import Fixed

__all__ = ["Array", "Fixed", "Parameters", "Reduction", "Starts", "States", "checked_number", "real_array"]
