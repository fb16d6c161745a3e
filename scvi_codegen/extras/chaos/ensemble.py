"""Chaos indicators of many initial states: tangent vectors propagated along each trajectory, in parallel threads.

In SIMD lanes the variations are additional coordinates (:mod:`scvi_codegen.systems.derived_systems`) of an ensemble.
After each step C replaces the tangent vectors by Q of their QR factorisation and sums their growth
(``templates/support/run/tangent_growth.h``). Systems without variational
equations in lanes, and lanes whose step fails, are computed trajectory by trajectory. Only the indicators are stored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.checks import checked_count
from scvi_codegen.api.runs import without_accuracy_warnings
from scvi_codegen.api.states import Array, Fixed, Parameters, Starts, States, checked_number
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.extras.chaos.indicators import MOST as LARGEST_CHUNK
from scvi_codegen.extras.chaos.indicators import (
    SERIES,
    ChaosIndicators,
    InitialTangents,
    StepSegment,
    TangentPropagation,
)
from scvi_codegen.runs.stepper import Stepper

OK = "ok"
CHECKED_STRIDE: Final = 64
"""Stride of the trajectories whose step error is estimated."""


class ChaosIndicatorsEnsemble:
    """Computation of the chaos indicators of many initial states; arguments as of ``chaos_indicators_ensemble``."""

    def __init__(
        self,
        stepper: Stepper,
        q: States,
        p: States | None,
        velocity: States | None,
        *,
        h: float,
        steps: int,
        count: int | None,
        directions: ArrayLike | None,
        save_every: int | None,
        t: float,
        parameters: Parameters,
        options: SolverOptions | None,
    ) -> None:
        stepper.products.require("chaos_ensemble")
        self.stepper, self.options = stepper, options
        self.h, steps = Fixed.checked(h).h, checked_count(steps, "steps", least=1)
        self.save_every = steps if save_every is None else checked_count(save_every, "save_every", least=1)
        if steps % self.save_every:
            raise StateError(
                f"steps={steps} must be a multiple of save_every={self.save_every}, so that the last value is saved"
            )
        start = checked_number(t, "t")
        self.t = Fixed(self.h).times(start, np.arange(steps + 1))
        self.q, self.p, self.parameters = stepper.products.ensemble_start(
            q, p, velocity, t=start, parameters=parameters
        )
        self.changes = InitialTangents.checked(stepper, count, directions)
        self.status = np.full(len(self.q), OK, dtype="<U32")
        self.values = np.full((len(SERIES), len(self.t[:: self.save_every]), len(self.q), self._width()), np.nan)

    def run(self, *, progress: Callable[[int], None] | None, threads: int | None) -> ChaosIndicators:
        """Compute the indicators; ``progress`` is called with the number of finished trajectories and may raise.

        Trajectories without SIMD support, or whose SIMD steps failed, use the derivatives of single steps.
        """
        report = progress or (lambda _: None)
        left = self._in_lanes(report, threads)
        if len(left):
            self.stepper.tangent  # noqa: B018  (compiled once, before threads ask for it)
            before = len(self.q) - len(left)
            self.stepper.products.in_threads(
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
            settings: dict[str, Any] = {"t": self.t[0], "parameters": self.parameters[j], "options": self.options}
            with suppress(StepFailedError), without_accuracy_warnings():
                runs[j] = self.stepper.integrate(*start, h=self.h, steps=steps, save_every=steps, **settings)
        worst = max(runs, key=lambda j: np.nan_to_num(runs[j].step_error), default=None)
        if worst is not None:
            runs[worst].warn_of_large_steps(f" (trajectory {worst} of {len(self.q)})")

    def _in_lanes(self, report: Callable[[int], None], threads: int | None) -> NDArray[np.intp]:
        """Process all trajectories in SIMD lanes; return those that failed, all without variational equations."""
        if self.stepper.interface.constraints or self.stepper.interface.rotations:
            return np.arange(len(self.q))
        count, steps, tangents = len(self.q), len(self.t) - 1, self._first(0)
        orthonormal, triangle = np.linalg.qr(tangents)
        frames = (np.tile(half.T.ravel(), (count, 1)) for half in np.split(orthonormal, 2))  # one vector after another
        q, p = (np.hstack(pair) for pair in zip((self.q, self.p), frames, strict=True))
        with np.errstate(divide="ignore"):  # linearly dependent directions span zero volume
            diagonal = np.log(np.abs(np.diagonal(triangle)))
        k = tangents.shape[1]
        growth = np.concatenate([np.zeros(2 * k), diagonal, np.zeros(3 * k), triangle.ravel()])  # of tangent_growth.h
        saved = np.full((len(self.t[:: self.save_every]), count, len(SERIES), k), np.nan)
        saved[0] = growth[: len(SERIES) * k].reshape(len(SERIES), k)
        plan: dict[str, Any] = {"h": self.h, "t": self.t[0], "steps": steps, "save_every": self.save_every}
        settings: dict[str, Any] = {"parameters": self.parameters, "options": self.options}
        runs = self.stepper.products.tangent_lanes(q, p, growth, saved, **plan, **settings)
        if runs is None:
            return np.arange(count)
        runs.run(progress=lambda _: report(int(np.count_nonzero(runs.status == 0))), threads=threads)
        ended = runs.status == 0
        self.values[:, :, ended] = saved.transpose(2, 0, 1, 3)[:, :, ended]
        return np.flatnonzero(~ended)

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

    def _follow(self, j: int, check_stop: Callable[[int], None]) -> None:
        """Integrate trajectory j with tangent vectors, by derivatives of single steps; NaN after a failed step."""
        stepper, steps = self.stepper, len(self.t) - 1

        def propagate_chunk(part: Starts, numbers: NDArray[np.intp], vectors: Array) -> None:
            check_stop(int(numbers[-1]))
            stepper.products.propagate(part, vectors, self.parameters[j], self.options)

        def step_segments() -> Iterator[StepSegment]:
            now = self.q[j], self.p[j]
            for first in range(0, steps, LARGEST_CHUNK):
                last = min(first + LARGEST_CHUNK, steps)
                starts = Starts.chain(*now, self.t[first:last], np.full(last - first, self.h))
                reached = np.arange(first, last + 1)
                yield starts, np.where(reached % self.save_every, -1, reached // self.save_every)
                now = starts.q[-1], starts.p[-1]

        propagation = None
        try:
            propagation = TangentPropagation(self.changes, self._first(j), self.t[:: self.save_every])
            propagation.follow(step_segments(), propagate_chunk)
        except StepFailedError as failure:
            self.status[j] = failure.status
        self.values[:, :, j] = np.nan if propagation is None else propagation.growth.values


def indicators_of_ensemble(
    stepper: Any,
    q: States,
    p: States | None,
    velocity: States | None,
    *,
    progress: Callable[[int], None] | None,
    threads: int | None,
    **settings: Any,
) -> ChaosIndicators:
    """Return the indicators of :meth:`scvi_codegen.Stepper.chaos_indicators_ensemble`."""
    q, p, velocity = stepper.products.states.start(q, p, velocity)
    return ChaosIndicatorsEnsemble(stepper, q, p, velocity, **settings).run(progress=progress, threads=threads)
