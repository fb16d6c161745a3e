"""Lyapunov exponents: how fast nearby motions part, by the tangent maps of the steps of a run.

The derivative is that of the computed map, lengths of steps held; of a symplectic method each factor is symplectic to
round-off. Steps are taken again from each kept state; a run stores nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scvi_codegen.runtime.exchanges import steps_between
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.kept_states import KeptStates

__all__ = ["lyapunov_exponents"]


def lyapunov_exponents(states: KeptStates) -> Array:
    """(2m,) in descending order, of the time that the run covers: how fast nearby motions part, by QR (Benettin)."""
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
    for k, (start, length, end) in enumerate(zip(states.t[:-1], states.lengths[:-1], states.t[1:], strict=True)):
        span = float(end - start)
        count, found = steps_between(float(length), span), []
        q, p = states.q[k], states.p[k]
        for j in range(count):
            part, at = (float(length), float(start + j * length)) if count > 1 else (span, float(start))
            q, p, factor = states.stepper.tangent_step(q, p, part, at, states.parameters, states.options)
            found.append(factor)
        yield found
