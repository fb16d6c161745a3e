"""The Lagrangian of ``examples/solar_system``: its terms against forms found otherwise, and its runs against DE421."""

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import sympy

import scvi_codegen as sc

FOLDER = Path(__file__).parents[2] / "examples" / "solar_system"
MASSES = {"a": 1.0, "b": 0.7, "d": 0.2}
PLACES = np.array([[0.1, -0.2, 0.3], [1.4, 0.3, -0.2], [-0.6, 1.9, 0.4]])
VELOCITIES = np.array([[0.1, -0.3, 0.2], [-0.2, 0.6, 0.1], [0.4, 0.1, -0.3]])
PEERS = ("de421", "jplephem", "matplotlib")
needs_ephemeris = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in PEERS), reason="needs the extras 'ephemeris' and 'plot'"
)


@pytest.fixture(scope="module")
def example():
    """Imports a module of the example."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        yield importlib.import_module


def relativistic(example, masses, c):
    terms = example("point_masses")
    return sc.LagrangianSystem.from_text(
        name="relativistic",
        coordinates=terms.coordinates(tuple(masses)),
        lagrangian=f"{terms.newton(tuple(masses))} + {terms.relativity(tuple(masses))}",
        parameters={f"gm_{body}": mass for body, mass in masses.items()} | {"c": c},
    )


def newhall_accelerations(gm, x, v, c):
    """The equations of motion as ephemerides use them: Newhall, Standish & Williams, A&A 125 (1983), equation 1."""
    n = len(gm)
    to = x[None] - x[:, None]  # [a, b]: from a to b
    r = np.linalg.norm(to, axis=-1) + np.eye(n)
    pull = gm * (1.0 - np.eye(n)) / r**3
    newton = np.einsum("ab,abi->ai", pull, to)
    potential = (gm * (1.0 - np.eye(n)) / r).sum(axis=1)
    along = np.einsum("abi,bi->ab", to, v) / r
    factor = -4.0 * potential[:, None] - potential + (v**2).sum(1)[:, None] + 2.0 * (v**2).sum(1) - 4.0 * v @ v.T
    factor += -1.5 * along**2 + 0.5 * np.einsum("abi,bi->ab", to, newton)
    drag = pull * np.einsum("abi,abi->ab", -to, 4.0 * v[:, None] - 3.0 * v)
    extra = np.einsum("ab,abi->ai", pull * factor, to) + np.einsum("ab,abi->ai", drag, v[:, None] - v)
    extra += 3.5 * np.einsum("ab,bi->ai", gm * (1.0 - np.eye(n)) / r, newton)
    return newton + extra / c**2


@pytest.mark.full
def test_bodies_move_as_einstein_infeld_and_hoffmann_found(example):
    """The residual of the closed-form accelerations in the equations of L is of the next order, 1/c^4."""
    system = relativistic(example, MASSES, 1.0)
    q, v = (sympy.Matrix(list(each)) for each in (system.coordinates, system.velocities))
    momenta = sympy.Matrix([system.lagrangian]).jacobian(v)
    forces = sympy.Matrix([system.lagrangian]).jacobian(q)
    accelerations = sympy.Matrix(sympy.symbols(f"acceleration:{len(q)}"))
    equations = momenta.jacobian(v) * accelerations + momenta.jacobian(q) * v - forces.T
    names = [symbol for symbol in system.lagrangian.free_symbols if symbol not in {*q, *v}]
    residual = sympy.lambdify([list(q), list(v), list(accelerations), names], list(equations), cse=True)
    gm, left = np.array(list(MASSES.values())), []
    for c in (20.0, 200.0):
        values = [c if symbol.name == "c" else MASSES[symbol.name.removeprefix("gm_")] for symbol in names]
        found = newhall_accelerations(gm, PLACES, VELOCITIES, c)
        left.append(np.array(residual(PLACES.ravel(), VELOCITIES.ravel(), found.ravel(), values)))
    assert np.abs(left[0]).max() < 1e-4
    np.testing.assert_allclose(left[1] * 1e4, left[0], rtol=0.05, atol=1e-6)


def value(text, values):
    """Return the value of a formula without velocities and time."""
    return float(eval(text, {"sqrt": np.sqrt, "sin": np.sin, "cos": np.cos} | values))


def placed(**places):
    return {
        f"{body}_{x}": coordinate for body, place in places.items() for x, coordinate in zip("xyz", place, strict=True)
    }


def test_zonal_harmonics_are_those_of_two_masses_on_the_axis(example):
    """Halves at a distance d along the axis have J_n R^n = -d^n for even n, and none for odd ones."""
    axis, place, d, radius = np.array([0.36, -0.48, 0.8]), np.array([1.1, 2.0, -0.4]), 0.05, 0.7
    harmonics = {2: -((d / radius) ** 2), 4: -((d / radius) ** 4)}
    values = placed(a=(0.3, 0.1, 0.2), b=place) | {"gm_a": 2.0, "gm_b": 3.0}
    text = example("figures").zonal("a", ["b"], [repr(k) for k in axis.tolist()], radius, harmonics)
    to = place - [0.3, 0.1, 0.2]
    exact = sum(3.0 / np.linalg.norm(to + side * d * axis) for side in (-1, 1)) - 6.0 / np.linalg.norm(to)
    assert value(text, values) == pytest.approx(exact, rel=1e-6)


def test_the_moon_is_a_body_of_three_axes(example):
    """Against six masses in pairs on its axes, whose quadrupole is J2 and C22 by definition."""
    lengths, gm_moon, gm_earth, radius = np.array([0.011, 0.009, 0.008]), 0.3, 2.0, 0.02
    axes = np.linalg.qr(np.array([[1.0, 0.3, 0.2], [-0.1, 1.0, 0.5], [0.4, 0.2, 1.0]]))[0].T
    x2, y2, z2 = (lengths**2 / 3.0).tolist()
    j2, c22 = (x2 + y2 - 2.0 * z2) / (2.0 * radius**2), (x2 - y2) / (4.0 * radius**2)
    earth = np.array([0.5, -0.7, 0.4])
    masses = [side * length * axis for (length, axis), side in product(zip(lengths, axes, strict=True), (-1, 1))]
    exact = sum(gm_moon * gm_earth / 6.0 / np.linalg.norm(earth - place) for place in masses)
    exact -= gm_moon * gm_earth / np.linalg.norm(earth)
    written = [[repr(k) for k in axes[i].tolist()] for i in (2, 0)]
    values = placed(moon=(0, 0, 0), earth=earth) | {"gm_moon": gm_moon, "gm_earth": gm_earth}
    assert value(example("figures").moon(*written, radius, j2, c22), values) == pytest.approx(exact, rel=2e-3)


@pytest.mark.rotated
def test_tides_are_mignards_for_one_love_number_and_one_small_lag(example):
    """Mignard, The Moon and the Planets 20 (1979), equation 5, for an Earth that turns about the z axis."""
    tides = example("tides")
    place, speed, radius, love, lag = np.array([0.9, -0.5, 0.6]), np.array([0.02, 0.07, -0.03]), 0.3, 0.4, 1e-6
    forces = tides.tide(radius, (love,) * 3, (lag,) * 3)
    states = placed(moon=place, earth=(0, 0, 0)) | placed(moon_dot=speed, earth_dot=(0, 0, 0))
    states = {re.sub(r"_dot_(\w)$", r"_\1_dot", name): number for name, number in states.items()} | {"gm_moon": 0.2}
    found = np.array([value(forces[f"moon_{x}"], states) for x in "xyz"])
    r2 = place @ place
    turned = np.cross(place, [0.0, 0.0, float(tides.TURNING)]) + speed
    at_once, late = r2 * place, 2.0 * (place @ speed) * place + r2 * turned
    factor = -3.0 * love * 0.2**2 * radius**5 / r2**5
    late *= factor * lag
    np.testing.assert_allclose(found - factor * at_once, late, rtol=0, atol=1e-4 * abs(late).max())
    assert [value(forces[f"earth_{x}"], states) for x in "xyz"] == pytest.approx(-found, rel=1e-14)


@needs_ephemeris
def test_elements_of_asteroids_are_those_of_their_states(example):
    asteroids, gm = example("asteroids"), example("ephemeris").constant("GMS")
    for name, (_, a, e, inclination, *_) in asteroids.ELEMENTS.items():
        q, v = asteroids.heliocentric(name)
        h = np.cross(q, v)
        normal = h @ [0.0, -np.sin(asteroids.OBLIQUITY), np.cos(asteroids.OBLIQUITY)] / np.linalg.norm(h)
        assert 1.0 / (2.0 / np.linalg.norm(q) - v @ v / gm) == pytest.approx(a, rel=1e-12)
        assert np.linalg.norm(np.cross(v, h) / gm - q / np.linalg.norm(q)) == pytest.approx(e, abs=1e-12)
        assert np.degrees(np.arccos(normal)) == pytest.approx(inclination, abs=1e-10)


def output_of(script, folder, *arguments):
    path = os.pathsep.join([str(FOLDER.parents[1]), os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(
        [sys.executable, "-W", "error", str(FOLDER / script), *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, "")
    return result.stdout


@pytest.mark.full
@pytest.mark.usefixtures("as_users_compile")
@needs_ephemeris
class TestRuns:
    def test_each_term_reduces_the_distance_to_de421(self, tmp_path):
        output = output_of("solar_system.py", tmp_path)
        title, *rows = output.split("\n\n")[1].splitlines()
        bodies = rows[0].split()
        table = {row[:32].strip(): dict(zip(bodies, map(float, row[32:].split()), strict=True)) for row in rows[1:]}
        newton, relativity, sun, earth, moon, tides, more = table.values()
        assert "1899 to 2053" in title
        assert newton["mercury"] > 20_000 > 15 > relativity["mercury"] > 10 > 1 > sun["mercury"] > more["mercury"]
        assert sun["moon"] > 1_000 > 100 > earth["moon"] > 2 * moon["moon"] > 10 > 0.5 > tides["moon"]
        assert tides["mars"] > 2 * more["mars"]
        assert max(more.values()) < 50
        turning = [float(line[32:]) for line in output.split("\n\n")[3].splitlines()[1:]]
        assert abs(turning[4] - 25.86) < 0.2  # by laser ranging, Chapront, Chapront-Touze & Francou, A&A 387 (2002)
        assert abs(turning[5]) < 1.0
        halves = [float(found) for found in re.findall(r"half steps change \w+ by (\d+) m", output)]
        assert max(halves) < 100
        assert (tmp_path / "solar_system.png").stat().st_size > 50_000

    def test_rebound_gives_the_same_trajectory(self, tmp_path):
        pytest.importorskip("rebound", reason="needs rebound")
        output = output_of("beside_rebound.py", tmp_path, "1")
        apart = [float(metres) for line in output.splitlines() if "apart" in line for metres in line.split()[4:-1]]
        assert len(apart) >= 10
        assert max(apart) < 20.0

    def test_secular_frequencies_are_near_laskars(self, tmp_path):
        """Two million years are few: seven periods of g5."""
        rows = [
            line.split() for line in output_of("secular.py", tmp_path, "2").splitlines() if re.match("[gs][5-8] ", line)
        ]
        found = {name: [float(number) for number in numbers] for name, *numbers in rows}
        for name in ("g5", "g6", "s6"):
            here, apart, published = found[name]
            assert here == pytest.approx(published, abs=0.02)
            assert apart < 0.1
        assert (tmp_path / "secular.png").stat().st_size > 20_000
        again = output_of("secular.py", tmp_path, "2.1")
        steps = [int(count.replace(",", "")) for count in re.findall(r"^([\d,]+) steps in", again, re.MULTILINE)]
        assert steps == [92_000]  # of 400 days: the run goes on from where it was
