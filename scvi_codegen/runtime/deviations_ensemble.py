"""Indicators of chaos over many initial states: small changes carried along each motion, over threads.

States and derivatives are told by the same steps in C, from piece to piece; of a motion nothing is kept but what the
indicators need, so that a million initial states are a question of time, not of memory.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.options import SolverOptions, checked_options
from scvi_codegen.runtime.deviations import Deviations
from scvi_codegen.runtime.ensemble_states import EnsembleParameters, start_of_ensemble
from scvi_codegen.runtime.ensemble_trajectory import OK
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.integrator import Integrator
from scvi_codegen.runtime.spreading import Changes, ahead
from scvi_codegen.runtime.times import times_after
from scvi_codegen.runtime.workers import Heed, run_each

__all__ = ["DeviationsEnsemble"]


class DeviationsEnsemble:
    """Changes of many initial states, to be carried along; arguments as of ``deviations_ensemble``."""

    def __init__(
        self,
        stepper: Integrator,
        q: ArrayLike,
        p: ArrayLike,
        *,
        h: float,
        steps: int,
        count: int | None,
        directions: ArrayLike | None,
        every: int | None,
        t: float,
        parameters: EnsembleParameters,
        options: SolverOptions | None,
    ) -> None:
        stepper.check_steps_of_h("a motion of an ensemble")
        self.stepper, self.options = stepper, checked_options(options)
        self.h, steps = checked_step(h), checked_count(steps, "steps", least=1)
        self.every = steps if every is None else checked_count(every, "every", least=1)
        if steps % self.every:
            raise StateError(f"steps={steps} is no multiple of every={self.every}: the last would not be kept")
        start = checked_number(t, "the time t")
        self.t = times_after(start, self.h, np.arange(steps + 1))[0]
        self.q, self.p, self.parameters = start_of_ensemble(stepper, q, p, start, parameters)
        self.changes = Changes.checked(stepper, count, directions)
        self.found: dict[int, tuple[Deviations, StepFailedError | None]] = {}

    def run(self, *, progress: Callable[[int], None] | None, threads: int | None) -> Deviations:
        """Follow all motions; ``progress`` is called with the number of those done, and may raise to stop them."""
        self.stepper.tangent  # noqa: B018  (compiled once, before threads ask for it)
        run_each(len(self.q), self._follow, progress=progress, threads=threads)
        found = [self.found[j] for j in range(len(self.q))]

        def of_all(name: str) -> Array:
            return np.stack([getattr(each, name) for each, _ in found], axis=1)

        return Deviations(
            t=self.t[:: self.every],
            lengths=of_all("lengths"),
            stretches=of_all("stretches"),
            rates=of_all("rates"),
            mean_rates=of_all("mean_rates"),
            status=np.array([failure.status if failure else OK for _, failure in found]),
        )

    def _follow(self, j: int, heed: Heed) -> None:
        self.found[j] = ahead(
            self.changes,
            self.q[j],
            self.p[j],
            self.parameters[j],
            t=self.t,
            h=self.h,
            every=self.every,
            options=self.options,
            heed=heed,
        )
