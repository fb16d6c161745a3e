"""Collocation in position form by its fixed-point iteration: where it exists, and that it finds what Newton finds."""

import numpy as np
import pytest
from samples import fixed_point

import scvi_codegen as sc

POSITION = (
    sc.SpectralCollocation(1),
    sc.SpectralCollocation(8),
    sc.Gauss(4, form="position"),
    sc.RadauIIA(2, form="position"),
    sc.RadauIA(3, form="position"),
    sc.LobattoIIIA(3, form="position"),
    sc.CollocationRK([0.0, 0.5], form="position"),
    sc.ExplicitEuler(form="position"),
)
PRINTED = (
    sc.SCVI(2, variational=False),
    sc.SCVI(8, variational=False),
    sc.SCVI(3, "gauss-lobatto:6", variational=False),
)
COUPLED = ("double-pendulum", "pumped-cart-pole", "charged-particle", "relativistic-particle", "spherical-pendulum")
named = {"ids": lambda value: getattr(value, "name", value)}


@pytest.mark.tiers(9)
@pytest.mark.parametrize("method", [*POSITION, *PRINTED], **named)
def test_every_coupled_system_has_an_iteration_on_accelerations(sample, method):
    kinds = {fixed_point(sample(name).system, method).name for name in COUPLED}
    assert kinds == {"collocation"}


def test_separable_systems_iterate_on_positions_but_for_the_printed_form(sample):
    system = sample("kepler").system
    assert {fixed_point(system, method).name for method in POSITION} == {"separable"}
    assert {fixed_point(system, method).name for method in PRINTED} == {"collocation"}
    assert fixed_point(system, sc.SCVI(1, variational=False)).name == "separable"


@pytest.mark.rotated
def test_more_points_than_lanes_use_newton(sample):
    system = sample("double-pendulum").system
    assert fixed_point(system, sc.SpectralCollocation(32)) is not None
    assert fixed_point(system, sc.SpectralCollocation(33)) is None
    assert fixed_point(system, sc.SCVI(2, "gauss-legendre:33", variational=False)) is None


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", [sc.SVI(3), sc.SCVI(2), sc.SpectralCollocation(3), PRINTED[0]], **named)
def test_start_from_rest_does_not_need_newton(sample, compiled, method):
    """Velocities that vanish are no measure of what is small."""
    q, p = sample("double-pendulum").state
    steps = [
        compiled("double-pendulum", method, solver=solver).step(q, 0 * p, 0.01) for solver in ("fixed-point", "newton")
    ]
    assert np.abs(np.subtract(*steps)).max() < 1e-14


@pytest.mark.second
@pytest.mark.parametrize("method", [sc.SpectralCollocation(3), PRINTED[0]], **named)
def test_stored_velocity_is_recomputed_for_new_parameters(sample, compiled, method):
    stepper = compiled("pumped-cart-pole", method, solver="fixed-point")
    run = stepper.start(*sample("pumped-cart-pole").state, h=0.05)
    run.record(5)
    heavier = {"m": 1.5, "M": 1.2}
    state, t = (run.q.copy(), run.p.copy()), run.t
    continued = stepper.from_checkpoint(run.checkpoint(), parameters=heavier).record(1)
    q, p = stepper.step(*state, 0.05, t, heavier)
    assert np.abs([continued.q[-1] - q, continued.p[-1] - p]).max() < 1e-14
