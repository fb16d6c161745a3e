"""Heat baths: time of a step, and bias of averages, beside OpenMM, a JAX scan and diffrax where they are installed."""

import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.integrate import quad

from benchmarks.report import ResultTable
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen.extras.fits.averages import average
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.systems.lagrangian import LagrangianSystem

WELL = "(q**2 - 1)**2 + q/2"
TRAJECTORIES, FEW = 100_000, 1_000
ATOMS_PER_SIDE, DENSITY, STEP = 10, 0.8442, 0.004
DISTANCE = "sum(a in 3, wrap(r[i, a] - r[j, a], box)**2)"
BIASED = (("stoermer-verlet", 0.1), ("stoermer-verlet", 0.2), ("composition:4", 0.2), ("composition:4", 0.4))
"""Methods and step sizes whose bias is measured."""
Samples = Callable[[], Any]
"""Function that integrates, and returns values of q, (n, k), or nothing."""


def _force(q: Any) -> Any:
    return -4 * q * (q * q - 1) - 0.5


def _our_well(method: str, h: float, steps: int, count: int, every: int) -> Samples:
    system = LagrangianSystem.from_text(
        name="warm well", coordinates=["q"], lagrangian=f"q_dot**2/2 - ({WELL})", damping=1, temperature=1
    )
    stepper, zeros = compile_stepper(system, method), np.zeros((count, 1))
    return lambda: stepper.integrate_ensemble(zeros, zeros, h=h, steps=steps, save_every=every, seed=1)


def _jax_well(h: float, steps: int, count: int) -> Samples:
    """Return the same splitting, O(h/2) Verlet O(h/2), as a scan in double precision."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    decay, strength = np.exp(-h / 2), np.sqrt(-np.expm1(-h))

    def step(state: Any, key: Any) -> Any:
        q, p = state
        first, second = jax.random.normal(key, (2, count))
        p = decay * p + strength * first + h / 2 * _force(q)
        q = q + h * p
        return (q, decay * (p + h / 2 * _force(q)) + strength * second), None

    zeros = jnp.zeros(count)
    scan = jax.jit(lambda key: jax.lax.scan(step, (zeros, zeros), jax.random.split(key, steps))[0])
    return lambda: jax.block_until_ready(scan(jax.random.PRNGKey(1)))


def _diffrax_well(h: float, steps: int, count: int) -> Samples:
    """Return Heun's method of diffrax with a virtual Brownian tree for each trajectory."""
    import diffrax
    import jax
    import jax.numpy as jnp

    def solve(key: Any) -> Any:
        noise = diffrax.VirtualBrownianTree(0, h * steps, tol=h / 2, shape=(1,), key=key)
        drift = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], _force(y[0]) - y[1]]))
        diffusion = diffrax.ControlTerm(lambda t, y, args: jnp.array([[0.0], [np.sqrt(2.0)]]), noise)
        terms, heun = diffrax.MultiTerm(drift, diffusion), diffrax.Heun()
        return diffrax.diffeqsolve(terms, heun, 0, h * steps, h, jnp.zeros(2), max_steps=2 * steps).ys

    solved = jax.jit(jax.vmap(solve))
    return lambda: jax.block_until_ready(solved(jax.random.split(jax.random.PRNGKey(1), count)))


def _liquids(steps: int) -> Iterator[tuple[str, Samples]]:
    """Yield runs of a thousand Lennard-Jones atoms, of which the first is ours."""
    count, box = ATOMS_PER_SIDE**3, ATOMS_PER_SIDE / DENSITY ** (1 / 3)
    grid = (np.stack(np.meshgrid(*[np.arange(ATOMS_PER_SIDE)] * 3), -1).reshape(-1, 3) + 0.5) * box / ATOMS_PER_SIDE
    liquid = LagrangianSystem.from_text(
        name="warm liquid",
        coordinates=["r[N, 3]"],
        parameters={"box": box, "cut": 2.5},
        neighbours={"near": {"of": "r", "cutoff": "cut", "box": "box", "skin": 0.3}},
        lagrangian="sum(i in N, sum(a in 3, r_dot[i, a]**2)/2)"
        f"- sum(i < j in near, 4*({DISTANCE}**-6 - {DISTANCE}**-3))",
        damping=1,
        temperature=1,
    )
    run = compile_stepper(liquid, "stoermer-verlet").start(grid, np.zeros((count, 3)), h=STEP)
    yield "ours, Verlet", lambda: run.advance(steps)
    if find_spec("openmm"):
        import openmm

        force, system = openmm.NonbondedForce(), openmm.System()
        force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
        force.setCutoffDistance(2.5)
        force.setUseDispersionCorrection(False)
        for _ in range(count):
            force.addParticle(0.0, 1.0, 1.0)
            system.addParticle(1.0)
        system.setDefaultPeriodicBoxVectors(*(box * np.eye(3)))
        system.addForce(force)
        integrator = openmm.LangevinMiddleIntegrator(1 / 0.00831446261815324, 1.0, STEP)  # kT = 1 kJ/mol
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"), {"Threads": "1"})
        context.setPositions(grid)
        yield "OpenMM, LangevinMiddle", lambda: context.getIntegrator().step(steps)


def _seconds(work: Samples, rounds: int) -> float:
    """Return the shortest wall time of a call, after one that compiles or brings the liquid to its temperature."""
    work()
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def run_bath(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure a double well of 10^5 trajectories, a liquid of 1000 atoms, and the bias of <q^2> in the well."""
    count, steps = (FEW, 20) if plan.quick else (TRAJECTORIES, 200)
    report_activity("bath: double well")
    timed = [("ours, Verlet", _our_well("stoermer-verlet", 0.1, steps, count, steps), count)]
    if find_spec("jax"):
        timed.append(("JAX scan", _jax_well(0.1, steps, count), count))
    if find_spec("diffrax"):
        timed.append(("diffrax, Heun", _diffrax_well(0.1, steps, FEW), FEW))
    times = [(each, 1e9 * _seconds(work, plan.rounds) / steps / size) for each, work, size in timed]
    rows: list[dict[str, Any]] = [
        {"system": "double well", "integrator": name, "h": 0.1, "ns": ns} for name, ns in times
    ]
    report_activity("bath: liquid")
    steps = 5 if plan.quick else 250
    times = [(name, 1e9 * _seconds(work, plan.rounds) / steps / ATOMS_PER_SIDE**3) for name, work in _liquids(steps)]
    rows += [{"system": "liquid", "integrator": name, "h": STEP, "ns": ns} for name, ns in times]
    ours: dict[str, float] = {}
    for row in rows:
        row["ratio"] = row["ns"] / ours.setdefault(row["system"], row["ns"])
    moments = [quad(lambda x, k=k: x**k * np.exp(-((x**2 - 1) ** 2) - x / 2), -6, 6)[0] for k in (0, 2)]
    for method, h in BIASED:
        report_activity(f"bath: bias of {method}")
        runs = _our_well(method, h, 4 * round(100 / h), FEW if plan.quick else 20_000, 4)()
        mean, error, _ = average(runs, runs.q[..., 0] ** 2)
        row = {"system": "double well", "integrator": f"ours, {method}", "h": h}
        rows.append(row | {"bias": mean - moments[1] / moments[0], "error": error})
    return ResultTable(
        name="bath",
        title="nanoseconds per step, and degree of freedom or atom, relative to ours; bias of <q^2> and standard error",
        columns={"system": "", "integrator": "", "h": "g", "ns": ".3g", "ratio": ".3g", "bias": ".1e", "error": ".1e"},
        rows=tuple(rows),
    )
