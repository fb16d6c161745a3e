"""The port of IRKGL16: coefficients, order, and the energy errors that its authors published."""

import numpy as np
import pytest

from benchmarks.cases.published import black_hole_momentum, published_case
from benchmarks.cases.unforced import Formulation, case
from benchmarks.contenders.irkgl16 import STAGES, Port, is_second_order, tables

EXTENDED = np.longdouble
needs_extended = pytest.mark.skipif(np.finfo(EXTENDED).eps > 1e-18, reason="long double is no wider than double here")
pytestmark = pytest.mark.second


def test_coefficients_are_symplectic_in_doubles_and_extrapolate_polynomials():
    c, b, *columns = tables()
    mu, eta, nu = (np.transpose(columns[k : k + STAGES]) for k in (0, STAGES, 2 * STAGES))
    above = np.triu_indices(STAGES, 1)
    assert np.array_equal(mu[above], 1.0 - mu.T[above])
    assert np.array_equal(eta[above], eta.T[above] + c[above[0]] - c[above[1]])
    for power in range(1, STAGES + 1):
        np.testing.assert_allclose(mu @ (b * power * c ** (power - 1)), c**power, atol=1e-15)
        # the stage increments of t^power in a step carry it into the next one
        np.testing.assert_allclose(nu @ (b * power * c ** (power - 1)), (1 + c) ** power - 1, rtol=1e-10)
    np.testing.assert_allclose(eta @ b, c**2 / 2, atol=1e-16)


def energies(port, start, energy, h, chunk, samples):
    """Return the largest relative energy error, that between samples, and the iterations per step."""
    advance = port.start(start)
    values, iterations = [energy(start.astype(EXTENDED))], 0
    for _ in range(samples):
        state, count = advance(h, chunk)
        values.append(energy(state.astype(EXTENDED)))
        iterations += count
    values = np.array(values)
    errors = np.abs(values / values[0] - 1).max(), np.abs(values[1:] / values[:-1] - 1).max()
    return *map(float, errors), iterations / (chunk * samples)


@pytest.mark.second
@needs_extended
@pytest.mark.usefixtures("as_users_compile")
class TestPublished:
    """Outputs of the authors' notebooks: relative energy errors over a thousand samples of the run."""

    @pytest.mark.parametrize(
        ("h", "largest", "local", "iterations"), [(24.0, 8.4487e-12, 3.8260e-12, 3.53), (12.0, 6e-16, 1.2e-16, 4)]
    )
    def test_black_hole(self, h, largest, local, iterations):
        chosen = published_case("black-hole")
        values = [EXTENDED(x) for x in chosen.system.defaults]
        q = np.array([11.0, np.pi / 2])
        start = np.array([*q, 0.0, black_hole_momentum(q, *chosen.system.defaults)])

        def energy(x):
            by_angle = x[0] * np.sin(x[1])
            potential = (values[1] / by_angle - values[2] / 2 * by_angle) ** 2 - x[0] / (x[0] - 2) * values[0] ** 2
            return potential / 2 + (1 - 2 / x[0]) * x[2] ** 2 / 2 + (x[3] / x[0]) ** 2 / 2

        assert energy(start.astype(EXTENDED)) == pytest.approx(-0.5, abs=1e-15)
        found = energies(Port(chosen, chosen.formulations[1]), start, energy, h, round(9984 / h), 1001)
        if h == 24.0:  # truncation
            assert found == (
                pytest.approx(largest, rel=1e-4),
                pytest.approx(local, rel=1e-4),
                pytest.approx(iterations, rel=0.04),
            )
        else:  # round-off
            assert np.all(np.less(found, (1.5 * largest, 1.5 * local, iterations)))


@pytest.mark.second
@needs_extended
@pytest.mark.parametrize("second_order", [True, False])
def test_the_order_is_16(second_order):
    chosen = case("kepler:0.5")
    port = Port(chosen, chosen.formulations[0], second_order)
    span, errors = 12.0, []
    exact = (
        Port(chosen, chosen.formulations[0])
        .start(np.concatenate([chosen.q[0], chosen.velocity[0]]))(span / 60, 60)[0]
        .copy()
    )
    for steps in (14, 18, 24):
        state, _ = port.start(np.concatenate([chosen.q[0], chosen.velocity[0]]))(span / steps, steps)
        errors.append(np.abs(state - exact).max())
    assert errors[-1] > 1e-12
    assert np.log(errors[0] / errors[-1]) / np.log(24 / 14) == pytest.approx(16, abs=2)


def test_second_order_forms_are_recognised():
    expected = {"kepler:0.5": True, "fput-chain:8": True, "double-pendulum": False}
    for name, second in expected.items():
        chosen = case(name)
        assert is_second_order(chosen.formulations[0], chosen) == second
    driven = Formulation(name="driven", rates=lambda x, of, functions: [x[1], functions.sin(functions.time) - x[0]])
    assert is_second_order(driven, case("duffing"))
    damped = Formulation(name="damped", rates=lambda x, of, functions: [x[1], -x[0] - x[1]])
    assert not is_second_order(damped, case("duffing"))
