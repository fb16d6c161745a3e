"""Certificates of integrators of array systems.

At small sizes, cut out of the arrays, the loops are compared with the unrolled system (:func:`unroll_sums`): its
equations in 60 digits, its exact motion and its compiled steps, none of which has loops. At full size, the rates are
compared with NumPy, and conserved quantities are measured along a run.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StateError
from scvi_codegen.lowering.arrays import one_coordinate
from scvi_codegen.mechanics.arrays.rolling import unroll_sums
from scvi_codegen.mechanics.arrays.system import ArraySystem
from scvi_codegen.methods import as_method
from scvi_codegen.methods.method import Method
from scvi_codegen.runtime.arrays.interface import read_arrays
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.verification.arrays.small import small_start
from scvi_codegen.verification.arrays.whole import WholeStart, whole_checks
from scvi_codegen.verification.certificate import Certificate, Finding, checked, issued
from scvi_codegen.verification.convergence import convergence_checks
from scvi_codegen.verification.stepping import step_checks
from scvi_codegen.verification.structure import structure_checks
from scvi_codegen.verification.system_under_test import State, SystemUnderTest

__all__ = ["verify_arrays"]

SMALL_STEPS = 40
ROUNDINGS = 16.0 * SMALL_STEPS
"""Bound on the deviation after ``SMALL_STEPS`` steps, in units of rounding."""


def verify_arrays(
    system: ArraySystem,
    method: Method | str,
    q: Any,
    p: Any,
    *,
    h: float | None,
    t: float,
    stepper: Stepper | None,
    tolerance: float | None,
    flags: Sequence[str],
    of_known_sizes: Callable[..., Certificate],
    **arrays_of_run: Any,
) -> Certificate:
    """Return the certificate of arrays of run-time sizes; arguments as of ``of_known_sizes``, which is ``verify``.

    Properties are measured on a few indices of the arrays first, then at full size; adaptive steps, constraints, and
    systems without an integrator for arrays of any size with known sizes only.
    """
    if q is None and p is None and system.mesh is not None:
        q, p, h = _state_of_fields(system.mesh, method, h)
    if q is None or h is None:
        raise StateError(f"verify requires q and h for arrays of '{system.name}': their shapes determine the sizes")
    if stepper is not None and not stepper.any_size:
        raise StateError(f"stepper must be one of any size, not {stepper!r}: compile it without sizes")
    began = time.perf_counter()
    chosen = as_method(method, one_coordinate(system))
    stepper = stepper or compile_stepper(system, chosen, flags=tuple(flags))
    run = stepper.start(q, p, h=h, t=t, **arrays_of_run)
    arrays = read_arrays(stepper.interface, q, arrays_of_run["parameters"], arrays_of_run["tables"])
    if stepper.source is None or system.coupled_terms or tolerance is not None or system.constraints:
        numbers = dict(zip(stepper.interface.parameters, arrays.numbers, strict=True))
        known = unroll_sums(system, arrays.sizes, tables=arrays.places, parameters={**numbers, **arrays.fields})
        return of_known_sizes(known, chosen, run.q, run.p, h=run.h, t=run.t, tolerance=tolerance, flags=flags)
    start = WholeStart(system, chosen, stepper, arrays, run.stepper.arrays(run.p), run.h, run.t)
    tested = _subject(start)
    checks = (
        *checked(
            "unrolled system",
            f"{SMALL_STEPS} steps equal those of the unrolled system",
            partial(_compared_with_unrolled, start, tested),
        ),
        *step_checks(tested),
        *structure_checks(tested),
        *convergence_checks(tested),
        *whole_checks(start),
    )
    parameters = dict(zip(stepper.interface.parameters, arrays.numbers, strict=True))
    return issued(
        stepper,
        tested.initial,
        began=began,
        system=system.name,
        method=chosen.name,
        parameters=parameters,
        checks=checks,
    )


def _state_of_fields(mesh: Any, method: Method | str, h: float | None) -> tuple[Any, Any, float]:
    """Return random fields at the points of a mesh, their momenta, and a step size at which iterations converge."""
    random = np.random.default_rng(0)
    q, p = ({each: random.uniform(-0.5, 0.5, mesh.weights.shape) for each in mesh.field_system.fields} for _ in "qp")
    q |= dict.fromkeys(mesh.field_system.scalars, np.array(0.1))
    return q, {each: mesh.weights * values for each, values in p.items()}, h or min(mesh.largest_step(method) / 4, 0.05)


def _subject(start: WholeStart) -> SystemUnderTest:
    """Return the loops on a few indices as an integrator of the unrolled system."""
    small = small_start(start.stepper.interface, start.arrays, start.p)
    arrays = small.arrays
    names = [parameter.name for parameter in start.system.parameters]
    numbers = dict(zip(names, arrays.numbers, strict=True))
    written = unroll_sums(start.system, arrays.sizes, tables=arrays.places, parameters={**numbers, **arrays.fields})
    q, p = (np.concatenate([values.reshape(-1) for values in state.values()]) for state in (arrays.state, small.p))
    stepper = start.stepper._bound_to(arrays)._copy(())
    stepper.interface = replace(stepper.interface, map_names=())  # whole_checks examines momentum maps
    return SystemUnderTest(written, start.method, stepper, None, State(q, p, start.t, start.h))


def _compared_with_unrolled(start: WholeStart, tested: SystemUnderTest) -> Finding:
    """Return the largest difference from the compiled unrolled system, in units of rounding of the first step."""
    first = tested.states[0]
    other = compile_stepper(tested.system, start.method, flags=start.stepper.flags)
    run: dict[str, Any] = {"h": first.h, "t": first.t, "steps": SMALL_STEPS, "parameters": tested.parameters}
    rolled, expected = (each.integrate(first.q, first.p, **run) for each in (tested.stepper, other))
    difference = np.abs(np.concatenate([rolled.q - expected.q, rolled.p - expected.p], axis=1)) / tested.rounding(first)
    return Finding(float(difference.max()), ROUNDINGS, "in units of rounding of a step")
