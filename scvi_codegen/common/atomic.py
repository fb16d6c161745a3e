"""Atomic writes, to a temporary name in the same folder that is then renamed, and reads of regular files alone."""

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import IO


def write_atomically(path: str | os.PathLike[str], write: Callable[[IO[bytes]], object]) -> None:
    """Write a temporary file in the folder of ``path``, then rename it, so that ``path`` is always complete."""
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


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text in UTF-8 atomically."""
    write_atomically(path, lambda file: file.write(text.encode()))


@contextmanager
def replaced(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path on the same disk for a new file or folder, which then replaces ``path``.

    If that fails, nothing has changed. A file is replaced atomically; an existing folder is moved aside just before,
    and removed afterwards.
    """
    target = Path(path)
    with tempfile.TemporaryDirectory(
        prefix=f".{target.name}.", dir=target.parent, ignore_cleanup_errors=True
    ) as temporary_folder:
        new, aside = Path(temporary_folder) / target.name, Path(temporary_folder) / "replaced"
        yield new
        _sync(new)
        if target.is_dir():
            target.replace(aside)
        try:
            new.replace(target)
        except OSError:
            if aside.exists():
                aside.replace(target)
            raise
    sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Synchronise the names in a folder to disk, where the operating system supports it."""
    with suppress(OSError):
        _sync(folder)


def _sync(path: Path) -> None:
    if path.is_dir() and os.name != "posix":
        return  # folders cannot be opened there
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)  # Windows requires write access
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def remove(path: Path) -> None:
    """Remove a file or a folder with its contents, ignoring errors."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def regular(path: str | os.PathLike[str]) -> Path:
    """Return a path; raise OSError for a device, pipe or socket, which could be read without end, and for no path."""
    if "\0" in os.fsdecode(path):
        raise OSError(errno.EINVAL, "a path contains no null character", repr(path))
    mode = (target := Path(path)).stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is not a regular file", str(target))
    return target


FOLDERS = "--folder DIR, load_model(.., folders=)"
"""Ways to name a folder with files that documents may name."""


class NamedFile(str):
    """Path that a user named on the command line, which may be anywhere, unlike those in documents of others."""

    __slots__ = ()


_named_folders: ContextVar[tuple[Path, ...]] = ContextVar("named_folders", default=())


@contextmanager
def naming_folders(folders: Iterable[str | os.PathLike[str]]) -> Iterator[None]:
    """Allow documents to name files in these folders as well, which a user named."""
    token = _named_folders.set((*_named_folders.get(), *(Path(folder).resolve() for folder in folders)))
    try:
        yield
    finally:
        _named_folders.reset(token)


def is_inside(folder: str | os.PathLike[str], path: Path) -> bool:
    """Return whether a path is in a folder, or in one of :func:`naming_folders`; links are followed."""
    admitted = (Path(folder).resolve(), *_named_folders.get())
    return any(path.resolve().is_relative_to(place) for place in admitted)


def inside(folder: str | os.PathLike[str], name: str | os.PathLike[str]) -> Path:
    """Return the path of a file that a document in the folder names; links are followed.

    Raises:
        OSError: if the file is outside the folder and those of :func:`naming_folders`, unless it is a
            :class:`NamedFile`.
    """
    path = Path(folder) / name
    if not isinstance(name, NamedFile) and not is_inside(folder, path):
        where = f"it is outside the folder {Path(folder).resolve()} of the document that names it"
        raise OSError(errno.EACCES, f"{where}: copy it there, or name its folder ({FOLDERS})")
    return path


def read_text(path: str | os.PathLike[str], encoding: str) -> str:
    """Return the text of a regular file."""
    return regular(path).read_text(encoding=encoding)
