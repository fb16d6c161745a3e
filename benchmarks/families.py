"""Families of periodic orbits: orbits a second at the default bound 1e-9 of their discretisation error.

AUTO-07p is no package of the Python index, so there is no peer beside.
"""

import time
from collections.abc import Callable
from typing import Any

from benchmarks.report import ResultTable
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen import Family, LagrangianSystem, compile_stepper, equilibrium, family, periodic_orbit

RESTRICTED = LagrangianSystem.from_text(
    name="restricted three-body problem",
    coordinates=["x", "y", "z"],
    lagrangian="((x_dot - y)**2 + (y_dot + x)**2 + z_dot**2)/2"
    " + (1 - mu)/sqrt((x + mu)**2 + y**2 + z**2) + mu/sqrt((x - 1 + mu)**2 + y**2 + z**2)",
    parameters={"mu": 1.215058560962404e-2},
)
DUFFING = LagrangianSystem.from_text(
    name="Duffing oscillator",
    coordinates=["x"],
    lagrangian="x_dot**2/2 - x**2/2 - b*x**4/4 + F*x*cos(w*t)",
    parameters={"b": 0.2, "F": 0.1, "w": 0.9, "c": 0.05},
    dissipation="c*x_dot**2/2",
)
ORBITS, QUICK_ORBITS = 500, 4


def run_families(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the continuation of Lyapunov and halo orbits about L1, and of a resonance curve."""
    count, rows = QUICK_ORBITS if plan.quick else ORBITS, []

    def measure(name: str, continued: Callable[[], Family]) -> Family:
        report_activity(f"families: {name}")
        began = time.process_time()
        members = continued()
        seconds = time.process_time() - began
        numbers: dict[str, Any] = {
            "orbits": len(members),
            "seconds": seconds,
            "orbits_a_second": len(members) / seconds,
        }
        numbers |= {"bifurcations": len(members.bifurcations), "error": max(orbit.error for orbit in members)}
        rows.append({"family": name, **numbers, "last_period": members.periods[-1], "ended": members.ended[:40]})
        return members

    stepper = compile_stepper(RESTRICTED, "svi:8")
    rest = equilibrium(stepper, [0.83, 0.0, 0.0])
    few = min(count, 40)
    planar = measure("Lyapunov orbits about L1", lambda: family(stepper, rest, amplitude=0.02, step=0.2, count=few))
    if planar.bifurcations:
        halo = planar.bifurcations[0]
        measure("halo orbits about L1", lambda: halo.switch(step=0.01, count=count))
    driven = compile_stepper(DUFFING, "svi:4")
    orbit = periodic_orbit(driven, [0.5], [0.0], period=6.981317007977318, fixed_period=True)
    curve: dict[str, Any] = {"parameter": "w", "period": "2*pi/w", "step": 0.1, "until": "w > 1.4", "count": count}
    measure("resonance curve of a Duffing oscillator", lambda: family(driven, orbit, **curve))
    columns = {"family": "", "orbits": "d", "bifurcations": "d", "seconds": ".2f", "orbits_a_second": ".0f"}
    return ResultTable(
        name="families",
        title="families of periodic orbits with errors below 1e-9, in one thread (seconds of the processor)",
        columns=columns | {"error": ".0e", "last_period": ".6f", "ended": ""},
        rows=tuple(rows),
        remarks=("the time includes the location of the bifurcations, to ten digits.",),
    )
