"""Lemmas and theorems of the paper, checked numerically."""

from __future__ import annotations

from scvi_codegen.reproduce.theorems import collocation, kronecker, order, rates

__all__ = ["EXPERIMENTS"]

EXPERIMENTS = (kronecker.EXPERIMENT, collocation.EXPERIMENT, order.EXPERIMENT, *rates.EXPERIMENTS)
"""Experiments in the paper's order."""
