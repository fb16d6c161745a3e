"""Every experiment by name, in the paper's order."""

from __future__ import annotations

from scvi_codegen.reproduce.experiment import Experiment

__all__ = ["EXPERIMENTS"]

EXPERIMENTS: dict[str, Experiment] = {}
"""By name, in the paper's order."""
