"""Contact and dry friction with closed forms: this package, MuJoCo (soft contacts), Siconos (Moreau's time stepping).

The error is the largest of the first coordinate at times with a closed form. MuJoCo has elliptic cones, ``impratio``
100 and the stiffest contacts that it admits, of two steps; its impacts are those of springs that only push, whose
damping ratio z obeys ln e = -z arctan2(2 z sqrt(1 - z^2), 2 z^2 - 1)/sqrt(1 - z^2).
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import sympy

from benchmarks.cases.unforced import SYSTEMS, Array, Case
from benchmarks.report import OURS, Contender
from scvi_codegen.systems.lagrangian import LagrangianSystem

CONTACTS: dict[str, Any] = {f"contact:{name}": table for name, table in SYSTEMS["contact"].items()}
OUR_STEPS, STEPS = (0.1, 0.05, 0.025), (4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4, 1.25e-4)
Prepare = Callable[[float, list[float], int], Callable[[], Any]]
"""Function of step size, times and the number of a start, always 0, that returns a run to be timed."""


def contact_case(name: str) -> Case:
    """Return the case of a table."""
    table = CONTACTS[name]
    system = LagrangianSystem.from_text(name, contacts=table["contacts"], **table["system"])
    q, velocity = np.array(table["start"])[:, np.newaxis]
    return Case(name=name, system=system, q=q, velocity=velocity, span=table["exact"][-1][0], step=0.1, mjcf="plane")


def _contenders(case: Case, method: str, steps: tuple[float, ...], seconds: float, run: Prepare) -> Iterator[Contender]:
    times, formulas = zip(*CONTACTS[case.name]["exact"], strict=True)
    exact = np.array([float(sympy.N(sympy.sympify(formula), 17)) for formula in formulas])
    for h in steps:
        prepare = partial(run, h, list(times))
        yield Contender(
            method, f"h={h:g}", "", seconds, prepare, starts=1, error=lambda x: float(np.abs(x - exact).max())
        )


def our_contacts(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield contenders of this package."""
    from benchmarks.contenders.ours import compiled  # which imports the list of peers

    def run(stepper: Any, h: float, times: list[float], _: int) -> Callable[[], Any]:
        def integrate() -> Callable[[], Array]:
            trajectory = stepper.integrate(case.q[0], velocity=case.velocity[0], h=h, t_end=case.span)
            return lambda: np.array(trajectory.at(times)[0][:, 0])

        return integrate

    for degree in (3,) if quick else (1, 2, 3):
        stepper, seconds = compiled(case.system, f"svi:{degree}")
        yield from _contenders(case, f"{OURS} svi:{degree}", OUR_STEPS, seconds, partial(run, stepper))
    stepper, seconds = compiled(case.system, "svi:1")
    by_steps = partial(run, stepper.by_transitions("by steps"))
    yield from _contenders(case, f"{OURS} by steps", STEPS[: 2 if quick else None], seconds, by_steps)


def _sampled(h: float, times: list[float], advance: Callable[[int], object], first: Callable[[], float]) -> Array:
    """Return the first coordinate at times, after numbers of steps."""
    reached = []
    for steps in np.diff([0, *(round(t / h) for t in times)]).tolist():
        advance(steps)
        reached.append(first())
    return np.array(reached)


def _linear(case: Case) -> tuple[Array, Array, Array]:
    """Return M, K and f of M q'' + K q = f."""
    L, q, v = case.system.lagrangian, case.system.coordinates, case.system.velocities
    start, forces = dict.fromkeys((*q, *v), 0), sympy.Matrix([L.diff(x) for x in q])
    terms = sympy.hessian(L, v), -forces.jacobian(q), forces.T
    M, K, f = (np.array(term.subs(start), float) for term in terms)
    return M, K, f[0]


def mujoco_contacts(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield MuJoCo with the integrator that it recommends; the coordinates are slides along x and z, and a hinge."""
    import mujoco

    table, (M, K, f) = {"plane": "", "solref": (2, 1), "axis": 1, "spheres": '<geom size=".5"/>'}, _linear(case)
    table |= CONTACTS[case.name].get("mujoco", {})
    mu, inertia = CONTACTS[case.name]["contacts"][0].get("friction", 0), f"{M[-1, -1]} " * 3
    hinge = f'<joint axis="0 {table["axis"]} 0"/>' * (len(f) > 2)

    def run(h: float, times: list[float], _: int) -> Callable[[], Array]:
        solref = '"{} {}"'.format(*np.array(table["solref"]) * (h, 1))
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{h}" integrator="implicitfast" cone="elliptic" impratio="100" '
            f'gravity="{f[0]} 0 {f[1]}"/><default><geom solref={solref} solimp=".99 .999 .001" friction="{mu} 0 0"/>'
            f'</default><worldbody><geom type="plane" size="9 9 1" {table["plane"]}/><body><inertial pos="0 0 0" '
            f'mass="1" diaginertia="{inertia}"/><joint type="slide" axis="1 0 0" stiffness="{K[0, 0]}"/>'
            f'<joint type="slide"/>{hinge}{table["spheres"]}</body></worldbody></mujoco>'
        )
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = case.q[0], case.velocity[0]
        return partial(_sampled, h, times, partial(mujoco.mj_step, model, data), lambda: data.qpos[0])

    yield from _contenders(case, "MuJoCo implicitfast", STEPS[: 2 if quick else None], 0.0, run)


def siconos_contacts(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield Siconos by Moreau and Jean's time stepping, theta = 1/2, for linear equations with one contact."""
    import siconos.kernel as sk

    (table, *others), (M, K, f) = CONTACTS[case.name]["contacts"], _linear(case)
    gap, slip = (sympy.sympify(table.get(name, "0")) for name in ("gap", "slip"))
    names = case.system.coordinates
    rows = [[gap.diff(x.name) for x in names], [slip.diff(f"{x.name}_dot") for x in names]]
    offset = gap.subs(dict.fromkeys(gap.free_symbols, 0))
    law = sk.NewtonImpactFrictionNSL(table.get("restitution", 0.0), 0.0, table.get("friction", 0.0), 2)

    def run(h: float, times: list[float], _: int) -> Callable[[], Array]:
        body = sk.LagrangianLinearTIDS(case.q[0], case.velocity[0], M)
        body.setKPtr(K)
        body.setFExtPtr(f)
        relation = sk.LagrangianLinearTIR(np.array(rows, float), np.array([offset, 0], float))
        model, solver = sk.NonSmoothDynamicalSystem(0.0, 2 * case.span), sk.FrictionContact(2)
        model.insertDynamicalSystem(body)
        model.link(sk.Interaction(law, relation), body)
        solver.numericsSolverOptions().dparam[0] = 1e-12
        stepping = sk.TimeStepping(model, sk.TimeDiscretisation(0.0, h), sk.MoreauJeanOSI(0.5), solver)

        def advance(steps: int) -> None:
            for _ in range(steps):
                stepping.computeOneStep()
                stepping.nextStep()

        return partial(_sampled, h, times, advance, lambda: body.q()[0])

    if not others:
        yield from _contenders(case, "Siconos Moreau-Jean", STEPS[: 2 if quick else None], 0.0, run)
