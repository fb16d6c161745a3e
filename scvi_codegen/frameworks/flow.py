"""Flow map, independent of the framework: a number of steps as a function of (q, p, parameters, t, h)."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from scvi_codegen.errors import MissingLibraryError, StateError
from scvi_codegen.rendering.source import Source
from scvi_codegen.representation import LONGEST, clipped
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.core.validation import check_inputs_given, parameter_index
from scvi_codegen.validation.counts import checked_count

__all__ = ["Flow", "imported"]


@dataclass(frozen=True, eq=False)
class Flow:
    """Fixed number of steps of a stepper.

    Attributes:
        stepper: compiled stepper.
        steps: number of steps.
        save_every: steps between saved states, the first of which is the initial one; 0 to return only the final state.
    """

    stepper: Stepper
    steps: int
    save_every: int

    @classmethod
    def checked(cls, stepper: Stepper, steps: int, save_every: int | None) -> Self:
        """Return a flow for arguments of users.

        Raises:
            MethodError: for a stepper without derivatives or without fixed steps.
            StateError: for invalid numbers of steps.
        """
        stepper._check_fixed_steps("a flow")
        steps = checked_count(steps, "steps", least=1)
        save_every = 0 if save_every is None else checked_count(save_every, "save_every", least=1)
        if save_every and steps % save_every:
            raise StateError(
                f"steps = {steps} must be a multiple of save_every = {save_every}, so that the final state is saved"
            )
        return cls(stepper, steps, save_every)

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.stepper, self.steps, self.save_every))  # without cached libraries

    def __repr__(self) -> str:
        return clipped(f"<{type(self).__name__} of {self.steps} steps: {self.stepper.title}>", LONGEST)

    @property
    def spacing(self) -> int:
        """Steps between saved states in C, which always saves the final one."""
        return self.save_every or self.steps

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
        """Return all parameters in order as a list, or, unless passed by name, unchanged.

        Raises:
            StateError: for unknown names, and missing inputs.
        """
        interface = self.stepper.interface
        check_inputs_given(interface, parameters)
        if parameters is not None and not isinstance(parameters, Mapping):
            return parameters
        values: list[Any] = list(interface.defaults)
        for name, value in (parameters or {}).items():
            values[parameter_index(interface, name)] = value
        return values


def imported(library: str, extra: str) -> Any:
    """Import a library; raise MissingLibraryError, which names the extra, if it is not installed."""
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise MissingLibraryError(
            f"this needs {library}, which is not installed: pip install 'scvi-codegen[{extra}]'"
        ) from error
