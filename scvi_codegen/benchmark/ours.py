"""This project's own steppers on a ladder of step sizes."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from scvi_codegen import building
from scvi_codegen.benchmark.cases import Array, Case
from scvi_codegen.benchmark.contenders import OURS, Contender
from scvi_codegen.compiler import generate_source
from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.stepper import Stepper

__all__ = ["Advice", "ladder", "our_contenders"]

Advice = Callable[[Case, Method], float]
"""A step size for a case and a method, chosen without knowing the answer."""

RUNGS = 11
RATIO = 2.0 ** (1.0 / 3.0)
PILOT_STEPS = 2
SLOWEST = 10.0
"""Seconds for a trajectory beyond which a step is not measured: the stages of a large system then go to Newton."""


def ladder(middle: float, rungs: int = RUNGS) -> list[float]:
    """Step sizes in geometric progression, the largest first."""
    return [middle * RATIO ** (rungs // 2 - rung) for rung in range(rungs)]


def our_contenders(
    case: Case, *, methods: Iterable[Method] | None = None, rungs: int = RUNGS, advice: Advice | None = None
) -> list[Contender]:
    """Every method at every step of the ladder (rounded so that steps fill the span), and at the step advised.

    Args:
        case: what to integrate.
        methods: by default the default method, SVI(8).
        rungs: length of the ladder.
        advice: chooses one more step.
    """
    result = []
    for method in methods or (SVI(8),):
        stepper, seconds = _compiled(case, method)
        momenta = np.array([stepper.momentum(q, v) for q, v in zip(case.q, case.velocity, strict=True)])
        steps = [(h, "") for h in ladder(case.step, rungs)]
        steps += [(advice(case, method), " (advised)")] if advice is not None else []
        for h, note in steps:
            count = max(1, round(case.span / h))
            result.append(
                Contender(
                    method=f"{OURS} {method.name}",
                    setting=f"h={case.span / count:.4g}{note}",
                    options=f"{stepper.title}, solver auto, {' '.join(stepper.flags)}",
                    compile_seconds=seconds,
                    prepare=_preparation(stepper, case, momenta, count),
                    momenta=momenta,
                )
            )
    return result


def _compiled(case: Case, method: Method) -> tuple[Stepper, float]:
    """The stepper, and the seconds from the Lagrangian to it with an empty cache."""
    with tempfile.TemporaryDirectory(prefix="scvi-codegen-bench-") as folder, _cache_in(folder):
        began = time.perf_counter()
        source, interface = generate_source(case.system, method)
        stepper = Stepper(source, interface)
        return stepper, time.perf_counter() - began


@contextmanager
def _cache_in(folder: str) -> Iterator[None]:
    before = os.environ.get(building.CACHE_VARIABLE)
    os.environ[building.CACHE_VARIABLE] = folder
    try:
        yield
    finally:
        if before is None:
            del os.environ[building.CACHE_VARIABLE]
        else:
            os.environ[building.CACHE_VARIABLE] = before


def _expected_seconds(stepper: Stepper, case: Case, momenta: Array, count: int) -> float:
    """For a trajectory, from its first steps; 0 if they fail, since then it costs nothing to see them fail again."""
    run = stepper.start(case.q[0], momenta[0], h=case.span / count)
    began = time.thread_time()
    try:
        run.record(min(PILOT_STEPS, count))
    except StepFailedError:
        return 0.0
    return (time.thread_time() - began) * max(1.0, count / PILOT_STEPS)


def _preparation(stepper: Stepper, case: Case, momenta: Array, count: int) -> Callable[[int], Callable[[], Array]]:
    expected = _expected_seconds(stepper, case, momenta, count)

    def prepare(index: int) -> Callable[[], Array]:
        if expected > SLOWEST:
            raise StateError(f"not measured, since it would take about {expected:.0f} s")
        run = stepper.start(case.q[index], momenta[index], h=case.span / count)

        def integrate() -> Array:
            final: Array = run.record(count, every=count).q[-1]
            return final

        return integrate

    return prepare
