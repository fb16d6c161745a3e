"""Derivatives of a trajectory with respect to its initial state and parameters, and chaos indicators."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.chaos.indicators import ChaosIndicators
from scvi_codegen.runtime.chaos.tangent_propagation import InitialTangents, along
from scvi_codegen.runtime.sensitivity.derivatives_with_inputs import DerivativesWithInputs
from scvi_codegen.runtime.sensitivity.gradients import Gradient, sensitivity, tangent_vectors, vector_jacobian_product
from scvi_codegen.runtime.sensitivity.hessians import hessian_product
from scvi_codegen.runtime.sensitivity.step_derivatives import Sensitivity
from scvi_codegen.runtime.trajectory.saved_states import Array, SavedStates
from scvi_codegen.validation import SWITCH, checked_count, checks_arguments


@dataclass(slots=True, kw_only=True, eq=False)
class TrajectoryDerivatives(SavedStates):
    """:class:`SavedStates` with the exact derivatives of the computed map at fixed step sizes.

    Derivatives require states at whole steps; states of ``t_eval`` have none. After a terminal event the size of the
    last, partial step is also held fixed: the variation of the crossing time is not included. In transformed time the
    steps of tau are fixed and the times of states vary, except the final time of a run (t_end or an event).
    """

    @property
    def _pieces(self) -> tuple[SavedStates, ...]:
        """Trajectories between the breakpoints of inputs; empty without inputs."""
        pieces: tuple[SavedStates, ...] = getattr(self, "pieces", ())
        return pieces

    @property
    def _with_inputs(self) -> DerivativesWithInputs:
        return DerivativesWithInputs(self._pieces)

    def _check_without_inputs(self, what: str) -> None:
        if self._pieces:
            raise StateError(f"{what} is not available for runs with inputs: use tangent or pullback, or run.pieces")

    def tangent(self, directions: ArrayLike | None = None) -> Array:
        """Return (n, 2m, k) tangent vectors at the states, from (2m, k) initial directions of (q, p), by default all.

        They are exact derivatives of the computed states at fixed step sizes (:meth:`Stepper.jacobian`). Directions
        may also be (2m + parameters + 2, k), of (q, p, parameters, t, h), with zeros for the parameters of inputs and,
        with inputs, for h. In transformed time the energy is that of
        the first state and varies with it; a direction of the energy parameter is added.

        Raises:
            StateError: if the directions have another shape, or the states are not at whole steps.
        """
        return self._with_inputs.tangent(directions) if self._pieces else tangent_vectors(self, directions)

    def sensitivity(self) -> Sensitivity:
        """Return the derivatives of all states with respect to the initial state, the parameters, t and h.

        Steps are recomputed from the saved states; derivatives are exact to round-off. For few functions of the states
        :meth:`pullback` is cheaper. In transformed time ``times`` contains the derivatives of the times. Raises as
        :meth:`tangent`.
        """
        self._check_without_inputs("sensitivity")
        return sensitivity(self)

    def pullback(self, cotangents: ArrayLike) -> Gradient:
        """Return the gradient of a function of the states with respect to the initial state, parameters, t and h.

        Discrete adjoint: one pass backward along the run, independent of the number of parameters, exact to round-off
        for the computed states. Steps between saved states (``save_every``) are recomputed.

        Args:
            cotangents: (n, 2m) derivatives of the function with respect to (q, p) of each state; (n, 2m, c) of c
                functions. In transformed time also (n, 2m + 1) or (n, 2m + 1, c), with those with respect to t.

        Raises:
            StateError: if the shape is another, or the states are not at whole steps.
        """
        return self._with_inputs.pullback(cotangents) if self._pieces else vector_jacobian_product(self, cotangents)

    def hessian_product(
        self, cotangents: ArrayLike, directions: ArrayLike, curvatures: ArrayLike | None = None
    ) -> Gradient:
        """Return the Hessian of a function F of the states, with respect to the initial data, times directions.

        This is the derivative of :meth:`pullback` along the directions, exact to round-off, computed in one forward
        and one backward pass for all of them; with the identity of size 2m + k + 2 it is the whole Hessian.

        Args:
            cotangents: (n, 2m) gradient of F with respect to (q, p) of each state.
            directions: (2m,) or (2m, k) of (q, p), or (2m + parameters + 2,) or (.., k) of (q, p, parameters, t, h).
            curvatures: (n, 2m, 2m) Hessian of F with respect to (q, p) of each state; by default 0 (linear F).

        Returns:
            A :class:`Gradient` of the products, (m,) or (m, k) for q, and so on.

        Raises:
            MethodError: if time is transformed, or the system is damped.
            StateError: if a shape is another, or the states are not at whole steps.
        """
        if self._pieces:
            return self._with_inputs.hessian_product(cotangents, directions, curvatures)
        return hessian_product(self, cotangents, directions, curvatures)

    def chaos_indicators(self, count: int | None = None, *, directions: ArrayLike | None = None) -> ChaosIndicators:
        """Return the growth of tangent vectors along the run, from which all chaos indicators are computed.

        Args:
            count: number of orthonormal tangent vectors in general position, the same in every run; at most and by
                default 2m, or as many as constraints allow.
            directions: instead (2m,) or (2m, k) tangent vectors admissible for the constraints; norms are irrelevant.

        Raises:
            MethodError: if time is transformed.
            StateError: if the run has no steps, a shape is another, or the states are not at whole steps.
        """
        self._check_without_inputs("chaos_indicators")
        if len(self) < 2:
            raise StateError("deviations require a run of at least one step")
        return along(self, InitialTangents.checked(self.stepper, count, directions))

    @checks_arguments(StateError, history=SWITCH)
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
