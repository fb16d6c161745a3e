"""Generated folders: written completely, without overwriting edited files or files of others unless forced."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any

from scvi_codegen.errors import PackageError
from scvi_codegen.files.atomic import write_atomically

__all__ = ["CERTIFICATE_FILE", "FORMAT", "INTERFACE_FILE", "record_text", "write_folder"]

INTERFACE_FILE, CERTIFICATE_FILE = "interface.json", "certificate.json"
FORMAT = 1
FILE_NAME = re.compile(r"(support/)?[\w.]+")


def write_folder(target: Path, texts: Mapping[str, str], *, force: bool) -> None:
    """Write texts by file name; checksums in ``interface.json`` tell what may be overwritten. Raises PackageError."""
    try:
        target.mkdir(parents=True, exist_ok=True)
        stale = _stale(target, texts)
        if not force:
            _refuse_to_lose(target, texts, stale)
        for name in stale:
            (target / name).unlink(missing_ok=True)
        for name, text in texts.items():
            (target / name).parent.mkdir(exist_ok=True)
            write_atomically(target / name, partial(_write, text))
    except OSError as error:
        raise PackageError(f"{error.filename or target} cannot be written: {error.strerror or error}") from error


def record_text(texts: Mapping[str, str], **described: Any) -> str:
    """Return the text of ``interface.json``: checksums of files, and further entries."""
    files = {name: _checksum(text.encode()) for name, text in texts.items()}
    return json.dumps({"format": FORMAT, **described, "files": files}, indent=1) + "\n"


def _write(text: str, file: IO[bytes]) -> None:
    file.write(text.encode())


def _checksum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _stale(folder: Path, texts: Mapping[str, str]) -> list[str]:
    """Return obsolete files of an older integrator, including its verification report unless the code is unchanged."""
    known = _recorded(folder)
    if known is None:
        return []
    same = all(known.get(name) == _checksum(text.encode()) for name, text in texts.items() if name != INTERFACE_FILE)
    return [
        *([] if same else [CERTIFICATE_FILE]),
        *(name for name in known if name not in texts and FILE_NAME.fullmatch(name)),
    ]


def _refuse_to_lose(folder: Path, texts: Mapping[str, str], stale: Sequence[str]) -> None:
    """Raise :class:`PackageError` if a file to be replaced or removed was edited or not generated."""
    known = _recorded(folder)
    for name, text in ({name: "" for name in stale if name != CERTIFICATE_FILE} | dict(texts)).items():
        try:
            found = _checksum((folder / name).read_bytes())
        except FileNotFoundError:
            continue
        if name == INTERFACE_FILE:
            ours = known is not None
        else:
            ours = found in (_checksum(text.encode()), (known or {}).get(name))
        if not ours:
            raise PackageError(
                f"{folder / name} was edited, or not written by this program: move it away, choose another folder, "
                "or overwrite it with --force (from Python: force=True)"
            )


def _recorded(folder: Path) -> dict[str, str] | None:
    """Return checksums by file name from ``interface.json``, or ``None`` if it is missing or not generated."""
    try:
        record = json.loads((folder / INTERFACE_FILE).read_text(encoding="utf-8"))
        files = record["files"] if isinstance(record["format"], int) else None
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return None
    return files if isinstance(files, dict) else None
