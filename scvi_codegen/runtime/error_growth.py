"""Indicator of error growth: a second run from a state changed in its last place, made after an adaptive run.

The difference of the two runs is what the motion makes of an error as small as rounding. The second run keeps no
states, is made of at most a fixed number of steps, and is given up half-way where errors grow too slowly to matter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import AccuracyWarning, StateError, StepFailedError, warn
from scvi_codegen.runtime import indexed_constraints
from scvi_codegen.runtime.accuracy import warnings_wanted
from scvi_codegen.runtime.constraints import projected
from scvi_codegen.runtime.indexed_run import IndexedRun
from scvi_codegen.runtime.memory import Memory

__all__ = ["MOST_STEPS", "GrowthCheck"]

Array = NDArray[np.float64]

MOST_STEPS, MOST_NUMBERS = 2048, 2**18
"""Steps of the second run by default: their number, and that times the number of coordinates."""
FASTEST = 10.0
"""Growth of an error within one step: what grows slower than this in so few steps is not looked at."""
NUDGE = 2.0**-50
"""Relative change of the initial state, or the local tolerance if that is larger."""
TOLERABLE, LOOSE, LARGEST = 1e-7, 1e5, 0.1
"""A run is reported where the difference exceeds the first and the second times its tolerance, or the third."""
SLOW = 0.4
"""Part of the decades in question that an error must have grown half-way for the second half to be made."""


class StatesRepeated(Protocol):
    """The states of a run that are compared."""

    @property
    def t(self) -> Array: ...
    @property
    def q(self) -> Any: ...
    @property
    def p(self) -> Any: ...


class GrowthCheck:
    """A run to be repeated, as it was at its start.

    Args:
        run: at its start.
        asked: ``True``: check all of the run; ``None``: up to ``MOST_STEPS`` of its steps, half of them where errors
            grow slowly; ``False``: nothing.
        lead: advances the run to a time; by default to the goal of that time.

    Raises:
        StateError: if the check is asked for and steps have a fixed size.
    """

    def __init__(
        self, run: Memory | IndexedRun, asked: bool | None, lead: Callable[[float], None] | None = None
    ) -> None:
        adaptive = run.goal is not None and not run.goal.tau
        if asked and not adaptive:
            raise StateError(
                "check_growth=True needs adaptive steps, and these have a fixed size: give t_end without h, or leave "
                "out check_growth"
            )
        self.run, self.asked, self.lead = run, asked, lead or self._to
        self.wanted = adaptive and asked is not False and warnings_wanted()
        if self.wanted:
            self.start: Any = run.save() if isinstance(run, Memory) else run.mark

    def warn(self, states: StatesRepeated) -> None:
        """Repeat the run, which stays where that ends, and warn if it ends elsewhere by more than is tolerable."""
        if not self.wanted or len(states.t) < 2:
            return
        goal, steps = self.run.goal, self.run.steps
        assert goal is not None  # by construction
        nudge = max(NUDGE, goal.tolerance)
        tolerable = min(max(TOLERABLE, LOOSE * goal.tolerance), LARGEST)
        last = self._last(states, steps)
        if last == 0 or nudge * FASTEST ** float(min(steps, 300)) < tolerable:
            return
        worst = (0.0, 0.0)
        try:
            self._begin(nudge)
            for k in sorted({last // 2, last} - {0}):
                self.lead(float(states.t[k]))
                apart = self._apart(states, k)
                worst = max(worst, (apart, float(states.t[k])))
                if k < last and not self.asked and apart < nudge * (tolerable / nudge) ** SLOW:
                    return
        except StepFailedError as failure:
            self._report(nudge, f"fails at t = {failure.t:g}")
            return
        if not worst[0] <= tolerable:
            self._report(nudge, f"is {worst[0]:.1e} of its size away at t = {worst[1]:g}")

    def _last(self, states: StatesRepeated, steps: int) -> int:
        """Return the number of the last state to compare: all of them are kept, or as many for each part of the run."""
        count = len(states.t) - 1
        if len(self._rows(states.q)) != len(states.t):
            return 0
        most = float(min(MOST_STEPS, MOST_NUMBERS // len(self._halves()[0])))
        return count if self.asked or steps <= most else int(count * most / steps)

    def _halves(self) -> tuple[Array, Array]:
        """Return the positions and momenta of the run, to be changed in place."""
        if isinstance(self.run, Memory):
            return self.run._q, self.run._p
        q, p = np.split(self.run.state, 2)
        return q, p

    def _begin(self, nudge: float) -> None:
        """Put the run back to its start, changed, and on its constraints."""
        run = self.run
        run.rewind(self.start)
        q, p = self._halves()
        for k, part in enumerate((q, p)):
            part *= 1.0 + nudge * np.cos(np.arange(len(part)) + k)
        if isinstance(run, IndexedRun):
            if run.interface.constraints:
                indexed_constraints.project(run)
        elif run.stepper.interface.constraints:
            q[:], p[:], _ = projected(run.stepper, q.copy(), p.copy(), run.t, run.parameters)

    def _to(self, t: float) -> None:
        assert self.run.goal is not None  # by construction
        self.run.change(goal=replace(self.run.goal, t_end=t))
        while not self.run.arrived:
            self.run.advance(MOST_STEPS)

    def _apart(self, states: StatesRepeated, k: int) -> float:
        """Return the larger of |dq|/|q| and |dp|/|p| at a state, relative to the largest until there."""
        found = []
        for mine, each in zip(self._halves(), (states.q, states.p), strict=True):
            rows = self._rows(each)[: k + 1]
            unit = float(np.abs(rows).max()) or 1.0  # squares of very large or small numbers are not finite or are 0
            size = float(np.linalg.norm(rows / unit, axis=1).max())
            apart = float(np.linalg.norm((mine - rows[k]) / unit))
            found.append(apart / size if apart and size else apart)
        return max(found)

    @staticmethod
    def _rows(values: Any) -> Array:
        if isinstance(values, Mapping):
            return np.concatenate([each.reshape(len(each), -1) for each in values.values()], axis=1)
        return np.asarray(values)

    @staticmethod
    def _report(nudge: float, said: str) -> None:
        warn(
            f"the motion magnifies errors: a run from an initial state changed by {nudge:.1e} (relative) {said}, so "
            "that a second run does not confirm this one; give error= for the time until which digits are confirmed, "
            "or check_growth=False to leave this check out",
            AccuracyWarning,
        )
