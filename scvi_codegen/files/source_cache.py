"""Cache of generated sources, next to the compiled ones.

The name of an entry is a digest of everything the source depends on: the parts of a key that the caller passes, and the
generator itself, represented by sizes and times of all files. An entry that cannot be read or written, or does not
match its checksum, is no error: the source is generated again.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.files.cache import cache_folder, exposed, make_folder, make_room, touch, trusted_folder
from scvi_codegen.files.templates import PACKAGE, template_folder


def cached_source(key: Sequence[str], make: Callable[[], str]) -> str:
    """Return the result of ``make`` for this key, from the cache if it was made before."""
    if trusted_folder() is None:
        return make()
    found = stored_text(key)
    if found is None:
        found = make()
        store_text(key, found)
    return found


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
        write_atomically(path, lambda file: file.write(record.encode()))
        path.chmod(path.stat().st_mode & ~0o022)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
