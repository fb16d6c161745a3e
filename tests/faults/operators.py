"""Where one small thing of a file may be wrong: a sign, an operator, an index, a constant, a name, a line left out."""

import ast
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Place:
    """A fault: what stands from one character to another of a file, and what is put there."""

    path: str
    start: int
    end: int
    old: str
    new: str
    kind: str

    def name(self, text: str) -> str:
        """``path:line kind: old -> new``, for people and as key."""
        line = text.count("\n", 0, self.start) + 1
        column = self.start - text.rfind("\n", 0, self.start)
        return f"{self.path}:{line}:{column} {self.kind}: {' '.join(self.old.split())} -> {self.new}"

    def applied(self, text: str) -> str:
        return text[: self.start] + self.new + text[self.end :]


def places(root: Path, path: str) -> list[Place]:
    """All that the operators find in a file of Python or of C."""
    text = (root / path).read_text()
    found = _python(text) if path.endswith(".py") else _c(text)
    return [Place(path, start, end, text[start:end], new, kind) for kind, start, end, new in found]


Edit = tuple[str, int, int, str]

# C.

C_EDITS: tuple[tuple[str, str, str], ...] = (
    ("sign", r" \+ ", " - "),
    ("sign", r" - ", " + "),
    ("sign", r" \+= ", " -= "),
    ("sign", r" -= ", " += "),
    ("operator", r" \* ", " / "),
    ("operator", r" / ", " * "),
    ("comparison", r" < ", " <= "),
    ("comparison", r" > ", " <= "),
    ("comparison", r" <= ", " > "),
    ("comparison", r" >= ", " < "),
    ("comparison", r" == ", " != "),
    ("logic", r" && ", " || "),
    ("logic", r" \|\| ", " && "),
    ("index", r"\[i\]", "[0]"),
    ("index", r"\[n\]", "[0]"),
    ("index", r"\[b\]", "[0]"),
    ("index", r"\bM \+ i\b", "i"),
    ("constant", r"(?<![\w.\[])0(?:\.0)?(?![\w.])", "1"),
    ("constant", r"(?<![\w.\[])1(?:\.0)?(?![\w.])", "2"),
    ("constant", r"(?<![\w.\[])[2-9](?:\.\d)?(?![\w.])", "1"),
    ("constant", r"\b1e-(?:\d+)\b", "1e-3"),
    ("name", r"\bcarry_q\b", "carry_p"),
    ("name", r"\bcarry_p\b", "carry_q"),
    ("name", r"\bq0\b", "p0"),
    ("name", r"\bp0\b", "q0"),
    ("name", r"\bdq\b", "dp"),
    ("name", r"\bdp\b", "dq"),
    ("name", r"\bLAST\b", "BEFORE"),
    ("name", r"\bLAST_ALONE\b", "LAST"),
    ("name", r"\bsize_q\b", "size_p"),
    ("name", r"\blarger\b", "smaller"),
)
DECLARES = "return|const|static|typedef|int |real |double |lanes |lane_view|coordinates|number |progress|movement"
C_LINE = re.compile(rf"(?<=  )(?! |break|continue|else|{DECLARES})[^#\n{{}}=]*(?:=[^#\n{{}}]*)?;$", re.M)


def _c(text: str) -> Iterator[Edit]:
    """Of code; comments, macros' names, types of arrays and the heads of functions stay."""
    code = re.sub(r"/\*.*?\*/|\{#.*?#\}|\{%.*?%\}|^#[^\n]*$|^[a-z][^\n]*$", _blank, text, flags=re.S | re.M)
    for kind, pattern, new in C_EDITS:
        yield from ((kind, found.start(), found.end(), new) for found in re.finditer(pattern, code))
    yield from (("dropped line", found.start(), found.end(), ";") for found in C_LINE.finditer(code))


def _blank(found: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", found[0])


# Python.

SWAPS: dict[type[ast.AST], str] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "+",
    ast.Div: "*",
    ast.Pow: "*",
    ast.FloorDiv: "*",
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.In: "not in",
    ast.NotIn: "in",
    ast.Is: "is not",
    ast.IsNot: "is",
}


def _python(text: str) -> Iterator[Edit]:
    """Of what is executed; messages, annotations, docstrings and decorators stay."""
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    if len(text) != len(text.encode()):
        return

    def span(node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    for node in _executed(ast.parse(text)):
        yield from _edits(node, text, span)


Span = Callable[[ast.expr | ast.stmt], tuple[int, int]]


def _edits(node: ast.AST, text: str, span: Span) -> Iterator[Edit]:
    if isinstance(node, ast.BinOp | ast.Compare):
        yield from _operator(node, text, span)
    elif isinstance(node, ast.BoolOp):
        word, other = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        here = text.find(f" {word} ", span(node.values[0])[1], span(node)[1])
        yield "logic", here + 1, here + 1 + len(word), other
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield "sign", span(node)[0], span(node.operand)[0], ""
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool | int):
        yield "constant", *span(node), str(not node.value if isinstance(node.value, bool) else node.value + 1)
    elif isinstance(node, ast.IfExp):
        yield "branch", *span(node), f"({text[slice(*span(node.orelse))]})"
    elif isinstance(node, ast.Call):
        yield from _call(node, text, span)
    elif isinstance(node, ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield "dropped line", *span(node), "pass"


def _operator(node: ast.BinOp | ast.Compare, text: str, span: Span) -> Iterator[Edit]:
    after = node.right if isinstance(node, ast.BinOp) else node.comparators[0]
    sign = node.op if isinstance(node, ast.BinOp) else node.ops[0]
    first = span(node.left)[1]
    between = re.search(r"[^\s()]+(?: (?:in|not))?", text[first : span(after)[0]])
    if between and type(sign) in SWAPS and not isinstance(after, ast.JoinedStr):
        yield "operator", first + between.start(), first + between.end(), SWAPS[type(sign)]


def _call(node: ast.Call, text: str, span: Span) -> Iterator[Edit]:
    """A keyword left out: what a default then says; the first two arguments exchanged."""
    for word in node.keywords:
        if word.arg and node.args:
            start, end = span(node.args[-1])[1], span(node)[1]
            value_start, value_end = span(word.value)
            here = text.rfind(",", start, value_start)
            if here >= 0:
                yield "keyword left out", here, value_end, ""
    if len(node.args) >= 2 and not any(isinstance(argument, ast.Starred) for argument in node.args[:2]):
        (first, end), (second, last) = span(node.args[0]), span(node.args[1])
        yield "exchange", first, last, f"{text[second:last]}{text[end:second]}{text[first:end]}"


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes below, without those that only speak."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            speaks = isinstance(child, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom)
            if isinstance(child, ast.AST) and not speaks:
                yield child
                yield from _executed(child)
