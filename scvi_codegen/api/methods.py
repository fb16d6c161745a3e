"""Methods and the equations of their steps.

``Method``
    Base class of one-step methods (t, q0, p0), h -> (q1, p1) with the properties that they guarantee.
``Discretisation(system, method)``
    The equations of a step as a ``StageSystem``: compiled, as in the paper, in 60 digits; what the steps preserve.
``StageSystem``
    Unknowns in blocks, equations in rows, and ``stage_groups`` of points that one kernel evaluates, with
    tables of 60 digits between them (``methods/stage_system.py`` states the contract).
"""

from scvi_codegen.methods import Method
from scvi_codegen.methods.discretise import Discretisation
from scvi_codegen.methods.stage_system import StageSystem

__all__ = ["Discretisation", "Method", "StageSystem"]
