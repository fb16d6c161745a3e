"""Kinetic energies of trees as functions of momenta: against Lagrangians, and steps against those by mass matrices."""

import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy

import scvi_codegen as sc
from benchmarks.cases import robots
from scvi_codegen.codegen.ir.arithmetic import lower_kernel
from scvi_codegen.codegen.pipeline import Sources
from scvi_codegen.common.precision import mp
from scvi_codegen.extras.robots.trees import energies
from scvi_codegen.methods import as_method
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import Tape, gradient
from scvi_codegen.systems.formulas.intermediates import intermediate, intermediates, separated, written_out

pytestmark = pytest.mark.rotated

ROBOTS = Path(__file__).parent / "robots"
SMALL = 1e-13  # constant rotations are orthogonal to round-off
FOLLOWING = '<mimic joint="shoulder" multiplier="-0.5" offset="0.2"/>'


@pytest.fixture
def always(monkeypatch):
    """Recursion for trees of any size."""
    monkeypatch.setattr(energies, "SMALLEST", 1)


def chain(folder: Path, n: int) -> sc.LagrangianSystem:
    """Chain of bodies on hinges and slides, with rotors, a branch at the second body and springs."""
    kinds = ("hinge", "hinge", "slide")
    bodies = "".join(
        f'<body pos="0.1 0 {-0.4 * (i > 0)}"><joint name="q{i}" type="{kinds[i % 3]}" axis="{1 - i % 2} {i % 2} 0.3" '
        f'armature="{0.02 * (i % 2)}" stiffness="2"/><inertial pos=".02 0 -.2" mass="1" diaginertia="0.08 0.07 0.01"/>'
        for i in range(n)
    )
    branch = '<body pos="0 0.2 0"><joint name="q" axis="1 0 0"/><inertial pos="0 0 -.1" mass=".5" diaginertia="1 1 1"/>'
    closing = "</body>" * (n - 2) + branch + "</body></body></body>"
    path = folder / f"chain{n}.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}{closing}</worldbody></mujoco>")
    return sc.LagrangianSystem.from_mjcf(path)


def values(formulas, point):
    return Tape(list(formulas), list(point))(list(point.values()))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("robot", ["figure.xml", "ball.xml", "arm.urdf", "chain"])
def test_dual_energy_is_the_kinetic_energy_at_the_momenta_of_velocities(robot, tmp_path, always):
    if robot == "chain":
        system = chain(tmp_path, 5)
    elif robot == "arm.urdf":
        (tmp_path / robot).write_text((ROBOTS / robot).read_text().replace(FOLLOWING, ""))
        assert FOLLOWING in (ROBOTS / robot).read_text()
        system = sc.LagrangianSystem.from_urdf(tmp_path / robot, floating=True)
    else:
        system = sc.LagrangianSystem.from_mjcf(ROBOTS / robot)
    draw = random.Random(5)
    symbols = (*system.coordinates, *system.velocities)
    state = {symbol: mp.mpf(draw.uniform(-1, 1)) for symbol in symbols}
    p = values(forms_of(system).momentum, state)
    rest = values([system.lagrangian], state | dict.fromkeys(system.velocities, mp.zero))[0]
    kinetic = values([system.lagrangian], state)[0] - rest
    phase = dict(list(state.items())[: system.dimension]) | dict(zip(system.momentum_symbols, p, strict=True))
    dual, *velocities = values([system.dual_energy, *gradient_of(system)], phase)
    assert abs(dual - kinetic) < SMALL
    assert all(abs(v - state[symbol]) < SMALL for v, symbol in zip(velocities, system.velocities, strict=True))
    assert forms_of(system).inverse_mass is not None


def gradient_of(system):
    partials = gradient(system.dual_energy, system.momentum_symbols)
    return [partials[i] for i in range(system.dimension)]


def test_dual_energy_is_unknown_where_joints_follow_others_and_not_used_for_another_lagrangian(tmp_path, always):
    assert sc.LagrangianSystem.from_urdf(ROBOTS / "arm.urdf", floating=True).dual_energy == 0
    system = chain(tmp_path, 3)
    assert forms_of(system).inverse_mass is not None
    assert forms_of(replace(system, lagrangian=2 * system.lagrangian)).inverse_mass is None
    assert forms_of(replace(system, damping=sympy.Rational(1, 10))).inverse_mass is None


def test_small_trees_factorise_their_mass_matrices(tmp_path):
    assert chain(tmp_path, energies.SMALLEST - 2).dual_energy == 0
    large = chain(tmp_path, energies.SMALLEST - 1)  # and the branch
    assert large.dimension == energies.SMALLEST
    assert forms_of(large).inverse_mass is not None


@pytest.mark.full
def test_operations_of_the_recursion_are_linear(tmp_path, always):
    counts = []
    for n in (8, 14, 20):
        system = chain(tmp_path, n)
        inverse, of = forms_of(system).inverse_mass, (*system.coordinates, *system.momentum_symbols)
        formulas = (inverse.velocities, of), (inverse.terms, of), (inverse.solution, (*inverse.symbols, *of))
        kernels = [
            lower_kernel("k", arguments=arguments, time=system.time, parameters=(), values=tuple(each))
            for each, arguments in formulas
        ]
        counts.append([sum(kernel.operation_counts().values()) for kernel in kernels])
    few, some, many = np.array(counts)
    assert np.all(np.abs((many - some) - (some - few)) <= 8)
    assert many[2] < many[0] / 2  # most depends on positions only


@pytest.mark.quick
def test_separated_parts_do_not_depend_on_the_variables():
    x, y, z = sympy.symbols("x y z", real=True)
    inner = intermediate(sympy.sin(y) * x + 3 * y**2)
    formulas = [inner * x - 2 * sympy.sin(y) * z, inner**2 + sympy.cos(y), sympy.Integer(2), 5 * y]
    solution, parts = separated(formulas, {x, z})
    assert {symbol for each in solution for symbol in each.free_symbols} == {x, z, *parts.values()}
    assert all(part.free_symbols == {y} for part in parts)
    assert 5 * parts[y] == solution[3]
    back = {symbol: part for part, symbol in parts.items()}
    for before, after in zip(formulas, solution, strict=True):
        assert sympy.expand(written_out(after).xreplace(back) - written_out(before)) == 0
    assert intermediates(*solution)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("method", "solver", "options"), [
    ("svi:2", "fixed-point", {"h": 0.02, "steps": 50}),
    ("svi:2", "newton", {"h": 0.02, "steps": 50}),
    ("sc:3", "auto", {"h": 0.02, "steps": 50}),
    ("svi:3", "auto", {"t_end": 1.0, "tolerance": 1e-10}),
])  # fmt: skip
def test_steps_are_those_by_the_mass_matrix(tmp_path, always, method, solver, options):
    system = chain(tmp_path, 4)
    start, speed = np.array([0.5, -0.4, 0.1, 0.3, 0.8]), np.array([0.1, 2.0, -1.0, 0.4, 0.3])
    ends = []
    for each in (system, replace(system, dual_energy=sympy.S.Zero)):
        stepper = sc.compile_stepper(each, method, solver=solver)
        run = stepper.integrate(start, velocity=speed, **options)
        ends.append(np.concatenate([run.q[-1], run.p[-1], run.velocity[-1], run.energy()[-1:]]))
    np.testing.assert_allclose(ends[0], ends[1], rtol=3e-12, atol=3e-12)


@pytest.mark.quick
def test_momenta_and_velocities_are_by_kernels_of_the_iteration(tmp_path, always):
    system = chain(tmp_path, 2)
    sources = Sources(system, as_method("svi:2", system))
    alone, beside = ({kernel.name for kernel in sources.program(fallback=each).kernels} for each in (False, True))
    assert {"legendre", "inverse_legendre", "lagrangian"} <= beside
    assert alone == {"lagrangian_at_rest"}
    stepper, start = sc.compile_stepper(system, "svi:2"), np.array([0.5, -0.4, 0.1])
    speed = np.array([0.1, 2.0, -1.0])
    p = stepper.momentum(start, speed)
    np.testing.assert_allclose(stepper.velocity(start, p), speed, rtol=1e-13)


@pytest.mark.quick
def test_turned_vectors_have_no_entries_of_rounding_errors():
    numbers = robots.chain(4).system.lagrangian.atoms(sympy.Rational)
    inner = {
        number for each in intermediates(robots.chain(4).system.lagrangian) for number in each.atoms(sympy.Rational)
    }
    assert all(abs(number) > 1e-6 for number in (numbers | inner) if number)
