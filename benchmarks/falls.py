"""Robots that fall, by steps: a step beside MuJoCo's Euler step on the same file, in turns in one process."""

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.report import ResultTable
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen import LagrangianSystem, compile_stepper

STEP, SECONDS, CHUNK = 2e-3, 4.0, 250
"""Step size, time of a fall, and steps of one turn."""
THROWS, QUICK_THROWS = 10, 1
SIDES = ((1, 1), (-1, 1), (-1, -1), (1, -1))
HUMANOID = Path(__file__).parents[1] / "examples" / "humanoid.xml"


def ant() -> str:
    """Return the file of an ant: a ball with four legs of two hinges, with limits, armature and damping."""
    legs = "".join(
        f'<body><geom fromto="0 0 0 {x / 5} {y / 5} 0"/><body pos="{x / 5} {y / 5} 0">'
        f'<joint name="hip_{k}" axis="0 0 1" range="-30 30"/><geom fromto="0 0 0 {x / 5} {y / 5} 0"/>'
        f'<body pos="{x / 5} {y / 5} 0"><joint name="ankle_{k}" axis="{-y} {x} 0" range="30 70"/>'
        f'<geom fromto="0 0 0 {x * 0.4} {y * 0.4} 0"/></body></body></body>'
        for k, (x, y) in enumerate(SIDES, 1)
    )
    return (
        '<mujoco model="ant"><default><joint armature="1" damping="1"/><geom type="capsule" size=".08" density="5" '
        'friction="1" conaffinity="0"/></default><worldbody><geom type="plane" size="40 40 1" conaffinity="1"/>'
        '<body pos="0 0 .75"><freejoint name="root"/><geom type="sphere" size=".25"/>'
        f"{legs}</body></worldbody></mujoco>"
    )


def run_falls(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the processor times of steps of robots that are thrown at a floor, and their motion at the end."""
    rows = []
    with TemporaryDirectory() as folder:
        files = {"ant": Path(folder) / "ant.xml", "humanoid": HUMANOID}
        files["ant"].write_text(ant(), encoding="utf-8")
        for name, file in files.items():
            report_activity(f"contact:falls: {name}")
            rows.append({"robot": name} | _measured(file, QUICK_THROWS if plan.quick else THROWS))
    columns = dict.fromkeys(("ours", "worst", "MuJoCo", "ratio"), ".1f")
    return ResultTable(
        name="contact:falls",
        title=f"a step of {STEP:g} of robots that fall for {SECONDS:g} s beside MuJoCo's Euler (microseconds)",
        columns={"robot": ""} | columns | {"residual": ".0e", "speed": ".0e", "MuJoCo speed": ".0e"},
        rows=tuple(rows),
        remarks=("worst: the slowest step, called from Python; speeds: medians of the fastest coordinate at the end",),
    )


def _measured(file: Path, throws: int) -> dict[str, Any]:
    """Return the times of a step, mean and worst, the largest residual, and medians of the speeds at the end."""
    robot = LagrangianSystem.from_mjcf(file, limits="contact", contacts="planes")
    stepper = compile_stepper(robot, "svi:1", transitions="by steps")
    engine: Any = import_module("mujoco") if find_spec("mujoco") else None
    times: dict[str, list[float]] = {"ours": [], "MuJoCo": []}
    residuals, speeds, single = [], [], []
    for number in range(throws):
        q, v = _throw(robot, np.random.default_rng(number))
        run, soft = stepper.start(q, velocity=v, h=STEP), engine and _in_mujoco(engine, file, robot, q, v)
        for _ in range(round(SECONDS / STEP / CHUNK)):
            times["ours"].append(_seconds(partial(run.advance, CHUNK)))
            if soft:
                times["MuJoCo"].append(_seconds(partial(engine.mj_step, *soft, CHUNK)))
        speeds.append((abs(run.velocity).max(), abs(soft[1].qvel).max() if soft else np.nan))
        residuals.append(stepper.integrate(q, velocity=v, h=STEP, t_end=SECONDS).contact_residual)
        run = stepper.start(q, velocity=v, h=STEP)
        single += [_seconds(partial(run.advance, 1)) for _ in range(round(SECONDS / STEP))]
    ours, other = (1e6 * np.mean(of) / CHUNK if of else np.nan for of in times.values())
    at_end = dict(zip(("speed", "MuJoCo speed"), np.median(speeds, axis=0), strict=True))
    return {"ours": ours, "worst": 1e6 * max(single), "MuJoCo": other, "ratio": ours / other} | {
        "residual": max(residuals),
        **at_end,
    }


def _throw(robot: LagrangianSystem, random: np.random.Generator) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a pose above the floor, with bent ankles, and a velocity."""
    names = [name for name in map(str, robot.coordinates) if not name.startswith("R_")]
    bent = {name: random.uniform(0.6, 1.1) if name.startswith("ankle_") else 0.0 for name in names}
    turn = random.normal(size=4) * 0.4 + [1, 0, 0, 0]
    q = bent | {"z_root": 1.5, "R_root": turn / np.linalg.norm(turn)}
    return q, dict(zip(names, random.normal(size=len(names)) / 2, strict=True)) | {"omega_root": random.normal(size=3)}


def _in_mujoco(engine: Any, file: Path, robot: LagrangianSystem, q: dict[str, Any], v: dict[str, Any]) -> Any:
    """Return the model and the state in MuJoCo, whose coordinates are in the same order but for the quaternion."""
    model = engine.MjModel.from_xml_path(str(file))
    model.opt.timestep, model.opt.integrator = STEP, engine.mjtIntegrator.mjINT_EULER
    data, hinges = engine.MjData(model), [name for name in q if not name.endswith("_root")]
    data.qpos[:] = [*(q[f"{x}_root"] for x in "xyz"), *q["R_root"], *(q[name] for name in hinges)]
    data.qvel[:] = [*(v[f"{x}_root"] for x in "xyz"), *v["omega_root"], *(v[name] for name in hinges)]
    return model, data


def _seconds(work: Callable[[], Any]) -> float:
    """Return the processor time of a call."""
    began = time.process_time()
    work()
    return time.process_time() - began
