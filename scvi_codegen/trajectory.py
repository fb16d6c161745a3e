"""The result of an integration: arrays, diagnostics, and files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError

if TYPE_CHECKING:
    from scvi_codegen.stepper import Stepper

__all__ = ["Trajectory", "relative_changes", "write_atomically"]

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
    """

    t: Array
    q: Array
    p: Array
    iterations: NDArray[np.int32]
    h: float
    parameters: Array
    stepper: Stepper = field(repr=False)

    def __len__(self) -> int:
        return len(self.t)

    def energy(self) -> Array:
        """(n,) energies p.v - L, constant along exact trajectories when L does not depend on time."""
        energies: Array = self.stepper.energy(self.q, self.p, self.t, self.parameters)
        return energies

    def momentum_maps(self) -> Array:
        """(n, k) values of what symmetries conserve, in the order of ``stepper.momentum_map_names``."""
        return self.stepper.momentum_maps(self.q, self.p, self.t, self.parameters)

    def momentum_errors(self) -> Array:
        """(n, k) changes of the momentum maps since the first state, relative to the largest size of their terms."""
        values, sizes = self.stepper.momentum_maps_and_sizes(self.q, self.p, self.t, self.parameters)
        return relative_changes(values, sizes)

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


def relative_changes(values: Array, sizes: Array) -> Array:
    """Changes since the first along axis 0, relative to the largest size; NaN where sizes are beyond all numbers."""
    with np.errstate(invalid="ignore", over="ignore"):
        scales = np.fmax.reduce(sizes, axis=0)
        changes: Array = (values - values[0]) / np.where(scales > 0.0, scales, 1.0)
    return np.where(np.isinf(scales), np.nan, changes)


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
