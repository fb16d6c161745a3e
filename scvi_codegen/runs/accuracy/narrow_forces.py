"""Search for forces that all runs of a comparison pass over: long steps are repeated in short pieces.

A pulse in time, or a well in space, that lies between the stages of a step changes nothing in it, so that runs which
all pass over it agree. A step in pieces samples the forces at many more times; the difference of both ends is its local
error (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, II.4).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import StepFailedError
from scvi_codegen.runs.results.saved_states import parameters_on_sides
from scvi_codegen.runs.stepping.step_plan import Fixed

Array = NDArray[np.float64]

MOST_PIECES, LEAST_PIECES, NUMBERS = 2048, 64, 2**20
"""Pieces of a run: of few coordinates, of arrays, and times the number of coordinates: narrower forces are not seen."""
LONG = 4.0
"""Pieces from which on a step is long: the stages of others are as close together."""


def longest_piece(run: Any, span: float) -> float:
    """Return the size of the pieces in which a run over a span is examined."""
    return abs(span) / float(min(MOST_PIECES, max(LEAST_PIECES, NUMBERS // run.stepper.dimension)))


def differences_in_pieces(run: Any, size: float) -> Array:
    """Return (2, m) largest differences of positions and momenta at the ends of long steps from the steps in pieces.

    Args:
        run: trajectory with all states of adaptive steps.
        size: of the pieces; steps from ``LONG`` times it on are taken in pieces, all but the last before an impact. If
            one fails, the differences are infinite.
    """
    largest = np.zeros((2, run.q.shape[1]))
    for part in run.pieces or (run,):
        pieces, times, ends = part._restarted(0, size), list[float](), list[tuple[Array, Array]]()
        for k in np.flatnonzero(np.abs(np.diff(part.t)) > LONG * size).tolist():
            t, h = part.t.item(k), part.t.item(k + 1) - part.t.item(k)
            try:
                pieces.plan = Fixed(h / (count := math.ceil(abs(h) / size)))
                pieces._parameters[:] = parameters_on_sides(part, t)
                pieces._begin(part.q[k], part.p[k], t)
                pieces.advance(last := count - (part.modes is not None and part.t[k + 1] in part.modes.t))
                times.append(part.t.item(k + 1) if last == count else t + last * h / count)
                ends.append((pieces.q, pieces.p))
            except StepFailedError:  # the step was solved over what its pieces meet
                largest[:] = np.inf
        if times:
            states = np.stack(part._states_at(np.array(times)), 1)
            np.fmax(largest, np.abs(np.array(ends) - states).max(axis=0), out=largest)
    return largest
