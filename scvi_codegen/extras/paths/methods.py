"""The method ``path`` of steppers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.states import Parameters, States
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.paths.path import ArrayOrFunction, Path, path_of


class OfSteppers:
    """Paths between positions."""

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
