"""Changes of modes of contacts by steps, across which the derivatives of steps are not those of the motion."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

from scvi_codegen.common.errors import AccuracyWarning, warn
from scvi_codegen.runs.events.contacts import contact_modes

SHOWN = 3
"""Changes of modes that a warning names."""


def check_modes(runs: Sequence[Any]) -> None:
    """Warn of the changes of modes of runs by steps."""
    changes = [change for run in runs for change in _changes(run)]
    if changes:
        more = f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else ""
        warn(
            f"contacts change their modes along the run by steps ({', '.join(changes[:SHOWN])}{more}): derivatives are "
            "those of its steps, which for small steps do not tend to the derivative of the motion across such "
            "changes. Omit transitions= (located) for that",
            AccuracyWarning,
        )


def _changes(run: Any) -> Iterator[str]:
    """Yield contact, new mode and time of each change of modes of a run, and times of rebounds."""
    titles, changes = [contact.title for contact in run.stepper.interface.contacts], contact_modes(run)
    for (_, before), (t, after) in pairwise(changes):
        modes = zip(titles, before, after, strict=True)
        yield from (f"{title} {is_now}s at t = {t:.6g}" for title, was, is_now in modes if was != is_now)
    yield from (f"a rebound at t = {t:.6g}" for t in run.modes.t.tolist() if t not in [t for t, _ in changes])
