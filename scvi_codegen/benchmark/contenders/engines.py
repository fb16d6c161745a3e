"""Contenders of multibody programs: MuJoCo's integrators at several step sizes, for cases that have its model."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array, Case
from scvi_codegen.benchmark.report import Contender

LARGEST_STEP, HALVINGS = 0.02, 6
"""Largest step size, ten times MuJoCo's default, and number of step sizes, each half of the one before."""
INTEGRATORS = ("RK4", "implicitfast", "Euler")


def step_counts(span: float, *, quick: bool) -> list[int]:
    """Return numbers of steps in a span, from the largest step size down."""
    return [max(1, round(span / LARGEST_STEP * 2**k)) for k in range(2 if quick else HALVINGS)]


def mujoco_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield MuJoCo's integrators; a model whose coordinates are those of all states integrates them together."""
    import mujoco

    assert case.mjcf is not None
    began = time.perf_counter()
    model = mujoco.MjModel.from_xml_string(case.mjcf)
    seconds, data = time.perf_counter() - began, mujoco.MjData(model)
    together = len(case.q) > 1 and model.nq == case.q.size
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT

    def preparation(integrator: str, steps: int) -> Callable[[int], Callable[[], Array]]:
        def prepare(index: int) -> Callable[[], Array]:
            chosen = slice(None) if together else index
            mujoco.mj_resetData(model, data)
            model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
            model.opt.timestep = case.span / steps
            data.qpos[:], data.qvel[:] = (np.ravel(part[chosen]) for part in case.states)

            def integrate() -> Array:
                with _warnings() as warnings_seen:
                    mujoco.mj_step(model, data, nstep=steps)
                if warnings_seen:
                    raise ArithmeticError(warnings_seen[0])
                return np.array(data.qpos).reshape(-1, case.dimension)

            return integrate

        return prepare

    for integrator in INTEGRATORS:
        for steps in step_counts(case.span, quick=quick):
            yield Contender(
                method=f"MuJoCo {integrator}",
                setting=f"h={case.span / steps:.4g}",
                options="without contacts",
                compile_seconds=seconds,
                prepare=preparation(integrator, steps),
                trajectories=len(case.q) if together else 1,
                starts=len(case.q),
            )


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would otherwise write to a file MUJOCO_LOG.TXT."""
    import mujoco

    warnings_seen: list[str] = []
    before: Any = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings_seen.append)
    try:
        yield warnings_seen
    finally:
        mujoco.set_mju_user_warning(before)
