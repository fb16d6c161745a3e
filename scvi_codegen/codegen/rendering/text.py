"""Text of C: lines of at most 120 characters, partial preprocessing, and names with the integrator's prefix.

**Preprocessing**: includes of support headers, and conditions on macros that the source defines. The result is one text
without include guards, macros and alternatives that the source does not use. Conditions on the compiler, the processor
or options of compilation (names that begin with ``_`` or ``SCVI_``) remain.

**Names** at file scope get the integrator's prefix, so that one translation unit can include several. This is not a C
parser: it relies on the layout of the templates, where a declaration at file scope begins in the first column.
"""

from __future__ import annotations

import operator
import posixpath
import re
import textwrap
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

TOLERANCE = 2.0**-52
"""Default relative update below which an iteration has converged: the round-off unit of binary64."""

MAX_ITERATIONS = 50
"""Default number of iterations after which a step fails: Newton's method takes 3 to 6, fixed-point iterations 5 to 20.
"""

ROUNDING_UNITS, INPUT_PRECISION, LARGEST_VIOLATION = 64.0, 1e-6, 1e-2
"""Limits of the constraint violation of an initial state, relative to its size.

Rounding, in units of it; precision of typed numbers, corrected silently; largest violation that is accepted.
"""


WIDTH = 120
CONTINUATION = 4
OPERATOR = re.compile(r" ([-+*/=]) ")
SHORT_SUM = re.compile(r"(?<=[-+*/] )\([^(),]{1,50}\)")


def table(declaration: str, rows: Sequence[str] | Sequence[Sequence[str]], *, braces: bool = True) -> str:
    """Return ``declaration = {...};`` of numbers, or of rows of numbers, in braces or not, on one line if they fit."""
    left, right = "{}" if braces else ("", "")
    braced = [row if isinstance(row, str) else f"{left}{', '.join(row)}{right}" for row in rows]
    line = f"{declaration} = {{{', '.join(braced)}}};"
    if len(line) <= WIDTH:
        return line
    lines = _entries(braced) if isinstance(rows[0], str) else _rows(braced)
    return "\n".join([f"{declaration} = {{", *lines]) + "};"


def _entries(braced: Sequence[str]) -> list[str]:
    """Return full lines of entries that are not broken."""
    joined = ", ".join(entry.replace(" ", "\0") for entry in braced)
    return [line.replace("\0", " ") for line in _lines(joined, "    ", "    ")]


def _rows(braced: Sequence[str]) -> list[str]:
    """Return one line per row, or several if it is too long."""
    lines: list[str] = []
    for k, row in enumerate(braced):
        lines += _lines(row + "," * (k + 1 < len(braced)), "    ", "     ")
    return lines


def wrapped(statement: str, indent: int = 2) -> str:
    """Return a statement, continued on further lines if it is too long, after an operator or comma."""
    first = " " * indent
    joined = SHORT_SUM.sub(lambda match: match[0].replace(" ", "\0"), statement)
    joined = OPERATOR.sub("\0\\1 ", joined)  # no break before an operator
    return "\n".join(_lines(joined, first, first + " " * CONTINUATION)).replace("\0", " ")


def wrapped_comment(text: str) -> str:
    """Return a comment in the first column."""
    return "\n".join(_lines(f"/* {text} */", "", " * "))


def wrapped_comment_lines(text: str) -> str:
    """Return a comment of several lines, with lines that are too long broken."""
    lines = (_lines(line, "", " * ") if len(line) > WIDTH else [line] for line in text.split("\n"))
    return "\n".join(part for parts in lines for part in parts)


def wrapped_prototype(prototype: str) -> str:
    """Return the head of a function, broken between arguments if it is too long."""
    arguments = prototype.replace(" ", "\0").replace(",\0", ", ")  # no break within an argument
    return "\n".join(_lines(arguments, "", " " * CONTINUATION)).replace("\0", " ")


def _lines(text: str, first: str, following: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=following,
        replace_whitespace=False,
        break_long_words=False,
        break_on_hyphens=False,
    )


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
        self.specialised: dict[str, str] = {}
        self.macros = _Macros()
        self.chains: list[_Chain] = []
        self.branches: dict[str, _Macros] = {}

    def lines(self, text: str, folder: str) -> Generator[str, None, list[str]]:
        """Yield the lines with headers inserted; return those of the text itself."""
        lines: list[str] = []
        for line in text.split("\n"):
            match = DIRECTIVE.match(line)
            word, rest = (match["word"], match["rest"]) if match else ("", "")
            if word in ("if", "ifdef", "ifndef", "elif", "else", "endif"):
                for kept in self.condition(word, COMMENT.sub("", rest), line):
                    lines.append(kept)
                    yield kept
            elif not any(chain.active is False for chain in self.chains):
                if word in ("define", "undef"):
                    self.define(word, rest)
                self.macros.failed |= word == "error"
                lines.append(line)
                if word == "include" and (OWN if folder else SUPPORT).match(rest):
                    yield from self.include(posixpath.normpath(posixpath.join(folder, rest.strip('"'))))
                else:
                    yield line
        return lines

    def define(self, word: str, rest: str) -> None:
        name, value = re.split(r"\b", COMMENT.sub("", rest) + " ", maxsplit=2)[1:]
        self.macros.uncertain.discard(name)
        self.macros.values.pop(name, None)
        if word == "define":
            self.macros.values[name] = value.strip() if re.fullmatch(r" +\w+", value) else None

    def include(self, name: str) -> Iterator[str]:
        if name not in self.files:
            self.files[name] = self.read(name)
        text = self.files[name]
        lines = yield from self.lines(text.removesuffix("\n"), posixpath.dirname(name))
        if any(lines):
            guarded = text.startswith("#ifndef ")
            kept = "\n".join([text.partition("\n")[0], *lines, "#endif", ""] if guarded else [*lines, ""])
            same = self.specialised.setdefault(name, kept) == kept
            self.specialised[name] = re.sub(r"\n{3,}", "\n\n", kept) if same else text

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


def specialised(text: str, read: Callable[[str], str]) -> dict[str, str]:
    """Return the support headers that a source includes, in order, without alternatives that it does not use."""
    work = _Preprocessor(read)
    list(work.lines(text, ""))
    return {name: work.specialised[name] for name in work.files}


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


def included(code: str, read: Callable[[str], str]) -> tuple[tuple[str, str], ...]:
    """Return names and texts of the support headers that a source includes, in order."""
    return tuple(preprocessed(code, read)[1].items())


IGNORED = re.compile(r'/\*(?:[^*]|\*(?!/))*\*/|"(?:\\.|[^"\\])*"|^#(?:.*\\\n)*.*$', re.MULTILINE)
MACRO = re.compile(r"^#define (?P<name>\w+)(?:\((?P<parameters>[^)]*)\))?(?P<body>(?:.*\\\n)*.*)$", re.MULTILINE)
ATTRIBUTE = re.compile(r"__attribute__\(\((?:[^()]|\([^()]*\))*\)\)")
FUNCTION = re.compile(r"[\w\s*]*?(\w+)\s*\(")
DECLARED = re.compile(r"(\w+)\s*(?:\[[^=]*\])?\s*;?\s*$")
EXPORTED = re.compile(r"\b(NAME|STATUS)\((\w+)\)")
PREFIXING = re.compile(r"^#define (NAME|STATUS)\(word\) (\w+)##word.*\n", re.MULTILINE)
TOKEN = re.compile(r'/\*(?:[^*]|\*(?!/))*\*/|"(?:\\.|[^"\\])*"|#include .*|\bFMI\(\w+\)|\b[A-Za-z_]\w*')
BREAK = re.compile(r'(?:[^" ]|"(?:\\.|[^"\\])*")+ ')


def with_own_names(code: str, prefix: str, header: str) -> str:
    """Return a source whose macros and names at file scope begin with the prefix of the integrator.

    Args:
        code: of one file, without include guards.
        prefix: of its own names; exported ones may have another, of the integrator that it belongs to.
        header: included by the code; its names are retained.
    """
    prefixes = dict(PREFIXING.findall(code))
    code = EXPORTED.sub(lambda match: prefixes[match[1]] + match[2], PREFIXING.sub("", code))
    taken = set(TOKEN.findall(header + code))
    names = {}
    for name in (*(match["name"] for match in MACRO.finditer(code)), *_names(code)):
        if not name.lower().startswith(f"{prefix.lower()}_"):
            upper, local = (prefix.upper(), "LOCAL") if name.isupper() else (prefix, "local")
            names[name] = f"{upper}_{name}" if f"{upper}_{name}" not in taken else f"{upper}_{local}_{name}"
    renamed = TOKEN.sub(lambda match: names.get(match[0], match[0]), code)
    return "\n".join(_broken(renamed.split("\n")))


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


def _names(code: str) -> Iterator[str]:
    """Yield names with internal linkage, types and enumerators in order."""
    makers = {
        match["name"]: ([each.strip() for each in match["parameters"].split(",")], names)
        for match in MACRO.finditer(code)
        if match["parameters"] and (names := re.findall(r"\bstatic\b[\w ]*?(\w+##\w+)\(", match["body"]))
    }
    local = {match["name"] for match in MACRO.finditer(code) if not match["parameters"] and "static" in match["body"]}
    for text in _declarations(ATTRIBUTE.sub("", IGNORED.sub("", code))):
        head, _, rest = re.sub(r" = .*", "", text, flags=re.DOTALL).partition("{")
        words = head.split()
        if (maker := makers.get(head.partition("(")[0])) is not None:
            yield from _made(*maker, head)
        elif words[0] == "enum":
            yield from re.findall(r"(?:^|,)\s*(\w+)", text[text.index("{") + 1 :])
        elif words[0] in ("typedef", "struct"):
            yield from re.findall(r"^(?:typedef )?(?:struct|union) (\w+)\s*$", head.strip())
            if head.endswith(");"):
                yield re.findall(r"(\w+)\)?\s*\(", head)[0]
            elif words[0] == "typedef":
                declared = (rest.rpartition("}")[2] or head).split(",")
                yield from (name for each in declared for name in DECLARED.findall(each))
        elif "static" in words or words[0] in local:
            yield (FUNCTION.match(head) or DECLARED.search(head) or [""])[1]


def _declarations(text: str) -> Iterator[str]:
    """Yield the declarations and definitions at file scope."""
    depth, lines = 0, list[str]()
    for line in text.split("\n"):
        if lines or line[:1].isidentifier():
            lines.append(line.rstrip())
            depth += line.count("{") - line.count("}")
            if depth == 0 and lines[-1].endswith((";", "}")):
                yield "\n".join(lines)
                lines = []


def _made(parameters: Iterable[str], names: Iterable[str], head: str) -> Iterator[str]:
    """Yield the names of functions that a macro defines, and those parts of them that the macro contains."""
    arguments = dict(zip(parameters, re.split(r"[(),]", head)[1:], strict=False))
    for name in names:
        yield from [part for part in name.split("##") if part not in arguments]
        yield "".join(arguments.get(part, part).strip() for part in name.split("##"))
