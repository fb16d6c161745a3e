"""What a run saves."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from scvi_codegen.runs.states.validation import Array


@dataclass(frozen=True, slots=True, eq=False)
class Output:
    """States that a run saves, and what it calls.

    Attributes:
        save_every: steps between saved states.
        times: (n,) output times instead; ``None`` without them.
        observe: an observer, its name, or a function of the run, whose results are saved instead of the states.
        progress: called with the number of completed steps.
    """

    save_every: int = 1
    times: Array | None = None
    observe: Any = None
    progress: Callable[[int], None] | None = None

    @property
    def has_states_alone(self) -> bool:
        """True without output times, observers and calls of ``progress``."""
        return self.times is None and self.observe is None and self.progress is None


ALL_STATES = Output()
"""Output of all states, without calls."""


@lru_cache(maxsize=64)
def every(save_every: int) -> Output:
    """Return the output of every k-th state, the same object for one k."""
    return ALL_STATES if save_every == 1 else Output(save_every)
