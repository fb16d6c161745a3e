"""Contenders of heyoka: adaptive Taylor series, compiled by LLVM.

Every formulation (hand-derived accelerations, ``heyoka.lagrangian``, Hamilton's equations where they are shorter,
``heyoka.model.nbody``) and, for systems that are not small, unrolled as well as compact code is tried; the fastest at
the default tolerance makes the curve. A second curve uses ``fast_math``, which allows what the C compiler's
``-ffast-math`` allows, and a third the Lagrangian alone, which is the input of this package. Powers whose base is 0 at
the start (in a chain's Lagrangian, the elongation of its middle spring) make heyoka fail; such a formulation is left
out.

Ensembles use its batch mode, with as many trajectories at once as it recommends for this processor. Its
``ensemble_propagate`` functions add only threads to that.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.cases.unforced import STATES, Array, Case, Formulation
from benchmarks.report import Contender
from scvi_codegen.systems.derived_expressions import forms_of

TOLERANCES = (0.0, 1e-15, 1e-14, 1e-13, 1e-12, 1e-11, 1e-10, 1e-8)
"""Tolerances; 0 is heyoka's default, 2^-52."""

FEW_TOLERANCES = (0.0, 1e-14, 1e-13, 1e-12)
"""Tolerances for systems that take long to compile, and for quick runs."""

FEWEST_TOLERANCES = (0.0, 1e-12, 1e-10)
"""Tolerances for systems that take very long to compile."""

LOOSE_TOLERANCES = (1e-8, 1e-6, 1e-4, 1e-2)
"""Further tolerances where large errors are of interest."""

TRIALS = 5
LARGEST_SMALL, LARGEST_QUICK, LARGEST_COUPLED, LARGEST_LAGRANGIAN, LARGEST_UNROLLED = 2, 8, 2, 18, 64
"""Limits on degrees of freedom: compact code is never faster; compiles within about a second; Lagrangian with coupled
masses (5 rods take minutes); without; unrolled code compiles within a minute."""


def heyoka_contenders(case: Case, quick: bool, loose: bool = False) -> Iterator[Contender]:
    """Yield the curves ``heyoka``, ``heyoka fast_math`` and ``heyoka.lagrangian``.

    Args:
        case: case to integrate.
        quick: use few tolerances.
        loose: extend the first two curves to large errors.
    """
    variants = list(_variants(case))
    yield from _two_curves(variants, case, quick, LOOSE_TOLERANCES[: 1 if quick else None] if loose else ())
    from_lagrangian = [replace(variant, curve=LAGRANGIAN) for variant in variants if variant.name == LAGRANGIAN]
    yield from _curve(from_lagrangian, case, FEW_TOLERANCES)


def heyoka_at(case: Case, tolerances: Sequence[float]) -> Iterator[Contender]:
    """Yield the curve ``heyoka`` at tolerances, the first of which chooses the formulation."""
    return _curve([variant for variant in _variants(case) if not variant.formulation.momenta], case, tolerances)


def heyoka_ensembles(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield the curves ``heyoka batch`` and ``heyoka batch fast_math``."""
    variants = [replace(variant, curve="heyoka batch") for variant in _variants(case) if not variant.compact]
    return _two_curves(variants, case, quick)


def _two_curves(variants: list[_Taylor], case: Case, quick: bool, further: Sequence[float] = ()) -> Iterator[Contender]:
    """Yield the curves without and with ``fast_math``; ``further``: additional tolerances."""
    tolerances: Sequence[float] = FEW_TOLERANCES if quick or case.dimension > LARGEST_QUICK else TOLERANCES
    tolerances = FEWEST_TOLERANCES if case.dimension > LARGEST_LAGRANGIAN else tolerances
    tolerances = tuple(dict.fromkeys((*tolerances, *further)))
    for fast in (False, True):
        yield from _curve([replace(variant, fast=fast) for variant in variants], case, tolerances)


def heyoka_states(case: Case, times: Array) -> Array:
    """Return (n, 2 m) states (q, v) at times from the first state of a case, at the default tolerance."""
    plain = next(variant for variant in _variants(case) if not variant.formulation.momenta)
    integrator, _ = plain.integrator(0.0)
    integrator.time = 0.0
    integrator.state[:] = np.concatenate([case.q[0], case.velocity[0]])
    states: Array = integrator.propagate_grid(times)[-1]
    return states


LAGRANGIAN = "heyoka.lagrangian"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Taylor:
    """System of heyoka with its options."""

    name: str
    equations: list[Any]
    formulation: Formulation
    compact: bool
    fast: bool = False
    curve: str = "heyoka"

    def integrator(self, tolerance: float, batch: int = 0) -> tuple[Any, float]:
        """Compile anew; return the integrator and the seconds, for ``batch`` trajectories at once unless 0."""
        import heyoka

        heyoka.llvm_state.clear_memcache()
        with contextlib.suppress(AttributeError):  # older versions have no such cache
            heyoka.llvm_state.set_diskcache_enabled(False)
        began = time.perf_counter()
        states = 0.125 * np.arange(1.0, len(self.equations) + 1.0)  # replaced before each run
        kind = heyoka.taylor_adaptive_batch if batch else heyoka.taylor_adaptive
        start = np.tile(states[:, np.newaxis], batch) if batch else states
        made = kind(self.equations, start, tol=tolerance, compact_mode=self.compact, fast_math=self.fast)
        return made, time.perf_counter() - began

    def contender(self, case: Case, tolerance: float) -> Contender:
        """Return a contender for one trajectory at a time, or for all trajectories of the case in batches."""
        import heyoka

        batch = heyoka.recommended_simd_size() if len(case.q) > STATES else 0
        integrator, seconds = self.integrator(tolerance, batch)
        return Contender(
            method=f"{self.curve} fast_math" if self.fast else self.curve,
            setting=f"tol={tolerance:.0e}" if tolerance else "tol=default",
            options=f"{self.name}, {'compact' if self.compact else 'unrolled'}, order {integrator.order}",
            compile_seconds=seconds,
            prepare=(self._batches if batch else self._preparation)(integrator, case),
            momenta=case.momenta if self.formulation.momenta else None,
            trajectories=len(case.q) if batch else 1,
        )

    def _second(self, case: Case) -> Array:
        """Return the second half of the states."""
        if self.formulation.momenta:
            return np.zeros_like(case.q) if case.momenta is None else case.momenta
        return case.velocity

    def _preparation(self, integrator: Any, case: Case) -> Callable[[int], Callable[[], Array]]:
        second = self._second(case)

        def prepare(index: int) -> Callable[[], Array]:
            integrator.time = 0.0
            integrator.state[:] = np.concatenate([case.q[index], second[index]])

            def integrate() -> Array:
                outcome = integrator.propagate_until(case.span)
                if "time_limit" not in str(outcome[0]):
                    raise ArithmeticError(f"heyoka stopped with {outcome[0]}")
                return np.array(integrator.state[: case.dimension])

            return integrate

        return prepare

    def _batches(self, integrator: Any, case: Case) -> Callable[[int], Callable[[], Array]]:
        """Return a function from all states to all final positions, batch by batch."""
        starts, size = np.concatenate([case.q, self._second(case)], axis=1), integrator.batch_size

        def integrate() -> Array:
            final = np.empty_like(case.q)
            for first in range(0, len(starts), size):
                integrator.set_time(0.0)
                integrator.state[:] = starts[first : first + size].T
                integrator.propagate_until(case.span)
                if any("time_limit" not in str(outcome[0]) for outcome in integrator.propagate_res):
                    raise ArithmeticError("heyoka stopped before the end")
                final[first : first + size] = integrator.state[: case.dimension].T
            return final

        return lambda index: integrate


def _variants(case: Case) -> Iterator[_Taylor]:
    m = case.dimension
    modes = (True,) if m > LARGEST_UNROLLED else (False, True) if m > LARGEST_SMALL else (False,)
    for name, equations, formulation in _formulations(case):
        for compact in modes:
            yield _Taylor(name=name, equations=equations, formulation=formulation, compact=compact)


def _curve(variants: list[_Taylor], case: Case, tolerances: Sequence[float]) -> Iterator[Contender]:
    """Yield contenders of the variant that is fastest at the first tolerance, the default; nothing if all fail."""
    made = [variant.contender(case, tolerances[0]) for variant in variants]
    seconds = [_quickest(contender) for contender in made]
    if seconds and min(seconds) < math.inf:
        best = int(np.argmin(seconds))
        yield made[best]
        yield from (variants[best].contender(case, tolerance) for tolerance in tolerances[1:])


def _formulations(case: Case) -> Iterator[tuple[str, list[Any], Formulation]]:
    import heyoka

    m = case.dimension
    x = heyoka.make_vars(*[f"q{n}" for n in range(m)], *[f"v{n}" for n in range(case.size - m)])
    for formulation in case.formulations:
        yield formulation.name, list(zip(x, formulation.rates(x, case.parameters, heyoka), strict=True)), formulation
    plain = case.formulations[0]
    most = LARGEST_LAGRANGIAN if forms_of(case.system).separable else LARGEST_COUPLED
    if 2 * m == case.size and m <= most and not any(case.system.forces):
        yield LAGRANGIAN, _from_lagrangian(case), plain
    if case.bodies is not None and case.bodies.axes == 3 and not case.bodies.fixed_centre:
        yield "heyoka.model.nbody", _n_bodies(case), plain


def _from_lagrangian(case: Case) -> list[Any]:
    """Return equations in the order q, v, from the Lagrangian with numbers for its parameters."""
    import heyoka
    import sympy

    system = case.system
    values = dict(zip(system.parameters, map(sympy.Float, system.defaults), strict=True))
    q, v = ([heyoka.expression(symbol.name) for symbol in part] for part in (system.coordinates, system.velocities))
    lagrangian = heyoka.from_sympy(system.lagrangian.xreplace(values))
    rates = {str(left): right for left, right in heyoka.lagrangian(lagrangian, q, v)}
    return [(symbol, rates[str(symbol)]) for symbol in (*q, *v)]


def _n_bodies(case: Case) -> list[Any]:
    """Return heyoka's N-body equations in the order of the case: all positions, then all velocities."""
    import heyoka

    bodies = case.bodies
    assert bodies is not None
    rates = heyoka.model.nbody(len(bodies.masses), masses=bodies.masses, Gconst=bodies.gravity)
    by_name = {str(left): (left, right) for left, right in rates}
    axes = "xyz"[: bodies.axes]
    names = [f"{kind}{axis}_{n}" for kind in ("", "v") for n in range(len(bodies.masses)) for axis in axes]
    return [by_name[name] for name in names]


def _quickest(contender: Contender) -> float:
    """Return the seconds of the fastest of a few runs; infinite if they fail (heyoka: powers of a zero distance)."""
    seconds = []
    for _ in range(TRIALS):
        integrate = contender.prepare(0)
        began = time.process_time()
        try:
            integrate()
        except ArithmeticError:
            return math.inf
        seconds.append(time.process_time() - began)
    return min(seconds)
