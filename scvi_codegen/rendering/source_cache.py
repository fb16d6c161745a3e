"""Cache of generated sources, next to the compiled ones.

The name of an entry is a digest of everything the source depends on: the parts of a key that the caller passes, and the
generator itself, represented by sizes and times of all files. An entry that cannot be read or written, or does not
match its checksum, is no error: the source is generated again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import sympy

from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.files.cache import exposed, make_folder, make_room, touch, trusted_folder
from scvi_codegen.files.templates import PACKAGE, template_folder

__all__ = ["cached_source"]


def cached_source(key: Sequence[str], make: Callable[[], str]) -> str:
    """Return the result of ``make`` for this key, from the cache if it was made before."""
    folder = trusted_folder()
    if folder is None:
        return make()
    path = folder / "texts" / f"{_digest(chr(0).join([*key, _generator()]))[:32]}.json"
    found = _read(path)
    if found is None:
        found = make()
        _write(path, found)
        make_room(folder, path)
    return found


@cache
def _generator() -> str:
    """Return the version of this package, to the file, and of SymPy, which orders terms."""
    files = sorted([*PACKAGE.rglob("*.py"), *filter(Path.is_file, template_folder().rglob("*"))])
    lines = [f"{path} {(stat := path.stat()).st_size} {stat.st_mtime_ns}" for path in files]
    return "\n".join([*lines, f"sympy {sympy.__version__}"])


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
