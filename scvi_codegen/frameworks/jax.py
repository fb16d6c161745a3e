"""Flow map for JAX: a C function called by XLA, with JVP, VJP, batches and compilation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import ArrayFlow, imported
from scvi_codegen.native import building
from scvi_codegen.rendering.flow import XLA_PARTS, XLA_SECOND_ORDER, with_xla_flow
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.validation import checks_arguments, of

_registered: set[str] = set()


@checks_arguments(StateError, stepper=of("a compiled stepper", Stepper))
def jax_flow(stepper: Stepper, *, steps: int, save_every: int | None = None) -> JaxFlow:
    """Return a fixed number of steps of a stepper as a function of JAX.

    XLA calls the compiled C directly, without Python: ``jit``, ``vmap``, ``grad``, ``jvp``, ``vjp``, ``jacfwd`` and
    ``jacrev`` apply, in any order, on CPUs (not on GPUs) and in binary64 (``jax_enable_x64``). Derivatives are those of
    the computed map, exact up to round-off: JVPs by the linearised steps, VJPs by their transpose; both store all
    states of one trajectory. Second derivatives are available as ``jax.hessian``, ``jacfwd`` or ``jacrev`` of a
    gradient or of ``jacrev``; forward over forward is not.

    Args:
        stepper: compiled stepper.
        steps: number of steps.
        save_every: save the initial state and every ``save_every``-th one; by default only the final state.

    Raises:
        MethodError: in transformed time, and for steps of a time-rescaling function.
        MissingLibraryError: without JAX (extra ``jax``).
        StateError: if ``steps`` is not a multiple of ``save_every``.
    """
    flow = JaxFlow.checked(stepper, steps, save_every)
    imported("jax", "jax")
    return flow


class JaxFlow(ArrayFlow):
    """States of a trajectory as a function that JAX differentiates."""

    def _along(self, x: Any) -> Any:
        """Return the saved states; see :meth:`ArrayFlow._along`."""
        from scvi_codegen.frameworks.jax_primitives import states_along

        size = 2 * self.stepper.dimension
        return states_along(x, target=self._target, steps=self.steps, save_every=self.spacing, size=size)

    @cached_property
    def _target(self) -> str:
        """Name under which the C functions are registered with XLA; compiled and registered on first use."""
        import jaxlib

        from scvi_codegen.frameworks.jax_primitives import SECOND

        name = self._registered(with_xla_flow(self.derivatives, jaxlib.__version__), XLA_PARTS)
        SECOND[name] = lambda: self._second_target
        return name

    @cached_property
    def _second_target(self) -> str:
        """Name of the second derivatives, which are compiled when JAX first needs them."""
        import jaxlib

        return self._registered(
            with_xla_flow(self.second_derivatives, jaxlib.__version__, second=True), [XLA_SECOND_ORDER]
        )

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

    def _binary64(self, value: Any, name: str) -> Any:
        """Return an array in double precision; see :meth:`ArrayFlow._binary64`."""
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

    def _joined(self, parts: Sequence[Any], batch: tuple[int, ...]) -> Any:
        """Return arrays concatenated along the last axis; see :meth:`ArrayFlow._joined`."""
        import jax.numpy as jnp

        return jnp.concatenate([jnp.broadcast_to(part, (*batch, part.shape[-1])) for part in parts], axis=-1)
