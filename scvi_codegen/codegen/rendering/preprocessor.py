"""Support headers as one integrator uses them: without alternatives and macros that belong to others.

Sources are compiled from the headers as they are. Packages, single files and pages of derivations are
read by people, and the preprocessor of a C compiler cannot make them: it also removes comments, names of constants and
conditions on the compiler and the processor, which only the reader's compiler can decide. Here conditions on names that
begin with ``_`` or ``SCVI_`` remain, as do those on macros that are defined under such a condition.
"""

from __future__ import annotations

import posixpath
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from scvi_codegen.codegen.rendering.c_text import Block, Branch, directive, nested, squeezed, words

Read = Callable[[str], str]
"""Function that returns the text of a support header by its name, ``support/...``."""

SUPPORT = "support/"
"""Folder of the support headers, from which the sources include them."""


def _support_name(line: str, folder: str) -> str | None:
    """Return the name of the support header that a line of a file in a folder includes, or ``None``."""
    if not line.startswith('#include "'):
        return None
    name = line.split('"')[1]
    is_beside = folder and (name.startswith("../") or "/" not in name)  # others are those of libraries
    return posixpath.normpath(posixpath.join(folder, name)) if is_beside or name.startswith(SUPPORT) else None


def included(code: str, read: Read) -> tuple[tuple[str, str], ...]:
    """Return names and texts of the support headers that a source includes under any condition, in order."""
    texts: dict[str, str] = {}

    def visit(text: str, folder: str) -> None:
        for line in text.split("\n"):
            name = _support_name(line, folder)
            if name is not None and name not in texts:
                texts[name] = read(name)
                visit(texts[name], posixpath.dirname(name))

    visit(code, "")
    return tuple(texts.items())


@dataclass
class _Macros:
    """Macros after the lines so far.

    Attributes:
        defined: names of those that are defined.
        uncertain: names of those that are defined under conditions that remain.
        failed: whether the lines end the compilation by ``#error``.
    """

    defined: set[str] = field(default_factory=set)
    uncertain: set[str] = field(default_factory=set)
    failed: bool = False

    def copy(self) -> _Macros:
        return _Macros({*self.defined}, {*self.uncertain})

    def resumed(self, branch: _Macros | None) -> _Macros:
        """Return the macros where a branch begins whose condition remained before, when it ended with others."""
        certain = self.uncertain & branch.defined if branch else set()
        return _Macros(self.defined | certain, self.uncertain - certain)

    def holds(self, line: str) -> bool | None:
        """Return whether the condition of a line holds; ``None`` if unknown, as for comparisons of numbers."""
        word, condition = directive(line)
        if word == "else":
            return True
        if word in ("ifdef", "ifndef"):
            condition = f"{'!' * (word == 'ifndef')}defined({condition})"
        operator, decides = (" || ", True) if " || " in condition else (" && ", False)
        terms = [self._term(term) for term in condition.split(operator)]
        if decides in terms:
            return decides
        return None if None in terms else not decides

    def _term(self, term: str) -> bool | None:
        """Return whether a condition on one macro holds; ``None`` if unknown."""
        macro = term.removeprefix("!").removeprefix("defined(").removesuffix(")")
        if "defined(" not in term or macro in self.uncertain or macro.startswith(("_", "SCVI_")):
            return None
        return (macro in self.defined) != term.startswith("!")


def _joined(ends: Sequence[_Macros]) -> _Macros:
    """Return the macros after alternatives of which any was compiled that does not fail."""
    compiled = [end for end in ends if not end.failed] or ends[:1]
    defined = set.intersection(*(end.defined for end in compiled))
    mentioned = set.union(*(end.defined | end.uncertain for end in compiled))
    return _Macros(defined, mentioned - defined, compiled[0].failed)


class _Preprocessor:
    """Lines that remain of a source and of the headers that it includes."""

    def __init__(self, code: str, read: Read) -> None:
        self._read, self._macros, self._ends = read, _Macros(), dict[str, _Macros]()
        self.lines = list(self._visit("", code))

    def _visit(self, folder: str, text: str) -> Iterator[str]:
        """Yield the lines of a text with headers inserted."""
        lines = (("directive" if line.startswith("#") else "code", line) for line in text.split("\n"))
        yield from self._block(nested(lines)[0], folder)

    def _block(self, block: Block, folder: str) -> Iterator[str]:
        for part in block:
            if isinstance(part, list):
                yield from self._conditional(part, folder)
                continue
            _, line = part
            word, rest = directive(line)
            if word in ("define", "undef"):
                macro = rest.split("(")[0].split()[0]
                self._macros.uncertain.discard(macro)
                (self._macros.defined.add if word == "define" else self._macros.defined.discard)(macro)
            self._macros.failed |= word == "error"
            header = _support_name(line, folder)
            if header is None:
                yield line
            else:
                yield from self._visit(posixpath.dirname(header), self._read(header).removesuffix("\n"))

    def _conditional(self, alternatives: Sequence[Branch], folder: str) -> Iterator[str]:
        before, ends, holds = self._macros, list[_Macros](), None
        for alternative in alternatives:
            holds = before.holds(alternative.line)
            if holds is False:
                continue
            if holds and not ends:
                yield from self._block(alternative.block, folder)
                return
            line = "#else" if holds else alternative.line
            if not ends and alternative is not alternatives[0]:
                line = f"#if {directive(line)[1]}"
            yield line
            self._macros = before.copy() if ends else before.resumed(self._ends.get(line))
            yield from self._block(alternative.block, folder)
            if not ends:
                self._ends[line] = self._macros
            ends.append(self._macros)
            if holds:
                break
        if ends:
            yield "#endif"
            self._macros = _joined(ends if holds else [*ends, before])


def preprocessed(code: str, read: Read) -> str:
    """Return a source with support headers inserted, without known conditions and macros that nothing uses."""
    lines = _Preprocessor(code, read).lines
    directives = {line: directive(line) for line in lines if line.startswith("#define ")}
    switches = {line: name for line, (_, name) in directives.items() if name.isidentifier()}
    used = words("\n".join(line for line in lines if line not in switches))
    kept = (line for line in lines if line not in switches or switches[line] in used)
    return squeezed("\n".join(kept).rstrip() + "\n")
