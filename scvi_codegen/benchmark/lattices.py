"""Time at equal error: SVI and explicit compositions of this package, hand-written C, SciPy, REBOUND and OpenMM.

Every contender runs with smaller and smaller steps, or tolerances; the times at an error are interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.resources import files
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from scvi_codegen.benchmark.cases.large import Lattice, atoms, bodies, field, ring
from scvi_codegen.benchmark.cases.references import Reference, rms_error
from scvi_codegen.benchmark.cases.unforced import Array, case
from scvi_codegen.benchmark.comparison import measure
from scvi_codegen.benchmark.report import Contender, Point, ResultTable, time_at
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.leapfrog_stages import kicks_and_drifts
from scvi_codegen.native import building
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

ERRORS = (1e-4, 1e-7, 1e-10)
METHODS = ("svi:2", "svi:4", "svi:6", "svi:8")
COMPOSITIONS = {"composition_8": 8, "composition_10": 10}
"""Orders of explicit compositions of this package, by the name in the table."""
COMPARED = ("kepler:0.5", "henon-heiles", "outer-solar-system")
"""Cases of the benchmark of named coordinates."""
SHARE, COARSEST = 0.1, 2.0
"""Part of the span of a case (in longer ones round-off exceeds the smallest error), and its largest step, in units of
its own."""
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
DECLARATIONS = (
    "void leapfrog(int is_field, double *q, double *v, double *work, long n, double strength, double h, long steps, "
    "const double *kicks, const double *drifts, int leaps);"
)


Prepare = Callable[[int], Callable[[], Array]]
"""Contender at one setting, as :attr:`~scvi_codegen.benchmark.report.Contender.prepare`."""


def lattices(plan: Plan) -> tuple[Lattice, ...]:
    """Return all array systems, or small ones."""
    if plan.quick:
        return (ring(64, 2.0), field(16, 0.5), bodies(8, 1.0), atoms(1, 0.5))
    return (
        *(ring(1000, 20.0), ring(100_000, 2.0), field(256, 2.0)),
        *(bodies(256, 2.0), bodies(1000, 0.5), atoms(4, 1.0)),
    )


def cases(plan: Plan) -> tuple[Lattice, ...]:
    """Return the cases of named coordinates, from their first state."""
    return tuple(
        Lattice(
            name=each.name,
            system=each.system,
            q=each.q[0],
            v=each.velocity[0],
            span=each.span * SHARE * plan.share,
            longest=COARSEST * each.step,
        )
        for each in map(case, COMPARED)
    )


def run_lattices(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Compare methods and peers on array systems."""
    return _table("lattices", lattices(plan), plan, report_activity)


def run_compositions(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Compare SVI and explicit compositions on systems of named coordinates."""
    return _table("compositions", cases(plan), plan, report_activity)


@without_accuracy_warnings()
def _table(name: str, problems: Sequence[Lattice], plan: Plan, report_activity: ReportActivity) -> ResultTable:
    rows: list[dict[str, Any]] = []
    for each in problems:
        report_activity(f"{name}: {each.name} of {each.q.size} coordinates")
        reference = reference_of(each)
        curves = _curves(_contenders(each, plan), reference, plan)
        rows += [_row(each, error, curves, reference.accuracy) for error in ERRORS]
    measured = dict.fromkeys(key for row in rows for key in row if key not in ("doubt", "ours_ms", "by"))
    first = {"problem": "", "coordinates": "d", "error": ".0e", "ours_ms": ".2f", "by": ""}
    return ResultTable(
        name=name,
        title="time at equal error, and ratios of other methods",
        columns=first | {key: ".2f" for key in measured if key not in first} | {"doubt": ".0e"},
        rows=tuple(rows),
        remarks=(
            "ours: the fastest of SVI(2), (4), (6), (8); composition, leapfrog: ours; by hand: C; below 1 another is",
            "faster than the first. Error: root mean square of positions over that of the positions at the end;",
            "doubt: how far apart SVI(10), by which it is measured, and a composition of order 10 are. OpenMM_CPU:",
            "single precision, one thread; OpenMM_double: Reference.",
        ),
    )


def _row(each: Lattice, error: float, curves: Mapping[str, list[Point]], doubt: float) -> dict[str, Any]:
    times = {name: time_at(points, error) for name, points in curves.items()}
    ours = {name: seconds for name in METHODS if (seconds := times.get(name)) is not None}
    best = min(ours, key=ours.__getitem__, default=None)
    result: dict[str, Any] = {"problem": each.name, "coordinates": each.q.size, "error": error, "doubt": doubt}
    if best is None:
        return result
    ratios = {name: seconds and seconds / ours[best] for name, seconds in times.items() if name not in METHODS}
    return result | {"ours_ms": 1e3 * ours[best], "by": best} | ratios


def reference_of(each: Lattice) -> Reference:
    """Return the final state by SVI(10); its accuracy is the distance from a composition of order 10."""
    ends = (("svi:10", _count(each, each.longest / 8)), (Composition(10), _count(each, each.longest / 32)))
    result, other = (_ours(each, method, count)(0)().reshape(1, -1) for method, count in ends)
    reference = Reference(high=result, low=np.zeros_like(result), accuracy=0.0)
    return replace(reference, accuracy=rms_error(other, reference))


def _curves(contenders: Mapping[str, Sequence[Prepare]], reference: Reference, plan: Plan) -> dict[str, list[Point]]:
    """Measure all settings of all contenders in turn; steps that are too large are left out."""
    settings = [
        Contender(method=name, setting="", options="", compile_seconds=0.0, prepare=prepare, starts=1)
        for name, several in contenders.items()
        for prepare in several
    ]
    measured = measure(settings, lambda _: reference, repeats=plan.rounds)
    return {
        name: [each.fastest_point for each in measured if each.method == name and not each.failure]
        for name in contenders
    }


def _count(each: Lattice, h: float) -> int:
    return max(1, round(each.span / h))


def _contenders(each: Lattice, plan: Plan) -> dict[str, list[Prepare]]:
    """Return the settings by name."""

    def halved(make: Callable[[int], Prepare], most: int, first: int = 0) -> list[Prepare]:
        return [make(_count(each, each.longest / 2**k)) for k in range(first, most)]

    result = {method: halved(partial(_ours, each, method), 7 - int(method[-1]) // 2) for method in METHODS}
    for name, order in COMPOSITIONS.items():
        result[name] = halved(partial(_ours, each, Composition(order)), 6)
    result["leapfrog"] = halved(partial(_ours, each, "stoermer-verlet"), 13, 1)
    if each.by_hand:
        result["leapfrog_by_hand"] = halved(partial(_by_hand, each, 2), 13, 1)
        result["composition_8_by_hand"] = halved(partial(_by_hand, each, 8), 6)
    if each.accelerations:
        result["DOP853"] = [_dop853(each, each.accelerations, tolerance) for tolerance in TOLERANCES]
    if each.name == "bodies" and "rebound" in plan.peers and find_spec("rebound"):
        result["REBOUND_leapfrog"] = halved(partial(_rebound, each, "leapfrog"), 12, 2)
        result["IAS15"] = [_rebound(each, "ias15", None)]
    if each.name == "atoms" and "openmm" in plan.peers and find_spec("openmm"):
        for name in PLATFORMS:
            result[name] = halved(partial(openmm_run, name, each), 10, 1)
    return result


def _ours(each: Lattice, method: Any, steps: int) -> Prepare:
    stepper = compile_stepper(each.system, method)

    def prepare(_: int) -> Callable[[], Array]:
        run = stepper.start(each.q, velocity=each.v, h=each.span / steps, parameters=each.parameters)

        def integrate() -> Array:
            run.advance(steps)
            parts = run.stepper.arrays(run.q).values()
            return np.concatenate([np.ravel(part) for part in parts]).reshape(each.q.shape)

        return integrate

    return prepare


def _by_hand(each: Lattice, order: int, steps: int) -> Prepare:
    assert each.by_hand is not None
    flags = (*building.TUNED_FLAGS, "-ffast-math")
    library = building.load(_by_hand_source(), flags=flags)
    kicks, drifts = (np.array([float(x) for x in row]) for row in kicks_and_drifts(Composition(order)))
    is_field, count, strength = each.by_hand

    def prepare(_: int) -> Callable[[], Array]:
        q, v = each.q.reshape(-1).copy(), each.v.reshape(-1).copy()
        arrays = [library.ffi.from_buffer("double[]", array) for array in (q, v, np.empty(q.size), kicks, drifts)]
        state, tables = arrays[:3], arrays[3:]

        def integrate() -> Array:
            library.lib.leapfrog(is_field, *state, count, strength, each.span / steps, steps, *tables, len(kicks))
            return q.reshape(each.q.shape)

        return integrate

    return prepare


def _by_hand_source() -> Source:
    code = files("scvi_codegen.benchmark").joinpath("lattices.c").read_text(encoding="utf-8")
    return Source(prefix="lattices", header=f"{DECLARATIONS}\n", code=code, declarations=DECLARATIONS)


def _dop853(each: Lattice, accelerations: Callable[[Array], Array], tolerance: float) -> Prepare:
    size, shape = each.q.size, each.q.shape

    def derivative(t: float, y: Array) -> Array:
        return np.concatenate([y[size:], accelerations(y[:size].reshape(shape)).reshape(-1)])

    def integrate() -> Array:
        start = np.concatenate([each.q.reshape(-1), each.v.reshape(-1)])
        result = solve_ivp(derivative, (0.0, each.span), start, method="DOP853", rtol=tolerance, atol=tolerance)
        end: Array = result.y[:size, -1].reshape(shape)
        return end

    return lambda _: integrate


def _rebound(each: Lattice, integrator: str, steps: int | None) -> Prepare:
    """Return REBOUND's final positions of bodies; ``None``: adaptive steps."""
    import rebound

    def prepare(_: int) -> Callable[[], Array]:
        simulation = rebound.Simulation()
        simulation.softening = float(each.system.defaults[1])
        for q, v in zip(each.q, each.v, strict=True):
            simulation.add(m=1 / len(each.q), x=q[0], y=q[1], z=q[2], vx=v[0], vy=v[1], vz=v[2])
        simulation.integrator = integrator
        if steps is not None:
            simulation.dt = each.span / steps

        def integrate() -> Array:
            simulation.integrate(each.span)
            return np.array([particle.xyz for particle in simulation.particles])

        return integrate

    return prepare


PLATFORMS = {"OpenMM_CPU": ("CPU", {"Threads": "1"}), "OpenMM_double": ("Reference", {})}
"""OpenMM's platforms by the name in the table: single precision with vectors in one thread; double precision with
loops."""


def openmm_run(name: str, each: Lattice, steps: int) -> Prepare:
    """Return ``steps`` steps of OpenMM's Verlet integrator, with the final (N, 3) positions.

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
    assert each.accelerations is not None
    half_before = each.v - h / 2 * each.accelerations(each.q)

    def prepare(_: int) -> Callable[[], Array]:
        context.setPositions(each.q)
        context.setVelocities(half_before)
        return integrate

    def integrate() -> Array:
        integrator.step(steps)
        end: Array = context.getState(positions=True).getPositions(asNumpy=True)._value
        return end

    return prepare
