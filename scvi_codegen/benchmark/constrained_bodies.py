"""Constrained bodies in this package and in MuJoCo: the same masses, lengths and initial states.

    chain      5 masses of 1/5 on rods of 1/5, released from 0.6 (the first) to 0.3 from the vertical; MuJoCo uses
               joint angles, which satisfy the constraints identically
    four-bar   masses at the two joints of rods of 1, 2 and 1.5 between points that are 2 apart; MuJoCo closes the loop
               by its equality ``connect``

A contender is a function of (step size, number of steps) that returns the spread of the energies at the ends of ten
equal parts, the largest error of the rod lengths there, and the processor time of the steps. It raises
:class:`ArithmeticError` if a step is too large.

Benchmark of constrained bodies: errors of energy and rod lengths of this package and of MuJoCo at equal time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array
from scvi_codegen.benchmark.report import FLOOR, OURS, Point, ResultTable, error_at
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

GRAVITY = 9.81
PARTS = 10
"""Number of parts of a run; energies are computed after each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Linkage:
    """Masses in the plane at (x, y), and rods between two of them, or one and a fixed point.

    Attributes:
        rods: (i, j); i < 0 is the fixed point ``anchors[-1 - i]``.
        closed: True if the last rod ends at a fixed point: a closed loop.
    """

    name: str
    masses: tuple[float, ...]
    start: tuple[tuple[float, float], ...]
    rods: tuple[tuple[int, int], ...]
    anchors: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    closed: bool = False

    def point(self, i: int) -> Array:
        """Return the initial position of a mass, or a fixed point."""
        return np.array(self.anchors[-1 - i] if i < 0 else self.start[i])

    def length(self, i: int, j: int) -> float:
        """Return the length of a rod."""
        return float(np.linalg.norm(self.point(j) - self.point(i)))

    @property
    def weight(self) -> float:
        """Unit of energy errors: the weight of all masses times a length of 1."""
        return GRAVITY * sum(self.masses)


def hanging_chain(n: int) -> Linkage:
    """Return a chain of n rods."""
    angles = np.linspace(0.6, 0.3, n)
    positions = np.cumsum(np.column_stack([np.sin(angles), -np.cos(angles)]) / n, axis=0)
    return Linkage(
        name="chain",
        masses=(1.0 / n,) * n,
        start=tuple(map(tuple, positions.tolist())),
        rods=tuple((i - 1, i) for i in range(n)),
    )


def four_bar() -> Linkage:
    """Return a four-bar linkage at rest; the second joint follows from the first."""
    first, end, b, c = np.array([0.0, 1.0]), np.array([2.0, 0.0]), 2.0, 1.5
    difference = float(np.linalg.norm(end - first))
    along = (difference**2 + b**2 - c**2) / (2 * difference)
    towards = (end - first) / difference
    second = first + along * towards + np.sqrt(b**2 - along**2) * np.array([-towards[1], towards[0]])
    return Linkage(
        name="four-bar",
        masses=(1.0, 1.0),
        start=(tuple(first.tolist()), tuple(second.tolist())),
        rods=((-1, 0), (0, 1), (1, -2)),
        anchors=((0.0, 0.0), (2.0, 0.0)),
        closed=True,
    )


LINKS = 5
LINKAGES: Mapping[str, Callable[[], Linkage]] = {"chain": lambda: hanging_chain(LINKS), "four-bar": four_bar}
"""Functions that build a case, by name."""


@dataclass(frozen=True, slots=True)
class ContenderRun:
    """Result of a run: processor seconds of its steps, spread of the energy, largest relative error of a rod length."""

    seconds: float
    energy: float
    length_error: float


def our_motion(linkage: Linkage, method: str) -> Callable[[float, int], ContenderRun]:
    """Return a run with constraints in Cartesian coordinates."""
    n = len(linkage.masses)
    kinetic = " + ".join(f"{linkage.masses[i]!r}*(x{i}_dot**2 + y{i}_dot**2)/2" for i in range(n))
    weights = " ".join(f"- {linkage.masses[i] * GRAVITY!r}*y{i}" for i in range(n))
    constraints = []
    for i, j in linkage.rods:
        (a, b), (c, d) = (
            map(repr, map(float, linkage.anchors[-1 - k])) if k < 0 else (f"x{k}", f"y{k}") for k in (i, j)
        )
        constraints.append(f"({c} - {a})**2 + ({d} - {b})**2 - {linkage.length(i, j) ** 2!r}")
    system = LagrangianSystem.from_text(
        name=f"{linkage.name} on rods",
        coordinates=[f"{axis}{i}" for i in range(n) for axis in "xy"],
        lagrangian=f"{kinetic} {weights}",
        constraints=constraints,
    )
    stepper = compile_stepper(system, method)
    q, p = stepper.project(np.ravel(linkage.start))

    def move(h: float, steps: int) -> ContenderRun:
        run, seconds, energies, worst = stepper.start(q, p, h=h), 0.0, [float(stepper.energy(q, p))], 0.0
        for _ in range(PARTS):
            began = time.process_time()
            run.advance(steps // PARTS)
            seconds += time.process_time() - began
            energies.append(float(stepper.energy(run.q, run.p)))
            worst = max(worst, _length_error(linkage, run.q.reshape(n, 2)))
        return ContenderRun(seconds, float(np.ptp(energies)), worst)

    return move


def _length_error(linkage: Linkage, positions: Array) -> float:
    """Return the largest relative error of a rod length."""
    result = 0.0
    for i, j in linkage.rods:
        ends = [np.array(linkage.anchors[-1 - k]) if k < 0 else positions[k] for k in (i, j)]
        length = linkage.length(i, j)
        result = max(result, abs(float(np.linalg.norm(ends[1] - ends[0])) - length) / length)
    return result


def mujoco_motion(linkage: Linkage, integrator: str, *, stiff: bool = False) -> Callable[[float, int], ContenderRun]:
    """Return a run of MuJoCo: hinges, and for a closed loop its equality constraint, soft or as stiff as a step allows.

    Raises:
        ImportError: without ``mujoco``.
    """
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # otherwise it writes MUJOCO_LOG.TXT to the working directory

    def move(h: float, steps: int) -> ContenderRun:
        model = mujoco.MjModel.from_xml_string(_document(linkage, integrator, h, stiff=stiff))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        seconds, energies, length_error = 0.0, [float(data.energy.sum())], 0.0
        with _warnings() as warnings_seen:
            for _ in range(PARTS):
                began = time.process_time()
                mujoco.mj_step(model, data, nstep=steps // PARTS)
                seconds += time.process_time() - began
                mujoco.mj_forward(model, data)
                energies.append(float(data.energy.sum()))
                positions = data.site_xpos[:, [0, 2]]
                length_error = max(length_error, _length_error(linkage, positions[: len(linkage.masses)]))
        if warnings_seen:
            raise ArithmeticError(warnings_seen[0])
        return ContenderRun(seconds, float(np.ptp(energies)), length_error)

    return move


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would otherwise write to a file MUJOCO_LOG.TXT."""
    import mujoco

    warnings_seen: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings_seen.append)
    try:
        yield warnings_seen
    finally:
        mujoco.set_mju_user_warning(before)


def _document(linkage: Linkage, integrator: str, h: float, *, stiff: bool) -> str:
    """Return MJCF: bodies nested along the rods; y is MuJoCo's z, the axis of hinges its y."""
    open_rods = linkage.rods[:-1] if linkage.closed else linkage.rods
    bodies, tail = "", ""
    for i, j in open_rods:
        last = linkage.closed and (i, j) == open_rods[-1]
        at, to = linkage.point(i), linkage.point(j)
        before = np.zeros(2) if i < 0 else at - linkage.point(open_rods[open_rods.index((i, j)) - 1][0])
        mass = linkage.masses[j] / (2.0 if last else 1.0)
        bodies += _body(f"b{j}", before, to - at, mass, f"s{j}")
        tail = "</body>" + tail
    loop, equality = "", ""
    if linkage.closed:
        i, j = linkage.rods[-1]
        end, other = linkage.point(j), linkage.point(i)
        loop = _body("closing", end, other - end, linkage.masses[i] / 2.0, "closing") + "</body>"
        soft = f'solref="{2 * h!r} 1" solimp="0.9999 0.9999 0.001 0.5 2"' if stiff else ""
        equality = f'<equality><connect site1="s{i}" site2="closing" {soft}/></equality>'
    return f"""<mujoco>
      <option timestep="{h!r}" integrator="{integrator}" gravity="0 0 {-GRAVITY}" tolerance="1e-15" iterations="200">
        <flag contact="disable" energy="enable"/>
      </option>
      <worldbody>{bodies}{tail}{loop}</worldbody>{equality}
    </mujoco>"""


def _body(name: str, before: Array, rod: Array, mass: float, site: str) -> str:
    """Return the opening of a body: a hinge at a position of its parent, with a mass at the end of a rod."""
    position, end = (" ".join(map(repr, (float(x), 0.0, float(y)))) for x, y in (before, rod))
    return (
        f'<body name="{name}" pos="{position}"><joint type="hinge" axis="0 1 0"/>'
        f'<inertial pos="{end}" mass="{mass!r}" diaginertia="1e-12 1e-12 1e-12"/><site name="{site}" pos="{end}"/>'
    )


SPAN = 10.0
METHODS = ("svi:1", "svi:2", "svi:4")
OUR_STEPS = (2000, 1000, 500, 250, 100)
"""Numbers of steps in the span."""
STEPS = (10000, 5000, 2000, 1000)
"""Numbers of steps of MuJoCo, whose default is 5000."""
INTEGRATORS = ("Euler", "implicitfast", "RK4")
LOST = 1.0
"""Energy change, in units of the weight, above which results are not compared."""

Move = Callable[[float, int], ContenderRun]


def run_constrained_bodies(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure all rows; those of MuJoCo state the reason if it is not installed."""
    rows: list[dict[str, Any]] = []
    for name, make in LINKAGES.items():
        linkage, constrained = make(), []
        for method in METHODS[: 1 if plan.quick else None]:
            report_activity(f"held: {name} by {method}")
            constrained += list(_rows(linkage, f"{OURS} {method}", our_motion(linkage, method), OUR_STEPS, plan))
        theirs = [row for label, move in _others(linkage) for row in _rows(linkage, label, move, STEPS, plan)]
        result = [row | _beside(row, _points(constrained)) for row in theirs] or [
            {"by": "MuJoCo", "why_not": "pip install mujoco"}
        ]
        rows += [{"bodies": name} | row for row in (*constrained, *result)]
    return ResultTable(
        name="constrained-bodies",
        title="constrained bodies: errors of energy and rod lengths over ten seconds",
        columns={
            "bodies": "",
            "by": "",
            "h": "g",
            "second_us": ".0f",
            "energy": ".1e",
            "stretch": ".0e",
            "ours_then": ".1e",
            "ratio": ".2g",
            "why_not": "",
        },
        rows=tuple(rows),
        remarks=(
            "second: processor microseconds per second of simulated time; energy: its largest change, in units of",
            "all weights times 1; stretch: of a rod, as a part of its length; ours then: that energy by constraints of",
            "this project at equal time, between its settings; ratio: theirs over ours.",
        ),
    )


def _others(linkage: Linkage) -> Iterator[tuple[str, Move]]:
    """Yield MuJoCo's integrators; closed loops also with the stiffest constraint that the step allows."""
    try:
        import mujoco  # noqa: F401  (whether it is there)
    except ImportError:
        return
    for integrator in INTEGRATORS:
        for stiff in (False, True)[: 2 if linkage.closed else 1]:
            label = f"MuJoCo {integrator}{', stiff' * stiff}"
            yield label, mujoco_motion(linkage, integrator, stiff=stiff)


def _rows(linkage: Linkage, by: str, move: Move, counts: Sequence[int], plan: Plan) -> Iterator[dict[str, Any]]:
    """Yield one row for each step size, with the median of the times."""
    span = SPAN * plan.share
    for count in (each for each in counts if each * plan.share >= PARTS):
        h = SPAN / count
        try:
            runs = [move(h, round(span / h)) for _ in range(plan.rounds)]
        except ArithmeticError as error:  # too large a step
            yield {"by": by, "h": h, "why_not": str(error)}
            continue
        energy = runs[0].energy / linkage.weight
        seconds = float(np.median([run.seconds for run in runs]))
        lost = {} if energy < LOST else {"why_not": "step too large: the energy error exceeds the weight"}
        yield {
            "by": by,
            "h": h,
            "second_us": 1e6 * seconds / span,
            "energy": energy,
            "stretch": runs[0].length_error,
        } | lost


def _points(rows: Sequence[dict[str, Any]]) -> list[Point]:
    return [Point(seconds=row["second_us"], error=row["energy"]) for row in rows if "why_not" not in row]


def _beside(row: dict[str, Any], points: list[Point]) -> dict[str, Any]:
    """Return the energy error of this package in the time of a row."""
    if "why_not" in row:
        return {}
    ours = error_at(points, row["second_us"])
    return {"ours_then": ours, "ratio": None if ours is None else row["energy"] / max(ours, FLOOR)}
