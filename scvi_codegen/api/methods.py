"""Methods and the equations of their steps.

``Method``
    Base class of one-step methods (t, q0, p0), h -> (q1, p1) with the properties that they guarantee.
``method_from_specification(specification)``
    The method of plain data, ``{"method": "svi", "degree": 8}``; MethodError for other data.
``Discretisation(system, method)``
    The equations of a step as a ``StageSystem``: compiled, as in the paper, in 60 digits; what the steps preserve.
``StageSystem``, ``StageGroup``
    Unknowns in blocks, equations in rows, and groups of points that one kernel evaluates, with tables of 60 digits
    between them (``methods/stage_system.py`` states the contract).
"""

from scvi_codegen.methods import Method, method_from_specification
from scvi_codegen.methods.discretise import Discretisation
from scvi_codegen.methods.stage_system import StageGroup, StageSystem

__all__ = ["Discretisation", "Method", "StageGroup", "StageSystem", "method_from_specification"]
