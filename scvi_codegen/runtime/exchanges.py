"""What forces gave along a run: work, and impulses to momentum maps, by the curve of each step."""

from __future__ import annotations

import numpy as np

from scvi_codegen.runtime.kept_states import Array, KeptStates
from scvi_codegen.runtime.retaken import retaken

__all__ = ["exchanged_until"]


def exchanged_until(states: KeptStates) -> Array:
    """(n, 1 + k) what forces gave from the first state to each: to the energy, then to momentum maps.

    Raises:
        MethodError: where no forces act, and for methods that do not integrate along a curve.
        StateError: if the states do not stand at whole steps, or steps taken again lead elsewhere.
        StepFailedError: if Newton's iteration does not converge.
    """
    stepper = states.stepper
    total = np.zeros((len(states), max(1, len(stepper.interface.exchange_names))))

    def step(q: Array, p: Array, h: float, t: float) -> tuple[Array, Array, Array]:
        return stepper.exchanged(q, p, h, t, states.parameters, options=states.options)

    for k, given in enumerate(retaken(states, step)):
        total[k + 1] = sum(given, total[k])
    return total
