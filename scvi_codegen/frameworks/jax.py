"""A flow for JAX: called by XLA in C, with derivatives forward and back, batches, and compilation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import imported
from scvi_codegen.frameworks.flow_of_arrays import ArrayFlow, Arrays
from scvi_codegen.given.kinds import of, takes
from scvi_codegen.native import building
from scvi_codegen.rendering.flow import XLA_PARTS, XLA_SECOND, with_xla_flow
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.stepper import Stepper

__all__ = ["JaxFlow", "jax_flow"]

_registered: set[str] = set()


@takes(StateError, stepper=of("a compiled stepper", Stepper))
def jax_flow(stepper: Stepper, *, steps: int, every: int | None = None) -> JaxFlow:
    """So many steps of a stepper as a function of JAX.

    It is compiled C that XLA calls itself, without Python: ``jit``, ``vmap``, ``grad``, ``jvp``, ``vjp``, ``jacfwd``
    and ``jacrev`` apply, in any order, on processors (not on GPUs) and in binary64 (``jax_enable_x64``). Derivatives
    are exact, those of the computed map: forward by the linearised steps, back by their transpose; both take memory
    for all states of one trajectory. Second ones are those of ``jax.hessian``, ``jacfwd`` or ``jacrev`` of a gradient
    or of ``jacrev``; there are none forward of forward.

    Args:
        stepper: system and method.
        steps: how many.
        every: keep every so-many-th state and the initial one; by default that at the end alone.

    Raises:
        MethodError: in transformed time, and where a monitor chooses the steps.
        MissingLibraryError: without JAX (extra ``jax``).
        StateError: for steps that are no multiple of ``every``.
    """
    flow = JaxFlow.checked(stepper, steps, every)
    imported("jax", "jax")
    return flow


class JaxFlow(ArrayFlow):
    """The states of a motion, as a function that JAX differentiates."""

    @property
    def _arrays(self) -> Arrays:
        """See :attr:`ArrayFlow._arrays`."""
        return _JaxArrays()

    def _along(self, x: Any) -> Any:
        """See :meth:`ArrayFlow._along`."""
        from scvi_codegen.frameworks.jax_primitives import states_along

        size = 2 * self.stepper.dimension
        return states_along(x, target=self._target, steps=self.steps, every=self.spacing, size=size)

    @cached_property
    def _target(self) -> str:
        """The name under which XLA knows the C functions, compiled and registered when first asked for."""
        import jaxlib

        from scvi_codegen.frameworks.jax_primitives import SECOND

        name = self._registered(with_xla_flow(self.derivatives, jaxlib.__version__), XLA_PARTS)
        SECOND[name] = lambda: self._second_target
        return name

    @cached_property
    def _second_target(self) -> str:
        """The same of second derivatives, which are derived when JAX first asks for them."""
        import jaxlib

        return self._registered(with_xla_flow(self.second_derivatives, jaxlib.__version__, second=True), [XLA_SECOND])

    def _registered(self, source: Source, parts: Sequence[str]) -> str:
        import jax

        flags = (*self.stepper.flags, f"-I{jax.ffi.include_dir()}")
        name = f"scvi_{building.fingerprint(source, flags=flags)}"
        if name not in _registered:
            library = building.load(source, flags=flags)
            for part in parts:
                function = getattr(library.lib, f"{source.prefix}_xla_{part}")
                address = int(library.ffi.cast("uintptr_t", function))
                jax.ffi.register_ffi_target(f"{name}_{part}", jax.ffi.pycapsule(address), platform="cpu")
            _registered.add(name)
        return name


class _JaxArrays:
    """Arrays of JAX."""

    def binary64(self, value: Any, name: str) -> Any:
        """See :meth:`Arrays.binary64`."""
        import jax
        import jax.numpy as jnp

        if not jax.config.jax_enable_x64:
            raise StateError(
                "a flow is computed in binary64: call jax.config.update('jax_enable_x64', True) at the start"
            )
        array = jnp.asarray(value)
        if array.dtype != jnp.float64 and jnp.issubdtype(array.dtype, jnp.inexact):
            raise StateError(f"{name} is {array.dtype}, but a flow is computed in binary64: give float64")
        return array.astype(jnp.float64)

    def expanded(self, array: Any, shape: tuple[int, ...]) -> Any:
        """See :meth:`Arrays.expanded`."""
        import jax.numpy as jnp

        return jnp.broadcast_to(array, shape)

    def joined(self, parts: Sequence[Any]) -> Any:
        """See :meth:`Arrays.joined`."""
        import jax.numpy as jnp

        return jnp.concatenate(parts, axis=-1)
