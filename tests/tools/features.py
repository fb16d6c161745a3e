"""Features of the table in docs/features.md, each as a function that uses it on one of three kinds of systems.

PYTHONPATH=tests/oracles python tests/tools/features.py      writes the names and refusals on that page.
"""

import textwrap
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.codegen.native.option_table import in_words
from scvi_codegen.runs.stepping import features

ENDS = {"named coordinates": ("x", "y", "z"), "known sizes": ("x", "q[2]"), "run-time sizes": ("x", "q[N]")}
KINDS = tuple(ENDS)
Q = {"named coordinates": {"x": 0.3, "y": 0.1, "z": -0.2}}


class Kind:
    """A body with two others on springs, by names, by an array of two, or of any number."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.named, self.run_time = name == "named coordinates", name == "run-time sizes"
        self.coordinates = list(ENDS[name])
        self.first = "y" if self.named else "q[0]"
        self.q = Q.get(name, {"x": 0.3, "q": [0.1, -0.2]})
        self.used: Any = None
        self.p = {each: np.zeros(np.shape(value)) for each, value in self.q.items()}

    def sum(self, named: str, indexed: str) -> str:
        """Return a formula of all bodies but x."""
        size = self.coordinates[1][2:-1]
        return named if self.named else f"sum(i in {size}, {indexed})"

    def system(self, *, kinetic: str = "", **arguments: Any) -> Any:
        """Return the system with a further kinetic energy, and other arguments of from_text."""
        moving, springs = (
            self.sum("y_dot**2/2 + z_dot**2/2", "q_dot[i]**2/2"),
            self.sum("((y - x)**2/2 + (z - x)**2/2)", "(q[i] - x)**2/2"),
        )
        text = f"x_dot**2/2 + {moving} - k*x**2/2 - x**4/9 - {springs}{kinetic}"
        arguments = {"parameters": {"k": 1}, **arguments}
        return sc.LagrangianSystem.from_text("bodies", self.coordinates, text, **arguments)

    @cache  # noqa: B019  (three objects in all)
    def stepper(self) -> Any:
        """Return a stepper of the system without anything else."""
        return self.compiled(self.system())

    def sized(self) -> Any:
        """Return the stepper, compiled with its sizes."""
        self.used = self.stepper().with_sizes(N=2) if self.run_time else self.stepper()
        return self.used

    def compiled(self, system: Any, method: Any = "svi:2", **given: Any) -> Any:
        """Return the stepper of a system."""
        self.used = sc.compile_stepper(system, method, flags=QUICK_FLAGS, **given)
        return self.used

    def run(self, stepper: Any = None, **given: Any) -> Any:
        """Return a run of few steps."""
        return (stepper or self.stepper()).integrate(self.q, self.p, **{"h": 0.1, "steps": 4, **given})

    def flat(self) -> tuple[Any, Any]:
        """Return the state as vectors, or as it is."""
        return ([0.3, 0.1, -0.2], [0.0] * 3) if not self.run_time else (self.q, self.p)

    def model(self, folder: Path) -> Any:
        """Return the model of a file."""
        text = self.system().to_text() if self.named else None
        springs = self.sum("((y - x)**2/2 + (z - x)**2/2)", "(q[i] - x)**2/2")
        text = text or f"x_dot**2/2 + {self.sum('', 'q_dot[i]**2/2')} - k*x**2/2 - x**4/9 - {springs}"
        numbers = ", ".join(f"{name} = {value}" for name, value in self.q.items())
        path = folder / "model.toml"
        path.write_text(
            f"[system]\nname = 'bodies'\ncoordinates = {self.coordinates}\nlagrangian = '''{text}'''\n"
            f"[parameters]\nk = 1\n[initial]\nq = {{{numbers}}}\n"
            f"q_dot = {{{', '.join(f'{name} = {np.zeros(np.shape(v)).tolist()}' for name, v in self.q.items())}}}\n"
            "[run]\nstep = 0.1\nspan = 1.0\n"
        )
        return sc.load_model(path)


def hamiltonians(of: Kind, _: Path) -> Any:
    text = f"p_x**2/2 + {of.sum('p_y**2/2 + p_z**2/2 + y**2 + z**2', 'p_q[i]**2/2 + q[i]**2')} + x**4"
    return of.run(of.compiled(sc.HamiltonianSystem.from_text("bodies", of.coordinates, text)))


def forces(of: Kind, _: Path) -> Any:
    friction = of.sum("y_dot**2 + z_dot**2", "q_dot[i]**2")
    return of.run(of.compiled(of.system(forces={"x": "cos(t)"}, dissipation=friction)))


def first_order(of: Kind, _: Path) -> Any:
    size = "N" if of.run_time else "2"
    names, state = ([f"x[{size}]", f"y[{size}]"], {"x": [0.3, -0.2], "y": [0.1, 0.4]})
    lagrangian = f"sum(i in {size}, (x[i] + x[i]**3)*y_dot[i] - (x[i]**2 + y[i]**2)/2)"
    if of.named:
        names, state, lagrangian = ["x", "y"], {"x": 0.3, "y": 0.1}, "(x + x**3)*y_dot - (x**2 + y**2)/2"
    run = of.compiled(sc.LagrangianSystem.from_text("vortices", names, lagrangian)).integrate(state, h=0.1, steps=3)
    assert run.energy_error() < 1e-6
    assert np.isfinite(run.tangent()).all()
    return run


def holonomic(of: Kind, _: Path) -> Any:
    system = of.system(constraints=[f"{of.first} - x = -0.2"])
    return of.run(of.compiled(system, "stoermer-verlet" if of.run_time else sc.SVI(1, "gauss-lobatto:2")))


def nonholonomic(of: Kind, _: Path) -> Any:
    dot = "y_dot" if of.named else "q_dot[0]"
    return of.run(of.compiled(of.system(constraints=[f"{dot} - x*x_dot = 0"]), sc.SVI(1, "gauss-lobatto:2")))


def inputs(of: Kind, _: Path) -> Any:
    stepper = of.compiled(of.system(forces={"x": "u"}, inputs=["u"]))
    return of.run(stepper, inputs={"u": ([0.0, 1.0], [0.0, 1.0])})


def time_transformation(of: Kind, _: Path) -> Any:
    stepper = of.compiled(of.system(), time_transformation="1/(1 + x**2)")
    return stepper.integrate(of.q, of.p, h=0.1, t_end=1.0)


def changing_events(of: Kind, _: Path) -> Any:
    run = of.run(events=sc.Event("x - 0.25", then={"p_x": "-p_x"}))
    assert len(run.events[0])
    return run


def ensembles(of: Kind, _: Path, precision: str = "double") -> Any:
    starts = {name: np.stack([value, value]) for name, value in of.q.items()}
    return of.stepper().integrate_ensemble(starts, np.zeros((2, 3)), h=0.1, steps=3, precision=precision)


def neighbours(of: Kind, _: Path) -> Any:
    near = {"near": {"of": of.first.removesuffix("[0]"), "cutoff": 0.5}}
    system = of.system(neighbours=near, kinetic=" - sum(i < j in near, (q[i] - q[j])**4)")
    return of.run(of.compiled(system))


def other_sizes(of: Kind, _: Path) -> Any:
    q = {"x": 0.0, "q": [0.1, 0.2, 0.3]} if not of.named else [0.0, 0.1, 0.2, 0.3]
    return of.stepper().integrate(q, q, h=0.1, steps=1)


def adjoint(of: Kind, _: Path) -> Any:
    run = of.run()
    return run.pullback(np.ones((len(run.t), 6)))


def hessian_products(of: Kind, _: Path) -> Any:
    run = of.run()
    return run.hessian_product(np.ones((len(run.t), 6)), np.ones(6))


def periodic(of: Kind, _: Path) -> Any:
    q = [0.0, 0.1, -0.1] if not of.run_time else of.q
    return sc.periodic_orbit(of.stepper(), q, of.flat()[1], period=6.3, steps=60)


def fits(of: Kind, _: Path) -> Any:
    run = of.run(steps=20)
    return sc.fit(of.stepper(), run.t, run.q, q=of.flat()[0], p=of.flat()[1], h=0.1, unknown=["k"])


def solve_ivp(of: Kind, _: Path) -> Any:
    if of.run_time:
        return sc.solve_ivp(of.system(), (0.0, 1.0), of.q, velocity=of.p)
    start = np.concatenate([[0.3], np.zeros(5)])
    return sc.solve_ivp(of.system(), (0.0, 1.0), start)


def checkpoints(of: Kind, _: Path) -> Any:
    run = of.stepper().start(of.q, of.p, h=0.1)
    run.advance(2)
    return of.stepper().from_checkpoint(run.checkpoint())


def rotations(of: Kind, _: Path) -> Any:
    system = of.system(kinetic=" + omega_1**2 + omega_2**2 + omega_3**2 - x*R_33", rotations={"R": "omega"})
    rest = {**of.p, "omega": [0, 0, 1]}
    return of.compiled(system).integrate({**of.q, "R": [1, 0, 0, 0]}, velocity=rest, h=0.1, steps=4).rotation()


FEATURES: dict[str, Callable[[Kind, Path], Any]] = {
    "SVI, spectral collocation, Runge-Kutta": lambda of, _: of.run(),
    "SCVI": lambda of, _: of.run(of.compiled(of.system(), "scvi:2")),
    "Stoermer-Verlet and compositions": lambda of, _: [
        of.run(of.compiled(of.system(), method)) for method in ("stoermer-verlet", "composition:8")
    ],
    "Hamiltonians": hamiltonians,
    "any kinetic energy": lambda of, _: of.run(
        of.compiled(of.system(kinetic=f" + {of.sum('x_dot*y_dot/9', 'x_dot*q_dot[i]/9')}"))
    ),
    "forces, Rayleigh dissipation": forces,
    "rotations, directions, spins": rotations,
    "Lagrangians linear in velocities": first_order,
    "uniform damping": lambda of, _: of.run(of.compiled(of.system(damping=0.1))),
    "holonomic constraints": holonomic,
    "nonholonomic constraints": nonholonomic,
    "inputs": inputs,
    "adaptive steps": lambda of, _: of.stepper().integrate(of.q, of.p, t_end=1.0),
    "Newton's iteration": lambda of, _: of.run(of.compiled(of.system(), solver="newton")),
    "time transformation": time_transformation,
    "output times `t_eval`": lambda of, _: of.run(t_eval=[0.05, 0.3]),
    "dense output `at`": lambda of, _: of.run().at([0.05, 0.3]),
    "events": lambda of, _: of.run(events="x - 0.25"),
    "events that change the state": changing_events,
    "ensembles": ensembles,
    "ensembles in single precision": lambda of, folder: ensembles(of, folder, "single"),
    "lists of neighbours": neighbours,
    "threads within a step": lambda of, _: of.run(threads=2),
    "sizes chosen by each run": other_sizes,
    "reduction of states `observe`": lambda of, _: of.run(observe=lambda run: run.energy),
    "Jacobians of steps": lambda of, _: of.stepper().jacobian(*of.flat(), 0.1),
    "adjoint derivatives": adjoint,
    "Hessian products": hessian_products,
    "chaos indicators": lambda of, _: of.run(steps=20).megno(),
    "periodic orbits": periodic,
    "fits": fits,
    "JAX": lambda of, _: sc.jax_flow(of.sized(), steps=3),
    "PyTorch": lambda of, _: sc.torch_flow(of.sized(), steps=3),
    "CasADi": lambda of, _: sc.casadi_flow(of.sized(), steps=3),
    "momentum maps": lambda of, _: of.run().momentum_maps(),
    "symmetries of the system": lambda of, _: sc.symmetries(of.system()),
    "work of forces": lambda of, _: of.run(of.compiled(of.system(forces={"x": "cos(t)"}))).work(),
    "discrete Lagrangian": lambda of, _: of.stepper().discrete_lagrangian(of.flat()[0], of.flat()[0], 0.1),
    "action": lambda of, _: of.run().action(),
    "shadow energy": lambda of, _: of.run().shadow_energy(2),
    "paths": lambda of, _: of.stepper().path(of.q, of.q, 0.4, steps=4),
    "exact map": lambda of, _: sc.exact_map(of.system(), *of.flat(), 0.01, digits=15),
    "derivation": lambda of, _: sc.derive(of.system(), "svi:1").to_text(),
    "verification report": lambda of, _: sc.verify(of.system(), "svi:2", *of.flat(), h=0.05),
    "model files": lambda of, folder: of.model(folder),
    "C folder": lambda of, folder: sc.generate_package(of.model(folder), folder / "made"),
    "FMU": lambda of, folder: sc.generate_fmu(of.model(folder), folder / "made.fmu"),
    "advice": lambda of, _: sc.advise(of.system(), "svi:2", *of.flat(), 1.0, 1e-4),
    "`solve_ivp`": solve_ivp,
    "checkpoints": checkpoints,
    "recorded runs": lambda of, folder: sc.record_run(of.stepper().start(of.q, of.p, h=0.1), folder / "run", steps=3),
    "xarray, pandas, HDF5": lambda of, _: of.run().to_xarray(),
}
"""Function of a kind of system and a folder, by row of the table."""

SUPPORTS = {
    "inputs": "inputs",
    "adaptive steps": "adaptive",
    "output times `t_eval`": "t_eval",
    "dense output `at`": "dense_output",
    "events": "events",
    "ensembles": "ensembles",
    "threads within a step": "threads",
    "sizes chosen by each run": "with_sizes",
    "reduction of states `observe`": "observe",
    "Jacobians of steps": "jacobian",
    "adjoint derivatives": "pullback",
    "Hessian products": "hessian",
    "chaos indicators": "chaos",
    "periodic orbits": "periodic_orbit",
    "fits": "fit",
    "JAX": "flow",
    "PyTorch": "flow",
    "CasADi": "flow",
    "momentum maps": "momentum_maps",
    "work of forces": "work",
    "discrete Lagrangian": "discrete_lagrangian",
    "action": "action",
    "shadow energy": "shadow_energy",
    "paths": "path",
    "checkpoints": "checkpoint",
}
"""Name of a row of the table in ``Stepper.supports``; the others are properties of systems, or use no stepper."""


def refusals() -> str:
    """Return the names, and the table of what excludes them, of docs/features.md."""
    names = (
        f"`{name}`" + f" ({title})" * (title.strip("=") != name)
        for name, title in zip(features.OPERATIONS, map(in_words, features.OPERATIONS.values()), strict=True)
    )
    rows: dict[tuple[str, str], list[str]] = {}
    for (operation, excluding), remedy in features.FEATURES.items():
        rows.setdefault((excluding, in_words(remedy)), []).append(f"`{operation}`")
    lines = [f"| {excluding} | {', '.join(each)} | {remedy} |" for (excluding, remedy), each in rows.items()]
    head = ["| property | not available | reason, remedy |", "| --- | --- | --- |"]
    return "\n".join([textwrap.fill(f"{MARK}: {', '.join(names)}.", 120), "", *head, *lines, ""])


MARK = "The names are"

if __name__ == "__main__":
    page = Path(__file__).parents[2] / "docs" / "features.md"
    before = page.read_text(encoding="utf-8").partition(MARK)[0]
    page.write_text(before + refusals(), encoding="utf-8")
