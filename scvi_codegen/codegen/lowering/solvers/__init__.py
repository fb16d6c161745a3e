"""Solvers of the stage equations without matrices: fixed-point iterations and splittings.

The points of an iteration are SIMD lanes. Each module turns the tables of a method and the kernels of a system into
data for a template; :mod:`scvi_codegen.codegen.lowering.program` selects one. Newton's method, which is always
available, is lowered from the stage system itself, in :mod:`scvi_codegen.codegen.lowering.program`.
"""
