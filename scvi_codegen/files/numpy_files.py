"""Arrays read from files of NumPy's (.npy, .npz), none of them pickled."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import numpy as np

__all__ = ["loaded"]


@contextmanager
def loaded(file: Any | IO[bytes]) -> Iterator[Any]:
    """What ``numpy.load`` gives, open as long as the context.

    Raises:
        OSError: if the file cannot be read.
        ValueError: for whatever a damaged file raises: errors of zipfile, zlib, the parser of headers, the memory.
    """
    try:
        found = np.load(file, allow_pickle=False)
        try:
            yield found
        finally:
            if hasattr(found, "close"):
                found.close()
    except (OSError, ValueError):
        raise
    except Exception as error:
        raise ValueError(f"it is no whole file of NumPy's: {error!r}") from error
