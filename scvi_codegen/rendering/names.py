"""Names at file scope of generated C, with the integrator's prefix, so that one translation unit can include several.

Not a C parser: it relies on the layout of the templates, where a declaration at file scope begins in the first column.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

IGNORED = re.compile(r'/\*(?:[^*]|\*(?!/))*\*/|"(?:\\.|[^"\\])*"|^#(?:.*\\\n)*.*$', re.MULTILINE)
MACRO = re.compile(r"^#define (?P<name>\w+)(?:\((?P<parameters>[^)]*)\))?(?P<body>(?:.*\\\n)*.*)$", re.MULTILINE)
ATTRIBUTE = re.compile(r"__attribute__\(\((?:[^()]|\([^()]*\))*\)\)")
FUNCTION = re.compile(r"[\w\s*]*?(\w+)\s*\(")
DECLARED = re.compile(r"(\w+)\s*(?:\[[^=]*\])?\s*;?\s*$")
SYSTEM_INCLUDE = re.compile(r"^#include <.*>$", re.MULTILINE)
LEADING = re.compile(r"(?:/\*(?:[^*]|\*(?!/))*\*/\n|#include .*\n|\n)*")
EXPORTED = re.compile(r"\b(?:NAME|FMI)\((\w+)\)")


def with_own_names(code: str, prefix: str) -> str:
    """Return a source that prefixes its names at file scope, and leaves no macro defined.

    Args:
        code: of one file, without include guards.
        prefix: of every exported C name.
    """
    macros = dict.fromkeys(match["name"] for match in MACRO.finditer(code))
    exported = set(EXPORTED.findall(code))
    names = [name for name in dict.fromkeys(_names(code)) if name not in macros]
    code = _with_leading_includes(code)
    leading = LEADING.match(code)
    start = leading.end() if leading else 0
    renamed = "".join(f"#define {name} {prefix}_{'local_' * (name in exported)}{name}\n" for name in names)
    undefined = "".join(f"#undef {name}\n" for name in (*macros, *names))
    return (
        f"{code[:start]}/* Names at file scope get the prefix of the integrator. */\n{renamed}\n{code[start:]}\n"
        f"/* Other integrators may follow in the same translation unit. */\n{undefined}"
    )


def _with_leading_includes(code: str) -> str:
    """Return the source with unconditional includes of system headers before everything else."""
    depth, lines, moved = 0, list[str](), list[str]()
    for line in code.split("\n"):
        depth += line.startswith("#if") - line.startswith("#endif")
        (moved if depth == 0 and SYSTEM_INCLUDE.fullmatch(line) else lines).append(line)
    first = next(i for i, line in enumerate(lines) if line.startswith("#include"))
    includes = [lines[first], *([""] if moved else []), *sorted(set(moved))]
    return re.sub(r"\n{3,}", "\n\n", "\n".join([*lines[:first], *includes, *lines[first + 1 :]]))


def _names(code: str) -> Iterator[str]:
    """Yield names with internal linkage, types and enumerators in order."""
    makers = {
        match["name"]: ([each.strip() for each in match["parameters"].split(",")], made)
        for match in MACRO.finditer(code)
        if match["parameters"] and (made := re.findall(r"\bstatic\b[\w ]*?(\w+##\w+)\(", match["body"]))
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


def _made(parameters: Iterable[str], made: Iterable[str], head: str) -> Iterator[str]:
    """Yield the names of functions that a macro defines."""
    arguments = dict(zip(parameters, re.split(r"[(),]", head)[1:], strict=False))
    for name in made:
        yield "".join(arguments.get(part, part).strip() for part in name.split("##"))
