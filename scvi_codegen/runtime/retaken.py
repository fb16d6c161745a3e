"""The steps of a run taken again, from each kept state to the next: for what a run does not store of them.

Newton's iteration solves them anew, from a straight line. That it found the run's own root is checked, not believed:
where the steps from a kept state do not lead to the next, there is an error instead of an answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.dense_output import whole_steps
from scvi_codegen.runtime.kept_states import Array, KeptStates

__all__ = ["retaken"]

Found = TypeVar("Found")

SAME_STATE = 1e-6
"""Of the largest number of a state: roots lie further apart, and rounding seldom grows so far between kept states."""
WHOLE = 1e-9
"""Of a step: what a span may differ from so many whole ones."""


def retaken(
    states: KeptStates, step: Callable[[Array, Array, float, float], tuple[Array, Array, Found]]
) -> Iterator[list[Found]]:
    """What each step gives, step by step from one kept state to the next.

    Args:
        states: at whole steps.
        step: of (q, p, h, t), gives (q1, p1, found).

    Raises:
        StateError: if the states do not stand at whole steps, or the steps lead elsewhere.
        StepFailedError: if Newton's iteration does not converge.
    """
    for k, (start, length, end) in enumerate(
        zip(states.t[:-1].tolist(), states.lengths[:-1].tolist(), states.t[1:].tolist(), strict=True)
    ):
        count, given = _steps_between(length, end - start), []
        q, p = states.q[k], states.p[k]
        for j in range(count):
            q, p, found = step(q, p, length if count > 1 else end - start, start + j * length)
            given.append(found)
        _check_same(states, k + 1, q, p)
        yield given


def _steps_between(length: float, span: float) -> int:
    """How many steps of a length; 1 for a last one that an event or the end cut short."""
    if np.isnan(length):
        raise StateError("this is known of whole steps: integrate without t_eval, and with every=1")
    count = int(whole_steps(np.array([span]), np.array([length]))[0])
    if count > 1 and abs(span - count * length) > WHOLE * abs(length):
        raise StateError("this is known of whole steps: keep all states (every=1)")
    return max(1, count)


def _check_same(states: KeptStates, k: int, q: Array, p: Array) -> None:
    """Beside the largest number of both states: of a momentum that is kept at 0 all is rounding."""
    near = slice(k - 1, k + 1)
    size = max(np.abs(states.q[near]).max(), np.abs(states.p[near]).max())
    if not max(np.abs(q - states.q[k]).max(), np.abs(p - states.p[k]).max()) <= SAME_STATE * size:
        raise StateError(
            f"the steps from t = {states.t[k - 1]:g}, taken again, do not lead to the state kept at "
            f"t = {states.t[k]:g}: their equations have several solutions (take shorter steps), or the motion is too "
            "sensitive between the two (keep all states, every=1)"
        )
