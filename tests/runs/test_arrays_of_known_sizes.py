"""Arrays of known sizes: their names, and steps that require them."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

LAGRANGIAN = (
    "M*x_dot**2/2 + sum(i in {N}, m[i]*q_dot[i]**2/2) - k*x**2/2"
    "- sum(i in {N} periodic, (q[i+1] - q[i])**4/4) - k*sum(i in {N}, (q[i] - x)**2/2)"
)
FORCES = {"x": "cos(t)/10", "q[i]": "sin(t)*m[i]"}


def body_on_ring(size: str) -> sc.LagrangianSystem:
    """A body joined by springs to the particles of a ring."""
    text = LAGRANGIAN.format(N=size)
    return lagrange(
        "body on ring", ["x", f"q[{size}]"], text, parameters={"M": 2, "k": 1, f"m[{size}]": 1}, forces=FORCES
    )


@pytest.fixture(scope="module")
def known():
    return sc.compile_stepper(body_on_ring("N"), "svi:4", sizes={"N": 5})


@pytest.mark.rotated
def test_the_only_array_needs_no_name():
    atoms = lagrange("atoms", ["r[2, 3]"], "sum(i in 2, k in 3, r_dot[i, k]**2/2 - r[i, k]**2/2)")
    stepper = sc.compile_stepper(atoms, "svi:4")
    start = np.arange(6.0).reshape(2, 3)
    run = stepper.integrate(start, 0 * start, h=0.1, steps=3)
    assert (run.q[0] == np.arange(6)).all()
    assert (stepper.arrays(run.q)["r"][0] == start).all()


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("extra", "method", "message"),
    [
        (
            {"lagrangian": "sum(i in N, q_dot[i]**2/2) + sum(i in 0..N-2, q_dot[i]*q_dot[i+1]/9)"},
            "svi:2",
            "velocities as m",
        ),
        ({"constraints": ["q_dot[i] = q[i]*q_dot[i+1] for i in 0..0"]}, sc.SVI(1, "gauss-lobatto:2"), "holonomic"),
        ({}, "scvi:2", "not supported for array systems"),
        ({"hamiltonian": "sum(i in N, p_q[i]**4/4 + p_q[i]**2/2 + q[i]**2/2)"}, "composition:8", "not supported"),
    ],
)
def test_steps_that_require_known_sizes_are_compiled_with_those_of_the_call(extra, method, message):
    kind = sc.HamiltonianSystem if "hamiltonian" in extra else sc.LagrangianSystem
    given = {} if "hamiltonian" in extra else {"lagrangian": "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)"}
    system = kind.from_text(name="chain", coordinates=["q[N]"], **{**given, **extra})
    run_time_sizes, start = sc.compile_stepper(system, method, flags=QUICK_FLAGS), {"q": np.array([0.1, 0.2])}
    run = run_time_sizes.integrate(start, velocity={"q": [0.02, 0.2]}, h=0.1, steps=3)
    known = sc.compile_stepper(system, method, sizes={"N": 2}, flags=QUICK_FLAGS)
    assert (run.q["q"] == known.integrate(start, velocity=[0.02, 0.2], h=0.1, steps=3).q).all()
    with pytest.raises(sc.MethodError, match=rf"(?s)2001 coordinates are too many.*{message}.*sizes=\{{'N': 8\}}"):
        run_time_sizes.integrate(np.zeros(2001), h=0.1, steps=1)
