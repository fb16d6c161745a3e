"""Constraints of array systems: rods and pins over tables, compared with the unrolled system and SciPy."""

import subprocess

import numpy as np
import pytest
from commands import invoke
from notation import lagrange
from scipy.optimize import minimize

import scvi_codegen as sc

RATTLE = sc.SVI(1, "gauss-lobatto:2")
ROUNDING = 2.0**-52


def net(axes=2):
    """Masses in weight, rods between them by a table, pins."""
    return sc.LagrangianSystem.from_text(
        name="net",
        coordinates=[f"r[N, {axes}]"],
        parameters={"m[N]": 1, "l[B]": 1, "g": 9.81, f"x[P, {axes}]": 0},
        tables=["bonds[B, 2]", "pins[P]"],
        lagrangian=f"sum(i in N, m[i]*sum(a in {axes}, r_dot[i, a]**2)/2 - m[i]*g*r[i, {axes - 1}])",
        constraints=[
            *(f"r[pins[p], {k}] = x[p, {k}] for p in P" for k in range(axes)),
            f"sum(a in {axes}, (r[bonds[b, 0], a] - r[bonds[b, 1], a])**2) = l[b]**2 for b in B",
        ],
    )


def chain(count):
    """A chain of rods and unequal masses that begins as a wave, pinned at one end."""
    angles = 0.5 + 0.3 * np.sin(7 * np.linspace(0, 1, count))
    ends = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0) / count
    bonds = np.stack([np.arange(count), np.arange(1, count + 1)], axis=1)
    masses = (1 + 0.4 * np.cos(np.arange(count + 1))) / count
    data = {"tables": {"bonds": bonds, "pins": [0]}, "parameters": {"l": 1 / count, "m": masses}}
    return np.concatenate([[[0.0, 0.0]], ends]), data


def residuals(run):
    """The largest of g, and of its rate."""
    return [max(np.abs(each).max() for each in values) for values in run.constraint_values]


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(net(), RATTLE)


@pytest.mark.parametrize("count", [30, 2000])
def test_every_state_of_a_chain_satisfies_its_constraints(stepper, count):
    q, data = chain(count)
    run = stepper.start(q, h=0.05 / count, **data)
    for _ in range(20):
        run.advance(1)
        g, rate = residuals(run)
        assert g < 16 * ROUNDING / count  # of 4 terms of 2 l x
        assert rate < 64 * ROUNDING / count
    assert run.iterations < 20 * 20


@pytest.mark.parametrize(("count", "stride"), [(500, 1), (16, 5)])
def test_chains_ordered_from_an_end_need_no_iteration_for_their_linear_systems(stepper, count, stride):
    """In another order of the rods the factors have fill-in: conjugate gradients give the same states."""
    q, data = chain(count)
    ordered = stepper.start(q, h=1e-4, **data)
    ordered.advance(10)
    bonds = np.concatenate([data["tables"]["bonds"][k::stride] for k in range(stride)])
    run = stepper.start(q, h=1e-4, **data | {"tables": data["tables"] | {"bonds": bonds}})
    memory, binding = run._memory, run.stepper.binding
    report, null = binding.new("report *"), binding.null
    binding.function("advance")(memory, 10, 1, run._arguments[0], *[null] * 5, report, null)
    assert report.iterations > 0
    assert (report.products == 0) == (stride == 1)
    assert np.abs(run.q["r"] - ordered.q["r"]).max() < 1e-14


def test_initial_state_is_projected_to_the_nearest_state(stepper):
    q, data = chain(3)
    off = q + 1e-3 * np.random.default_rng(1).normal(size=q.shape)
    near, _ = stepper.project(off, **data)
    lengths = {"type": "eq", "fun": lambda x: [*(np.diff(x.reshape(4, 2), axis=0) ** 2).sum(1) - 1 / 9, *x[:2]]}
    masses = np.repeat(data["parameters"]["m"], 2)
    nearest = minimize(
        lambda x: np.sum(masses * (x - off.ravel()) ** 2), q.ravel(), constraints=[lengths], tol=1e-14, method="SLSQP"
    )
    assert np.abs(near["r"].ravel() - nearest.x).max() < 1e-7
    with pytest.warns(sc.AccuracyWarning, match=r"violates the constraints by .* \(relative\)"):
        run = stepper.start(off, h=0.01, **data)
    assert np.abs(run.q["r"] - near["r"]).max() < 1e-14
    with pytest.raises(sc.StateError, match=r"stepper\.project"):
        stepper.start(1.02 * q, h=0.01, **data)


def test_momentum_maps_compatible_with_constraints_are_conserved():
    """Free rods turn in space; pins hold them, by whose constraints nothing is kept."""
    free = sc.LagrangianSystem.from_text(
        name="molecule",
        coordinates=["r[N, 3]"],
        tables=["bonds[B, 2]"],
        lagrangian="sum(i in N, sum(a in 3, r_dot[i, a]**2)/2)",
        constraints=["sum(a in 3, (r[bonds[b, 0], a] - r[bonds[b, 1], a])**2) = 1 for b in B"],
    )
    stepper = sc.compile_stepper(free, "stoermer-verlet")
    assert len(stepper.momentum_map_names) == 6
    assert sc.compile_stepper(net(), "stoermer-verlet").momentum_map_names == ()
    q = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]])
    velocity = np.random.default_rng(2).normal(size=q.shape)
    tables = {"bonds": [[0, 1], [1, 2], [2, 3]]}
    q, p = stepper.project(q, velocity=velocity, tables=tables)
    run = stepper.integrate(q, p, h=0.01, steps=500, save_every=100, tables=tables)
    assert np.abs(np.ptp(run.momentum_maps(), axis=0)).max() < 1e-13


@pytest.mark.rotated
def test_time_dependent_constraints_are_satisfied():
    """A pendulum whose pivot shakes is that written out in its angle."""
    text = "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2 - r[i, 1])"
    shaken = lagrange(
        "shaken", ["r[N, 2]"], text, constraints=["(r[i, 0] - sin(3*t)/10)**2 + r[i, 1]**2 = 1 for i in N"]
    )
    stepper = sc.compile_stepper(shaken, "composition:8")
    run = stepper.integrate([[0.0, -1.0]], velocity=[[0.3, 0.0]], h=0.02, steps=100, save_every=100)
    angle = lagrange("angle", "a", "((a_dot*cos(a) + 3*cos(3*t)/10)**2 + (a_dot*sin(a))**2)/2 + cos(a)")
    exact = sc.compile_stepper(angle, "svi:8").integrate([0.0], velocity=[0.0], h=0.05, steps=40)
    place = [np.sin(6.0) / 10 + np.sin(exact.q[-1, 0]), -np.cos(exact.q[-1, 0])]
    assert np.abs(run.q["r"][-1, 0] - place).max() < 1e-9


MODEL = """
[system]
name = "chain"
coordinates = ["r[N, 2]"]
lagrangian = "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2 - g*r[i, 1])"
constraints = ["r[0, 0] = 0", "r[0, 1] = 0", "sum(a in 2, (r[i+1, a] - r[i, a])**2) = 1/100 for i in 0..N-2"]
[sizes]
N = 6
[parameters]
g = 9.81
[initial]
q = "i*(1-j)/10"
[method]
method = "stoermer-verlet"
[run]
step = 0.01
steps = 20
"""


@pytest.mark.rotated
def test_model_files_and_generated_programs_have_constraints(tmp_path):
    (tmp_path / "chain.toml").write_text(MODEL)
    model = sc.load_model(tmp_path / "chain.toml")
    run = model.integrate()
    assert "order 2, symplectic, symmetric" in invoke("run", tmp_path / "chain.toml").stdout
    folder = sc.generate_package(model, tmp_path / "chain_c")
    made = subprocess.run(["make", "run"], cwd=folder, capture_output=True, text=True, check=True)
    assert "warning" not in made.stderr
    end = np.loadtxt(folder / "end.txt")
    assert np.abs(end[:12] - run.q["r"][-1].ravel()).max() < 1e-12
    assert "lambda*(2*r[i+1, 0] - 2*r[i, 0])" in sc.derive(model.system, model.method).to_text()


def test_discontinuous_constraint_parameters_are_rejected(stepper):
    q, data = chain(3)
    run = stepper.start(q, h=0.01, **data)
    with pytest.raises(sc.StateError, match="must be continuous"):
        run.update(parameters={"l": 0.5})
    run.advance(1)
    assert residuals(run)[0] < 1e-15
