"""A flow for PyTorch: compiled C with derivatives forward and back, of second order, too, and of batches."""

from __future__ import annotations

from typing import Any

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import imported
from scvi_codegen.frameworks.flow_of_rows import FlowOfRows
from scvi_codegen.kinds import of, takes
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


class TorchFlow(FlowOfRows):
    """The states of a motion, as a function that PyTorch differentiates."""

    def __call__(self, q: Any, p: Any, *, h: Any, t: Any = 0.0, parameters: Any = None) -> tuple[Any, Any]:
        """States at the end, or where every so-many-th is kept, at these; as of :meth:`JaxFlow.__call__`.

        Args:
            q, p: (.., m) initial positions and momenta. Leading axes are broadcast against each other.
            h: (..) step.
            t: (..) initial time.
            parameters: by name, (..) each, others keeping their defaults; or (.., k) in order.

        Returns:
            (q, p), (.., m) each; with ``every`` (.., n, m).

        Raises:
            StateError: for wrong shapes and names, and for anything but binary64.
            StepFailedError: if a step fails.
        """
        import torch

        from scvi_codegen.frameworks.torch_functions import StatesAlong

        m, count = self.stepper.dimension, len(self.stepper.parameters)
        values = self.parameter_values(parameters)
        if isinstance(values, list):
            each = torch.broadcast_tensors(*(_binary64(value, "a parameter") for value in values)) if values else []
            values = torch.stack(each, -1) if values else torch.zeros(0, dtype=torch.float64)
        vectors = [_vector(q, m, "q"), _vector(p, m, "p"), _vector(values, count, "parameters")]
        numbers = [_binary64(t, "t").unsqueeze(-1), _binary64(h, "h").unsqueeze(-1)]
        found = StatesAlong.apply(_beside(*vectors, *numbers), self)
        found = found if self.every else found[..., -1, :]
        return found[..., :m], found[..., m:]


def _binary64(value: Any, name: str) -> Any:
    """A tensor; StateError for numbers of fewer digits, to which a flow would be rounded without a word."""
    import torch

    tensor = torch.as_tensor(value, dtype=None if isinstance(value, torch.Tensor) else torch.float64)
    if tensor.device.type != "cpu":
        raise StateError(f"{name} is on the device {tensor.device}, but a flow is computed on processors: {name}.cpu()")
    if tensor.is_floating_point() and tensor.dtype != torch.float64:
        raise StateError(f"{name} is {tensor.dtype}, but a flow is computed in binary64: give torch.float64")
    return tensor.to(torch.float64)


def _vector(value: Any, length: int, name: str) -> Any:
    tensor = _binary64(value, name)
    if tensor.shape[-1:] != (length,):
        raise StateError(f"{name} must have shape (.., {length}), not {tuple(tensor.shape)}")
    return tensor


def _beside(*parts: Any) -> Any:
    """(.., n) tensors, one behind the other."""
    import torch

    try:
        batch = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    except RuntimeError as error:
        raise StateError(f"the leading axes of q, p, parameters, t and h do not fit: {error}") from error
    return torch.cat([part.expand(*batch, part.shape[-1]) for part in parts], dim=-1)
