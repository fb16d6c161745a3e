"""Contenders of the Runge-Kutta method DOP853 at several tolerances, by SciPy or another solver."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from benchmarks.cases.unforced import Array, Case
from benchmarks.report import Contender

TIGHT = (3e-14, 1e-13, 1e-12, 1e-11, 1e-9, 1e-7)
LOOSE = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
"""Relative tolerances."""


def start_of(case: Case, index: int) -> Array:
    """Return an initial state (q, v) as one array."""
    return np.concatenate([part[index] for part in case.states])


def absolute_tolerance(tolerance: float, start: Array) -> float:
    """Return the absolute tolerance: a tenth of the relative one times the smaller typical size of q and v."""
    sizes = [float(np.sqrt(np.mean(half**2))) for half in np.array_split(start, 2)]
    return 0.1 * tolerance * min(size for size in sizes if size > 0.0)


def by_tolerance(
    method: str,
    options: str,
    seconds: float,
    case: Case,
    quick: bool,
    solve: Callable[[Array, float], Array],
    tolerances: Sequence[float] = TIGHT,
) -> Iterator[Contender]:
    """Yield one contender per tolerance; ``solve`` maps (state, relative tolerance) to the final state."""

    def prepare(tolerance: float, index: int) -> Callable[[], Array]:
        start = start_of(case, index)
        return lambda: solve(start, tolerance)[: case.dimension]

    for tolerance in tolerances[: 2 if quick else None]:
        setting, starts = f"rtol={tolerance:.0e}", len(case.q)
        yield Contender(method, setting, options, seconds, partial(prepare, tolerance), starts=starts)


def dop853(
    options: str,
    seconds: float,
    case: Case,
    quick: bool,
    rates: Callable[[float, Array], Array],
    tolerances: Sequence[float] = TIGHT,
    method: str = "SciPy DOP853",
) -> Iterator[Contender]:
    """Yield SciPy's DOP853 with a right-hand side."""
    from scipy.integrate import solve_ivp

    def solve(start: Array, tolerance: float) -> Array:
        how = {"rtol": tolerance, "atol": absolute_tolerance(tolerance, start), "t_eval": [case.span]}
        outcome = solve_ivp(rates, (0.0, case.span), start, method="DOP853", **how)
        if not outcome.success:
            raise ArithmeticError(f"solve_ivp: {outcome.message}")
        final: Array = outcome.y[:, -1]
        return final

    yield from by_tolerance(method, options, seconds, case, quick, solve, tolerances)
