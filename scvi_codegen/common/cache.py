"""The user's cache folder: compiled integrators, generated sources, reference solutions.

Every entry can be regenerated, and is if it is missing or its checksum does not match. Checksums detect accidents;
against other users, the folder and its entries are used only if no one but this user and root may write to them. If
the entries exceed ``$SCVI_CODEGEN_CACHE_SIZE`` (1G by default; 0: no limit), the least recently used are removed.
Counting thousands of entries takes as long as compiling one: a process counts them at its first write, and again when
it has written a certain share of what was free. Concurrent processes are safe: entries are created and removed by
renaming.

The name of a generated source is a digest of everything that it depends on: the parts of a key that the caller passes,
and the generator itself, represented by sizes and times of all files. An entry that cannot be read or written, or does
not match its checksum, is no error: the source is generated again.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

from scvi_codegen.common.atomic import remove, write_text
from scvi_codegen.common.errors import BuildError, CacheWarning, warn

if TYPE_CHECKING:
    import sympy

PACKAGE = Path(__file__).parents[1]


def template_folder() -> Path:
    """Return the templates: inside the installed package, or next to it in a checkout."""
    for folder in (PACKAGE / "templates", PACKAGE.parent / "templates"):
        if (folder / "stepper.c.jinja").is_file():
            return folder
    raise FileNotFoundError("the C templates are missing: reinstall scvi-codegen")


CACHE_VARIABLE = "SCVI_CODEGEN_CACHE"
SIZE_VARIABLE = "SCVI_CODEGEN_CACHE_SIZE"
DEFAULT_SIZE = "1G"
UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}

INTEGRATORS, TEXTS, REFERENCES = "_scvi_*", "texts/*.json", "references/*.npz"
UNFINISHED = (".building-*", ".removed-*", "texts/.*", "references/.*")
STALE_SECONDS = 3600
"""Age after which an unfinished entry is attributed to a killed process; no compilation takes so long."""
UNCOUNTED_SHARE = 1 / 16
"""Share of the free size that a process writes before it counts again."""
FILLED = 0.9
"""Part of the limit to which a full cache is reduced: entries are then counted again only after several builds."""
_uncounted: dict[tuple[Path, int], float] = {}
"""Bytes that this process may write before it counts again, by folder and limit."""


def cache_folder() -> Path:
    """Return the cache folder: ``$SCVI_CODEGEN_CACHE``, else the user's cache folder."""
    setting = os.environ.get(CACHE_VARIABLE)
    return Path(setting) if setting else platformdirs.user_cache_path("scvi-codegen")


def trusted_folder() -> Path | None:
    """Return the cache folder, or ``None`` with a warning if others may write to it: its contents are executed."""
    folder = cache_folder()
    if not exposed(folder):
        return folder
    warn(f"the cache folder '{folder}' is not used, because {remedy_of(folder)}", CacheWarning)
    return None


def remedy_of(folder: Path) -> str:
    """Return why a folder is not used, and what to do."""
    reason = exposed(folder)
    remedy = f"chmod go-w '{folder}', or name" if "write" in reason else "name"
    return f"{reason}, and its contents are executed: {remedy} another folder in {CACHE_VARIABLE}"


def make_folder(folder: Path) -> None:
    """Create a folder that only this user may write to, whatever the umask; OSError if that fails."""
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)


def exposed(path: Path) -> str:
    """Return why users other than this one and root may write to a path; empty if they may not."""
    if os.name != "posix":
        return ""
    try:
        status = path.stat()
    except OSError:
        return ""
    if status.st_uid not in (os.geteuid(), 0):
        return f"it belongs to the user number {status.st_uid}, not to you ({os.geteuid()}) or root"
    if status.st_mode & stat.S_IWOTH:
        return "every user of this machine may write to it"
    return "every user of its group may write to it" if status.st_mode & stat.S_IWGRP else ""


def size_limit() -> int:
    """Return the maximum total size of the entries in bytes, 0 for no limit; BuildError if the variable is no size."""
    setting = os.environ.get(SIZE_VARIABLE) or DEFAULT_SIZE
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?", setting.strip(), re.IGNORECASE)
    if match is None:
        raise BuildError(
            f"the environment variable {SIZE_VARIABLE} is {setting!r}: it must be a size, as in 500M or 2G, or 0 for "
            "no limit"
        )
    return int(float(match[1]) * UNITS[match[2].upper()])


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheInfo:
    """Contents of the cache.

    Attributes:
        folder: path of the cache folder.
        integrators, texts, references: numbers of compiled integrators, generated texts and reference solutions.
        size: their total size in bytes.
        limit: maximum total size in bytes, 0 for no limit.
    """

    folder: Path
    integrators: int
    texts: int
    references: int
    size: int
    limit: int

    def __repr__(self) -> str:
        return f"CacheInfo(folder='{self.folder}', integrators={self.integrators}, size={self.size})"

    def __str__(self) -> str:
        limit = f"of {_readable(self.limit)}" if self.limit else "without a limit"
        return (
            f"{self.folder}\n"
            f"{self.integrators} compiled integrators, {self.texts} generated texts, "
            f"{self.references} reference solutions: {_readable(self.size)} {limit} ({SIZE_VARIABLE})"
        )


def cache_info() -> CacheInfo:
    """Return the current contents of the cache. Raises as :func:`size_limit`."""
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
    """Remove all entries, and unfinished entries of processes killed long ago. Returns the number of bytes freed."""
    folder = cache_folder()
    entries = list(_entries(folder))
    freed = sum(map(_size, entries))
    for path in entries:
        discard(path)
    _remove_unfinished(folder)
    return freed


def touch(entry: Path) -> None:
    """Record the use of an entry."""
    with suppress(OSError):
        os.utime(entry)


def make_room(folder: Path, newest: Path) -> None:
    """Remove the least recently used entries until all fit the limit, except the ``newest``.

    Entries are counted only if this one may exceed what was left uncounted.
    """
    limit = size_limit()
    left = _uncounted.get((folder, limit), 0.0) - _size(newest)
    if left <= 0.0:
        _remove_unfinished(folder)
        left = (limit - _fit(folder, newest, limit)) * UNCOUNTED_SHARE if limit else float("inf")
    _uncounted[folder, limit] = left


def _fit(folder: Path, newest: Path, limit: int) -> int:
    """Remove entries if they exceed the limit, so that some room is left; return the bytes of the remaining ones."""
    entries = [(_last_use(path), _size(path), path) for path in _entries(folder) if path != newest]
    total = _size(newest) + sum(size for _, size, _ in entries)
    allowed = limit if total <= limit else FILLED * limit
    for _, size, path in sorted(entries):
        if total <= allowed:
            break
        discard(path)
        total -= size
    return total


def discard(entry: Path) -> None:
    """Remove an entry, after renaming it, so that other processes find it either complete or missing."""
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
    """Return the time of the last use, 0 for a path that no longer exists."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _size(path: Path | os.DirEntry[str]) -> int:
    """Return the bytes of a file, or of all files in a folder, which others may be removing."""
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


def cached_source(key: Sequence[str], make: Callable[[], str]) -> str:
    """Return the result of ``make`` for this key, from the cache if it was made before."""
    if trusted_folder() is None:
        return make()
    text = stored_text(key)
    if text is None:
        text = make()
        store_text(key, text)
    return text


def stored_text(key: Sequence[str]) -> str | None:
    """Return the text stored under this key; ``None`` if there is none, or others may write to the folder."""
    return None if exposed(cache_folder()) else _read(_path(key))


def store_text(key: Sequence[str], text: str) -> None:
    """Store a text under this key, unless others may write to the folder."""
    if not exposed(folder := cache_folder()):
        _write(_path(key), text)
        make_room(folder, _path(key))


def _path(key: Sequence[str]) -> Path:
    return cache_folder() / "texts" / f"{_digest(chr(0).join([*key, _generator()]))[:32]}.json"


@cache
def _generator() -> str:
    """Return the version of this package, to the file, and of SymPy, which orders terms."""
    sympy = find_spec("sympy")  # does not import it
    release = Path(sympy.origin).with_name("release.py").read_text(encoding="utf-8") if sympy and sympy.origin else ""
    return "\n".join([*sorted([*_files(PACKAGE, ".py"), *_files(template_folder(), "")]), f"sympy {release}"])


def _files(folder: str | os.PathLike[str], suffix: str) -> Iterator[str]:
    """Yield path, size and time of each file below a folder whose name has this suffix."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _files(entry, suffix)
            elif entry.name.endswith(suffix):
                yield f"{entry.path} {(stat := entry.stat()).st_size} {stat.st_mtime_ns}"


def _read(path: Path) -> str | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        text = record["text"]
        if record["sha256"] != _digest(text) or exposed(path):
            return None
        touch(path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return str(text)


def _write(path: Path, text: str) -> None:
    record = json.dumps({"sha256": _digest(text), "text": text})
    with suppress(OSError):
        make_folder(path.parent.parent)
        make_folder(path.parent)
        write_text(path, record)
        path.chmod(path.stat().st_mode & ~0o022)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def identity(expression: sympy.Basic) -> str:
    """Return text that identifies an expression uniquely.

    Each line is a subexpression that refers to its arguments by line numbers. Arguments are in SymPy's order, the same
    in all processes; ``sympy.srepr`` sorts them again, which takes longer than to differentiate a sum of thousands.

    >>> from sympy.abc import x
    >>> print(identity((x + 1)**2))
    Integer(1)
    Symbol('x')
    Add(0, 1)
    Integer(2)
    Pow(2, 3)
    """
    from sympy import srepr

    numbers: dict[sympy.Basic, int] = {}
    lines: list[str] = []

    pending = [expression]
    while pending:
        part = pending[-1]
        missing = [argument for argument in part.args if argument not in numbers]
        if missing:
            pending += reversed(missing)
            continue
        pending.pop()
        if part not in numbers:
            inner = ", ".join([str(numbers[argument]) for argument in part.args])
            lines.append(f"{type(part).__name__}({inner})" if part.args else srepr(part))
            numbers[part] = len(lines) - 1
    return "\n".join(lines)


def key_of(value: Any) -> str:
    """Return text that differs for different values: a dataclass by its type and all of its fields.

    Cache keys are made from it, so that a new field cannot be forgotten. Fields excluded from comparisons are
    included.

    Raises:
        TypeError: for a value that is no dataclass, expression, number, text, ``None``, sequence or mapping.

    >>> key_of((1, 1.0, "1", None))
    "(1, 1.0, '1', None)"
    """
    if is_dataclass(value) and not isinstance(value, type):
        named = ", ".join(f"{field.name}={key_of(getattr(value, field.name))}" for field in fields(value))
        return f"{type(value).__module__}.{type(value).__qualname__}({named})"
    if "sympy" in sys.modules and isinstance(value, sys.modules["sympy"].Basic):
        return repr(identity(value))
    if hasattr(value, "_mpf_"):
        return f"mpf{value._mpf_}"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key_of(name)}: {key_of(item)}' for name, item in value.items())}}}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(key_of, value))})"
    if isinstance(value, float):
        return repr(float(value))
    if value is None or isinstance(value, bool | int | str):
        return repr(value)
    raise TypeError(f"a cache key cannot be made from a {type(value).__name__}: {value!r}")
