"""Benchmark of a thousand gravitating bodies; REBOUND's leapfrog and IAS15 at equal error."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec

from scvi_codegen.benchmark.cases import Array
from scvi_codegen.benchmark.contenders.contenders import OURS
from scvi_codegen.benchmark.large_cases import Lattice, bodies
from scvi_codegen.benchmark.lattices import reference_of, rms
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

__all__ = ["run_thousand_bodies"]

State = tuple[Array, Array]
"""Final positions and velocities."""

COUNT, QUICK_COUNT, SPAN = 1000, 20, 0.5
LEAPS = (16, 64, 256, 1024)
OURS_BY = {"svi:2": (16, 32), "svi:4": (4, 8, 16), "svi:8": (2, 4, 8, 16), "composition:8": (4, 8, 16)}
"""Numbers of steps of each method."""


@without_accuracy_warnings()
def run_thousand_bodies(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure every contender at several numbers of steps, each twice."""
    each = bodies(QUICK_COUNT if plan.quick else COUNT, SPAN)
    reference, doubt = reference_of(each)
    energy = _energies(each)
    before = energy((each.q, each.v))
    rows = []
    for name, steps, settle in _contenders(each, plan):
        report_activity(f"cluster: {name}, {steps or 'adaptive'} steps")
        seconds, end = _timed(settle)
        errors = {"error": rms(end[0], reference), "energy_error": abs(energy(end) / before - 1.0)}
        rows.append({"by": name, "steps": steps, "ms": 1e3 * seconds, **errors})
    return ResultTable(
        name="thousand-bodies",
        title=f"{len(each.q)} bodies, direct sum, softened, to t = {SPAN:g}",
        columns={"by": "", "steps": "d", "ms": ".0f", "error": ".1e", "energy_error": ".1e"},
        rows=tuple(rows),
        remarks=(
            f"error: root mean square of positions over that of the positions, known to {doubt:.0e}; energy error:",
            "relative. Processor time, the faster of two runs. IAS15 has adaptive step size at its default accuracy.",
        ),
    )


def _timed(settle: Callable[[], State]) -> tuple[float, State]:
    times = []
    for _ in range(2):
        began = time.process_time()
        end = settle()
        times.append(time.process_time() - began)
    return min(times), end


def _energies(each: Lattice) -> Callable[[State], float]:
    stepper = compile_stepper(each.system, "stoermer-verlet")
    return lambda state: stepper.start(state[0], velocity=state[1], h=1.0, parameters=each.parameters).energy


def _contenders(each: Lattice, plan: Plan) -> Iterator[tuple[str, int | None, Callable[[], State]]]:
    for method, counts in OURS_BY.items():
        for steps in counts:
            yield f"{OURS} {method}", steps, _ours(each, method, steps)
    for steps in LEAPS:
        yield f"{OURS} stoermer-verlet", steps, _ours(each, "stoermer-verlet", steps)
    if "rebound" in plan.peers and find_spec("rebound"):
        for steps in LEAPS:
            yield "REBOUND leapfrog", steps, _rebound(each, "leapfrog", steps)
        yield "REBOUND IAS15", None, _rebound(each, "ias15", None)


def _ours(each: Lattice, method: str, steps: int) -> Callable[[], State]:
    stepper = compile_stepper(each.system, method)

    def settle() -> State:
        run = stepper.start(each.q, velocity=each.v, h=each.span / steps, parameters=each.parameters)
        run.advance(steps)
        return run.q["r"], run.velocity["r"]

    return settle


def _rebound(each: Lattice, integrator: str, steps: int | None) -> Callable[[], State]:
    import numpy as np
    import rebound

    def settle() -> State:
        simulation = rebound.Simulation()
        simulation.softening = float(each.system.defaults[1])
        for q, v in zip(each.q, each.v, strict=True):
            simulation.add(m=1 / len(each.q), x=q[0], y=q[1], z=q[2], vx=v[0], vy=v[1], vz=v[2])
        simulation.integrator = integrator
        if steps is not None:
            simulation.dt = each.span / steps
        simulation.integrate(each.span)
        result = [[[p.x, p.y, p.z], [p.vx, p.vy, p.vz]] for p in simulation.particles]
        positions, velocities = np.array(result).transpose(1, 0, 2)
        return positions, velocities

    return settle
