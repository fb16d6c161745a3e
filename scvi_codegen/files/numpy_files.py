"""Reading of NumPy's files (.npy, .npz) without pickle."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import numpy as np


@contextmanager
def loaded(file: Any | IO[bytes]) -> Iterator[Any]:
    """Return the result of ``numpy.load``, open within the context.

    Raises:
        OSError: if the file cannot be read.
        ValueError: for any failure on a damaged file: of zipfile, zlib, the header parser, or memory.
    """
    try:
        content = np.load(file, allow_pickle=False)
        try:
            yield content
        finally:
            if hasattr(content, "close"):
                content.close()
    except (OSError, ValueError):
        raise
    except Exception as error:
        raise ValueError(f"it is not a complete NumPy file: {error!r}") from error
