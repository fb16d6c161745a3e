"""Arrays of rotations, directions and spins: the same motion as by names, and as by SciPy."""

import numpy as np
import pytest
from notation import hamilton
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import scvi_codegen as sc

RNG = np.random.default_rng(3)
QUATERNIONS, OMEGA, UNIT = RNG.normal(size=(3, 4)), RNG.normal(size=(3, 3)), RNG.normal(size=(2, 3))
TANGENTS = np.cross(UNIT, UNIT[::-1])
BODY = "J[i]*omega_1[i]**2 + 2*omega_2[i]**2 + 3*omega_3[i]**2 - x*R_33[i] + R_11[i]*n_2[0]"
STEPS = {"h": 0.05, "steps": 10}


def bodies() -> sc.LagrangianSystem:
    """Three rigid bodies, two pendulums and a coordinate, in arrays."""
    return sc.LagrangianSystem.from_text(
        name="bodies",
        coordinates=["x"],
        lagrangian=f"x_dot**2/2 + sum(i in 3, {BODY}) + sum(a in 2, n_1_dot[a]**2 + n_2_dot[a]**2 + n_3_dot[a]**2)/2",
        parameters={"J[3]": 1},
        rotations={"R[3]": "omega"},
        directions=["n[2]"],
        forces={"n[a]": ["0", "0", "-1"]},
        torques={"R[i]": ["0", "0", "-omega_3[i]"]},
        torques_space={"R[1]": ["0", "cos(t)", "0"]},
        dissipation="sum(i in 3, omega_1[i]**2/2)",
    )


def named() -> sc.LagrangianSystem:
    """The same system without arrays."""
    parts = [f"{i + 1}*w{i}_1**2 + 2*w{i}_2**2 + 3*w{i}_3**2 - x*S{i}_33 + S{i}_11*n_2" for i in range(3)]
    parts += ["x_dot**2/2", *(f"({d}_1_dot**2 + {d}_2_dot**2 + {d}_3_dot**2)/2" for d in "nm")]
    return sc.LagrangianSystem.from_text(
        name="named",
        coordinates=["x"],
        lagrangian=" + ".join(parts),
        rotations={f"S{i}": f"w{i}" for i in range(3)},
        directions=["n", "m"],
        forces={d: ["0", "0", "-1"] for d in "nm"},
        torques={f"S{i}": ["0", "0", f"-w{i}_3"] for i in range(3)},
        torques_space={"S1": ["0", "cos(t)", "0"]},
        dissipation="(w0_1**2 + w1_1**2 + w2_1**2)/2",
    )


@pytest.mark.rotated
def test_arrays_of_rotations_move_as_by_names(tmp_path):
    stepper = sc.compile_stepper(bodies(), "svi:2", flags=QUICK_FLAGS)
    q, velocity = {"x": 0.3, "R": QUATERNIONS, "n": UNIT}, {"x": 0.1, "omega": OMEGA, "n": TANGENTS}
    run = stepper.integrate(q, velocity=velocity, parameters={"J": [1, 2, 3]}, **STEPS)
    q = {"x": 0.3, "n": UNIT[0], "m": UNIT[1], **{f"S{i}": QUATERNIONS[i] for i in range(3)}}
    velocity = {"x": 0.1, "n": TANGENTS[0], "m": TANGENTS[1], **{f"w{i}": OMEGA[i] for i in range(3)}}
    other = sc.compile_stepper(named(), "svi:2", flags=QUICK_FLAGS).integrate(q, velocity=velocity, **STEPS)
    assert np.abs(np.asarray(run.q) - np.asarray(other.q)).max() < 1e-14
    assert run.q["R"].shape == (11, 3, 4)
    assert run.rotation().shape == (11, 3, 3, 3)
    assert np.abs(run.rotation("R")[:, 1] - other.rotation("S1")).max() < 1e-14
    assert np.abs(run.angular_velocity("R")[:, 2] - other.angular_velocity("S2")).max() < 1e-13
    assert np.abs(run.direction("n")[:, 1] - other.direction("m")).max() < 1e-14
    angles = {"euler": "zxz", "angles": Rotation.from_matrix(run.rotation()[0]).as_euler("zxz")}
    for attitudes in (run.rotation()[0], Rotation.from_matrix(run.rotation()[0]), angles):
        start = {"x": 0.3, "R": attitudes, "n": UNIT}
        again = stepper.start(start, velocity={"x": 0.1, "omega": OMEGA, "n": TANGENTS}, h=0.05)
        assert stepper.arrays(again.q)["R"].shape == (3, 4)
        assert np.abs(again.rotation() - run.rotation()[0]).max() < 1e-14
    with pytest.raises(sc.StateError, match=r"'omega' must have the shape \(3,\) of vectors, not \(2, 3\)"):
        stepper.start(q | {"R": QUATERNIONS, "n": UNIT}, velocity={"omega": OMEGA[:2]}, h=0.05)


@pytest.mark.rotated
@pytest.mark.parametrize("size", ["6", "N"])
def test_spin_chain_against_scipy(size):
    """ds/dt = s x dH/ds with the field of the neighbours."""
    text = (
        f"-sum(i in {size} periodic, s_1[i]*s_1[i+1] + s_2[i]*s_2[i+1] + s_3[i]*s_3[i+1]) - b*sum(i in {size}, s_3[i])"
    )
    chain = hamilton("spin chain", [], text, spins=[f"s[{size}]"], b=0.3)
    start = np.random.default_rng(0).normal(size=(6, 3))

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        s = y.reshape(6, 3)
        return np.cross(s, np.roll(s, 1, axis=0) + np.roll(s, -1, axis=0) + [0, 0, 0.3]).ravel()

    exact = solve_ivp(rates, (0, 2), start.ravel(), rtol=1e-12, atol=1e-12, method="DOP853").y[:, -1]
    run = sc.compile_stepper(chain, "svi:4", flags=QUICK_FLAGS).integrate(
        {"s": start}, h=0.02, steps=100, events="s_3[5]*s_2[0]"
    )
    assert run.spin("s")[-1].ravel() == pytest.approx(exact, abs=1e-9)
    product = run.spin("s")[:, 5, 2] * run.spin("s")[:, 0, 1]
    assert len(run.events[0]) == (np.diff(np.sign(product)) != 0).sum() > 0
    assert run.spin("s_3").shape == (101, 3)
