"""How directions at the start of a run are carried along: tangent maps of its steps, and Lyapunov exponents.

The derivative is that of the computed map, lengths of steps held; of a symplectic method each factor is symplectic to
round-off. Steps are taken again; a run stores nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import real_array
from scvi_codegen.runtime.kept_states import Array, KeptStates
from scvi_codegen.runtime.retaken import retaken

__all__ = ["carried", "lyapunov_exponents"]


def carried(states: KeptStates, directions: ArrayLike | None) -> Array:
    """(n, 2m, k) what becomes of (2m, k) directions of (q, p); all 2m without any, the derivative of each state.

    Raises:
        StateError: for directions of another shape, and states that do not stand at whole steps.
    """
    size = 2 * states.stepper.dimension
    given = np.eye(size) if directions is None else real_array(directions, "directions")
    if given.ndim not in (1, 2) or len(given) != size:
        raise StateError(f"directions have shape ({size},) or ({size}, k), not {given.shape}")
    found = np.empty((len(states), *given.shape))
    found[0] = given
    for k, factors in enumerate(_factors(states)):
        now = found[k]
        for factor in factors:
            now = factor @ now
        found[k + 1] = now
    return found


def lyapunov_exponents(states: KeptStates) -> Array:
    """(2m,) in descending order, of the time that the run covers: how fast nearby motions part, by QR (Benettin).

    Raises:
        StateError: of a run of no steps, and as :func:`carried`.
    """
    if len(states) < 2:
        raise StateError("Lyapunov exponents are those of a time that passes: this run has no steps")
    size = 2 * states.stepper.dimension
    frame, total = np.eye(size), np.zeros(size)
    for factors in _factors(states):
        for factor in factors:
            frame, stretch = np.linalg.qr(factor @ frame)
            total += np.log(np.abs(np.diag(stretch)))
    exponents: Array = np.sort(total / abs(states.t[-1] - states.t[0]))[::-1]
    return exponents


def _factors(states: KeptStates) -> Iterator[list[Array]]:
    """The derivatives of the steps from each kept state to the next."""

    def step(q: Array, p: Array, h: float, t: float) -> tuple[Array, Array, Array]:
        return states.stepper.tangent_step(q, p, h, t, states.parameters, states.options)

    return retaken(states, step)
