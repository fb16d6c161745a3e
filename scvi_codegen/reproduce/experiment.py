"""Results of experiments: setting, claims of the paper, measurements, numbers and a picture.

Everything is plain data that can be sent between processes; a formula is SymPy.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import TypeAlias

from scvi_codegen.display.page.blocks import TableBlock
from scvi_codegen.reproduce.drawing import Picture


class Verdict(Enum):
    """Verdict on a statement of the paper."""

    HOLDS = "holds"
    PARTLY = "holds in part"
    FAILS = "does not hold"
    SHOWN = "shown"
    """No claim, or none that can be decided."""


def judged(*conditions: bool) -> Verdict:
    """Return ``HOLDS`` if all conditions do, ``FAILS`` if none does, else ``PARTLY``."""
    if all(conditions):
        return Verdict.HOLDS
    return Verdict.PARTLY if any(conditions) else Verdict.FAILS


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Statement of the paper and the measurement that tests it.

    Attributes:
        claim: statement of the paper, in one sentence.
        measured: measurement, in one sentence with its numbers.
        verdict: whether they agree.
        bears_on: keys of the claims (:mod:`scvi_codegen.reproduce.claims`) that this decides.
    """

    claim: str
    measured: str
    verdict: Verdict
    bears_on: tuple[str, ...] = ()


def comparison(claim: str, measured: str, *conditions: object, bears_on: str = "") -> Comparison:
    """Return a comparison whose verdict follows from conditions; without any it is only shown."""
    verdict = judged(*map(bool, conditions)) if conditions else Verdict.SHOWN
    return Comparison(claim=claim, measured=measured, verdict=verdict, bears_on=tuple(bears_on.split()))


def common_verdict(checks: Iterable[Comparison]) -> Verdict:
    """Return the verdict of several checks: ``PARTLY`` if they differ, ``SHOWN`` if none decides anything."""
    result = {check.verdict for check in checks} - {Verdict.SHOWN}
    if not result:
        return Verdict.SHOWN
    return result.pop() if len(result) == 1 else Verdict.PARTLY


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of an experiment.

    Attributes:
        name: name, as ``"figure-4"``; set by :meth:`Experiment.result`.
        title: the paper's title, one line; by default that of the experiment.
        setting: what was run, and how details that the caption omits were chosen, a sentence each.
        checks: claims and measurements.
        tables: numbers; the first has no name.
        picture: picture, or ``None``.
    """

    name: str = ""
    title: str = ""
    setting: tuple[str, ...] = ()
    checks: tuple[Comparison, ...] = ()
    tables: tuple[TableBlock, ...] = ()
    picture: Picture | None = None

    @property
    def verdict(self) -> Verdict:
        """Common verdict of all checks; ``PARTLY`` if they differ, ``SHOWN`` if there is none."""
        return common_verdict(self.checks)


Run: TypeAlias = Callable[[Mapping[str, Result]], Result]


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """Part of the paper that can be reproduced.

    Attributes:
        name: name on the command line.
        title: one line.
        run: function that returns the result, called with the results of ``needs``, by name.
        needs: names of experiments whose results it judges.
    """

    name: str
    title: str
    run: Run
    needs: tuple[str, ...] = ()

    def result(self, needs: Mapping[str, Result]) -> Result:
        """Return the result with the name of the experiment, and its title unless it has one."""
        result = self.run(needs)
        return replace(result, name=self.name, title=result.title or self.title)
