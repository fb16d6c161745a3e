"""Contenders of multibody programs for cases that have a model of MuJoCo: MuJoCo, Pinocchio, Exudyn."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from benchmarks.cases.robots import model_file
from benchmarks.cases.unforced import Array, Case
from benchmarks.contenders.arrays import step_counts
from benchmarks.contenders.dop853 import LOOSE, dop853, start_of
from benchmarks.report import Contender
from scvi_codegen.extras.robots.trees.energies import Tree
from scvi_codegen.extras.robots.trees.mjcf import links_of_mjcf

LARGEST_STEP, HALVINGS = 0.02, 6
"""Largest step size, ten times MuJoCo's default, and number of step sizes, each half of the one before."""
STIFF = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of stiff equality constraints."""
INTEGRATORS = ("RK4", "implicitfast", "Euler")
EXUDYN_HALVINGS = {"RK44": 7, "RK67": 6, "GeneralizedAlpha": 6}
"""Number of step sizes, from that of the case on, each half of the one before."""


def mujoco_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield MuJoCo's integrators; a model whose coordinates are those of all states integrates them together.

    A closed loop (``<equality>``) is integrated with MuJoCo's default softness and with the stiffest that a step size
    allows; the final coordinates are then the positions of its sites in the plane of x and z.
    """
    import mujoco

    assert case.mjcf is not None
    began = time.perf_counter()
    model = mujoco.MjModel.from_xml_string(case.mjcf)
    seconds, data = time.perf_counter() - began, mujoco.MjData(model)
    together = len(case.q) > 1 and model.nq == case.q.size
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    prepare = _mujoco_preparation(case, model, data, together=together)
    for integrator in INTEGRATORS:
        for stiff in (False, True)[: 2 if model.neq else 1]:
            for steps in _counts(case, quick):
                yield Contender(
                    method=f"MuJoCo {integrator}{', stiff' * stiff}",
                    setting=f"h={case.span / steps:.4g}",
                    options="without contacts",
                    compile_seconds=seconds,
                    prepare=partial(prepare, integrator, steps, stiff),
                    trajectories=len(case.q) if together else 1,
                    starts=len(case.q),
                )


def _counts(case: Case, quick: bool) -> list[int]:
    """Return numbers of steps, from the step size of the case on if that is larger."""
    largest = max(case.step, LARGEST_STEP)
    most = HALVINGS + round(np.log2(largest / LARGEST_STEP))
    return step_counts(replace(case, step=largest), range(2 if quick else most))


def _mujoco_preparation(case: Case, model: Any, data: Any, *, together: bool) -> Callable[..., Callable[[], Any]]:
    """Return a function of (integrator, steps, stiff, number of the state) that prepares a run."""
    import mujoco

    softness = model.eq_solref.copy(), model.eq_solimp.copy()
    places = None if together or model.neq else coordinate_places(model, case)

    def prepare(integrator: str, steps: int, stiff: bool, index: int) -> Callable[[], Any]:
        h = case.span / steps
        mujoco.mj_resetData(model, data)
        model.opt.integrator, model.opt.timestep = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}"), h
        model.eq_solref[:], model.eq_solimp[:] = ((2 * h, 1.0), STIFF) if stiff else softness
        if places is not None:
            data.qpos[:], data.qvel[:] = case.q[index][places[0]], case.velocity[index][places[1]]
        elif together:
            data.qpos[:], data.qvel[:] = (np.ravel(part) for part in case.states)
        return partial(integrate, steps)

    def integrate(steps: int) -> Callable[[], Array]:
        with _warnings() as warnings_seen:
            mujoco.mj_step(model, data, nstep=steps)
        if warnings_seen:
            raise ArithmeticError(warnings_seen[0])
        return final

    def final() -> Array:
        if model.neq:
            mujoco.mj_forward(model, data)
            return np.ravel(data.site_xpos[: case.dimension // 2, [0, 2]])
        q = np.array(data.qpos)
        return q.reshape(-1, case.dimension) if places is None else q[np.argsort(places[0])]

    return prepare


def mujoco_states(case: Case, integrator: str, h: float, every: int, count: int) -> tuple[float, Array]:
    """Return the seconds and ``count`` states (q, v), every so many steps; NaN once the simulation is unstable."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(case.mjcf)
    data, (positions, velocities) = mujoco.MjData(model), coordinate_places(model, case)
    model.opt.integrator, model.opt.timestep = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}"), h
    data.qpos[:], data.qvel[:] = case.q[0][positions], case.velocity[0][velocities]
    states, seconds = np.full((count, case.size), np.nan), 0.0
    with _warnings() as warnings_seen:
        for state in states:
            state[positions] = data.qpos
            state[[case.dimension + k for k in velocities]] = data.qvel
            began = time.process_time()
            mujoco.mj_step(model, data, nstep=every)
            seconds += time.process_time() - began
            if warnings_seen:
                break
    return seconds, states


def coordinate_places(model: Any, case: Case) -> tuple[list[int], list[int]]:
    """Return the indices in coordinates and velocities of a case of those of MuJoCo's hinges and free joints."""
    names = [str(symbol) for symbol in case.system.coordinates]
    positions: list[int] = []
    velocities: list[int] = []
    for name, free in ((model.joint(k).name, model.jnt_type[k] == 0) for k in range(model.njnt)):
        own = [names.index(f"{axis}_{name}") for axis in "xyz"] if free else [names.index(name)]
        positions += own
        velocities += own
        if free:
            positions += [names.index(f"R_{name}_{part}") for part in "wxyz"]
            velocities += range(len(names) - 4, len(names) - 1)  # the one rotation is the last
    return positions, velocities


def pinocchio_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield the classical Runge-Kutta method with Pinocchio's ``aba``, and SciPy's DOP853 with it.

    Pinocchio has no integrator. The time of the first is that of the four calls of ``aba`` a step alone, made by C++
    (``abaInParallel`` with one thread): a lower bound for any program of C++. The second is run from Python as it is.
    """
    import pinocchio

    began = time.perf_counter()
    with model_file(case.mjcf or "") as path:
        made = pinocchio.buildModelFromMJCF(str(path))
    model = made[0] if isinstance(made, tuple) else made
    data, pool, m = model.createData(), pinocchio.ModelPool(model, 1), case.dimension
    seconds, zero = time.perf_counter() - began, np.zeros(model.nv)
    places, turned = _pinocchio_places(case, model), model.nq != model.nv

    def rates(t: float, x: Array) -> Array:
        if not turned:
            return np.concatenate([x[m:], pinocchio.aba(model, data, x[:m], x[m:], zero)])
        q, v = x[places[0]], x[places[1]]
        q[3:7] /= np.linalg.norm(q[3:7])
        turn = pinocchio.Quaternion(q[3:7]).matrix()
        v[:3] = turn.T @ v[:3]  # of the base in its own axes
        a = pinocchio.aba(model, data, q, v, zero)
        rate = np.empty_like(x)
        rate[places[0]] = np.concatenate([turn @ v[:3], _quaternion_rate(x[places[0][3:7]], v[3:6]), v[6:]])
        a[:3] = turn @ (a[:3] + np.cross(v[3:6], v[:3]))
        rate[places[1]] = a
        return rate

    def runge_kutta(index: int, steps: int) -> Array:
        x, h = start_of(case, index), case.span / steps
        for _ in range(steps):
            a = rates(0.0, x)
            b = rates(0.0, x + h / 2 * a)
            c = rates(0.0, x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + rates(0.0, x + h * c))
        return x[:m]

    def timed(steps: int, index: int) -> Callable[[], Callable[[], Array]]:
        start = start_of(case, index)
        q, v = (np.tile(start[part][:, np.newaxis], 4 * steps) for part in places)
        torques, accelerations = np.zeros_like(v), np.empty_like(v)

        def evaluate() -> Callable[[], Array]:
            pinocchio.abaInParallel(1, pool, q, v, torques, accelerations)
            return partial(ends, index, steps)

        return evaluate

    ends, starts = lru_cache(maxsize=None)(runge_kutta), len(case.q)
    for steps in _counts(case, quick):
        name, setting = "Pinocchio aba, RK4 (bound)", f"h={case.span / steps:.4g}"
        yield Contender(name, setting, "4 aba a step in C++", seconds, partial(timed, steps), starts=starts)
    yield from dop853("aba from Python", seconds, case, quick, rates, LOOSE, "Pinocchio DOP853")


def _pinocchio_places(case: Case, model: Any) -> tuple[list[int], list[int]]:
    """Return the indices in (q, v) of a case of Pinocchio's positions and velocities, those of a free base first."""
    m = case.dimension
    names = [str(symbol) for symbol in case.system.coordinates]
    hinges = [names.index(name) for name in list(model.names)[1:] if name in names]
    if model.nq == model.nv:
        return hinges, [m + k for k in hinges]
    turn, omega = [m - 3, m - 2, m - 1, m - 4], range(case.size - 3, case.size)  # the one rotation is the last
    return [0, 1, 2, *turn, *hinges], [m, m + 1, m + 2, *omega, *(m + k for k in hinges)]


def _quaternion_rate(q: Array, omega: Array) -> Array:
    """Return q (omega, 0)/2 of a quaternion (x, y, z, w) and an angular velocity in the body frame."""
    x, w = q[:3], q[3]
    return np.append(w * omega + np.cross(x, omega), -x @ omega) / 2


def exudyn_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield adaptive DOPRI5, explicit Runge-Kutta methods, and generalised alpha without numerical damping."""
    with model_file(case.mjcf or "") as path:
        _, links, gravity, *_ = links_of_mjcf(path)
    settings = [("DOPRI5", value, f"rtol={value:.0e}") for value in LOOSE[: 2 if quick else None]]
    for name, most in EXUDYN_HALVINGS.items():
        counts = step_counts(case, range(2 if quick else most))
        settings += [(name, steps, f"h={case.span / steps:.4g}") for steps in counts]
    for name, value, setting in settings:
        prepare = partial(_exudyn_preparation, case, Tree(links, gravity), gravity, name, value)
        yield Contender(f"Exudyn {name}", setting, "kinematic tree", 0.0, prepare, starts=len(case.q))


def _exudyn_preparation(
    case: Case, tree: Tree, gravity: Array, name: str, value: float, index: int
) -> Callable[[], Array]:
    """Return a run of an integrator with a number of steps, or of DOPRI5 with a tolerance."""
    import exudyn
    from exudyn.itemInterface import NodeGenericODE2, ObjectKinematicTree

    exudyn.config.printToConsole = False
    joints, inertias = [each.joint for each in tree.links], [each.inertia for each in tree.links]
    names = [str(each) for each in case.system.coordinates]
    places = [names.index(each.name) for each in joints]
    q, v = (part[index][places].tolist() for part in (case.q, case.velocity))
    types = {"hinge": exudyn.JointType.RevoluteZ, "slide": exudyn.JointType.PrismaticZ}
    mbs = exudyn.SystemContainer().AddSystem()
    model = ObjectKinematicTree(
        nodeNumber=mbs.AddNode(NodeGenericODE2("", [0.0] * len(q), q, v, len(q))),
        gravity=gravity.tolist(),
        jointTypes=[types[each.kind] for each in joints],
        linkParents=[each.parent for each in tree.links],
        jointTransformations=exudyn.Matrix3DList([each.pose.rotation for each in joints]),
        jointOffsets=exudyn.Vector3DList([each.pose.position for each in joints]),
        linkInertiasCOM=exudyn.Matrix3DList([each.matrix for each in inertias]),
        linkCOMs=exudyn.Vector3DList([each.center for each in inertias]),
        linkMasses=[each.mass for each in inertias],
    )
    mbs.AddObject(model)
    mbs.Assemble()
    settings, solver = exudyn.SimulationSettings(), getattr(exudyn.DynamicSolverType, name)
    settings.solution.file.write, method = False, settings.timeIntegration
    method.endTime, method.generalizedAlpha.spectralRadius = case.span, 1.0
    method.automaticStepSize, method.numberOfSteps = (True, 10) if value < 1 else (False, value)
    method.relativeTolerance = method.absoluteTolerance = value

    def integrate() -> Array:
        if not mbs.SolveDynamic(settings, solverType=solver):
            raise ArithmeticError("Exudyn's solver failed")
        return np.asarray(mbs.systemData.GetODE2Coordinates())[np.argsort(places)]

    return integrate


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would otherwise write to a file MUJOCO_LOG.TXT."""
    import mujoco

    warnings_seen: list[str] = []
    before: Any = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings_seen.append)
    try:
        yield warnings_seen
    finally:
        mujoco.set_mju_user_warning(before)
