"""Index notation outside of the Lagrangian: time transformations, events, rotated vectors."""

import numpy as np
import pytest
from notation import hamilton
from samples import QUICK_FLAGS

import scvi_codegen as sc

Q = np.array([0.1, 0.2, 0.3, 0.5])
RING = "sum(i in {N}, q_dot[i]**2/2) - sum(i in {N} periodic, (q[i+1] - q[i])**2/2 + q[i]**4/4)"


@pytest.fixture(scope="module", params=["N", "4"])
def ring(request) -> sc.LagrangianSystem:
    size = request.param
    return sc.LagrangianSystem.from_text(name="ring", coordinates=[f"q[{size}]"], lagrangian=RING.format(N=size))


def compiled(system: sc.LagrangianSystem, **options) -> sc.Stepper:
    return sc.compile_stepper(system, "svi:4", flags=QUICK_FLAGS, **options)


def size_of(system: sc.LagrangianSystem) -> str:
    return "4" if system.coordinates[0].name == "q_0" else "N"


@pytest.mark.tiers(0, 1)
def test_time_transformation_equals_that_of_the_entries(ring):
    options = {"velocity": 0 * Q, "h": 0.1, "t_end": 2.0}
    g = f"1/(1 + q[{size_of(ring)}-1]**2 + sum(i in {size_of(ring)}, q[i]**2))"
    run = compiled(ring, time_transformation=g).integrate(Q, **options)
    same = compiled(ring, time_transformation="1/(1 + q_0**2 + q_1**2 + q_2**2 + 2*q_3**2)").integrate(Q, **options)
    assert len(run) > 15
    np.testing.assert_allclose(run.t, same.t, rtol=0, atol=1e-14)


@pytest.mark.second
def test_time_transformation_by_an_index_table():
    net = sc.LagrangianSystem.from_text(
        name="net",
        coordinates=["q[N]"],
        tables=["bonds[B, 2]"],
        lagrangian="sum(i in N, q_dot[i]**2/2) - sum(b in B, (q[bonds[b, 1]] - q[bonds[b, 0]])**2/2)",
    )
    options = {"h": 0.1, "t_end": 1.0, "tables": {"bonds": [[0, 1], [1, 3]]}}
    run = compiled(net, time_transformation="1/(1 + sum(b in B, (q[bonds[b, 0]] - q[bonds[b, 1]])**2))")
    same = compiled(net, time_transformation="1/(1 + (q_0 - q_1)**2 + (q_1 - q_3)**2)")
    np.testing.assert_allclose(run.integrate(Q, **options).t, same.integrate(Q, **options).t, rtol=0, atol=1e-14)


def test_time_transformation_by_momenta_of_a_hamiltonian():
    system = hamilton("H", "q[3]", "sum(i in 3, p[i]**2/2 + q[i]**4/4)", momenta="p[3]")
    found = sc.reparametrise(system, "1/(1 + sum(i in 3, p[i]**2))").clock.rate
    assert str(found) == "1/(p_0**2 + p_1**2 + p_2**2 + 1)"


@pytest.mark.rotated
def test_events_in_index_notation_change_the_state():
    system = sc.LagrangianSystem.from_text(name="ring", coordinates=["q[4]"], lagrangian=RING.format(N=4))
    by_index = sc.Event("q[2] - sum(i in 4, q[i])**2", then={"p_q[2]": "-p_q[2]/2"}, where="q_dot[1] < 1")
    by_name = sc.Event("q_2 - (q_0 + q_1 + q_2 + q_3)**2", then={"p_q_2": "-p_q_2/2"}, where="q_1_dot < 1")
    options = {"velocity": 0 * Q, "h": 0.1, "t_end": 15.0}
    found, same = (compiled(system).integrate(Q, events=each, **options) for each in (by_index, by_name))
    assert len(found.events[0]) > 0
    np.testing.assert_array_equal(found.q[-1], same.q[-1])


@pytest.mark.parametrize("size", ["N", "3"])
@pytest.mark.parametrize(("inverse", "entries"), [("", "R_21, R_22, R_23"), ("un", "R_12, R_22, R_32")])
def test_rotated_vectors_of_arrays(size, inverse, entries):
    def system(potential):
        return sc.LagrangianSystem.from_text(
            name="tops",
            coordinates=["x"],
            rotations={f"R[{size}]": "omega"},
            parameters={"g": 9.81},
            lagrangian=f"x_dot**2/2 + sum(i in {size}, omega_1[i]**2 + omega_2[i]**2 + omega_3[i]**2 - {potential})",
        )

    first, second, third = (f"{name}[i]" for name in entries.split(", "))
    found = system(f"{inverse}rotate_2(R[i], g, x + 1, -2)")
    expected = system(f"(g*{first} + (x + 1)*{second} - 2*{third})")
    if size == "N":
        found, expected = (sc.unroll_sums(each, {"N": 3}) for each in (found, expected))
    assert found.formula.expand() == expected.formula.expand()
