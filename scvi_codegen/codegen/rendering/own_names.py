"""Names at file scope with the integrator's prefix, so that one translation unit can include several single files.

C has no other means to hide macros, types and enumerators of an included file. This is not a C parser: it relies on the
layout of the templates, where a declaration at file scope begins in the first column.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

from scvi_codegen.codegen.rendering.text import CONTINUATION, WIDTH, wrapped_prototype

IGNORED = re.compile(r'/\*(?:[^*]|\*(?!/))*\*/|"(?:\\.|[^"\\])*"|^#(?:.*\\\n)*.*$', re.MULTILINE)
MACRO = re.compile(r"^#define (?P<name>\w+)(?:\((?P<parameters>[^)]*)\))?(?P<body>(?:.*\\\n)*.*)$", re.MULTILINE)
ATTRIBUTE = re.compile(r"__attribute__\(\((?:[^()]|\([^()]*\))*\)\)")
FUNCTION = re.compile(r"[\w\s*]*?(\w+)\s*\(")
DECLARED = re.compile(r"(\w+)\s*(?:\[[^=]*\])?\s*;?\s*$")
EXPORTED = re.compile(r"\b(NAME|STATUS)\((\w+)\)")
PREFIXING = re.compile(r"^#define (NAME|STATUS)\(word\) (\w+)##word.*\n", re.MULTILINE)
SAME = re.compile(r"^typedef (\w+) \1;\n", re.MULTILINE)
"""Type that already has its name, as ``solver_options`` of the integrator ``solver``."""
TOKEN = re.compile(r'/\*(?:[^*]|\*(?!/))*\*/|"(?:\\.|[^"\\])*"|#include .*|##\w+|\bFMI\(\w+\)|\b[A-Za-z_]\w*')
"""Comments, strings, words, and words pasted to the end of others, which are no names by themselves."""
EXPORTED_OR_TOKEN = re.compile(rf"{EXPORTED.pattern}|{TOKEN.pattern}")
DECLARATION = re.compile(r"^typedef struct (\w+) \{|^\} (\w+);|(\w+)\(", re.MULTILINE)
"""Types and functions that a header declares; macros with the prefix are written as such in the code."""
HEAD = re.compile(r'^(?P<head>[A-Za-z_][^;{}#/"]*\))(?=\n\{)', re.MULTILINE)
"""Head of the definition of a function."""
CONTINUED = re.compile(r"^#define .*\\\n(?:.*\\\n)*.*$", re.MULTILINE)
BREAK = re.compile(r'(?:[^" ]|"(?:\\.|[^"\\])*")+ ')


def with_distinct_names(texts: Mapping[str, str], header: str, prefix: str) -> dict[str, str]:
    """Return texts whose own names are none of those they export, as ``finish_step`` of an integrator ``finish``."""
    if not any(f"{of}_" in text for of in (prefix, prefix.upper()) for text in texts.values()):
        return dict(texts)
    exported = {
        name for names in DECLARATION.findall(header) for name in names if name.lower().startswith(f"{prefix}_")
    }
    for kind, word in (export for text in texts.values() for export in EXPORTED.findall(text)):
        exported.add(f"{prefix if kind == 'NAME' else prefix.upper()}_{word}")

    def distinct(match: re.Match[str]) -> str:
        name = match[0]
        return f"{'LOCAL' if name.isupper() else 'local'}_{name}" if name in exported else name

    return {file: EXPORTED_OR_TOKEN.sub(distinct, text) for file, text in texts.items()}


def with_exported_names(code: str) -> str:
    """Return a source with exported names in place of the macros that make them."""
    prefixes = dict(PREFIXING.findall(code))
    code = EXPORTED.sub(lambda match: prefixes[match[1]] + match[2], PREFIXING.sub("", code))
    code = SAME.sub("", code)
    return re.sub(r"\n{3,}", "\n\n", _wrapped(code))


def with_own_names(code: str, prefix: str, header: str) -> str:
    """Return a source whose macros and names at file scope begin with the prefix of the integrator.

    Args:
        code: of one file, without include guards and macros of exported names.
        prefix: of its own names; exported ones may have another, of the integrator that it belongs to.
        header: included by the code; its names are retained.
    """
    taken = set(TOKEN.findall(header + code))
    names = {}
    for name in FileScope(code).names(code):
        if not name.lower().startswith(f"{prefix.lower()}_"):
            upper, local = (prefix.upper(), "LOCAL") if name.isupper() else (prefix, "local")
            names[name] = f"{upper}_{name}" if f"{upper}_{name}" not in taken else f"{upper}_{local}_{name}"
    renamed = TOKEN.sub(lambda match: names.get(match[0], match[0]), code)
    return _wrapped(renamed)


def _wrapped(code: str) -> str:
    """Return a source whose lines have changed lengths with those that are too long broken."""
    code = HEAD.sub(lambda match: wrapped_prototype(" ".join(match["head"].split()).replace("( ", "(")), code)
    return CONTINUED.sub(_aligned, "\n".join(_broken(code.split("\n"))))


def _aligned(macro: re.Match[str]) -> str:
    """Return the lines of a macro with the backslashes at their ends in one column."""
    lines = [line.removesuffix("\\").rstrip() for line in macro[0].split("\n")]
    width = max(map(len, lines[:-1])) + 1
    return "\n".join([*(f"{line:{width}}\\" for line in lines[:-1]), lines[-1]])


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


class FileScope:
    """Names that declarations at file scope make, in a source with certain macros."""

    def __init__(self, code: str) -> None:
        macros = [*MACRO.finditer(code)]
        self._makers = {
            match["name"]: ([parameter.strip() for parameter in match["parameters"].split(",")], names)
            for match in macros
            if match["parameters"] and (names := re.findall(r"\bstatic\b[\w ]*?(\w+(?:##\w+)*)\(", match["body"]))
        }
        for match in macros:  # those that end in another one
            call = re.search(r"(\w+)\(((?:[^()]|\([^()]*\))*)\)$", match["body"])
            if call and (inner := self._makers.get(call[1])) and match["parameters"]:
                arguments = dict(zip(inner[0], map(str.strip, call[2].split(",")), strict=False))
                made = ["##".join(arguments.get(part, part) for part in name.split("##")) for name in inner[1]]
                parameters = [parameter.strip() for parameter in match["parameters"].split(",")]
                self._makers.setdefault(match["name"], (parameters, []))[1].extend(made)
        self._local = {match["name"] for match in macros if not match["parameters"] and "static" in match["body"]}

    def names(self, code: str) -> Iterator[str]:
        """Yield the names of macros, of types and enumerators, and of variables and functions in order."""
        yield from (match["name"] for match in MACRO.finditer(code))
        for text in _declarations(ATTRIBUTE.sub("", IGNORED.sub("", code))):
            yield from self._declared(text)

    def _declared(self, text: str) -> Iterator[str]:
        """Yield the names of one declaration, that of a function that is exported as ``NAME(word)``."""
        head, _, rest = re.sub(r"\s=\s.*", "", text, flags=re.DOTALL).partition("{")
        words = head.split()
        if (maker := self._makers.get(head.partition("(")[0])) is not None:
            yield from _made(*maker, head)
        elif words[0] == "enum":
            yield from re.findall(r"(?:^|,)\s*(\w+)", text[text.index("{") + 1 :])
        elif words[0] in ("typedef", "struct"):
            yield from re.findall(r"^(?:typedef )?(?:struct|union) (\w+)\s*$", head.strip())
            if head.endswith(");"):
                yield re.findall(r"(\w+)\)?\s*\(", head)[0]
            elif words[0] == "typedef":
                declared = (rest.rpartition("}")[2] or head).split(",")
                yield from (name for declarator in declared for name in DECLARED.findall(declarator))
        elif "static" in words or words[0] in self._local:
            yield (FUNCTION.match(head) or DECLARED.search(head) or [""])[1]
        elif exported := re.search(r"\bNAME\(\w+\)(?=\()", head):
            yield exported[0]


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
        yield from [part for part in name.split("##")[:1] if part not in arguments]
        yield "".join(arguments.get(part, part).strip() for part in name.split("##"))
