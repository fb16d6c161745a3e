"""Lowering of stage systems to programs, and the choice of a solver (:mod:`~scvi_codegen.codegen.lowering.solvers`)."""
