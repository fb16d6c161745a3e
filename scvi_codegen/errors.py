"""Every error a user can meet. Each message names the symbol or value at fault and says what to do."""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Iterable
from typing import Any

__all__ = [
    "AccuracyWarning",
    "ArgumentError",
    "BuildError",
    "CacheWarning",
    "ControlError",
    "EventError",
    "ExpressionError",
    "FitError",
    "MethodError",
    "MethodWarning",
    "MissingLibraryError",
    "ModelFileError",
    "OrbitError",
    "PackageError",
    "PlotError",
    "RecordingError",
    "RecordingWarning",
    "ScviCodegenError",
    "StateError",
    "StepFailedError",
    "SystemDefinitionError",
    "SystemDefinitionWarning",
    "closest",
    "warn",
]

PACKAGE = __name__.partition(".")[0]


def closest(name: str, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"`` for the known name nearest to ``name``, or a full stop."""
    matches = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{matches[0]}'?" if matches else "."


def warn(message: str, category: type[Warning]) -> None:
    """Of the line that called this package, from however deep inside it."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == PACKAGE:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


class ScviCodegenError(Exception):
    """Base of all errors raised on purpose by this package."""


class ArgumentError(ScviCodegenError, TypeError):
    """An argument is not of the kind that a public function takes."""


class SystemDefinitionError(ScviCodegenError, ValueError):
    """The mechanical system is not well defined (unknown symbol, singular mass matrix, ...)."""


class ExpressionError(SystemDefinitionError):
    """Text that is not a formula of the accepted grammar.

    Attributes:
        text: the text as given.
        column: 0-based position of the offence in ``text``.
    """

    def __init__(self, message: str, text: str, column: int) -> None:
        self.text, self.column = text, column
        start = max(0, column - 50)
        window = text[start : column + 30].replace("\n", " ")
        super().__init__(f"{message}\n  {window}\n  {' ' * (column - start)}^ column {column + 1}")


class ControlError(ScviCodegenError, ArithmeticError):
    """No optimal control was found; ``motion`` is the last that was tried."""

    def __init__(self, message: str, motion: Any = None) -> None:
        self.motion = motion
        super().__init__(message)


class FitError(ScviCodegenError, ValueError):
    """Measurements that do not tell what is asked of them."""


class MethodError(ScviCodegenError, ValueError):
    """A combination of degree, nodes and quadrature that makes no sense."""


class OrbitError(ScviCodegenError, ArithmeticError):
    """No periodic orbit was found near a guess."""


class MethodWarning(UserWarning):
    """A method that can be built, with a property the user should know of."""


class SystemDefinitionWarning(UserWarning):
    """A definition that is probably a mistake: a parameter without effect, or a mass that its default makes negative.

    The system can be compiled and run as it is written. Parameters that only events use are reported, too, since a
    definition does not contain its events; add them to L to declare them used.
    """


class AccuracyWarning(UserWarning):
    """Of a run that went on: steps too long for the motion, or an initial state that was moved onto its constraints.

    The equations were solved; but states after steps that are too long are not to be trusted.
    """


class ModelFileError(ScviCodegenError, ValueError):
    """A model file that cannot be read, or that lacks or repeats something."""


class PackageError(ScviCodegenError, ValueError):
    """A folder that cannot hold a generated package, or holds none."""


class EventError(ScviCodegenError, ValueError):
    """An event that cannot be watched: an unknown symbol, a constant, another direction, a value that is not finite."""


class PlotError(ScviCodegenError):
    """matplotlib is not installed."""


class CacheWarning(UserWarning):
    """A cache folder that is not used."""


class MissingLibraryError(ScviCodegenError, ImportError):
    """A library that a file format or a conversion needs is not installed; the message names the extra that has it."""


class RecordingError(ScviCodegenError, OSError):
    """A folder that holds no run, or that cannot be read or written; the message says how far the run in it goes."""


class RecordingWarning(UserWarning):
    """A recorded run goes on under other circumstances than it began."""


class StateError(ScviCodegenError, ValueError):
    """A state, step or parameter of the wrong shape, type or name."""


class BuildError(ScviCodegenError, RuntimeError):
    """No C compiler was found, or it refused the generated source."""


class StepFailedError(ScviCodegenError, ArithmeticError):
    """A step did not converge; the state before it is untouched.

    Attributes:
        status: the status word of the C code (``"not converged"``, ``"singular"``, ``"not finite"``).
        step: index of the failing step, counted from 0.
        t: time at the start of the failing step.
        residual: the last scaled Newton update.
        trajectory: the :class:`Trajectory` before the failure, ``None`` for a single step; :meth:`Trajectory.before`.
    """

    def __init__(
        self, message: str, *, status: str, step: int, t: float, residual: float, trajectory: object | None = None
    ) -> None:
        super().__init__(message)
        self.status, self.step, self.t, self.residual, self.trajectory = status, step, t, residual, trajectory
