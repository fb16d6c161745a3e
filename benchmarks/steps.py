"""Tables of the time of one step: by size, threads, compiler; with derivatives, transforms and Newton's method."""

import functools
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import scipy.fft

from benchmarks.cases.large import atoms, bodies, field, ring
from benchmarks.cases.unforced import Array, Case, case
from benchmarks.contenders.arrays import by_hand
from benchmarks.contenders.ours import momenta_of
from benchmarks.report import ResultTable
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen.codegen.ir.variants import SUMS
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS, TUNED_FLAGS
from scvi_codegen.common.errors import StepFailedError
from scvi_codegen.extras.fields.system import FieldSystem
from scvi_codegen.runs.compiler import compile_stepper

Start = tuple[Array, Array]
"""Initial positions and velocities."""
STEP_SECONDS = 0.1
"""Shortest time of a timed interval."""
TURNS_SECONDS = 4.0
"""Shortest time of contenders in turns: a shared processor is slower for seconds at a time."""
RINGS, QUICK_RINGS = (1_000, 10_000, 100_000, 1_000_000), (1_000,)
SCALED = {"svi:4": 0.1, "svi:8": 0.1, "stoermer-verlet": 0.02}
"""Step sizes of a ring by method."""
THREADED: dict[str, tuple[Callable[[], Case], float]] = {
    **{f"ring:{n}": (functools.partial(ring, n, 1.0), 0.1) for n in RINGS[1:]},
    **{f"atoms:{4 * k**3}": (functools.partial(atoms, k, 1.0), 0.002) for k in (3, 4, 6)},
    **{f"bodies:{n}": (functools.partial(bodies, n, 1.0), 0.01) for n in (256, 1000)},
    "field:512": (functools.partial(field, 512, 1.0), 0.02),
}
"""Array systems and the step sizes of SVI(8); leapfrog takes a fifth of them."""
BY_HAND: tuple[Callable[[], Case], ...] = (
    *(functools.partial(ring, count, 1.0) for count in (1000, 100_000)),
    *(functools.partial(field, side, 1.0) for side in (32, 316)),
)
"""Lattices that are measured beside C by hand."""
DIFFERENTIATED: dict[str, tuple[str, float]] = {
    "Kepler": ("kepler:0.5", 0.25),
    "double pendulum": ("double-pendulum", 0.05),
    "FPUT chain of 64": ("fput-chain:64", 0.5),
    "outer solar system": ("outer-solar-system", 200.0),
}
"""Cases and step sizes of which derivatives are computed."""
DERIVED_STEPS = 2000
DENSITIES = {"sine-Gordon": "u_t**2/2 - u_x**2/2 + cos(u)", "sqrt(1 + u_x^2)": "u_t**2/2 - sqrt(1 + u_x**2)"}
"""Densities on Fourier meshes of a circle: derivatives of one convolution, and of two with a product between them."""
TRANSFORMED = (256, 1024, 4096, 16384)
"""Numbers of points of Fourier meshes."""
LARGE = (1, 10, 30, 100)
"""Step sizes times the highest frequency of the linear part."""
BUILDS = ("cc", "clang")
TARGETS = ("native", "x86-64-v4", "x86-64-v3", "x86-64", "portable")
BUILT = ("kepler:0.5", "outer-solar-system")


def shortest(work: Callable[[], object], plan: Plan, clock: Callable[[], float] = time.process_time) -> float:
    """Return the shortest of several times of a call, whose number is at least that of the timed rounds."""
    began, best, rounds = clock(), float("inf"), 0
    while rounds < plan.rounds or (clock() - began < STEP_SECONDS and not plan.quick):
        start = clock()
        work()
        best, rounds = min(best, clock() - start), rounds + 1
    return best


def _step_seconds(chosen: Case, method: str, h: float, plan: Plan, threads: int = 1) -> float:
    """Return the shortest wall time of a step of a case with arrays."""
    shape = chosen.arrays.shape if chosen.arrays is not None else (-1,)
    q, velocity = (part[0].reshape(shape) for part in chosen.states)
    run = compile_stepper(chosen.system, method).start(q, velocity=velocity, h=h, threads=threads)
    run.advance(3)
    count = max(1, round(STEP_SECONDS / max(1e-7, shortest(lambda: run.advance(1), plan, time.perf_counter))))
    return shortest(lambda: run.advance(count), plan, time.perf_counter) / count


def run_scaling(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure steps of rings of 10^3 to 10^6 elements."""
    rows = []
    for count in QUICK_RINGS if plan.quick else RINGS:
        report_activity(f"scaling: ring of {count}")
        chosen = ring(count, 1.0)
        times = {by: 1e9 * _step_seconds(chosen, by, h, plan) / count for by, h in SCALED.items()}
        rows.append({"coordinates": count} | times)
    return ResultTable(
        name="scaling",
        title="nanoseconds per coordinate and step of a ring of springs, one thread",
        columns={"coordinates": "d"} | dict.fromkeys(SCALED, ".3g"),
        rows=tuple(rows),
    )


def run_threads(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure steps of large systems with one and with two threads."""
    rows = []
    for name, (make, h) in itertools.islice(THREADED.items(), 1 if plan.quick else None):
        report_activity(f"threads: {name}")
        chosen, row = make(), dict[str, Any](system=name)
        for by, size in (("svi:8", h), ("stoermer-verlet", h / 5)):
            one, two = (_step_seconds(chosen, by, size, plan, threads) for threads in (1, 2))
            row |= {f"{by}_us": 1e6 * one, f"{by}_speed-up": one / two}
        rows.append(row)
    columns = {"system": "", "svi:8_us": ".3g", "svi:8_speed-up": ".2f"}
    columns |= {"stoermer-verlet_us": ".3g", "stoermer-verlet_speed-up": ".2f"}
    return ResultTable(
        name="threads",
        title="time of a step in one thread, and the speed-up of two threads; wall time",
        columns=columns,
        rows=tuple(rows),
    )


def run_by_hand(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure steps of lattices beside C by hand, in turns, with both kinds of sums."""
    rows = []
    for make in itertools.islice(BY_HAND, 1 if plan.quick else None):
        for order, method in ((2, "stoermer-verlet"), (8, "composition:8")):
            chosen, row = make(), dict[str, Any](method=method)
            report_activity(f"by hand: {chosen.name}, {method}")
            assert chosen.arrays is not None
            steps = max(256 // order, 1_000_000 // chosen.dimension // order)
            shape, h = chosen.arrays.shape, chosen.step / 20
            q, velocity = (part[0].reshape(shape) for part in chosen.states)
            timed: dict[str, Callable[[], object]] = {
                "hand": by_hand(replace(chosen, span=h * steps), method, order, steps).prepare(0)
            }
            for sums in SUMS:
                run = compile_stepper(chosen.system, method, sums=sums).start(q, velocity=velocity, h=h)
                timed[sums] = functools.partial(run.advance, steps)
            times = dict.fromkeys(timed, float("inf"))
            end = time.monotonic() + (STEP_SECONDS if plan.quick else TURNS_SECONDS)
            while time.monotonic() < end:
                for name, work in timed.items():
                    began = time.process_time()
                    work()
                    times[name] = min(times[name], time.process_time() - began)
            row |= {"system": chosen.name, "hand_ns": 1e9 * times["hand"] / steps / chosen.dimension}
            rows.append(row | {sums: times[sums] / times["hand"] for sums in SUMS})
    return ResultTable(
        name="by-hand",
        title="nanoseconds per coordinate and step of C by hand, and times of both kinds of sums relative to it",
        columns={"system": "", "method": "", "hand_ns": ".3g", "compensated": ".2f", "plain": ".2f"},
        rows=tuple(rows),
    )


def _lattice(chosen: Case) -> tuple[Any, Start]:
    """Return a lattice with its initial positions and velocities."""
    shape = chosen.arrays.shape if chosen.arrays is not None else (-1,)
    q, velocity = (part[0].reshape(shape) for part in chosen.states)
    return chosen.system, (q, velocity)


def _long_wave(count: int) -> tuple[Any, Start]:
    """Return a ring at rest with one wave, whose springs are strained by up to 0.3."""
    q = count / 20 * np.sin(2 * np.pi * np.arange(count) / count)
    return ring(count, 1.0).system, (q, np.zeros(count))


def _mesh(density: str, count: int) -> tuple[Any, Start]:
    """Return a density on a Fourier mesh of a circle of circumference 2 pi, at rest at u = sin(x)/2."""
    space: Any = {"name": "wave", "fields": ["u"], "space": {"x": ("0", "2*pi")}, "boundary": {"x": "periodic"}}
    mesh = FieldSystem.from_text(**space, density=DENSITIES[density]).discretise("fourier", points=count)
    start = np.sin(mesh.points["x"]) / 2
    return mesh.system, (start, np.zeros(count))


def run_transforms(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure leapfrog on Fourier meshes, beside leapfrog by hand with SciPy's transforms."""
    rows = []
    for name, count in itertools.product(DENSITIES, TRANSFORMED[: 1 if plan.quick else None]):
        report_activity(f"transforms: {name}, {count} points")
        system, (q, velocity) = _mesh(name, count)
        h, steps = 1.0 / count, 200 if plan.quick else 500_000 // count
        run = compile_stepper(system, "stoermer-verlet").start(q, velocity=velocity, h=h)
        ours = shortest(functools.partial(run.advance, steps), plan)
        run = compile_stepper(system, "stoermer-verlet").start(q, velocity=velocity, h=h)
        run.advance(steps)
        by_hand = functools.partial(_spectral_leapfrog, name, q, h, steps)
        other = shortest(by_hand, plan)
        both = {"here_us": 1e6 * ours / steps, "scipy_us": 1e6 * other / steps, "ratio": other / ours}
        rows.append({"density": name, "points": count} | both | {"difference": float(np.abs(run.q - by_hand()).max())})
    return ResultTable(
        name="transforms",
        title="microseconds a step of leapfrog on Fourier meshes, here and by hand with SciPy's rfft and irfft",
        columns={"density": "", "points": "d"}
        | dict.fromkeys(("here_us", "scipy_us", "ratio"), ".3g")
        | {"difference": ".0e"},
        rows=tuple(rows),
    )


def _spectral_leapfrog(name: str, q: Array, h: float, steps: int) -> Array:
    """Return the positions after leapfrog steps from rest, with derivatives by SciPy's transforms."""
    k = 1j * np.fft.rfftfreq(len(q), 1.0 / len(q))
    k[-1] = 0.0  # the derivative of the highest mode vanishes at the points
    squared = k**2

    def force(u: Array) -> Array:
        if name == "sine-Gordon":
            return cast("Array", scipy.fft.irfft(squared * scipy.fft.rfft(u), len(u)) - np.sin(u))
        gradient = scipy.fft.irfft(k * scipy.fft.rfft(u), len(u))
        return cast("Array", scipy.fft.irfft(k * scipy.fft.rfft(gradient / np.sqrt(1.0 + gradient**2)), len(u)))

    u, v = q.copy(), h / 2 * force(q)
    for _ in range(steps):
        u += h * v
        v += h * force(u)
    return u


STIFF: dict[str, tuple[Callable[[], tuple[Any, Start]], float]] = {
    "ring of 1000": (lambda: _long_wave(1000), 2.0),
    "sine-Gordon field, 256 x 256": (lambda: _lattice(field(256, 1.0)), 20.0 * 2.0**0.5),
    **{
        f"{name}, Fourier, {count}": (functools.partial(_mesh, name, count), count / 2)
        for name, count in itertools.product(DENSITIES, TRANSFORMED[:3])
    },
}
"""Systems with their initial states, and the highest frequencies of their linear parts."""


def run_newton(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the fixed-point iteration and Newton's method at large step sizes."""
    rows = []
    for name, (make, frequency) in itertools.islice(STIFF.items(), 1 if plan.quick else None):
        report_activity(f"newton: {name}")
        system, (q, velocity) = make()
        solvers = {by: compile_stepper(system, "svi:4", solver=by) for by in ("fixed-point", "newton")}
        exact: Array = np.empty(0)
        for large in LARGE:
            count, row = max(2, (20 if plan.quick else 300) // large), dict[str, Any](system=name, h_omega=large)
            for by, stepper in solvers.items():
                how: dict[str, Any] = {"h": large / frequency, "steps": count, "save_every": count}
                work = functools.partial(stepper.integrate, q, velocity=velocity, check_growth=False, **how)
                try:
                    run, seconds = work(), shortest(work, plan)
                except StepFailedError:
                    continue
                row |= {
                    f"{by}_iterations": float(np.sum(run.iterations)) / count,
                    f"{by}_ns": 1e9 * seconds / count / q.size,
                }
                end = run.q[-1].ravel()
                exact = end if not exact.size else exact
                row["difference"] = float(np.abs(end - exact).max() / np.abs(exact).max())
            rows.append(row)
    timing = {f"{by}_{each}": form for by in solvers for each, form in (("iterations", ".1f"), ("ns", ".3g"))}
    return ResultTable(
        name="newton",
        title="nanoseconds per coordinate and step of SVI(4) by the fixed-point iteration and by Newton's method",
        columns={"system": "", "h_omega": "g"} | timing | {"difference": ".0e"},
        rows=tuple(rows),
        remarks=(
            "h omega: step size times the highest frequency of the linear part. iterations: per step. difference: of",
            "the final positions, to the smallest step. -: failed.",
        ),
    )


def run_derivatives(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure runs alone, with tangent vectors and with a gradient."""
    rows = []
    for (name, (problem, h)), by in itertools.product(DIFFERENTIATED.items(), ("svi:4", "svi:8")):
        if plan.quick and (name, by) != ("Kepler", "svi:4"):
            continue
        report_activity(f"derivatives: {name}, {by}")
        rows.append({"problem": name, "method": by, "h": h} | _derived(case(problem), by, h, plan))
    return ResultTable(
        name="derivatives",
        title="microseconds a step: alone, with one tangent vector, each further one, the gradient of one function",
        columns={"problem": "", "method": "", "h": "g"}
        | dict.fromkeys(("step", "tangent", "further", "pullback"), ".3g"),
        rows=tuple(rows),
        remarks=(f"runs of {DERIVED_STEPS} saved steps, from Python; tangent contains the run, pullback does not.",),
    )


def _derived(chosen: Case, by: str, h: float, plan: Plan) -> dict[str, float]:
    """Return the times of a step of a run, with its derivatives, in microseconds."""
    stepper = compile_stepper(chosen.system, by)
    q, p = chosen.q[0], momenta_of(stepper, chosen)[0]
    how: dict[str, Any] = {"h": h, "steps": DERIVED_STEPS, "check_growth": False}
    basis = np.eye(2 * chosen.dimension)
    few, many = basis[:, :1], basis[:, :4]

    def tangent(directions: Array) -> float:
        return shortest(lambda: stepper.integrate(q, p, **how).tangent(directions), plan)

    run = stepper.integrate(q, p, **how)
    cotangents = np.zeros((len(run.q), len(basis)))
    cotangents[-1, 0] = 1.0
    for directions in (few, many):  # compiled on first use
        run.tangent(directions)
    run.pullback(cotangents)
    alone = shortest(lambda: stepper.integrate(q, p, **how), plan)
    first, more = tangent(few), tangent(many)
    times = {
        "step": alone,
        "tangent": first,
        "further": (more - first) / (many.shape[1] - 1),
        "pullback": shortest(lambda: run.pullback(cotangents), plan),
    }
    return {name: 1e6 * seconds / DERIVED_STEPS for name, seconds in times.items()}


def run_builds(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure one source built by the installed compilers for several processors."""
    rows = []
    for command, target in itertools.product(BUILDS, TARGETS[-1:] if plan.quick else TARGETS):
        if shutil.which(command) is not None:
            report_activity(f"builds: {command}, {target}")
            arguments = [sys.executable, "-m", "benchmarks.steps", target, str(plan.rounds), str(int(plan.quick))]
            environment = os.environ | {"CC": command}
            output = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True).stdout
            rows.append({"compiler": command, "target": target} | json.loads(output))
    names = [f"{name}_{by}" for name in BUILT for by in ("svi:4", "svi:8")]
    return ResultTable(
        name="builds",
        title="microseconds a step by compiler and -march; portable: the flags of generated packages",
        columns={"compiler": "", "target": ""} | dict.fromkeys(names, ".3g"),
        rows=tuple(rows),
    )


def built_steps(target: str, plan: Plan) -> dict[str, float]:
    """Return the times of a step in microseconds with this process's compiler, by case and method."""
    tuned = tuple(f"-march={target}" if flag.startswith("-march") else flag for flag in TUNED_FLAGS)
    flags, result = PORTABLE_FLAGS if target == "portable" else tuned, {}
    chosen: Iterable[Case] = map(case, BUILT)
    for each, by in itertools.product(chosen, ("svi:4", "svi:8")):
        stepper = compile_stepper(each.system, by, flags=flags)
        run = stepper.start(each.q[0], momenta_of(stepper, each)[0], h=each.step)
        count = 100 if plan.quick else 10_000
        result[f"{each.name}_{by}"] = 1e6 * shortest(functools.partial(run.advance, count), plan) / count
    return result


if __name__ == "__main__":
    build, rounds, quick = sys.argv[1:]
    print(json.dumps(built_steps(build, Plan(repeats=int(rounds), quick=quick == "1"))))
