"""The result of an integration: arrays, diagnostics, and files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError

if TYPE_CHECKING:
    from scvi_codegen.binding import SolverOptions
    from scvi_codegen.events import Crossings, Event, EventLike
    from scvi_codegen.stepper import Stepper

__all__ = ["Trajectory", "write_atomically"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """States along a run, the initial one first.

    Attributes:
        t: (n,) times.
        q: (n, m) positions.
        p: (n, m) momenta.
        iterations: (n,) Newton iterations since the state before, 0 for the first.
        h: step size (negative: backward).
        parameters: (k,) values in the order of ``stepper.parameters``.
        stepper: the compiled integrator.
        options: convergence of the stage equations, ``None`` for the defaults.
        events: the zero crossings found, parallel to ``stepper.events``.
    """

    t: Array
    q: Array
    p: Array
    iterations: NDArray[np.int32]
    h: float
    parameters: Array
    stepper: Stepper = field(repr=False)
    options: SolverOptions | None = field(default=None, repr=False)
    events: tuple[Crossings, ...] = ()

    def __len__(self) -> int:
        return len(self.t)

    def energy(self) -> Array:
        """(n,) energies p.v - L, constant along exact trajectories when L does not depend on time."""
        energies: Array = self.stepper.energy(self.q, self.p, self.t, self.parameters)
        return energies

    @property
    def ended_by(self) -> Event | None:
        """The terminal event that ended the run, at whose crossing the last state is, or ``None``."""
        for found in self.events:
            if found.event.terminal and len(found) >= int(found.event.terminal):
                return found.event
        return None

    def at(self, t: ArrayLike) -> tuple[Array, Array]:
        """States between those kept: steps of a part of h, as accurate as the method and continuous in t.

        A whole step is the state kept there, so nothing jumps; where only every so-many-th was kept, the steps between
        are taken again, to round-off. Backward runs as well.

        Args:
            t: a time, or (n,) times in any order, within the trajectory.

        Returns:
            (q, p), each (m,) for a number and (n, m) for times.

        Raises:
            StateError: for times outside, and of a trajectory made with ``t_eval``.
        """
        return self.stepper.states_at(self, t)

    def crossings(self, events: EventLike | Sequence[EventLike]) -> tuple[Crossings, ...]:
        """Zero crossings of functions along the trajectory, looked for now; it needs all states (``every=1``).

        Args:
            events: as of :meth:`Stepper.integrate`; terminal ones do not end the search.
        """
        return self.stepper.with_events(events).crossings(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``.npz`` (arrays t, q, p, iterations, h, parameters, names) or ``.csv``, atomically.

        Raises:
            StateError: for another suffix.
        """
        suffix = Path(path).suffix.lower()
        if suffix == ".npz":
            write_atomically(path, self._write_npz)
        elif suffix == ".csv":
            write_atomically(path, self._write_csv)
        else:
            raise StateError(f"a trajectory is saved as .npz or .csv, not as {str(path)!r}")

    def _write_npz(self, file: IO[bytes]) -> None:
        np.savez(
            file,
            t=self.t,
            q=self.q,
            p=self.p,
            iterations=self.iterations,
            h=self.h,
            parameters=self.parameters,
            coordinates=np.array(self.stepper.coordinates),
            parameter_names=np.array(self.stepper.parameters, dtype=str),
            title=self.stepper.title,
        )

    def _write_csv(self, file: IO[bytes]) -> None:
        names = self.stepper.coordinates
        header = ",".join(["t", *names, *(f"p_{name}" for name in names), "iterations"])
        table = np.column_stack([self.t, self.q, self.p, self.iterations])
        formats = ["%.17g"] * (1 + 2 * len(names)) + ["%d"]
        np.savetxt(file, table, delimiter=",", header=header, comments="", fmt=formats)


def write_atomically(path: str | os.PathLike[str], write: Callable[[IO[bytes]], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then rename it: the old one stays until the new is whole."""
    target = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        mask = os.umask(0)
        os.umask(mask)
        Path(name).chmod(0o666 & ~mask)
        Path(name).replace(target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
