"""Programs whose results are compared bit by bit with those of the C sources recorded in ``sources.json.xz``.

A cell is a system, a method and a kind of run. Its recorded source and the one that the package generates now are
compiled with the same flags on the same machine and run by the same steps, so that no recorded number depends on libm.
"""

import json
import lzma
import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import samples
from golden_drivers import arrays_driver, ensemble_driver, run_driver, tangent_driver
from golden_scenes import SCENES
from notation import hamilton, lagrange

from scvi_codegen import HamiltonianSystem, LagrangianSystem, as_method, problem, reparametrise
from scvi_codegen.codegen.ir.variants import Derivatives, Lanes, NewtonFallback
from scvi_codegen.codegen.native.compilers import find_compiler
from scvi_codegen.codegen.pipeline import ArraySources, Sources, generate_source
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.system import MechanicalSystem

RECORDED = Path(__file__).parents[1] / "golden" / "sources.json.xz"
FLAGS = ("-std=gnu99", *samples.UNOPTIMISED, "-ffp-contract=off", "-w", "-DSCVI_THREADS", "-pthread")
"""Neither contraction nor other freedoms: the bits do not depend on the level of optimisation."""


@dataclass(frozen=True)
class Program:
    """C source of an integrator in one file, its header, and a main program; those of a search for events, if any."""

    prefix: str
    header: str
    code: str
    main: str
    search_header: str = ""
    search: str = ""

    @property
    def files(self) -> dict[str, str]:
        files = {f"{self.prefix}.h": self.header, f"{self.prefix}.c": self.code, "main.c": self.main}
        searches = {f"{self.prefix}_events.h": self.search_header, f"{self.prefix}_events.c": self.search}
        return files | (searches if self.search else {})


def of_source(source: Source | None, main: str) -> Program:
    """Return the program in one file."""
    assert source is not None
    whole = source.amalgamated()
    texts = (whole.header, whole.code, main, *((whole.beside.header, whole.beside.code) if whole.beside else ()))
    return Program(whole.prefix, *map(plain, texts))


def sources_of(
    system: MechanicalSystem, method: str, prefix: str, solver: str, time_transformation: str | None
) -> Sources:
    return Sources(system, as_method(method, system), solver, prefix, (), time_transformation)


Made = tuple[Source | None, str]
"""Source of an integrator, and a main program."""


def single(
    name: str,
    system: Callable[[], MechanicalSystem],
    *,
    method: str,
    q: tuple[float, ...],
    p: tuple[float, ...],
    h: float,
    steps: int = 1000,
    kind: str = "fixed",
    solver: str = "auto",
    time_transformation: str | None = None,
    tolerance: float = 0.0,
    t_end: float = 20.0,
) -> Made:
    """A run of a system with named coordinates."""
    found = system()
    sources = sources_of(found, method, name, solver, time_transformation)
    parameters = found.defaults
    if kind == "ensemble":
        source = sources.variant(Lanes())
        return source, ensemble_driver(f"{name}_ensemble", q, p, parameters, h, steps)
    if kind in ("tangent", "second"):
        second = kind == "second"
        source = sources.variant(Derivatives(order=2 if second else 1))
        return source, tangent_driver(source.prefix, q, p, parameters, h, 4, second=second)
    if kind == "embedded":
        source = generate_source(found, as_method(method, found), prefix=name, embedded="double")[0]
        return source, run_driver(name, q, p, parameters, h, steps)
    if kind == "adaptive":
        source = sources.integrator()[0]
        transformed = time_transformation is not None
        adaptive = {"t_end": t_end, "tolerance": tolerance, "transformed": transformed}
        return source, run_driver(name, q, p, parameters, h, steps, **adaptive)
    source = sources.variant(NewtonFallback()) or sources.integrator()[0]
    return source, run_driver(name, q, p, parameters, h, steps)


def arrays(
    name: str,
    system: Callable[[], ArraySystem],
    *,
    method: str,
    sizes: tuple[int, ...],
    h: float,
    steps: int = 1000,
    solver: str = "fixed-point",
    adaptive: bool = False,
    threads: int = 0,
    tolerance: float = 0.0,
    tables: tuple[tuple[int, ...], ...] = (),
    constrained: bool = False,
) -> Made:
    """A run of a system with array coordinates."""
    found = system()
    sources = ArraySources(found, as_method(method), solver, name)
    main = arrays_driver(
        name,
        sizes,
        tables,
        len(found.fields),
        found.defaults,
        h,
        steps,
        threads=threads,
        t_end=20.0 if adaptive else 0.0,
        tolerance=tolerance,
        constrained=constrained,
    )
    return sources.integrator(controlled=adaptive)[0], main


def catalogue(name: str) -> Callable[[], MechanicalSystem]:
    return lambda: problem(name).system


def rods() -> LagrangianSystem:
    return lagrange(
        "rods",
        "x1 y1 x2 y2",
        "2*(x1_dot**2 + y1_dot**2)/2 + (x2_dot**2 + y2_dot**2)/2 - 3*(2*y1 + y2)",
        constraints=["x1**2 + y1**2 = 1", "(x2 - x1)**2 + (y2 - y1)**2 = 1"],
    )


def transformed() -> MechanicalSystem:
    return reparametrise(problem("kepler").system, "sqrt(q1**2 + q2**2)")


def vibration() -> HamiltonianSystem:
    return hamilton(
        "vibration", "x y", "(1 + x**2)*u**2/2 + v**2*(1 + u**2)/2 + x**2/2 + y**4/4 + x*y/3", momenta="u v"
    )


def rubbed() -> LagrangianSystem:
    return lagrange(
        "rubbed",
        "x y",
        "(x_dot**2 + 2*y_dot**2)/2 - x**2 - (x - y)**4/4",
        forces={"x": "-c*x_dot*y**2 + cos(t)", "y": "-c*y_dot"},
        c=0.05,
    )


def ring() -> ArraySystem:
    return lagrange(
        "ring",
        "q[N]",
        "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2 + beta*(q[i+1] - q[i])**4/4)",
        beta=0.25,
    )


def forms() -> ArraySystem:
    return lagrange(
        "forms",
        ["u[NX, NY]", "q[N]"],
        "sum(i in NX, j in NY, u_dot[i, j]**2/2 - u[i, j]**2) + sum(i in N, m[i]*q_dot[i]**2/2 - q[i]**4)"
        " - sum(i in NX periodic, j in NY, u[i-1, j]*u[i+2, j]*cos(g*t)/9)"
        " - sum(i < j in N, sqrt(1 + (q[i] - q[j])**2))"
        " - sum(b in B, k[b]*(q[bonds[b, 0]] - q[bonds[b, 1]])**2)",
        parameters={"m[N]": 1, "k[B]": 1, "g": 0.5},
        tables=["bonds[B, 2]"],
    )


def rubbed_ring() -> ArraySystem:
    return lagrange(
        "rubbed ring",
        "q[N]",
        "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2 - cos(q[i]))",
        forces={"q[i]": "-c*q_dot[i]*(1 + q[i]**2)", "q[0]": "cos(t)"},
        c=0.01,
    )


def rotors() -> ArraySystem:
    return hamilton(
        "rotors",
        "q[N]",
        "sum(i in N, p_q[i]**2/2*(1 + q[i]**2/9) + m[i]*q[i]**2/2) + sum(i in N periodic, (q[i+1] - q[i])**4/4)",
        parameters={"m[N]": 1},
    )


def swings() -> ArraySystem:
    return lagrange(
        "swings",
        ["r[N, 2]"],
        "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2 - r[i, 1])",
        constraints=["r[i, 0]**2 + (r[i, 1] - 2)**2 = 1 for i in N"],
    )


def body() -> LagrangianSystem:
    return lagrange("body", (), "(w_1**2 + w_2**2 + 2.5*w_3**2)/2 - R_33 - R_13**2", rotations={"R": "w"})


BONDS = (tuple(place for b in range(6) for place in (b, (3 * b + 1) % 7)),)
KEPLER = partial(single, system=catalogue("kepler"), q=(0.4, 0.1), p=(0.0, 2.0), h=0.05)
PENDULUM = partial(single, system=catalogue("planar-pendulum"), q=(2.0,), p=(0.1,), h=0.1)
DOUBLE = partial(single, system=catalogue("double-pendulum"), q=(0.9, -0.6), p=(0.5, 1.2), h=0.02)
VIBRATION = partial(single, system=vibration, q=(0.3, -0.4), p=(0.2, 0.5), h=0.05)
RUBBED = partial(single, system=rubbed, q=(0.3, -0.4), p=(0.2, 0.5), h=0.05)
CHAIN = partial(
    single, system=catalogue("fput-chain:12"), q=tuple(0.1 * k - 0.3 for k in range(12)), p=(0.2,) * 12, h=0.1
)
DAMPED = partial(single, system=samples.damped_pendulum, q=(0.3, -0.4), p=(0.2, 0.5), h=0.05)
RODS = partial(single, system=rods, q=(0.6, 0.8, 1.6, 0.8), p=(-0.8, 0.6, -0.4, 0.3), h=0.01)
BODY = partial(single, system=body, q=(0.5, 0.5, -0.5, 0.5), p=(3.0, -5.0, 9.0, 12.0), h=0.4, steps=300)
RING = partial(arrays, system=ring, sizes=(11,), h=0.1)
FORMS = partial(arrays, system=forms, sizes=(5, 3, 7, 6), tables=BONDS, h=0.05, steps=300)
RUBBED_RING = partial(arrays, system=rubbed_ring, sizes=(9,), h=0.1)
ROTORS = partial(arrays, system=rotors, sizes=(10,), h=0.05)
SWINGS = partial(arrays, system=swings, sizes=(5,), h=0.01, constrained=True)

CELLS: dict[str, Callable[..., Made]] = {
    "kepler": partial(KEPLER, method="svi:8"),
    "kepler_adaptive": partial(KEPLER, method="svi:8", kind="adaptive"),
    "kepler_loose": partial(KEPLER, method="svi:4", kind="adaptive", tolerance=1e-6),
    "kepler_many": partial(KEPLER, method="svi:8", kind="ensemble"),
    "kepler_tangent": partial(KEPLER, method="svi:4", kind="tangent"),
    "kepler_second": partial(KEPLER, method="svi:2", kind="second"),
    "kepler_newton": partial(KEPLER, method="svi:4", solver="newton"),
    "kepler_newton_adaptive": partial(KEPLER, method="svi:4", solver="newton", kind="adaptive", tolerance=1e-8),
    "kepler_collocation": partial(KEPLER, method="sc:4"),
    "kepler_shooting": partial(KEPLER, method="scvi:4"),
    "kepler_gauss": partial(KEPLER, method="gauss:3"),
    "kepler_monitor": partial(
        KEPLER, method="svi:4", kind="adaptive", time_transformation="q1**2 + q2**2", tolerance=0.05
    ),
    "kepler_embedded": partial(KEPLER, method="svi:2", kind="embedded", steps=100),
    "kepler_fallback": partial(KEPLER, method="svi:6", h=0.45, steps=100),
    "kepler_clock": partial(KEPLER, system=transformed, method="svi:4"),
    "kepler_composition": partial(KEPLER, method="composition:8"),
    "pendulum": partial(PENDULUM, method="svi:8"),
    "pendulum_adaptive": partial(PENDULUM, method="svi:6", kind="adaptive"),
    "pendulum_many": partial(PENDULUM, method="svi:6", kind="ensemble"),
    "chain": partial(CHAIN, method="svi:6"),
    "chain_adaptive": partial(CHAIN, method="svi:6", kind="adaptive"),
    "chain_many": partial(CHAIN, method="svi:4", kind="ensemble", steps=300),
    "double": partial(DOUBLE, method="svi:4", steps=300),
    "double_adaptive": partial(DOUBLE, method="svi:4", kind="adaptive", steps=300, tolerance=1e-9),
    "double_many": partial(DOUBLE, method="svi:4", kind="ensemble", steps=300),
    "double_tangent": partial(DOUBLE, method="svi:2", kind="tangent"),
    "vibration": partial(VIBRATION, method="svi:4"),
    "vibration_adaptive": partial(VIBRATION, method="svi:4", kind="adaptive"),
    "rubbed_many": partial(RUBBED, method="svi:4", kind="ensemble"),
    "rubbed": partial(RUBBED, method="svi:4"),
    "rubbed_adaptive": partial(RUBBED, method="svi:4", kind="adaptive", tolerance=1e-8),
    "damped": partial(DAMPED, method="svi:4", steps=300),
    "rods": partial(RODS, method="svi:1"),
    "rods_newton": partial(RODS, method="svi:3", steps=100),
    "body": partial(BODY, method="svi:6", kind="adaptive", tolerance=1e-3),
    "ring": partial(RING, method="svi:8"),
    "ring_adaptive": partial(RING, method="svi:6", adaptive=True),
    "ring_loose": partial(RING, method="svi:4", adaptive=True, tolerance=1e-6),
    "ring_threads": partial(RING, method="svi:4", sizes=(4099,), steps=20, threads=3),
    "ring_newton": partial(RING, method="svi:4", solver="newton", steps=100),
    "ring_composition": partial(RING, method="composition:8"),
    "forms": partial(FORMS, method="svi:4"),
    "forms_adaptive": partial(FORMS, method="gauss:3", adaptive=True),
    "forms_newton": partial(FORMS, method="svi:4", solver="newton", steps=30),
    "rubbed_ring": partial(RUBBED_RING, method="svi:4"),
    "rubbed_ring_adaptive": partial(RUBBED_RING, method="svi:4", adaptive=True),
    "rotors": partial(ROTORS, method="svi:6"),
    "rotors_adaptive": partial(ROTORS, method="svi:4", adaptive=True, tolerance=1e-7),
    "rotors_threads": partial(ROTORS, method="svi:4", sizes=(4099,), steps=10, threads=3),
    "swings": partial(SWINGS, method="stoermer-verlet"),
}


RECORDED_CELLS = CELLS | {name: scene.made for name, scene in SCENES.items()}


def program(name: str) -> Program:
    """Generate the program of a cell."""
    return of_source(*RECORDED_CELLS[name](name))


def plain(text: str) -> str:
    """C without comments and indentation, which do not change results."""
    bare = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    return "\n".join(filter(None, map(str.strip, bare.splitlines()))) + "\n"


@cache
def recorded() -> dict[str, Program]:
    """Recorded programs by the names of their cells."""
    return {name: Program(**each) for name, each in json.loads(lzma.decompress(RECORDED.read_bytes())).items()}


def build(program: Program, folder: Path, flags: Sequence[str] = FLAGS) -> Path:
    """Compile a program; return the executable."""
    for name, text in program.files.items():
        (folder / name).write_text(text)
    target = folder / "program"
    sources = [name for name in program.files if name.endswith(".c")]
    command = [*find_compiler(), *flags, *sources, "-lm", "-o", str(target)]
    subprocess.run(command, check=True, cwd=folder)
    return target


def output(program: Program, folder: Path) -> str:
    """Compile and run a program; return what it prints."""
    done = subprocess.run([build(program, folder)], check=True, capture_output=True, text=True, timeout=60)
    return done.stdout
