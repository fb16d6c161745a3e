"""The C of an integrator.

``Source``
    Header, code and the files that it includes; ``write(folder)`` stores them. Equal sources compile once.
``Interface``
    What a compiled integrator is: names of coordinates, momenta, parameters and inputs, dimension, words of a number,
    constraints, rotations, sizes of arrays.
``Derivation(system, method)``
    How a step is derived: the form that is discretised, statements, the lowered program and its C. MethodError.
``checked_integrator(model, prefix)``
    Source and interface of a ``Model``, as of generated programs; a prefix begins its functions. ModelFileError.
"""

from scvi_codegen.codegen.derivation import Derivation
from scvi_codegen.codegen.rendering.source import Interface, Source
from scvi_codegen.interfaces.models.packages.package import checked_integrator

__all__ = ["Derivation", "Interface", "Source", "checked_integrator"]
