"""What an experiment gives back: what was run, what the paper claims of it, what was measured, numbers and a picture.

Everything is plain data that travels between processes: a picture is a module-level function with its numbers bound by
``functools.partial``, a formula is SymPy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from scvi_codegen.display.page.blocks import Block, Cell, Formula, Listing, Paragraph, TableBlock

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Block",
    "Cell",
    "Comparison",
    "Experiment",
    "Formula",
    "Listing",
    "Paragraph",
    "Picture",
    "Result",
    "TableBlock",
    "Verdict",
    "common_verdict",
    "holds",
    "judged",
]


class Verdict(Enum):
    """Whether what the paper says was found."""

    HOLDS = "holds"
    PARTLY = "holds in part"
    FAILS = "does not hold"
    SHOWN = "shown"
    """Nothing is claimed, or nothing can be decided."""


def holds(condition: bool) -> Verdict:
    """``HOLDS`` or ``FAILS``."""
    return Verdict.HOLDS if condition else Verdict.FAILS


def judged(*conditions: bool) -> Verdict:
    """``HOLDS`` if all conditions do, ``FAILS`` if none does, else ``PARTLY``."""
    if all(conditions):
        return Verdict.HOLDS
    return Verdict.PARTLY if any(conditions) else Verdict.FAILS


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One statement of the paper beside what was measured.

    Attributes:
        claim: what the paper says, in one sentence.
        measured: what was found, in one sentence with its numbers.
        verdict: whether they agree.
        bears_on: keys of the claims (:mod:`scvi_codegen.reproduce.claims`) that this decides.
    """

    claim: str
    measured: str
    verdict: Verdict
    bears_on: tuple[str, ...] = ()


def common_verdict(checks: Iterable[Comparison]) -> Verdict:
    """Of several checks: ``PARTLY`` where they differ, ``SHOWN`` where none decides anything."""
    found = {check.verdict for check in checks} - {Verdict.SHOWN}
    if not found:
        return Verdict.SHOWN
    return found.pop() if len(found) == 1 else Verdict.PARTLY


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """``draw`` fills an empty Matplotlib figure of ``width`` x ``height`` inches."""

    draw: Callable[[Figure], None]
    width: float = 9.0
    height: float = 4.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What an experiment found.

    Attributes:
        name: ``"figure-4"``.
        title: what the paper calls it, one line.
        setting: what was run, and what the caption leaves open and how it was chosen, a sentence each.
        checks: claims and findings.
        tables: numbers; the first has no name.
        picture: or ``None``.
        body: text and formulas, in order, for experiments that are read rather than looked at.
    """

    name: str
    title: str
    setting: tuple[str, ...]
    checks: tuple[Comparison, ...] = ()
    tables: tuple[TableBlock, ...] = ()
    picture: Picture | None = None
    body: tuple[Block, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The common verdict of all checks; ``PARTLY`` where they differ, ``SHOWN`` where there is none."""
        return common_verdict(self.checks)


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """Something of the paper that can be run.

    Attributes:
        name: on the command line.
        title: one line.
        run: gives the result; it is called with the results of ``needs``, by name.
        needs: names of experiments whose results it judges.
    """

    name: str
    title: str
    run: Callable[[Mapping[str, Result]], Result]
    needs: tuple[str, ...] = ()
