"""Families of like terms in loops: the same motion, energy and symmetries as written out, in a short text."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen import as_method, symmetries
from scvi_codegen.codegen import pipeline
from scvi_codegen.codegen.pipeline import program_of
from scvi_codegen.systems import term_groups as module

FLAGS = {"flags": QUICK_FLAGS}
MANY = 4
"""Added to five coordinates: forces of more than eight are not linearised, which terms in loops are not either."""


def bodies(name: str, count: int, **extra: object) -> sc.LagrangianSystem:
    """Masses as parameters but for the first, which is a number; a family of two kinds of constants."""
    names = [f"{c}{i}" for i in range(count) for c in "xyz"]
    masses = ["2", *(f"m{i}" for i in range(1, count))]
    kinetic = [f"{m}*({' + '.join(f'{c}{i}_dot**2' for c in 'xyz')})/2" for i, m in enumerate(masses)]
    pairs = [
        f"{masses[i]}*{masses[j]}/sqrt({' + '.join(f'({c}{i} - {c}{j})**2' for c in 'xyz')})"
        for i, j in combinations(range(count), 2)
    ]
    parameters = {f"m{i}": 1 + i / 7 for i in range(1, count)} | {"c": 0.1}
    return sc.LagrangianSystem.from_text(
        name=name, coordinates=names, lagrangian=" + ".join(kinetic + pairs), parameters=parameters, **extra
    )


def driven(name: str, count: int) -> sc.LagrangianSystem:
    """Forces, damping and time dependence in addition to the term groups."""
    forces = {"x0": "-c*x0_dot**3", "y1": "c*x1*cos(t)"}
    return bodies(name, count, forces=forces, damping="c/5")


def coupled(name: str, count: int) -> sc.LagrangianSystem:
    """A kinetic energy that is no sum of squares."""
    q = [f"q{i}" for i in range(count + MANY)]
    kinetic = [f"{a}_dot**2" for a in q] + [f"cos({a})*{a}_dot*{b}_dot/4" for a, b in pairwise(q)]
    springs = [f"-({b} - {a} - {k}/10)**2/2 - k*sin(t)*({b} - {a})**4" for k, (a, b) in enumerate(pairwise(q))]
    return lagrange(name, q, " + ".join(kinetic) + " ".join(springs), k=0.3)


def hamiltonian(name: str, count: int) -> sc.HamiltonianSystem:
    q = [f"q{i}" for i in range(count)]
    kinetic = " + ".join(f"sqrt(1 + p_{a}**2)*(1 + {a}**2/20)" for a in q)
    springs = " + ".join(f"({b} - {a})**2/2 + exp({b} - {a})" for a, b in pairwise(q))
    return sc.HamiltonianSystem.from_text(name=name, coordinates=q, hamiltonian=f"{kinetic} + {springs}")


@pytest.fixture
def few(monkeypatch):
    """Families of three terms are rolled."""
    monkeypatch.setattr(module, "MIN_GROUP_SIZE", 3)
    module.roll_terms.cache_clear()
    yield
    module.roll_terms.cache_clear()


def swinging(name: str, count: int) -> sc.LagrangianSystem:
    """A chain of rods in absolute angles, whose mass matrix is full; masses are parameters or numbers."""
    count += MANY
    q = [f"q{i}" for i in range(count)]
    beyond = [f"({' + '.join(['2', *(f'm{k}' for k in range(max(i, 1), count))])})" for i in range(count)]
    kinetic = [f"{beyond[i]}*{a}_dot**2/2 + {beyond[i]}*cos({a})" for i, a in enumerate(q)]
    pairs = [f"{i + 2}*cos({q[i]} - {q[j]})*{q[i]}_dot*{q[j]}_dot/5" for j, i in combinations(range(count), 2)]
    parameters = {f"m{i}": 1 + i / 7 for i in range(1, count)}
    return sc.LagrangianSystem.from_text(
        name=name,
        coordinates=q,
        lagrangian=" + ".join(kinetic + pairs),
        parameters=parameters,
        forces={"q0": "-q0_dot"},
    )


def varying(name: str, count: int) -> sc.LagrangianSystem:
    """Masses that depend on their own coordinate, momenta that depend on others, and a potential."""
    q = [f"q{i}" for i in range(count + MANY)]
    kinetic = [
        f"{a}_dot**2*(1 + {a}**2/{i + 2})/2 + {i + 1}*{a}*{b}_dot*sin({a})/9" for i, (a, b) in enumerate(pairwise(q))
    ]
    springs = [f"{k + 1}*cos({b} - {a})" for k, (a, b) in enumerate(combinations(q, 2))]
    return lagrange(name, q, " + ".join([*kinetic, f"{q[-1]}_dot**2", *springs]))


CASES = [
    (swinging, "svi:4"),
    (swinging, "svi:2"),
    (varying, "svi:3"),
    (bodies, "svi:4"),
    (bodies, "stoermer-verlet"),
    (driven, "svi:3"),
    (coupled, "svi:2"),
    (hamiltonian, "gauss:2"),
    (hamiltonian, "svi:3"),
]


@pytest.mark.rotated
@pytest.mark.sampled(4)
@pytest.mark.parametrize(("make", "method"), CASES)
@pytest.mark.usefixtures("few")
def test_steps_energies_and_ensembles_equal_those_of_unrolled_terms(make, method, monkeypatch):
    system = make("rolled", 5)
    assert module.roll_terms(system) or module.roll_terms(system, moving=True)
    rolled = sc.compile_stepper(system, method, **FLAGS)
    assert "index_e < " in rolled.source.code
    monkeypatch.setattr(module, "MIN_GROUP_SIZE", 10**6)
    module.roll_terms.cache_clear()
    written = sc.compile_stepper(make("written_out", 5), method, **FLAGS)
    assert "index_e < " not in written.source.code
    q, v = np.random.default_rng(2).normal(size=(2, len(system.coordinates)))
    start = {"q": q, "p": v}
    one, other = (each.integrate(**start, h=0.01, steps=10) for each in (rolled, written))
    assert np.abs(one.q - other.q).max() < 1e-13 * np.abs(q).max()
    assert np.abs(one.p - other.p).max() < 1e-12 * np.abs(one.p).max()
    assert np.abs(one.energy() - other.energy()).max() < 1e-12 * np.abs(one.energy()).max()
    assert one.iterations.sum() <= 1.1 * other.iterations.sum()
    many, others = (each.integrate_ensemble([q, -q], [v, v], h=0.01, steps=10) for each in (rolled, written))
    assert np.abs(many.q - others.q).max() < 1e-13 * np.abs(q).max()


@pytest.mark.rotated
@pytest.mark.usefixtures("few")
def test_symmetries_equal_those_of_unrolled_terms(monkeypatch):
    rolled = symmetries(bodies("rolled", 14))
    monkeypatch.setattr(module, "MIN_GROUP_SIZE", 10**6)
    module.roll_terms.cache_clear()
    assert [str(each) for each in rolled] == [str(each) for each in symmetries(bodies("written_out", 14))]
    assert len(rolled) == 9


@pytest.mark.rotated
@pytest.mark.usefixtures("few")
def test_the_number_of_operations_in_the_text_does_not_grow_with_the_number_of_terms():
    sizes = []
    for count in (5, 15):
        program = program_of(bodies(f"rolled_{count}", count), as_method("svi:2"), fallback=False)
        (force,) = program.fixed_point.kernels
        sizes.append([len(each.kernel.temporaries) for each in force.sums])
        assert all(not str(result).startswith("Operation") for result in force.results)
        assert sum(each.rows for each in force.sums) == count * (count - 1) // 2
    assert sizes[0] == sizes[1]


@pytest.mark.rotated
def test_few_terms_and_constraints_remain_unrolled():
    assert module.roll_terms(bodies("few", 5)) is None
    rods = [f"(x{i} - x{i + 1})**2 + (y{i} - y{i + 1})**2 + (z{i} - z{i + 1})**2 = 1" for i in range(46)]
    assert module.roll_terms(bodies("held", 47, constraints=rods)) is None


@pytest.mark.rotated
def test_long_kernels_warn_with_statements_of_the_same_motion_that_are_short(monkeypatch, tmp_path):
    """A chain in angles from the vertical, as points of arrays with rods, and by the joints of a file."""
    n, start = 6, np.linspace(0.5, 0.1, 6)
    q = [f"q{i}" for i in range(n)]
    rods = [f"{n - i}*({a}_dot**2/2 + cos({a})) + J*{a}_dot**2/2" for i, a in enumerate(q)]
    pairs = [f"{n - j}*cos({q[i]} - {q[j]})*{q[i]}_dot*{q[j]}_dot" for i, j in combinations(range(n), 2)]
    angles = lagrange("angles", q, " + ".join(rods + pairs), J=0.0)
    sources = pipeline.Sources(angles, as_method("svi:8"), "auto", None, (), None, None)
    monkeypatch.setattr(pipeline, "MOST_OPERATIONS", 500)
    with pytest.warns(sc.MethodWarning, match=r"^the step of 'angles' .*: state .* joints in a file .*r\[N, 2\]"):
        sources.program()
    with pytest.warns(sc.MethodWarning, match=r"^Newton's iteration of .* operations; above 500 .*: shorten .*; or "):
        sources.program(fallback=True)
    monkeypatch.undo()

    stepper, span = sc.compile_stepper(angles, "svi:8", **FLAGS), {"h": 1 / 64, "steps": 64}
    end = stepper.integrate(start, velocity=0 * start, **span).q[-1]
    points = sc.LagrangianSystem.from_text(
        name="points",
        coordinates=["r[N, 2]"],
        lagrangian="sum(i in N, (r_dot[i,0]**2 + r_dot[i,1]**2)/2 - r[i,1])",
        constraints=[
            "r[0,0]**2 + r[0,1]**2 = 1",
            "(r[i+1,0] - r[i,0])**2 + (r[i+1,1] - r[i,1])**2 = 1 for i in 0..N-2",
        ],
    )
    places = [np.cumsum(np.column_stack([np.sin(a), -np.cos(a)]), axis=0) for a in (start, end)]
    run = sc.compile_stepper(points, "composition:8", **FLAGS).integrate(places[0], **span)
    np.testing.assert_allclose(run.q["r"][-1], places[1], atol=1e-9)

    end = stepper.integrate(start, velocity=0 * start, parameters={"J": 0.1}, **span).q[-1]
    bodies = "".join(
        f'<body pos="0 0 {-float(k > 0)}"><joint name="q{k}" axis="0 1 0"/>'
        '<inertial pos="0 0 -1" mass="1" diaginertia="0.1 0.1 0.1"/>'
        for k in range(n)
    )
    file = tmp_path / "chain.xml"
    file.write_text(f'<mujoco><option gravity="0 0 -1"/><worldbody>{bodies}{"</body>" * n}</worldbody></mujoco>')
    joints = sc.compile_stepper(sc.LagrangianSystem.from_mjcf(file), "svi:8", **FLAGS)
    run = joints.integrate(np.diff(start, prepend=0), velocity=0 * start, **span)
    np.testing.assert_allclose(np.cumsum(run.q[-1]), end, atol=1e-9)
