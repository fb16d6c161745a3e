"""A generated integrator: ``stepper`` steps and integrates it; README.md says how. Yours to use as you like."""

from pathlib import Path

from scvi_codegen.package import load_package

__all__ = ["stepper"]

stepper = load_package(Path(__file__).parent)
