"""Flow map for PyTorch: compiled C with JVP, VJP, second derivatives and batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.common.errors import StateError, imported
from scvi_codegen.extras.frameworks.flow import ArrayFlow, FlowOfRows
from scvi_codegen.runs.stepper import Stepper


@checks_arguments(StateError, stepper=Kind.of("a compiled stepper", Stepper))
def torch_flow(stepper: Stepper, *, steps: int, save_every: int | None = None) -> TorchFlow:
    """Return a fixed number of steps of a stepper as a differentiable function of PyTorch.

    It is compiled C, on CPUs and in binary64 (``dtype=torch.float64``): ``backward``, ``torch.func.grad``, ``vjp``,
    ``jvp``, ``jacrev``, ``jacfwd``, ``hessian`` and ``vmap`` apply. Derivatives are those of the computed map, exact up
    to round-off, including second derivatives except forward over forward.

    Arguments and errors are those of :func:`~scvi_codegen.jax_flow`; PyTorch is the extra ``torch``.
    """
    flow = TorchFlow.checked(stepper, steps, save_every)
    imported("torch", "torch")
    return flow


class TorchFlow(FlowOfRows, ArrayFlow):
    """States of a trajectory as a function that PyTorch differentiates."""

    def _along(self, x: Any) -> Any:
        from scvi_codegen.extras.frameworks.torch_functions import StatesAlong

        return StatesAlong.apply(x, self)

    def _binary64(self, value: Any, name: str) -> Any:
        import torch

        tensor = torch.as_tensor(value, dtype=None if isinstance(value, torch.Tensor) else torch.float64)
        if tensor.device.type != "cpu":
            raise StateError(f"{name} is on the device {tensor.device}, but a flow runs on the CPU: pass {name}.cpu()")
        if tensor.is_floating_point() and tensor.dtype != torch.float64:
            raise StateError(f"{name} is {tensor.dtype}, but a flow is computed in binary64: give torch.float64")
        return tensor.to(torch.float64)

    def _joined(self, parts: Sequence[Any], batch: tuple[int, ...]) -> Any:
        import torch

        return torch.cat([part.expand((*batch, part.shape[-1])) for part in parts], dim=-1)
