"""Certificates of integrators of array systems.

At small sizes, cut out of the arrays, the loops are compared with the unrolled system (:func:`unroll_sums`): its
equations in 60 digits, its exact motion and its compiled steps, none of which has loops. At full size, the rates are
compared with NumPy, and conserved quantities are measured along a run.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.formulas import Array
from scvi_codegen.api.methods import Method
from scvi_codegen.api.program import Interface
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.verification.arrays.whole import WholeStart, whole_checks
from scvi_codegen.extras.verification.certificate import Certificate, Check, Finding, checked, information, issued
from scvi_codegen.extras.verification.convergence import convergence_checks
from scvi_codegen.extras.verification.impacts import impact_checks
from scvi_codegen.extras.verification.stepping import step_checks
from scvi_codegen.extras.verification.structure import structure_checks
from scvi_codegen.extras.verification.system_under_test import ROUNDINGS, SHORT_RUN, State, SystemUnderTest
from scvi_codegen.methods import SVI, StoermerVerlet
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.systems.rolling import unroll_sums

__all__ = ["state_of_fields", "verify_arrays"]

MOST_COORDINATES = 64


def state_of_fields(mesh: Any, method: Method | str, h: float | None) -> tuple[Any, Any, float]:
    """Return random fields at the points of a mesh, their momenta, and a step size at which iterations converge."""
    random, fields = np.random.default_rng(0), mesh.field_system.fields
    q, rates = ({field: random.uniform(-0.5, 0.5, mesh.weights.shape) for field in fields} for _ in "qp")
    q |= dict.fromkeys(mesh.field_system.scalars, np.array(0.1))
    p = {field: mesh.weights * rate for field, rate in rates.items()}
    return q, p, h or min(mesh.largest_step(method) / 4, 0.05)


def verify_arrays(
    system: ArraySystem,
    method: Method,
    with_events: Stepper,
    state: tuple[Any, Any, float, float],
    began: float,
    *,
    of_known_sizes: Callable[..., Certificate],
    tolerance: float | None,
    **arrays_of_run: Any,
) -> Certificate:
    """Return the certificate of arrays of run-time sizes at a state (q, p, h, t).

    Properties are measured on a few indices of the arrays first, then at full size; adaptive steps, constraints, and
    systems without an integrator for arrays of run-time sizes with known sizes only, by ``of_known_sizes``: ``verify``
    with this tolerance.
    """
    q, p, h, t = state
    stepper = with_events.with_events(())
    run = stepper.start(q, p, h=h, t=t, **arrays_of_run)
    arrays = stepper.products.run_arrays(q, arrays_of_run["parameters"], arrays_of_run["tables"])
    if stepper.source is None or system.coupled_terms or tolerance is not None or system.constraints:
        initial = State(run.q, run.p, run.t, run._step_size)
        return _at_known_sizes(system, method, with_events, arrays, initial, of_known_sizes)
    start = WholeStart(system, method, stepper, arrays, run.stepper.arrays(run.p), run._step_size, run.t)
    tested = _subject(small_start(start))
    checks = (
        *_unrolled_checks(tested),
        *step_checks(tested),
        *structure_checks(tested),
        *convergence_checks(tested),
        *whole_checks(start),
        *_impact_checks(start, with_events),
    )
    parameters = dict(zip(stepper.interface.parameters, arrays.numbers, strict=True))
    names = {"system": system.name, "method": method.name}
    return issued(stepper, tested.initial, began=began, **names, parameters=parameters, checks=checks)


def _at_known_sizes(
    system: ArraySystem,
    method: Method,
    with_events: Stepper,
    arrays: Any,
    initial: State,
    of_known_sizes: Callable[..., Certificate],
) -> Certificate:
    """Return the certificate of the unrolled system, with the check that loops equal it if there are loops."""
    parameters = {**dict(zip(with_events.interface.parameters, arrays.numbers, strict=True)), **arrays.fields}
    unrolled = unroll_sums(system, arrays.sizes, tables=arrays.places, parameters=parameters)
    stepper = None
    if with_events.events:
        stepper = compile_stepper(unrolled, method, flags=with_events.flags, events=with_events.events)
    if system.constraints and isinstance(method, StoermerVerlet):
        method = SVI(1, "gauss-lobatto:2")  # RATTLE under its name for known sizes
    certificate = of_known_sizes(unrolled, method, initial.q, initial.p, h=initial.h, t=initial.t, stepper=stepper)
    if with_events.source is None:
        return certificate
    loops = SystemUnderTest(unrolled, method, _bound(with_events.with_events(()), arrays), None, initial)
    return replace(certificate, checks=(*_unrolled_checks(loops), *certificate.checks))


def _impact_checks(start: WholeStart, with_events: Stepper) -> Iterator[Check]:
    """Yield the checks of events that change the state, which are compared with formulas of all coordinates."""
    arrays = start.arrays
    stepper = with_events.bind(arrays.state, start.parameters, arrays.places)[0]
    if not stepper.changes_states:
        return
    if stepper.dimension > MOST_COORDINATES:
        yield information("impacts", f"measured for at most {MOST_COORDINATES} coordinates: give fewer", None)
        return
    numbers = np.concatenate([arrays.numbers, *(values.reshape(-1) for values in arrays.fields.values())])
    yield from impact_checks(replace(_subject(start), stepper=stepper), stepper, numbers)


def _subject(start: WholeStart) -> SystemUnderTest:
    """Return the loops at the sizes of ``start`` as an integrator of the unrolled system."""
    arrays = start.arrays
    unrolled = unroll_sums(start.system, arrays.sizes, tables=arrays.places, parameters=start.parameters)
    q, p = (np.concatenate([values.reshape(-1) for values in part.values()]) for part in (arrays.state, start.p))
    return SystemUnderTest(unrolled, start.method, _bound(start.stepper, arrays), None, State(q, p, start.t, start.h))


def _bound(stepper: Stepper, arrays: Any) -> Stepper:
    """Return a stepper of arrays at these sizes, as one of named coordinates."""
    result: Stepper = cast(Any, stepper)._bound_to(arrays)._copy(())
    result.interface = replace(result.interface, map_names=())  # whole_checks examines momentum maps
    return result


def _unrolled_checks(tested: SystemUnderTest) -> Iterator[Check]:
    statement = f"{SHORT_RUN} steps equal those of the unrolled system"
    return checked("unrolled system", statement, partial(_compared_with_unrolled, tested))


def _compared_with_unrolled(tested: SystemUnderTest) -> Finding:
    """Return the largest difference from the compiled unrolled system, in units of rounding of the first step."""
    first = tested.states[0]
    other = compile_stepper(tested.system, tested.method, flags=tested.stepper.flags)
    states = [(first.q, first.p)] * 2
    worst = 0.0
    for n in range(SHORT_RUN):  # single steps, which take kinks as formulas
        t = first.t + n * first.h
        pairs = zip((tested.stepper, other), states, strict=True)
        states = [stepper.step(*state, first.h, t, tested.parameters) for stepper, state in pairs]
        difference = np.subtract(*map(np.concatenate, states))
        worst = max(worst, float((np.abs(difference) / tested.rounding(first)).max()))
    return Finding(worst, ROUNDINGS * SHORT_RUN, "in units of rounding of a step")


Numbers = NDArray[np.float64]

CUT_SIZES = ((5, 6), (4, 4), (3, 3), (3, 2), (2, 2), (2, 1), (6, 6), (8, 8), (12, 12), (16, 16))
"""Numbers of indices of a size and of rows of a table; the first pair that is consistent and small is used."""
MAX_COORDINATES = 9
"""Largest number of coordinates; steps in 60 digits take seconds for it."""


def small_start(start: WholeStart) -> WholeStart:
    """Cut out a few indices where the arrays are largest, and table rows with the indices that occur in them.

    Raises:
        StateError: if no small cut is closed under the accesses of the system.
    """
    interface, arrays, result = start.stepper.interface, start.arrays, None
    for window, rows in CUT_SIZES:
        tables = {table.axes[0].name for table in interface.layout.tables}
        indices = {name: np.arange(min(arrays.sizes[name], rows)) for name in tables}
        for name in interface.layout.sizes:
            if name in indices:
                continue
            used = [
                arrays.places[table][indices[row], column]
                for table, row, column, size in _columns(interface)
                if size == name
            ]
            in_tables = np.unique(np.concatenate([*used, np.empty(0, dtype=np.int64)]))
            further = np.setdiff1d(_around(start, name, window), in_tables)
            indices[name] = np.union1d(in_tables, further[: max(0, window - len(in_tables))])
        small = _cut(start, indices)
        try:
            start.stepper.products.check_accesses(small.arrays.sizes, small.arrays.places)
        except StateError:
            continue
        count = sum(values.size for values in small.arrays.state.values())
        if count <= MAX_COORDINATES:
            return small
        result = result or small
    if result is None:
        raise StateError("no small array sizes were found at which all indices are in range")
    return result


def _columns(interface: Interface) -> Iterator[tuple[str, str, int, str]]:
    """Yield table, row size and column of each table access, and the size that its indices refer to."""
    rows = {table.name: table.axes[0].name for table in interface.layout.tables}
    for access, _ in interface.layout.accesses:
        for subscript, axis in zip(access.places, access.array.axes, strict=True):
            if subscript.table and axis.name:
                yield subscript.table, rows[subscript.table], subscript.column, axis.name


def _around(start: WholeStart, size: str, window: int) -> NDArray[np.int64]:
    """Return consecutive indices around the maximum of the first array of that size."""
    length, centre = start.arrays.sizes[size], 0
    for array in start.stepper.interface.layout.coordinates:
        axes = [k for k, axis in enumerate(array.axes) if axis.name == size]
        if axes:
            others = tuple(k for k in range(len(array.axes)) if k != axes[0])
            sizes = np.abs(start.arrays.state[array.name]) + np.abs(start.p[array.name])
            centre = int(np.argmax(sizes.max(axis=others)))
            break
    first = max(0, min(centre - window // 2, length - window))
    return np.arange(first, min(length, first + window))


def _cut(start: WholeStart, indices: Mapping[str, NDArray[np.int64]]) -> WholeStart:
    interface, arrays = start.stepper.interface, start.arrays

    def part(array: Array, values: Numbers) -> Numbers:
        return np.ascontiguousarray(
            values[np.ix_(*(indices[axis.name] if axis.name else np.arange(axis.number) for axis in array.axes))]
        )

    tables = {table.name: arrays.places[table.name][indices[table.axes[0].name]] for table in interface.layout.tables}
    for table, row, column, size in _columns(interface):
        old = arrays.places[table][indices[row], column]
        new = np.minimum(np.searchsorted(indices[size], old), len(indices[size]) - 1)
        tables[table][:, column] = np.where(indices[size][new] == old, new, old % len(indices[size]))
    cut = replace(
        arrays,
        sizes={name: len(indices[name]) for name in interface.layout.sizes},
        state={array.name: part(array, arrays.state[array.name]) for array in interface.layout.coordinates},
        fields={array.name: part(array, arrays.fields[array.name]) for array in interface.layout.fields},
        places=tables,
    )
    p = {array.name: part(array, start.p[array.name]) for array in interface.layout.coordinates}
    return replace(start, arrays=cut, p=p)
