"""Solvers of the stage equations that need no matrix: fixed points, whose points are lanes of a vector, and splittings.

Each room here turns the tables of a method and the kernels of a system into data for one template; which of them serves
is said in :mod:`scvi_codegen.lowering.solvers.choice`. Newton's iteration, which serves always, is made from the stage
system itself, in :mod:`scvi_codegen.lowering.program`.
"""
