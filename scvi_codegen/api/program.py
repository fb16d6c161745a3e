"""The C of an integrator.

``Source``
    Header, code and the files that it includes; ``write(folder)`` stores them. Equal sources compile once.
``Interface``
    What a compiled integrator is: names of coordinates, momenta, parameters and inputs, dimension, words of a number,
    constraints, rotations, sizes of arrays.
``Derivation(system, method)``
    How a step is derived: the form that is discretised, statements, the lowered program and its C. MethodError.
"""

from scvi_codegen.codegen.derivation import Derivation
from scvi_codegen.codegen.rendering.source import Interface, Source

__all__ = ["Derivation", "Interface", "Source"]
