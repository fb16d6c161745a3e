"""Declarations of C in the layout of the templates: their texts, the names that they make and the words that they use.

This is the one place that reads C: assembling a source for readers, removing what nothing uses, and giving names a
prefix all go by what it returns. It is no parser of C. It splits text into tokens, and relies on a declaration at file
scope that begins in the first column and ends at the end of a line. A macro that makes a function there has the
parameter ``name`` first.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

TOKEN = re.compile(
    r"(?P<comment>/\*.*?\*/)|(?P<string>\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\\n])'|<\w+\.h>)|(?P<space>(?:[^\S\n]|\\\n)+)"
    r"|(?P<newline>\n)|(?P<word>\b(?:NAME|STATUS)\(\w+\)|[A-Za-z_]\w*)|(?P<pasted>##\w+)|(?P<member>(?:->|\.)[A-Za-z_]\w*)"
    r"|(?P<foreign>\bFMI\(\w+\))|(?P<number>\.?\d(?:[eEpP][+-]|[\w.])*)|(?P<other>.)",
    re.DOTALL,
)
"""Tokens of C: exported names are words, the ends of pasted words and the standard's names of FMI are none."""


DIRECTIVES = {"ifdef", "ifndef", "if", "elif", "else", "endif", "define", "undef", "include", "error"}


class Macro(NamedTuple):
    """Macro with the names of its parameters, ``None`` without brackets, and the tokens of its text."""

    parameters: tuple[str, ...] | None
    body: tuple[str, ...]


NO_MACRO = Macro(None, ())


def tokens(code: str) -> Iterator[str]:
    """Yield the tokens of a text but comments and white space."""
    return (match[0] for match in TOKEN.finditer(code) if match.lastgroup not in ("comment", "space", "newline"))


def words(code: str) -> frozenset[str]:
    """Return the names that occur in a text other than as members, and the ends of pasted ones."""
    tokens = (match[0] for match in TOKEN.finditer(code) if match.lastgroup in ("word", "pasted"))
    return frozenset(word.removeprefix("##") for word in tokens)


def is_name(token: str) -> bool:
    """Return whether a token is a name, exported ones among them."""
    return token[0].isalpha() or token[0] == "_"


def renamed(code: str, names: Mapping[str, str], *, comments: bool = False) -> str:
    """Return a text with other names, of members and perhaps in comments, too: all that has one of them is renamed."""

    def with_name(match: re.Match[str]) -> str:
        text = match[0]
        if match.lastgroup == "comment" and comments:
            return f"/*{renamed(text[2:-2], names)}*/"
        if match.lastgroup not in ("word", "member"):
            return text
        name = text.lstrip("->.")
        return text.removesuffix(name) + names.get(name, name)

    return TOKEN.sub(with_name, code)


def squeezed(code: str) -> str:
    """Return a text with at most one empty line in succession."""
    lines = code.split("\n")
    return "\n".join(line for before, line in pairwise(["-", *lines]) if before or line)


def pieces(code: str) -> Iterator[tuple[str, str]]:
    """Yield the kinds and texts of what is at file scope: blank, comment, directive with its continuation, code."""
    start, depth, kind, last = 0, 0, "", ""
    for match in TOKEN.finditer(code):
        of, text = match.lastgroup, match[0]
        if not kind:
            kind = {"newline": "blank", "comment": "comment"}.get(str(of), "directive" if text == "#" else "code")
        if of == "newline" and (kind != "code" or (depth == 0 and last in (";", "}"))):
            yield kind, code[start : match.start()]
            start, kind, last = match.end(), "", ""
        elif of not in ("comment", "space", "newline"):
            depth += (text == "{") - (text == "}")
            last = text
    if kind:
        yield kind, code[start:]


class Branch(NamedTuple):
    """Line of ``#if``, ``#elif`` or ``#else``, and what is below it."""

    line: str
    block: Block


Block = list["tuple[str, str] | list[Branch]"]
"""Pieces, and conditionals as their branches."""


def nested(pieces: Iterator[tuple[str, str]]) -> tuple[Block, str]:
    """Return kinds and texts with conditionals as branches, and the directive that ends the block, else nothing."""
    block: Block = []
    for kind, text in pieces:
        word = directive(text)[0] if kind == "directive" else ""
        if word in ("elif", "else", "endif"):
            return block, text
        if not word.startswith("if"):
            block.append((kind, text))
            continue
        branches, line = list[Branch](), text
        while directive(line)[0] not in ("endif", ""):
            inside, end = nested(pieces)
            branches.append(Branch(line, inside))
            line = end
        block.append(branches)
    return block, ""


def directive(text: str) -> tuple[str, str]:
    """Return the word of a directive and the rest of its line without a comment; empty words for other texts."""
    word, _, rest = text[1:].partition(" ") if text.startswith("#") else ("", "", "")
    return (word, rest.partition("/*")[0].strip()) if word in DIRECTIVES else ("", "")


def macros_of(code: str) -> dict[str, Macro]:
    """Return the macros of a text by name, of several definitions the last one."""
    return dict(_macro(line) for _, line in definitions(code))


def definitions(code: str) -> Iterator[tuple[str, str]]:
    """Yield the names and lines of the macros that a text defines, in functions, too."""
    lines = iter(code.split("\n"))
    for line in lines:
        if line.startswith("#define "):
            while line.endswith("\\"):
                line += "\n" + next(lines)
            yield line.split("(")[0].split()[1], line


def _macro(line: str) -> tuple[str, Macro]:
    _, _, name, *body = tokens(line)
    if f"#define {name}(" not in line:
        return name, Macro(None, tuple(body))
    end = body.index(")")
    return name, Macro(tuple(token for token in body[1:end] if token != ","), tuple(body[end + 1 :]))


def names_of(code: str, macros: Mapping[str, Macro]) -> Iterator[str]:
    """Yield the names at file scope that a text makes: of macros, then types, enumerators, variables and functions."""
    yield from (name for name, _ in definitions(code))
    for kind, text in pieces(code):
        if kind == "code":
            yield from _declared([*tokens(text)], macros)


def _declared(text: Sequence[str], macros: Mapping[str, Macro]) -> Iterator[str]:
    """Yield the names that a declaration makes; a macro at its beginning may be ``static``, or make a function."""
    macro = macros.get(text[0], NO_MACRO)
    if macro.parameters is not None:
        yield from text[2:3] if macro.parameters[:1] == ("name",) else ()
        return
    text = [*_without_attributes([*macro.body, *text])]
    end = _first_of("{=", text)
    head = text[:end]
    if head[0] == "enum":
        yield from (name for before, name in pairwise(text[end:]) if before in "{," and is_name(name))
    elif head[0] in ("typedef", "struct"):
        tag = head[head[0] == "typedef" :]
        if tag[0] in ("struct", "union") and len(tag) == 2 and end < len(text):
            yield tag[1]
        if head[0] == "typedef":
            declared = text[len(text) - 1 - text[::-1].index("}") :] if "}" in text else text
            yield from _declarators(declared)
        elif "(" in head:
            yield _name(head)
    elif "static" in head:
        yield _name(head)
    else:
        yield from (name for name, after in pairwise(head) if name.startswith("NAME(") and after == "(")


def _name(head: Sequence[str]) -> str:
    """Return the name of a function or variable: the last one before its arguments or size."""
    return head[_first_of("([;", head) - 1]


def _first_of(marks: str, text: Sequence[str]) -> int:
    """Return the place of the first of some tokens; the end if there is none."""
    return next((place for place, token in enumerate(text) if token in marks), len(text))


def _declarators(text: Sequence[str]) -> Iterator[str]:
    """Yield the names of types, of functions ``f(..)`` or of pointers to them ``(*f)(..)``, too."""
    depth = 0
    for name, after in pairwise(text):
        depth += (name in ("(", "[")) - (name in (")", "]"))
        if is_name(name) and (
            (depth == 0 and after in (",", "[", ";")) or (after in (")", "(") and text[-2] == ")" and depth < 2)
        ):
            yield name
            if after in (")", "("):
                return


def _without_attributes(text: Iterable[str]) -> Iterator[str]:
    """Yield tokens but ``__attribute__((..))``."""
    rest = iter(text)
    for token in rest:
        if token != "__attribute__":
            yield token
            continue
        depth = 0
        for inner in rest:
            depth += (inner == "(") - (inner == ")")
            if depth == 0:
                break
