"""Generated folders as they are read: their prefix, their record and the C code in them."""

from __future__ import annotations

import json
import keyword
import os
import sys
from pathlib import Path
from typing import Any

from scvi_codegen.errors import PackageError
from scvi_codegen.models.packages.folders import FORMAT, INTERFACE_FILE
from scvi_codegen.rendering.source import PREFIX, Source, included

OTHER_NAMES = frozenset({"main", "scvi_codegen", "numpy", "cffi", "platformdirs"})
"""Folder names that would collide with ``main.c`` or shadow imports of the package."""


def read_record(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Return ``interface.json`` of a generated folder; raises as :func:`source_in`."""
    target = Path(folder)
    try:
        record = json.loads((target / INTERFACE_FILE).read_text(encoding="utf-8"))
    except OSError as error:
        raise PackageError(f"{target} is not a generated package: {error.filename}: {error.strerror}") from error
    except ValueError as error:
        raise damaged(target, error) from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise PackageError(f"{target / INTERFACE_FILE} has another format: generate the folder again")
    return record


def source_in(folder: Path, prefix: str) -> Source:
    """Return the C code in a generated folder.

    Raises:
        PackageError: if the folder lacks a file or was written by another version.
    """
    if not PREFIX.fullmatch(prefix):
        raise damaged(folder, ValueError(f"{prefix!r} is not a prefix of C names"))
    try:
        header, code = (_read(folder / f"{prefix}.{kind}") for kind in "hc")
        declarations = "\n".join(read_record(folder)["declarations"])
        support = included(code, lambda name: _read(folder / name))
    except OSError as error:
        raise PackageError(f"{folder} is not a generated package: {error.filename}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, PackageError):
            raise
        raise damaged(folder, error) from error
    return Source(prefix=prefix, header=header, code=code, declarations=declarations, support=support)


def damaged(folder: Path, error: Exception) -> PackageError:
    """Return the error for a folder whose record does not fit its C code."""
    return PackageError(f"{folder / INTERFACE_FILE} is damaged ({error!r}): generate the folder again")


def _read(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def prefix_of(folder: Path) -> str:
    """Return the name of the folder, validated as a prefix of C names and as a Python module."""
    from scvi_codegen.pipeline import (
        LONGEST_PREFIX,
        c_identifier,  # imported here: it imports SymPy
    )

    try:
        name = folder.resolve().name
        name.encode()
    except ValueError as error:
        raise PackageError(f"{str(folder)!r} cannot be the name of a folder: {error}") from error
    cleaned = c_identifier(name)
    if name != cleaned:
        raise PackageError(
            "the name of the folder must be a prefix of C names and a name of a Python package; "
            f"'{name}' is not (lower-case letters, digits and underscores, at most {LONGEST_PREFIX}): "
            f"use '{cleaned}'"
        )
    if keyword.iskeyword(name) or name in sys.stdlib_module_names or name in OTHER_NAMES:
        raise PackageError(f"'{name}' is reserved in C or Python: use '{name}_integrator' for the folder")
    return name
