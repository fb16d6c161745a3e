"""Reproduction of the paper: every figure, table, theorem and claim as an experiment with a verdict.

An experiment is a function that returns a :class:`~scvi_codegen.reproduce.laboratory.experiment.Result`: setting, claim
of the paper, measurements, numbers, a picture. :mod:`~scvi_codegen.reproduce.catalogue` lists all of them.
"""
