"""Files of a source as a reader needs them: what exported functions reach, each declaration behind those that it needs.

The first file has the step and its run, and includes the others. Like
:mod:`~scvi_codegen.codegen.rendering.own_names` this relies on the layout of the templates, where a declaration at file
scope begins in the first column, and is not a C parser: a name counts as used wherever it occurs other than as a
member. The support headers serve all integrators, each of which uses a part of them, and no C compiler prints a source
without what it does not use.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from scvi_codegen.codegen.rendering.own_names import FileScope

FIRST = "solve", "NAME(step)"
"""Functions whose source comes first."""
FILES = {
    "adaptive": ("Adaptive steps.", ("default_step_control", "smallest_tolerance", "advance_to")),
    "mechanics": (
        "Momenta and velocities, energies, conserved quantities, constraints; the discrete Lagrangian.",
        (
            *("momentum", "velocity", "energy", "energies", "momentum_maps", "rates"),
            *("constraint_values", "project", "apart", "multipliers", "contact_terms"),
            *("discrete_legendre", "work_and_impulses"),
        ),
    ),
}
"""Files behind that of the step and its run: what they are, and their exported functions."""
PREFIXED = {"NAME", "STATUS"}
"""Macros of the prefix, which stay."""
WORD = re.compile(r"\b(?:NAME|STATUS)\(\w+\)|(?<![.\w])(?<!->)[A-Za-z_]\w*")
COMMENTS = re.compile(r"/\*.*?\*/", re.DOTALL)
REQUIRED = re.compile(r"\s+(?:\* )?Requires:.*?(?= \*/)", re.DOTALL)
CHOICE = re.compile(r"\b[A-Z]{4,}(?:_[A-Z]+)*\b")
"""Name of an alternative or number in a comment."""
ALIAS = re.compile(r"^#define (\w+)(?: ([A-Za-z_][\w ]*)|\((\w+)\) \3(?: /\*.*\*/)?)$", re.MULTILINE)
"""Macro that is another name, keywords or its argument."""
UNDEFINED = re.compile(r"^#undef (\w+)$", re.MULTILINE)
STANDARD = {"#include <float.h>": r"\b(DBL|FLT)_", "#include <limits.h>": r"\b(INT|U?L?LONG)_M"}
"""Standard headers that not every source uses, and names that they define."""
MEANINGS = "#define", "#undef", "typedef", "struct"
"""Beginnings of declarations on whose words those depend that mention their names."""
CHOICES = "/* Choices of this integrator among the alternatives of the support headers. */\n"


@dataclass(frozen=True, eq=False)
class Part:
    """Declaration, macro, conditional or other line of the preprocessor at file scope.

    Attributes:
        comment: above it.
        lines: without the comment.
        names: that it declares.
        conditions: lines of the conditionals around it.
        section: comments above several parts, of which this is one.
        joined: whether it follows the part before it without an empty line.
        branches: of a conditional, the line that begins each and the parts below it.
    """

    comment: tuple[str, ...]
    lines: tuple[str, ...]
    names: frozenset[str]
    conditions: tuple[str, ...]
    section: tuple[str, ...]
    joined: bool
    branches: tuple[tuple[str, tuple[Part, ...]], ...] = ()

    @cached_property
    def words(self) -> frozenset[str]:
        """Names that occur in it and in the conditions around it."""
        return frozenset(WORD.findall(COMMENTS.sub("", "\n".join((*self.conditions, *self.lines)))))

    @property
    def leaves(self) -> Iterator[Part]:
        """Parts that are no conditionals."""
        if not self.branches:
            yield self
        for _, parts in self.branches:
            for part in parts:
                yield from part.leaves


def readable(code: str) -> dict[str, str]:
    """Return the files of a source, without what no exported function reaches, in the order in which C reads them.

    The first one, of the name "", has the step and its run; the others are those of :data:`FILES` that are not empty.
    """
    if "#define NAME(" not in code:
        return {"": code}
    code = _without_aliases(code.replace(CHOICES, ""))
    scope = FileScope(code)
    parts = tuple(_parts(code.split("\n"), scope, ()))
    files = _by_file(_without_alternatives(_reached(parts)))
    texts = {
        name: "\n".join([f"/* {FILES[name][0]} */\n" if name else "", *_lines(file)]).strip("\n")
        for name, file in files.items()
    }
    for include, names in STANDARD.items():
        if not any(re.search(names, text) for text in texts.values()):
            texts[""] = texts[""].replace(f"{include}\n", "")
    return {name: re.sub(r"\n{3,}", "\n\n", text) + "\n" for name, text in texts.items()}


def _without_aliases(code: str) -> str:
    """Return a source with other names, or its argument, in place of each macro that is nothing else."""
    for name, body, _ in ALIAS.findall(code):
        mentions = rf"^#(?:define {name}\b|(?:undef|if|ifn?def|elif) .*\b{name}\b)"
        if len(re.findall(mentions, code, re.MULTILINE)) == 1:  # no condition, and no other definition
            used = rf"(?<!#define )\b{name}\b"
            code = re.sub(used, body, code) if body else re.sub(rf"{used}\(([^()]*)\)", r"\1", code)
    return code


def _parts(lines: Sequence[str], scope: FileScope, conditions: tuple[str, ...]) -> Iterator[Part]:
    """Yield the parts of lines at file scope in order."""
    rest, joined, opened = iter(lines), False, False
    section, comment = tuple[str, ...](), tuple[str, ...]()
    for line in rest:
        if not line:
            if comment:
                section, opened = ((*section, "\n".join(comment)) if opened else ("\n".join(comment),)), True
            comment, joined = (), False
            continue
        block = (line, *_continued(line, rest))
        if line.startswith("/*"):
            comment += block
            continue
        if line.startswith("#if"):
            branches = tuple(_branches(block, scope, conditions))
            names = frozenset(name for _, parts in branches for part in parts for name in part.names)
        else:
            branches, names = (), _names(scope, block)
        comment = tuple(REQUIRED.sub("", "\n".join(comment)).split("\n")) if comment else ()
        yield Part(comment, block, names, conditions, section, joined and not comment, branches)
        comment, joined, opened = (), True, False


def _names(scope: FileScope, block: Sequence[str]) -> frozenset[str]:
    """Return the names that a declaration or macro makes, without parts of them that a macro contains."""
    text = "\n".join(block)
    names = {name for name in scope.names(text) if not name.endswith("_")}
    return frozenset(names.union(UNDEFINED.findall(text)) - PREFIXED)


def _continued(line: str, rest: Iterator[str]) -> Iterator[str]:
    """Yield the lines of a part or comment behind the first one."""
    if line.startswith("/*"):
        while not line.endswith("*/"):
            line = next(rest)
            yield line
    elif line.startswith("#"):
        depth, commented = int(line.startswith("#if")), False
        while (commented := _is_open(line, commented)) or depth or line.endswith("\\"):
            line = next(rest)
            depth += line.startswith("#if") - line.startswith("#endif")
            yield line
    else:
        code, depth = COMMENTS.sub("", line).rstrip(), 0
        while (depth := depth + code.count("{") - code.count("}")) or not code.endswith((";", "}")):
            line = next(rest)
            code = COMMENTS.sub("", line).rstrip()
            yield line


def _is_open(line: str, before: bool) -> bool:
    """Return whether a comment continues behind a line."""
    return line.rfind("/*") > line.rfind("*/") or (before and "*/" not in line)


def _branches(block: Sequence[str], scope: FileScope, outer: tuple[str, ...]) -> Iterator[tuple[str, tuple[Part, ...]]]:
    """Yield the branches of a conditional."""
    depth, start = 0, 0
    for i, line in enumerate(block):
        depth -= line.startswith("#endif")
        if i and (depth == 0 or (depth == 1 and line.startswith(("#else", "#elif")))):
            yield block[start], tuple(_parts(block[start + 1 : i], scope, (*outer, block[0])))
            start = i
        depth += line.startswith("#if")


def _is_exported(part: Part) -> bool:
    return any(name.startswith("NAME(") for name in part.names)


def _reached(parts: Sequence[Part]) -> list[Part]:
    """Return the parts that exported functions reach, with nothing else in conditionals."""
    leaves = [leaf for part in parts for leaf in part.leaves]
    by_name: dict[str, list[Part]] = {}
    for leaf in leaves:
        for name in leaf.names:
            by_name.setdefault(name, []).append(leaf)
    pending, reached = [leaf for leaf in leaves if _is_exported(leaf)], set[Part]()
    while pending:
        leaf = pending.pop()
        if leaf not in reached:
            reached.add(leaf)
            pending += [other for word in leaf.words for other in by_name.get(word, ())]
    # conditionals without names, of pragmas, serve all functions
    return [left for part in parts if (left := part if part.branches and not part.names else _kept(part, reached))]


def _kept(part: Part, reached: set[Part]) -> Part | None:
    """Return what remains of a part, if anything."""
    if not part.branches:
        return part if part in reached or not (part.names or part.conditions) else None
    if not any(leaf in reached for leaf in part.leaves):
        return None
    branches = []
    for line, parts in part.branches:
        nameless = {leaf for inner in parts for leaf in inner.leaves if not leaf.names}
        branches.append((line, tuple(left for inner in parts if (left := _kept(inner, reached | nameless)))))
    lines = [text for line, parts in branches for text in (line, *_lines(parts))]
    return replace(part, lines=(*lines, "#endif"), branches=tuple(branches))


def _by_file(parts: Sequence[Part]) -> dict[str, list[Part]]:
    """Return the parts of each file by its name, each behind those that it needs; the step comes first."""
    needed, placed = _needed(parts), set[Part]()
    file_of = {f"NAME({function})": name for name, (_, functions) in FILES.items() for function in functions}
    steps = [part for name in FIRST for part in parts if name in part.names]
    ends = {"": [*(part for part in parts if not part.names), *steps], **{name: list[Part]() for name in FILES}}
    for part in filter(_is_exported, parts):
        ends[min(file_of.get(name, "") for name in part.names)].append(part)

    def place(part: Part) -> Iterator[Part]:
        if part not in placed:
            placed.add(part)
            for other in needed[part]:
                yield from place(other)
            yield part

    files = {}
    for name, parts_at_end in ends.items():
        file = [part for end in parts_at_end for part in place(end)]
        declared = {word for part in placed if part.lines[-1].endswith(");") for word in part.names}  # defined below
        if file := file + [part for end in parts if end.names & declared for part in place(end)]:
            files[name] = file
    return files


def _needed(parts: Sequence[Part]) -> dict[Part, list[Part]]:
    """Return the parts that must precede each one: all of them did so before.

    They declare what it uses, directly or by a macro or type, or mention a macro that it defines, undefines or changes.
    """
    meanings: dict[str, set[str]] = {}
    mentioning: dict[str, list[Part]] = {}
    declaring: dict[str, list[Part]] = {}
    for leaf in (leaf for part in parts for leaf in part.leaves if leaf.lines[0].startswith(MEANINGS)):
        for name in leaf.names:
            meanings.setdefault(name, set()).update(leaf.words)
    needed: dict[Part, list[Part]] = {}
    for part in parts:
        words, pending = set[str](), [*part.words]
        while pending:
            if (word := pending.pop()) not in words:
                words.add(word)
                pending += meanings.get(word, ())
        before = {other for word in words for other in declaring.get(word, ())}
        if any(leaf.lines[0].startswith("#") for leaf in part.leaves):
            before |= {other for name in part.names for other in mentioning.get(name, ())}
        needed[part] = [other for other in needed if other in before]
        for name in part.names:
            declaring.setdefault(name, []).append(part)
        for word in words:
            mentioning.setdefault(word, []).append(part)
    return needed


def _lines(parts: Sequence[Part]) -> Iterator[str]:
    """Yield the lines of parts, comments of a section above the first one of it."""
    sections, last = set[tuple[str, ...]](), None
    for part in parts:
        comments = () if part.section in sections else part.section
        sections.add(part.section)
        if last and not (part.joined and not comments and len(part.lines) == 1 == len(last.lines)):
            yield ""
        for comment in comments:
            yield from comment.split("\n")
            if part.comment:
                yield ""
        yield from part.comment
        yield from part.lines
        last = part


def _without_alternatives(parts: Sequence[Part]) -> list[Part]:
    """Return parts without comments of sections on alternatives that the source does not have."""
    names = {name for part in parts for leaf in part.leaves for name in leaf.words}
    kept = []
    for part in parts:
        comments = [REQUIRED.sub("", comment) for comment in part.section]
        section = [comment for comment in comments if comment != "/* */" and {*CHOICE.findall(comment)} <= names]
        kept.append(replace(part, section=tuple(section)))
    return kept
