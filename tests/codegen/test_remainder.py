"""Energies do not drift: the remainder that the fixed-point iteration leaves is added to the last update.

The slope of the energy of an oscillator is measured in rounding errors (2^-53 of the energy) per step. A remainder that
is left out has the same sign in each period: rates of 1 to 200. The tables of the remainder are compared with the
matrices that they stand for.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

from scvi_codegen import LagrangianSystem, compile_stepper
from scvi_codegen.codegen.lowering.solvers.tables import remainder_tables

LARGEST_SLOPE = 0.25
"""Largest admissible drift of the energy, in rounding errors per step."""
STEPS = 20_000
OSCILLATOR = LagrangianSystem.from_text("oscillator", ["x"], "x_dot**2/2-4*x**2/2")
RING = lagrange("ring", "u[N]", "sum(i in N, u_dot[i]**2/2) - sum(i in N periodic, (u[i+1]-u[i])**2/2)")
WORST = [
    ("svi:2", 0.9),
    ("svi:2", 2.0),
    ("svi:4", 0.6),
    ("svi:4", 3.0),
    ("svi:6", 1.5),
    ("svi:8", 2.5),
    ("gauss:3", 0.9),
]
"""Where the rates were largest."""


def slope(system: LagrangianSystem, method: str, q: list[float], angle: float) -> float:
    """Return the slope of the energy."""
    run = compile_stepper(system, method, flags=QUICK_FLAGS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # large steps
        found = run.integrate(q, [0.0] * len(q), h=angle / 2, steps=STEPS, save_every=STEPS // 200)
    assert not np.sum(found.fallback_steps)
    energy = np.asarray(found.energy())
    per_step = np.polyfit(np.arange(len(energy)) * (STEPS // 200), energy - energy[0], 1)[0]
    return float(abs(per_step / energy[0]) * 2**53)


@pytest.mark.tiers(1, 1)
@pytest.mark.sampled(4)
@pytest.mark.parametrize(("method", "angle"), WORST)
def test_the_energy_of_an_oscillator_does_not_drift(method, angle):
    assert slope(OSCILLATOR, method, [1.0], angle) <= LARGEST_SLOPE


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("method", "angle"), [("svi:4", 0.6), ("svi:8", 2.5)])
@pytest.mark.rotated
def test_the_energy_of_a_lattice_does_not_drift(method, angle):
    assert slope(RING, method, [*np.sin(np.pi * 14 / 16 * (np.arange(16) + 0.5))], angle) <= LARGEST_SLOPE


def test_tables_of_the_remainder_are_those_of_the_matrix():
    generator = np.random.default_rng(5)
    product, weights = generator.normal(size=(5, 5)) / 10, generator.normal(size=(2, 5))
    tables = remainder_tables(tuple(map(tuple, product)), *map(tuple, weights), 8)
    for stiffness in (0.2, -0.7):
        powers = stiffness ** np.arange(1, 9)
        geometric = -stiffness * product @ np.linalg.inv(np.eye(5) + stiffness * product)
        determinant = 1 + powers @ np.array(tables.determinant, float)
        for table, row in zip((tables.position, tables.momentum), weights, strict=True):
            assert np.array(table, float)[:5] @ powers / determinant == pytest.approx(row @ geometric, rel=1e-12)
