"""Words of the project: docstrings, messages, identifiers and pages, and the terms that are not used in them.

python tests/tools/language.py messages     # every error, warning, report and help text, with file and line
python tests/tools/language.py docstrings   # first lines
python tests/tools/language.py words        # retired words with their places
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
FRAGMENT = re.compile(
    r"(What|Of|Whether|How|Those|The same|One|From|With|As|Which|Where|When|All of|And|But|For|In|On|By|To|So|That|"
    r"Then|It|Its|They|Nothing|None|Not|Until|If|Out of|Before|After|Here|There|Who)\b"
)
"""Beginning of a docstring that names nothing and tells to do nothing."""
RETIRED_PHRASES = {
    r"choos\w+ (their|its) (own )?length|of their own lengths?": "adaptive step size",
    r"steps of one length": "fixed step size",
    r"lengths? of (a|the) steps?": "step size",
    r"\bladders?\b|\brungs?\b": "step-size grid, level",
    r"\bsweeps?\b|\bswept\b|\bsweeping\b": "fixed-point iteration",
    r"\bcom(e|es|ing) to rest\b": "converges",
    r"\bas good as nothing\b": "below machine precision",
    r"\bnearby motions?\b|\bsmall changes\b": "tangent vectors",
    r"\bpush and pull\b": "JVP and VJP",
    r"\bjoined by lines\b": "piecewise linear interpolation",
    r"\bheld against\b": "compared with",
    r"\bsums over indices\b|\bgather(s|ed|ing)? sums\b": "array systems, rolled sums",
    r"\bpoints famil(y|ies)\b": "stage group",
    r"\bneighbours that answer\b": "stencil probing",
    r"\bcrowds?\b": "ensemble, batch",
    r"\bpromises?\b": "guaranteed property",
    r"\bown time\b": "transformed time",
    r"\bmoved onto\b": "projected onto",
    r"\bborrow(s|ed)?\b|\blent\b": "fallback library",
    r"\btold\b|\bsays? so\b|\bis said\b|\bare said\b": "reported, computed",
    r"\bno number\b": "NaN",
    r"\b(a|the|its) monitor\b|\bmonitor functions?\b": "time transformation",
}
RETIRED_NAMES = frozenset(
    re.findall(
        r"\w+",
        "slopes sweep sweeps swept sweeping goal goals rung rungs ladder octave octaves crowd lent borrowed told said "
        "bent promise promises pace paces companions stretch portions gather_sums expand_sums drive_ensemble "
        "solve_motion monitor monitors monitored strayed stray strays vanished stalled bends heed awaited octave",
    )
)
"""Words of identifiers that have a standard term; see the glossary of the documentation."""
RETIRED_NAMES_OF_TESTS = RETIRED_NAMES | frozenset(
    re.findall(
        r"\w+",
        "say says saying tell tells kept keeps stray strays beside stands lender borrows promised nobody anew nought "
        "whatever however wherever aloud goes gone",
    )
)
"""Words that are not used in the names of tests and of their variables, either."""
FRAGMENT_OF_TEST = re.compile(r"test_(what|of|where|it|its|they|there|who|nor|so|these|those)_")
"""Beginning of a test name that refers to something outside the name instead of a property."""


class Text(NamedTuple):
    """A piece of text with its place."""

    path: Path
    line: int
    text: str


def package() -> list[Path]:
    """Python files of the package and of its benchmarks."""
    return sorted(path for folder in ("scvi_codegen", "benchmarks") for path in (ROOT / folder).rglob("*.py"))


def templates() -> list[Path]:
    """Templates and headers of the generated C."""
    return sorted(path for path in (ROOT / "templates").rglob("*") if path.suffix in (".h", ".jinja", ".c"))


def pages() -> list[Path]:
    """Pages of the documentation."""
    return [ROOT / "README.md", ROOT / "SECURITY.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def docstrings() -> Iterator[Text]:
    """Docstrings of modules, classes and functions of the package."""
    for path in package():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text:
                    yield Text(path, getattr(node, "lineno", 1), text)


def unknown_arguments() -> Iterator[Text]:
    """Names under ``Args:`` of a function that are none of its parameters."""
    for path in package():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                own = {each.arg for each in ast.walk(node.args) if isinstance(each, ast.arg)}
                entries = re.search(r"^Args:\n((?: .*\n?|\n)*)", ast.get_docstring(node) or "", re.MULTILINE)
                for names in re.findall(
                    r"^    ((?:\*{0,2}\w+, )*\*{0,2}\w+):", entries[1] if entries else "", re.MULTILINE
                ):
                    if unknown := set(names.replace("*", "").split(", ")) - own:
                        yield Text(path, node.lineno, ", ".join(sorted(unknown)))


def messages() -> Iterator[Text]:
    """Texts of errors, warnings, reports and help: strings in calls that raise, warn, print or describe an option."""
    spoken = re.compile(r"(Error|Warning|warn|echo|print|option|argument|command|ClickException|Check)$")
    for path in package():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and spoken.search(_name(node.func)):
                for value in (*node.args, *(keyword.value for keyword in node.keywords)):
                    text = _flat(value)
                    if " " in text.strip():
                        yield Text(path, value.lineno, text)


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def _flat(value: ast.expr) -> str:
    """Text of a string, an f-string or a sum of them, with fields in braces."""
    match value:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(map(_flat, parts))
        case ast.FormattedValue(value=inner):
            return "{" + ast.unparse(inner) + "}"
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _flat(left) + _flat(right)
        case ast.IfExp(body=body, orelse=other):
            return f"{_flat(body)} | {_flat(other)}"
    return ""


@cache
def _tokens(path: Path) -> tuple[list[tuple[int, str]], dict[str, int]]:
    """Return the strings and comments of a file with their lines, and its names with the first line of each."""
    strings, names = [], dict[str, int]()
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type in (tokenize.STRING, tokenize.COMMENT):
            strings.append((token.start[0], token.string))
        elif token.type == tokenize.NAME:
            names.setdefault(token.string, token.start[0])
    return strings, names


def prose() -> Iterator[Text]:
    """Everything that people read: docstrings and strings of the package, comments, pages without their code."""
    for path in package():
        for line, string in _tokens(path)[0]:
            yield Text(path, line, re.sub(r"\{[^{}]*\}|``[^`]*``|`[^`]*`", " ", string))
    for path in templates():
        text = path.read_text(encoding="utf-8")
        for found in re.finditer(r"/\*.*?\*/|\{#.*?#\}|//[^\n]*", text, re.DOTALL):
            yield Text(path, text.count("\n", 0, found.start()) + 1, found[0])
    for path in pages():
        text = re.sub(r"<!--.*?-->", _blank, path.read_text(encoding="utf-8"), flags=re.DOTALL)  # words of users
        text = re.sub(r"^(```|~~~).*?^\1", _blank, text, flags=re.DOTALL | re.MULTILINE)
        for number, line in enumerate(re.sub(r"`[^`\n]*`", " ", text).splitlines(), 1):
            yield Text(path, number, line)


def _blank(found: re.Match[str]) -> str:
    return "\n" * found[0].count("\n")


def identifiers() -> Iterator[Text]:
    """Names in the code of the package and of the templates, and names of files."""
    for path in (*package(), *templates()):
        yield Text(path, 0, path.name.partition(".")[0])
    for path in package():
        for name, line in _tokens(path)[1].items():
            yield Text(path, line, name)
    for path in templates():
        text = path.read_text(encoding="utf-8")
        code = re.sub(r'/\*.*?\*/|\{#.*?#\}|//[^\n]*|"[^"\n]*"', _blank, text, flags=re.DOTALL)
        for found in re.finditer(r"[A-Za-z_]\w*", code):
            yield Text(path, code.count("\n", 0, found.start()) + 1, found[0])


def names_in_tests() -> Iterator[Text]:
    """Names of functions, classes, arguments and variables that are defined in the tests."""
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Name(id=name, ctx=ast.Store()) | ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                    yield Text(path, node.lineno, name)
                case ast.arg(arg=name):
                    yield Text(path, node.lineno, name)


@cache
def words_of(identifier: str) -> set[str]:
    """Words of a name in snake case or camel case, in lower case, and the whole of it."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", identifier)
    return {word.lower() for word in spaced.split("_") if word} | {identifier.lower()}


def is_retired_in_tests(name: str) -> bool:
    """Return whether a name defined in the tests has a retired word, or begins as a fragment."""
    return bool(words_of(name) & RETIRED_NAMES_OF_TESTS or FRAGMENT_OF_TEST.match(name))


def main() -> None:
    kind = sys.argv[1] if len(sys.argv) > 1 else "words"
    if kind == "messages":
        found = list(messages())
    elif kind == "docstrings":
        found = [text._replace(text=text.text.splitlines()[0]) for text in docstrings()]
    else:
        retired = re.compile("|".join(RETIRED_PHRASES), re.IGNORECASE)
        found = [text._replace(text=hit[0]) for text in prose() for hit in retired.finditer(text.text)]
        found += [text for text in identifiers() if words_of(text.text) & RETIRED_NAMES]
        found += [text for text in names_in_tests() if is_retired_in_tests(text.text)]
    for path, line, text in found:
        print(f"{path.relative_to(ROOT)}:{line}: {' '.join(text.split())}")
    print(f"{len(found)} in all")


if __name__ == "__main__":
    main()
