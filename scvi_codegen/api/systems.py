"""Systems as formulas: what a product reads of them.

``MechanicalSystem``
    Coordinates, time, parameters with defaults, constraints, forces, events of named coordinates; its subclasses are
    the public ``LagrangianSystem``, ``HamiltonianSystem``, ``FirstOrderSystem``. SystemDefinitionError.
``ArraySystem``
    The same in index notation, with sizes that are known at run time.
``SYSTEM_OR_ARRAYS``
    Kind of an argument that is one of these.
``forms_of(system)``
    Derived expressions, each computed once: mass matrix, equations of motion, energy, conditions and
    forces of constraints.
"""

from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.system import SYSTEM_OR_ARRAYS, MechanicalSystem

__all__ = ["SYSTEM_OR_ARRAYS", "ArraySystem", "MechanicalSystem", "forms_of"]
