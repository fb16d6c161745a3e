"""Files of states of a recorded run."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import RecordingError
from scvi_codegen.files.atomic import sync_folder, write_atomically
from scvi_codegen.files.export import COLUMNS, Piece, loaded

NAME = re.compile(r"states-(\d{6,})\.npz")
UNFINISHED = re.compile(r"\.(states-\d{6,}\.npz|manifest\.json)\..+")
"""Names of temporary files that a killed process leaves."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive states, and a checkpoint after the last of them or some steps later.

    Attributes:
        piece: the states.
        step: number of steps at the checkpoint.
        memory: memory of the run, as returned by :meth:`Run.checkpoint`.
    """

    piece: Piece
    step: int
    memory: bytes

    def __len__(self) -> int:
        return len(self.piece[0])


def no_states(dimension: int) -> Piece:
    """Return an empty piece of states of m coordinates."""
    vectors = np.empty((0, dimension))
    return np.empty(0), vectors, vectors, np.empty(0, dtype=np.int32)


def chunk_path(folder: Path, number: int) -> Path:
    """Return the path of a file of states, numbered from 0."""
    return folder / f"states-{number:06d}.npz"


def chunk_paths(folder: Path) -> list[Path]:
    """Return the existing files of states, in order.

    Raises:
        RecordingError: if a file between them is missing.
    """
    numbers = sorted(int(match[1]) for path in folder.iterdir() if (match := NAME.fullmatch(path.name)))
    for expected, number in enumerate(numbers):
        if number != expected:
            raise RecordingError(f"'{chunk_path(folder, expected)}' is missing: restore it, later files depend on it")
    return [chunk_path(folder, number) for number in numbers]


def unfinished(folder: Path) -> list[Path]:
    """Return the temporary files that killed processes left."""
    return [path for path in folder.iterdir() if UNFINISHED.fullmatch(path.name)]


def write_chunk(folder: Path, number: int, chunk: Chunk) -> None:
    """Write a file of states atomically and durably; raise OSError on failure."""
    buffer = io.BytesIO()  # a full disk then fails in one plain write
    t, q, p, iterations = chunk.piece
    memory = np.frombuffer(chunk.memory, dtype=np.uint8)
    np.savez(buffer, t=t, q=q, p=p, iterations=iterations, step=np.int64(chunk.step), memory=memory)
    write_atomically(chunk_path(folder, number), lambda file: file.write(buffer.getbuffer()))
    sync_folder(folder)


def read_chunk(path: Path, dimension: int | None = None, rows: int | None = None) -> Chunk:
    """Return the contents of a file of states after checking checksums and, optionally, dimension and number of rows.

    Raises:
        RecordingError: if the file cannot be read or is damaged.
    """
    try:
        with path.open("rb") as file, loaded(file) as arrays:
            t, q, p, iterations = (arrays[name] for name in COLUMNS)
            chunk = Chunk((t, q, p, iterations), int(arrays["step"]), arrays["memory"].tobytes())
            _check_shapes(chunk, q.shape[-1] if dimension is None else dimension, rows)
            return chunk
    except (OSError, ValueError) as error:
        raise RecordingError(f"'{path}' cannot be read: {error}") from error


def _check_shapes(chunk: Chunk, dimension: int, rows: int | None) -> None:
    """Raise :class:`ValueError` if columns have other types or inconsistent lengths."""
    columns: tuple[NDArray[Any], ...] = chunk.piece
    likes: tuple[NDArray[Any], ...] = no_states(dimension)
    for name, column, like in zip(COLUMNS, columns, likes, strict=True):
        if column.shape != (len(chunk), *like.shape[1:]) or column.dtype != like.dtype:
            raise ValueError(f"{name} has the shape {column.shape} and the type {column.dtype}")
    if chunk.step < 0 or (rows is not None and len(chunk) > rows):
        raise ValueError(f"it has {len(chunk)} states up to step {chunk.step}")
