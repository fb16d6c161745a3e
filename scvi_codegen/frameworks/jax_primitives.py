"""JAX primitives of the flow: four C functions that XLA calls, and their transformation rules.

``states`` computes the states; ``push``, linear in its second argument, is the JVP, and ``pull`` the VJP; ``bend``,
linear in cotangents and in tangents, is the derivative of ``pull`` with respect to the start (Hessian-vector product).
Tangents and cotangents have an axis of their own for those that share a trajectory: the steps are linearised once for
all of them, so that a Jacobian costs far less than its columns one by one.
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

STATIC = ("target", "steps", "save_every", "size")
SECOND: dict[str, Callable[[], str]] = {}
"""Functions that return the target with second derivatives, by name of the target."""


def states_along(x: Any, *, target: str, steps: int, save_every: int, size: int) -> Any:
    """Return (.., n, size) states of ``steps`` steps from (.., k) numbers (q, p, parameters, t, h).

    Args:
        x: initial values.
        target: name under which the C functions are registered, with the suffixes ``_states``, ``_push`` and ``_pull``.
        steps, save_every: number of steps, and of steps between saved states.
        size: 2m.
    """
    return STATES.bind(x, target=target, steps=steps, save_every=save_every, size=size)


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
        count = next(each.shape[axis] for each, axis in zip(arguments, axes, strict=True) if axis is not None)
        place = arguments[0].ndim - 1 if axes[0] is None else 0
        x = arguments[0] if axes[0] is None else jnp.moveaxis(arguments[0], axes[0], 0)
        given = [
            _repeated(each, count, place) if axis is None else jnp.moveaxis(each, axis, place)
            for each, axis in zip(arguments[1:], axes[1:], strict=True)
        ]
        if axes[0] is not None:
            return primitive().bind(x, *given, **static), 0
        beside = [each.reshape(*each.shape[:place], -1, *each.shape[place + 2 :]) for each in given]
        found = primitive().bind(x, *beside, **static)
        return found.reshape(*given[0].shape[: place + 2], *found.shape[place + 1 :]), place

    return batched


def _repeated(given: Any, count: int, place: int) -> Any:
    """Return the array repeated along a new axis of length ``count``."""
    return jnp.broadcast_to(jnp.expand_dims(given, place), (*given.shape[:place], count, *given.shape[place:]))


STATES: Primitive = _primitive("states", lambda x, n, size: (*x[:-1], n, size), _states_batched)
PUSH: Primitive = _primitive("push", lambda _, v, n, size: (*v[:-1], n, size), _linear_batched(lambda: PUSH))
PULL: Primitive = _primitive("pull", lambda x, w, *_: (*w[:-2], x[-1]), _linear_batched(lambda: PULL))
BEND: Primitive = _primitive("bend", lambda x, w, v, *_: v, _linear_batched(lambda: BEND))


def _states_pushed(given: Sequence[Any], changes: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    found = STATES.bind(*given, **static)
    if type(changes[0]) is ad.Zero:
        return found, ad.Zero.from_primal_value(found)
    pushed = PUSH.bind(given[0], jnp.expand_dims(changes[0], -2), **static)
    return found, jnp.squeeze(pushed, -3)


def _push_pushed(given: Sequence[Any], changes: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    if type(changes[0]) is not ad.Zero:
        raise MethodError(
            "a flow has no forward-over-forward second derivatives (jacfwd of jacfwd, jacrev of jacfwd) and no third "
            "derivatives: use jax.hessian, or jacfwd or jacrev of jacrev"
        )
    return PUSH.bind(*given, **static), PUSH.bind(given[0], changes[1], **static)


def _pull_pushed(given: Sequence[Any], changes: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    (x, slopes), (of_x, of_slopes), parts = given, changes, []
    if type(of_slopes) is not ad.Zero:
        parts.append(PULL.bind(x, of_slopes, **static))
    if type(of_x) is not ad.Zero:
        second = static | {"target": SECOND[static["target"]]()}
        parts.append(BEND.bind(x, slopes, _repeated(of_x, slopes.shape[x.ndim - 1], x.ndim - 1), **second))
    return PULL.bind(x, slopes, **static), sum(parts[1:], parts[0])


def _bend_pushed(given: Sequence[Any], changes: Sequence[Any], **static: Any) -> tuple[Any, Any]:
    if type(changes[0]) is not ad.Zero:
        raise MethodError("a flow has no third derivatives")
    (x, slopes, moved), (_, of_slopes, of_moved), found = given, changes, []
    if type(of_slopes) is not ad.Zero:
        found.append(BEND.bind(x, of_slopes, moved, **static))
    if type(of_moved) is not ad.Zero:
        found.append(BEND.bind(x, slopes, of_moved, **static))
    return BEND.bind(*given, **static), sum(found[1:], found[0])


def _transposed(other: Primitive) -> Callable[..., tuple[None, Any]]:
    def transpose(slopes: Any, x: Any, given: Any, **static: Any) -> tuple[None, Any]:
        if type(slopes) is ad.Zero:
            return None, ad.Zero(given.aval)
        return None, other.bind(x, slopes, **static)

    return transpose


def _bend_transposed(slopes: Any, x: Any, own: Any, moved: Any, **static: Any) -> tuple[Any, ...]:
    """Return the transpose with respect to tangents: itself, as second derivatives are symmetric."""
    if ad.is_undefined_primal(own):
        raise MethodError("a flow has no forward-over-forward second derivatives: use jacfwd or jacrev of jacrev")
    if type(slopes) is ad.Zero:
        return None, None, ad.Zero(moved.aval)
    return None, None, BEND.bind(x, own, slopes, **static)


ad.primitive_jvps[STATES] = _states_pushed
ad.primitive_jvps[PUSH], ad.primitive_jvps[PULL], ad.primitive_jvps[BEND] = _push_pushed, _pull_pushed, _bend_pushed
ad.primitive_transposes[BEND] = _bend_transposed
ad.primitive_transposes[PUSH], ad.primitive_transposes[PULL] = _transposed(PULL), _transposed(PUSH)
