"""Reproduction of the paper: every numerical figure, table and claim as an experiment with a verdict.

Figures are data of a few kinds: runs over time (:mod:`.runs`, :mod:`.figures`), errors of one step
(:mod:`.refinement`), iterations, tableaux. An experiment returns a
:class:`~scvi_codegen.extras.paper.experiment.Result`: setting, claim of the paper,
measurements, numbers, a picture. :mod:`.catalogue` lists all of them.
"""
