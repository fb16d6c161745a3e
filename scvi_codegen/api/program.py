"""The C of an integrator.

``Source``
    Header, code and the files that it includes; ``write(folder)`` stores them. Equal sources compile once.
``Interface``
    What a compiled integrator is: names of coordinates, momenta, parameters and inputs, dimension, words of a number,
    constraints, rotations, sizes of arrays.
"""

from scvi_codegen.codegen.rendering.source import Interface, Source

__all__ = ["Interface", "Source"]
