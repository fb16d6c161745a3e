"""What the products of ``scvi_codegen.extras`` may use of the core: at most 60 names in nine modules.

``checks`` of arguments; ``text``, files; ``formulas``, numbers of 60 digits; ``systems``; ``methods``; ``program``,
the C source; ``states``; ``runs``; ``commands`` of the command line. Each lists its names with shapes, units, errors.
Public names, ``scvi_codegen.__all__``, are used besides. :mod:`scvi_codegen.common.registry` says how a product adds
commands and methods.
"""
