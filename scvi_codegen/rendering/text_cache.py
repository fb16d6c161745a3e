"""Generated texts, kept beside the compiled ones: what was derived once is not derived again.

The name of an entry is made from everything the text depends on: the system, the method, the solver, and the generator
itself, of which the sizes and times of all files are taken. An entry that cannot be read or written, or is not what its
checksum says, is no error: the text is then made anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import TypeAlias

import sympy

from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.files.cache import exposed, make_folder, make_room, touch, trusted_folder
from scvi_codegen.files.templates import PACKAGE, template_folder
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.rendering.source import Interface, Source

__all__ = ["Texts", "remembered_texts"]

Texts: TypeAlias = tuple[Source, Interface, Source | None]
"""An integrator, its interface, and its ensemble if it has one."""


def remembered_texts(
    system: MechanicalSystem, method: Method, options: Sequence[object], make: Callable[[], Texts]
) -> Texts:
    """What ``make`` returns for these arguments, from the cache if it was made before."""
    folder = trusted_folder()
    if folder is None:
        return make()
    path = folder / "texts" / f"{_key(system, method, options)}.json"
    found = _read(path)
    if found is None:
        found = make()
        _write(path, found)
        make_room(folder, path)
    return found


def _key(system: MechanicalSystem, method: Method, options: Sequence[object]) -> str:
    symbols = (*system.coordinates, *system.auxiliaries, *system.parameters, system.time)
    parts = [
        system.name,
        sympy.srepr(system.formula),
        " ".join(symbol.name for symbol in symbols),
        repr((len(system.coordinates), len(system.auxiliaries), system.defaults)),
        repr(method),
        repr(tuple(map(str, options))),
        _generator(),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


@cache
def _generator() -> str:
    """Which version of this package, to the file, and of SymPy, which orders terms."""
    files = sorted([*PACKAGE.rglob("*.py"), *template_folder().rglob("*.jinja")])
    lines = [f"{path} {(stat := path.stat()).st_size} {stat.st_mtime_ns}" for path in files]
    return "\n".join([*lines, f"sympy {sympy.__version__}"])


def _read(path: Path) -> Texts | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["sha256"] != _checksum(record["entry"]) or exposed(path):
            return None
        entry = json.loads(record["entry"])
        touch(path)
        ensemble = entry["ensemble"]
        source, interface = Source(**entry["source"]), Interface.from_json(entry["interface"])
        return source, interface, None if ensemble is None else Source(**ensemble)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _write(path: Path, texts: Texts) -> None:
    source, interface, ensemble = texts
    entry = {
        "source": asdict(source),
        "interface": interface.to_json(),
        "ensemble": None if ensemble is None else asdict(ensemble),
    }
    text = json.dumps(entry)
    record = json.dumps({"sha256": _checksum(text), "entry": text})
    with suppress(OSError):
        make_folder(path.parent.parent)
        make_folder(path.parent)
        write_atomically(path, lambda file: file.write(record.encode()))
        path.chmod(path.stat().st_mode & ~0o022)


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
