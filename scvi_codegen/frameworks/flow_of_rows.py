"""Flow map of many rows of numbers in compiled C, for frameworks that call it with arrays."""

from __future__ import annotations

from functools import cached_property

from scvi_codegen.frameworks.flow import Flow
from scvi_codegen.native import building
from scvi_codegen.native.binding import Binding
from scvi_codegen.rendering.flow import with_flow_of_rows

__all__ = ["FlowOfRows"]


class FlowOfRows(Flow):
    """Flow with its compiled C functions."""

    @cached_property
    def library(self) -> Binding:
        """Values and derivatives, compiled on first use."""
        source = with_flow_of_rows(self.derivatives)
        return Binding(building.load(source, flags=self.stepper.flags), source.prefix)

    @cached_property
    def second_library(self) -> Binding:
        """Values and derivatives up to second order, compiled on first use."""
        source = with_flow_of_rows(self.second_derivatives, second=True)
        return Binding(building.load(source, flags=self.stepper.flags), source.prefix)
