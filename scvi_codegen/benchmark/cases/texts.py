"""Systems from two to some thousand coordinates as text, for measuring compile times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np

AXES = "xyz"


@dataclass(frozen=True, slots=True, kw_only=True)
class SystemText:
    """Lagrangian as text, and an initial state.

    Attributes:
        name: name of the system.
        coordinates: names of the coordinates; all initial momenta are 0.
        lagrangian: formula.
        start: (m,) positions at which it is defined.
        parameters: default values by name.
    """

    name: str
    coordinates: tuple[str, ...]
    lagrangian: str
    start: tuple[float, ...]
    parameters: dict[str, float] = field(default_factory=dict)


def kepler() -> SystemText:
    """Return the planar Kepler problem."""
    return SystemText(
        name="Kepler",
        coordinates=("q1", "q2"),
        lagrangian="(q1_dot**2 + q2_dot**2)/2 + mu/sqrt(q1**2 + q2**2)",
        start=(0.5, 0.0),
        parameters={"mu": 1.0},
    )


def links(n: int) -> SystemText:
    """Return a pendulum of n unit masses in a chain."""
    masses = [[n - max(i, j) for j in range(n)] for i in range(n)]
    kinetic = (f"{masses[i][j]}*cos(q{i} - q{j})*q{i}_dot*q{j}_dot/2" for i in range(n) for j in range(n))
    return SystemText(
        name=f"{n} links",
        coordinates=tuple(f"q{i}" for i in range(n)),
        lagrangian=_sum((*kinetic, *(f"{n - i}*g*cos(q{i})" for i in range(n)))),
        start=tuple(0.3 + 0.1 * i for i in range(n)),
        parameters={"g": 9.81},
    )


def chain(n: int) -> SystemText:
    """Return a chain of n unit masses between walls with quartic springs (FPUT, beta)."""
    names = tuple(f"q{i}" for i in range(1, n + 1))
    stretched = [f"({b} - {a})" for a, b in pairwise(("0", *names, "0"))]
    return SystemText(
        name=f"chain of {n}",
        coordinates=names,
        lagrangian=_sum((*(f"{q}_dot**2/2" for q in names), *(f"-{s}**2/2 - beta*{s}**4/4" for s in stretched))),
        start=tuple(float(x) for x in np.sin(np.pi * np.arange(1, n + 1) / (n + 1))),
        parameters={"beta": 0.3},
    )


def bodies(n: int) -> SystemText:
    """Return n gravitating bodies in space."""
    names = [f"b{i}" for i in range(n)]
    return SystemText(
        name=f"{n} bodies",
        coordinates=_cartesian(names),
        lagrangian=_sum(
            (
                *(f"m_{a}*{_square(a)}/2" for a in names),
                *(f"m_{a}*m_{b}/{_distance(a, b)}" for a, b in combinations(names, 2)),
            )
        ),
        start=_grid(n),
        parameters={f"m_{a}": 1.0 / (1.0 + i) for i, a in enumerate(names)},
    )


def lennard_jones(n: int) -> SystemText:
    """Return n atoms in space."""
    names = [f"a{i}" for i in range(n)]
    pairs = (
        f"4*epsilon*((sigma/{_distance(a, b)})**6 - (sigma/{_distance(a, b)})**12)" for a, b in combinations(names, 2)
    )
    return SystemText(
        name=f"Lennard-Jones {n}",
        coordinates=_cartesian(names),
        lagrangian=_sum((*(f"mass*{_square(a)}/2" for a in names), *pairs)),
        start=_grid(n),
        parameters={"mass": 1.0, "epsilon": 1.0, "sigma": 1.0},
    )


def cloth(n: int) -> SystemText:
    """Return n by n unit masses in space, with springs of length 1 along the threads, under gravity."""
    names = [f"p{i}_{j}" for i in range(n) for j in range(n)]
    threads = [(i * n + j, i * n + j + 1) for i in range(n) for j in range(n - 1)]
    threads += [(i * n + j, (i + 1) * n + j) for i in range(n - 1) for j in range(n)]
    springs = (f"-k*({_distance(names[a], names[b])} - 1)**2/2" for a, b in threads)
    return SystemText(
        name=f"cloth {n} x {n}",
        coordinates=_cartesian(names),
        lagrangian=_sum((*(f"{_square(a)}/2 - g*{a}_z" for a in names), *springs)),
        start=tuple(float(x) for i in range(n) for j in range(n) for x in (1.1 * i, 1.1 * j, 0.01 * i * j)),
        parameters={"k": 100.0, "g": 9.81},
    )


def post_newtonian(n: int) -> SystemText:
    """Return point masses with first post-Newtonian corrections (Einstein, Infeld, Hoffmann)."""
    names = [f"b{i}" for i in range(n)]
    kinetic = [f"m_{a}*({_square(a)}/2 + {_square(a)}**2/(8*c2))" for a in names]
    squared = (
        f"-m_{a}*({_sum(f'm_{b}/{_distance(a, b)}' for b in names if b != a)})**2/(2*c2)"
        for a in names
    )  # fmt: skip
    return SystemText(
        name=f"post-Newtonian {n}",
        coordinates=_cartesian(names),
        lagrangian=_sum((*kinetic, *(_relativistic_pair(a, b) for a, b in combinations(names, 2)), *squared)),
        start=_grid(n),
        parameters={f"m_{a}": 1.0 / (1.0 + i) for i, a in enumerate(names)} | {"c2": 1e4},
    )


def _relativistic_pair(a: str, b: str) -> str:
    product = "(" + " + ".join(f"{a}_{x}_dot*{b}_{x}_dot" for x in AXES) + ")"
    along = ["(" + " + ".join(f"({a}_{x} - {b}_{x})*{c}_{x}_dot" for x in AXES) + ")" for c in (a, b)]
    r = _distance(a, b)
    correction = f"3*({_square(a)} + {_square(b)}) - 7*{product} - {along[0]}*{along[1]}/{r}**2"
    return f"m_{a}*m_{b}/{r}*(1 + ({correction})/(2*c2))"


def _sum(terms: Iterable[str]) -> str:
    return " + ".join(terms)


def _cartesian(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{name}_{x}" for name in names for x in AXES)


def _square(a: str) -> str:
    """Return the square of a speed."""
    return "(" + " + ".join(f"{a}_{x}_dot**2" for x in AXES) + ")"


def _distance(a: str, b: str) -> str:
    return "sqrt(" + " + ".join(f"({a}_{x} - {b}_{x})**2" for x in AXES) + ")"


def _grid(n: int) -> tuple[float, ...]:
    """Return positions in space, at least 1.2 apart, slightly irregular."""
    side = int(np.ceil(n ** (1 / 3)))
    points = np.array([(i, j, k) for i in range(side) for j in range(side) for k in range(side)][:n])
    return tuple(float(x) for x in (1.3 * points + 0.04 * np.sin(1.0 + 5.0 * np.arange(3 * n).reshape(n, 3))).ravel())
