"""The chain-rule term that the printed SCVI lacks: derived, measured, drawn."""

from __future__ import annotations

from scvi_codegen.reproduce.correction.experiment import EXPERIMENTS

__all__ = ["EXPERIMENTS"]
