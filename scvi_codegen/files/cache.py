"""The user's cache folder: compiled integrators, generated texts, reference solutions.

Anything in it can be made again, and is made again when it is missing or not what its checksum says. A checksum finds
accidents; what protects from others is that nobody else may write here: a folder or an entry that belongs to another
user than this one or root, or that its group or every user of the machine may write, is not used. When the entries
are larger than ``$SCVI_CODEGEN_CACHE_SIZE`` (1G by default; 0: no limit), those used least recently are removed. To
count thousands of entries takes as long as to compile one: a process counts them at its first, and again when it has
written a share of what was free. Processes may do all this at once: entries come and go by renaming.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from scvi_codegen.errors import BuildError, CacheWarning, warn
from scvi_codegen.files.atomic import remove

__all__ = [
    "CACHE_VARIABLE",
    "SIZE_VARIABLE",
    "CacheInfo",
    "cache_folder",
    "cache_info",
    "clear_cache",
    "discard",
    "exposed",
    "make_folder",
    "make_room",
    "remedy_of",
    "size_limit",
    "touch",
    "trusted_folder",
]

CACHE_VARIABLE = "SCVI_CODEGEN_CACHE"
SIZE_VARIABLE = "SCVI_CODEGEN_CACHE_SIZE"
DEFAULT_SIZE = "1G"
UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}

INTEGRATORS, TEXTS, REFERENCES = "_scvi_*", "texts/*.json", "references/*.npz"
UNFINISHED = (".building-*", ".removed-*", "texts/.*", "references/.*")
STALE_SECONDS = 3600
"""After which something unfinished is taken to be of a process that was killed; no compilation takes so long."""
UNCOUNTED_SHARE = 1 / 16
"""Of what is free: so much a process writes before it counts again."""
_uncounted: dict[tuple[Path, int], float] = {}
"""Bytes that this process may yet write before it counts, by folder and limit."""


def cache_folder() -> Path:
    """Where compiled steppers are kept: ``$SCVI_CODEGEN_CACHE``, else the user's cache folder."""
    chosen = os.environ.get(CACHE_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("scvi-codegen")


def trusted_folder() -> Path | None:
    """The cache folder, or ``None``, with a warning, if others may write into it: what lies there is run."""
    folder = cache_folder()
    if not exposed(folder):
        return folder
    warn(f"the cache folder '{folder}' is not used, because {remedy_of(folder)}", CacheWarning)
    return None


def remedy_of(folder: Path) -> str:
    """Why a folder is not used, and what to do."""
    reason = exposed(folder)
    remedy = f"chmod go-w '{folder}', or name" if "write" in reason else "name"
    return f"{reason}, and what lies there is run: {remedy} another folder in {CACHE_VARIABLE}"


def make_folder(folder: Path) -> None:
    """Make a folder that nobody else may write, whatever the umask; OSError if that fails."""
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)


def exposed(path: Path) -> str:
    """Why others than this user and root may change what is there; nothing where they may not, or nothing is there."""
    if os.name != "posix":
        return ""
    try:
        found = path.stat()
    except OSError:
        return ""
    if found.st_uid not in (os.geteuid(), 0):
        return f"it belongs to the user number {found.st_uid}, not to you ({os.geteuid()}) or root"
    if found.st_mode & stat.S_IWOTH:
        return "every user of this machine may write into it"
    return "every user of its group may write into it" if found.st_mode & stat.S_IWGRP else ""


def size_limit() -> int:
    """Bytes that the entries may have together, 0 for any number.

    Raises:
        BuildError: if ``$SCVI_CODEGEN_CACHE_SIZE`` is no size.
    """
    given = os.environ.get(SIZE_VARIABLE) or DEFAULT_SIZE
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?", given.strip(), re.IGNORECASE)
    if match is None:
        raise BuildError(
            f"the environment variable {SIZE_VARIABLE} is {given!r}: it must be a size, as in 500M or 2G, or 0 for no "
            "limit"
        )
    return int(float(match[1]) * UNITS[match[2].upper()])


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheInfo:
    """What is in the cache.

    Attributes:
        folder: where it is.
        integrators, texts, references: numbers of compiled integrators, of generated texts, of reference solutions.
        size: bytes of all of them.
        limit: bytes they may have, 0 for any number.
    """

    folder: Path
    integrators: int
    texts: int
    references: int
    size: int
    limit: int

    def __str__(self) -> str:
        limit = f"of {_readable(self.limit)}" if self.limit else "without a limit"
        return (
            f"{self.folder}\n"
            f"{self.integrators} compiled integrators, {self.texts} generated texts, "
            f"{self.references} reference solutions: {_readable(self.size)} {limit} ({SIZE_VARIABLE})"
        )


def cache_info() -> CacheInfo:
    """What is in the cache now. Raises as :func:`size_limit`."""
    folder = cache_folder()
    integrators, texts, references = (list(folder.glob(kind)) for kind in (INTEGRATORS, TEXTS, REFERENCES))
    return CacheInfo(
        folder=folder,
        integrators=len(integrators),
        texts=len(texts),
        references=len(references),
        size=sum(_size(path) for path in (*integrators, *texts, *references)),
        limit=size_limit(),
    )


def clear_cache() -> int:
    """Remove all entries, and what processes left that were killed long ago; nothing else. Returns the bytes freed."""
    folder = cache_folder()
    entries = list(_entries(folder))
    freed = sum(map(_size, entries))
    for path in entries:
        discard(path)
    _remove_unfinished(folder)
    return freed


def touch(entry: Path) -> None:
    """Note that an entry was used."""
    with suppress(OSError):
        os.utime(entry)


def make_room(folder: Path, newest: Path) -> None:
    """Remove the entries used least recently until all fit the limit, but never the ``newest``, which was written now.

    They are counted where this one may be too much: where it does not fit what was left uncounted.
    """
    limit = size_limit()
    left = _uncounted.get((folder, limit), 0.0) - _size(newest)
    if left <= 0.0:
        _remove_unfinished(folder)
        left = (limit - _fit(folder, newest, limit)) * UNCOUNTED_SHARE if limit else float("inf")
    _uncounted[folder, limit] = left


def _fit(folder: Path, newest: Path, limit: int) -> int:
    """Remove entries until all fit; the bytes of those that are left."""
    found = [(_last_use(path), _size(path), path) for path in _entries(folder) if path != newest]
    total = _size(newest) + sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= limit:
            break
        discard(path)
        total -= size
    return total


def discard(entry: Path) -> None:
    """Remove an entry: first out of sight, so that no other process finds half of it or puts another in its place."""
    try:
        aside = Path(tempfile.mkdtemp(prefix=".removed-", dir=entry.parent))
    except OSError:
        return
    with suppress(OSError):
        entry.replace(aside / "entry")
    remove(aside)


def _entries(folder: Path) -> Iterator[Path]:
    for kind in (INTEGRATORS, TEXTS, REFERENCES):
        yield from folder.glob(kind)


def _remove_unfinished(folder: Path) -> None:
    for kind in UNFINISHED:
        for path in folder.glob(kind):
            if time.time() - _last_use(path) > STALE_SECONDS:
                remove(path)


def _last_use(path: Path) -> float:
    """0 for what is gone meanwhile."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _size(path: Path | os.DirEntry[str]) -> int:
    """Bytes of a file, or of all in a folder that others may be removing."""
    try:
        if not path.is_dir():
            return path.stat().st_size
        with os.scandir(path) as inside:
            return sum(map(_size, inside))
    except OSError:
        return 0


def _readable(size: float) -> str:
    for unit in ("B", "KiB", "MiB", "GiB"):
        if size < 1024:
            return f"{size:.4g} {unit}"
        size /= 1024
    return f"{size:.4g} TiB"
