"""Many trajectories at once, as users ask a stepper for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.given.kinds import FUNCTION, MAPPING, takes
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.accuracy import warn_of_lost_energies
from scvi_codegen.runtime.constrained_states import ConstrainedStates
from scvi_codegen.runtime.deviations import Deviations
from scvi_codegen.runtime.deviations_ensemble import DeviationsEnsemble
from scvi_codegen.runtime.ensemble_states import EnsembleParameters, momenta_of_each
from scvi_codegen.runtime.ensemble_trajectory import EnsembleTrajectory
from scvi_codegen.runtime.ensemble_work import driven_work, ensemble_work

__all__ = ["Ensembles"]


class Ensembles(ConstrainedStates):
    """Integrations of many states, each on its own, over all cores."""

    @takes(StateError, progress=FUNCTION)
    def integrate_ensemble(
        self,
        q: ArrayLike,
        p: ArrayLike | None = None,
        *,
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
    ) -> EnsembleTrajectory:
        """Run k trajectories over all cores: with common steps, eight at a time as vector lanes, or each by its own.

        Args:
            q, p: (k, m) initial positions and momenta.
            velocity: (k, m) initial velocities, in place of p.
            h, steps, save_every, t, options, progress: as in :meth:`integrate`.
            t_end: instead of h and steps: one time or (k,) times to go to, by steps that choose their length in each
                trajectory. Every ``save_every``-th state of each is kept, and the last, at the ``times`` of the
                result. ``progress`` is then called with the number of trajectories done.
            tolerance: relative error of the end of such a step; by default round-off.
            t_eval: (n,) times: keep the states of all trajectories at these instead; NaN beyond their ends.
            parameters: by name, one number or k each; or (k, number of parameters).
            threads: workers, by default one a core.

        Returns:
            An :class:`EnsembleTrajectory`; states equal those of :meth:`integrate` to round-off. A trajectory that
            fails has NaN from there on and says why in ``status``; the others are not disturbed.

        Raises:
            StateError: on wrong shapes, names or numbers.
        """
        work = ensemble_work(
            self,
            q,
            p,
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
        work.run(progress=progress, threads=threads)
        found = work.result()
        warn_of_lost_energies(found)
        return found

    @takes(StateError, progress=FUNCTION, inputs=MAPPING)
    def drive_ensemble(
        self,
        q: ArrayLike,
        p: ArrayLike | None = None,
        *,
        inputs: Mapping[str, Any],
        h: float | None = None,
        velocity: ArrayLike | None = None,
        steps: int | None = None,
        t_end: ArrayLike | None = None,
        tolerance: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        parameters: EnsembleParameters = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        threads: int | None = None,
    ) -> EnsembleTrajectory:
        """Run k trajectories with inputs: by common steps that end at all breakpoints, or each by steps of its own.

        Args:
            inputs: as of :meth:`drive`, the same for all trajectories; with values of shape (k, n) each has its own.
            h: of common steps; one that ends at a breakpoint is shorter. Without it steps choose their length.
            steps, t_end: with h one of both; without it ``t_end``, one time or (k,).
            q, p, velocity, tolerance, save_every, t, parameters, options, progress, threads: as of
                :meth:`integrate_ensemble`.

        Returns:
            An :class:`EnsembleTrajectory` with the states of :meth:`drive`, equal to round-off, to the bit without h.

        Raises:
            StateError: as :meth:`drive`.
        """
        work = driven_work(
            self,
            q,
            p,
            velocity=velocity,
            inputs=inputs,
            h=h,
            steps=steps,
            t_end=t_end,
            tolerance=tolerance,
            save_every=save_every,
            t=t,
            parameters=parameters,
            options=options,
        )
        work.run(progress=progress, threads=threads)
        return work.result()

    @takes(StateError, progress=FUNCTION)
    def deviations_ensemble(
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
    ) -> Deviations:
        """What becomes of small changes of K initial states over ``steps`` steps of h: indicators of chaos of each.

        Of systems with constant diagonal masses and forces of position and time, by methods with sweeps for them (SVI,
        collocation), eight motions go at a time, as vector lanes; others each by the derivatives of its steps, about
        ten times as slow. What is told is the same, to round-off.

        Args:
            q, p, velocity: (K, m) initial states, as of :meth:`integrate_ensemble`.
            count, directions: of changes, as of :meth:`Trajectory.deviations`; 1 is enough for MEGNO.
            save_every: steps between what is kept of each motion; by default the last alone.
            t, parameters, options, threads: as of :meth:`integrate_ensemble`.
            progress: called now and then with the number of motions done.

        Returns:
            :class:`Deviations` of (n, K, k): ``found.megno()[-1]`` are K numbers. A motion that fails is not a number
            from there on, or from up to a thousand steps before, and says why in ``status``. An
            :class:`~scvi_codegen.AccuracyWarning` says when steps are too long, as one motion in 64 finds.

        Raises:
            MethodError: in transformed time, and where a monitor chooses the steps.
            StateError: on wrong shapes, names or numbers.
        """
        p = momenta_of_each(self, q, p, velocity, t, parameters)
        work = DeviationsEnsemble(
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
