"""Flow map: a number of steps as a differentiable function of (q, p, parameters, t, h), and its form for JAX.

JAX calls the compiled C by XLA, PyTorch (:mod:`scvi_codegen.extras.frameworks.torch`) for many rows of numbers at
once; both have JVP, VJP, second derivatives and batches.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from textwrap import shorten
from typing import Any, Self

import numpy as np

from scvi_codegen.api.checks import Kind, checked_count, checks_arguments
from scvi_codegen.api.program import Source
from scvi_codegen.common.errors import StateError, imported
from scvi_codegen.extras.frameworks.sources import XLA_PARTS, XLA_SECOND_ORDER, with_flow_of_rows, with_xla_flow
from scvi_codegen.runs.stepper import Stepper


@dataclass(frozen=True, eq=False)
class Flow:
    """Fixed number of steps of a stepper.

    Attributes:
        stepper: compiled stepper.
        steps: number of steps.
        save_every: steps between saved states, the first of which is the initial one; by default only the final state
            is saved.
    """

    stepper: Stepper
    steps: int
    save_every: int | None

    @classmethod
    def checked(cls, stepper: Stepper, steps: int, save_every: int | None) -> Self:
        """Return a flow; MethodError without derivatives or fixed steps, StateError for invalid numbers of steps."""
        stepper.products.require("flow")
        stepper = stepper.known
        steps = checked_count(steps, "steps", least=1)
        if save_every is not None and steps % (save_every := checked_count(save_every, "save_every", least=1)):
            raise StateError(
                f"steps = {steps} must be a multiple of save_every = {save_every}, so that the final state is saved"
            )
        return cls(stepper, steps, save_every)

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.stepper, self.steps, self.save_every))  # without cached libraries

    def __repr__(self) -> str:
        return shorten(f"<{type(self).__name__} of {self.steps} steps: {self.stepper.title}>", 100, placeholder="..")

    @property
    def spacing(self) -> int:
        """Steps between saved states in C, which always saves the final one."""
        return self.steps if self.save_every is None else self.save_every

    @property
    def saved_states(self) -> int:
        """Number of saved states."""
        return self.steps // self.spacing + 1

    @property
    def derivatives(self) -> Source:
        """C source with derivatives of steps."""
        source = self.stepper.derivatives
        assert source is not None
        return source

    @property
    def second_derivatives(self) -> Source:
        """C source with first and second derivatives; raises MethodError if there are none."""
        self.stepper._second_derivatives  # noqa: B018
        source = self.stepper.second_derivatives
        assert source is not None
        return source

    def parameter_values(self, parameters: Any) -> Any:
        """Return all parameters in order as a list, or, unless passed by name, unchanged."""
        interface = self.stepper.interface
        self.stepper.products.check_given(parameters)
        if parameters is not None and not isinstance(parameters, Mapping):
            return parameters
        values: list[Any] = list(interface.defaults)
        for name, value in (parameters or {}).items():
            values[interface.parameter_index(name)] = value
        return values


class ArrayFlow(Flow):
    """States of a trajectory as a differentiable function of a framework."""

    @abstractmethod
    def _binary64(self, value: Any, name: str) -> Any:
        """Return an array in double precision; raise StateError for lower precision."""

    @abstractmethod
    def _joined(self, parts: Sequence[Any], batch: tuple[int, ...]) -> Any:
        """Return arrays (.., n), broadcast to the leading axes ``batch``, concatenated along the last axis."""

    @abstractmethod
    def _along(self, x: Any) -> Any:
        """Return (.., saved, 2m) states of the flows from (.., n) arguments each."""

    @checks_arguments(StateError)
    def __call__(self, q: Any, p: Any, *, h: Any, t: Any = 0.0, parameters: Any = None) -> tuple[Any, Any]:
        """Return the final state, or with ``save_every`` all saved states.

        Args:
            q, p: (.., m) initial positions and momenta. Leading axes are broadcast. States that violate the constraints
                are not projected; the first step moves them onto the constraint manifold.
            h: (..) step size.
            t: (..) initial time.
            parameters: by name, (..) each, others keep their defaults; or (.., k) in order.

        Returns:
            (q, p), (.., m) each; with ``save_every`` (.., n, m).

        Raises:
            StateError: for wrong shapes and names, and for anything but binary64.
            StepFailedError: if a step fails; in JAX its own error, with the time of the step.
        """
        m, values = self.stepper.dimension, self.parameter_values(parameters)
        count = len(self.stepper.interface.parameters)
        if isinstance(values, list):
            arguments = [self._number(value, "a parameter") for value in values]
        else:
            arguments = [self._vector(values, count, "parameters")]
        ends = [self._number(t, "t"), self._number(h, "h")]
        result = self._along(self._concatenated(self._vector(q, m, "q"), self._vector(p, m, "p"), *arguments, *ends))
        result = result[..., -1, :] if self.save_every is None else result
        return result[..., :m], result[..., m:]

    def _number(self, value: Any, name: str) -> Any:
        return self._binary64(value, name)[..., None]

    def _vector(self, value: Any, length: int, name: str) -> Any:
        array = self._binary64(value, name)
        if tuple(array.shape[-1:]) != (length,):
            raise StateError(f"{name} must have shape (.., {length}), not {tuple(array.shape)}")
        return array

    def _concatenated(self, *parts: Any) -> Any:
        """Broadcast (.., n) arrays and concatenate them along the last axis."""
        try:
            batch = np.broadcast_shapes(*(tuple(part.shape[:-1]) for part in parts))
        except ValueError as error:
            raise StateError(f"the leading axes of q, p, parameters, t and h cannot be broadcast: {error}") from error
        return self._joined(parts, batch)


class FlowOfRows(Flow):
    """Flow with its compiled C functions."""

    @cached_property
    def library(self) -> Any:
        """Values and derivatives, compiled on first use."""
        source = with_flow_of_rows(self.derivatives)
        return self.stepper.products.compiled(source)

    @cached_property
    def second_library(self) -> Any:
        """Values and derivatives up to second order, compiled on first use."""
        source = with_flow_of_rows(self.second_derivatives, second=True)
        return self.stepper.products.compiled(source)


_registered: set[str] = set()


@checks_arguments(StateError, stepper=Kind.of("a compiled stepper", Stepper))
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
        from scvi_codegen.extras.frameworks.jax_primitives import STATES

        size = 2 * self.stepper.dimension
        return STATES.bind(x, target=self._target, steps=self.steps, save_every=self.spacing, size=size)

    @cached_property
    def _target(self) -> str:
        """Name under which the C functions are registered with XLA; compiled and registered on first use."""
        import jaxlib

        from scvi_codegen.extras.frameworks.jax_primitives import SECOND

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

        flags = [f"-I{jax.ffi.include_dir()}"]
        name = f"scvi_{self.stepper.products.fingerprint(source, flags)}"
        if name not in _registered:
            library = self.stepper.products.library(source, flags)
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
