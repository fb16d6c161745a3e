"""What a certificate says: one check a promise, with the number measured and the bound it is held to."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from typing import IO, Any, NamedTuple

from scvi_codegen.display.cards import Html, card, grid, plain
from scvi_codegen.errors import MethodError, StateError, StepFailedError, SystemDefinitionError
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.native.waiting import waiting_for

__all__ = [
    "BrokenError",
    "Certificate",
    "Check",
    "Finding",
    "Outcome",
    "checked",
    "information",
    "issued",
]


class Outcome(StrEnum):
    """What became of a promise."""

    KEPT = "kept"
    BROKEN = "BROKEN"
    NOT_MEASURED = "not measured"
    INFORMATION = "information"


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One promise, and what was measured.

    Attributes:
        name: a word or two.
        promise: the sentence that is to hold, or what the number of an information is.
        outcome: kept, broken, not measured, or an information without a promise.
        measured: the number, or ``None``.
        bound: what it is held to, or ``None``.
        remark: where and how it was measured; why it was not.
    """

    name: str
    promise: str
    outcome: Outcome
    measured: float | None = None
    bound: float | None = None
    remark: str = ""

    def __str__(self) -> str:
        numbers = "" if self.measured is None else f"{self.measured:.3g}"
        if self.bound is not None:
            numbers += f" (bound {self.bound:.3g})"
        end = "; ".join(part for part in (numbers, self.remark) if part)
        return f"{self.outcome.value:12}  {self.name}: {self.promise}{': ' + end if end else ''}"


class Finding(NamedTuple):
    """A number, and what it is held to: at most the bound, or at least."""

    measured: float
    bound: float
    remark: str = ""
    at_least: bool = False

    @property
    def kept(self) -> bool:
        """Whether it is on the right side; a NaN never is."""
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound


class BrokenError(Exception):
    """A promise that fails without a number."""


def checked(name: str, promise: str, measure: Callable[[], Finding | None]) -> Iterator[Check]:
    """The check of a promise; nothing where it does not apply, and the reason where it cannot be measured."""
    outcome, remark, finding = Outcome.NOT_MEASURED, "", None
    try:
        with waiting_for(f"measuring {name}"):
            finding = measure()
        if finding is None:
            return
        outcome, remark = Outcome.KEPT if finding.kept else Outcome.BROKEN, finding.remark
    except BrokenError as fault:
        outcome, remark = Outcome.BROKEN, str(fault)
    except (StateError, StepFailedError, MethodError, SystemDefinitionError, ArithmeticError) as reason:
        remark = str(reason)
    yield Check(
        name=name,
        promise=promise,
        outcome=outcome,
        measured=finding and finding.measured,
        bound=finding and finding.bound,
        remark=remark,
    )


def information(name: str, what: str, measured: float | None, remark: str = "") -> Check:
    """A number that no promise is about."""
    return Check(name=name, promise=what, outcome=Outcome.INFORMATION, measured=measured, remark=remark)


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """What an integrator promises, and what was measured of it as it was built.

    Attributes:
        title: system and method.
        system, method: their names.
        version: of the generator.
        checksum: SHA-256 of header and source, as in ``sha256sum`` of both files one after the other.
        flags: of the C compiler.
        q, p, t, h: the state and the step it was asked for.
        parameters: default values by name.
        checks: in the order of measurement.
        seconds: that it took.
    """

    title: str
    system: str
    method: str
    version: str
    checksum: str
    flags: tuple[str, ...]
    q: tuple[float, ...]
    p: tuple[float, ...]
    t: float
    h: float
    parameters: dict[str, float]
    checks: tuple[Check, ...]
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether no promise is broken; those not measured are listed in :attr:`not_measured`."""
        return not self.broken

    @property
    def broken(self) -> tuple[Check, ...]:
        """The promises that do not hold."""
        return self._with(Outcome.BROKEN)

    @property
    def not_measured(self) -> tuple[Check, ...]:
        """The promises of which nothing is known, each with its reason."""
        return self._with(Outcome.NOT_MEASURED)

    def _with(self, outcome: Outcome) -> tuple[Check, ...]:
        return tuple(check for check in self.checks if check.outcome is outcome)

    @property
    def verdict(self) -> str:
        """Whether promises are kept, and how many."""
        counts = Counter(check.outcome for check in self.checks)
        verdict = "every promise measured is kept" if self.passed else "PROMISES ARE BROKEN"
        numbers = ", ".join(f"{counts[outcome]} {outcome.value}" for outcome in Outcome if counts[outcome])
        return f"{verdict}: {numbers}"

    def to_text(self) -> str:
        """A line a check, and the verdict."""
        head = [self.title, f"C source sha256 {self.checksum}", f"flags {' '.join(self.flags)}; step {self.h:g}", ""]
        return "\n".join([*head, *map(str, self.checks), "", f"{self.verdict}; {self.seconds:.1f} s"]) + "\n"

    def _repr_html_(self) -> str:
        facts = (
            ("verdict", plain(self.verdict)),
            ("C source", plain(f"sha256 {self.checksum}")),
            ("step", plain(f"{self.h:g}")),
        )
        head = ("", "outcome", "measured", "bound", "promise")
        return card(self.title, facts, grid(map(_row, self.checks), head=head))

    def to_json(self) -> str:
        """All of it, for programs; numbers that are not finite are strings."""
        return json.dumps({"passed": self.passed, **_finite(asdict(self))}, indent=1, allow_nan=False) + "\n"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the JSON, whole or not at all."""
        write_atomically(path, partial(_write, self.to_json()))


def issued(files: Mapping[str, str], *, q: Iterable[float], p: Iterable[float], **said: Any) -> Certificate:
    """The certificate of C files by name, for a state, with what else is said in it."""
    return Certificate(
        version=_installed_version(),
        checksum=hashlib.sha256("".join(files.values()).encode()).hexdigest(),
        q=tuple(map(float, q)),
        p=tuple(map(float, p)),
        **said,
    )


def _installed_version() -> str:
    """Of this package."""
    try:
        return importlib.metadata.version("scvi-codegen")
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _row(check: Check) -> tuple[Html, ...]:
    """Of the table in a notebook; what is broken stands out."""
    outcome = plain(check.outcome.value)
    if check.outcome is Outcome.BROKEN:
        outcome = Html(f"<strong>{outcome}</strong>")
    numbers = ["" if number is None else f"{number:.3g}" for number in (check.measured, check.bound)]
    words = "; ".join(filter(None, (check.promise, check.remark)))
    return plain(check.name), outcome, *map(plain, numbers), plain(words)


def _write(text: str, file: IO[bytes]) -> None:
    file.write(text.encode())


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
