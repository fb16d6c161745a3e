"""PyTorch functions of the flow: four C functions, and their rules of differentiation and batching.

``StatesAlong`` computes the states; ``Jvp``, linear in its second argument, is the JVP, ``Vjp`` the VJP, and
``VjpDerivative``, linear in cotangents and in tangents, the derivative of ``Vjp`` by the start (Hessian-vector
product). Tangents and cotangents have an axis of their own for those that share a trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from scvi_codegen.common.errors import MethodError
from scvi_codegen.extras.frameworks.flow import FlowOfRows

STATES, PUSH, PULL = range(3)
NO_MEMORY = 6


def _call(
    binding: Any, name: str, flow: FlowOfRows, counts: Sequence[int], x: Any, arguments: Sequence[Any], shape: Any
) -> Any:
    result = torch.empty(shape, dtype=torch.float64)
    arrays = [tensor.detach().contiguous() for tensor in (x, *arguments)]
    report, rows = binding.new("report *"), x[..., 0].numel()
    part, count = counts[:-1], counts[-1]
    pointers = [binding.pointer(tensor.numpy()) for tensor in (*arrays, result)]
    if rows and result.numel():
        status = binding.function(name)(*part, flow.steps, flow.spacing, count, rows, *pointers, report)
        if status == NO_MEMORY:
            raise MemoryError("not enough memory for the states of a flow")
        if status:
            raise binding.failure(status, report, step=int(report.steps), h=0.0)
    return result


def _summed(parts: Sequence[Any]) -> Any:
    return sum(parts[1:], parts[0]) if parts else None


class StatesAlong(torch.autograd.Function):  # type: ignore[misc]  # mypy does not see torch
    """States (.., n, 2m) from (.., k) numbers (q, p, parameters, t, h)."""

    @staticmethod
    def forward(x: Any, flow: FlowOfRows) -> Any:
        """Return the states."""
        shape = (*x.shape[:-1], flow.saved_states, 2 * flow.stepper.dimension)
        return _call(flow.library, "flow_rows", flow, (STATES, 0), x, (x,), shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Save the tensors that derivatives need."""
        x, ctx.flow = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def backward(ctx: Any, cotangents: Any) -> Any:
        """Return the cotangent of x for a cotangent of the states."""
        (x,) = ctx.saved_tensors
        return Vjp.apply(x, cotangents.unsqueeze(-3), ctx.flow).squeeze(-2), None

    @staticmethod
    def jvp(ctx: Any, change: Any, _: Any) -> Any:
        """Return the tangent of the states for a tangent of x."""
        (x,) = ctx.saved_tensors
        return Jvp.apply(x, change.unsqueeze(-2), ctx.flow).squeeze(-3)

    @staticmethod
    def vmap(info: Any, axes: Any, x: Any, flow: FlowOfRows) -> Any:
        """Return the states of a batch."""
        return StatesAlong.apply(x.movedim(axes[0], 0), flow), 0


def _mapped(function: Callable[[], Any]) -> Any:
    """Return a batching rule: each element has its own trajectory, or all share one and are stacked."""

    def vmap(info: Any, axes: Any, x: Any, *rest: Any) -> Any:
        *arguments, flow = rest
        axis_index = x.ndim - 1 if axes[0] is None else 0
        x = x if axes[0] is None else x.movedim(axes[0], 0)
        along = []
        for tensor, axis in zip(arguments, axes[1:], strict=False):
            if axis is None:
                shape = (*tensor.shape[:axis_index], info.batch_size, *tensor.shape[axis_index:])
                along.append(tensor.unsqueeze(axis_index).expand(shape))
            else:
                along.append(tensor.movedim(axis, axis_index))
        if axes[0] is not None:
            return function().apply(x, *along, flow), 0
        stacked = [tensor.flatten(axis_index, axis_index + 1) for tensor in along]
        result = function().apply(x, *stacked, flow)
        return result.unflatten(axis_index, along[0].shape[axis_index : axis_index + 2]), axis_index

    return staticmethod(vmap)


class _Linear(torch.autograd.Function):  # type: ignore[misc]
    """Function of a trajectory that is linear in tangents or cotangents along it."""

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        *tensors, ctx.flow = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)


class Jvp(_Linear):
    """JVP: tangents (.., count, n, 2m) of the states from tangents (.., count, k) of x."""

    vmap = _mapped(lambda: Jvp)

    @staticmethod
    def forward(x: Any, tangents: Any, flow: FlowOfRows) -> Any:
        shape = (*tangents.shape[:-1], flow.saved_states, 2 * flow.stepper.dimension)
        return _call(flow.library, "flow_rows", flow, (PUSH, tangents.shape[-2]), x, (tangents,), shape)

    @staticmethod
    def backward(ctx: Any, cotangents: Any) -> Any:
        x, tangents = ctx.saved_tensors
        by_start = VjpDerivative.apply(x, cotangents, tangents, ctx.flow).sum(-2) if ctx.needs_input_grad[0] else None
        return by_start, Vjp.apply(x, cotangents, ctx.flow), None

    @staticmethod
    def jvp(ctx: Any, of_x: Any, of_tangents: Any, _: Any) -> Any:
        if of_x is not None:
            raise MethodError(
                "a flow has no forward-over-forward second derivatives (jacfwd of jacfwd): use torch.func.hessian, or "
                "jacrev of either"
            )
        return Jvp.apply(ctx.saved_tensors[0], of_tangents, ctx.flow)


class Vjp(_Linear):
    """VJP: cotangents (.., count, k) of x from cotangents (.., count, n, 2m) of the states."""

    vmap = _mapped(lambda: Vjp)

    @staticmethod
    def forward(x: Any, cotangents: Any, flow: FlowOfRows) -> Any:
        shape = (*cotangents.shape[:-2], x.shape[-1])
        return _call(flow.library, "flow_rows", flow, (PULL, cotangents.shape[-3]), x, (cotangents,), shape)

    @staticmethod
    def backward(ctx: Any, tangents: Any) -> Any:
        x, cotangents = ctx.saved_tensors
        by_start = VjpDerivative.apply(x, cotangents, tangents, ctx.flow).sum(-2) if ctx.needs_input_grad[0] else None
        return by_start, Jvp.apply(x, tangents, ctx.flow) if ctx.needs_input_grad[1] else None, None

    @staticmethod
    def jvp(ctx: Any, of_x: Any, of_cotangents: Any, _: Any) -> Any:
        (x, cotangents), parts = ctx.saved_tensors, []
        if of_cotangents is not None:
            parts.append(Vjp.apply(x, of_cotangents, ctx.flow))
        if of_x is not None:
            tangents = of_x.unsqueeze(-2).expand(*cotangents.shape[:-2], x.shape[-1])
            parts.append(VjpDerivative.apply(x, cotangents, tangents, ctx.flow))
        return _summed(parts)


class VjpDerivative(_Linear):
    """Derivative (.., count, k) of the VJP from cotangents of the states and tangents of x."""

    vmap = _mapped(lambda: VjpDerivative)

    @staticmethod
    def forward(x: Any, cotangents: Any, tangents: Any, flow: FlowOfRows) -> Any:
        arguments, count = (cotangents, tangents), tangents.shape[-2]
        return _call(flow.second_library, "hessian_rows", flow, (count,), x, arguments, tangents.shape)

    @staticmethod
    def backward(ctx: Any, back: Any) -> Any:
        """Return the transpose with respect to tangents: itself, as second derivatives are symmetric."""
        x, cotangents, _ = ctx.saved_tensors
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[1]:
            raise MethodError("a flow has no third derivatives and no forward-over-forward second derivatives")
        return None, None, VjpDerivative.apply(x, cotangents, back, ctx.flow), None

    @staticmethod
    def jvp(ctx: Any, of_x: Any, of_cotangents: Any, of_tangents: Any, _: Any) -> Any:
        (x, cotangents, tangents), parts = ctx.saved_tensors, []
        if of_x is not None:
            raise MethodError("a flow has no third derivatives")
        if of_cotangents is not None:
            parts.append(VjpDerivative.apply(x, of_cotangents, tangents, ctx.flow))
        if of_tangents is not None:
            parts.append(VjpDerivative.apply(x, cotangents, of_tangents, ctx.flow))
        return _summed(parts)
