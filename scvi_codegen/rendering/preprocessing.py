"""Partial preprocessing of generated C: includes of support headers, and conditions on macros that the source defines.

The result is one text without include guards, macros and alternatives that the source does not use. Conditions on the
compiler, the processor or options of compilation (names that begin with ``_`` or ``SCVI_``) remain.
"""

from __future__ import annotations

import operator
import posixpath
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

DIRECTIVE = re.compile(r"#(?P<word>ifdef|ifndef|if|elif|else|endif|define|undef|include|error)\b *(?P<rest>.*)$")
DEFINED = re.compile(r"(?P<negated>!)?defined\((?P<macro>\w+)\)")
COMPARED = re.compile(r"(?P<left>\w+)(?: (?P<sign>[<>=!]=|[<>]) (?P<right>\w+))?")
OWN = re.compile(r'"(?:\.\./\w+/)?\w+\.h"')
"""Headers of the same or of a sibling folder; others, as of XLA, are those of libraries."""
SUPPORT = re.compile('"support/')
SWITCH = re.compile(r"#define (?P<macro>\w+)(?: /\*.*\*/)?")
COMMENT = re.compile(r" *(?://.*|/\*.*)$")
COMMENTS = re.compile(r"/\*.*?\*/", re.DOTALL)
SIGNS: dict[str, Callable[[int, int], bool]] = {
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


@dataclass
class _Macros:
    """Macros after the lines so far.

    Attributes:
        values: of those that are defined, ``None`` for unknown.
        uncertain: names of those that are defined under conditions that remain.
        failed: whether the lines end the compilation by ``#error``.
    """

    values: dict[str, str | None] = field(default_factory=dict)
    uncertain: set[str] = field(default_factory=set)
    failed: bool = False

    def copy(self) -> _Macros:
        return _Macros(dict(self.values), set(self.uncertain))

    def joined(self, other: _Macros) -> _Macros:
        """Return the macros after alternatives of which either was compiled."""
        if self.failed or other.failed:
            return other if self.failed else self
        both = {name: v if v == other.values[name] else None for name, v in self.values.items() if name in other.values}
        return _Macros(both, (self.values.keys() | other.values | self.uncertain | other.uncertain) - both.keys())

    def resume(self, branch: _Macros | None) -> None:
        """Continue a branch whose condition was opened before: macros that are uncertain are as at its end."""
        for name in self.uncertain & branch.values.keys() if branch else ():
            self.uncertain.discard(name)
            self.values[name] = branch.values[name] if branch else None

    def is_defined(self, name: str) -> bool | None:
        """Return whether a macro is defined; ``None`` if that is not known here."""
        if name in self.uncertain or name.startswith(("_", "SCVI_")):
            return None
        return name in self.values

    def integer(self, word: str) -> int | None:
        """Return the value of a word of a condition, if it is known."""
        while not word.isdecimal():
            value = self.values.get(word)
            if value is None:
                return None
            word = value
        return int(word)

    def holds(self, word: str, condition: str) -> bool | None:
        """Return whether the condition of ``#if``, ``#ifdef``, ``#ifndef`` or ``#elif`` holds; ``None`` if unknown."""
        if word in ("ifdef", "ifndef"):
            defined = self.is_defined(condition)
            return defined if defined is None else defined == (word == "ifdef")
        if match := DEFINED.fullmatch(condition):
            defined = self.is_defined(match["macro"])
            return defined if defined is None else defined != bool(match["negated"])
        match = COMPARED.fullmatch(condition)
        left = self.integer(match["left"]) if match else None
        right = self.integer(match["right"] or "0") if match else None
        if match is None or left is None or right is None:
            return None
        return SIGNS[match["sign"] or "!="](left, right)


@dataclass
class _Chain:
    """Open condition with its alternatives.

    Attributes:
        active: whether the present alternative is compiled; ``None`` if that remains a condition.
        chosen: whether an earlier alternative, or the present one, is compiled for certain.
        before: macros before the alternatives that remain conditions.
        after: macros after those so far.
        opened: line of the first alternative.
    """

    active: bool | None
    chosen: bool
    before: _Macros
    opened: str
    after: _Macros | None = None


class _Preprocessor:
    def __init__(self, read: Callable[[str], str]) -> None:
        self.read = read
        self.files: dict[str, str] = {}
        self.macros = _Macros()
        self.chains: list[_Chain] = []
        self.branches: dict[str, _Macros] = {}

    def lines(self, text: str, folder: str) -> Iterator[str]:
        for line in text.split("\n"):
            match = DIRECTIVE.match(line)
            word, rest = (match["word"], match["rest"]) if match else ("", "")
            if word in ("if", "ifdef", "ifndef", "elif", "else", "endif"):
                yield from self.condition(word, COMMENT.sub("", rest), line)
            elif not any(chain.active is False for chain in self.chains):
                if word in ("define", "undef"):
                    self.define(word, rest)
                self.macros.failed |= word == "error"
                if word == "include" and (OWN if folder else SUPPORT).match(rest):
                    yield from self.include(posixpath.normpath(posixpath.join(folder, rest.strip('"'))))
                else:
                    yield line

    def define(self, word: str, rest: str) -> None:
        name, value = re.split(r"\b", COMMENT.sub("", rest) + " ", maxsplit=2)[1:]
        self.macros.uncertain.discard(name)
        self.macros.values.pop(name, None)
        if word == "define":
            self.macros.values[name] = value.strip() if re.fullmatch(r" +\w+", value) else None

    def include(self, name: str) -> Iterator[str]:
        if name not in self.files:
            self.files[name] = self.read(name)
        yield from self.lines(self.files[name].removesuffix("\n"), posixpath.dirname(name))

    def condition(self, word: str, rest: str, line: str) -> Iterator[str]:
        if word == "endif":
            chain = self.chains.pop()
            if chain.after is not None or chain.active is None:
                self.macros = self.macros.joined(chain.after or chain.before)
                if not chain.chosen:
                    self.macros = self.macros.joined(chain.before)
                yield line
            return
        if word.startswith("if"):
            skipped = any(chain.active is False for chain in self.chains)
            holds = False if skipped else self.macros.holds(word, rest)
            self.chains.append(_Chain(holds, skipped or holds is True, self.macros.copy(), line))
            if holds is None:
                self.macros.resume(self.branches.get(line))
                yield line
            return
        chain = self.chains[-1]
        undecided = chain.active is None or chain.after is not None
        if undecided and chain.active is not False:
            self.branches[chain.opened] = self.macros.copy()
            chain.after = self.macros.joined(chain.after) if chain.after else self.macros
        self.macros = chain.before.copy() if undecided else self.macros
        holds = False if chain.chosen else word == "else" or self.macros.holds(word, rest)
        if undecided and holds is not False:  # it stays an alternative of conditions that remain
            chain.active, chain.chosen = None, holds is True
            yield "#else" if holds else line
        elif holds is None:  # the first condition that remains
            chain.active = None
            yield f"#if {rest}"
        else:
            chain.active, chain.chosen = holds, chain.chosen or holds


def preprocessed(text: str, read: Callable[[str], str]) -> tuple[str, dict[str, str]]:
    """Return a source with support headers inserted and known conditions resolved; and these headers, in order.

    Args:
        text: of a file in the folder that contains the folder ``support``.
        read: returns the text of a support header by its name, ``support/...``.
    """
    work = _Preprocessor(read)
    lines = list(work.lines(text, ""))
    rest = COMMENTS.sub("", "\n".join(line for line in lines if not SWITCH.fullmatch(line)))
    used = set(re.findall(r"\w+", rest))
    kept = [line for line in lines if not ((switch := SWITCH.fullmatch(line)) and switch["macro"] not in used)]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(kept).rstrip() + "\n"), work.files
