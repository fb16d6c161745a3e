"""Certificates of integrators: measurement of every guaranteed property of the code as built.

Three independent computations are compared. The *compiled* step is compared with the paper's equations solved in 60
digits (:mod:`scvi_codegen.extras.exact.step`) and, for its structure, with finite differences of itself. *These
digits* are compared with the exact motion, computed from the formula of L or H alone
(:mod:`scvi_codegen.extras.exact.solution`), and with other methods that are the same map. An error in the printed C,
the tables, a kernel or a solver shows in the first comparison; an error in the derivation, which both sides share, in
the second.

States and parameters are perturbed slightly, so that no symmetry and no mass of 1 hides an error.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.methods import Method
from scvi_codegen.api.program import Derivation
from scvi_codegen.api.runs import without_accuracy_warnings
from scvi_codegen.api.states import Array, Fixed, checked_number
from scvi_codegen.api.systems import ArraySystem, MechanicalSystem
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.extras.verification.arrays import state_of_fields, verify_arrays
from scvi_codegen.extras.verification.certificate import Certificate, Check, Outcome, issued
from scvi_codegen.extras.verification.convergence import convergence_checks, identity_checks
from scvi_codegen.extras.verification.derivatives import derivative_checks, time_transformation_derivative_checks
from scvi_codegen.extras.verification.impacts import impact_checks, run_of, transition_checks
from scvi_codegen.extras.verification.roundoff import roundoff_checks
from scvi_codegen.extras.verification.stepping import predictor_checks, step_checks
from scvi_codegen.extras.verification.structure import largest_step, structure_checks
from scvi_codegen.extras.verification.system_under_test import EPSILON, SHORT_RUN, State, SystemUnderTest
from scvi_codegen.extras.verification.variable_steps import VariableSteps, at_fixed_energy, variable_step_checks
from scvi_codegen.methods import as_method
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.stepper import Stepper

__all__ = ["Certificate", "Check", "Outcome", "verify"]


SEEDS = range(20)
"""Seeds of the random states that are tried if no state is passed."""
PART = 0.1
"""Largest change of the state per step relative to its size."""


@checks_arguments(system=MechanicalSystem.OR_ARRAYS, stepper=Stepper.KIND)
@without_accuracy_warnings()
def verify(
    system: MechanicalSystem,
    method: Method | str,
    q: ArrayLike | Mapping[str, ArrayLike] | None = None,
    p: ArrayLike | Mapping[str, ArrayLike] | None = None,
    *,
    h: float | None = None,
    t: float = 0.0,
    stepper: Stepper | None = None,
    tolerance: float | None = None,
    solver: str = "auto",
    velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
    parameters: Mapping[str, ArrayLike] | None = None,
    tables: Mapping[str, ArrayLike] | None = None,
) -> Certificate:
    """Measure the guaranteed properties of the integrator of ``system`` by ``method`` and return a certificate.

    Inputs are cubic polynomials in time, as between breakpoints.

    Args:
        system: mechanical system.
        method: method, or its name, as ``"svi:8"``.
        q, p: (m,) state at which to measure; by default a random state at which steps succeed.
        h: step size, in transformed time of tau; by default one that changes this state by about a tenth of its size.
        t: time.
        stepper: stepper under test, for example from ``load_package``; by default compiled now. For a stepper with a
            time-rescaling function (:func:`~scvi_codegen.compile_stepper`) its adaptive steps are measured, too.
        tolerance: also measure runs with adaptive step size and this relative local error; 0: round-off.
        solver: as for ``compile_stepper``.
        velocity: (m,) velocities of the state, instead of p.
        parameters, tables: only for arrays of run-time sizes, which also need q and h (fields on a mesh do not), as of
            :meth:`Stepper.integrate`: properties are measured on a few indices of the arrays first, then at full size;
            the state of the certificate is that of the few indices.

    Returns:
        The certificate. The properties follow from the method (order, symmetry, symplecticity) and the system (momentum
        maps). A property that cannot be measured has the reason in its remark.

    Raises:
        BuildError: without a C compiler.
        MethodError: if the method does not apply to the system, or has no such solver.
        StateError: for q without p and velocity or with both, p or velocity without q, or if no state is found.
    """
    of_run: dict[str, Any] = {"velocity": velocity, "parameters": parameters, "tables": tables}
    if isinstance(system, ArraySystem) and system.mesh is not None and q is None and p is None:
        q, p, h = state_of_fields(system.mesh, method, h)
    _check_arguments(system, stepper, q, h, of_run)
    t, h = checked_number(t, "t"), None if h is None else Fixed.checked(h).h
    began, method = time.perf_counter(), as_method(method, system)
    if isinstance(system, ArraySystem):
        stepper = stepper or compile_stepper(system, method, solver=solver)
        of_known_sizes = partial(verify, solver=solver, tolerance=tolerance)
        of_run |= {"of_known_sizes": of_known_sizes, "tolerance": tolerance}
        return verify_arrays(system, method, stepper, (q, p, cast(float, h), t), began, **of_run)
    if stepper is None or stepper.interface.contacts:
        system = Derivation(system, method).with_friction.system
    derivation = Derivation(system, method)
    form, located = derivation.form, derivation.located
    stepper = stepper or compile_stepper(system, method, solver=solver)
    if stepper.interface.masked != len(form.reactions):
        raise StateError(f"'{system.name}' has other contacts than {stepper!r}: pass a system with them, contacts=")
    system = located if stepper.interface.modes else form
    start = _initial_state(system, stepper, (q, p, velocity), h, t)
    return _certificate(system, form, method, stepper, start, began, solver=solver, tolerance=tolerance)


def _check_arguments(
    system: MechanicalSystem, stepper: Stepper | None, q: Any, h: float | None, of_run: Mapping[str, Any]
) -> None:
    """Raise :class:`StateError` for arguments that named coordinates lack or arrays require, and the other way."""
    of_arrays = isinstance(system, ArraySystem)
    if of_arrays and (q is None or h is None):
        raise StateError(f"verify requires q and h for arrays of '{system.name}': their shapes determine the sizes")
    for name in ("parameters", "tables"):
        if of_run[name] is not None and not of_arrays:
            raise StateError(f"{name} is for arrays of run-time sizes: give parameters as defaults of the system")
    if stepper is None or stepper.run_time_sizes == of_arrays:
        return
    if of_arrays:
        raise StateError(f"stepper must be one of run-time sizes, not {stepper!r}: compile it without sizes")
    raise StateError(f"{stepper!r} is for arrays of run-time sizes, but the sizes of '{system.name}' are known")


def _certificate(
    system: MechanicalSystem,
    stated: MechanicalSystem,
    method: Method,
    stepper: Stepper,
    start: State,
    began: float,
    *,
    solver: str,
    tolerance: float | None,
) -> Certificate:
    flags, with_events, stepper = stepper.flags, stepper, stepper.with_events(())
    run = run_of(stepper, start, start.h, steps=10 * SHORT_RUN) if stepper.interface.mode_names else None
    if run:
        system = system.with_parameters(**stepper.parameters_by_name(run.parameters_on_sides(start.t)))
    steps, single = stepper, at_fixed_energy(system, stepper.energy(start.q, start.p, start.t))
    if single is not system or stepper.interface.time_transformation is not None:
        steps = compile_stepper(single, method, solver=solver, flags=flags)
    newton = _newton(stated if stepper.interface.modes else single, method, steps, solver, flags)  # locates kinks once
    tested = SystemUnderTest(single, method, steps, newton, start)
    variable = steps is not stepper or tolerance is not None
    runs = VariableSteps(tested, stepper, system.in_time, system, tolerance)
    checks = (
        *(transition_checks(tested, run) if run else ()),
        *(variable_step_checks(runs) if variable else ()),
        *step_checks(tested),
        *(() if run else predictor_checks(tested)),
        *(() if system.constraints or run else roundoff_checks(tested)),
        *structure_checks(tested),
        *derivative_checks(tested),
        *(time_transformation_derivative_checks(runs) if system.clock else ()),
        *convergence_checks(tested),
        *identity_checks(tested),
        *impact_checks(tested, with_events),
        *(() if run else (largest_step(tested),)),
    )
    parameters = {name.name: value for name, value in single.constants.items()}
    return issued(
        stepper, start, began=began, system=single.name, method=method.name, parameters=parameters, checks=checks
    )


def _newton(
    system: MechanicalSystem, method: Method, stepper: Stepper, solver: str, flags: tuple[str, ...]
) -> Stepper | None:
    """Return a stepper that uses Newton's method alone, to compare with; ``None`` for an explicit or other solver."""
    if solver == "newton":
        return stepper
    if solver != "auto" or not method.implicit:
        return None
    return compile_stepper(system, method, solver="newton", flags=flags)


def _initial_state(
    system: MechanicalSystem, stepper: Stepper, state: tuple[Any, Any, Any], h: float | None, t: float
) -> State:
    if all(part is None for part in state):
        return _random_state(system, stepper, h, t)
    if state[0] is None:
        raise StateError("p or velocity was passed without q: give the whole state, or none")
    position, momentum = np.split(stepper.products.start(*state, t, None)[0], 2)
    if system.constraints:
        position, momentum = stepper.project(position, momentum, t=t)
    return State(position, momentum, t, h if h else _step(stepper, position, momentum, t))


def _random_state(system: MechanicalSystem, stepper: Stepper, h: float | None, t: float) -> State:
    """Return a random state of size 1 at which steps succeed and the energy is finite."""
    for seed in SEEDS:
        generator = np.random.default_rng(seed)
        q, v = generator.uniform(0.2, 1.0, (2, system.dimension))
        try:
            p = v if system.auxiliaries else stepper.momentum(q, v, t)
            if system.constraints:
                q, p = stepper.project(q, p, t=t)
            step = h or _step(stepper, q, p, t)
            stepper.step(q, p, step, t, stepper.defaults)
        except (StateError, StepFailedError):
            continue
        return State(q, p, t, step)
    raise StateError(
        f"no random state of '{system.name}' of size 1 was found at which a step succeeds: give q, p and h"
    )


def _step(stepper: Stepper, q: Array, p: Array, t: float) -> float:
    """Return a step size that changes q and p by at most a tenth of their size."""
    h = 1.0
    while h > EPSILON:
        try:
            q1, p1 = stepper.step(q, p, h, t, stepper.defaults)
        except StepFailedError:
            h /= 2
            continue
        change = max(np.abs(q1 - q).max() / (np.abs(q).max() or 1.0), np.abs(p1 - p).max() / (np.abs(p).max() or 1.0))
        if change <= PART:
            return h
        h /= 2
    raise StateError("no step of any size succeeds at this state: give h, or another state")
