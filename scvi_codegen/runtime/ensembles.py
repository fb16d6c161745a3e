"""Public methods for ensembles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.accuracy import warn_of_energy_errors
from scvi_codegen.runtime.adaptive_ensemble import AdaptiveEnsemble
from scvi_codegen.runtime.chaos_indicators import ChaosIndicators
from scvi_codegen.runtime.chaos_indicators_ensemble import ChaosIndicatorsEnsemble
from scvi_codegen.runtime.constrained_states import ConstrainedStates
from scvi_codegen.runtime.ensemble_selection import ensemble_work
from scvi_codegen.runtime.ensemble_states import EnsembleParameters, momenta_of_each
from scvi_codegen.runtime.ensemble_trajectory import EnsembleTrajectory
from scvi_codegen.runtime.global_error import checked_error, warn_of_unconfirmed
from scvi_codegen.validation.argument_types import FUNCTION, MAPPING, checks_arguments

__all__ = ["Ensembles"]


class Ensembles(ConstrainedStates):
    """Integration of many initial states on all cores."""

    @checks_arguments(StateError, progress=FUNCTION, inputs=MAPPING)
    def integrate_ensemble(
        self,
        q: ArrayLike,
        p: ArrayLike | None = None,
        *,
        inputs: Mapping[str, Any] | None = None,
        velocity: ArrayLike | None = None,
        h: float | None = None,
        steps: int | None = None,
        t_end: ArrayLike | None = None,
        tolerance: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        t_eval: ArrayLike | None = None,
        parameters: EnsembleParameters = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        threads: int | None = None,
        error: float | None = None,
    ) -> EnsembleTrajectory:
        """Run k trajectories on all cores, with common fixed steps (SIMD lanes) or with adaptive steps for each.

        Args:
            q, p: (k, m) initial positions and momenta.
            inputs: of a system with inputs, as of :meth:`integrate`, common to all trajectories, or values of shape
                (k, n), one row per trajectory. Fixed steps are common, end at all breakpoints and lead to one t_end.
            velocity: (k, m) initial velocities, instead of p.
            h, steps, save_every, t, options, progress: as in :meth:`integrate`.
            t_end: final time; with h the last step is shorter unless h divides the time. Without h and steps: final
                time, or (k,) final times, of adaptive steps; every ``save_every``-th state and the last state of each
                trajectory are saved, with their times in ``times``, and ``progress`` is called with the number of
                completed trajectories.
            tolerance: relative error of an adaptive step; by default round-off.
            t_eval: (n,) times at which states are saved instead; NaN after the end of a trajectory.
            parameters: values by name, one number or k each; or an array (k, number of parameters).
            threads: number of threads, by default one per core.
            error: as of :meth:`integrate`, a bound of the relative global error of each trajectory, with a local
                tolerance of its own: ``global_error``, ``confirmed_digits`` and ``confirmed_until`` of the result.

        Returns:
            An :class:`EnsembleTrajectory`; states equal those of :meth:`integrate` to round-off. A trajectory that
            fails has NaN after the failure and the reason in ``status``; the others are unaffected.

        Raises:
            StateError: if a shape, name or number is invalid.
        """
        if error is not None:
            others = {"h": h, "steps": steps, "tolerance": tolerance}
            tau = self.interface.energy_parameter or self.interface.time_transformation
            error = checked_error(error, others, has_tau=bool(tau))
        work = ensemble_work(
            self,
            q,
            p,
            inputs=inputs,
            velocity=velocity,
            h=h,
            steps=steps,
            t_end=t_end,
            tolerance=tolerance,
            t_eval=t_eval,
            save_every=save_every,
            t=t,
            parameters=parameters,
            options=options,
        )
        if error is not None and isinstance(work, AdaptiveEnsemble):
            work.confirm(self, error, threads=threads)
        work.run(progress=progress, threads=threads)
        found = work.result()
        warn_of_unconfirmed(found.confirmations)
        warn_of_energy_errors(found)
        return found

    @checks_arguments(StateError, progress=FUNCTION)
    def chaos_indicators_ensemble(
        self,
        q: ArrayLike,
        p: ArrayLike | None = None,
        *,
        h: float,
        steps: int,
        velocity: ArrayLike | None = None,
        count: int | None = None,
        directions: ArrayLike | None = None,
        save_every: int | None = None,
        t: float = 0.0,
        parameters: EnsembleParameters = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        threads: int | None = None,
    ) -> ChaosIndicators:
        """Return chaos indicators of K initial states over ``steps`` steps of size h.

        For constant diagonal masses and forces of position and time, methods with a fixed-point iteration (SVI,
        collocation) integrate eight trajectories at a time in SIMD lanes; otherwise the derivatives of single steps are
        used, about ten times slower. Results agree to round-off.

        Args:
            q, p, velocity: (K, m) initial states, as of :meth:`integrate_ensemble`.
            count, directions: tangent vectors, as of :meth:`Trajectory.chaos_indicators`; one suffices for MEGNO.
            save_every: steps between saved values; by default only the last is saved.
            t, parameters, options, threads: as of :meth:`integrate_ensemble`.
            progress: called with the number of completed trajectories.

        Returns:
            :class:`ChaosIndicators` of shape (n, K, k): ``found.megno()[-1]`` has K values. A trajectory that fails has
            NaN from at most a thousand steps before the failure on, and the reason in ``status``. An
            :class:`~scvi_codegen.AccuracyWarning` is issued for too large steps, checked on every 64th trajectory.

        Raises:
            MethodError: if time is transformed.
            StateError: if a shape, name or number is invalid.
        """
        p = momenta_of_each(self, q, p, velocity, t, parameters)
        work = ChaosIndicatorsEnsemble(
            self,
            q,
            p,
            h=h,
            steps=steps,
            count=count,
            directions=directions,
            save_every=save_every,
            t=t,
            parameters=parameters,
            options=options,
        )
        return work.run(progress=progress, threads=threads)
