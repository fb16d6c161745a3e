"""Contacts: constraints in some modes only, whose forces are oblique where they slide."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import sympy
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.systems.constraints.kind import Reaction
from scvi_codegen.systems.formulas.symbols import symbol

MU = 0.3
CLOSED, STICKS, DIRECTION = map(symbol, ("closed", "sticks", "direction"))


def in_contact(system: Any, gap: sympy.Expr, slip: sympy.Expr, d: sympy.Expr = DIRECTION) -> Any:
    """Return the system with a contact in one row, whose masks are parameters."""
    q, v = system.coordinates, system.velocities
    normal, along = ([sympy.diff(f, x) for x in xs] for f, xs in ((gap, q), (slip, v)))
    sliding = tuple(a - sympy.Rational(3, 10) * d * b for a, b in zip(normal, along, strict=True))
    return replace(
        system,
        parameters=(*system.parameters, CLOSED, STICKS, DIRECTION),
        defaults=(*system.defaults, 0.0, 0.0, 0.0),
        constraints=(gap, slip),
        reactions=(
            Reaction(active=CLOSED, direction=sliding),
            Reaction(active=CLOSED * STICKS, direction=tuple(along)),
        ),
    )


@cache
def rod(degree: int) -> Any:
    """Return the stepper of a rod of length 2 whose end touches the floor."""
    system = sc.LagrangianSystem.from_text(
        name="rod", coordinates=["x", "y", "a"], lagrangian="(x_dot**2 + y_dot**2)/2 + a_dot**2/6 - y"
    )
    (_, y, a), (vx, _, va) = system.coordinates, system.velocities
    return sc.compile_stepper(in_contact(system, y - sympy.cos(a), vx - sympy.cos(a) * va), f"svi:{degree}")


MASS = np.array([1.0, 1.0, 1 / 3])


def explicit_rod(_: float, x: NDArray[Any], sticks: bool) -> NDArray[Any]:
    """Return the rates of positions and velocities with the multipliers in closed form."""
    a, v = x[2], x[3:]
    normal, along = np.array([0.0, 1.0, np.sin(a)]), np.array([1.0, 0.0, -np.cos(a)])
    rows, forces = [normal], [normal - MU * along]
    rests = [np.cos(a) * v[2] ** 2]
    if sticks:
        rows, forces, rests = [normal, along], [normal, along], [*rests, np.sin(a) * v[2] ** 2]
    R, C, weight = np.array(rows), np.array(forces), np.array([0.0, -1.0, 0.0])
    multipliers = np.linalg.solve(R @ (C / MASS).T, -(R @ (weight / MASS) + rests))
    return np.concatenate([v, (weight + C.T @ multipliers) / MASS])


@pytest.mark.parametrize(("degree", "largest"), [(1, 3e-5), (2, 3e-9), (3, 1e-13)])
@pytest.mark.parametrize("sticks", [False, True])
def test_sliding_and_sticking_keep_the_order(degree: int, largest: float, sticks: bool) -> None:
    a, rate = 0.4, 0.3
    velocity = np.array([rate * np.cos(a) if sticks else 2.0, -np.sin(a) * rate, rate])
    start = np.array([0.0, np.cos(a), a])
    true = solve_ivp(explicit_rod, (0, 0.6), [*start, *velocity], "DOP853", rtol=1e-13, atol=1e-14, args=(sticks,)).y[
        :, -1
    ]
    mode = {"closed": 1.0, "sticks": float(sticks), "direction": 1.0 - sticks}
    errors = []
    for n in (4, 8, 16):
        run = rod(degree).integrate(start, velocity=velocity, h=0.6 / n, steps=n, parameters=mode)
        errors.append(np.abs(np.concatenate([run.q[-1], run.velocity[-1]]) - true).max())
    assert errors[-1] < largest
    assert np.log2(errors[0] / errors[1]) > 2 * degree - 0.2
    closed = explicit_rod(0.0, np.concatenate([run.q[-1], run.velocity[-1]]), sticks)[3:]
    assert run.multipliers()[-1, 0] == pytest.approx(closed[1] + 1.0, abs=1e-3 if degree == 1 else 1e-8)
    assert (run.multipliers()[-1, 1] == 0.0) != sticks


def test_an_open_contact_changes_nothing() -> None:
    run = rod(3).integrate([0.0, 2.0, 0.3], velocity=[1.0, 0.0, 0.4], h=0.1, steps=5)
    assert np.allclose(run.q[-1], [0.5, 2.0 - 0.125, 0.5], atol=1e-15)
    assert not run.multipliers().any()


@pytest.mark.parametrize(("degree", "order", "largest"), [(1, 2, 3e-4), (2, 4, 1e-7), (3, 6, 1e-10)])
def test_the_direction_of_sliding_in_space_turns(degree: int, order: int, largest: float) -> None:
    system = sc.LagrangianSystem.from_text(
        name="bowl", coordinates=["x", "y", "z"], lagrangian="(x_dot**2 + y_dot**2 + z_dot**2)/2 - z"
    )
    (x, y, z), (vx, vy, vz) = system.coordinates, system.velocities
    gap = (z - (x**2 + y**2) / 2) / sympy.sqrt(1 + x**2 + y**2)
    speed = sympy.sqrt(vx**2 + vy**2 + vz**2)
    touching = in_contact(system, gap, vx)
    normal, _ = touching.reactions
    oblique = tuple(
        sympy.diff(gap, a) - sympy.Rational(1, 5) * b / speed
        for a, b in zip(system.coordinates, system.velocities, strict=True)
    )
    touching = replace(touching, reactions=(replace(normal, direction=oblique), touching.reactions[1]))

    def rates(_: float, state: NDArray[Any]) -> NDArray[Any]:
        u, v = state[:3], state[3:]
        root = np.sqrt(1 + u[0] ** 2 + u[1] ** 2)
        up = np.array([-u[0], -u[1], 1.0]) / root
        force = (v[0] ** 2 + v[1] ** 2) / root + up[2]
        return np.concatenate([v, force * (up - 0.2 * v / np.linalg.norm(v)) - [0.0, 0.0, 1.0]])

    start = [1.0, 0.0, 0.5, 0.3, 0.8, 0.3]
    true = solve_ivp(rates, (0, 1), start, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    stepper, errors = sc.compile_stepper(touching, f"svi:{degree}"), []
    for n in (8, 16):
        run = stepper.integrate(start[:3], velocity=start[3:], h=1 / n, steps=n, parameters={"closed": 1.0})
        errors.append(np.abs(np.concatenate([run.q[-1], run.velocity[-1]]) - true).max())
    assert errors[-1] < largest
    assert np.log2(errors[0] / errors[1]) > order - 0.3


def test_a_multiplier_is_an_event() -> None:
    system = sc.LagrangianSystem.from_text(
        name="bead", coordinates=["x", "y"], lagrangian="(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"]
    )
    start = [0.05, np.sqrt(1 - 0.05**2)]
    leaves = sc.Event("lambda_1", terminal=True)
    run = sc.compile_stepper(system, "svi:4").integrate(start, velocity=[0, 0], t_end=5, events=leaves)
    assert run.q[-1, 1] == pytest.approx(2 / 3 * start[1], abs=1e-13)
    assert abs(run.multipliers()[-1, 0]) < 1e-13
