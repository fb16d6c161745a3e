"""Attributes of runs that not every way to compute them records: they raise an error, and have no default."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

from scvi_codegen.common.errors import StateError

Run = TypeVar("Run")
MISSING = -1
"""Value of a number, or of all entries of an array, that was not recorded."""


class Recorded:
    """Slot of a run whose value may not have been recorded; reading it raises :class:`StateError` then."""

    def __init__(self, name: str, slot: Any) -> None:
        self.name, self.slot = name, slot

    def __get__(self, run: Any, owner: Any = None) -> Any:
        if run is None:
            return self
        value = self.slot.__get__(run)
        number = value[0] if isinstance(value, tuple) else value
        if number is not None and np.size(number) and np.ravel(number)[0] == MISSING:
            raise not_recorded(self.name)
        return value

    def __set__(self, run: Any, value: Any) -> None:
        self.slot.__set__(run, value)


def not_recorded(name: str) -> StateError:
    """Return the error for an attribute that ensembles do not record."""
    return StateError(
        f"ensembles do not record {name}: integrate the trajectory alone, by stepper.integrate(..) with its state and "
        "parameters"
    )


def record_or_raise(kind: type, names: Sequence[str]) -> None:
    """Make attributes of a class of runs raise an error where they were not recorded."""
    for name in names:
        setattr(kind, name, Recorded(name, kind.__dict__[name]))


def stored(run: Any, name: str) -> Any:
    """Return the value of an attribute, of one that was not recorded the value for that."""
    attribute = getattr(type(run), name, None)
    return attribute.slot.__get__(run) if isinstance(attribute, Recorded) else getattr(run, name)


def changed(run: Run, **changes: Any) -> Run:
    """Return a copy of a run with other values of some attributes, as by :func:`dataclasses.replace`."""
    values = {of.name: stored(run, of.name) for of in fields(run) if of.init and of.name not in changes}  # type: ignore[arg-type]
    return type(run)(**values, **changes)
