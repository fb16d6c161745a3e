"""Contender: one integrator at one setting, ready to be timed.

Steppers of this package at the step sizes that :func:`scvi_codegen.advise` recommends for a list of tolerances.
"""

import itertools
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from contextvars import Context
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from benchmarks.cases.unforced import Array, Case
from benchmarks.report import OURS, Contender
from benchmarks.settings import set_variable
from scvi_codegen.codegen.native import building
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.advice.advice import advise
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.states.rotations import members_of
from scvi_codegen.runs.stepper import Stepper

TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-8, 1e-9, 1e-10, 3e-11, 1e-11, 3e-12, 1e-12, 5e-13, 3e-13, 2e-13, 1e-13)
"""Tolerances for which a step size is recommended; the errors reached are measured."""

QUICK_TOLERANCES = (1e-8, 1e-10, 1e-12)
ADAPTIVE_TOLERANCES = (None, 1e-15, 1e-14, 1e-13, 1e-12, 1e-10, 1e-8)
LOOSE_TOLERANCES = (*ADAPTIVE_TOLERANCES, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
DEGREES = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12)
"""Degrees whose work-precision curves are compared."""
END_ALONE = 2**30
"""``save_every`` of runs that return their initial and final states alone."""
FIXED = tuple(2.0 ** (k / 2) for k in range(-2, 9))
"""Fixed steps, as multiples of the number of adaptive steps."""
LARGEST_NEWTON = 18
"""Largest number of degrees of freedom for which Newton's method is used; beyond, its larger steps take seconds
each."""

_builds = itertools.count()


def label_of(method: str | Method) -> str:
    """Return a method as records and users write it: ``svi:8``."""
    if isinstance(method, str):
        return method
    return f"svi:{method.degree}" if isinstance(method, SVI) and method == SVI(method.degree) else method.name


def our_contenders(case: Case, *, methods: Iterable[Method] = (), quick: bool = False) -> list[Contender]:
    """Return contenders for every method at every recommended step size.

    Args:
        case: case to integrate.
        methods: by default SVI(8).
        quick: use few tolerances.
    """
    result = []
    for method in methods or (SVI(8),):
        stepper, seconds = compiled(case.system, method)
        momenta = momenta_of(stepper, case)
        options = f"{stepper.title}, solver auto, {' '.join(stepper.flags)}"
        for count, setting in _settings(case, method, np.hstack([case.q[:1], momenta[:1]]), quick).items():
            prepare = partial(_fixed, stepper, case, momenta, count)
            result.append(Contender(f"{OURS} {label_of(method)}", setting, options, seconds, prepare, momenta))
    return result


def fixed_contenders(case: Case, counts: Mapping[str | Method, Iterable[int]]) -> list[Contender]:
    """Return contenders by several methods with numbers of steps."""
    result = []
    for method, numbers in counts.items():
        stepper, seconds = compiled(case.system, method)
        momenta = momenta_of(stepper, case) if case.arrays is None and not case.system.constraints else None
        for steps in numbers:
            prepare, name = partial(_fixed, stepper, case, momenta, steps), label_of(method)
            setting, starts = f"h={case.span / steps:.4g}", len(case.q)
            result.append(Contender(f"{OURS} {name}", setting, "", seconds, prepare, momenta, starts=starts))
    return result


def _fixed(stepper: Any, case: Case, momenta: Array | None, steps: int, index: int) -> Callable[[], Array]:
    shape = (-1,) if case.arrays is None else case.arrays.shape
    q, velocity = (part[index].reshape(shape) for part in case.states)
    how = {"velocity": velocity} if momenta is None else {"p": momenta[index]}
    run = stepper.start(q, **how, h=case.span / steps)

    def integrate() -> Array:
        run.advance(steps)
        return np.array(run.q, dtype=float).ravel()

    return integrate


def run_contenders(case: Case, counts: Mapping[str | Method, Iterable[int]]) -> list[Contender]:
    """Return contenders that advance one run for each state of a case in turn, started beforehand."""

    def prepare(contender: Contender, _: int) -> Callable[[], Array]:
        integrations = [contender.prepare(k) for k in range(len(case.q))]
        return lambda: np.array([integrate() for integrate in integrations])

    made = fixed_contenders(case, counts)
    return [
        replace(each, method=f"{OURS} runs", prepare=partial(prepare, each), starts=1, trajectories=len(case.q))
        for each in made
    ]


def our_ensembles(
    case: Case, *, quick: bool = False, counts: Mapping[str | Method, Iterable[int]] | None = None
) -> list[Contender]:
    """Return contenders with all states of the case as one ensemble, in one thread.

    ``counts``: numbers of steps by method; by default those of SVI(8) that suffice for every state.
    """
    result = []
    for method in counts or (SVI(8),):
        stepper, seconds = compiled(case.system, method)
        momenta = momenta_of(stepper, case)
        began = time.perf_counter()
        stepper.integrate_ensemble(case.q, momenta, h=case.step, steps=1, threads=1)  # compiled on first use
        seconds += time.perf_counter() - began
        options, size = f"{stepper.title}, one thread", len(case.q)
        if counts is None:
            settings = _settings(case, SVI(8), np.unique(np.hstack([case.q, momenta]), axis=0), quick)
        else:
            settings = {count: f"h={case.span / count:.4g}" for count in counts[method]}
        for count, setting in settings.items():
            prepare = partial(_prepared_ensemble, stepper, case, momenta, count)
            name = f"{OURS} ensemble" if counts is None else f"{OURS} ensemble {getattr(method, 'name', method)}"
            result.append(Contender(name, setting, options, seconds, prepare, momenta, size))
    return result


def _settings(case: Case, method: Method, states: Array, quick: bool) -> dict[int, str]:
    """Return the step sizes recommended for all (k, 2m) states by number of steps, as text."""
    counts = advised_counts(case, method, states, quick=quick)
    return {count: f"h={case.span / count:.4g} for {tolerance:.0e}" for count, tolerance in counts.items()}


def advised_counts(case: Case, method: Method, states: Array, *, quick: bool) -> dict[int, float]:
    """Return numbers of steps that fill the span -> the tolerance for which each suffices, from each of the states."""
    counts: dict[int, float] = {}
    solver = "auto" if case.dimension <= LARGEST_NEWTON or case.system.constraints else "fixed-point"
    q, p = (part[0] if len(states) == 1 else part for part in np.split(states, 2, axis=1))
    for tolerance in QUICK_TOLERANCES if quick else TOLERANCES:
        try:
            steps = advise(case.system, method, q, p, case.span, tolerance, solver=solver).steps
        except StateError:  # no step size is known to be small enough
            continue
        counts.setdefault(steps, tolerance)
    return counts


def compiled(system: Any, method: str | Method, solver: str = "auto") -> tuple[Any, float]:
    """Return the stepper, and the seconds to compile it with an empty cache and a new name."""
    with (
        tempfile.TemporaryDirectory(prefix="scvi-codegen-bench-") as folder,
        set_variable(building.CACHE_VARIABLE, folder),
    ):
        began = time.perf_counter()
        stepper = compile_stepper(system, method, solver=solver, prefix=f"bench_{next(_builds)}")
        return stepper, time.perf_counter() - began


def momenta_of(stepper: Stepper, case: Case) -> Array:
    """Return (k, m) initial momenta, of rotations those of their quaternions."""
    members = members_of(stepper.dimension, stepper.interface.rotations)
    ordinary = stepper.dimension - 4 * len(members)
    q, velocity = ({name: part[:, k] for k, name in enumerate(stepper.coordinates[:ordinary])} for part in case.states)
    for k, member in enumerate(members):
        q[member.name] = case.q[:, member.columns]
        velocity[member.rate] = case.velocity[:, ordinary + 3 * k : ordinary + 3 * k + 3]
    positions, _, velocities = stepper._states.start(q, None, velocity)
    return stepper.momentum(positions, velocities) if members else stepper.momentum(*case.states)


def _prepared_ensemble(stepper: Stepper, case: Case, momenta: Array, count: int, _: int) -> Callable[[], Array]:
    arguments: dict[str, Any] = {"h": case.span / count, "steps": count, "save_every": count, "threads": 1}
    return lambda: cast("Array", stepper.integrate_ensemble(case.q, momenta, **arguments).q[-1])


def adaptive_contenders(case: Case, *, quick: bool) -> list[Contender]:
    """Return contenders by SVI(8) with adaptive step size at several tolerances, and with fixed steps beside them."""
    stepper, seconds = compiled(case.system, SVI(8))
    momenta = momenta_of(stepper, case)
    adaptive = stepper.integrate(case.q[0], momenta[0], t_end=case.span, check_growth=False).steps
    counts = [max(1, round(adaptive * factor)) for factor in FIXED[: 1 if quick else None]]
    tolerances = ADAPTIVE_TOLERANCES[: 2 if quick else None]
    controlled = controlled_contenders(case, stepper, seconds, tolerances)
    checked = controlled_contenders(case, stepper, seconds, tolerances, check_growth=True)
    fixed = (replace(each, method=f"{OURS} fixed") for each in fixed_contenders(case, {SVI(8): counts}))
    return [*checked, *controlled, *fixed]


def degree_contenders(case: Case, *, quick: bool) -> list[Contender]:
    """Return contenders by SVI of all degrees with adaptive step size, at tolerances from 1e-2 to round-off."""
    tolerances, made = LOOSE_TOLERANCES[:: 4 if quick else 1], []
    for degree in DEGREES[:: 6 if quick else 1]:
        stepper, seconds = compiled(case.system, SVI(degree))
        curve = controlled_contenders(case, stepper, seconds, tolerances)
        made += [replace(each, method=f"{OURS} svi:{degree}") for each in curve]
    return made


def controlled_contenders(
    case: Case, stepper: Stepper, seconds: float, tolerances: Iterable[float | None], *, check_growth: bool = False
) -> list[Contender]:
    """Return contenders with adaptive step size at several tolerances, which return the final state alone.

    With ``check_growth`` they are calls of ``integrate`` with its default check, otherwise runs started beforehand, as
    heyoka's ``propagate_until``.
    """
    momenta = momenta_of(stepper, case)

    def prepare_checked(tolerance: float | None, index: int) -> Callable[[], Array]:
        how: dict[str, Any] = {"t_end": case.span, "tolerance": tolerance, "save_every": END_ALONE}
        run = partial(stepper.integrate, case.q[index], momenta[index], **how)
        return lambda: Context().run(run).q[-1]  # outside without_accuracy_warnings, which disables the check

    def prepare(tolerance: float | None, index: int) -> Callable[[], Array]:
        run = stepper.start(case.q[index], momenta[index], t_end=case.span, tolerance=tolerance)

        def integrate() -> Array:
            run._run_to_target()
            end: Array = run.q
            return end

        return integrate

    return [
        Contender(
            method=f"{OURS} adaptive, checked" if check_growth else f"{OURS} adaptive",
            setting=f"tol={tolerance:.0e}" if tolerance else "tol=default",
            options=f"{stepper.title}, {' '.join(stepper.flags)}",
            compile_seconds=seconds,
            prepare=partial(prepare_checked if check_growth else prepare, tolerance),
            momenta=momenta,
            starts=len(case.q),
        )
        for tolerance in tolerances
    ]
