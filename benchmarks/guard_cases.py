"""What ``python -m benchmarks guard`` measures, and the process that measures it with one checkout's package.

The process is started with the checkout on PYTHONPATH, and reads one request a line: ``{"case": name}`` prepares a case
and answers with the seconds of one call, ``{"case": name, "calls": n}`` with the seconds of each of n calls. Times are
seconds of the processor (``time.process_time``). This file uses public names of the package that every version has.
"""

import gc
import json
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Call = Callable[[], object]

KEPLER = "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)"
ANISOTROPIC = "(1.25*x_dot**2 + y_dot**2/1.25)/2 + 1/sqrt(x**2 + y**2)"
HENON_HEILES = "(x_dot**2 + y_dot**2 - x**2 - y**2)/2 - x**2*y + y**3/3"
DOUBLE_PENDULUM = "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + 19.62*cos(a) + 9.81*cos(b)"
HEAVY_TOP = (
    "((ph_dot*sin(th)*sin(ps) + th_dot*cos(ps))**2 + 1.4*(ph_dot*sin(th)*cos(ps) - th_dot*sin(ps))**2"
    " + .6*(ph_dot*cos(th) + ps_dot)**2)/2 - .8*cos(th)"
)
RING = "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/16)"
WELL = "x_dot**2/2 - (x**2 - 1)**2 - x/2"


def _stepper(lagrangian: str, coordinates: str = "x y", method: str = "svi:8", **options: Any) -> Any:
    import scvi_codegen as sc

    names = coordinates.split()
    return sc.compile_stepper(sc.LagrangianSystem.from_text("guarded", names, lagrangian, **options), method)


def _kepler_fixed() -> Call:
    stepper = _stepper(KEPLER)
    return lambda: stepper.integrate([0.5, 0.0], velocity=[0.0, 3**0.5], h=0.1, steps=1000, save_every=1000)


def _kepler_adaptive() -> Call:
    stepper = _stepper(KEPLER)
    return lambda: stepper.integrate([0.1, 0.0], velocity=[0.0, 19**0.5], t_end=50.0)


def _anisotropic_kepler() -> Call:
    stepper = _stepper(ANISOTROPIC)
    return lambda: stepper.integrate([0.9, 0.35], velocity=[0.15, 0.55], t_end=20.0)


def _henon_heiles() -> Call:
    stepper = _stepper(HENON_HEILES)
    return lambda: stepper.integrate([0.0, 0.1], velocity=[0.35, 0.3], t_end=300.0)


def _regular_henon_heiles() -> Call:
    stepper = _stepper(HENON_HEILES)
    return lambda: stepper.integrate([0.0, 0.1], velocity=[0.1, 0.1], t_end=300.0)


def _forced_duffing() -> Call:
    stepper = _stepper("x_dot**2/2 - x**4/4", "x", forces={"x": "-x_dot/10 + cos(6*t/5)/2"})
    return lambda: stepper.integrate([1.0], velocity=[0.0], t_end=50.0)


def _double_pendulum_loose() -> Call:
    stepper = _stepper(DOUBLE_PENDULUM, "a b", "svi:4")
    return lambda: stepper.integrate([0.7, -0.4], velocity=[0.1, 0.3], t_end=10.0, tolerance=1e-6)


def _heavy_top_fixed() -> Call:
    stepper = _stepper(HEAVY_TOP, "ph th ps")
    return lambda: stepper.integrate([0.2, 1.1, -0.4], velocity=[0.3, -0.2, 0.9], h=0.1, steps=300, save_every=300)


def _rods() -> tuple[Any, np.ndarray, np.ndarray]:
    lengths, names = [1.0, 0.7, 1.2], ["x1", "y1", "x2", "y2", "x3", "y3"]
    masses, pairs = [1.0, 2.0, 0.5], list(zip(names[::2], names[1::2], strict=True))
    energies = (f"{m}*({x}_dot**2 + {y}_dot**2)/2 - {m * 9.81}*{y}" for m, (x, y) in zip(masses, pairs, strict=True))
    ends = [("0", "0"), *pairs]
    constraints = [
        f"({x} - {x0})**2 + ({y} - {y0})**2 - {length**2}"
        for length, (x0, y0), (x, y) in zip(lengths, ends[:-1], ends[1:], strict=True)
    ]
    stepper = _stepper(" + ".join(energies), " ".join(names), constraints=constraints)
    angles = np.array([0.9, 0.4, 1.3])
    ends_of_rods = np.cumsum(np.array(lengths)[:, None] * np.c_[np.sin(angles), -np.cos(angles)], axis=0)
    return stepper, ends_of_rods.ravel(), np.zeros(6)


def _rods_fixed() -> Call:
    stepper, q, v = _rods()
    return lambda: stepper.integrate(q, velocity=v, h=0.05, steps=100, save_every=100)


def _rods_adaptive() -> Call:
    stepper, q, v = _rods()
    return lambda: stepper.integrate(q, velocity=v, t_end=20.0, tolerance=1e-8)


def _bouncing_ball() -> Call:
    import scvi_codegen as sc

    contact = sc.contact("y", restitution=0.8)
    stepper = _stepper("(x_dot**2 + y_dot**2)/2 - 9.81*y", "x y", "svi:3", contacts=[contact])
    return lambda: stepper.integrate([0.0, 1.0], velocity=[1.0, 0.0], h=0.01, t_end=2.0)


def _bath() -> Call:
    stepper = _stepper(
        WELL, "x", "composition:4", parameters={"kT": 1.0, "gamma": 1.0}, damping="gamma", temperature="kT"
    )
    start = np.zeros((16, 1))
    return lambda: stepper.integrate_ensemble(start, start, h=0.3, steps=50, seed=7, threads=1)


def _free_bodies() -> Call:
    import scvi_codegen as sc

    kinetic = "(omega_1**2 + 1.4*omega_2**2 + 2.1*omega_3**2)/2"
    body = sc.LagrangianSystem.from_text(name="body", rotations={"R": "omega"}, lagrangian=kinetic)
    stepper, random = sc.compile_stepper(body, "composition:2"), np.random.default_rng(3)
    omega, quaternions = random.normal(size=(500, 3)), random.normal(size=(500, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    return lambda: stepper.integrate_ensemble({"R": quaternions}, velocity={"omega": omega}, h=1.0, steps=1, threads=1)


def _chain(count: int) -> Any:
    """Return a chain of hinges with crossed axes, read from a file as users have them."""
    import scvi_codegen as sc

    rod = '<inertial pos="0 0 -0.5" mass="1" diaginertia="0.0833 0.0833 0.01"/>'
    bodies = "".join(
        f'<body name="b{i}" pos="0 0 {-1 if i else 0}"><joint name="q{i}" axis="{("1 0 0", "0 1 0")[i % 2]}"/>{rod}'
        for i in range(count)
    )
    text = f'<mujoco><option gravity="0 0 -9.81"/><worldbody>{bodies}{"</body>" * count}</worldbody></mujoco>'
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "chain.xml")
        path.write_text(text, encoding="utf-8")
        return sc.LagrangianSystem.from_mjcf(path, name="chain")


def _three_hinges() -> Call:
    import scvi_codegen as sc

    stepper = sc.compile_stepper(_chain(3), "svi:3")
    angles = np.linspace(0.4, 0.6, 3)
    return lambda: stepper.integrate(angles, velocity=np.zeros(3), h=0.02, steps=20, save_every=20)


def _ring(count: int, method: str, h: float, steps: int) -> Callable[[], Call]:
    def prepare() -> Call:
        stepper = _stepper(RING, "q[N]", method)
        run = stepper.start(np.zeros(count), velocity=np.random.default_rng(1).normal(size=count), h=h)
        return lambda: run.advance(steps)

    return prepare


def _ensemble_adaptive() -> Call:
    stepper, e = _stepper(KEPLER), np.random.default_rng(3).uniform(0.1, 0.7, 200)
    q, p = np.c_[1 - e, 0 * e], np.c_[0 * e, np.sqrt((1 + e) / (1 - e))]
    return lambda: stepper.integrate_ensemble(q, p, t_end=6.28, threads=1)


def _double_double() -> Call:
    import scvi_codegen as sc

    stepper = sc.compile_stepper(sc.problem("kepler").system, "svi:8", precision="double-double")
    return lambda: stepper.integrate([0.5, 0.0], [0.0, 3**0.5], h=0.1, steps=100, save_every=100)


def _jacobian() -> Call:
    stepper, q, p = _stepper(KEPLER), np.array([0.5, 0.0]), np.array([0.0, 3**0.5])
    return lambda: stepper.jacobian(q, p, h=0.1)


def _tangent() -> Call:
    stepper, directions = _stepper(KEPLER), np.eye(4)[:, :1]
    run = stepper.integrate([0.5, 0.0], velocity=[0.0, 3**0.5], h=0.1, steps=100)
    return lambda: run.tangent(directions)


def _call() -> Call:
    stepper = _stepper(KEPLER)
    return lambda: stepper.integrate([0.5, 0.0], velocity=[0.0, 3**0.5], h=0.1, steps=1)


def _call_adaptive() -> Call:
    stepper = _stepper(KEPLER)
    return lambda: stepper.integrate([1.0, 0.0], velocity=[0.0, 1.0], t_end=1.0)


CASES: dict[str, Callable[[], Call]] = {
    "kepler fixed": _kepler_fixed,
    "kepler e = .9 adaptive": _kepler_adaptive,
    "anisotropic kepler": _anisotropic_kepler,
    "henon-heiles, chaotic": _henon_heiles,
    "henon-heiles, regular": _regular_henon_heiles,
    "forced duffing": _forced_duffing,
    "double pendulum svi:4 1e-6": _double_pendulum_loose,
    "heavy top fixed": _heavy_top_fixed,
    "rods fixed": _rods_fixed,
    "rods adaptive 1e-8": _rods_adaptive,
    "contact": _bouncing_ball,
    "bath": _bath,
    "free bodies": _free_bodies,
    "three hinges svi:3": _three_hinges,
    "ring of 1000 svi:4": _ring(1000, "svi:4", 0.1, 10),
    "ring of 20000 verlet": _ring(20000, "stoermer-verlet", 0.02, 20),
    "ensemble adaptive": _ensemble_adaptive,
    "double-double": _double_double,
    "jacobian": _jacobian,
    "tangent": _tangent,
    "call": _call,
    "call adaptive": _call_adaptive,
}
"""Cases that two processes repeat in turns: name, and the function that prepares a call."""


def _warm_start() -> dict[str, float]:
    """Return the time of this process to its first run, whose stepper is in the cache (or is put there)."""
    import scvi_codegen as sc

    sc.compile_stepper(sc.problem("kepler").system, "svi:8").integrate([0.5, 0.0], [0.0, 3**0.5], h=0.1, steps=1)
    return {"seconds": time.process_time()}


def _peak_memory() -> dict[str, float]:
    """Return the largest resident set of this process in a long run that saves each state, in kilobytes."""
    _stepper(KEPLER).integrate([0.5, 0.0], velocity=[0.0, 3**0.5], h=0.1, steps=200_000)
    return {"peak kB": float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)}


def _made(system: Any, method: str) -> dict[str, float]:
    """Return what it takes to make a stepper: seconds of derivation and of the compiler, and counts of its C."""
    import scvi_codegen as sc

    began = time.process_time()
    stepper = sc.compile_stepper(system, method)
    derived = time.process_time() - began
    text = stepper.source.code
    compiled = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "seconds": derived,
        "compiler": compiled.ru_utime + compiled.ru_stime,
        "lines": float(text.count("\n")),
        "operations": float(sum(text.count(f" {operator} ") for operator in "+-*/")),
    }


def _make_pendulum() -> dict[str, float]:
    import scvi_codegen as sc

    return _made(sc.LagrangianSystem.from_text("pendulum", ["q"], "q_dot**2/2 + cos(q)"), "svi:8")


def _make_ten_hinges() -> dict[str, float]:
    return _made(_chain(10), "svi:8")


def _make_thirty_angles() -> dict[str, float]:
    import scvi_codegen as sc

    names = [f"a{i}" for i in range(30)]
    x_dot, energies = "", []
    y_dot = y = ""
    for name in names:
        x_dot, y_dot, y = (
            f"{x_dot} + {name}_dot*cos({name})",
            f"{y_dot} + {name}_dot*sin({name})",
            f"{y} - cos({name})",
        )
        energies.append(f"(({x_dot})**2 + ({y_dot})**2)/2 - 9.81*({y})")
    return _made(sc.LagrangianSystem.from_text("chain", names, " + ".join(energies)), "svi:4")


def _make_quadruped() -> dict[str, float]:
    """Make the stepper of a body with four legs of two hinges, read from a file."""
    import scvi_codegen as sc

    leg = (
        '<body name="upper{i}" pos="{x} {y} 0"><joint name="hip{i}" axis="0 1 0"/>'
        '<inertial pos="0 0 -.1" mass="1" diaginertia=".004 .004 .001"/>'
        '<body name="lower{i}" pos="0 0 -.2"><joint name="knee{i}" axis="0 1 0"/>'
        '<inertial pos="0 0 -.1" mass=".5" diaginertia=".002 .002 .0005"/></body></body>'
    )
    legs = "".join(leg.format(i=i, x=(-0.2, 0.2)[i % 2], y=(-0.1, 0.1)[i // 2]) for i in range(4))
    trunk = '<freejoint name="base"/><inertial pos="0 0 0" mass="5" diaginertia=".05 .1 .12"/>'
    text = f'<mujoco><worldbody><body name="trunk" pos="0 0 .5">{trunk}{legs}</body></worldbody></mujoco>'
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "quadruped.xml")
        path.write_text(text, encoding="utf-8")
        system = sc.LagrangianSystem.from_mjcf(path, name="quadruped")
    return _made(system, "svi:3")


WHOLE: dict[str, Callable[[], dict[str, float]]] = {
    "warm start": _warm_start,
    "peak memory": _peak_memory,
    "make a pendulum": _make_pendulum,
    "make ten hinges": _make_ten_hinges,
    "make thirty angles": _make_thirty_angles,
    "make a quadruped": _make_quadruped,
}
"""Cases that take a process of their own each time; those that make a stepper have an empty cache."""


def _seconds(function: Call, calls: int) -> float:
    began = time.process_time()
    for _ in range(calls):
        function()
    return (time.process_time() - began) / calls


def answer(request: dict[str, Any], prepared: dict[str, Call]) -> float | str:
    """Return the seconds of a call, or the error of a case that this checkout cannot run."""
    name = request["case"]
    try:
        if "calls" in request:
            return min(_seconds(prepared[name], request["calls"]) for _ in range(2))
        prepared[name] = function = CASES[name]()
        function()
        function()
        gc.collect()
        gc.freeze()
        gc.disable()
        return min(_seconds(function, 1) for _ in range(3))
    except Exception as error:  # noqa: BLE001  a version may lack what a case needs: the table says so
        return f"{type(error).__name__}: {error}"[:200]


def main() -> None:
    """Answer the requests of standard input, or measure the case of ``WHOLE`` that is named."""
    warnings.simplefilter("ignore")
    replies, sys.stdout = sys.stdout, sys.stderr
    if len(sys.argv) > 1:
        replies.write(json.dumps(WHOLE[sys.argv[1]]()) + "\n")
        return
    prepared: dict[str, Call] = {}
    for line in sys.stdin:
        replies.write(json.dumps(answer(json.loads(line), prepared)) + "\n")
        replies.flush()


if __name__ == "__main__":
    main()
