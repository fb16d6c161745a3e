"""A folder with everything one integrator needs: C for C programs, an importable package for Python.

    pendulum_svi/  pendulum_svi.h  pendulum_svi.c   the integrator, C99
                   main.c  Makefile                 ``make run`` runs the example with a C compiler and libm
                   __init__.py  interface.json      ``import pendulum_svi`` gives ``pendulum_svi.stepper``
                   model.toml  README.md            what it was made from, and how to use it

The folder's name begins every C name. Importing it compiles the C text once, as it stands there, and never needs SymPy.
``interface.json`` also records a checksum of each file, so that a file edited since is not overwritten unasked.
"""

from __future__ import annotations

import hashlib
import json
import keyword
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scvi_codegen.errors import ModelFileError, ScviCodegenError
from scvi_codegen.source import Interface, Source
from scvi_codegen.stepper import Stepper
from scvi_codegen.trajectory import write_atomically

if TYPE_CHECKING:
    from scvi_codegen.model_file import Model
    from scvi_codegen.rendering import ExampleRun

__all__ = ["PackageError", "generate_package", "load_package"]

INTERFACE_FILE = "interface.json"
FORMAT = 1
OUTPUTS = 20
LONGEST_PREFIX = 64
C_HEADERS = frozenset(
    """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef stdint
    stdio stdlib string tgmath time wchar wctype
    """.split()  # noqa: SIM905  (a paragraph of words reads better than twenty quoted ones)
)
"""Folder names whose header would hide one of the standard library's."""

OTHER_NAMES = frozenset({"main", "scvi_codegen", "numpy", "cffi", "platformdirs"})
"""Folder names that would collide with ``main.c`` or hide what the package imports."""


class PackageError(ScviCodegenError, ValueError):
    """A folder that cannot hold a generated package, or holds none."""


def generate_package(model: Model, folder: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the integrator of a model into a folder, made if it is missing; other files in it are left alone.

    Args:
        model: system, method, and the initial state and step of the example.
        folder: where to; its name becomes the prefix of the C names and the name of the Python package.
        force: overwrite files of the same names that were edited or written by someone else.

    Returns:
        The folder.

    Raises:
        PackageError: if the folder's name does not serve, it cannot be written, or a file in it would be lost.
        BuildError: if the initial velocities are to be turned into momenta and there is no C compiler.
    """
    target = Path(folder)
    prefix = _prefix(target)
    texts = _texts(model, prefix)
    try:
        target.mkdir(parents=True, exist_ok=True)
        if not force:
            _refuse_to_lose(target, texts)
        for name, text in texts.items():
            data = text.encode()
            write_atomically(target / name, lambda file, data=data: file.write(data))  # type: ignore[misc]
    except OSError as error:
        raise PackageError(f"{error.filename or target} cannot be written: {error.strerror or error}") from error
    return target


def load_package(folder: str | os.PathLike[str]) -> Stepper:
    """The stepper of a generated folder, compiled from the C text in it (from the cache if that is unchanged).

    Raises:
        PackageError: if the folder lacks a file or was written by another version.
        BuildError: without a C compiler, or if it refuses the text.
    """
    target = Path(folder)
    try:
        record = json.loads((target / INTERFACE_FILE).read_text(encoding="utf-8"))
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise PackageError(f"{target / INTERFACE_FILE} has another format: generate the folder again")
        interface = Interface.from_json(json.dumps(record["interface"]))
        header, code = ((target / f"{interface.prefix}.{kind}").read_text(encoding="utf-8") for kind in "hc")
        declarations = "\n".join(record["declarations"])
    except OSError as error:
        raise PackageError(f"{target} is not a generated package: {error.filename}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, PackageError):
            raise
        raise PackageError(f"{target / INTERFACE_FILE} is damaged ({error!r}): generate the folder again") from error
    return Stepper(Source(prefix=interface.prefix, header=header, code=code, declarations=declarations), interface)


def _prefix(folder: Path) -> str:
    """The name of the folder, fit to begin C names and to be imported."""
    from scvi_codegen.compiler import c_identifier  # here, because it imports SymPy

    name = folder.resolve().name
    cleaned = c_identifier(name)
    if name != cleaned:
        raise PackageError(
            f"the folder's name begins every C name and is the name of the Python package; '{name}' does not serve "
            f"(lower-case letters, digits and underscores, at most {LONGEST_PREFIX}): call it '{cleaned}'"
        )
    if keyword.iskeyword(name) or name in sys.stdlib_module_names or name in C_HEADERS | OTHER_NAMES:
        raise PackageError(f"'{name}' has a meaning in C or Python: call the folder '{name}_integrator'")
    return name


def _texts(model: Model, prefix: str) -> dict[str, str]:
    """Text by file name, ``interface.json`` last."""
    from scvi_codegen.compiler import describe
    from scvi_codegen.lowering import lower
    from scvi_codegen.model_file import dump_model
    from scvi_codegen.rendering import render, render_example, render_package

    program = lower(model.system, model.method, prefix=prefix)
    source, interface = render(program), describe(program, model.system, model.method)
    texts = {f"{prefix}.h": source.header, f"{prefix}.c": source.code}
    texts |= render_example(program, _example(model, Stepper(source, interface)))
    texts |= _package_texts(interface)
    try:
        texts["model.toml"] = dump_model(model)
    except ModelFileError:
        texts["model.toml"] = ""
    return {**texts, INTERFACE_FILE: _interface_text(source, interface, texts)}
