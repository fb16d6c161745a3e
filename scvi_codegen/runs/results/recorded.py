"""Attributes of runs that not every way to compute them records: they are not set, and reading them raises an error."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

from scvi_codegen.common.errors import StateError

Run = TypeVar("Run")


class OfMethod:
    """Mixin of runs, trajectories and ensembles: their method."""

    __slots__ = ()

    @property
    def method(self: Any) -> str:
        """Name of the method whose steps these are, ``"svi-8-gauss-legendre-8"``; by default by tolerance."""
        return str(self.stepper.interface.method)


class NotRecordedError(StateError, AttributeError):
    """An attribute of a run that its computation did not record."""


class WithUnsetAttributes:
    """Run whose attributes ``OPTIONAL`` are not set where its computation does not record them."""

    __slots__ = ()

    OPTIONAL = (
        *("iterations", "rejected_steps", "fallback_steps", "bath", "acceptance"),
        *("step_error", "worst_step_time", "transitions"),
    )

    def __getattr__(self, name: str) -> Any:
        """Raise an error that says what records an attribute; Python calls this for those that are not set."""
        if name in self.OPTIONAL:
            raise not_recorded(name)
        return object.__getattribute__(self, name)  # raises the error again


def not_recorded(name: str) -> NotRecordedError:
    """Return the error for an attribute that ensembles do not record."""
    return NotRecordedError(
        f"ensembles do not record {name}: integrate the trajectory alone, by stepper.integrate(..) with its state and "
        "parameters"
    )


def without(run: Run, *names: str) -> Run:
    """Remove attributes that were not recorded from a run, and return it."""
    for name in names:
        delattr(run, name)
    return run


def changed(run: Run, **changes: Any) -> Run:
    """Return a copy of a run with other values of some attributes, as by :func:`dataclasses.replace`."""
    kept = [of.name for of in fields(run) if of.init and of.name not in changes]  # type: ignore[arg-type]
    unset = [name for name in kept if not hasattr(run, name)]
    values = {name: None if name in unset else getattr(run, name) for name in kept}
    return without(type(run)(**values, **changes), *unset)
