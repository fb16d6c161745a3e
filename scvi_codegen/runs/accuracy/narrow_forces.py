"""Search for forces that all runs of a comparison pass over: long steps are repeated in short pieces.

A pulse in time, or a well in space, that lies between the stages of a step changes nothing in it, so that runs which
all pass over it agree. A step in pieces samples the forces at many more times; the difference of both ends is its local
error (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, II.4).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.runs.results.saved_states import times_of_changes
from scvi_codegen.runs.states.times import number_until

Array = NDArray[np.float64]

MOST_PIECES, LEAST_PIECES, NUMBERS = 1024, 64, 2**20
"""Pieces of a run: of few coordinates, of arrays, and times the number of coordinates: narrower forces are not seen."""
ITERATED = 0.1
"""Tolerance of the iterations in pieces, of the differences that count: their motions add up to that of the step."""
LONG = 2.0
"""Pieces from which on a step is long: the stages of others are as close together."""


def longest_piece(run: Any, span: float) -> float:
    """Return the size of the pieces in which a run over a span is examined."""
    return abs(span) / float(min(MOST_PIECES, max(LEAST_PIECES, NUMBERS // run.stepper.dimension)))


def differences_in_pieces(run: Any, size: float, part: float) -> Array:
    """Return (2, m) largest differences of positions and momenta at the ends of long steps from the steps in pieces.

    Args:
        run: trajectory with all states of adaptive steps.
        size: of the pieces; steps from ``LONG`` times it on are taken in pieces, all but the last before an impact. If
            one fails, the differences are infinite.
        part: of the motion of a step, differences that count.
    """
    largest, options = np.zeros((2, run.q.shape[1])), SolverOptions(tolerance=ITERATED * part)
    for piece in run.pieces or (run,):
        spans, changes = np.diff(piece.t), times_of_changes(piece)
        rows = np.flatnonzero(np.abs(spans) > LONG * size)
        modes = number_until(changes, piece.t[rows], piece.forward)
        for mode in {*modes.tolist()}:
            apart = _apart(piece, rows[modes == mode], spans, size, changes, options)
            np.fmax(largest, apart, out=largest)
    return largest


def _apart(
    part: Any, rows: NDArray[np.intp], spans: Array, size: float, changes: Array, options: SolverOptions
) -> Array:
    """Return (2, m) largest differences of the steps at some rows in one mode, by one call of C."""
    counts, stepper = np.ceil(np.abs(spans[rows]) / size), part.stepper
    h, before = spans[rows] / counts, np.zeros(len(rows), bool)
    if len(changes):
        before = np.isin(part.t[rows + 1], changes)
    (q, p), binding = (np.ascontiguousarray(np.asarray(x)[rows]) for x in (part.q, part.p)), stepper.binding
    pieces, ends = (counts - before).astype(np.int64), np.empty((2, *q.shape))
    arguments = *map(binding.pointer, (np.ascontiguousarray(part.t[rows]), h)), binding.whole_numbers(pieces)
    parameters = part.parameters_on_sides(float(part.t[rows[0]]))
    pointers = map(binding.pointer, (q, p, *ends))
    status, _ = stepper._call_steps("pieces", parameters, options, len(rows), *arguments, *pointers)
    if status:
        return np.full((2, q.shape[1]), np.inf)  # the step was solved over what its pieces meet
    states = np.array([np.asarray(x)[rows + 1] for x in (part.q, part.p)])
    if before.any():
        states[:, before] = part._states_at((part.t[rows] + pieces * h)[before])
    return np.asarray(np.abs(ends - states).max(axis=1, initial=0.0))
