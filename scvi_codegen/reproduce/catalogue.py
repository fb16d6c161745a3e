"""Catalogue of all experiments by name, in the paper's order."""

from __future__ import annotations

from scvi_codegen.reproduce import claims, correction
from scvi_codegen.reproduce.kepler import (
    figures_13_to_20,
    figures_23_to_30,
    many_points,
    overview,
)
from scvi_codegen.reproduce.laboratory.experiment import REGISTERED, Experiment
from scvi_codegen.reproduce.oscillators import oscillator, pendulum_and_duffing
from scvi_codegen.reproduce.paper_tables import costs, iterations, tableaux
from scvi_codegen.reproduce.refinement import kepler as kepler_refinement
from scvi_codegen.reproduce.refinement import oscillator as oscillator_refinement

ORDER = """
    table-1 table-2 table-3 figure-1 figure-3 figure-4 figure-5 figure-6 figure-7 figure-8
    figure-9 figure-10 table-6 figure-11 figure-12 table-7
    figure-13 figure-14 figure-15 figure-16 figure-17 figure-18 figure-19 figure-20 table-8 table-9
    figure-21 figure-22 figure-23 figure-24 figure-25 figure-26 figure-27 figure-28 figure-29 figure-30
    correction claims
"""
MODULES = (
    *(overview, oscillator, oscillator_refinement, kepler_refinement, pendulum_and_duffing, figures_13_to_20),
    *(figures_23_to_30, many_points, correction, tableaux, costs, iterations, claims),
)
"""Modules whose import registers the experiments."""


def _catalogue() -> dict[str, Experiment]:
    names = ORDER.split()
    if set(names) != set(REGISTERED):
        raise AssertionError(f"the order of the catalogue is wrong about {set(names) ^ set(REGISTERED)}")
    return {name: REGISTERED[name] for name in names}


EXPERIMENTS = _catalogue()
"""Experiments by name, in the paper's order; ``claims``, which judges the others, is last."""
