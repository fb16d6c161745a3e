"""Multibody systems as models of MuJoCo, which this package reads: chains of hinges, robots on a free base, a linkage.

The linkage is written in Cartesian coordinates with constraints instead, because its loop is closed; its errors are
those of the positions of its two masses.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cases.unforced import Array, Case
from scvi_codegen.systems.lagrangian import LagrangianSystem

CHAINS = (2, 5, 10, 30)
"""Numbers of hinges."""
GRAVITY = 9.81
AXES = ("1 0 0", "0 1 0")
ROD = '<inertial pos="0 0 -0.5" mass="1" diaginertia="0.0833 0.0833 0.01"/>'
LIMB = '<inertial pos="0 0 -0.1" mass="{}" diaginertia="0.005 0.005 0.001"/>'


@contextmanager
def model_file(mjcf: str) -> Iterator[Path]:
    """Write a model of MuJoCo to a file, for readers of files."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(mjcf, encoding="utf-8")
        yield path


def _model(bodies: str, others: str = "") -> str:
    return f'<mujoco><option gravity="0 0 {-GRAVITY}"/><worldbody>{bodies}</worldbody>{others}</mujoco>'


def _case(name: str, mjcf: str, q: Sequence[float], velocity: Sequence[float], span: float, **others: Any) -> Case:
    system = others.pop("system", None)
    if system is None:
        with model_file(mjcf) as path:
            system = LagrangianSystem.from_mjcf(path, name=name)
    return Case(
        name=f"robots:{name}",
        system=system,
        q=np.array([q], dtype=float),
        velocity=np.array([velocity], dtype=float),
        span=span,
        step=others.get("step", 0.04),
        mjcf=mjcf,
    )


def chain(n: int) -> Case:
    """Return a chain of rods on hinges about alternate horizontal axes, released from rest."""
    bodies = (
        f'<body name="b{i}" pos="0 0 {-1 if i else 0}"><joint name="q{i}" axis="{AXES[i % 2]}"/>{ROD}' for i in range(n)
    )
    return _case(
        f"chain:{n}", _model("".join(bodies) + "</body>" * n), np.linspace(0.4, 0.6, n).tolist(), [0.0] * n, span=2.0
    )


def quadruped() -> Case:
    """Return a trunk with four legs of three hinges each, in free fall, tumbling and paddling; without contact."""
    legs, hinges = "", 0
    for x, y in ((0.3, 0.15), (0.3, -0.15), (-0.3, 0.15), (-0.3, -0.15)):
        for part, (position, axis) in enumerate(
            (((x, y, 0.0), AXES[0]), ((0, 0, 0), AXES[1]), ((0, 0, -0.2), AXES[1]))
        ):
            place = " ".join(map(str, position))
            inertia = LIMB.format((0.7, 1.0, 0.3)[part])
            legs += f'<body name="l{hinges}" pos="{place}"><joint name="q{hinges}" axis="{axis}"/>{inertia}'
            hinges += 1
        legs += "</body>" * 3
    trunk = '<freejoint name="base"/><inertial pos="0 0 0" mass="6" diaginertia="0.05 0.2 0.22"/>'
    angles, speeds = np.tile([0.1, 0.6, -1.2], 4), np.tile([0.5, 2.0, -3.0], 4) * np.linspace(1.0, 0.7, hinges)
    mjcf = _model(f'<body name="trunk" pos="0 0 0">{trunk}{legs}</body>')
    q, velocity = [0.0, 0.0, 1.0, *angles, 1.0, 0.0, 0.0, 0.0], [0.3, 0.0, 1.0, *speeds, 0.4, 1.0, 0.2]
    return _case("quadruped", mjcf, q, velocity, span=1.0)


def tree(degrees: int, span: float) -> Case:
    """Return limbs of hinges on a free base, with random inertias and velocities, in free fall."""
    chance, hinges = random.Random(1), degrees - 6
    limbs = 4 if hinges <= 14 else 5
    bodies, first = "", 0
    for limb in range(limbs):
        count = hinges // limbs + (limb < hinges % limbs)
        bodies += "".join(_hinged(k, chance) for k in range(first, first + count)) + "</body>" * count
        first += count
    trunk = '<freejoint name="base"/><inertial pos="0.01 0.02 0.03" mass="6" diaginertia="0.05 0.2 0.22"/>'
    mjcf = _model(f'<body name="trunk" pos="0 0 1">{trunk}{bodies}</body>')
    q, velocity = [0.0, 0.0, 1.0, *[0.0] * hinges, 1.0, 0.0, 0.0, 0.0], np.random.default_rng(1).uniform(-1, 1, degrees)
    return _case(f"tree:{degrees}:{span:g}", mjcf, q, velocity.tolist(), span=span, step=0.25)


def _hinged(number: int, chance: random.Random) -> str:
    """Return the opening of a body on a hinge, somewhere near its parent, with a random inertia."""

    def uniform(size: float, count: int) -> str:
        return " ".join(f"{chance.uniform(-size, size):.5f}" for _ in range(count))

    mass = chance.uniform(0.3, 2.0)
    inertia = " ".join(f"{mass * moment:.6f}" for moment in (0.004, 0.005, 0.006))
    return (
        f'<body name="b{number}" pos="{uniform(0.15, 3)}" euler="{uniform(40, 3)}"><joint name="q{number}" '
        f'axis="{("1 0 0", "0 1 0", "0 0 1")[number % 3]}"/><inertial pos="{uniform(0.05, 3)}" '
        f'quat="{uniform(1, 4)}" mass="{mass:.5f}" diaginertia="{inertia}"/>'
    )


def four_bar() -> Case:
    """Return masses at the two joints of rods of 1, 2 and 1.5 between points that are 2 apart, released from rest."""
    first, end, b, c = np.array([0.0, 1.0]), np.array([2.0, 0.0]), 2.0, 1.5
    distance = float(np.linalg.norm(end - first))
    along, towards = (distance**2 + b**2 - c**2) / (2 * distance), (end - first) / distance
    second = first + along * towards + np.sqrt(b**2 - along**2) * np.array([-towards[1], towards[0]])
    system = LagrangianSystem.from_text(
        name="four-bar",
        coordinates=["x0", "y0", "x1", "y1"],
        lagrangian=f"(x0_dot**2 + y0_dot**2 + x1_dot**2 + y1_dot**2)/2 - {GRAVITY}*(y0 + y1)",
        constraints=["x0**2 + y0**2 = 1", f"(x1 - x0)**2 + (y1 - y0)**2 = {b**2}", f"(x1 - 2)**2 + y1**2 = {c**2}"],
    )
    zero = np.zeros(2)
    bodies = _rod("s0", zero, first, 1.0) + _rod("s1", first, second - first, 0.5) + "</body></body>"
    bodies += _rod("closing", end, second - end, 0.5) + "</body>"
    mjcf = _model(bodies, '<equality><connect site1="s1" site2="closing"/></equality>')
    q, rest = [*first, *second], [0.0] * 4
    return _case("four-bar", mjcf, q, rest, span=2.0, system=system)


def _rod(site: str, before: Array, rod: Array, mass: float) -> str:
    """Return the opening of a body: a hinge at a position of its parent, with a mass at the end of a rod."""
    position, end = (" ".join(map(repr, (float(x), 0.0, float(y)))) for x, y in (before, rod))
    return (
        f'<body pos="{position}"><joint type="hinge" axis="0 1 0"/>'
        f'<inertial pos="{end}" mass="{mass!r}" diaginertia="1e-12 1e-12 1e-12"/><site name="{site}" pos="{end}"/>'
    )


ROBOTS: Mapping[str, Callable[[], Case]] = {
    **{f"chain:{n}": partial(chain, n) for n in CHAINS},
    "quadruped": quadruped,
    "four-bar": four_bar,
}
"""Functions that build a case, by the name after ``robots:``."""
TREES = {f"tree:{m}:{span}": partial(tree, m, span) for m in (18, 35, 49) for span in (1, 10)}
"""The same for robots on a free base, by their degrees of freedom and the duration of the motion."""
