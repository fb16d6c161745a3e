"""The theorems of the paper, measured."""

from __future__ import annotations

from scvi_codegen.reproduce import collocation_theorem, order_theorem, rate_theorems

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (collocation_theorem.EXPERIMENT, order_theorem.EXPERIMENT, *rate_theorems.EXPERIMENTS)
"""In the paper's order."""
