"""Outline of the generated C: functions, the comments above them, and the call graph.

Not a C parser: it relies on the layout of the templates, with a function's head in the first column and its closing
brace alone on a line.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

HEAD = re.compile(
    r"(?:^/\*(?P<comment>(?:[^*]|\*(?!/))*)\*/\n)?"
    r"^(?P<text>(?!typedef|struct|enum)[a-z_](?:[\w *]|__attribute__\(\(\w+\)\))*?[ *](?P<name>(?!__attribute__)\w+)"
    r"\((?P<arguments>[^;{}]*)\)\n\{\n(?P<body>.*?)^\})$",
    re.MULTILINE | re.DOTALL,
)
HOT = re.compile(r"^#define HOT (.*)$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Function:
    """A function of the source.

    Attributes:
        name: as it is called.
        arguments: their names in order.
        comment: the one above it, on one line, or empty.
        body: between its braces.
        text: all of it, without the comment.
        calls: the functions of the same source that it calls, in order of first call.
    """

    name: str
    arguments: tuple[str, ...]
    comment: str
    body: str
    text: str
    calls: tuple[str, ...]


def functions_of(code: str) -> dict[str, Function]:
    """Return every function with a body, by name, in order; of preprocessor alternatives the first."""
    matches: dict[str, re.Match[str]] = {}
    prefix, stored = re.search(r"^#define NAME\(word\) (\w+)##word", code, re.MULTILINE), HOT.search(code)
    text = re.sub(r"\bNAME\((\w+)\)", rf"{prefix[1]}\1", code) if prefix else code
    text = re.sub(r"^(static )?SELDOM ", r"\1", text, flags=re.MULTILINE)
    for match in HEAD.finditer(re.sub(r"^HOT ", f"{stored[1]} ", text, flags=re.MULTILINE) if stored else text):
        matches.setdefault(match["name"], match)
    return {name: _function(match, matches) for name, match in matches.items()}


def _function(match: re.Match[str], matches: Mapping[str, re.Match[str]]) -> Function:
    called = dict.fromkeys(re.findall(r"\b(\w+)\(", match["body"]))
    return Function(
        name=match["name"],
        arguments=tuple(
            re.findall(r"\w+", re.sub(r"\[.*?\]|\)", "", argument))[-1]
            for argument in match["arguments"].split(",")
            if argument != "void"
        ),
        comment=" ".join((match["comment"] or "").replace("\n *", " ").split()),
        body=match["body"],
        text=match["text"],
        calls=tuple(name for name in called if name in matches and name != match["name"]),
    )


def reached(functions: Mapping[str, Function], start: str) -> tuple[Function, ...]:
    """Return ``start`` and the functions that it calls, directly or not, each once, callers first."""
    functions_reached: dict[str, Function] = {}
    pending = [start]
    while pending:
        name = pending.pop()
        if name not in functions_reached:
            functions_reached[name] = functions[name]
            pending.extend(reversed(functions[name].calls))
    return tuple(functions_reached.values())
