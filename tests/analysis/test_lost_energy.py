"""Relative error of the conserved energy after a run to a tolerance, compared with its definition."""

import math
import re

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.analysis.advice.tolerance_check import _lost_energy, _tenfold


@pytest.mark.tiers(0, 2)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("mass", "offset"), [(1.0, 0.0), (1e3, 0.0), (1e-3, 0.0), (1e3, 7e4)])
def test_energy_error_is_relative_to_energy_and_twice_the_kinetic_energy(mass, offset):
    """A coarse run of an anharmonic oscillator; the size does not vanish where the energy does."""
    system = lagrange("oscillator", "x", "m*x_dot**2/2 - m*(x**2/2 + x**4/4) - offset", m=mass, offset=offset)
    run = sc.compile_stepper(system, "svi:1").integrate([1.0], velocity=[0.3], h=0.2, steps=50, t=0.4)
    x, p = run.q[:, 0], run.p[:, 0]
    energy = p**2 / (2 * mass) + mass * (x**2 / 2 + x**4 / 4) + offset
    expected = np.abs(energy - energy[0]).max() / (np.abs(energy).max() + (p**2 / mass).max())
    found = re.search(r"relative error of (\S+)$", _lost_energy(run, 1e-9))
    assert found is not None
    assert float(found[1]) == pytest.approx(expected, rel=0.05)
    assert _lost_energy(run, expected) == ""


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_time_of_tenfold_growth_is_that_of_an_exponential(rate):
    """Of distances from a start without one; growth by a power of time has no such time."""
    t = np.linspace(0.0, 4.0, 129)
    assert _tenfold(1e-12 * 10.0 ** (rate * t) * (t > 0.0), 4.0) == pytest.approx(1 / rate, rel=1e-12)
    assert _tenfold(1e-12 * t**2, 4.0) == math.inf
