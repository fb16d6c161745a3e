"""The chain-rule term missing from the printed SCVI: derivation, measurement, figure."""

from __future__ import annotations

from scvi_codegen.reproduce.correction import experiment

__all__ = ["experiment"]
