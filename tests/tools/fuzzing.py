"""Hostile input: texts from a seeded generator and from a corpus, and a guard under which they are read.

Everything is drawn from one ``random.Random``, so that a failing input is found again by its number alone.
"""

import re
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, TypeVar

from counting import TooMuchWorkError, at_most

from scvi_codegen.common.cache import cache_folder

CORPUS = Path(__file__).parents[1] / "corpus"
MOST_CALLS = 30_000_000
"""Of functions for one input, the same number on a slow or busy machine; the tableau of 64 stages takes 14 million."""
MOST_MEMORY = 2**30
SECONDS = 300
"""Of processor time: ends what runs away without calling anything."""

Result = TypeVar("Result")


class RanCodeError(BaseException):
    """Something was compiled, executed, written or started."""


FORBIDDEN = (
    *(
        "compile",
        "exec",
        "subprocess.",
        "socket.",
        "shutil.",
        "ctypes.",
        "code.",
        "webbrowser.",
        "urllib.",
        "tempfile.",
    ),
    *(
        f"os.{name}"
        for name in ("system", "exec", "posix_spawn", "spawn", "fork", "startfile", "kill", "putenv", "chdir")
    ),
    *(f"os.{name}" for name in ("remove", "rename", "mkdir", "rmdir", "link", "symlink", "chmod", "truncate")),
)
_watching: list[str] = []
_opened: list[str] = []
"""Files that were opened for reading while a guard is in force."""


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watching:
        return
    if event == "exec" and getattr(arguments[0], "co_name", "") == "<module>":
        return  # SymPy imports some of its parts when they are first needed
    if event == "compile" and str(arguments[1]).endswith(".py"):
        return  # the same, where they are not yet compiled
    if event == "compile" and str(arguments[0]).startswith("b'lambda _cls,"):
        return  # a named tuple in one of them
    writes = event == "open" and isinstance(arguments[1], str) and not set(arguments[1]).isdisjoint("wax+")
    if event == "open" and not writes:
        _opened.append(str(arguments[0]))
    if writes or event.startswith(FORBIDDEN):
        _watching.append(f"{event}{arguments!r:.200}")


sys.addaudithook(_watch)


@contextmanager
def guarded(most_calls: int = MOST_CALLS, *, may_compile: bool = False) -> Iterator[None]:
    """Refuse code that is run, files that are written, processes that are started, and more than some function calls.

    SymPy's polynomials and Jinja's templates compile code of their own: behind the front end that may be.
    """

    def ring(*_: object) -> None:
        raise TooMuchWorkError

    before = signal.signal(signal.SIGVTALRM, ring)
    _watching.append("")
    _opened.clear()
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        with at_most(most_calls):
            yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
        events = _watching[1:]
        _watching.clear()
    if may_compile:
        events = [event for event in events if not event.startswith(("compile(", "exec("))]
    if events:
        raise RanCodeError(events[0])


def foreign_files(folder: Path, text: str) -> list[str]:
    """Return files opened under the last guard that are not in a folder, named in a text, or of the program."""
    program = (sys.prefix, sys.base_prefix, *filter(None, sys.path), Path(__file__).parents[2], "/proc", cache_folder())
    own = [str(Path(each).resolve()) for each in (folder, *program)]
    return [
        name
        for name in _opened
        if not name.isdigit() and not any(str(Path(name).resolve()).startswith(each) for each in own)
        if Path(name).name not in text
    ]


@contextmanager
def limited_memory(more: int = MOST_MEMORY) -> Iterator[None]:
    """Refuse allocations that exceed the present size of the process by more than some bytes."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@cache
def seeds(name: str) -> tuple[str, ...]:
    """Texts of ``corpus/<name>``: the files of a folder, or the lines of a file in Python's notation."""
    path = CORPUS / name
    if path.is_dir():
        return tuple(file.read_bytes().decode("utf-8", "surrogateescape") for file in sorted(path.iterdir()))
    return tuple(line.encode().decode("unicode_escape") for line in path.read_text("utf-8").splitlines())


NUMBERS = """
    0 1 2 3 64 65 0.1 .5 3. 1e-3 1e300 1e-300 1e308 1e309 1e-324 1e999 9999999999999999999 0.30000000000000004 1e0
    00 1_0 0x10 1j 1e 1e+ 10000 1e5 1e-9999999 4503599627370497
""".split()  # noqa: SIM905  (a paragraph of words reads better)
VALUE = re.compile(r'(?<![\w.])-?[0-9][\w.]*|"[^"\n]*"')
"""Numbers and quoted texts of a file."""
EXTREME = (
    "2000000000", "99999999", "-1", "1e-300", "-1e300", "inf", "nan", "[]", "{}", "true", "../x.csv", "/dev/zero",
)  # fmt: skip
NAMES = "x y z x x y t pi q q_dot p m sin exp e E I oo nan inf zoo S N Q".split()  # noqa: SIM905
FUNCTIONS = """
    sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp log sqrt sqrt sin cos abs Abs eval __import__
    lambdify Integer Symbol sign gamma max min where positive_part unit_step
""".split()  # noqa: SIM905
OPERATORS = ["+", "-", "*", "/", "**", "+", "*", " - ", " + "]
POISON = [
    "__import__('os').system('x')", "().__class__", "x.__class__", "lambda x: x", "eval('1')",
    "open('f','w')", "'a'*9**9",
    "{0}", "[x]", "x;y", "x=1", "*/", "/*", "\\", "\n#include <x>", "`ls`", "$(ls)", "%s%n", "\x00", "\ud800", "\u202e",
    "٣", "ｘ", "x̂", "'''", '"""', "\r", "\t", "**", "((((((((", "))))))))", "--------", "1" * 400, "x" * 300,
]  # fmt: skip


def formula(random: Random, depth: int = 0) -> str:
    """A text of the grammar, or nearly."""
    kind = random.random()
    if depth > 5 or kind < 0.30:
        return random.choice(NUMBERS if random.random() < 0.4 else NAMES)
    if kind < 0.65:
        parts = [formula(random, depth + 1) for _ in range(random.choice((2, 2, 2, 3, 5)))]
        return "".join(part + random.choice(OPERATORS) for part in parts[:-1]) + parts[-1]
    if kind < 0.80:
        return f"({formula(random, depth + 1)})"
    if kind < 0.97:
        arguments = ", ".join(formula(random, depth + 1) for _ in range(2 if random.random() < 0.1 else 1))
        return f"{random.choice(FUNCTIONS)}({arguments})"
    return random.choice(POISON)


def mutated(random: Random, text: str, others: tuple[str, ...]) -> str:
    """The text with a few characters or pieces taken out, doubled, changed or put in."""
    for _ in range(random.choice((1, 1, 2, 4))):
        start = random.randrange(len(text) + 1)
        end = min(len(text), start + random.choice((0, 1, 1, 2, 8, 40)))
        other = random.choice(others)
        piece = random.randrange(len(other) + 1)
        new = random.choice(
            (
                "",
                text[start:end] * random.choice((2, 2, 30)),
                random.choice(POISON),
                random.choice(NUMBERS),
                chr(
                    random.choice(
                        (0, 10, 34, 39, 46, 91, 93, 123, 125, 127, 233, 0x3B8, 0x2028, random.randrange(0xD800))
                    )
                ),
                other[piece : piece + random.choice((3, 10, 60))],
            )
        )
        text = text[:start] + new + text[end:]
    return text[:4000]


def damaged(random: Random, data: bytes, others: tuple[str, ...]) -> bytes:
    """The bytes of a file with the end cut off, some bytes or, mostly, a value changed, or as :func:`mutated`."""
    kind = random.random()
    if kind < 0.05:
        return data[: random.randrange(len(data) + 1)]
    try:
        text = data.decode()
    except UnicodeDecodeError:
        kind = 0.1
    if kind < 0.15:
        changed = bytearray(data)
        for place in random.choices(range(len(data)), k=random.choice((1, 1, 2, 8))):
            changed[place] = random.choice((0, 255, random.randrange(256), changed[place] ^ 1 << random.randrange(8)))
        return bytes(changed)
    start = random.randrange(max(1, len(text) - 2000))
    part, values = text[start : start + 2000], []
    if kind < 0.85:
        values = list(VALUE.finditer(part))
    for value in random.sample(values, min(len(values), 1)):
        plain = random.choice((*NUMBERS, *EXTREME, *[random.choice(NAMES), repr(random.random()), formula(random)] * 9))
        quoted = value[0][0] == '"' or random.random() < 0.05
        new = f'"{random.choice((plain, plain, plain, random.choice(POISON)))}"' if quoted else plain
        part = part[: value.start()] + new + part[value.end() :]
    part = part if values else mutated(random, part, others)
    return (text[:start] + part + text[start + 2000 :]).encode("utf-8", "surrogatepass")


def quietly(call: Callable[..., Result], *arguments: Any, expected: type[Exception]) -> Result | None:
    """Return the result of the call under the guard; ``None`` if it raises the expected error."""
    with guarded():
        try:
            return call(*arguments)
        except expected:
            return None
