"""Benchmark of array systems: time at equal error (hand-written C, SciPy, REBOUND, OpenMM), and scaling with size.

OpenMM's Verlet integrator for Lennard-Jones atoms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.resources import files
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from scvi_codegen.benchmark.cases.large import Lattice, atoms, bodies, field, ring
from scvi_codegen.benchmark.cases.unforced import Array
from scvi_codegen.benchmark.machine import machine_limits
from scvi_codegen.benchmark.report import OURS, Point, ResultTable, time_at
from scvi_codegen.benchmark.settings import Plan, ReportActivity, output_of_process, timed
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.leapfrog_stages import kicks_and_drifts
from scvi_codegen.native import building
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.arrays.stepper import ArrayStepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings
from scvi_codegen.runtime.run.run import Run

ERRORS = (1e-4, 1e-7, 1e-10)
OWN = "composition"
METHODS = ("svi:2", "svi:4", "svi:6", "svi:8")
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
DECLARATIONS = (
    "void leapfrog(int is_field, double *q, double *v, double *work, long n, double strength, double h, long steps, "
    "const double *kicks, const double *drifts, int leaps);"
)
GROWTH = (10**3, 10**4, 10**5, 10**6)
SIDE = 512
"""Length of the axes of the field."""
MEASURED = {
    "first_step_s": ".2f",
    "ns_a_coordinate_and_step": ".1f",
    "iterations": ".2f",
    "gflops": ".2f",
    "gigabytes_s": ".1f",
    "memory_mb": ".0f",
}
"""Numbers that a process of :mod:`~scvi_codegen.benchmark.contenders.array_process` prints, with their formats."""
PATIENCE = 0.3
"""Seconds above which a setting is timed only twice."""


def lattices(plan: Plan) -> tuple[Lattice, ...]:
    """Return all problems, or small ones."""
    if plan.quick:
        return (ring(64, 2.0), field(16, 0.5), bodies(8, 1.0), atoms(1, 0.5))
    return (ring(1000, 20.0), ring(100_000, 2.0), field(256, 2.0), bodies(256, 2.0), atoms(4, 1.0))


@without_accuracy_warnings()
def run_lattices(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the times of every contender at equal error."""
    rows: list[dict[str, Any]] = []
    for each in lattices(plan):
        report_activity(f"sums: {each.name} of {each.q.size} coordinates")
        reference, doubt = reference_of(each)
        curves = _curves(_contenders(each, plan), reference, plan)
        rows += [_row(each, error, curves, doubt) for error in ERRORS]
    names = (OWN, "leapfrog", "order_8", "DOP853", "IAS15", "REBOUND_leapfrog", *PLATFORMS)
    return ResultTable(
        name="lattices",
        title="time at equal error, and ratios of other methods",
        columns={"problem": "", "coordinates": "d", "error": ".0e", "ours_ms": ".2f", "by": ""}
        | dict.fromkeys(names, ".2f")
        | {"doubt": ".0e"},
        rows=tuple(rows),
        remarks=(
            "ours: the fastest of SVI(2), (4), (6), (8); composition: ours of order 8; leapfrog, order 8: C by hand,",
            "the second the same composition; below 1 another is faster than the first. Error: root mean square of",
            "positions over that of the positions at the end; doubt: how far apart SVI(10), by which it is measured,",
            "and a composition of order 10 are. OpenMM_CPU: single precision, one thread; OpenMM_double: Reference.",
        ),
    )


def _row(each: Lattice, error: float, curves: Mapping[str, list[Point]], doubt: float) -> dict[str, Any]:
    times = {name: time_at(points, error) for name, points in curves.items()}
    ours = {name: seconds for name in METHODS if (seconds := times.get(name)) is not None}
    result: dict[str, Any] = {"problem": each.name, "coordinates": each.q.size, "error": error, "doubt": doubt}
    if not ours:
        return result
    best = min(ours, key=ours.__getitem__)
    ratios = {name: seconds / ours[best] for name, seconds in times.items() if name not in METHODS and seconds}
    return result | {"ours_ms": 1e3 * ours[best], "by": best} | ratios


def reference_of(each: Lattice) -> tuple[Array, float]:
    """Return the final state by SVI(10), and its distance from a composition of order 10."""
    result = _ours(each, "svi:10", _count(each, each.longest / 8))()
    other = _ours(each, Composition(10), _count(each, each.longest / 32))()
    return result, rms(other, result)


def _curves(
    contenders: Mapping[str, Sequence[Callable[[], Array]]], reference: Array, plan: Plan
) -> dict[str, list[Point]]:
    """Measure all settings of all contenders in turn, for several rounds; slow ones twice."""
    seconds: dict[tuple[str, int], list[float]] = {}
    errors: dict[tuple[str, int], float] = {}
    for number in range(plan.rounds + 1):
        for name, settings in contenders.items():
            for k, setting in enumerate(settings):
                known = seconds.setdefault((name, k), [])
                if number < 2 or min(known) < PATIENCE:
                    elapsed, end = timed(setting)
                    known.append(elapsed)
                    errors[name, k] = rms(end, reference)
    return {
        name: [Point(seconds=min(seconds[name, k]), error=errors[name, k]) for k in range(len(settings))]
        for name, settings in contenders.items()
    }


def rms(end: Array, reference: Array) -> float:
    """Return the root mean square of the differences, relative to that of the reference."""
    return float(np.sqrt(np.mean((end - reference) ** 2) / np.mean(reference**2)))


def _count(each: Lattice, h: float) -> int:
    return max(1, round(each.span / h))


def _contenders(each: Lattice, plan: Plan) -> dict[str, list[Callable[[], Array]]]:
    """Return the settings by name."""
    result = {
        method: [_ours(each, method, _count(each, each.longest / 2**k)) for k in range(7 - int(method[-1]) // 2)]
        for method in METHODS
    }
    result[OWN] = [_ours(each, Composition(8), _count(each, each.longest / 2**k)) for k in range(6)]
    if each.by_hand:
        result["leapfrog"] = [_by_hand(each, 2, _count(each, each.longest / 2**k)) for k in range(1, 13)]
        result["order_8"] = [_by_hand(each, 8, _count(each, each.longest / 2**k)) for k in range(6)]
    result["DOP853"] = [_dop853(each, tolerance) for tolerance in TOLERANCES]
    if each.name == "bodies" and "rebound" in plan.peers and find_spec("rebound"):
        result["REBOUND_leapfrog"] = [
            _rebound(each, "leapfrog", _count(each, each.longest / 2**k)) for k in range(2, 12)
        ]
        result["IAS15"] = [_rebound(each, "ias15", None)]
    if each.name == "atoms" and "openmm" in plan.peers and find_spec("openmm"):
        for name in PLATFORMS:
            result[name] = [openmm_run(name, each, _count(each, each.longest / 2**k)) for k in range(1, 10)]
    return result


def _ours(each: Lattice, method: Any, steps: int) -> Callable[[], Array]:
    stepper, name = compile_stepper(each.system, method), each.system.coordinates[0].name
    return lambda: positions_of(advanced(stepper, each, steps))[name]


def advanced(stepper: ArrayStepper, each: Lattice, steps: int) -> Run:
    """Return a run at the end of the span."""
    run = stepper.start(each.q, velocity=each.v, h=each.span / steps, parameters=each.parameters)
    run.advance(steps)
    return run


def positions_of(run: Run) -> dict[str, Array]:
    """Return the positions of a run by the name of their array."""
    return run.stepper.arrays(run.q)


def _by_hand(each: Lattice, order: int, steps: int) -> Callable[[], Array]:
    assert each.by_hand is not None
    flags = (*building.TUNED_FLAGS, "-ffast-math")
    library = building.load(_by_hand_source(), flags=flags)
    kicks, drifts = (np.array([float(x) for x in row]) for row in kicks_and_drifts(Composition(order)))
    is_field, count, strength = each.by_hand

    def run() -> Array:
        q, v = each.q.reshape(-1).copy(), each.v.reshape(-1).copy()
        arrays = [library.ffi.from_buffer("double[]", array) for array in (q, v, np.empty(q.size), kicks, drifts)]
        state, tables = arrays[:3], arrays[3:]
        library.lib.leapfrog(is_field, *state, count, strength, each.span / steps, steps, *tables, len(kicks))
        return q.reshape(each.q.shape)

    return run


def _by_hand_source() -> Source:
    code = files("scvi_codegen.benchmark").joinpath("lattices.c").read_text(encoding="utf-8")
    return Source(prefix="lattices", header=f"{DECLARATIONS}\n", code=code, declarations=DECLARATIONS)


def _dop853(each: Lattice, tolerance: float) -> Callable[[], Array]:
    size, shape = each.q.size, each.q.shape

    def derivative(t: float, y: Array) -> Array:
        return np.concatenate([y[size:], each.accelerations(y[:size].reshape(shape)).reshape(-1)])

    def run() -> Array:
        start = np.concatenate([each.q.reshape(-1), each.v.reshape(-1)])
        result = solve_ivp(derivative, (0.0, each.span), start, method="DOP853", rtol=tolerance, atol=tolerance)
        end: Array = result.y[:size, -1].reshape(shape)
        return end

    return run


def states_by_rebound(each: Lattice, integrator: str, steps: int | None) -> tuple[Array, Array]:
    """Return the final positions and velocities of bodies by REBOUND; ``None``: adaptive steps."""
    import rebound

    simulation = rebound.Simulation()
    simulation.softening = float(each.system.defaults[1])
    for q, v in zip(each.q, each.v, strict=True):
        simulation.add(m=1 / len(each.q), x=q[0], y=q[1], z=q[2], vx=v[0], vy=v[1], vz=v[2])
    simulation.integrator = integrator
    if steps is not None:
        simulation.dt = each.span / steps
    simulation.integrate(each.span)
    positions, velocities = np.array([[p.xyz, p.vxyz] for p in simulation.particles]).transpose(1, 0, 2)
    return positions, velocities


def _rebound(each: Lattice, integrator: str, steps: int | None) -> Callable[[], Array]:
    return lambda: states_by_rebound(each, integrator, steps)[0]


@without_accuracy_warnings()
def run_growth(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the time to the first step, and time and memory per step, by number of coordinates."""
    rows, (memory, arithmetic) = list(_growth(plan, report_activity)), machine_limits()
    return ResultTable(
        name="growth",
        title="scaling with size: h = 0.1 (field: 0.03), one process each with an empty cache",
        columns={
            "problem": "",
            "by": "",
            "coordinates": "d",
            **MEASURED,
        },
        rows=tuple(rows),
        remarks=(
            "first step: from text; gflops: of kernels and table products, in iterations; gigabytes: their array reads",
            "and writes; memory: of the process. One core of this machine, at most: multiply-adds in registers",
            f"{arithmetic:.0f} GFLOP/s, STREAM's triad {memory:.1f} GB/s.",
        ),
    )


def _growth(plan: Plan, report_activity: ReportActivity) -> Iterator[dict[str, Any]]:
    sizes = [("ring", count) for count in GROWTH[: 2 if plan.quick else None]]
    sizes.append(("field", 16 if plan.quick else SIDE))
    for method in ("svi:4", "svi:8", "stoermer-verlet"):
        for name, size in sizes:
            count = size * size if name == "field" else size
            report_activity(f"growth: {name} of {count} coordinates by {method}")
            arguments = ["-m", "scvi_codegen.benchmark.contenders.array_process", method, name, str(size)]
            numbers = map(float, output_of_process(arguments).split())
            named = dict(zip(MEASURED, numbers, strict=True))
            yield {"problem": name, "by": f"{OURS} {method}", "coordinates": count} | named


PLATFORMS = {"OpenMM_CPU": ("CPU", {"Threads": "1"}), "OpenMM_double": ("Reference", {})}
"""OpenMM's platforms by the name in the table: single precision with vectors in one thread; double precision with
loops."""


def openmm_run(name: str, each: Lattice, steps: int) -> Callable[[], Array]:
    """Return a function that performs ``steps`` steps of OpenMM's Verlet integrator and returns the (N, 3) positions.

    Atoms have unit mass, depth and diameter. OpenMM's velocities are those half a step before the positions, so that
    the start is shifted by half a kick; the method is then Stoermer-Verlet. Units are consistent: dalton, nm, ps,
    kJ/mol.
    """
    import openmm

    platform, properties = PLATFORMS[name]
    system, force = openmm.System(), openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.NoCutoff)
    for _ in each.q:
        system.addParticle(1.0)
        force.addParticle(0.0, 1.0, 1.0)
    system.addForce(force)
    h = each.span / steps
    integrator = openmm.VerletIntegrator(h)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)
    half_before = each.v - h / 2 * each.accelerations(each.q)

    def run() -> Array:
        context.setPositions(each.q)
        context.setVelocities(half_before)
        integrator.step(steps)
        end: Array = context.getState(positions=True).getPositions(asNumpy=True)._value
        return end

    return run
