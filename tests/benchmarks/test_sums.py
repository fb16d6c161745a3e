"""Array systems, multibody systems and fields of the benchmark: all contenders compute the same motion."""

from dataclasses import replace

import numpy as np
import pytest

import benchmarks as bench
from benchmarks import sections
from benchmarks.cases.fields import FIELDS, our_fields
from benchmarks.cases.large import atoms, field, ring
from benchmarks.cases.robots import chain, four_bar
from benchmarks.contenders import arrays, engines, pdes
from benchmarks.contenders.ours import fixed_contenders
from scvi_codegen.methods import Composition


def quiet(text):
    """Says nothing."""


def end(contender):
    """Return the final positions of a contender."""
    found = contender.prepare(0)()
    return found() if callable(found) else found


def ours(case, method, steps):
    """Return the final positions of this package."""
    (contender,) = fixed_contenders(case, {method: [steps]})
    return end(contender)


@pytest.mark.tiers(1)
@pytest.mark.parametrize("case", [ring(8, 1.0), field(6, 0.2)], ids=lambda case: case.name)
def test_lattices_by_hand_move_as_generated_ones(case):
    by_hand, generated = end(arrays.by_hand(case, "", 8, 10)), ours(case, Composition(8), 10)
    assert np.abs(by_hand - generated).max() < 1e-14
    assert np.abs(generated - case.q[0]).max() > 0.01


@pytest.mark.parametrize("name", sorted(arrays.PLATFORMS))
def test_openmm_makes_the_steps_of_leapfrog(name):
    pytest.importorskip("openmm", reason="needs the extra 'bench'")
    crystal, steps = atoms(1, 0.5), 50
    found = ours(crystal, "stoermer-verlet", steps)
    rounding = {"OpenMM CPU": 1e-5, "OpenMM Reference": 1e-13}[name]
    assert np.abs(end(arrays.openmm_contender(crystal, name, steps)) - found).max() < rounding
    assert np.abs(found - crystal.q[0]).max() > 0.1


@pytest.mark.rotated
@pytest.mark.parametrize("make", [lambda: chain(2), four_bar], ids=["chain", "four-bar"])
def test_multibody_systems_are_measured_without_peers(make):
    plan = bench.Plan(quick=True, peers=(), repeats=1)
    result = bench.run_race(
        lambda plan: sections._halved(make, {"svi:2": range(2)}, {"svi:3": 2, "svi:2": 3}, plan), plan, quiet
    )
    assert result.methods() == ["scvi-codegen svi:2"]
    assert 0.0 < min(each.error for each in result.measurements) < 1e-6


@pytest.mark.parametrize(("name", "most"), [("mujoco", 0.01), ("pinocchio", 0.01), ("exudyn", 1e-6)])
def test_chains_move_in_engines_as_here(name, most):
    """At steps or tolerances of at most ``most``."""
    pytest.importorskip(name, reason="extra bench")
    robot = chain(3)
    contenders = getattr(engines, f"{name}_contenders")(robot, quick=name == "exudyn")
    found = end(next(each for each in contenders if float(each.setting.partition("=")[2]) <= most))
    assert np.abs(found - ours(robot, "svi:4", 200)).max() < 2e-6


def test_instability_of_mujoco_is_reported_and_leaves_no_file(monkeypatch, here):
    """MuJoCo would write its warnings into the working folder."""
    pytest.importorskip("mujoco", reason="extra bench")
    monkeypatch.setattr(engines, "LARGEST_STEP", 2.0)
    robot = replace(chain(5), span=400.0)
    with pytest.raises(ArithmeticError, match="unstable"):
        end(next(engines.mujoco_contenders(robot, quick=True)))
    assert not list(here.iterdir())


@pytest.mark.parametrize("name", FIELDS)
def test_exact_solutions_of_fields_solve_their_equations(name):
    """Differences of order 8 in space, of order 2 in time."""
    case, t, dt = FIELDS[name](), 0.7, 1e-4
    axes = pdes._axes(case, 128 if name == "wave-2d" else 512)
    points, dx = pdes._points(axes), axes[0][1] - axes[0][0]
    before, now, after = (case.exact(points, t + k * dt) for k in (-1, 0, 1))

    def laplacian(u):
        total = len(axes) * pdes.STENCIL[0] * u
        for k, weight in enumerate(pdes.STENCIL[1:], 1):
            total = total + weight * sum(np.roll(u, sign * k, axis) for axis in range(len(axes)) for sign in (1, -1))
        return total / dx**2

    if case.complex:
        psi, rate = now[0] + 1j * now[1], (after[0] - before[0] + 1j * (after[1] - before[1])) / (2 * dt)
        rest = 1j * rate + laplacian(psi) / 2 + abs(psi) ** 2 * psi
    else:
        nonlinear = np.sin(now[0]) if name == "breather" else 0.0
        rest = (after[0] - 2 * now[0] + before[0]) / dt**2 - laplacian(now[0]) + nonlinear
        assert np.abs((after[0] - before[0]) / (2 * dt) - now[1]).max() < 1e-6 * np.abs(now[1]).max()
    assert np.abs(rest).max() < 1e-4 * max(1.0, np.abs(now[0]).max())


@pytest.mark.rotated
def test_fields_are_measured_without_peers_and_by_split_steps():
    case = FIELDS["breather"]()
    here = [each.error(end(each)) for each in our_fields(case, quick=True)]
    assert min(here) < 0.03
    contenders = [each for each in pdes.fft_contenders(case.plain(), quick=False) if each.method.endswith("8")]
    split = next(each for each in contenders if each.setting == "256 points, 200 steps")
    assert split.error(end(split)) < 1e-8
