"""Threads that share the steps of array systems: no bit depends on their number, and every term is counted once."""

import os
import signal
import subprocess
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from notation import hamilton, lagrange
from programs import needs

import scvi_codegen as sc
from scvi_codegen.codegen.lowering.program import lower_arrays
from scvi_codegen.codegen.native.compilers import find_compiler
from scvi_codegen.codegen.pipeline import ArraySources
from scvi_codegen.codegen.rendering.kernels.loop_nests import Sharing, sharing_of
from scvi_codegen.runs.stepping.array_envelope import envelope_of

RNG = np.random.default_rng(5)
THREADS = (1, 2, 3, 5)
BONDS = RNG.integers(0, 1500, size=(3000, 2))
PINS = RNG.integers(0, 300, size=7)


@dataclass(frozen=True)
class Case:
    """A potential, how its terms are shared, and its forces by NumPy."""

    coordinates: str
    potential: str
    shape: tuple[int, ...]
    shared: Sharing
    forces: Callable[[Any], Any]
    given: dict[str, Any] = field(default_factory=dict)


def scattered(*parts: tuple[Any, Any]) -> Callable[[Any], Any]:
    """Adds up values at places that may occur more than once."""

    def add(q: Any) -> Any:
        total = np.zeros_like(q)
        for places, values in parts:
            np.add.at(total, places, values(q))
        return total

    return add


def ring(q: Any) -> Any:
    cubes = (np.roll(q, -1) - q) ** 3
    return cubes - np.roll(cubes, 1) - np.roll(q, -3) - np.roll(q, 3)


def plane(u: Any) -> Any:
    cubes = (np.roll(u, -2, axis=0) - u) ** 3
    return cubes - np.roll(cubes, 2, axis=0) - u


def pairs(q: Any) -> Any:
    partials = np.sin(q[:, None] - q[None, :]) / len(q)
    return partials.sum(axis=1)


def transposed(u: Any) -> Any:
    return -(u.T**2) - 2 * u * u.T


LINES, COLUMNS = BONDS.T
CASES = {
    "ring": Case("q[N]", "sum(i in N periodic, (q[i+1] - q[i])**4/4 + q[i-1]*q[i+2])", (9000,), Sharing.IN_TURN, ring),
    "plane": Case(
        "q[N, M]",
        "sum(i in N periodic, j in M, (q[i+2, j] - q[i, j])**4/4 + q[i, j]**2/2)",
        (90, 70),
        Sharing.IN_TURN,
        plane,
    ),
    "pairs": Case("q[N]", "sum(i < j in N, cos(q[i] - q[j])/N)", (210,), Sharing.IN_TILES, pairs),
    "few pairs": Case("q[N]", "sum(i < j in N, cos(q[i] - q[j])/N)", (66,), Sharing.IN_TILES, pairs),
    "net": Case(
        "q[N]",
        "sum(b in B, (q[bonds[b, 0]] - q[bonds[b, 1]])**4/4)",
        (1500,),
        Sharing.BY_PLACES,
        scattered(
            (LINES, lambda q: -((q[LINES] - q[COLUMNS]) ** 3)), (COLUMNS, lambda q: (q[LINES] - q[COLUMNS]) ** 3)
        ),
        {"tables": {"bonds": BONDS}},
    ),
    "pins": Case(
        "q[N]",
        "sum(i in N, c in P, q[i]**2*q[pins[c]]/8)",
        (3000,),
        Sharing.BY_PLACES,
        scattered(
            (slice(None), lambda q: -q * q[PINS].sum() / 4), (PINS, lambda q: np.full(len(PINS), -(q**2).sum() / 8))
        ),
        {"tables": {"pins": PINS}},
    ),
    "transposed": Case("q[N, N]", "sum(i in N, j in N, q[i, j]*q[j, i]**2)", (60, 60), Sharing.BY_PLACES, transposed),
}


def system_of(case: Case) -> sc.LagrangianSystem:
    """Return a system with unit masses."""
    axes = "i in N, j in N" if "N, N" in case.coordinates else "i in N, j in M" if "M" in case.coordinates else "i in N"
    velocity = "q_dot[i, j]" if "j" in axes else "q_dot[i]"
    return sc.LagrangianSystem.from_text(
        name="shared",
        coordinates=[case.coordinates],
        tables=[each for each in ("bonds[B, 2]", "pins[P]") if each.split("[")[0] in case.potential],
        lagrangian=f"sum({axes}, {velocity}**2/2) - {case.potential.replace('/N', '/size')}",
        parameters={"size": case.shape[0]},
    )


@cache
def stepper_of(name: str, method: str, solver: str = "fixed-point") -> sc.Stepper:
    return sc.compile_stepper(system_of(CASES[name]), method, solver=solver)


def start_of(name: str) -> Any:
    return 0.3 * np.sin(1.0 + np.arange(np.prod(CASES[name].shape)) ** 1.3).reshape(CASES[name].shape)


def bits(run: Any) -> tuple[Any, ...]:
    """All that must not depend on the number of threads."""
    states = (values.tobytes() for values in (*run.q.values(), *run.p.values()))
    return (*states, np.sum(run.iterations), run.steps, run.rejected_steps, repr(run.step_error))


@pytest.mark.parametrize("name", CASES)
def test_terms_are_distributed_over_threads(name: str) -> None:
    system = system_of(CASES[name])
    program = lower_arrays(system, sc.as_method("svi:2"), prefix="shared")
    assert {sharing_of(rolled) for rolled in program.loops.forces} == {CASES[name].shared}


@pytest.mark.tiers(2, 3)
@pytest.mark.sampled(5)
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("name", CASES)
def test_every_term_is_counted_once(name: str, threads: int) -> None:
    """A leapfrog step compared with one by NumPy's forces."""
    case, q, h = CASES[name], start_of(name), 1e-3
    run = stepper_of(name, "stoermer-verlet").integrate(q, h=h, steps=1, threads=threads, **case.given)
    there = q + h * (h / 2 * case.forces(q))
    kick = h / 2 * (case.forces(q) + case.forces(there))
    np.testing.assert_allclose(run.q["q"][1], there, rtol=0, atol=2e-16 * 4)
    np.testing.assert_allclose(run.p["q"][1], kick, rtol=0, atol=2e-15 * np.abs(kick).max())


FEW = {"h": 0.01, "steps": 4}


@pytest.mark.tiers(2, 3)
@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("name", "method", "plan"),
    [(name, "stoermer-verlet", FEW) for name in CASES]
    + [(name, "svi:4", FEW) for name in ("ring", "pairs", "net")]
    + [("pairs", "svi:4", {"t_end": 3.0, "tolerance": 1e-9})],
)
def test_results_do_not_depend_on_the_number_of_threads(name: str, method: str, plan: dict[str, Any]) -> None:
    found = [
        bits(stepper_of(name, method).integrate(start_of(name), **plan, threads=threads, **CASES[name].given))
        for threads in THREADS
    ]
    assert found[1:] == found[:1] * (len(THREADS) - 1)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("sums", "method"),
    [
        ("compensated", sc.StoermerVerlet()),
        ("compensated", sc.StoermerVerlet("drift-kick-drift")),
        ("compensated", sc.Composition(4)),
        ("plain", sc.StoermerVerlet("drift-kick-drift")),  # of steps that end with a kick, two kicks become one
    ],
)
def test_steps_together_are_those_one_by_one(sums: str, method: Any) -> None:
    """Up to a failure, whose step is left out: rings of one and of several blocks, with a wave that steepens."""
    text = "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**3/3) - sum(i in N, q[i]**2/2)"
    system = sc.LagrangianSystem.from_text(name="steep", coordinates=["q[N]"], lagrangian=text)
    stepper = sc.compile_stepper(system, method, sums=sums)
    for count in (700, 5000):
        q, ends = 0.3 * np.sin(1.0 + np.arange(count) ** 1.3), []
        for at_once, threads in ((1, 1), (7, 2), (10**6, 1), (10**6, 3)):
            run = stepper.start(q, h=0.1, threads=threads)
            with pytest.raises(sc.StepFailedError, match=r"infinite or NaN|term overflows"):
                deque(map(run.advance, repeat(at_once)), maxlen=0)
            ends.append((run.steps, run.t, np.asarray(run.q).tobytes(), np.asarray(run.p).tobytes()))
        assert 33 < ends[0][0] < 10**4
        assert ends[1:] == ends[:1] * 3


def leapfrog(q: Any, v: Any, h: float, steps: int, forces: Callable[[Any], Any]) -> Any:
    """Return the positions after steps of Stoermer-Verlet with unit masses, by NumPy in extended precision."""
    q, v = q.astype(np.longdouble), v.astype(np.longdouble)
    for _ in range(steps):
        v = v + h / 2 * forces(q)
        q = q + h * v
        v = v + h / 2 * forces(q)
    return q.astype(float)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("before", ["", " - sum(i in N, q[i]**4/4)"])
@pytest.mark.parametrize("boundary", ["periodic", "free"])
@pytest.mark.parametrize("sums", ["compensated", "plain"])
def test_coordinates_are_continued_behind_their_last_force(sums: str, boundary: str, before: str) -> None:
    """In chunks, ends and blocks of all sizes; two threads keep the forces of 1500 coordinates."""
    span = "N periodic" if boundary == "periodic" else "N-1"
    text = f"sum(i in N, q_dot[i]**2/2){before} - sum(i in {span}, (q[i+1] - q[i])**4/4 + (q[i+1] - q[i])**2/2)"
    system = sc.LagrangianSystem.from_text(name="chain", coordinates=["q[N]"], lagrangian=text)
    stepper = sc.compile_stepper(system, "stoermer-verlet", sums=sums)

    def forces(q: Any) -> Any:
        d = np.roll(q, -1) - q
        pull = d**3 + d
        pull[-1] *= boundary == "periodic"
        return pull - np.roll(pull, 1) - q**3 * bool(before)

    for count in (2, 3, 7, 8, 9, 33, 513, 1000, 1500, 2100):
        q, v = np.random.default_rng(count).normal(size=(2, count))
        runs = [stepper.start(q, velocity=v, h=0.02, threads=threads) for threads in (1, 2)]
        for run in runs:
            run.advance(50)
        if sums == "compensated":
            assert [np.asarray(run.p).tobytes() for run in runs] == [np.asarray(runs[0].p).tobytes()] * 2
        for run in runs:
            np.testing.assert_allclose(run.q, leapfrog(q, v, 0.02, 50, forces), rtol=0, atol=4e-14)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("along", ["M periodic", "0..M-2"])
@pytest.mark.parametrize("sums", ["compensated", "plain"])
def test_forces_on_a_torus_and_on_a_cylinder_are_those_of_numpy(sums: str, along: str) -> None:
    """Springs with strengths, cubic ones along rows: from one element to several blocks, positions changed in place."""
    text = f"sum(i in N periodic, j in {along}, s[i]*(u[i+1, j] - u[i, j])**2/2 + (u[i, j+1] - u[i, j])**4/4)"
    kinetic = "sum(i in N, j in M, u_dot[i, j]**2/2 + cos(u[i, j]))"
    system = lagrange("torus", ["u[N, M]"], f"{kinetic} - {text}", parameters={"s[N]": 1})
    stepper = sc.compile_stepper(system, "stoermer-verlet", sums=sums)
    for shape in ((1, 1), (1, 4), (2, 1), (2, 2), (3, 7), (21, 33), (70, 90)):
        q, v = np.random.default_rng(shape[0]).normal(size=(2, *shape))
        s, bound = np.arange(1.0, shape[0] + 1)[:, None] / shape[0], np.full(shape[1], 1.0)
        bound[-1] = along == "M periodic"

        def forces(u: Any, s: Any = s, bound: Any = bound) -> Any:
            across, pull = s * bound * (np.roll(u, -1, axis=0) - u), bound * (np.roll(u, -1, axis=1) - u) ** 3
            return across - np.roll(across, 1, axis=0) + pull - np.roll(pull, 1, axis=1) - np.sin(u)

        for threads in (1, 2):
            run = stepper.start(q, velocity=v, h=0.02, threads=threads, parameters={"s": s[:, 0]})
            run.advance(50)
            np.testing.assert_allclose(np.reshape(run.q, shape), leapfrog(q, v, 0.02, 50, forces), rtol=0, atol=4e-14)


@pytest.mark.second
def test_energies_of_lattices_whose_forces_are_complete_at_once_are_those_of_numpy() -> None:
    """The entries of a term are not those of its forces, which reach in both directions."""
    couplings = "(u[i+1, j] - u[i, j])**2/2 + (u[i, j+1] - u[i, j])**2/2", "s[i]*u[i, j]**2*u[i+1, j]/3"
    text = "".join(f" - sum(i in N periodic, j in M periodic, {coupling})" for coupling in couplings)
    system = lagrange("plane", ["u[N, M]"], f"sum(i in N, j in M, u_dot[i, j]**2/2){text}", parameters={"s[N]": 1})
    u, v, s = np.random.default_rng(0).normal(size=(3, 5, 4))
    stepper = sc.compile_stepper(system, "stoermer-verlet")
    run = stepper.integrate({"u": u}, velocity={"u": v}, h=0.01, steps=1, parameters={"s": s[:, 0]})
    next_u, s = np.roll(u, -1, axis=0), s[:, :1]
    potential = (next_u - u) ** 2 / 2 + (np.roll(u, -1, axis=1) - u) ** 2 / 2 + s * u**2 * next_u / 3
    assert run.energy()[0] == pytest.approx((v**2 / 2 + potential).sum(), rel=1e-14)


@pytest.mark.rotated
def test_hamiltonians_and_velocity_dependent_forces_with_threads() -> None:
    text = "sum(i in N periodic, ((q[i+1] - q[i])**2 + (p[i+1] - p[i])**2)/2 - (q[i]**2 + p[i]**2)**2/4)"
    field = hamilton("field", "q[N]", text, momenta="p[N]")
    text = "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2)"
    damped = lagrange("damped", "q[N]", text, forces={"q[i]": "-q_dot[i]**3", "q[0]": "cos(t)"})
    for system, method in ((field, "gauss:4"), (damped, "svi:4")):
        stepper, q = sc.compile_stepper(system, method), np.sin(0.1 * np.arange(5000))
        found = [bits(stepper.integrate(q, np.cos(0.2 * q), h=0.1, steps=4, threads=threads)) for threads in THREADS]
        assert found[1:] == found[:1] * (len(THREADS) - 1)


@pytest.mark.rotated
def test_interrupt_ends_a_run_between_steps() -> None:
    run = stepper_of("pairs", "svi:4").start(start_of("pairs"), h=0.001, threads=3)

    def interrupt(done: int) -> None:
        if done > 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run.advance(10**9, progress=interrupt)
    stopped = run.steps
    run.advance(2)
    assert run.steps == stopped + 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
def test_forked_process_has_separate_threads() -> None:
    stepper, q = stepper_of("pairs", "svi:4"), start_of("pairs")
    expected = bits(stepper.integrate(q, h=0.01, steps=3, threads=3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of JAX, where another test has imported it
        child = os.fork()
    if child == 0:
        os._exit(int(bits(stepper.integrate(q, h=0.01, steps=3, threads=3)) != expected))
    assert os.waitpid(child, 0)[1] == 0


def test_invalid_thread_counts_are_rejected() -> None:
    stepper, q = stepper_of("ring", "svi:4"), start_of("ring")
    for threads in (0, -1, 65):
        with pytest.raises(sc.StateError, match="threads"):
            stepper.start(q, h=0.1, threads=threads)
    text = "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2)"
    rods = lagrange("rods", ["r[N, 2]"], text, constraints=["sum(a in 2, r[i, a]**2) = 1 for i in N"])
    with pytest.raises(sc.MethodError, match="the step uses one"):
        sc.compile_stepper(rods, "stoermer-verlet").start(np.array([[1.0, 0.0]]), h=0.1, threads=2)


RACES = """
#include <stdlib.h>
#include "shared.h"
enum {{ N = {count} }};
static const int bonds[] = {{{bonds}}}, pattern[] = {{{pattern}}};
static double start[2 * N];
static double t[{steps}], q[{steps} * N], p[{steps} * N];
static int iterations[{steps}];
int main(void)
{{
  const long long sizes[] = {{{sizes}}};
  const int *const tables[] = {{{tables}0}};
  const double parameters[] = {{N}};
  char *const memory = calloc((size_t)shared_memory(sizes, tables) + 8, sizeof(double));
  shared_run *run = shared_bind(sizes, tables, (double *)(void *)(memory + 63 - ((size_t)memory + 63) % 64));
  for (int i = 0; i < N; i++)
    start[i] = 0.3 * (i * 37 % 101) / 101.0;
  shared_start(run, 0.0, 0.01, start, start + N);
  run->threads = {threads};
  return shared_advance(run, {steps}, 1, parameters, 0, t, q, p, iterations, 0, 0);
}}
"""


def program(name: str, method: str, solver: str, folder: Path, **numbers: int) -> None:
    """Write the source of a run with threads, and the C program that makes it."""
    source, interface = ArraySources(system_of(CASES[name]), sc.as_method(method), solver, "shared").integrator()
    for path, text in source.files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    sizes, layout, envelope = {"N": CASES[name].shape[0], "B": len(BONDS)}, interface.layout, None
    if solver == "newton":
        envelope = envelope_of(layout, stepper_of(name, method, solver).start(start_of(name), h=0.01).stepper.problem)
    texts = {
        "count": sizes["N"],
        "bonds": ", ".join(map(str, BONDS.reshape(-1))),
        "pattern": "0" if envelope is None else ", ".join(map(str, envelope.pattern)),
        "tables": "bonds, " * bool(layout.tables) + "pattern, " * (envelope is not None),
        "sizes": ", ".join(str(sizes[size]) for size in layout.sizes),
    }
    (folder / "main.c").write_text(RACES.format(**texts, **numbers))


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "method", "solver"),
    [(name, method, "fixed-point") for name in ("ring", "pairs", "net") for method in ("svi:4", "stoermer-verlet")]
    + [("ring", "svi:4", "newton")],
)
def test_threads_have_no_data_races(name: str, method: str, solver: str, tmp_path: Path) -> None:
    """The thread sanitizer is used if the compiler has it."""
    needs("setarch")
    program(name, method, solver, tmp_path, threads=3, steps=4)
    flags = ["-std=c99", "-O1", "-g", "-fsanitize=thread", "-DSCVI_THREADS", "-pthread", "-Wno-psabi"]
    command = [*find_compiler(), *flags, "main.c", "shared.c", "-lm", "-o", "main"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    if built.returncode:
        pytest.skip(f"no thread sanitizer: {built.stderr[-200:]}")
    done = subprocess.run(["setarch", "-R", "./main"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.rotated
def test_newton_iteration_with_threads() -> None:
    """The last bits of a large step from q = 0 depend on the order in which inner products are summed."""
    stepper, start = stepper_of("ring", "svi:2", "newton"), start_of("ring")
    found = [bits(stepper.integrate(start, h=0.2, steps=3, threads=threads)) for threads in THREADS]
    assert found[1:] == found[:1] * (len(THREADS) - 1)
    one, two = (
        bits(stepper.integrate(np.zeros(2000), 3.0 * start[:2000], h=0.7, steps=1, threads=threads))
        for threads in THREADS[:2]
    )
    assert one == two
