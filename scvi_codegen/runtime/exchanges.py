"""What forces gave along a run: work, and impulses to momentum maps, by the curve of each step.

Steps between kept states are taken again, from each kept state to the next; nothing of it is stored by a run.
"""

from __future__ import annotations

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.dense_output import whole_steps
from scvi_codegen.runtime.kept_states import Array, KeptStates

__all__ = ["exchanged_until", "steps_between"]


def exchanged_until(states: KeptStates) -> Array:
    """(n, 1 + k) what forces gave from the first state to each: to the energy, then to momentum maps.

    Raises:
        MethodError: where no forces act, and for methods that do not integrate along a curve.
        StateError: if the states do not stand at whole steps.
        StepFailedError: if Newton's iteration does not converge.
    """
    stepper, t = states.stepper, states.t
    total = np.zeros((len(states), max(1, len(stepper.interface.exchange_names))))
    for k, (start, length, span) in enumerate(
        zip(t[:-1].tolist(), states.lengths[:-1].tolist(), np.diff(t).tolist(), strict=True)
    ):
        count = steps_between(length, span)
        q, p = states.q[k], states.p[k]
        total[k + 1] = total[k]
        for j in range(count):
            part = length if count > 1 else span
            q, p, given = stepper.exchanged(q, p, part, start + j * length, states.parameters, options=states.options)
            total[k + 1] += given
    return total


def steps_between(length: float, span: float) -> int:
    """How many steps of a length; 1 for a last one that an event or the end cut short."""
    if np.isnan(length):
        raise StateError("this is known of whole steps: integrate without t_eval, and with every=1")
    count = int(whole_steps(np.array([span]), np.array([length]))[0])
    if count > 1 and abs(span - count * length) > 1e-9 * abs(length):
        raise StateError("this is known of whole steps: keep all states (every=1)")
    return max(1, count)
