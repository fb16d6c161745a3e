"""Errors and warnings of the package. Each message names the symbol or value at fault and says what to do."""

import difflib
import importlib
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, TypeAlias

PACKAGE = __name__.partition(".")[0]


Face: TypeAlias = Literal["python", "model", "file", "command"]
"""Where a user writes the options that messages name: a call, a :class:`Model`, its file, or a command with MODEL."""
FACE: ContextVar[Face] = ContextVar("face", default="python")


@contextmanager
def speaking(face: Face) -> Iterator[None]:
    """Let messages name options in the words of a face, the outermost one that is no call of Python."""
    token = FACE.set(face if FACE.get() == "python" else FACE.get())
    try:
        yield
    finally:
        FACE.reset(token)


def closest(name: str, candidates: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the known name nearest to ``name``, or a full stop if none is near."""
    matches = difflib.get_close_matches(name, list(candidates), n=1)
    return f"; did you mean '{matches[0]}'?" if matches else "."


def warn(message: str, category: type[Warning]) -> None:
    """Issue a warning attributed to the line that called this package, at any depth inside it and its decorators."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in (PACKAGE, "contextlib"):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


class ScviCodegenError(Exception):
    """Base class of all errors raised by this package."""


class ArgumentError(ScviCodegenError, TypeError):
    """An argument of the wrong type."""


class SystemDefinitionError(ScviCodegenError, ValueError):
    """An ill-defined mechanical system (unknown symbol, singular mass matrix, ...)."""


class ExpressionError(SystemDefinitionError):
    """Text that the formula grammar does not accept.

    Attributes:
        text: the text that was parsed.
        column: 0-based position of the error in ``text``.
    """

    def __init__(self, message: str, text: str, column: int) -> None:
        self.text, self.column = text, column
        start = max(0, column - 50)
        window = text[start : column + 30].replace("\n", " ")
        super().__init__(f"{message}\n  {window}\n  {' ' * (column - start)}^ column {column + 1}")


class PathError(ScviCodegenError, ArithmeticError):
    """No path between two positions, or closed path, was found."""


class ControlError(ScviCodegenError, ArithmeticError):
    """Failure to find an optimal control; ``motion`` is the last iterate."""

    def __init__(self, message: str, motion: Any = None) -> None:
        self.motion = motion
        super().__init__(message)


class FitError(ScviCodegenError, ValueError):
    """Measurements that do not determine the requested parameters."""


class MethodError(ScviCodegenError, ValueError):
    """An invalid combination of degree, nodes and quadrature, or a feature that the method does not have."""


class SizesRequiredError(SystemDefinitionError, MethodError):
    """A system or a method that has no integrator for arrays of run-time sizes: the sizes must be known."""


class OrbitError(ScviCodegenError, ArithmeticError):
    """Failure to find a periodic orbit near an initial guess."""


class MethodWarning(UserWarning):
    """A method that works but has a property the user should know."""


class SystemDefinitionWarning(UserWarning):
    """A definition that is probably a mistake, or not read entirely: a parameter without effect, limits of a robot.

    The system can be compiled and run as it is written. Parameters that only events use are reported by
    definitions in Python, which do not contain the events; model files are examined with their events.
    """


class AccuracyWarning(UserWarning):
    """A result of doubtful accuracy or meaning: too large steps, a projected initial state, a closed path at rest.

    The equations were solved, but states computed with too large steps are unreliable.
    """


class ModelFileError(ScviCodegenError, ValueError):
    """A model file that cannot be read, or that lacks or repeats an entry."""


class PackageError(ScviCodegenError, ValueError):
    """A folder that contains no generated package or cannot be used for one."""


class EventError(ScviCodegenError, ValueError):
    """An invalid event: an unknown symbol, a constant function, an unknown direction or a value that is not finite.

    Attributes:
        trajectory: the :class:`Trajectory` before a failure of contacts, or of an event that changes the state.
    """

    trajectory: object | None = None


class EventWarning(UserWarning):
    """A run that ended where its events accumulate, or whose contacts have several modes or created energy."""


class ContactError(EventError):
    """Contacts without consistent forces or impulses, with a negative gap at the start or negative friction."""


class PlotError(ScviCodegenError):
    """Missing matplotlib."""


class CacheWarning(UserWarning):
    """A cache folder that cannot be used."""


class MissingLibraryError(ScviCodegenError, ImportError):
    """An optional library that is not installed; the message names the extra that provides it."""


@contextmanager
def of_trajectory(number: int) -> Iterator[None]:
    """Name a trajectory of an ensemble in the message of an error of its start."""
    try:
        yield
    except (StateError, EventError) as error:
        raise type(error)(f"trajectory {number}: {error}") from error


def missing(library: str, extra: str) -> MissingLibraryError:
    """Return the error for a library that is not installed; ``extra`` provides it."""
    return MissingLibraryError(f"this needs {library}, which is not installed: pip install 'scvi-codegen[{extra}]'")


def imported(library: str, extra: str) -> Any:
    """Import a library; raise MissingLibraryError, which names the extra, if it is not installed."""
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise missing(library, extra) from error


class RecordingError(ScviCodegenError, OSError):
    """A folder without a run, or one that cannot be read or written; the message says how far its run goes."""


class RecordingWarning(UserWarning):
    """A recorded run that is resumed under other conditions than those of its start."""


class StateError(ScviCodegenError, ValueError):
    """A state, step size or parameter of the wrong shape, type or name."""


class UnresolvedError(StateError, ArithmeticError):
    """A motion that no fixed step size resolves: it ends in a singularity, or has a close encounter."""


class BuildError(ScviCodegenError, RuntimeError):
    """A missing C compiler, or C source that the compiler rejected."""


class StepFailedError(ScviCodegenError, ArithmeticError):
    """Failure to solve a step, or to store its state; the state before it is unchanged.

    Attributes:
        status: the status word of the C code (``"not converged"``, ``"singular"``, ``"not finite"``), or ``"too many
            states"``.
        step: index of the failed step, counted from 0.
        t: time at the start of the failed step.
        residual: the last scaled Newton update.
        trajectory: the :class:`Trajectory` before the failure, ``None`` for a single step; see
            :meth:`Trajectory.before`.
    """

    def __init__(
        self, message: str, *, status: str, step: int, t: float, residual: float, trajectory: object | None = None
    ) -> None:
        super().__init__(message)
        self.status, self.step, self.t, self.residual, self.trajectory = status, step, t, residual, trajectory
