"""The flow of JAX: three primitives that XLA calls in C, and the rules by which JAX transforms them.

``states`` has the values; ``push``, linear in its second argument, is the derivative applied to changes, and ``pull``
its transpose applied to slopes. Changes and slopes have an axis of their own, of those that share a trajectory: the
steps are then linearised once for all of them, so that a Jacobian costs far less than its columns one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from scvi_codegen.errors import MethodError

__all__ = ["states_along"]

STATIC = ("target", "steps", "every", "size")


def states_along(x: Any, *, target: str, steps: int, every: int, size: int) -> Any:
    """(.., n, size) states from (.., given) numbers (q, p, parameters, t, h) through so many steps.

    Args:
        x: where they start.
        target: the C functions are registered under this name with ``_states``, ``_push`` and ``_pull`` behind it.
        steps, every: how many, and how many between kept states.
        size: 2m.
    """
    return STATES.bind(x, target=target, steps=steps, every=every, size=size)


def _primitive(part: str, shape: Callable[..., tuple[int, ...]], batched: Callable[..., Any]) -> Primitive:
    """One that XLA calls in C on processors; ``shape`` is that of its result."""
    primitive = Primitive(f"scvi_flow_{part}")

    def called(*arguments: Any, target: str, steps: int, every: int, size: int) -> Any:
        result = jax.ShapeDtypeStruct(shape(*(a.shape for a in arguments), steps // every + 1, size), jnp.float64)
        return jax.ffi.ffi_call(f"{target}_{part}", result)(*arguments, steps=steps, every=every)

    def described(*arguments: Any, target: str, steps: int, every: int, size: int) -> Any:
        return ShapedArray(shape(*(a.shape for a in arguments), steps // every + 1, size), jnp.float64)

    primitive.def_impl(jax.jit(called, static_argnames=STATIC))
    primitive.def_abstract_eval(described)
    mlir.register_lowering(primitive, mlir.lower_fun(called, multiple_results=False), platform="cpu")
    batching.primitive_batchers[primitive] = batched
    return primitive


def _states_batched(arguments: Sequence[Any], axes: Sequence[int], **static: Any) -> tuple[Any, int]:
    return STATES.bind(jnp.moveaxis(arguments[0], axes[0], 0), **static), 0


def _linear_batched(primitive: Callable[[], Primitive]) -> Callable[..., tuple[Any, int]]:
    """Each with a trajectory of its own, or all that share one beside each other."""

    def batched(arguments: Sequence[Any], axes: Sequence[Any], **static: Any) -> tuple[Any, int]:
        (x, given), (of_x, of_given) = arguments, axes
        if of_x is not None:
            x = jnp.moveaxis(x, of_x, 0)
            shape = (len(x), *given.shape)
            own = jnp.broadcast_to(given, shape) if of_given is None else jnp.moveaxis(given, of_given, 0)
            return primitive().bind(x, own, **static), 0
        at = x.ndim - 1
        given = jnp.moveaxis(given, of_given, at)
        beside = given.reshape(*given.shape[:at], -1, *given.shape[at + 2 :])
        found = primitive().bind(x, beside, **static)
        return found.reshape(*given.shape[: at + 2], *found.shape[at + 1 :]), at

    return batched


STATES: Primitive = _primitive("states", lambda x, n, size: (*x[:-1], n, size), _states_batched)
PUSH: Primitive = _primitive("push", lambda _, v, n, size: (*v[:-1], n, size), _linear_batched(lambda: PUSH))
PULL: Primitive = _primitive("pull", lambda x, w, *_: (*w[:-2], x[-1]), _linear_batched(lambda: PULL))


def _states_pushed(given: Sequence[Any], changes: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    found = STATES.bind(*given, **static)
    if type(changes[0]) is ad.Zero:
        return found, ad.Zero.from_primal_value(found)
    pushed = PUSH.bind(given[0], jnp.expand_dims(changes[0], -2), **static)
    return found, jnp.squeeze(pushed, -3)


def _linear_pushed(primitive: Primitive) -> Callable[..., tuple[Any, Any]]:
    def pushed(given: Sequence[Any], changes: Sequence[Any], **static: Any) -> tuple[Any, Any]:
        if type(changes[0]) is not ad.Zero:
            raise MethodError(
                "a flow has no second derivatives, as jax.hessian asks for: take methods that need first ones alone, "
                "such as BFGS, or Gauss-Newton with jax.jacfwd"
            )
        return primitive.bind(*given, **static), primitive.bind(given[0], changes[1], **static)

    return pushed


def _transposed(other: Primitive) -> Callable[..., tuple[None, Any]]:
    def transpose(slopes: Any, x: Any, given: Any, **static: Any) -> tuple[None, Any]:
        if type(slopes) is ad.Zero:
            return None, ad.Zero(given.aval)
        return None, other.bind(x, slopes, **static)

    return transpose


ad.primitive_jvps[STATES] = _states_pushed
ad.primitive_jvps[PUSH], ad.primitive_jvps[PULL] = _linear_pushed(PUSH), _linear_pushed(PULL)
ad.primitive_transposes[PUSH], ad.primitive_transposes[PULL] = _transposed(PULL), _transposed(PUSH)
