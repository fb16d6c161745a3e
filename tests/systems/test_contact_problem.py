"""The contact problem of cone.h: the decisions of 10,000 runs, and random problems beside a trial of all modes."""

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from contact_decisions import FORCES, IMPULSES, JUMP, decisions
from contact_problem import Problem, Vector, solve

pytestmark = pytest.mark.second
SMALL = 1e-10


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the compiled header."""
    return tmp_path_factory.mktemp("cone")


def test_decisions_of_runs_satisfy_the_conditions(folder: Path) -> None:
    """By forces from those before, in half of the cases from 0: a problem may have several solutions."""
    kinds: set[int] = set()
    for k, decision in enumerate(decisions()):
        problem = decision.problem
        answer = solve(problem, folder, decision.of_rows["start"] if k % 2 else 0.0)
        kinds.add(decision.kind)
        assert answer.solved == decision.solved
        assert not answer.solved or problem.violation(answer.f) < 1e-9
    assert kinds == {FORCES, IMPULSES, JUMP}


def test_other_forces_violate_them() -> None:
    """Of redundant contacts, too: a change of one force changes the rate of its own row."""
    for decision in itertools.islice(decisions(), 0, None, 50):
        force, problem = decision.of_rows["force"].copy(), decision.problem
        row = int(np.abs(force).argmax())
        if decision.solved and force[row] != 0:
            force[row] *= 1 + 1e-6 * max(1.0, problem.terms[row] / abs(force[row] * decision.W[row, row]))
            assert problem.violation(force) > 1e-9


Modes = tuple["str | float", ...]
"""``"open"``, ``"stick"``, or the direction of the slip, of each contact with one slip."""


def forces_in(problem: Problem, modes: Modes) -> Vector:
    """Forces with rates 0 of the gaps of closed contacts and of the slips of those that stick."""
    rows, columns, force = [], [], np.zeros(len(problem.b))
    unit = np.eye(len(force))
    for (n, t, _), mode, mu in zip(problem.places, modes, problem.friction, strict=True):
        slides = -mu * mode * unit[t] if isinstance(mode, float) else 0 * unit[t]
        if n >= 0 and mode != "open":
            rows.append(n)
            columns.append(unit[n] + slides)
        elif mode != "open":
            force += slides
        if mode == "stick":
            rows.append(t)
            columns.append(unit[t])
    if rows:
        along = np.transpose(columns)
        force += along @ np.linalg.solve(problem.W[rows] @ along, -(problem.b + problem.W @ force)[rows])
    return force


def is_consistent(problem: Problem, k: int, mode: str | float, force: Vector, u: Vector) -> bool:
    """Whether a contact satisfies the conditions of its mode."""
    n, t, _ = problem.places[k]
    normal = float(force[n]) if n >= 0 else 1.0
    if mode == "open":
        return bool(u[n] >= -SMALL)
    if isinstance(mode, float):
        return bool(normal >= -SMALL and (problem.given[k].any() or mode * u[t] >= -SMALL))
    return bool(normal >= -SMALL and abs(force[t]) <= problem.static[k] * normal + SMALL)


def all_modes(problem: Problem) -> Iterator[tuple[set[int], Vector]]:
    """Contacts that stick and rates of each consistent mode of contacts with one slip, by trial of all."""
    choices = [
        (*(("open",) if n >= 0 else ()), *((float(d[0]),) if d.any() else ("stick", 1.0, -1.0)))
        for (n, _, _), d in zip(problem.places, problem.given, strict=True)
    ]
    for modes in itertools.product(*choices):
        force = forces_in(problem, modes)
        u = problem.b + problem.W @ force
        if all(is_consistent(problem, k, mode, force, u) for k, mode in enumerate(modes)):
            yield {k for k, mode in enumerate(modes) if mode == "stick"}, u


def test_plane_contacts_have_one_of_all_modes_where_one_exists(folder: Path) -> None:
    """1 to 4 contacts, friction up to 5, half of the slips with a direction: there may be no solution, or several."""
    random, outcomes = np.random.default_rng(7), Counter[tuple[bool, bool]]()
    for case in range(300):
        count = int(random.integers(1, 5))
        rows, mu = random.normal(size=(2 * count, 8)), random.uniform(0.0, random.choice([1.0, 2.0, 5.0]), count)
        problem = Problem.at_rest(rows @ rows.T, rows @ random.normal(size=8), 1, mu)
        if case % 2:
            problem.given[:, 0] = random.choice([-1.0, 0.0, 1.0], count, p=[0.25, 0.5, 0.25])
        answer, modes = solve(problem, folder), [rates for _, rates in all_modes(problem)]
        outcomes[bool(modes), answer.solved] += 1
        assert not answer.solved or any(np.allclose(answer.u, u, atol=1e-8 * max(1.0, abs(u).max())) for u in modes)
    assert outcomes[False, False] > 1
    assert outcomes[True, False] <= 1
    assert outcomes[False, True] == 0


def test_static_contacts_stick_where_they_can(folder: Path) -> None:
    """Static friction up to 1.6 times the sliding one, also without gaps: no consistent mode sticks with more."""
    random = np.random.default_rng(3)
    for case in range(150):
        count, gaps = int(random.integers(2, 5)), bool(case % 2)
        rows = random.normal(size=(2 * count, 2 * count + 2))
        if not gaps:
            rows = (np.eye(count) - np.eye(count, k=-1)) / 10 ** random.uniform(-0.5, 0.5, count)
        mu = random.uniform(0.1, 0.8, count) if gaps else random.uniform(0.3, 2, count)
        loads = rows @ random.normal(size=rows.shape[1]) * (1 if gaps else random.uniform(1, 4))
        static = mu * random.uniform(1, 1.6, count)
        problem = Problem.at_rest(rows @ rows.T, loads, 1, mu, static=static, gaps=gaps)
        modes, answer = list(all_modes(problem)), solve(problem, folder)
        if modes:
            own = [sticks for sticks, u in modes if np.allclose(u, answer.u, atol=1e-7 * max(1.0, abs(u).max()))]
            assert own
            assert not any(max(own, key=len) < sticks for sticks, _ in modes)


@pytest.mark.parametrize(("slips", "most", "decades"), [(1, 20, 6), (2, 12, 2)])
def test_redundant_contacts_have_forces(folder: Path, slips: int, most: int, decades: int) -> None:
    """More rows than coordinates, of masses over decades, in half of the cases: impulses exist for all rates."""
    random = np.random.default_rng(slips)
    unsolved = 0
    for case in range(100):
        count = int(random.integers(1, most + 1))
        rows = (1 + slips) * count
        coordinates = int(random.integers(3, 8)) if case % 2 else rows + 2
        G = random.normal(size=(rows, coordinates)) / 10 ** random.uniform(-decades / 4, decades / 4, coordinates)
        problem = Problem.at_rest(G @ G.T, G @ random.normal(size=coordinates), slips, random.uniform(0, 1.2, count))
        answer = solve(problem, folder)
        unsolved += not answer.solved
        assert not answer.solved or problem.violation(answer.f) < 1e-10
    assert unsolved <= 1
