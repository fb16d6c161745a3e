"""Certificate: one check for each guaranteed property, with the measured number and its bound."""

import hashlib
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from scvi_codegen.api.text import Html, announced, summary, write_text
from scvi_codegen.common.errors import EventError, MethodError, StateError, StepFailedError, SystemDefinitionError
from scvi_codegen.extras.verification.system_under_test import State
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.version import __version__


class Outcome(StrEnum):
    """Result of a check."""

    SATISFIED = "satisfied"
    VIOLATED = "VIOLATED"
    NOT_MEASURED = "not measured"
    INFORMATION = "information"


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Guaranteed property and its measurement.

    Attributes:
        name: short name.
        statement: statement of the property; for an information, what its number means.
        outcome: property holds, is violated, or was not measured; or an information without a property.
        measured: measured number, or ``None``.
        bound: bound on that number, or ``None``.
        remark: where and how it was measured, or why it was not.
    """

    name: str
    statement: str
    outcome: Outcome
    measured: float | None = None
    bound: float | None = None
    remark: str = ""

    def __str__(self) -> str:
        numbers = "" if self.measured is None else f"{self.measured:.3g}"
        if self.bound is not None:
            numbers += f" (bound {self.bound:.3g})"
        end = "; ".join(part for part in (numbers, self.remark) if part)
        return f"{self.outcome.value:12}  {self.name}: {self.statement}{': ' + end if end else ''}"


class Finding(NamedTuple):
    """Measured number and its upper bound, or lower bound if ``at_least``."""

    measured: float
    bound: float
    remark: str = ""
    at_least: bool = False

    @property
    def satisfied(self) -> bool:
        """True if the number satisfies the bound; a NaN never does."""
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound


class ViolationError(Exception):
    """Violation of a property that is not expressed by a number."""


def checked(name: str, statement: str, measure: Callable[[], Finding | None]) -> Iterator[Check]:
    """Yield the check of a property; nothing if it does not apply, the reason if it cannot be measured."""
    outcome, remark, finding = Outcome.NOT_MEASURED, "", None
    try:
        with announced(f"measuring {name}"):
            finding = measure()
        if finding is None:
            return
        outcome, remark = Outcome.SATISFIED if finding.satisfied else Outcome.VIOLATED, finding.remark
    except ViolationError as fault:
        outcome, remark = Outcome.VIOLATED, str(fault)
    except (StateError, EventError, StepFailedError, MethodError, SystemDefinitionError, ArithmeticError) as reason:
        remark = str(reason)
    yield Check(
        name=name,
        statement=statement,
        outcome=outcome,
        measured=finding and finding.measured,
        bound=finding and finding.bound,
        remark=remark,
    )


def information(name: str, statement: str, measured: float | None, remark: str = "") -> Check:
    """Return a measured number without a bound."""
    return Check(name=name, statement=statement, outcome=Outcome.INFORMATION, measured=measured, remark=remark)


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """Guaranteed properties of an integrator, and their measurement on the code as built.

    Attributes:
        title: system and method.
        system, method: their names.
        version: version of the generator.
        checksum: SHA-256 of header and source, as ``sha256sum`` of both files concatenated.
        flags: flags of the C compiler.
        q, p, t, h: state and step size of the measurement.
        parameters: default values by name.
        checks: checks in the order of measurement.
        seconds: duration of the measurement.
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

    __repr__ = summary("system", "method", "verdict")

    @property
    def passed(self) -> bool:
        """True if no property is violated; properties not measured are in :attr:`not_measured`."""
        return not self.violated

    @property
    def violated(self) -> tuple[Check, ...]:
        """Checks of violated properties."""
        return self._with(Outcome.VIOLATED)

    @property
    def not_measured(self) -> tuple[Check, ...]:
        """Checks of properties that could not be measured; the remark is the reason."""
        return self._with(Outcome.NOT_MEASURED)

    def _with(self, outcome: Outcome) -> tuple[Check, ...]:
        return tuple(check for check in self.checks if check.outcome is outcome)

    @property
    def verdict(self) -> str:
        """Summary: whether properties are violated, and the number of checks by outcome."""
        counts = Counter(check.outcome for check in self.checks)
        verdict = "all measured properties are satisfied" if self.passed else "PROPERTIES ARE VIOLATED"
        numbers = ", ".join(f"{counts[outcome]} {outcome.value}" for outcome in Outcome if counts[outcome])
        return f"{verdict}: {numbers}"

    def to_text(self) -> str:
        """Return a line for each check, and the verdict."""
        head = [self.title, f"C source sha256 {self.checksum}", f"flags {' '.join(self.flags)}; step {self.h:g}", ""]
        return "\n".join([*head, *map(str, self.checks), "", f"{self.verdict}; {self.seconds:.1f} s"]) + "\n"

    def _repr_html_(self) -> str:
        facts = (
            ("verdict", Html.plain(self.verdict)),
            ("C source", Html.plain(f"sha256 {self.checksum}")),
            ("step", Html.plain(f"{self.h:g}")),
        )
        head = ("", "outcome", "measured", "bound", "property")
        return Html.card(self.title, facts, Html.grid(map(_row, self.checks), head=head))

    def to_json(self) -> str:
        """Return all attributes as JSON; numbers that are not finite are strings."""
        return json.dumps({"passed": self.passed, **_finite(asdict(self))}, indent=1, allow_nan=False) + "\n"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the JSON to a file atomically."""
        write_text(path, self.to_json())


def issued(stepper: Stepper, state: State, *, began: float, **attributes: Any) -> Certificate:
    """Return the certificate of a stepper measured at a state; ``attributes`` are the other attributes."""
    assert stepper.source is not None
    return Certificate(
        title=stepper.interface.title,
        version=__version__,
        checksum=hashlib.sha256("".join(stepper.source.files.values()).encode()).hexdigest(),
        flags=stepper.flags,
        q=tuple(map(float, state.q)),
        p=tuple(map(float, state.p)),
        t=state.t,
        h=state.h,
        seconds=time.perf_counter() - began,
        **attributes,
    )


def _row(check: Check) -> tuple[Html, ...]:
    """Return a row of the table in a notebook; violations are bold."""
    outcome = Html.plain(check.outcome.value)
    if check.outcome is Outcome.VIOLATED:
        outcome = Html(f"<strong>{outcome}</strong>")
    numbers = ["" if number is None else f"{number:.3g}" for number in (check.measured, check.bound)]
    words = "; ".join(filter(None, (check.statement, check.remark)))
    return Html.plain(check.name), outcome, *map(Html.plain, numbers), Html.plain(words)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
