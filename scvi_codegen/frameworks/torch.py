"""A flow for PyTorch: compiled C with derivatives forward and back, of second order, too, and of batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import imported
from scvi_codegen.frameworks.flow_of_arrays import ArrayFlow, Arrays
from scvi_codegen.frameworks.flow_of_rows import FlowOfRows
from scvi_codegen.given.kinds import of, takes
from scvi_codegen.runtime.stepper import Stepper

__all__ = ["TorchFlow", "torch_flow"]


@takes(StateError, stepper=of("a compiled stepper", Stepper))
def torch_flow(stepper: Stepper, *, steps: int, every: int | None = None) -> TorchFlow:
    """So many steps of a stepper as a differentiable function of PyTorch.

    It is compiled C, on processors and in binary64 (``dtype=torch.float64``): ``backward``, ``torch.func.grad``,
    ``vjp``, ``jvp``, ``jacrev``, ``jacfwd``, ``hessian`` and ``vmap`` apply. Derivatives are exact, those of the
    computed map; second ones, too, but for those forward of forward.

    Args:
        stepper: system and method.
        steps: how many.
        every: keep every so-many-th state and the initial one; by default that at the end alone.

    Raises:
        MethodError: in transformed time, and where a monitor chooses the steps.
        MissingLibraryError: without PyTorch (extra ``torch``).
        StateError: for steps that are no multiple of ``every``.
    """
    flow = TorchFlow.checked(stepper, steps, every)
    imported("torch", "torch")
    return flow


class TorchFlow(FlowOfRows, ArrayFlow):
    """The states of a motion, as a function that PyTorch differentiates."""

    @property
    def _arrays(self) -> Arrays:
        """See :attr:`ArrayFlow._arrays`."""
        return _Tensors()

    def _along(self, x: Any) -> Any:
        """See :meth:`ArrayFlow._along`."""
        from scvi_codegen.frameworks.torch_functions import StatesAlong

        return StatesAlong.apply(x, self)


class _Tensors:
    """Tensors of PyTorch."""

    def binary64(self, value: Any, name: str) -> Any:
        """See :meth:`Arrays.binary64`."""
        import torch

        tensor = torch.as_tensor(value, dtype=None if isinstance(value, torch.Tensor) else torch.float64)
        if tensor.device.type != "cpu":
            raise StateError(
                f"{name} is on the device {tensor.device}, but a flow is computed on processors: {name}.cpu()"
            )
        if tensor.is_floating_point() and tensor.dtype != torch.float64:
            raise StateError(f"{name} is {tensor.dtype}, but a flow is computed in binary64: give torch.float64")
        return tensor.to(torch.float64)

    def expanded(self, array: Any, shape: tuple[int, ...]) -> Any:
        """See :meth:`Arrays.expanded`."""
        return array.expand(shape)

    def joined(self, parts: Sequence[Any]) -> Any:
        """See :meth:`Arrays.joined`."""
        import torch

        return torch.cat(list(parts), dim=-1)
