"""Numbers of ``benchmarks`` and ``reproduce``, recomputed independently from the raw figures in the same output.

Errors of positions and energies come from Runge-Kutta methods written out here and from SciPy's DOP853.
"""

import csv
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.integrate import solve_ivp

from benchmarks.__main__ import main as benchmarks
from benchmarks.cases.unforced import case
from scvi_codegen.interfaces.cli import main

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("here"), pytest.mark.rotated]

Array = Any
QUICK = 0.05
"""Part of the span that --quick integrates."""


def output_of(*words: str, command: click.Command = main) -> str:
    found = CliRunner().invoke(command, words)
    assert found.exit_code == 0, found.output
    return found.stdout


def gauss(stages: int) -> Array:
    return (1 + np.polynomial.legendre.leggauss(stages)[0]) / 2


def chebyshev_lobatto(degree: int) -> Array:
    return (1 - np.cos(np.pi * np.arange(1, degree + 1) / degree)) / 2  # without the start


def coefficients(nodes: Array) -> tuple[Array, Array]:
    """A and b: integrals of the Lagrange polynomials of the nodes to the nodes and to 1, by a quadrature."""
    x, weights = np.polynomial.legendre.leggauss(len(nodes))

    def to(end: float) -> Array:
        t = end * (1 + x) / 2
        others = [np.delete(nodes, j) for j in range(len(nodes))]
        return [
            end / 2 * weights @ np.prod((t[:, None] - o) / (c - o), axis=1) for c, o in zip(nodes, others, strict=True)
        ]

    return np.array([to(c) for c in nodes]), np.array(to(1.0))


def collocated(nodes: Array, rates: Callable[[Array], Array], x: Array, h: float, steps: int) -> Array:
    """(steps + 1, 2m) states by the Runge-Kutta method that collocates at the nodes, by fixed-point iteration."""
    a, b = coefficients(nodes)
    states = [np.asarray(x, float)]
    for _ in range(steps):
        k = np.tile(rates(states[-1]), (len(nodes), 1))
        for _ in range(200):
            before, k = k, np.array([rates(y) for y in states[-1] + h * a @ k])
            if np.abs(k - before).max() < 1e-15:
                break
        states.append(states[-1] + h * b @ k)
    return np.array(states)


@dataclass(frozen=True)
class Motion:
    """A unit mass: its force and its potential."""

    force: Callable[[Array], Array]
    potential: Callable[[Array], Array]

    def __call__(self, x: Array) -> Array:
        return np.array([x[1], self.force(x[0])])

    def energy(self, x: Array) -> Array:
        return x[:, 1] ** 2 / 2 + self.potential(x[:, 0])


PENDULUM = Motion(lambda x: -np.sin(x), lambda x: -np.cos(x))
DUFFING = Motion(lambda x: x - 8 * x**3 / 3, lambda x: 2 * x**4 / 3 - x**2 / 2)


def exact(rates: Callable[[Array], Array], x: Array, span: float) -> Array:
    return solve_ivp(lambda t, y: rates(y), (0, span), x, method="DOP853", rtol=3e-14, atol=1e-16).y[:, -1]


def seconds_at(points: list[tuple[float, float]], error: float) -> float:
    """Seconds at an error, on the line in logarithms through the settings that no other one beats."""
    points = sorted(points)
    best = [p for n, p in enumerate(points) if all(p[1] < other[1] for other in points[:n])]
    reached = next((n for n, p in enumerate(best) if p[1] < 1e-13), len(best) - 1)
    seconds, errors = np.array(best[: reached + 1]).T
    return float(np.exp(np.interp(-np.log(error), -np.log(errors), np.log(seconds))))


def test_rows_of_benchmarks_follow_from_their_measurements():
    """Ratios at equal error, and the settings shown."""
    text = output_of("planar-pendulum", "--quick", "--peers", "scipy", "-o", "report.json", command=benchmarks)
    (found,) = json.loads(Path("report.json").read_text())["cases"]
    of: dict[str, list[Any]] = {row["method"]: [] for row in found["rows"]}
    for each in found["measurements"]:
        assert 0.0 < each["fastest"] <= each["seconds"]
        of[each["method"]].append(each)
    (ours,) = (name for name in of if "svi-8" in name)
    (peer,) = of.keys() - {ours}
    points = {name: [(each["seconds"], each["error"]) for each in of[name]] for name in of}
    floors = {name: max(1e-13, 2 * least if (least := min(e for _, e in points[name])) > 1e-13 else 0.0) for name in of}
    common = max(floors.values())
    for row in found["rows"]:
        name, at_error = row["method"], row["at_error"]
        assert at_error == pytest.approx(floors[name])
        assert row["seconds"] == pytest.approx(seconds_at(points[name], at_error))
        expected = seconds_at(points[peer], common) / seconds_at(points[name], common)
        assert row["peer"] == pytest.approx(expected if name == ours else 1.0)
        assert row["default"] is row["best"] is None
        reaching = [each for each in of[name] if max(each["error"], 1e-13) <= at_error]
        shown = min(reaching, key=lambda each: each["seconds"])
        assert row["setting"] == shown["setting"]
        cells = f"{1e3 * shown['seconds']:.3g} +{shown['error']:.1e} +{shown['compile_seconds']:.2f} +- +- "
        assert re.search(rf"\n  {name} .* {cells} +{row['peer']:.2f} +{at_error:.1e}\b", text)


def test_errors_of_benchmarks_are_those_of_their_settings():
    """SVI(8) with 8 Gauss points is the Gauss method of 8 stages for these Lagrangians."""
    text = output_of("planar-pendulum", "--quick", "--peers", "", "-o", "report.json", command=benchmarks)
    (found,) = json.loads(Path("report.json").read_text())["cases"]
    problem = case("planar-pendulum")
    assert found["span"] == problem.span * QUICK
    assert f"T = {found['span']:g}, m = 1 (reference accurate to {found['reference_accuracy']:.0e})" in text
    starts = np.concatenate([problem.q, problem.velocity], axis=1)
    ends = np.array([collocated(gauss(10), PENDULUM, start, found["span"] / 200, 200)[-1, 0] for start in starts])
    checked = 0
    for each in found["measurements"]:
        if each["error"] > 1e-11:
            steps = round(found["span"] / float(re.match(r"h=(\S+)", each["setting"])[1]))
            runs = [collocated(gauss(8), PENDULUM, start, found["span"] / steps, steps) for start in starts]
            error = np.linalg.norm([run[-1, 0] for run in runs] - ends) / np.linalg.norm(ends)
            assert each["error"] == pytest.approx(error, rel=0.02)
            checked += 1
    assert checked >= 2


@pytest.mark.full
def test_energy_errors_of_the_paper_follow_from_methods_written_out():
    """Energy errors of Figs. 10 and 12, the settings of Tables 6 and 7, from the methods in NumPy."""
    output_of("reproduce", "figure-10", "figure-12", "--jobs", "1", "-o", "out")
    for figure, motion, start, h, steps, methods in (
        (10, PENDULUM, (0.5, 0.0), 0.5, 2000, {"SRK4": gauss(2), "SVI, degree 3": gauss(3), "SC, degree 3": 3}),
        (12, DUFFING, (0.0, 1.0), 0.6, 3333, {"SRK6": gauss(3), "SVI, degree 5": gauss(5), "SC, degree 5": 5}),
    ):
        with Path(f"out/figure-{figure}.csv").open(newline="") as file:
            rows = {row["method"]: row for row in csv.DictReader(file)}
        for name, nodes in methods.items():
            run = collocated(
                chebyshev_lobatto(nodes) if isinstance(nodes, int) else nodes, motion, np.array(start), h, steps
            )
            energy = motion.energy(run)
            error = float(rows[name]["largest energy error"])
            assert error == pytest.approx(np.abs(energy - energy[0]).max(), rel=1e-2)
            assert int(rows[name]["steps"]) == steps


def kepler(x: Array) -> Array:
    return np.concatenate([x[2:], -x[:2] / np.hypot(*x[:2]) ** 3])


def euler(x: Array, h: float, steps: int) -> Array:
    states = [x]
    for _ in range(steps):
        states.append(states[-1] + h * kepler(states[-1]))
    return np.array(states)


def verlet(x: Array, h: float, steps: int) -> Array:
    states = [x]
    for _ in range(steps):
        q, p = np.split(states[-1], 2)
        p = p + h / 2 * kepler(np.append(q, p))[2:]
        q = q + h * p
        states.append(np.append(q, p + h / 2 * kepler(np.append(q, p))[2:]))
    return np.array(states)


def test_reproduced_numbers_of_keplers_problem():
    """Energies and areas of figure 1 from the four methods in NumPy; its text from its table."""
    text = output_of("reproduce", "figure-1", "--jobs", "1", "-o", "out") and Path("out/figure-1.txt").read_text()
    text = " ".join(text.split())
    with Path("out/figure-1.csv").open(newline="") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    start = np.array([0.4, 0.0, 0.0, 2.0])
    runs = {
        "explicit Euler": euler(start, 0.0025, 40_000),
        "Stoermer-Verlet": verlet(start, 0.1, 1000),
        "symplectic Runge-Kutta": collocated(gauss(3), kepler, start, 0.25, 400),
        "Chebyshev collocation": collocated(chebyshev_lobatto(4), kepler, start, 0.25, 400),
    }
    found = {}
    for name, run in runs.items():
        row, (x, y, u, v) = rows[name], run.T
        energy = (u**2 + v**2) / 2 - 1 / np.hypot(x, y)
        area = np.pi * np.abs(x * v - y * u) / (-2 * energy) ** 1.5
        three = round(6 * np.pi / float(row["h"]))
        expected = area[-three:].mean() / area[:three].mean() - 1, np.abs(energy - energy[0]).max()
        found[name] = [float(row[column]) for column in list(row)[3:5]]
        assert int(row["steps"]) == len(run) - 1
        assert found[name] == pytest.approx(expected, rel=1e-6)
    for which in (("explicit Euler", "Chebyshev collocation"), ("Stoermer-Verlet", "symplectic Runge-Kutta")):
        areas = ", ".join(f"{found[name][0]:+.2%} ({name})" for name in which)
        assert f"Change of the area of the ellipse: {areas}." in text
    errors = ", ".join(f"{found[name][1]:.1e} ({name})" for name in ("Chebyshev collocation", "explicit Euler"))
    assert f"Largest energy error: {errors}." in text
