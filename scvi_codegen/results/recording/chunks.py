"""The files of states of a recorded run."""

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
from scvi_codegen.files.export import COLUMNS, Piece
from scvi_codegen.files.numpy_files import loaded

__all__ = ["Chunk", "chunk_path", "chunk_paths", "no_states", "read_chunk", "unfinished", "write_chunk"]

NAME = re.compile(r"states-(\d{6,})\.npz")
UNFINISHED = re.compile(r"\.(states-\d{6,}\.npz|manifest\.json)\..+")
"""Files on the way to their place when their process was killed."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """States in a row, and where the run goes on from: after the last of them, or some steps later.

    Attributes:
        piece: the states.
        step: number of steps done by then.
        memory: of the run then, as :meth:`Run.save` gives it.
    """

    piece: Piece
    step: int
    memory: bytes

    def __len__(self) -> int:
        return len(self.piece[0])


def no_states(dimension: int) -> Piece:
    """An empty piece of states of m coordinates."""
    vectors = np.empty((0, dimension))
    return np.empty(0), vectors, vectors, np.empty(0, dtype=np.int32)


def chunk_path(folder: Path, number: int) -> Path:
    """Where the files of states are, counted from 0."""
    return folder / f"states-{number:06d}.npz"


def chunk_paths(folder: Path) -> list[Path]:
    """The files of states that are there, in order.

    Raises:
        RecordingError: if one is missing between them.
    """
    numbers = sorted(int(match[1]) for path in folder.iterdir() if (match := NAME.fullmatch(path.name)))
    for expected, number in enumerate(numbers):
        if number != expected:
            raise RecordingError(f"'{chunk_path(folder, expected)}' is missing: the files after it are not continued")
    return [chunk_path(folder, number) for number in numbers]


def unfinished(folder: Path) -> list[Path]:
    """What processes that were killed left of files that never came to their place."""
    return [path for path in folder.iterdir() if UNFINISHED.fullmatch(path.name)]


def write_chunk(folder: Path, number: int, chunk: Chunk) -> None:
    """Put a file of states in its place, whole and on the disk; OSError if that fails."""
    buffer = io.BytesIO()  # a full disk is met in one plain write
    t, q, p, iterations = chunk.piece
    memory = np.frombuffer(chunk.memory, dtype=np.uint8)
    np.savez(buffer, t=t, q=q, p=p, iterations=iterations, step=np.int64(chunk.step), memory=memory)
    write_atomically(chunk_path(folder, number), lambda file: file.write(buffer.getbuffer()))
    sync_folder(folder)


def read_chunk(path: Path, dimension: int | None = None, rows: int | None = None) -> Chunk:
    """What a file of states holds, its checksums compared; of states of m coordinates, so many at most.

    Raises:
        RecordingError: if it cannot be read, or was changed.
    """
    try:
        with path.open("rb") as file, loaded(file) as arrays:
            t, q, p, iterations = (arrays[name] for name in COLUMNS)
            found = Chunk((t, q, p, iterations), int(arrays["step"]), arrays["memory"].tobytes())
            _check_shapes(found, q.shape[-1] if dimension is None else dimension, rows)
            return found
    except (OSError, ValueError) as error:
        raise RecordingError(f"'{path}' cannot be read: {error}") from error


def _check_shapes(chunk: Chunk, dimension: int, rows: int | None) -> None:
    """Raise :class:`ValueError` for columns of other kinds, or of lengths that differ."""
    columns: tuple[NDArray[Any], ...] = chunk.piece
    likes: tuple[NDArray[Any], ...] = no_states(dimension)
    for name, column, like in zip(COLUMNS, columns, likes, strict=True):
        if column.shape != (len(chunk), *like.shape[1:]) or column.dtype != like.dtype:
            raise ValueError(f"{name} has the shape {column.shape} and the type {column.dtype}")
    if chunk.step < 0 or (rows is not None and len(chunk) > rows):
        raise ValueError(f"it has {len(chunk)} states up to step {chunk.step}")
