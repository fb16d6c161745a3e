"""Observers by name, and those that save states: every n-th, those at output times, or the first and the last."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError, closest
from scvi_codegen.native.arguments import real_array
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.observer import Observer, StateChunk
from scvi_codegen.runtime.trajectory.dense_output import states_and_steps_at, step_sizes_at
from scvi_codegen.validation import checked_count


class Extremes(Observer):
    """Smallest and largest values of q and p over all states, (2, 2m)."""

    def __init__(self) -> None:
        self.values = np.empty(0)

    def functions(self, chunk: StateChunk) -> Array:
        """Return the (n, 2m) values at the states."""
        return np.concatenate([chunk.states.q, chunk.states.p], axis=1)

    def receive(self, chunk: StateChunk) -> None:
        """Include the states."""
        states = self.functions(chunk)
        rows = states if chunk.is_first else np.concatenate([self.values, states])
        self.values = np.array([rows.min(axis=0), rows.max(axis=0)])

    def result(self) -> ArrayLike:
        """Return the smallest and the largest values."""
        return self.values


class EnergyExtremes(Extremes):
    """Smallest and largest energy over all states, (2,)."""

    def functions(self, chunk: StateChunk) -> Array:
        """Return the (n,) energies of the states."""
        return chunk.states.energy()


Observe = Observer | Callable[[Any], ArrayLike] | str | None
OBSERVERS: dict[str, Callable[[], Observer]] = {
    # each is made anew for a run
    "extremes": Extremes,
    "energy": EnergyExtremes,
}
"""Observers by name, ``integrate(observe="extremes")``."""


class Saver(Observer):
    """Every n-th state and the last one.

    Args:
        save_every: steps between saved states.
        within_steps: with ``save_every=1``, also states after changes by events within steps.

    Attributes:
        rows: arrays t, q, p, step sizes, independent variables, numbers of iterations and actions (NaN unless the run
            sums them) of each chunk.
    """

    def __init__(self, save_every: int = 1, *, within_steps: bool = True) -> None:
        self.save_every, self.within_steps = checked_count(save_every, "save_every", least=1), within_steps
        self.rows: list[tuple[Array, Array, Array, Array, Array, NDArray[np.int64], Array]] = []

    def wanted(self, chunk: StateChunk) -> NDArray[np.bool_]:
        """Return which states of a chunk to save."""
        wanted: NDArray[np.bool_] = chunk.numbers % self.save_every == 0  # states within a step only if all are saved
        wanted &= self.within_steps | (chunk.numbers >= 0)
        wanted[0] = chunk.is_first
        wanted[-1] |= chunk.is_last
        return wanted

    def receive(self, chunk: StateChunk) -> None:
        """Save the states that are wanted."""
        if (wanted := self.wanted(chunk)).any():
            self.save(chunk, wanted)

    def save(self, chunk: StateChunk, wanted: NDArray[np.bool_]) -> None:
        """Save some states of a chunk."""
        part = chunk.states
        t, q, p, sizes, stepped = (each[wanted] for each in (part.t, part.q, part.p, part.step_sizes, part.stepped))
        actions = np.full(len(t), np.nan) if part.actions is None else part.actions[wanted]
        self.rows.append((t, q, p, sizes, stepped, chunk.iterations[wanted], actions))

    def cut_step(self, size: float) -> None:
        """Set the size of the step that follows the last state, which an event may have cut, if that is saved."""
        if self.save_every == 1 and self.rows:
            self.rows[-1][3][-1] = size

    def fields(self) -> dict[str, Any]:
        """Return further fields of the trajectory."""
        return {}


class AtTimes(Saver):
    """States at (n,) output times, sorted in the direction of the run."""

    def __init__(self, times: Array) -> None:
        super().__init__()
        self.times = times

    def receive(self, chunk: StateChunk) -> None:
        """Save the states at the times within the chunk, by partial steps."""
        part, forward = chunk.states, chunk.states.forward
        left, right = forward * part.t[0], forward * part.t[-1]
        after = forward * self.times >= left if chunk.is_first else forward * self.times > left
        times = self.times[after & (forward * self.times <= right)]
        q, p, stepped = states_and_steps_at(part, times)
        before = np.searchsorted(forward * part.t, forward * times, side="right") - 1
        unknown = np.full(len(times), np.nan)
        self.rows.append((times, q, p, step_sizes_at(part, times), stepped, chunk.iterations[before], unknown))

    def cut_step(self, size: float) -> None:
        """Output times are within steps."""


class Observed(Saver):
    """Times of every n-th state, conserved quantities there, the states at both ends and the results of observers.

    Args:
        observer: an observer, or a function of the run, of whose results at every n-th state ``observed`` consists.
        save_every: steps between saved times.
    """

    def __init__(self, observer: Observer | Callable[[Any], ArrayLike], save_every: int) -> None:
        super().__init__(save_every)
        self.observer, self.observed, self.conserved = observer, list[Array](), list[Array]()
        self.ends: list[tuple[Array, Array]] = []

    def most_steps(self, run: Memory) -> float:
        """Return the number of steps to the next saved time, where a function is called."""
        if isinstance(self.observer, Observer):
            return self.observer.most_steps(run)
        return self.save_every - run.steps % self.save_every

    def receive(self, chunk: StateChunk) -> None:
        """Pass the states to the observer."""
        wanted = self.wanted(chunk)
        if isinstance(self.observer, Observer):
            self.observer.receive(chunk)
        elif wanted.any():
            self._call(chunk)
        if not wanted.any():
            return
        self.save(chunk, wanted)
        t, q, p, sizes, stepped, count, actions = self.rows[-1]
        self.rows[-1] = t, q[:0], p[:0], sizes, stepped, count, actions
        self.ends = [*self.ends[:1], (q[-1], p[-1])]
        stepper, parameters = chunk.run.stepper, chunk.states.parameters
        energies = stepper._energy_parts(q, p, t, parameters)
        maps = stepper.momentum_maps(q, p, t, parameters) if stepper.momentum_map_names else np.empty((len(t), 0))
        self.conserved.extend(np.concatenate([energies, maps], axis=1))

    def _call(self, chunk: StateChunk) -> None:
        run, part = chunk.run, chunk.states
        if chunk.within_step:
            here = {"t": part.t[-1], "parameters": run.parameters, "options": run.options}
            run = type(run).started(run.stepper, part.q[-1], part.p[-1], plan=run.plan, **here)
        assert not isinstance(self.observer, Observer)
        array, when = real_array(self.observer(run), "the result of observe"), f"at t = {run.t:g}"
        if self.observed and array.shape != self.observed[0].shape:
            raise StateError(
                f"the result of observe must keep its shape: {array.shape} {when}, {self.observed[0].shape} before"
            )
        self.observed.append(array)

    def fields(self) -> dict[str, Any]:
        """Return the results."""
        observed: Any = self.observed
        if isinstance(self.observer, Observer):
            observed = real_array(self.observer.result(), "the result of observe")
        q, p = (np.concatenate([end[None] for end in each]) for each in zip(*self.ends, strict=True))
        return {"q": q, "p": p, "observed": np.array(observed), "conserved": np.array(self.conserved)}


def saver_of(observe: Any, times: Array | None, save_every: int) -> Saver:
    """Return the saver of a run with output times or an observer: its name, an observer or a function of the run.

    Raises:
        StateError: for another observer.
    """
    if times is not None:
        return AtTimes(times)
    if observe is None:
        return Saver(save_every)
    if isinstance(observe, str):
        if observe not in OBSERVERS:
            known = ", ".join(OBSERVERS)
            raise StateError(f"there is no observer '{observe}'{closest(observe, OBSERVERS)} Known: {known}")
        observe = OBSERVERS[observe]()
    if not (isinstance(observe, Observer) or callable(observe)):
        raise StateError(f"observe must be a function of the run, an observer or its name, not {observe!r}")
    return Observed(observe, save_every)
