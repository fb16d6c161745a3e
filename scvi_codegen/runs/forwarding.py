"""Methods of steppers and runs that forward to rooms above: analysis and interfaces.

Imports go down (CONTRIBUTING.md). These methods are the exception, so that a user finds paths, chaos indicators and
pictures at the stepper and at the run they belong to; they import when they are called.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.validation import checked_count, checks_arguments
from scvi_codegen.runs.states.validation import Array, EnsembleParameters, Parameters, States

if TYPE_CHECKING:
    from scvi_codegen.extras.chaos.indicators import ChaosIndicators
    from scvi_codegen.extras.paths.path import ArrayOrFunction, Path
    from scvi_codegen.extras.pictures.animation import Film
    from scvi_codegen.extras.pictures.overview import Plots


class SteppersAnalysis:
    """Paths and chaos indicators, of steppers."""

    @checks_arguments(StateError)
    def path(
        self: Any,
        q0: States | None = None,
        q1: States | None = None,
        T: float | None = None,
        *,
        steps: int = 32,
        start: ArrayOrFunction = None,
        revolutions: int | None = None,
        energy: float | None = None,
        closed: Any = None,
        t: float = 0.0,
        parameters: Parameters = None,
        inputs: Mapping[str, Any] | None = None,
        options: SolverOptions | None = None,
    ) -> Path:
        """Return a motion from q0 to q1 in the time T (boundary-value problem): a stationary point of the action.

        Newton's method on the positions of all steps, with the exact Hessian of the action. Boundary-value problems may
        have several solutions: each start leads to one. With forces, damping and inputs the equations are those of
        Lagrange and d'Alembert. The discretisation error of the path is estimated by finer steps; a stationary point of
        the discrete action that is no motion, as through an attractive singularity, is dropped and counted.

        Args:
            q0, q1: (m,) positions at t and t + T.
            T: duration, negative for a path backward in time.
            steps: number of steps. A method of degree 4 to 8 needs about one to four in the shortest period over 2 pi.
            start: positions to start from: (steps + 1, m), or a function of time; by default the straight line. If that
                leads to no path, the path of duration T/16 is continued to T, which finds the direct one, without
                revolutions. If that fails, starts around the centre of a rotational symmetry (both ways) and ten curves
                at random follow.
            revolutions: start from a curve around the centre of a rotational symmetry: 0 for the shorter way from q0
                to q1, n for n more revolutions, negative for the other way around, from -1.
            energy: at the start, of closed paths the mean of all nodes; the duration is then unknown, T an estimate.
            closed: a closed path q(t + T) = M q(t) near ``start``, without q0 and q1: ``True`` (M = 1); the coordinates
                that follow after T, in the order of all, as a permutation with signs, ``["x2", "-y2", ..]``; or an
                orthogonal (m, m) matrix. Without forces and energy= a minimum of the action is sought first.
            t, parameters, options: as in :meth:`step`.
            inputs: as in :meth:`integrate`; their breakpoints should be ends of steps.

        Returns:
            A :class:`~scvi_codegen.extras.paths.path.Path`; its ``run()`` integrates from the first state.

        Raises:
            PathError: if no path is found.
            MethodError: for methods without a sum of L, first-order systems and nonholonomic constraints.
            StateError: if a shape, name or number is invalid.
        """
        from scvi_codegen.extras.paths.path import path_of

        return path_of(
            self.known,
            q0,
            q1,
            T,
            steps=steps,
            start=start,
            revolutions=revolutions,
            energy=energy,
            closed=closed,
            t=t,
            parameters=parameters,
            inputs=inputs,
            options=options,
        )

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
            :class:`ChaosIndicators` of shape (n, K, k): ``megno()[-1]`` has K values. A trajectory that fails has NaN
            from at most a thousand steps before the failure on, and the reason in ``status``. An
            :class:`~scvi_codegen.AccuracyWarning` is issued for too large steps, checked on every 64th trajectory.

        Raises:
            MethodError: if time is transformed.
            StateError: if a shape, name or number is invalid.
        """
        from scvi_codegen.extras.chaos.ensemble import indicators_of_ensemble

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


class ChaosOfRun:
    """Chaos indicators, of runs at saved states."""

    __slots__ = ()

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
        from scvi_codegen.extras.chaos.indicators import InitialTangents, along

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


class Pictured:
    """Mixin of trajectories and ensembles with pictures."""

    __slots__ = ()

    @property
    def _pictured(self) -> Any:
        return self

    @property
    def plot(self) -> Plots:
        """Plots: ``run.plot()`` gives an overview, ``run.plot.energy("energy.png")`` a single plot in a file.

        There are ``motion``, ``phase``, ``energy``, ``momentum_maps`` and ``section``, and of fields on a mesh
        ``field`` and ``spectrum``; each returns Matplotlib axes. Of an ensemble the first 64 trajectories are drawn.
        """
        from scvi_codegen.extras.pictures.overview import Plots

        return Plots(self._pictured)

    def animate(
        self,
        path: str | PathLike[str] | None = None,
        *,
        seconds: float = 8.0,
        positions: Callable[[Array], Array] | None = None,
        picture: Mapping[str, Any] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Film:
        """Return an animation for a notebook, or write .gif, .html or .mp4; see :func:`scvi_codegen.animate`.

        Of an ensemble the first 64 trajectories are drawn together.
        """
        from scvi_codegen.extras.pictures.animation import animate

        return animate(self._pictured, path, seconds=seconds, positions=positions, picture=picture, progress=progress)
