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

from scvi_codegen.cards import Html, card, grid, listed, plain, sparkline
from scvi_codegen.errors import StateError

if TYPE_CHECKING:
    from scvi_codegen.stepper import Stepper

__all__ = ["Trajectory", "write_atomically"]

Array = NDArray[np.float64]

MOST_DRAWN, MOST_CURVES = 400, 6
"""States, and coordinates, that a notebook draws."""


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

    def _repr_html_(self) -> str:
        every = max(1, -(-len(self) // MOST_DRAWN))
        series = list(zip(self.stepper.coordinates, self.q[::every].T, strict=True))[:MOST_CURVES]
        energies = self._energies(every)
        rows = [(plain(name), sparkline(values.tolist(), name), _range(values)) for name, values in series]
        if energies is not None:
            rows.append((plain("energy"), sparkline(energies.tolist(), "energy"), _range(energies)))
        names = zip(self.stepper.parameters, self.parameters, strict=True)
        facts = (
            ("time", plain(f"{self.t[0]:g} to {self.t[-1]:g}, h = {self.h:g}")),
            ("states", plain(f"{len(self)}; q and p of shape {self.q.shape}")),
            ("coordinates", listed(self.stepper.coordinates)),
            ("parameters", listed([f"{name} = {value:g}" for name, value in names])),
            ("iterations", plain(f"{self.iterations.sum()}")),
        )
        return card(self.stepper.title, facts, grid(rows))

    def _energies(self, every: int) -> Array | None:
        """Of each so many states, ``None`` where a state has no energy."""
        try:
            energies: Array = self.stepper.energy(self.q[::every], self.p[::every], self.t[::every], self.parameters)
        except StateError:
            return None
        return energies

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


def _range(values: Array) -> Html:
    """From the least to the greatest value, and by how much they differ."""
    low, high = float(np.min(values)), float(np.max(values))
    return plain(f"{low:.10g} to {high:.10g}, a difference of {high - low:.2g}")


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
