"""Kinetic energies that couple the velocities of one element: loops over any number of them, and threads."""

import numpy as np
import pytest
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.systems.legendre.of_arrays import site_hamiltonian

N = 7
RNG = np.random.default_rng(0)
Q, V, MASS = RNG.normal(size=N), RNG.normal(size=N), 1 + RNG.random(N)
CHAIN = "sum(i in N, m[i]*(1 + q[i]**2)*q_dot[i]**2/2 - q[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2)"
CHARGES = (
    "sum(i in N, (r_dot[i, 0]**2 + r_dot[i, 1]**2)/2 + B*(r[i, 0]*r_dot[i, 1] - r[i, 1]*r_dot[i, 0]))"
    "- sum(i < j in N, 1/sqrt((r[i, 0] - r[j, 0])**2 + (r[i, 1] - r[j, 1])**2))"
)


@pytest.mark.rotated
def test_masses_that_depend_on_position_against_scipy():
    system = sc.LagrangianSystem.from_text("chain", ["q[N]"], CHAIN, parameters={"m[N]": 1})
    stepper, given = sc.compile_stepper(system, "svi:4", flags=QUICK_FLAGS), {"parameters": {"m": MASS}}
    run = stepper.integrate(Q, velocity=V, h=0.05, steps=40, **given)

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:N], y[N:]
        force = -MASS * q * v**2 - 3 * q + np.roll(q, 1) + np.roll(q, -1)
        return np.concatenate([v, force / (MASS * (1 + q**2))])

    exact = solve_ivp(rates, (0, 2), [*Q, *V], rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1]
    assert run.q[-1] == pytest.approx(exact[:N], abs=1e-10)
    assert run.velocity[-1] == pytest.approx(exact[N:], abs=1e-10)
    assert np.ptp(run.energy()) < 1e-10
    known = stepper.with_sizes(N=N).integrate(Q, velocity=V, h=0.05, steps=40, **given)
    assert np.abs(run.q - known.q).max() < 1e-14
    assert np.abs(run.p - known.p).max() < 1e-13
    assert (stepper.integrate(Q, velocity=V, h=0.05, steps=40, threads=2, **given).q == run.q).all()
    assert stepper.integrate(Q, velocity=V, t_end=2.0, **given).q[-1] == pytest.approx(exact[:N], abs=1e-11)
    (crossed,) = stepper.integrate(Q, velocity=V, h=0.05, steps=40, events="q_dot[0]", **given).events
    assert len(crossed.t) == (np.diff(np.sign(run.velocity[:, 0])) != 0).sum()


@pytest.mark.rotated
def test_charges_in_a_magnetic_field_keep_their_angular_momentum():
    system = sc.LagrangianSystem.from_text("charges", ["r[N, 2]"], CHARGES, parameters={"B": 0.5})
    stepper = sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS)
    q, velocity = 3 * RNG.normal(size=(5, 2)), RNG.normal(size=(5, 2))
    run = stepper.integrate(q, velocity=velocity, h=0.05, steps=20)
    known = stepper.with_sizes(N=5).integrate(q, velocity=velocity, h=0.05, steps=20)
    assert np.abs(run.q - known.q).max() < 1e-14
    assert stepper.momentum_map_names == ("angular momentum of r[.., 0], r[.., 1]",)
    assert np.ptp(run.momentum_maps()) < 1e-13
    rest = stepper.integrate(q, h=0.05, steps=1)
    assert not rest.velocity[0].any()
    assert np.abs(rest.p[0]).max() > 0.1


@pytest.mark.parametrize(
    "lagrangian",
    [
        "sum(i in N, q_dot[i]**2/2) + sum(i in 0..N-2, q_dot[i]*q_dot[i+1]/9)",
        "sum(i in N, -sqrt(1 - q_dot[i]**2))",
        "sum(i in 0..N-2, (1 + q[i]**2)*q_dot[i]**2/2)",
        "sum(i < j in N, q_dot[i]**2*q_dot[j]**2)",
        "sum(i in N, q[i]*q_dot[i])",
    ],
)
def test_other_kinetic_energies_have_no_hamiltonian_by_elements(lagrangian):
    assert site_hamiltonian(sc.LagrangianSystem.from_text("other", ["q[N]"], lagrangian)) is None


@pytest.mark.rotated
def test_many_coupled_velocities_are_solved_by_newton():
    """Full mass matrices at all points, on the stack, are left to the banded ones of Newton's method."""
    text = "sum(i in N, q_dot[i]**2/2 - q[i]**2/2) + sum(i in 0..N-2, q_dot[i]*q_dot[i+1]/9)"
    chain = sc.LagrangianSystem.from_text("chain", ["q[N]"], text)
    solvers = [sc.generate_source(sc.unroll_sums(chain, {"N": n}), "svi:3")[1].solver for n in (20, 200)]
    assert solvers == ["fixed-point", "newton"]
