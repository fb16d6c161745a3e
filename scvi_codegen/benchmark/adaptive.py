"""Benchmark of adaptive step size on problems with close encounters; heyoka and IAS15 at equal error.

References: Kepler's equation in 40 digits for the Kepler problem; for others the Gauss method of 16 stages in extended
precision, on the adaptive steps of this package (which a method of twice the order resolves by far) and on halves of
them; the difference is their accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from mpmath import mp

from scvi_codegen.benchmark.cases.adaptive import adaptive_case
from scvi_codegen.benchmark.cases.references import (
    Extended,
    Field,
    Reference,
    field_of,
    remembered,
    rms,
    states_after,
    two_doubles,
)
from scvi_codegen.benchmark.cases.unforced import Array, Case
from scvi_codegen.benchmark.comparison import Makers, race
from scvi_codegen.benchmark.contenders.ours import compiled, momenta_of
from scvi_codegen.benchmark.contenders.peers import peer_contenders
from scvi_codegen.benchmark.report import OURS, CaseResult, Contender
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StateError
from scvi_codegen.mechanics.time_transformation import reparametrise
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

TOLERANCES = (None, 1e-15, 1e-14, 1e-13, 1e-12, 1e-10, 1e-8)
PEERS = ("heyoka", "rebound")
FIXED = tuple(2.0 ** (k / 2) for k in range(-2, 9))
"""Fixed steps, as multiples of the number of adaptive steps."""
TRANSFORMED = (0.4, 0.3, 0.2, 0.15, 0.1)
"""Step sizes of tau for dt = g dtau with the time-rescaling function "frequency"."""
LAST = 10**15
HALVINGS = 2
"""Largest number of halvings of a reference's steps, if a step of a close encounter is too large for Gauss."""


@without_accuracy_warnings()
def run_adaptive(name: str, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Measure this package in all its modes, heyoka, and for gravitating bodies IAS15."""
    chosen = adaptive_case(name)
    makers: Makers = {peer: partial(peer_contenders, peer, chosen, quick=True) for peer in PEERS if peer in plan.peers}
    return race(chosen, partial(_ours, chosen, quick=plan.quick), makers, plan, report_activity, adaptive_reference)


def _ours(chosen: Case, *, quick: bool) -> list[Contender]:
    stepper, seconds = compiled(chosen, SVI(8))
    momenta, span = momenta_of(stepper, chosen), chosen.span
    adaptive = stepper.integrate(chosen.q[0], momenta[0], t_end=span, check_growth=False).steps
    counts = [max(1, round(adaptive * factor)) for factor in FIXED[: 1 if quick else None]]
    settings: list[tuple[str, str, Stepper, Callable[..., Callable[[], Array]], dict[str, Any]]] = [
        ("controlled", f"tol={each:.0e}" if each else "tol=default", stepper, _to_its_end, {"tolerance": each})
        for each in TOLERANCES[: 2 if quick else None]
    ]
    settings += [("fixed", f"{n} steps", stepper, _by_so_many, {"steps": n}) for n in counts]
    if "kepler" in chosen.name and not quick:
        transformed = compile_stepper(reparametrise(chosen.system, "frequency"), SVI(8))
        settings += [("transformed", f"h={h:g}", transformed, _transformed, {"h": h}) for h in TRANSFORMED]

    def prepare(used: Stepper, start: Callable[..., Callable[[], Array]], how: dict[str, Any], k: int) -> Any:
        return start(used, chosen.q[k], momenta[k], span, **how)

    return [
        Contender(
            method=f"{OURS} {mode}",
            setting=setting,
            options=f"{used.title}, {' '.join(used.flags)}",
            compile_seconds=seconds,
            prepare=partial(prepare, used, start, how),
            momenta=momenta,
        )
        for mode, setting, used, start, how in settings
    ]


def _to_its_end(stepper: Stepper, q: Array, p: Array, t_end: float, tolerance: float | None) -> Callable[[], Array]:
    run = stepper.start(q, p, t_end=t_end, tolerance=tolerance)

    def integrate() -> Array:
        """Integrate and return the final state alone, as heyoka's propagate_until."""
        run._run_to_target()
        return run.q

    return integrate


def _by_so_many(stepper: Stepper, q: Array, p: Array, t_end: float, steps: int) -> Callable[[], Array]:
    run = stepper.start(q, p, h=t_end / steps)

    def integrate() -> Array:
        run.advance(steps)
        return run.q

    return integrate


def _transformed(stepper: Stepper, q: Array, p: Array, t_end: float, h: float) -> Callable[[], Array]:
    return lambda: stepper.integrate(q, p, h=h, t_end=t_end, save_every=LAST, check_growth=False).q[-1]


def adaptive_reference(chosen: Case, momenta: Array | None = None) -> Reference:
    """Return the final states of a case: exact, or in extended precision (minutes, then cached on disk)."""
    velocity = chosen.velocity.astype(np.longdouble)
    if momenta is not None and chosen.masses is not None:
        velocity = momenta.astype(np.longdouble) / np.array(chosen.masses, dtype=np.longdouble)
    return remembered(chosen, velocity, kepler_ends if "kepler" in chosen.name else _ends)


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
