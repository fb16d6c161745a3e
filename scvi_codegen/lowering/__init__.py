"""Stage system to program, and which solver serves it (:mod:`~scvi_codegen.lowering.solvers`)."""
