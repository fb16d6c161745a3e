"""The lemmas and theorems of the paper, measured."""

from __future__ import annotations

from scvi_codegen.reproduce.theorems import collocation, kronecker, order, rates

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (kronecker.EXPERIMENT, collocation.EXPERIMENT, order.EXPERIMENT, *rates.EXPERIMENTS)
"""In the paper's order."""
