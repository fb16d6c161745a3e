"""Reference solutions by the Gauss method of 16 stages in extended precision.

NumPy's ``longdouble`` has 80 bits on x86 and 128 on 64-bit Arm under Linux. The computation is independent of the
package's steppers: right-hand sides are the hand-derived ones of :mod:`.unforced`, tables come from mpmath. Each
reference is computed with two step sizes, and their difference is stored as its accuracy.

With close encounters the steps are the adaptive ones of this package, which a method of twice the order resolves by
far, and halves of them.
"""

import contextlib
import hashlib
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from mpmath import mp, polyroots, taylor
from numpy.typing import NDArray

from benchmarks.cases.unforced import Array, Case
from benchmarks.contenders.tracing import rates_text
from scvi_codegen.codegen.native import building
from scvi_codegen.common.atomic import write_atomically
from scvi_codegen.common.errors import StateError
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.runs.compiler import compile_stepper

Extended = NDArray[np.longdouble]
Field = Callable[[Extended, Extended], Extended]
"""Function that returns x' for x, (.., d), at times t, (..)."""

STAGES = 16
MAX_ITERATIONS = 100
STAGNATED, ROUNDED = 1e-16, 1e-14
"""Relative changes below which the iteration has converged: once they hardly shrink, or, near collisions, grow."""

HALVINGS = 2
"""Largest number of halvings of a reference's steps, if a step of a close encounter is too large for Gauss."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """Final positions.

    Attributes:
        positions: (k, m) positions, in extended precision where they were computed so.
        accuracy: relative difference of two computations with different step sizes.
    """

    positions: NDArray[Any]
    accuracy: float


def rms_error(q: Array, reference: Reference) -> float:
    """Return the root mean square over the states of |q - reference|, relative to |reference|; (k, m) positions."""
    return rms(q - reference.positions) / rms(reference.positions)


def rms(positions: NDArray[Any]) -> float:
    """Return the root of the mean over states of |position|^2; (k, m) positions."""
    return float(np.sqrt(np.mean(np.sum(np.square(positions), axis=1))))


def reference(case: Case, momenta: Array | None = None) -> Reference:
    """Return the reference of a case, from the user's cache folder or computed now (seconds to minutes).

    Args:
        case: case to compute.
        momenta: (k, m) doubles to start from instead of the case's velocities, for steppers whose state is (q, p);
            relevant only if momenta are rounded velocities.
    """
    velocity = case.velocity.astype(np.longdouble)
    if momenta is not None and case.velocity_of is not None:
        velocity = case.velocity_of(momenta.astype(np.longdouble))
    path = building.cache_folder() / "references" / f"{_key(case, velocity)}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError), np.load(path) as file:
        return Reference(positions=file["positions"], accuracy=float(file["accuracy"]))
    made = _compute(case, velocity)
    with contextlib.suppress(OSError):  # work without a cache
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda file: np.savez(file, positions=made.positions, accuracy=np.array(made.accuracy)))
    return made


def _key(case: Case, velocity: Extended) -> str:
    """Return a hash of everything that the result depends on."""
    digest = hashlib.sha256(inspect.getsource(inspect.getmodule(_key)).encode())  # type: ignore[arg-type]
    digest.update(rates_text(case.formulations[0].rates, case.parameters, case.size).encode())
    settings = case.span, case.fine, np.finfo(np.longdouble).machep
    digest.update(repr((case.q.tolist(), velocity.tolist(), *settings)).encode())
    return digest.hexdigest()[:24]


def _compute(case: Case, velocity: Extended) -> Reference:
    if np.finfo(np.longdouble).eps > 1e-18:
        raise StateError(
            "references need a long double with at least 64 bits of precision, which NumPy lacks on this machine"
        )
    start, field = np.concatenate([case.q.astype(np.longdouble), velocity], axis=1), field_of(case)
    steps = _shortest(_adaptive_times(case, velocity)) if case.fine is None else equal_steps(case.span, case.fine)
    rough, fine = (ends[:, : case.dimension] for ends in _with_two_steps(field, start, steps))
    return Reference(positions=fine, accuracy=rms(rough - fine) / rms(fine))


def equal_steps(span: float, h: float) -> Extended:
    """Return steps of h, and a smaller last one, that fill a span."""
    whole = int(span // h)
    return np.array([h] * whole + ([span - whole * h] if span > whole * h else []), dtype=np.longdouble)


def states_after(field: Field, start: Extended, steps: Extended) -> Extended:
    """Return (k, d) states after these steps."""
    a, b, guess_table = gauss_tables(STAGES)
    x, before, t = start, None, np.longdouble(0)
    stages: Extended | None = None
    for h in steps:
        guess = None if stages is None or h != before else np.tensordot(guess_table, stages, 1)
        stages = _stages(field, (t + h * a.sum(axis=1))[:, np.newaxis], x, h * a, guess)
        x, t, before = x + h * np.tensordot(b, stages, 1), t + h, h
    return x


def field_of(case: Case) -> Field:
    """Return the hand-derived equations in extended precision."""
    parameters = {name: np.longdouble(value) for name, value in case.parameters.items()}

    def field(x: Extended, t: Extended) -> Extended:
        functions = SimpleNamespace(sin=np.sin, cos=np.cos, sqrt=np.sqrt, time=t)
        rates = case.formulations[0].rates(list(np.moveaxis(x, -1, 0)), parameters, functions)
        return np.stack(np.broadcast_arrays(*rates), axis=-1)

    return field


def _stages(field: Field, times: Extended, x: Extended, a: Extended, guess: Extended | None) -> Extended:
    """Return (s, k, d) derivatives F_n = field(x + sum_j a_nj F_j), by fixed-point iteration to round-off."""
    derivatives = field(np.broadcast_to(x, (len(a), *x.shape)), times) if guess is None else guess
    scale, last = np.abs(a).sum(axis=1).max() / np.max(np.abs(x)), np.inf
    for _ in range(MAX_ITERATIONS):
        new = field(x + np.tensordot(a, derivatives, 1), times)
        change = float(scale * np.max(np.abs(new - derivatives)))
        derivatives = new
        if change == 0.0 or (change < STAGNATED and change >= 0.3 * last) or (change < ROUNDED and change >= last):
            return derivatives
        last = change
    raise StateError(f"the reference did not converge (last change {change:.1e})")


def gauss_tables(stages: int) -> tuple[Extended, Extended, Extended]:
    """Return Gauss's A and b, and the table that extrapolates the stages by one step."""
    with mp.workdps(50):
        legendre = list(reversed(taylor(lambda x: mp.legendre(stages, 2 * x - 1), 0, stages)))
        c = sorted(polyroots(legendre, maxsteps=500, extraprec=400), key=lambda root: root.real)
        inverse = mp.matrix([[x**k for k in range(stages)] for x in c]) ** -1
        integrals = [[x ** (k + 1) / (k + 1) for k in range(stages)] for x in [*c, mp.one]]
        ahead = [[(1 + x) ** k for k in range(stages)] for x in c]
        products = [(mp.matrix(rows) * inverse).apply(mp.re).tolist() for rows in (integrals, ahead)]
        both, guess = (np.array([[np.longdouble(mp.nstr(x, 40)) for x in row] for row in each]) for each in products)
    return both[:stages], both[stages], guess


def _adaptive_times(case: Case, velocity: Extended) -> list[Array]:
    """Return the times of this package's adaptive steps from every state."""
    stepper, pairs = compile_stepper(case.system, SVI(8)), zip(case.q, velocity.astype(float), strict=True)
    return [stepper.integrate(q, velocity=v, t_end=case.span, check_growth=False).t for q, v in pairs]


def _shortest(runs: Sequence[Array]) -> Extended:
    """Return common steps for all runs from the times of each: the smallest that any of them takes at that time."""
    times, end = [float(runs[0][0])], float(runs[0][-1])
    while times[-1] < end:
        indices = [np.searchsorted(run[1:-1], times[-1], side="right") for run in runs]
        times.append(min(end, times[-1] + min(run[k + 1] - run[k] for run, k in zip(runs, indices, strict=True))))
    return np.diff(np.array(times, dtype=np.longdouble))


def _with_two_steps(field: Field, start: Extended, steps: Extended) -> tuple[Extended, Extended]:
    """Return the final states with these steps and with halves of them, or with smaller ones if Gauss fails."""
    for parts in 2 ** np.arange(HALVINGS + 1):
        short = np.repeat(steps / parts, parts)
        try:
            return states_after(field, start, short), states_after(field, start, np.repeat(short / 2, 2))
        except StateError as error:
            failure = error
    raise failure
