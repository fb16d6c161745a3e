"""Lyapunov exponents: how fast nearby motions part, by the tangent maps of the steps of a run.

The derivative is that of the computed map, lengths of steps held; of a symplectic method each factor is symplectic to
round-off. Steps are taken again; a run stores nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.kept_states import Array, KeptStates
from scvi_codegen.runtime.retaken import retaken

__all__ = ["lyapunov_exponents"]


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
