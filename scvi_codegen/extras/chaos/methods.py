"""Methods of steppers and runs: chaos indicators."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from scvi_codegen.api.checks import checked_count, checks_arguments
from scvi_codegen.api.states import Array, Parameters, States
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.chaos.ensemble import indicators_of_ensemble
from scvi_codegen.extras.chaos.indicators import ChaosIndicators, InitialTangents, along


class OfSteppers:
    """Chaos indicators of ensembles."""

    @checks_arguments(StateError)
    def chaos_indicators_ensemble(
        self: Any,
        q: States,
        p: States | None = None,
        *,
        h: float,
        steps: int,
        velocity: States | None = None,
        count: int | None = None,
        directions: ArrayLike | None = None,
        save_every: int | None = None,
        t: float = 0.0,
        parameters: Parameters = None,
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
            :class:`ChaosIndicators` of shape (n, K, k): ``megno()[-1]`` has K values. A trajectory that fails has NaN
            from at most a thousand steps before the failure on, and the reason in ``status``. An
            :class:`~scvi_codegen.AccuracyWarning` is issued for too large steps, checked on every 64th trajectory.

        Raises:
            MethodError: if time is transformed.
            StateError: if a shape, name or number is invalid.
        """
        return indicators_of_ensemble(
            self,
            q,
            p,
            velocity,
            h=h,
            steps=steps,
            count=count,
            directions=directions,
            save_every=save_every,
            t=t,
            parameters=parameters,
            options=options,
            progress=progress,
            threads=threads,
        )


class OfRuns:
    """Chaos indicators, of runs at saved states."""

    def chaos_indicators(
        self: Any, count: int | None = None, *, directions: ArrayLike | None = None
    ) -> ChaosIndicators:
        """Return the growth of tangent vectors along the run, from which all chaos indicators are computed.

        Args:
            count: number of orthonormal tangent vectors in general position, the same in every run; at most and by
                default 2m, or as many as constraints allow.
            directions: instead (2m,) or (2m, k) tangent vectors admissible for the constraints; norms are irrelevant.

        Raises:
            MethodError: if time is transformed.
            StateError: if the run has no steps, a shape is another, or the states are not at whole steps.
        """
        self._require("chaos")
        if len(self) < 2:
            raise StateError("deviations require a run of at least one step")
        return along(self, InitialTangents.checked(self.stepper, count, directions))

    @checks_arguments(StateError)
    def lyapunov_exponents(self, *, history: bool = False) -> Array:
        """Return the (2m,) finite-time Lyapunov exponents of the run, descending; raises as :meth:`chaos_indicators`.

        For symplectic steps they occur in pairs of opposite sign, to round-off.

        Args:
            history: return (n, 2m) exponents up to each state instead; NaN at the first state.
        """
        exponents = self.chaos_indicators().lyapunov_exponents()
        return exponents if history else exponents[-1]

    def megno(self) -> Array:
        """Return (n,) MEGNO: 2 if regular, lambda t / 2 if chaotic; see :meth:`ChaosIndicators.megno`."""
        return self.chaos_indicators(1).megno()

    def fli(self) -> Array:
        """Return (n,) the fast Lyapunov indicator: log t or lambda t; see :meth:`ChaosIndicators.fli`."""
        return self.chaos_indicators().fli()

    def gali(self, k: int = 2) -> Array:
        """Return (n,) the generalised alignment index of k vectors, 2 to 2m; see :meth:`ChaosIndicators.gali`."""
        return self.chaos_indicators(checked_count(k, "k", least=2)).gali(k)

    def sali(self) -> Array:
        """Return (n,) the smaller alignment index of two tangent vectors; see :meth:`ChaosIndicators.sali`."""
        return self.chaos_indicators(2).sali()
