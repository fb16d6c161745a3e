"""Names at file scope with the integrator's prefix, so that one translation unit can include several single files.

C has no other means to hide macros, types and enumerators of an included file. Which names a source has is read by
:mod:`~scvi_codegen.codegen.rendering.c_text`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

from scvi_codegen.codegen.rendering.c_text import definitions, macros_of, names_of, pieces, renamed, squeezed, words
from scvi_codegen.codegen.rendering.text import CONTINUATION, WIDTH, wrapped_prototype

BREAK = re.compile(r'(?:[^" ]|"(?:\\.|[^"\\])*")+ ')
"""Text that no line break may divide, and the place behind it."""


def with_distinct_names(texts: Mapping[str, str], header: str, prefix: str) -> dict[str, str]:
    """Return texts whose own names are none of those they export, as ``finish_step`` of an integrator ``finish``."""
    starts = f"{prefix}_", f"{prefix.upper()}_"
    macros = {name for name, _ in definitions(header)}.union(starts)  # with the prefix in the code, too
    having = (text for text in texts.values() if any(start in text for start in starts))
    if not any(name.startswith(starts) for text in having for name in words(text) - macros):
        return dict(texts)
    exported = {name for name in words(header) - macros if name.startswith(starts[0])}
    exported |= {_exported(name, prefix) for text in texts.values() for name in words(text) if name.endswith(")")}
    distinct = {name: f"{'LOCAL' if name.isupper() else 'local'}_{name}" for name in exported}
    return {file: renamed(text, distinct) for file, text in texts.items()}


def with_exported_names(texts: Mapping[str, str]) -> dict[str, str]:
    """Return the files of a source with exported names in place of the macros that make them."""
    exported = exported_names(texts.values())
    heads = tuple(f"#define {name}" for name in ("NAME(word)", "STATUS(word)"))
    files = {}
    for file, code in texts.items():
        plain = renamed("\n".join(line for line in code.split("\n") if not line.startswith(heads)), exported)
        files[file] = squeezed(_wrapped("\n".join(line for line in plain.split("\n") if not _is_vain(line))))
    return files


def exported_names(texts: Iterable[str]) -> dict[str, str]:
    """Return the exported name of each ``NAME(word)`` or ``STATUS(word)`` in the texts, by the macro in one of them."""
    texts = [*texts]
    macro = next((macros["NAME(word)"] for macros in map(macros_of, texts) if "NAME(word)" in macros), None)
    prefix = macro.body[0].removesuffix("_") if macro else ""
    return {name: _exported(name, prefix) for text in texts for name in words(text) if name.endswith(")")}


def _exported(name: str, prefix: str) -> str:
    """Return the exported name ``NAME(word)`` or ``STATUS(word)``."""
    macro, word = name.removesuffix(")").split("(")
    return f"{prefix if macro == 'NAME' else prefix.upper()}_{word}"


def _is_vain(line: str) -> bool:
    """Return whether a line gives a type the name that it has, as ``solver_options`` of the integrator ``solver``."""
    return line.startswith("typedef ") and len(line.split()) == 3 and line.split()[1] + ";" == line.split()[2]


def with_own_names(code: str, prefix: str, header: str) -> str:
    """Return a source whose macros and names at file scope begin with the prefix of the integrator.

    Args:
        code: of one file, without include guards and macros of exported names.
        prefix: of its own names; exported ones may have another, of the integrator that it belongs to.
        header: included by the code; its names are retained.
    """
    taken = words(header) | words(code)
    names = {}
    for name in names_of(code, macros_of(code)):
        if not name.lower().startswith(f"{prefix.lower()}_"):
            upper, local = (prefix.upper(), "LOCAL") if name.isupper() else (prefix, "local")
            names[name] = f"{upper}_{name}" if f"{upper}_{name}" not in taken else f"{upper}_{local}_{name}"
    return _wrapped(renamed(code, names))


def _wrapped(code: str) -> str:
    """Return a source whose lines have changed lengths with those that are too long broken."""
    broken = "\n".join(_broken([line for _, text in pieces(code) for line in _laid_out(text).split("\n")]))
    aligned = (_aligned(text) if kind == "directive" and "\\\n" in text else text for kind, text in pieces(broken))
    return "\n".join(aligned) + "\n"


def _laid_out(text: str) -> str:
    """Return a declaration with the head of a function on as few lines as it needs."""
    head, bracket, body = text.partition("\n{")
    if not bracket or not head.endswith(")") or any(token in head for token in ';{}#/"'):
        return text
    return wrapped_prototype(" ".join(head.split()).replace("( ", "(")) + bracket + body


def _aligned(macro: str) -> str:
    """Return the lines of a macro with the backslashes at their ends in one column."""
    lines = macro.split("\n")
    width = max(len(line[:-1].rstrip()) for line in lines if line.endswith("\\")) + 1
    return "\n".join(f"{line[:-1].rstrip():{width}}\\" if line.endswith("\\") else line for line in lines)


def _broken(lines: Sequence[str]) -> Iterator[str]:
    """Yield lines, those that are too long broken between words of code or of its comment."""
    for before, line in pairwise(["", *lines]):
        indent = " " * (len(line) - len(line.lstrip()) + CONTINUATION)
        end = " \\" if line.startswith("#") or before.endswith("\\") else ""
        while len(line) > WIDTH:
            words = BREAK.finditer(line.removesuffix(" */"))
            ends = [match.end() for match in words if len(indent) < match.end() < WIDTH]
            if not ends:
                break
            first, line = line[: ends[-1] - 1], line[ends[-1] :]
            commented = first.rfind("/*") > first.rfind("*/")
            yield first + ("" if commented else end)
            line = f"{indent}{' * ' if commented else ''}{line}"
        yield line
