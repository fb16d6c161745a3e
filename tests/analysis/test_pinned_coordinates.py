"""Certificates of systems with coordinates that constraints hold at 0, where terms cancel up to rounding."""

from typing import Any

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc

RATTLE = sc.SVI(1, "gauss-lobatto:2")
ROD = {
    "lagrangian": "(x0_dot**2 + y0_dot**2 + x1_dot**2 + y1_dot**2)/2 - g*(y0 + y1)",
    "constraints": ["x0", "y0", "(x1 - x0)**2 + (y1 - y0)**2 - 1/100"],
    "parameters": {"g": 9.81},
}


def rod(**arguments: Any) -> Any:
    """A mass on a rod from a support at the origin, which is a coordinate, too."""
    return sc.LagrangianSystem.from_text("rod", ["x0", "y0", "x1", "y1"], **ROD, **arguments)


def point(*constraints: str) -> Any:
    """A heavy point."""
    formula = "(x_dot**2 + y_dot**2)/2 - 9.81*y"
    return sc.LagrangianSystem.from_text("point", ["x", "y"], formula, constraints=list(constraints))


def chain() -> Any:
    """Masses on rods, of any number."""
    return sc.LagrangianSystem.from_text(
        "chain",
        ["r[N, 2]"],
        "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2 - g*r[i, 1])",
        parameters={"g": 9.81},
        constraints=[*("r[0, 0] = 0", "r[0, 1] = 0"), "sum(a in 2, (r[i+1, a] - r[i, a])**2) = 1/100 for i in 0..N-2"],
    )


CASES: dict[str, tuple[Any, Any, Any, float]] = {
    "rod": (rod, RATTLE, [0.0, 0.0, 0.1, 0.0], 0.01),
    "hanging rod": (rod, sc.SVI(2, "gauss-lobatto:3"), [0.0, 0.0, 0.0, -0.1], 0.01),
    "damped rod": (lambda: rod(forces={"x1": "-x1_dot"}), sc.SVI(2, "gauss-lobatto:3"), [0.0, 0.0, 0.1, 0.0], 0.01),
    "chain of arrays": (chain, "stoermer-verlet", [[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]], 0.01),
    "truss": (lambda: point("x**2 + y**2 - 1", "(x - 2)**2 + y**2 - 3"), RATTLE, [0.5, 0.75**0.5], 0.1),
    "fixed at the origin": (lambda: point("x", "y"), RATTLE, [0.0, 0.0], 0.1),
    "slides without a force": (lambda: point("y"), RATTLE, [0.5, 0.0], 0.1),
}


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", CASES)
def test_pinned_coordinates_are_certified(name: str) -> None:
    make, method, q, h = CASES[name]
    certificate = sc.verify(make(), method, q, np.zeros_like(q), h=h)
    assert certificate.passed, certificate.to_text()


@pytest.mark.rotated
@pytest.mark.parametrize(("degree", "h"), [(2, 0.01), (3, 0.005)])
def test_constraints_of_long_runs_hold_to_rounding(degree: int, h: float, as_users_compile: object) -> None:
    """Rounding at the pinned coordinates ended the iteration of the others at changes of 1e-11."""
    stepper = sc.compile_stepper(rod(), sc.SVI(degree, f"gauss-lobatto:{degree + 1}"))
    run = stepper.integrate([0.0, 0.0, 0.1, 0.0], np.zeros(4), h=h, steps=2000)
    values = [np.concatenate(stepper.constraint_values(q, p, 0.0)) for q, p in zip(run.q, run.p, strict=True)]
    assert np.abs(values).max(axis=0) == pytest.approx(0.0, abs=2e-16)
    assert run.iterations[1:].max() <= 7
    assert run.iterations[1:].mean() < 5.5


@pytest.mark.second
def test_a_structure_at_rest_continues_from_its_own_state() -> None:
    """Its momenta are rounding errors, which violated the rates of the constraints by 1 (relative)."""
    stepper = sc.compile_stepper(point("x**2 + y**2 - 1", "(x - 2)**2 + y**2 - 3"), RATTLE, flags=QUICK_FLAGS)
    run = stepper.integrate([0.5, 0.75**0.5], [0.0, 0.0], h=0.1, steps=7)
    again = stepper.integrate(run.q[-1], run.p[-1] + 1e-20, h=0.1, steps=7)
    assert np.abs(again.p).max() < 1e-14
    assert stepper.multipliers(run.q[-1], run.p[-1], 0.0) == pytest.approx(stepper.multipliers(run.q[0], run.p[0], 0.0))
