"""Nouns of what a run is asked for, as users gave it, ``None`` where omitted.

With :class:`~scvi_codegen.runs.states.layout.Initial`, :class:`~scvi_codegen.runs.stepping.step_plan.Steps` and
:class:`~scvi_codegen.runs.stepping.step_plan.Span` these are all arguments of the one door, ``Stepper._integrate``.
They are tuples, which C compares and hashes.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from scvi_codegen.runs.stepping.noise import DEFAULT_NOISE, Noise


class Save(NamedTuple):
    """States that a run saves, and what it calls.

    Attributes:
        save_every: steps between saved states.
        t_eval: (n,) output times instead.
        observe: an observer, its name, or a function of the run, whose results are saved instead of the states.
        progress: called with the number of completed steps.
    """

    save_every: int = 1
    t_eval: Any = None
    observe: Any = None
    progress: Callable[[int], None] | None = None


class Execution(NamedTuple):
    """What acts along a run, and how its steps are executed.

    Attributes:
        check_growth: whether the growth of errors is checked.
        inputs, events: of the run, else those of the stepper.
        tables, threads: of arrays of run-time sizes.
        action: whether the action is summed.
        transitions, strict_energy: of contacts.
        noise: its stream, not checked.
    """

    check_growth: bool | None = None
    inputs: Mapping[str, Any] | None = None
    events: Any = None
    tables: Mapping[str, ArrayLike] | None = None
    threads: int | None = None
    action: bool = False
    transitions: str | None = None
    strict_energy: bool = False
    noise: Noise = DEFAULT_NOISE


ALL_STATES, PLAIN = Save(), Execution()
PLAIN_BUT_GROWTH = PLAIN[1:]
"""What else acts along a plain run, whether or not the growth of errors is checked."""
