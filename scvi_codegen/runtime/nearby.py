"""What kept states say of nearby motions: derivatives by all that a run starts from, and indicators of chaos."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.given.counts import checked_count
from scvi_codegen.given.kinds import SWITCH, takes
from scvi_codegen.runtime.deviations import Deviations
from scvi_codegen.runtime.gradients import Gradient, carried, pulled_back, sensitivity
from scvi_codegen.runtime.hessians import hessian_product
from scvi_codegen.runtime.kept_states import Array, KeptStates
from scvi_codegen.runtime.linearised import Sensitivity
from scvi_codegen.runtime.spreading import Changes, along

__all__ = ["NearbyMotions"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearbyMotions(KeptStates):
    """:class:`KeptStates` with the exact derivatives of the computed map, lengths of steps held.

    They stand at whole steps: states of ``t_eval`` have none. The last step of a run that a terminal event ended is
    that to the time of the crossing, which is held, too: how it would move is not told. In transformed time lengths are
    of tau, and the times of states move; but where a run ends, at t_end or an event, its time is held.
    """

    def tangent(self, directions: ArrayLike | None = None) -> Array:
        """(n, 2m, k) what becomes of (2m, k) directions of (q, p) at the first state; all 2m without any.

        The exact derivative of the computed states, lengths of steps held (:meth:`Stepper.jacobian`). Directions may
        be (2m + parameters + 2, k), too, of (q, p, parameters, t, h). In transformed time the energy is that of the
        first state, and moves with it; one among the parameters is what is added to it.

        Raises:
            StateError: for directions of another shape, and states that do not stand at whole steps.
        """
        return carried(self, directions)

    def sensitivity(self) -> Sensitivity:
        """Derivatives of all states by the initial state, the parameters, the initial time and h, lengths held.

        Of steps solved anew from the kept states, exact to round-off. For a few functions of the states
        :meth:`pullback` costs less. In transformed time ``times`` tells of the times of the states. Raises as
        :meth:`tangent`.
        """
        return sensitivity(self)

    def pullback(self, cotangents: ArrayLike) -> Gradient:
        """The gradient of a function of the states by the initial state, the parameters, the initial time and h.

        One pass back along the run, whatever the number of parameters: the adjoint, exact to round-off of the computed
        states. Where not all states are kept (``save_every``) the steps between them are taken again.

        Args:
            cotangents: (n, 2m) slopes of the function by (q, p) of each state; (n, 2m, c) of c functions. In
                transformed time also (n, 2m + 1) or (n, 2m + 1, c), with those by the time of each.

        Raises:
            StateError: for another shape, and states that do not stand at whole steps.
        """
        return pulled_back(self, cotangents)

    def hessian_product(
        self, cotangents: ArrayLike, directions: ArrayLike, curvatures: ArrayLike | None = None
    ) -> Gradient:
        """The Hessian of a function F of the states, by all that the run started from, times directions.

        The derivative of :meth:`pullback` along directions, exact to round-off: once forward and back along the run
        for all of them, whatever the number of parameters; with ``np.eye(stepper.given)`` the whole Hessian.

        Args:
            cotangents: (n, 2m) slopes of F by (q, p) of each state.
            directions: (2m,) or (2m, k) of (q, p), or (2m + parameters + 2,) or (.., k) of (q, p, parameters, t, h).
            curvatures: (n, 2m, 2m) second slopes of F by (q, p) of each state; without any, F is linear in the states.

        Returns:
            A :class:`Gradient`, (m,) or (m, k) and so on: its changes along the directions.

        Raises:
            MethodError: in transformed time, and with damping.
            StateError: for another shape, and states that do not stand at whole steps.
        """
        return hessian_product(self, cotangents, directions, curvatures)

    def deviations(self, count: int | None = None, *, directions: ArrayLike | None = None) -> Deviations:
        """What becomes of small changes of the initial state: what all indicators of chaos are told from.

        Args:
            count: of changes, orthonormal and in general position, the same in every run; at most and by default 2m, or
                as many as constraints leave.
            directions: instead (2m,) or (2m, k) changes, which constraints allow; their lengths do not matter.

        Raises:
            MethodError: in transformed time.
            StateError: of a run of no steps, for other shapes, and states that do not stand at whole steps.
        """
        if len(self) < 2:
            raise StateError("what nearby motions do takes a time that passes: this run has no steps")
        return along(self, Changes.checked(self.stepper, count, directions))

    @takes(StateError, history=SWITCH)
    def lyapunov_exponents(self, *, history: bool = False) -> Array:
        """(2m,) Lyapunov exponents of the time that the run covers, descending; raises as :meth:`deviations`.

        Of symplectic steps they are opposite in pairs, to round-off.

        Args:
            history: (n, 2m) of the time until each state instead; not numbers at the first.
        """
        exponents = self.deviations().lyapunov_exponents()
        return exponents if history else exponents[-1]

    def megno(self) -> Array:
        """(n,) MEGNO: 2 for regular motions, lambda t / 2 for chaotic ones; see :meth:`Deviations.megno`."""
        return self.deviations(1).megno()

    def fli(self) -> Array:
        """(n,) the fast Lyapunov indicator: log t or lambda t; see :meth:`Deviations.fli`."""
        return self.deviations().fli()

    def gali(self, k: int = 2) -> Array:
        """(n,) the generalized alignment index of k changes, 2 to 2m; see :meth:`Deviations.gali`."""
        return self.deviations(checked_count(k, "k", least=2)).gali(k)

    def sali(self) -> Array:
        """(n,) the smaller alignment index of two changes; see :meth:`Deviations.sali`."""
        return self.deviations(2).sali()
