"""Modes of contacts at random states, compared with all modes that satisfy the conditions."""

import itertools
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from numpy.typing import NDArray

import scvi_codegen as sc

pytestmark = pytest.mark.rotated
CONTACTS, M = 3, 6
SMALL, SAME = 1e-12, 1e-8
Matrix = NDArray[np.float64]


def consistent(rows: Matrix, slips: Matrix, forces: Matrix, friction: Matrix, rates: Matrix) -> list[Matrix]:
    """Return the accelerations of all consistent modes of contacts in a plane, by trial of each.

    Args:
        rows, slips: (k, m) gaps and slips by the velocities, both divided by the Cholesky factor of the mass.
        forces: (m,) applied.
        friction, rates: (k,) coefficients and slips at the state.
    """
    found: list[Matrix] = []
    choices: list[Sequence[Any]] = [
        ("open", np.sign(w)) if abs(w) > SMALL else ("open", "stick", 1.0, -1.0) for w in rates
    ]
    for modes in itertools.product(*choices):
        imposed, pushed, owner = [], [], []
        for k, mode in enumerate(modes):
            if mode == "stick":
                imposed += [rows[k], slips[k]]
                pushed += [rows[k], slips[k]]
                owner += [k, k]
            elif mode != "open":
                imposed.append(rows[k])
                pushed.append(rows[k] - friction[k] * mode * slips[k])
                owner.append(k)
        matrix, along = np.reshape(imposed, (-1, M)), np.reshape(pushed, (-1, M))
        multipliers = np.linalg.solve(matrix @ along.T, -matrix @ forces) if owner else np.empty(0)
        acceleration = forces + along.T @ multipliers
        holds = True
        for k, mode in enumerate(modes):
            own = multipliers[[j for j, each in enumerate(owner) if each == k]]
            if mode == "open":
                holds &= rows[k] @ acceleration >= -SMALL
            elif mode == "stick":
                holds &= own[0] >= -SMALL and abs(own[1]) <= friction[k] * own[0] + SMALL
            else:
                starts = abs(rates[k]) > SMALL or mode * (slips[k] @ acceleration) >= -SMALL
                holds &= own[0] >= -SMALL and starts
        if holds and not any(np.allclose(acceleration, other, atol=SAME) for other in found):
            found.append(acceleration)
    return found


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("seed", "largest"), [(0, 2.0), (1, 5.0)])
def test_runs_have_one_of_all_consistent_modes_and_say_whether_there_are_several(seed: int, largest: float) -> None:
    """Particles m = 1 of constant forces with up to three contacts, whose normals and slips are neither orthogonal."""
    names = [f"x_{i}" for i in range(M)]
    numbers = {f"{kind}_{k}_{i}": 0.0 for kind in "gw" for k in range(CONTACTS) for i in range(M)}
    numbers |= {f"{kind}_{k}": 0.0 for kind in ("mu", "away") for k in range(CONTACTS)} | {f"f_{x}": 0.0 for x in names}
    contacts = [
        sc.contact(
            " + ".join([f"away_{k}", *(f"g_{k}_{i}*{x}" for i, x in enumerate(names))]),
            slip=" + ".join(f"w_{k}_{i}*{x}_dot" for i, x in enumerate(names)),
            friction=f"mu_{k}",
        )
        for k in range(CONTACTS)
    ]
    text = " + ".join(f"{x}_dot**2/2 + f_{x}*{x}" for x in names)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sc.SystemDefinitionWarning)  # parameters of contacts alone
        stepper = sc.compile_stepper(lagrange("random", " ".join(names), text, **numbers), "svi:1", contacts=contacts)
    random, outcomes = np.random.default_rng(seed), []
    for _ in range(200):
        forces, (rows, slips) = random.normal(size=M), random.normal(size=(2, CONTACTS, M))
        friction, count = random.uniform(0.0, largest, CONTACTS), random.integers(1, CONTACTS + 1)
        rests = random.random(count) < 0.5
        imposed = np.concatenate([rows[:count], slips[:count][rests]])
        velocity = random.normal(size=M) * (len(imposed) < M)
        velocity -= np.linalg.pinv(imposed) @ (imposed @ velocity)
        states = consistent(rows[:count], slips[:count], forces, friction, slips[:count] @ velocity)
        values = dict(
            zip(numbers, [*rows.ravel(), *slips.ravel(), *friction, *np.zeros(CONTACTS), *forces], strict=True)
        )
        values |= {f"away_{k}": 100.0 for k in range(count, CONTACTS)}
        outcomes.append(min(len(states), 2))
        start: dict[str, Any] = {"velocity": velocity, "h": 1e-6, "steps": 1, "parameters": values}
        if not states:
            ends = "neither forces nor impulses|impact without collision"
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", ".*several motions")  # after the impact
                with pytest.raises((sc.ContactError, sc.EventWarning), match=ends):
                    stepper.integrate(np.zeros(M), **start)
            continue
        with warnings.catch_warnings(record=True) as issued:
            warnings.simplefilter("always")
            acting = stepper.integrate(np.zeros(M), **start).contact_forces()[0]
        acceleration = forces + rows.T @ acting[:, 0] + slips.T @ acting[:, 1]
        assert any(np.allclose(acceleration, other, atol=1e-5) for other in states)
        assert any("several motions" in str(each.message) for each in issued) == (len(states) > 1)
    assert np.all(np.bincount(outcomes, minlength=3) > [0, 100, 0])


@pytest.mark.tiers(0, 1)
def test_independent_contacts_have_their_own_scales() -> None:
    """A block that is pressed with 1e12 times the weight of one that slides to v^2 / (2 mu)."""
    contacts = [sc.contact(gap, slip=slip, friction=0.3) for gap, slip in (("y", "x_dot"), ("u", "z_dot"))]
    text = "(x_dot**2 + y_dot**2 + z_dot**2 + u_dot**2)/2 - G*y - u"
    stepper = sc.compile_stepper(lagrange("blocks", "x y z u", text, G=1e12), "svi:3", contacts=contacts)
    run = stepper.integrate([0.0] * 4, velocity=[0, 0, 1, 0], h=0.1, t_end=5.0)
    assert run.q[-1] == pytest.approx([0.0, 0.0, 1 / 0.6, 0.0], abs=1e-14)
    assert run.contact_modes[-1] == (pytest.approx(1 / 0.3), ("stick", "stick"))


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("start", [0.0, 0.123])
def test_a_limit_lifts_by_a_small_force_in_free_fall(start: float) -> None:
    """A force of 1e-6 of the weight that changes its sign at the start, and s'' = f (1/m + 1/M) after it."""
    text = "(z_dot**2 + 2*(z_dot + s_dot)**2)/2 - 10*(z + 2*(z + s)) + 2e-5*(t - T)*s"
    stepper = sc.compile_stepper(lagrange("limit", "z s", text, T=start), "svi:2", contacts=[sc.contact("s")])
    for steps in ({"h": 0.05}, {"tolerance": 1e-8}):
        run = stepper.integrate([0.0] * 2, velocity=[0.0] * 2, t_end=0.5, **steps)
        assert [len(each.t) for each in run.transitions] == [0, 1]
        assert run.transitions[1].t[0] == pytest.approx(start, abs=1e-8)
        assert run.q[-1, 1] == pytest.approx(2e-5 * (0.5 - start) ** 3 / 6 * (1 + 1 / 2), rel=1e-7)


@pytest.mark.second
@pytest.mark.parametrize("height", [0.0, 0.2])
def test_a_straight_leg_lands_at_the_limit_of_its_joint(height: float) -> None:
    """Forces on the corners of the foot, whose gaps are 0 but for the rounding of b - c - 2 l, cancel at the joint."""
    text = "m*((x_dot - l*a_dot*cos(a))**2 + (y_dot + l*a_dot*sin(a))**2 + r**2*a_dot**2 - 2*g*(y - l*cos(a)))/2"
    numbers = {"M": 2.0, "m": 0.7, "l": 0.05, "r": 0.1, "g": 9.81, "b": 0.3, "c": 0.2}
    system = lagrange("leg", "x y a", f"{text} + M*(x_dot**2 + y_dot**2 - 2*g*y)/2", **numbers)
    foot = [sc.contact(f"y + b - c - 2*l*cos(a) {s} r*sin(a)", slip="x_dot", friction=0.7) for s in "+-"]
    stepper = sc.compile_stepper(system, "svi:3", contacts=[sc.contact("a"), *foot])
    run = stepper.integrate([0.3, height, 0.0], velocity=[0.0] * 3, h=0.01, t_end=0.5)
    assert run.contact_modes[-1][1][1:] == ("stick", "stick")


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("friction", "jumps"),
    [("where(x_dot > w, 1, 2)", True), ("2 - sign(w - x_dot)", True), ("1 + abs(x_dot - w)", False), ("2 + x", False)],
)
def test_friction_that_jumps_where_slip_vanishes_is_refused(friction: str, jumps: bool) -> None:
    system = lagrange("mass", "x", "x_dot**2/2 - x**2/w", w=0.5)
    make = [sc.friction("x_dot - w", limit=friction)]
    if not jumps:
        assert sc.compile_stepper(system, "svi:1", contacts=make)
        return
    with pytest.raises(sc.SystemDefinitionError, match="at rest would depend on the motion before"):
        sc.compile_stepper(system, "svi:1", contacts=make)
