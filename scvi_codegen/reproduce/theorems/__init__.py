"""The theorems of the paper, measured."""

from __future__ import annotations

from scvi_codegen.reproduce.theorems import collocation as collocation_theorem
from scvi_codegen.reproduce.theorems import order as order_theorem
from scvi_codegen.reproduce.theorems import rates as rate_theorems

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (collocation_theorem.EXPERIMENT, order_theorem.EXPERIMENT, *rate_theorems.EXPERIMENTS)
"""In the paper's order."""
