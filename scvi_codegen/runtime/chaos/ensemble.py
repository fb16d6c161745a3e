"""Chaos indicators of many initial states: tangent vectors propagated along each trajectory, in parallel threads.

If the ensemble source supports variational equations they run in SIMD lanes. Otherwise, and where a SIMD step fails,
states and derivatives are computed trajectory by trajectory in C, chunk by chunk. Only the indicator series are stored,
so memory does not limit the number of initial states.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.native import building
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import SolverOptions, checked_options
from scvi_codegen.runtime.chaos.growth import SERIES
from scvi_codegen.runtime.chaos.indicators import ChaosIndicators
from scvi_codegen.runtime.chaos.tangent_lanes import TRAJECTORIES_TOGETHER, propagate_in_lanes
from scvi_codegen.runtime.chaos.tangent_propagation import InitialTangents, ahead
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array, States
from scvi_codegen.runtime.ensemble.initial_states import EnsembleParameters, start_of_ensemble
from scvi_codegen.runtime.ensemble.result import OK
from scvi_codegen.runtime.ensemble.thread_pool import StopCheck, run_jobs
from scvi_codegen.runtime.run.accuracy import warn_of_large_steps
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.run_loop import record
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.run.times import times_after
from scvi_codegen.validation import checked_count

CHECKED_STRIDE: Final = 64
"""Stride of the trajectories whose step error is estimated."""


class ChaosIndicatorsEnsemble:
    """Computation of the chaos indicators of many initial states; arguments as of ``chaos_indicators_ensemble``."""

    def __init__(
        self,
        stepper: Integrator,
        q: States,
        p: States,
        *,
        h: float,
        steps: int,
        count: int | None,
        directions: ArrayLike | None,
        save_every: int | None,
        t: float,
        parameters: EnsembleParameters,
        options: SolverOptions | None,
    ) -> None:
        stepper._check_fixed_steps("chaos_indicators_ensemble")
        self.stepper, self.options = stepper, checked_options(options)
        self.h, steps = checked_step(h), checked_count(steps, "steps", least=1)
        self.save_every = steps if save_every is None else checked_count(save_every, "save_every", least=1)
        if steps % self.save_every:
            raise StateError(
                f"steps={steps} must be a multiple of save_every={self.save_every}, so that the last value is saved"
            )
        start = checked_number(t, "the time t")
        self.t = times_after(start, self.h, np.arange(steps + 1))[0]
        self.q, self.p, self.parameters = start_of_ensemble(stepper, q, p, start, parameters)
        self.changes = InitialTangents.checked(stepper, count, directions)
        self.status = np.full(len(self.q), OK, dtype="<U32")
        self.values = np.full((len(SERIES), len(self.t[:: self.save_every]), len(self.q), self._width()), np.nan)

    def run(self, *, progress: Callable[[int], None] | None, threads: int | None) -> ChaosIndicators:
        """Compute the indicators; ``progress`` is called with the number of finished trajectories and may raise.

        Trajectories without SIMD support, or whose SIMD steps failed, use the derivatives of single steps.
        """
        report, left = progress or _silence, np.arange(len(self.q))
        if (binding := self._lanes()) is not None:
            left = self._all_in_lanes(binding, report, threads)
        if len(left):
            self.stepper.tangent  # noqa: B018  (compiled once, before threads ask for it)
            before = len(self.q) - len(left)
            run_jobs(
                len(left),
                lambda k, check_stop: self._follow(int(left[k]), check_stop),
                progress=lambda done: report(before + done),
                threads=threads,
            )
        self._warn_of_long_steps()
        return ChaosIndicators.of(self.t[:: self.save_every], self.values, self.status)

    def _warn_of_long_steps(self) -> None:
        """Warn of too large steps: rerun every ``CHECKED_STRIDE``-th trajectory, as SIMD steps estimate no error."""
        steps, runs = len(self.t) - 1, {}
        for j in range(0, len(self.q), CHECKED_STRIDE):
            start = self.q[j], self.p[j]
            given: dict[str, Any] = {"t": self.t[0], "parameters": self.parameters[j], "options": self.options}
            memory = Memory.started(self.stepper, *start, plan=StepPlan.with_step(self.h), **given)
            with suppress(StepFailedError):
                runs[j] = record(memory, steps, save_every=steps)
        worst = max(runs, key=lambda j: np.nan_to_num(runs[j].step_error), default=None)
        if worst is not None:
            warn_of_large_steps(runs[worst], remedy=f" (trajectory {worst} of {len(self.q)})")

    def _lanes(self) -> Binding | None:
        """Return the compiled ensemble library with tangent vectors, or ``None``."""
        if self.stepper.interface.constraints or self.stepper.interface.rotations:
            return None
        source = self.stepper._variational_source(self.values.shape[-1])
        return None if source is None else Binding(building.load(source, flags=self.stepper.flags), source.prefix)

    def _all_in_lanes(self, binding: Binding, report: Callable[[int], None], threads: int | None) -> NDArray[np.intp]:
        """Process all trajectories in SIMD lanes, ``TRAJECTORIES_TOGETHER`` at a time; return those that failed."""
        count, changes = len(self.q), self._first(0)
        done = np.zeros(count, dtype=bool)

        def follow(k: int, check_stop: StopCheck) -> None:
            part = slice(k * TRAJECTORIES_TOGETHER, min((k + 1) * TRAJECTORIES_TOGETHER, count))
            self.values[:, :, part], done[part] = propagate_in_lanes(
                binding,
                changes,
                self.q[part],
                self.p[part],
                self.parameters[part],
                t=self.t,
                h=self.h,
                save_every=self.save_every,
                options=self.options,
                check_stop=check_stop,
            )

        run_jobs(
            -(-count // TRAJECTORIES_TOGETHER), follow, progress=lambda _: report(int(done.sum())), threads=threads
        )
        return np.flatnonzero(~done)

    def _width(self) -> int:
        """Return the number of tangent vectors of the first trajectory that can be started (constraints reduce it)."""
        for j in range(len(self.q)):
            with suppress(StepFailedError):
                return int(self._first(j).shape[1])
        return self.changes.count or self.changes.size

    def _first(self, j: int) -> Array:
        """Return the (2m, k) initial tangent vectors of trajectory j."""
        start = self.q[j], self.p[j], self.h, float(self.t[0])
        return self.changes.at(*start, self.parameters[j], self.options)

    def _follow(self, j: int, check_stop: StopCheck) -> None:
        values, failure = ahead(
            self.changes,
            self.q[j],
            self.p[j],
            self.parameters[j],
            t=self.t,
            h=self.h,
            save_every=self.save_every,
            options=self.options,
            check_stop=check_stop,
        )
        self.values[:, :, j] = np.nan if values is None else values
        if failure:
            self.status[j] = failure.status


def _silence(_: int) -> None:
    pass
