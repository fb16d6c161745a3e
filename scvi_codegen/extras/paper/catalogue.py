"""Catalogue of all experiments by name, in the paper's order; ``claims``, which judges the others, is last."""

from scvi_codegen.extras.paper import correction, experiment, iterations, refinement, runs

ORDER = """
    figure-1 figure-3 figure-4 figure-5 figure-6 figure-7 figure-8
    figure-9 figure-10 figure-11 figure-12
    figure-13 figure-14 figure-15 figure-16 figure-17 figure-18 figure-19 figure-20 table-8 table-9
    figure-21 figure-22 figure-23 figure-24 figure-25 figure-26 figure-27 figure-28 figure-29 figure-30
    correction claims
"""
MODULES = (runs, refinement, iterations, correction, experiment)
_BY_NAME = {entry.name: entry for module in MODULES for entry in module.EXPERIMENTS}
EXPERIMENTS = {name: _BY_NAME[name] for name in ORDER.split()}
