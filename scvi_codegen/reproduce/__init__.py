"""The paper, run again: every figure, table, theorem and claim as an experiment that is judged.

An experiment is a function that gives a :class:`~scvi_codegen.reproduce.laboratory.experiment.Result`: what was run,
what the paper says, what was measured, numbers, a picture. :mod:`~scvi_codegen.reproduce.catalogue` lists them all.
"""
