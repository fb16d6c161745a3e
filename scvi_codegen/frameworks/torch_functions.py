"""PyTorch functions of the flow: four C functions, and their rules of differentiation and batching.

``StatesAlong`` computes the states; ``Push``, linear in its second argument, is the JVP, ``Pull`` the VJP, and
``Bend``, linear in cotangents and in tangents, the derivative of ``Pull`` with respect to the start (Hessian-vector
product). Tangents and cotangents have an axis of their own for those that share a trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from scvi_codegen.errors import MethodError
from scvi_codegen.frameworks.flow_of_rows import FlowOfRows
from scvi_codegen.native.options import step_failure

__all__ = ["StatesAlong"]

STATES, PUSH, PULL = range(3)
NO_MEMORY = 6


def _call(
    binding: Any, name: str, flow: FlowOfRows, counts: Sequence[int], x: Any, given: Sequence[Any], shape: Any
) -> Any:
    """Return the results of a C function for all rows of x."""
    found = torch.empty(shape, dtype=torch.float64)
    arrays = [each.detach().contiguous() for each in (x, *given)]
    report, rows = binding.new("report *"), x[..., 0].numel()
    part, count = counts[:-1], counts[-1]
    pointers = [binding.pointer(each.numpy()) for each in (*arrays, found)]
    if rows and found.numel():
        status = binding.function(name)(*part, flow.steps, flow.spacing, count, rows, *pointers, report)
        if status == NO_MEMORY:
            raise MemoryError("not enough memory for the states of a flow")
        if status:
            raise step_failure(status, report, step=int(report.steps), h=0.0)
    return found


def _summed(parts: Sequence[Any]) -> Any:
    return sum(parts[1:], parts[0]) if parts else None


class StatesAlong(torch.autograd.Function):  # type: ignore[misc]  # mypy does not see torch
    """States (.., n, 2m) from (.., k) numbers (q, p, parameters, t, h)."""

    @staticmethod
    def forward(x: Any, flow: FlowOfRows) -> Any:
        """Return the states."""
        shape = (*x.shape[:-1], flow.kept, 2 * flow.stepper.dimension)
        return _call(flow.library, "flow_rows", flow, (STATES, 0), x, (x,), shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Save the tensors that derivatives need."""
        x, ctx.flow = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def backward(ctx: Any, slopes: Any) -> Any:
        """Return the cotangent of x for a cotangent of the states."""
        (x,) = ctx.saved_tensors
        return Pull.apply(x, slopes.unsqueeze(-3), ctx.flow).squeeze(-2), None

    @staticmethod
    def jvp(ctx: Any, change: Any, _: Any) -> Any:
        """Return the tangent of the states for a tangent of x."""
        (x,) = ctx.saved_tensors
        return Push.apply(x, change.unsqueeze(-2), ctx.flow).squeeze(-3)

    @staticmethod
    def vmap(info: Any, axes: Any, x: Any, flow: FlowOfRows) -> Any:
        """Return the states of a batch."""
        return StatesAlong.apply(x.movedim(axes[0], 0), flow), 0


def _mapped(function: Callable[[], Any]) -> Any:
    """Return a batching rule: each element has its own trajectory, or all share one and are stacked."""

    def vmap(info: Any, axes: Any, x: Any, *rest: Any) -> Any:
        *given, flow = rest
        place = x.ndim - 1 if axes[0] is None else 0
        x = x if axes[0] is None else x.movedim(axes[0], 0)
        along = [
            each.unsqueeze(place).expand(*each.shape[:place], info.batch_size, *each.shape[place:])
            if axis is None
            else each.movedim(axis, place)
            for each, axis in zip(given, axes[1:], strict=False)
        ]
        if axes[0] is not None:
            return function().apply(x, *along, flow), 0
        beside = [each.flatten(place, place + 1) for each in along]
        found = function().apply(x, *beside, flow)
        return found.unflatten(place, along[0].shape[place : place + 2]), place

    return staticmethod(vmap)


class _Linear(torch.autograd.Function):  # type: ignore[misc]
    """Function of a trajectory that is linear in tangents or cotangents along it."""

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        *tensors, ctx.flow = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)


class Push(_Linear):
    """JVP: tangents (.., count, n, 2m) of the states from tangents (.., count, k) of x."""

    vmap = _mapped(lambda: Push)

    @staticmethod
    def forward(x: Any, changes: Any, flow: FlowOfRows) -> Any:
        shape = (*changes.shape[:-1], flow.kept, 2 * flow.stepper.dimension)
        return _call(flow.library, "flow_rows", flow, (PUSH, changes.shape[-2]), x, (changes,), shape)

    @staticmethod
    def backward(ctx: Any, slopes: Any) -> Any:
        x, changes = ctx.saved_tensors
        by_start = Bend.apply(x, slopes, changes, ctx.flow).sum(-2) if ctx.needs_input_grad[0] else None
        return by_start, Pull.apply(x, slopes, ctx.flow), None

    @staticmethod
    def jvp(ctx: Any, of_x: Any, of_changes: Any, _: Any) -> Any:
        if of_x is not None:
            raise MethodError(
                "a flow has no forward-over-forward second derivatives (jacfwd of jacfwd): use torch.func.hessian, or "
                "jacrev of either"
            )
        return Push.apply(ctx.saved_tensors[0], of_changes, ctx.flow)


class Pull(_Linear):
    """VJP: cotangents (.., count, k) of x from cotangents (.., count, n, 2m) of the states."""

    vmap = _mapped(lambda: Pull)

    @staticmethod
    def forward(x: Any, slopes: Any, flow: FlowOfRows) -> Any:
        shape = (*slopes.shape[:-2], x.shape[-1])
        return _call(flow.library, "flow_rows", flow, (PULL, slopes.shape[-3]), x, (slopes,), shape)

    @staticmethod
    def backward(ctx: Any, changes: Any) -> Any:
        x, slopes = ctx.saved_tensors
        by_start = Bend.apply(x, slopes, changes, ctx.flow).sum(-2) if ctx.needs_input_grad[0] else None
        return by_start, Push.apply(x, changes, ctx.flow) if ctx.needs_input_grad[1] else None, None

    @staticmethod
    def jvp(ctx: Any, of_x: Any, of_slopes: Any, _: Any) -> Any:
        (x, slopes), parts = ctx.saved_tensors, []
        if of_slopes is not None:
            parts.append(Pull.apply(x, of_slopes, ctx.flow))
        if of_x is not None:
            changes = of_x.unsqueeze(-2).expand(*slopes.shape[:-2], x.shape[-1])
            parts.append(Bend.apply(x, slopes, changes, ctx.flow))
        return _summed(parts)


class Bend(_Linear):
    """Derivative (.., count, k) of the VJP from cotangents of the states and tangents of x."""

    vmap = _mapped(lambda: Bend)

    @staticmethod
    def forward(x: Any, slopes: Any, changes: Any, flow: FlowOfRows) -> Any:
        given, count = (slopes, changes), changes.shape[-2]
        return _call(flow.second_library, "bend_rows", flow, (count,), x, given, changes.shape)

    @staticmethod
    def backward(ctx: Any, back: Any) -> Any:
        """Return the transpose with respect to tangents: itself, as second derivatives are symmetric."""
        x, slopes, _ = ctx.saved_tensors
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[1]:
            raise MethodError("a flow has no third derivatives and no forward-over-forward second derivatives")
        return None, None, Bend.apply(x, slopes, back, ctx.flow), None

    @staticmethod
    def jvp(ctx: Any, of_x: Any, of_slopes: Any, of_changes: Any, _: Any) -> Any:
        (x, slopes, changes), parts = ctx.saved_tensors, []
        if of_x is not None:
            raise MethodError("a flow has no third derivatives")
        if of_slopes is not None:
            parts.append(Bend.apply(x, of_slopes, changes, ctx.flow))
        if of_changes is not None:
            parts.append(Bend.apply(x, slopes, of_changes, ctx.flow))
        return _summed(parts)
