"""Reference solutions to 18 digits: Gauss method of 16 stages in extended precision, fixed step, compensated sums.

NumPy's ``longdouble`` has 80 bits on x86 and 128 on 64-bit Arm under Linux. The computation is independent of the
package's steppers: right-hand sides are the hand-derived ones of :mod:`.unforced`, tables come from mpmath. Tables are
sums of two numbers and steps are short binary fractions, so that neither causes a systematic error. Each reference is
computed with two step sizes, and their difference is stored as its accuracy.

With close encounters the steps are the adaptive ones of this package, which a method of twice the order resolves by
far, and halves of them; Kepler's problem is solved by Kepler's equation in 40 digits.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mpmath import mp, polyroots, taylor
from numpy.typing import NDArray

from scvi_codegen.benchmark.cases.unforced import Array, Case
from scvi_codegen.benchmark.contenders.tracing import rates_text
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StateError
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.native import building

Extended = NDArray[np.longdouble]
Field = Callable[[Extended, Extended], Extended]
"""Function that returns x' for x, (.., d), at times t, (..)."""

STAGES = 16
MAX_ITERATIONS = 100
STAGNATED, ROUNDED = 1e-16, 1e-14
"""Relative changes below which the iteration has converged: once they hardly shrink, or, near collisions, grow."""

DIGITS = 50
HALVINGS = 2
"""Largest number of halvings of a reference's steps, if a step of a close encounter is too large for Gauss."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """Final positions.

    Attributes:
        high, low: (k, m) positions as sums of two doubles.
        accuracy: relative difference of two computations with different step sizes.
    """

    high: Array
    low: Array
    accuracy: float


def rms_error(q: Array, reference: Reference) -> float:
    """Return the root mean square over the states of |q - reference|, relative to |reference|; (k, m) positions."""
    return rms((q - reference.high) - reference.low) / rms(reference.high)


def rms(positions: NDArray[Any]) -> float:
    """Return the root of the mean over states of |position|^2; (k, m) positions."""
    return float(np.sqrt(np.mean(np.sum(np.square(positions), axis=1))))


def reference(case: Case, momenta: Array | None = None) -> Reference:
    """Return the reference of a case, from the user's cache folder or computed now (seconds to a minute).

    Args:
        case: case to compute.
        momenta: (k, m) doubles to start from instead of the case's velocities, for steppers whose state is (q, p);
            relevant only if momenta are rounded velocities.
    """
    return remembered(case, _velocity(case, momenta), _compute)


def _velocity(case: Case, momenta: Array | None) -> Extended:
    if momenta is None or case.velocity_of is None:
        return case.velocity.astype(np.longdouble)
    velocity: Extended = case.velocity_of(momenta.astype(np.longdouble))
    return velocity


def remembered(case: Case, velocity: Extended, compute: Callable[[Case, Extended], Reference]) -> Reference:
    """Return a result for a case and (k, m) velocities, from the user's cache folder if it is there."""
    path = building.cache_folder() / "references" / f"{_key(case, velocity, compute.__qualname__)}.npz"
    states = _read(path)
    if states is None:
        states = compute(case, velocity)
        _write(path, states)
    return states


def _key(case: Case, velocity: Extended, kind: str) -> str:
    """Return a hash of everything that the result depends on."""
    digest = hashlib.sha256(inspect.getsource(inspect.getmodule(_key)).encode())  # type: ignore[arg-type]
    digest.update(rates_text(case.formulations[0].rates, case.parameters, case.size).encode())
    for array in (case.q, *two_doubles(velocity)):
        digest.update(array.tobytes())
    digest.update(repr((kind, case.span, case.fine, np.finfo(np.longdouble).machep)).encode())
    return digest.hexdigest()[:24]


def _read(path: Path) -> Reference | None:
    try:
        with np.load(path) as file:
            return Reference(high=file["high"], low=file["low"], accuracy=float(file["accuracy"]))
    except (OSError, ValueError, KeyError):
        return None


def _write(path: Path, result: Reference) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(
            path, lambda file: np.savez(file, high=result.high, low=result.low, accuracy=np.array(result.accuracy))
        )
    except OSError:
        return  # work without a cache


def _compute(case: Case, velocity: Extended) -> Reference:
    if np.finfo(np.longdouble).eps > 1e-18:
        raise StateError(
            "references need a long double with at least 64 bits of precision, which NumPy lacks on this machine"
        )
    start, field = np.concatenate([case.q.astype(np.longdouble), velocity], axis=1), field_of(case)
    fine, finer = (final_states(field, start, case.span, case.fine * factor) for factor in (1.0, 0.75))
    m = case.dimension
    high, low = two_doubles(finer[:, :m])
    accuracy = rms((fine - finer)[:, :m]) / rms(high)
    return Reference(high=high, low=low, accuracy=accuracy)


def two_doubles(x: Extended) -> tuple[Array, Array]:
    """Return extended numbers as sums of two doubles."""
    high = x.astype(np.float64)
    return high, (x - high).astype(np.float64)


def final_states(field: Field, start: Extended, span: float, h: float) -> Extended:
    """Return (k, d) states after ``span``, with steps of h, a short binary fraction, and a smaller last one.

    Args:
        field: x' for x of shape (..., d) and t.
        start: (k, d) initial states.
        span: duration.
        h: step size.
    """
    whole = int(span // h)
    return states_after(field, start, [h] * whole + ([span - whole * h] if span > whole * h else []))


def states_after(field: Field, start: Extended, steps: Sequence[float] | Extended) -> Extended:
    """Return (k, d) states after these steps."""
    a, b, guess_table = gauss_tables(STAGES)
    # Compensated summation (Kahan): ``compensation`` is the part of x that rounding cut off.
    x, compensation, before, t = start.copy(), np.zeros_like(start), None, np.longdouble(0)
    stages: Extended | None = None
    for size in steps:
        guess = None if stages is None or size != before else _product(guess_table, stages)
        before, h = size, np.longdouble(size)
        stages = _stages(partial(_at, field, t + h * a[0].sum(axis=1)), x + compensation, h, a, guess)
        change = compensation + h * _product(b, stages)[0]
        new = x + change
        compensation = change - (new - x)
        x, t = new, t + h
    return x + compensation


def _at(field: Field, times: Extended, x: Extended) -> Extended:
    """Return the field of (s, k, d) states at (s,) times."""
    return field(x, times[:, np.newaxis])


def field_of(case: Case) -> Field:
    """Return the hand-derived equations in extended precision."""
    parameters = {name: np.longdouble(value) for name, value in case.parameters.items()}

    def field(x: Extended, t: Extended) -> Extended:
        functions = SimpleNamespace(sin=np.sin, cos=np.cos, sqrt=np.sqrt, time=t)
        rates = case.formulations[0].rates(list(np.moveaxis(x, -1, 0)), parameters, functions)
        return np.stack(np.broadcast_arrays(*rates), axis=-1)

    return field


Table = tuple[Extended, Extended]


def _product(table: tuple[Extended, ...], values: Extended) -> Extended:
    """Return the product of a (rows, s) table, a sum of parts, with (s, k, d) values."""
    flat = values.reshape(values.shape[0], -1)
    result: Extended = sum(part @ flat for part in table[1:]) + table[0] @ flat
    return result.reshape(-1, *values.shape[1:])


def _stages(
    field: Callable[[Extended], Extended], x: Extended, h: np.longdouble, a: Table, guess: Extended | None
) -> Extended:
    """Return (s, k, d) derivatives F_n = field(x + h sum_j a_nj F_j), by fixed-point iteration to round-off."""
    derivatives = field(np.broadcast_to(x, (len(a[0]), *x.shape))) if guess is None else guess
    low = _product((a[1],), derivatives)  # small: not updated in the iteration
    scale, last = h / np.max(np.abs(x)), np.inf
    for _ in range(MAX_ITERATIONS):
        new = field(x + h * (_product((a[0],), derivatives) + low))
        change = float(scale * np.max(np.abs(new - derivatives)))
        derivatives = new
        if change == 0.0 or (change < STAGNATED and change >= 0.3 * last) or (change < ROUNDED and change >= last):
            return derivatives
        last = change
    raise StateError(f"the reference did not converge with steps of {float(h):g} (last change {change:.1e})")


def gauss_tables(stages: int) -> tuple[Table, Table, Table]:
    """Return Gauss's A and b, and the table that extrapolates the stages by one step, as sums of two numbers."""
    with mp.workdps(DIGITS):
        legendre = list(reversed(taylor(lambda x: mp.legendre(stages, 2 * x - 1), 0, stages)))
        c = sorted(polyroots(legendre, maxsteps=500, extraprec=400), key=lambda root: root.real)
        powers = mp.matrix([[x**k for k in range(stages)] for x in c])
        inverse = powers**-1
        integrals = mp.matrix([[x ** (k + 1) / (k + 1) for k in range(stages)] for x in [*c, mp.one]])
        ahead = mp.matrix([[(1 + x) ** k for k in range(stages)] for x in c])
        both, guess = integrals * inverse, ahead * inverse
        return _table(both[:stages, :]), _table(both[stages:, :]), _table(guess)


def _table(matrix: Any) -> Table:
    rows = [[mp.nstr(entry.real, 40) for entry in matrix[n, :]] for n in range(matrix.rows)]
    high = np.array([[np.longdouble(entry) for entry in row] for row in rows])
    low = np.array(
        [
            [np.longdouble(mp.nstr(mp.mpf(entry) - _exact(rounded), 25)) for entry, rounded in zip(*pair, strict=True)]
            for pair in zip(rows, high, strict=True)
        ]
    )
    return high, low


def _exact(x: np.longdouble) -> Any:
    """Return an extended number exactly, as a sum of doubles in mpmath."""
    high = float(x)
    middle = float(x - np.longdouble(high))
    return mp.mpf(high) + mp.mpf(middle) + mp.mpf(float(x - np.longdouble(high) - np.longdouble(middle)))


def adaptive_reference(chosen: Case, momenta: Array | None = None) -> Reference:
    """Return the final states of a case: exact, or in extended precision (minutes, then cached on disk)."""
    return remembered(chosen, _velocity(chosen, momenta), kepler_ends if "kepler" in chosen.name else _ends)


def kepler_ends(chosen: Case, velocity: Extended) -> Reference:
    """Return exact final states from Kepler's equation and Lagrange coefficients in 40 digits."""
    ends = [_kepler_end(q, v, chosen.span) for q, v in zip(chosen.q, velocity.astype(float), strict=True)]
    high = np.array([[float(x) for x in end] for end in ends])
    low = np.array([[float(x - mp.mpf(float(x))) for x in end] for end in ends])
    return Reference(high=high, low=low, accuracy=1e-30)


def _kepler_end(q: Array, v: Array, t: float) -> tuple[Any, Any]:
    with mp.workdps(40):
        # Lagrange's f and g functions of the change E of the eccentric anomaly.
        (x, y), (u, w) = map(mp.mpf, q.tolist()), map(mp.mpf, v.tolist())
        r = mp.hypot(x, y)
        a = 1 / (2 / r - (u * u + w * w))
        n, cosine, sine = a ** mp.mpf("-1.5"), 1 - r / a, (x * u + y * w) / mp.sqrt(a)
        anomaly = mp.findroot(
            lambda E: E - cosine * mp.sin(E) + sine * (1 - mp.cos(E)) - n * t,
            (n * t - 2, n * t + 2),
            solver="anderson",
            tol=1e-70,
            maxsteps=200,
        )
        f, g = 1 - a / r * (1 - mp.cos(anomaly)), t - (anomaly - mp.sin(anomaly)) / n
        return f * x + g * u, f * y + g * w


def _ends(chosen: Case, velocity: Extended) -> Reference:
    stepper, field, m = compile_stepper(chosen.system, SVI(8)), field_of(chosen), chosen.dimension
    runs = [
        stepper.integrate(q, velocity=v, t_end=chosen.span, check_growth=False).t
        for q, v in zip(chosen.q, velocity.astype(float), strict=True)
    ]
    start = np.concatenate([chosen.q.astype(np.longdouble), velocity], axis=1)
    rough, fine = (ends[:, :m] for ends in _with_two_steps(field, start, _shortest(runs)))
    high, low = two_doubles(fine)
    return Reference(high=high, low=low, accuracy=rms(rough - fine) / rms(high))


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
