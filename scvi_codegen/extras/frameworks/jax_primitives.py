"""JAX primitives of the flow: four C functions that XLA calls, and their transformation rules.

``states`` computes the states; ``jvp``, linear in its second argument, is the JVP, and ``vjp`` the VJP;
``vjp_derivative``, linear in cotangents and in tangents, is the derivative of ``vjp`` with respect to the start
(Hessian-vector product). Tangents and cotangents have an axis of their own for those that share a trajectory: the steps
are linearised once for all of them, so that a Jacobian costs far less than its columns one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from scvi_codegen.common.errors import MethodError

STATIC = ("target", "steps", "save_every", "size")
SECOND: dict[str, Callable[[], str]] = {}
"""Functions that return the target with second derivatives, by name of the target."""


def _primitive(part: str, shape: Callable[..., tuple[int, ...]], batched: Callable[..., Any]) -> Primitive:
    """Return a primitive that XLA calls in C on CPUs; ``shape`` is that of its result."""
    primitive = Primitive(f"scvi_flow_{part}")

    def called(*arguments: Any, target: str, steps: int, save_every: int, size: int) -> Any:
        result = jax.ShapeDtypeStruct(shape(*(a.shape for a in arguments), steps // save_every + 1, size), jnp.float64)
        return jax.ffi.ffi_call(f"{target}_{part}", result)(*arguments, steps=steps, save_every=save_every)

    def described(*arguments: Any, target: str, steps: int, save_every: int, size: int) -> Any:
        return ShapedArray(shape(*(a.shape for a in arguments), steps // save_every + 1, size), jnp.float64)

    primitive.def_impl(jax.jit(called, static_argnames=STATIC))
    primitive.def_abstract_eval(described)
    mlir.register_lowering(primitive, mlir.lower_fun(called, multiple_results=False), platform="cpu")
    batching.primitive_batchers[primitive] = batched
    return primitive


def _states_batched(arguments: Sequence[Any], axes: Sequence[int], **static: Any) -> tuple[Any, int]:
    return STATES.bind(jnp.moveaxis(arguments[0], axes[0], 0), **static), 0


def _linear_batched(primitive: Callable[[], Primitive]) -> Callable[..., tuple[Any, int]]:
    """Return a batching rule: each element has its own trajectory, or all share one and are stacked."""

    def batched(arguments: Sequence[Any], axes: Sequence[Any], **static: Any) -> tuple[Any, int]:
        count = next(array.shape[axis] for array, axis in zip(arguments, axes, strict=True) if axis is not None)
        axis_index = arguments[0].ndim - 1 if axes[0] is None else 0
        x = arguments[0] if axes[0] is None else jnp.moveaxis(arguments[0], axes[0], 0)
        aligned = [
            _repeated(array, count, axis_index) if axis is None else jnp.moveaxis(array, axis, axis_index)
            for array, axis in zip(arguments[1:], axes[1:], strict=True)
        ]
        if axes[0] is not None:
            return primitive().bind(x, *aligned, **static), 0
        stacked = [array.reshape(*array.shape[:axis_index], -1, *array.shape[axis_index + 2 :]) for array in aligned]
        result = primitive().bind(x, *stacked, **static)
        return result.reshape(*aligned[0].shape[: axis_index + 2], *result.shape[axis_index + 1 :]), axis_index

    return batched


def _repeated(array: Any, count: int, axis_index: int) -> Any:
    return jnp.broadcast_to(
        jnp.expand_dims(array, axis_index), (*array.shape[:axis_index], count, *array.shape[axis_index:])
    )


STATES: Primitive = _primitive("states", lambda x, n, size: (*x[:-1], n, size), _states_batched)
"""(.., n, size) states of ``steps`` steps from (.., k) numbers (q, p, parameters, t, h), size = 2m; ``target``: name
under which the C functions are registered, with the suffixes ``_states``, ``_push`` and ``_pull``."""
JVP: Primitive = _primitive("jvp", lambda _, v, n, size: (*v[:-1], n, size), _linear_batched(lambda: JVP))
VJP: Primitive = _primitive("vjp", lambda x, w, *_: (*w[:-2], x[-1]), _linear_batched(lambda: VJP))
VJP_DERIVATIVE: Primitive = _primitive("vjp_derivative", lambda x, w, v, *_: v, _linear_batched(lambda: VJP_DERIVATIVE))


def _states_jvp(primals: Sequence[Any], tangents: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    states = STATES.bind(*primals, **static)
    if type(tangents[0]) is ad.Zero:
        return states, ad.Zero.from_primal_value(states)
    pushed = JVP.bind(primals[0], jnp.expand_dims(tangents[0], -2), **static)
    return states, jnp.squeeze(pushed, -3)


def _jvp_jvp(primals: Sequence[Any], tangents: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    if type(tangents[0]) is not ad.Zero:
        raise MethodError(
            "a flow has no forward-over-forward second derivatives (jacfwd of jacfwd, jacrev of jacfwd) and no third "
            "derivatives: use jax.hessian, or jacfwd or jacrev of jacrev"
        )
    return JVP.bind(*primals, **static), JVP.bind(primals[0], tangents[1], **static)


def _vjp_jvp(primals: Sequence[Any], tangents: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    (x, cotangents), (of_x, of_cotangents), parts = primals, tangents, []
    if type(of_cotangents) is not ad.Zero:
        parts.append(VJP.bind(x, of_cotangents, **static))
    if type(of_x) is not ad.Zero:
        second = static | {"target": SECOND[static["target"]]()}
        parts.append(
            VJP_DERIVATIVE.bind(x, cotangents, _repeated(of_x, cotangents.shape[x.ndim - 1], x.ndim - 1), **second)
        )
    return VJP.bind(x, cotangents, **static), sum(parts[1:], parts[0])


def _vjp_derivative_jvp(primals: Sequence[Any], tangents: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    if type(tangents[0]) is not ad.Zero:
        raise MethodError("a flow has no third derivatives")
    (x, cotangents, moved), (_, of_cotangents, of_moved), parts = primals, tangents, []
    if type(of_cotangents) is not ad.Zero:
        parts.append(VJP_DERIVATIVE.bind(x, of_cotangents, moved, **static))
    if type(of_moved) is not ad.Zero:
        parts.append(VJP_DERIVATIVE.bind(x, cotangents, of_moved, **static))
    return VJP_DERIVATIVE.bind(*primals, **static), sum(parts[1:], parts[0])


def _transposed(other: Primitive) -> Callable[..., tuple[None, Any]]:
    def transpose(cotangents: Any, x: Any, tangent: Any, **static: Any) -> tuple[None, Any]:
        if type(cotangents) is ad.Zero:
            return None, ad.Zero(tangent.aval)
        return None, other.bind(x, cotangents, **static)

    return transpose


def _vjp_derivative_transposed(
    cotangents: Any, x: Any, primal_cotangents: Any, moved: Any, **static: Any
) -> tuple[Any, ...]:
    """Return the transpose with respect to tangents: itself, as second derivatives are symmetric."""
    if ad.is_undefined_primal(primal_cotangents):
        raise MethodError("a flow has no forward-over-forward second derivatives: use jacfwd or jacrev of jacrev")
    if type(cotangents) is ad.Zero:
        return None, None, ad.Zero(moved.aval)
    return None, None, VJP_DERIVATIVE.bind(x, primal_cotangents, cotangents, **static)


ad.primitive_jvps[STATES] = _states_jvp
ad.primitive_jvps[JVP] = _jvp_jvp
ad.primitive_jvps[VJP] = _vjp_jvp
ad.primitive_jvps[VJP_DERIVATIVE] = _vjp_derivative_jvp
ad.primitive_transposes[VJP_DERIVATIVE] = _vjp_derivative_transposed
ad.primitive_transposes[JVP], ad.primitive_transposes[VJP] = _transposed(VJP), _transposed(JVP)
