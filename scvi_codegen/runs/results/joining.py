"""Joining of the trajectories of consecutive segments of a run."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.runs.results.recorded import changed
from scvi_codegen.runs.results.saved_states import Array, ModeHistory
from scvi_codegen.systems.event import Crossings

Number = TypeVar("Number", bound=np.generic)
Result = TypeVar("Result")
Found = TypeVar("Found", bound=Crossings)


def joined(pieces: Sequence[Result]) -> Result:
    """Return the trajectory of consecutive segments of a run, each with its parameters."""
    every: Sequence[Any] = pieces
    first, last = every[0], every[-1]
    states: dict[str, Any] = {
        name: concatenated([getattr(piece, name) for piece in pieces])
        for name in ("t", "q", "p", "iterations")
        if hasattr(first, name)
    }
    states |= {name: first.stepper.named(states[name]) for name in "qp"}
    same = ("plan", "steps", "rejected_steps", "fallback_steps", "step_error", "worst_step_time")
    whole: Result = changed(
        first,
        **states,
        **{name: getattr(last, name) for name in same if hasattr(last, name)},
        step_sizes=np.concatenate([*(piece.step_sizes[:-1] for piece in every), last.step_sizes[-1:]]),
        actions=accumulated([piece.actions for piece in every]),
        events=tuple(map(joined_crossings, zip(*(piece.events for piece in every), strict=True))),
        **(
            {"transitions": tuple(map(joined_crossings, zip(*(piece.transitions for piece in every), strict=True)))}
            if hasattr(first, "transitions")
            else {}
        ),
        modes=None if first.modes is None else ModeHistory.joined([piece.modes for piece in every]),
        pieces=tuple(pieces),
    )
    return whole


def concatenated(parts: Sequence[NDArray[Number]]) -> NDArray[Number]:
    """Concatenate arrays of successive pieces; the first state of each repeats the last of the previous one."""
    first, *others = parts
    return np.concatenate([first, *(other[1:] for other in others)]) if others else first


def accumulated(parts: Sequence[Array | None]) -> Array | None:
    """Return sums along a run from those along its pieces, which may begin with any value; ``None`` without one."""
    sums = [part for part in parts if part is not None]
    if len(sums) < len(parts):
        return None
    before = compensated_sums(np.array([0.0, *(part[-1] - part[0] for part in sums[:-1])]))
    along: Array = sums[0][0] + concatenated([part - part[0] + start for part, start in zip(sums, before, strict=True)])
    return along


def compensated_sums(terms: Array) -> Array:
    """Return the partial sums, with the rounding errors of the additions summed besides."""
    sums = np.cumsum(terms)
    before = np.concatenate([[0.0], sums[:-1]])
    added = sums - before
    return np.asarray(sums + np.cumsum((before - (sums - added)) + (terms - added)))


def joined_crossings(crossings: Sequence[Found]) -> Found:
    """Concatenate the crossings of one event over all pieces."""
    columns: Any = {name: [getattr(part, name) for part in crossings] for name in crossings[0].columns}
    joined: dict[str, Any] = {name: np.concatenate(parts) for name, parts in columns.items()}
    return replace(crossings[0], **joined)


SUSPICIOUS, ROUNDING = 1e-6, 1e-10
"""Relative change of a quantity from which on its terms may be rounding errors; the largest such change relative to its
bound."""


def relative_changes(values: Array, sizes: Array, bounds: Callable[[NDArray[np.bool_]], Array]) -> Array:
    """Return changes since the first value along axis 0, relative to the largest size; NaN if sizes overflow.

    If the terms of a quantity are rounding errors, as of the angular momentum of a fall along an axis, changes are
    relative to a bound of its values, (..) ``bounds`` where a mask (..) is true.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        scales = np.fmax.reduce(sizes, axis=0)
        changes: Array = values - values[0]
        scales = np.where(scales > 0.0, scales, 1.0)
        largest = np.fmax.reduce(np.abs(changes), axis=0).astype(float)
        if (suspicious := largest > SUSPICIOUS * scales).any():
            wider = bounds(suspicious)
            scales = np.where(suspicious & (largest <= ROUNDING * wider), wider, scales)
        changes = changes / scales
    return np.where(np.isinf(scales), np.nan, changes)
