"""Files of a source as a reader needs them: what exported functions reach, each declaration behind those that it needs.

The first file has the step and its run, and includes the others. A name counts as used wherever it occurs other than as
a member (:mod:`~scvi_codegen.codegen.rendering.c_text`). The support headers serve all integrators, each of which uses
a part of them, and no C compiler prints a source without what it does not use.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, pairwise

from scvi_codegen.codegen.rendering.c_text import (
    Block,
    Macro,
    definitions,
    directive,
    macros_of,
    names_of,
    nested,
    pieces,
    renamed,
    squeezed,
    tokens,
    words,
)
from scvi_codegen.codegen.rendering.own_names import exported_names

FIRST = "solve", "NAME(step)"
"""Functions whose source comes first."""
FILES = {
    "adaptive": ("Adaptive steps.", ("default_step_control", "smallest_tolerance", "advance_to")),
    "mechanics": (
        "Momenta and velocities, energies, conserved quantities, constraints; the discrete Lagrangian.",
        (
            *("momentum", "velocity", "energy", "energies", "momentum_maps", "rates"),
            *("constraint_values", "project", "apart", "multipliers", "contact_terms"),
            *("motion_terms", "row_terms", "contact_laws"),
            *("discrete_legendre", "work_and_impulses"),
        ),
    ),
}
"""Files behind that of the step and its run: what they are, and their exported functions."""
PREFIXED = {"NAME", "STATUS"}
"""Macros of the prefix, which stay."""
STANDARD = {
    "#include <float.h>": ("DBL_", "FLT_"),
    "#include <limits.h>": ("INT_M", "LONG_M", "LLONG_M", "ULONG_M", "ULLONG_M"),
}
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
        return words("\n".join((*self.conditions, *self.lines)))

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
    files = _by_file(_without_alternatives(_reached(_parts_of(code))))
    texts = {
        name: "\n".join([f"/* {FILES[name][0]} */\n" if name else "", *_lines(file)]).strip("\n")
        for name, file in files.items()
    }
    used = frozenset.union(*map(words, texts.values()))
    for include, beginnings in STANDARD.items():
        if not any(word.startswith(beginnings) for word in used):
            texts[""] = texts[""].replace(f"{include}\n", "")
    return {name: f"{squeezed(text)}\n" for name, text in texts.items()}


def _without_aliases(code: str) -> str:
    """Return a source with other names in place of macros that are nothing else, and arguments of those that are it."""
    mentions = Counter[str]()
    for line in code.split("\n"):
        if line.startswith("#"):
            _, word, *rest = tokens(line)
            mentions.update({*rest[:1]} if word == "define" else {*rest})
    commented = {name for name, line in definitions(code) if line.endswith("*/")}
    once = {name: macro for name, macro in macros_of(code).items() if mentions[name] == 1}
    names = {
        name: " ".join(macro.body)
        for name, macro in once.items()
        if macro.parameters is None and name not in commented and macro.body and all(map(str.isidentifier, macro.body))
    }
    for name, macro in once.items():
        if macro.parameters == macro.body:
            code = _without_calls(code, name)

    while named := [name for name, text in names.items() if any(word in names for word in text.split())]:
        names |= {name: " ".join(names.get(word, word) for word in names[name].split()) for name in named}

    def defines(line: str) -> bool:
        return line.startswith("#define ") and line.split()[1] in names

    blocks = ((own, "\n".join(lines)) for own, lines in groupby(code.split("\n"), defines))
    return "\n".join(text if own else renamed(text, names, comments=True) for own, text in blocks)


def _without_calls(code: str, macro: str) -> str:
    """Return a source with the arguments in place of calls of a macro that is its argument, except of calls in them."""
    first, *rest = code.split(f"{macro}(")
    texts = [first]
    for text in rest:
        argument, _, after = text.partition(")")
        last = texts[-1]
        is_other = last[-1:].isidentifier() or last[-1:].isdigit() or last.endswith("#define ")
        texts += [f"{macro}(", text] if is_other or "(" in argument else [f"{argument}{after}"]
    return "".join(texts)


def _parts_of(code: str) -> list[Part]:
    """Return the parts of a text at file scope in order."""
    return [*_parts(nested(pieces(code))[0], macros_of(code))]


def _parts(block: Block, macros: Mapping[str, Macro], conditions: tuple[str, ...] = ()) -> Iterator[Part]:
    """Yield the parts of a block at file scope in order."""
    joined, opened = False, False
    section, comment = tuple[str, ...](), tuple[str, ...]()
    for piece in block:
        kind, text = ("directive", piece[0].line) if isinstance(piece, list) else piece
        if kind == "blank":
            if comment:
                section, opened = ((*section, "\n".join(comment)) if opened else ("\n".join(comment),)), True
            comment, joined = (), False
            continue
        if kind == "comment":
            comment += (text,)
            continue
        comment = tuple(_for_readers("\n".join(comment)).split("\n")) if comment else ()
        whole = Part(comment, (*text.split("\n"),), frozenset(), conditions, section, joined and not comment)
        if isinstance(piece, list):
            inside = *conditions, text
            yield _conditional(whole, ((line, tuple(_parts(block, macros, inside))) for line, block in piece))
        else:
            word, name = directive(text)
            yield replace(whole, names=frozenset([name] if word == "undef" else names_of(text, macros)) - PREFIXED)
        comment, joined, opened = (), True, False


def _conditional(part: Part, branches: Iterable[tuple[str, tuple[Part, ...]]]) -> Part:
    """Return a part that consists of branches."""
    branches = tuple(branches)
    names = frozenset(name for _, parts in branches for inner in parts for name in inner.names)
    lines = [text for line, parts in branches for text in (line, *_lines(parts))]
    return replace(part, lines=(*lines, "#endif"), names=names, branches=branches)


def _for_readers(comment: str) -> str:
    """Return a comment without what its templates require."""
    before, required, after = comment.partition("Requires:")
    if not required:
        return comment
    return before.rstrip().removesuffix("\n *").rstrip() + after[after.index(" */") :]


def _alternatives(comment: str) -> frozenset[str]:
    """Return the names of alternatives or numbers in a comment."""
    in_comment = words(comment.strip("/*"))
    return frozenset(w for w in in_comment if w.isupper() and w.replace("_", "").isalpha() and len(w.split("_")[0]) > 3)


@dataclass(frozen=True, slots=True)
class Function:
    """A function of a source.

    Attributes:
        name: as it is called.
        arguments: their names in order.
        comment: the one above it, on one line, or empty.
        text: all of it, without the comment; of which ``body`` is between its braces.
        calls: the functions of the same source that it calls, in order of first call.
    """

    name: str
    arguments: tuple[str, ...]
    comment: str
    text: str
    calls: tuple[str, ...]

    @property
    def body(self) -> str:
        """Lines between its braces."""
        return self.text.partition("\n{\n")[2].removesuffix("}")


def functions_of(code: str) -> dict[str, Function]:
    """Return every function with a body, by its exported or own name, in order; of alternatives the first."""
    code, exported = _without_aliases(code), exported_names([code])
    bodies: dict[str, Part] = {}
    for part in _parts_of(code):
        for leaf in part.leaves:
            if "{" in leaf.lines:
                (name,) = leaf.names
                bodies.setdefault(exported.get(name, name), leaf)
    functions = {}
    for name, leaf in bodies.items():
        text = renamed("\n".join(leaf.lines), exported)
        above = "\n".join(leaf.comment).rpartition("/*")[2].removesuffix("*/")
        comment = " ".join(above.replace("\n *", " ").split())
        called = dict.fromkeys(word for word, after in pairwise(tokens(text)) if after == "(" and word in bodies)
        calls = tuple(word for word in called if word != name)
        functions[name] = Function(name, (*_arguments(text, name),), comment, text, calls)
    return functions


def _arguments(text: str, name: str) -> Iterator[str]:
    """Yield the names of the arguments of a function."""
    head = [*tokens(text.partition("\n{\n")[0])]
    for argument, after in pairwise(head[head.index(name) + 1 :]):
        if argument.isidentifier() and argument != "void" and after in (",", ")", "["):
            yield argument


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
    return _conditional(part, branches)


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
        comments = [_for_readers(comment) for comment in part.section]
        section = [comment for comment in comments if comment != "/* */" and _alternatives(comment) <= names]
        kept.append(replace(part, section=tuple(section)))
    return kept
