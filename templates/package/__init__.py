"""Generated integrator: ``stepper`` performs steps and runs; see README.md. Yours to use as you like."""

from pathlib import Path

from scvi_codegen import load_package

__all__ = ["stepper"]

stepper = load_package(Path(__file__).parent)
