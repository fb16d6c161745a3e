"""Systems as formulas: what a product reads of them.

``MechanicalSystem``
    Coordinates, time, parameters with defaults, constraints, forces, events of named coordinates; its subclasses are
    the public ``LagrangianSystem``, ``HamiltonianSystem``, ``FirstOrderSystem``. SystemDefinitionError. ``KIND`` and
    ``OR_ARRAYS`` are kinds of an argument that is one of these, with arrays of sizes known at run time or without.
``ArraySystem``
    The same in index notation, with sizes that are known at run time.
``system_from_sympy(make, function, formula, *, name, coordinates, ..)``
    System that ``make`` returns for its fields, of a SymPy ``"Lagrangian"`` or ``"Hamiltonian"``, as of ``from_sympy``.
``tangent_space(rows)``
    Rank, basis and determined columns of rows of derivatives, by the one decision on rank.
``forms_of(system)``
    Derived expressions, each computed once: mass matrix, equations of motion, energy, conditions and
    forces of constraints.
"""

from scvi_codegen.common.tangent_space import tangent_space
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.reading import system_from_sympy
from scvi_codegen.systems.system import MechanicalSystem

__all__ = ["ArraySystem", "MechanicalSystem", "forms_of", "system_from_sympy", "tangent_space"]
