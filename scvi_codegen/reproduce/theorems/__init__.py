"""The theorems of the paper, measured."""

from __future__ import annotations

from scvi_codegen.reproduce.theorems import collocation, order, rates

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (collocation.EXPERIMENT, order.EXPERIMENT, *rates.EXPERIMENTS)
"""In the paper's order."""
