"""Examples run unchanged and produce their documented results."""

import os
import re
import runpy
import subprocess
import sys
import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from commands import invoke
from samples import UNOPTIMISED
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from scvi_codegen.codegen.native.building import FLAGS_VARIABLE
from scvi_codegen.interfaces.models.model_files.model_file import load_model

pytestmark = [pytest.mark.long, pytest.mark.rotated]

EXAMPLES = Path(__file__).parents[2] / "examples"
SCRIPTS = (
    "ceres_orbit", "collisions_in_space", "curves_and_quadratures",
    "eccentric_comet", "elements_on_processes", "falling_humanoid", "field_on_two_processes", "halo_orbits",
    "hanging_chain", "henon_heiles_map", "custom_sympy_system", "import_generated_stepper", "inspect_derivation",
    "joints", "kepler_conservation", "lennard_jones_liquid", "logarithmic_hamiltonian", "mechanism_from_joints",
    "rebound_bodies", "which_step",
)  # fmt: skip
ENERGY_ERRORS = {
    "outer_solar_system": 1e-13,
    "pendulum": 1e-8,
    "kepler": 1e-12,
    "double_pendulum": 1e-11,
    "vortex_pairs": 1e-12,
}


@pytest.fixture(
    autouse=True, params=[" ".join(UNOPTIMISED), pytest.param("", marks=pytest.mark.full)], ids=["quickly", "as users"]
)
def compiled_with(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile with little optimisation, which does not change the output of an example."""
    monkeypatch.setenv(FLAGS_VARIABLE, request.param)


many_steps = pytest.mark.parametrize("compiled_with", [""], ids=["as users"], indirect=True)
"""Of which an example is mostly made: quicker if they are compiled as users do."""


@pytest.fixture
def output_of(tmp_path, monkeypatch, capfd) -> Callable[..., str]:
    """Return the output of a Python example with these arguments, run in this process in another folder."""

    def output(name: str, *arguments: str) -> str:
        script = str(EXAMPLES / f"{name}.py")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("MPLBACKEND", "agg")
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        monkeypatch.syspath_prepend(str(EXAMPLES))  # as Python does for a script
        with warnings.catch_warnings(action="error"):
            runpy.run_path(script, run_name="__main__")
        if "matplotlib.pyplot" in sys.modules:
            sys.modules["matplotlib.pyplot"].close("all")
        printed, complaints = capfd.readouterr()
        announced = "scvi-codegen: compiling "  # where it takes longer than others
        assert [line for line in complaints.splitlines() if not line.startswith(announced)] == []
        return printed

    return output


@pytest.mark.quick
def test_every_example_is_tested():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SCRIPTS)
    assert {path.stem for path in EXAMPLES.glob("*.toml")} == {*ENERGY_ERRORS, "shaken_tower", "fput_ring"}


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ENERGY_ERRORS)
def test_model_files_run_and_conserve_energy(name, tmp_path):
    output = tmp_path / "run.npz"
    found = re.search(r"energy error: (\S+) at most", invoke("run", EXAMPLES / f"{name}.toml", "-o", output).stdout)
    assert found is not None
    assert float(found[1]) < ENERGY_ERRORS[name]
    model = load_model(EXAMPLES / f"{name}.toml")
    with np.load(output) as written:
        assert len(written["t"]) == model.step_count // model.save_every + 1


@pytest.mark.tiers(0, 1)
def test_ring_conserves_energy_and_momentum(tmp_path):
    output = tmp_path / "run.npz"
    words = ["run", str(EXAMPLES / "fput_ring.toml"), "--steps", "100", "-o", str(output)]
    invoke(*words)
    with np.load(output) as written:
        q, p = written["q"], written["p"]
    bonds = np.roll(q, -1, axis=1) - q
    beta = load_model(EXAMPLES / "fput_ring.toml").parameters["beta"]
    energies = (p**2 / 2 + bonds**2 / 2 + beta * bonds**4 / 4).sum(axis=1)
    assert np.ptp(energies) < 1e-14 * energies[0]
    assert np.ptp(p.sum(axis=1)) < 1e-14


def test_shaken_tower_agrees_with_dop853(tmp_path):
    """Compare with DOP853 between breakpoints of SciPy's spline through the same table."""
    assert "too long" not in invoke("run", EXAMPLES / "shaken_tower.toml", "-o", tmp_path / "run.csv").output
    times, values = np.loadtxt(EXAMPLES / "ground_motion.csv", delimiter=",", skiprows=1).T
    ground, state = CubicSpline(times, values), [0.02, 0.03, 0.0, 0.0]

    def motion(t, y):
        between = -60.0 * (y[1] - y[0]) - 0.5 * (y[3] - y[2])
        return [y[2], y[3], -60.0 * (y[0] - ground(t)) - between, between]

    for span in pairwise(times):
        state = solve_ivp(motion, span, state, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    last = np.loadtxt(tmp_path / "run.csv", delimiter=",", skiprows=1)[-1]
    assert last[:5] == pytest.approx([8.0, *state], abs=1e-8)


@pytest.mark.tiers(0, 1)
def test_kepler_conservation_distinguishes_the_methods(output_of):
    errors = {
        line[:32].strip(): [float(word) for word in line[32:].split()]
        for line in output_of("kepler_conservation").splitlines()[1:]
    }
    assert max(errors["SVI, degree 4"]) < 1e-7
    assert max(errors["SVI, degree 4"]) < 1.1 * min(errors["SVI, degree 4"])
    assert errors["spectral collocation, degree 4"][2] > 10 * errors["spectral collocation, degree 4"][0]
    assert min(errors["explicit Euler"]) > 0.1


def test_eccentric_comet_conserves_energy(output_of):
    rows = [line[12:].split() for line in output_of("eccentric_comet").splitlines()[1:]]
    (stretched, regular) = ([float(word) for word in row] for row in rows)
    assert stretched[1] > 1000 * stretched[2]
    assert stretched[3] < 1e-9
    assert regular[3] < 1e-11
    assert regular[4] < 1e-9


def test_field_in_two_parts_is_bitwise_equal(output_of):
    bits, states, *times = output_of("field_on_two_processes").splitlines()
    assert bits == "two processes have the bits of one: True"
    assert states == "and the states of the compiled integrator: True"
    assert len(times) in (4, 5)  # the last where others had the cores


def test_elements_on_processes_are_bitwise_equal(output_of):
    bits, states, sent = output_of("elements_on_processes").splitlines()
    assert bits == "two and four processes have the bits of one: True"
    assert states == "and the states of the compiled integrator: True"
    assert sent.endswith("in an iteration: 8")


def test_every_step_size_selection_has_its_documented_accuracy(output_of):
    """Over a thousand periods; in docs/steps.md ten thousand."""
    rows = [line[28:].split() for line in output_of("which_step").splitlines()[1:]]
    steps, _, energy, _, error = zip(*(map(float, row) for row in rows), strict=True)
    fixed, controlled, loose, transformed, reversible = range(5)
    assert steps[fixed] > 5 * max(steps[controlled:])
    assert energy[loose] > 2e-11 > 1e-11 > energy[fixed]
    assert max(energy[way] for way in (controlled, transformed, reversible)) < 2e-12
    assert max(error[way] for way in (controlled, transformed, reversible)) < 1e-8 < error[fixed]


def test_comet_returns_after_a_near_collision(output_of):
    errors = [float(line.split()[-1]) for line in output_of("collisions_in_space").splitlines()[1:]]
    assert max(errors) < 1e-11


@many_steps
def test_a_humanoid_falls_and_rests_in_less_than_the_time_of_its_fall(output_of):
    motion, rest, energy = output_of("falling_humanoid").splitlines()
    seconds, taken = map(float, re.findall(r"(\S+) s\b", motion))
    assert taken < seconds
    assert float(rest.split(";")[0].split()[-1]) < 1e-3
    before, after, lost = map(float, re.findall(r"(\S+) J", energy))
    assert after < before - lost < before


def test_leapfrog_with_logarithmic_hamiltonian_preserves_an_ellipse(output_of):
    rows = [line.split() for line in output_of("logarithmic_hamiltonian").splitlines()[1:]]
    _, away, period = zip(*(map(float, row) for row in rows), strict=True)
    assert max(away) < 1e-14
    assert period[0] / period[2] == pytest.approx(16.0, rel=0.2)


@many_steps
def test_halo_orbits_and_their_bifurcations_are_the_published_ones(output_of, tmp_path):
    output = output_of("halo_orbits")
    away = [float(found) for found in re.findall(r"(\S+) from the published orbit", output)]
    assert len(away) == 4
    assert max(away) < 1e-10
    assert float(re.search(r"pairs within (\S+)", output)[1]) < 1e-6
    assert float(re.search(r"to (\S+), pairs", output)[1]) < 1.75
    stable = [float(found) for found in re.search(r"stable between (\S+) and (\S+)", output).groups()]
    assert 2.1 < stable[0] < 2.2 < 2.3 < stable[1] < 2.4
    assert (tmp_path / "halo_orbits.png").stat().st_size > 10_000


def test_the_map_of_henon_and_heiles_is_half_chaotic(output_of, tmp_path):
    """The grids are coarser than the default; on fine ones 44 per cent are regular."""
    output = output_of("henon_heiles_map", "24")
    assert 30 < float(re.search(r"regular .*: (\d+)%", output)[1]) < 60
    assert float(re.search(r"(\d+) a second", output)[1]) > 0
    assert (tmp_path / "henon_heiles_map.png").stat().st_size > 10_000


def test_curves_and_quadratures_have_their_documented_advantages(output_of):
    errors = [float(line.split()[-1]) for line in output_of("curves_and_quadratures").splitlines() if "e-" in line]
    polynomials, harmonics, smooth, splines, trapezoid, hermite, more = errors
    assert harmonics < polynomials / 100
    assert splines < smooth / 1e4
    assert more < 1e-7 < hermite < trapezoid


def test_import_generated_stepper_runs_without_sympy(output_of):
    output = output_of("import_generated_stepper")
    assert "pendulum_svi.c" in output
    assert float(output.rsplit(maxsplit=1)[1]) < 1e-8


@pytest.mark.second
def test_custom_sympy_system_finds_the_bifurcation(output_of):
    output = output_of("custom_sympy_system")
    assert "the same from LagrangesMethod: True" in output
    slow, fast = re.findall(r"between (\S+) and (\S+)", output)
    assert float(slow[0]) < 0 < float(slow[1])
    assert 0 < float(fast[0]) < float(fast[1])


def test_mechanism_from_joints_agrees_with_sympy(output_of):
    output = output_of("mechanism_from_joints")
    assert float(re.search(r"unaccounted for: (\S+)", output)[1]) < 1e-12
    assert float(re.search(r"after 10 s: (\S+)", output)[1]) < 1e-11


@pytest.mark.second
def test_bodies_of_rebound_have_its_trajectory_here_and_there(output_of):
    pytest.importorskip("rebound", reason="needs rebound")
    apart = [float(number) for number in re.findall(r": (\S+) AU apart", output_of("rebound_bodies"))]
    assert len(apart) == 2
    assert max(apart) < 1e-10


def test_inspect_derivation_runs_in_a_separate_process(tmp_path):
    path = os.pathsep.join([str(EXAMPLES.parent), os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / "inspect_derivation.py")],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert "27a" in result.stdout
    assert r"\tag{27a}" in result.stdout
    assert "sqrt(3)" in result.stdout


def test_damped_hanging_chain_converges_to_a_catenary(output_of):
    output = output_of("hanging_chain")
    assert float(re.search(r"off their length by (\S+)", output)[1]) < 1e-16
    a = brentq(lambda a: 2.0 * a * np.sinh(0.5 / a) - 1.2, 0.1, 10.0)
    sag, tension = (float(re.search(rf"{what} (\S+?),", output)[1]) for what in ("sag", "tension"))
    assert sag == pytest.approx(a * (np.cosh(0.5 / a) - 1.0), abs=2e-4)
    assert tension == pytest.approx(9.81 * a / 1.2, rel=1e-3)
    carried, weight = re.search(r"carry (\S+) of the weight (\S+)", output).groups()
    assert float(carried) == pytest.approx(float(weight), abs=1e-5)


def test_joint_forces_are_the_documented_ones(output_of):
    output = output_of("joints")
    forces = re.findall(r"(\d+\.\d+), (?:by its turning|with a constant acceleration) (\S+)", output)
    assert len(forces) == 2
    for found, expected in forces:
        assert float(found) == pytest.approx(float(expected), abs=2e-9)
    saved = [float(number) for number in re.findall(r"joints kept to (\S+),", output)]
    assert len(saved) == 6
    assert max(saved) < 1e-14
    hangers = [float(number) for number in re.search(r"hangers pull with (\S+) and (\S+)", output).groups()]
    assert sum(hangers) == pytest.approx((9 * 0.2 + 3.0) * 9.81, abs=1e-3)


def test_orbit_of_ceres_determines_the_mass_of_jupiter(output_of, tmp_path):
    """The mass agrees to two thousandths, the accuracy of the approximate orbits of the planets."""
    output = output_of("ceres_orbit")
    found, published = map(float, re.search(r"1/(\S+) of the Sun; 1/(\S+) by other", output).groups())
    assert published == 1047.3
    assert found == pytest.approx(published, rel=2e-3)
    alone, helped = map(float, re.findall(r"within (\S+) au", output))
    assert alone > 5e-3
    assert helped < 5e-5
    assert (tmp_path / "ceres_orbit.png").stat().st_size > 10_000
