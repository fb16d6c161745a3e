"""Predictive controller, the default of adaptive steps: errors are expected to continue their growth."""

from scvi_codegen.methods.controllers.controller import Controller

__all__ = ["PREDICTIVE"]

PREDICTIVE = Controller(
    summary="adaptive steps (default)", code='#include "support/step_size/predictive_controller.h"\n'
)
"""Source: K. Gustafsson, ACM Trans. Math. Softw. 20 (1994) 496."""
