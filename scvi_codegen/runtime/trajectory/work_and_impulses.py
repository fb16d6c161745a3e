"""Work and impulse of the forces along a run, by the quadrature of each step."""

import numpy as np

from scvi_codegen.runtime.trajectory.recomputation import recomputed_steps
from scvi_codegen.runtime.trajectory.saved_states import Array, SavedStates


def work_and_impulses_until(states: SavedStates) -> Array:
    """Return (n, 1 + k) work of the forces from the first state to each, and their impulses on the momentum maps.

    Raises:
        MethodError: if no forces act, or the method has no curve of positions.
        StateError: if the states are not at whole steps, or recomputed steps differ.
        StepFailedError: if Newton's iteration does not converge.
    """
    stepper = states.stepper
    total = np.zeros((len(states), max(1, len(stepper.interface.exchange_names))))

    def step(q: Array, p: Array, h: float, t: float) -> tuple[Array, Array, Array]:
        return stepper.work_and_impulses(q, p, h, t, states.parameters, options=states.options)

    for k, outputs in enumerate(recomputed_steps(states, step)):
        total[k + 1] = sum(outputs, total[k])
    return total
