"""Lagrangians rolled into sums of array terms: the same motion, few term groups, and errors."""

from itertools import pairwise

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.common.errors import SystemDefinitionError


def lagrangian(names, text, **parameters):
    return sc.LagrangianSystem.from_text(name="written", coordinates=names, lagrangian=text, parameters=parameters)


def bodies(count):
    names = [f"{c}{i}" for i in range(count) for c in "xyz"]
    kinetic = [f"m{i}*(x{i}_dot**2 + y{i}_dot**2 + z{i}_dot**2)/2" for i in range(count)]
    pairs = [
        f"G*m{i}*m{j}/sqrt((x{i} - x{j})**2 + (y{i} - y{j})**2 + (z{j} - z{i})**2)"
        for i in range(count)
        for j in range(i)
    ]
    return lagrangian(names, " + ".join(kinetic + pairs), G=0.5, **{f"m{i}": 1 + i / 7 for i in range(count)})


def lattice(count):
    """Springs with constants of their own, a sine, a place apart, time."""
    names = [f"q{i}" for i in range(count)]
    kinetic = [f"{1 + i}*{q}_dot**2/2" for i, q in enumerate(names)]
    springs = [f"-{k + 1}*({b} - {a} - {k}/10)**2/2 + k*cos({a})" for k, (a, b) in enumerate(pairwise(names))]
    return lagrangian(names, " + ".join(kinetic) + " ".join(springs) + " - q0**4*sin(t)", k=0.3)


def damped(count):
    """Forces of two kinds and an input."""
    q = [f"q{i}" for i in range(count)]
    kinetic = " + ".join(f"{a}_dot**2/2" for a in q)
    springs = "".join(f" - ({b} - {a})**2/2 - ({b} - {a})**4" for a, b in pairwise(q))
    friction = {a: f"-c*{k + 1}*{a}_dot**3 + sin({b} - {a})" for k, (a, b) in enumerate(pairwise(q))}
    return lagrange("damped", q, f"{kinetic}{springs} - q0**2/2", c=0.1, forces={**friction, q[-1]: "c*cos(t)"})


def canonical(count):
    """A Hamiltonian that is no sum of both energies."""
    q = [f"q{i}" for i in range(count)]
    terms = [f"((q{i} - q{i + 1})**2 + (p_q{i} - p_q{i + 1})**2)/2" for i in range(count - 1)]
    terms += [f"{i + 1}*({a}**2 + p_{a}**2)**2/4" for i, a in enumerate(q)]
    return sc.HamiltonianSystem.from_text(name="canonical", coordinates=q, hamiltonian=" + ".join(terms))


EXAMPLES = [bodies(4), bodies(12), lattice(5), lattice(13), damped(6), canonical(5)]


@pytest.mark.rotated
@pytest.mark.sampled(3)
@pytest.mark.parametrize("system", EXAMPLES, ids=lambda each: each.name)
def test_rolled_system_has_equal_trajectories(system):
    found = sc.roll_sums(system)
    q, v = np.random.default_rng(3).normal(size=(2, len(system.coordinates)))
    start = {"p" if system.auxiliaries else "velocity": v}
    run = sc.compile_stepper(found.system, "gauss:4").integrate(
        q, **start, h=0.01, steps=5, tables=found.tables, parameters=found.parameters
    )
    other = sc.compile_stepper(system, "gauss:4").integrate(q, **start, h=0.01, steps=5)
    assert np.abs(run.q["q"] - other.q).max() < 1e-13 * np.abs(q).max()
    assert np.abs(run.energy() - other.energy()).max() < 1e-12 * np.abs(run.energies).max()


def test_common_parameters_remain_scalar():
    found = sc.roll_sums(bodies(4))
    assert [str(name) for name in found.system.parameters] == ["G"]
    assert found.system.defaults == (0.5,)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (lagrangian(["x"], "x_dot**2*x**2/2"), "m\\*v\\*\\*2/2 only"),
        (
            lagrangian(["x"], "x_dot**2/2 + " + " + ".join(f"x**{k} + sin(x)*x**{k}" for k in range(3, 50))),
            "more than 64 different structures",
        ),
        (lagrange("damped", "x", "x_dot**2/2", damping="1"), "'damped' has damping"),
        (lagrange("rod", "x y", "x_dot**2/2 + y_dot**2/2", constraints=["x**2 + y**2 = 1"]), "'rod' has constraints"),
    ],
)
def test_unsupported_systems_are_rejected(system, message):
    with pytest.raises(SystemDefinitionError, match=message):
        sc.roll_sums(system)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", ["b", "q", "N", "at0", "B0", "q_dot", "c0_1", "p_q"])
def test_parameter_names_differ_from_names_of_arrays_and_tables(name):
    written = lagrangian(["x", "y"], f"x_dot**2/2 + y_dot**2/2 - {name}*x**2/2 - 3*{name}*y**2/2", **{name: 1.3})
    found = sc.roll_sums(written)
    own = sc.compile_stepper(found.system, "stoermer-verlet").integrate(
        [1.0, 2.0], h=0.1, steps=3, tables=found.tables, parameters={**found.parameters, name: 1.7}
    )
    other = sc.compile_stepper(written, "stoermer-verlet")
    (q,) = own.q.values()
    expected = other.integrate([1.0, 2.0], [0.0, 0.0], h=0.1, steps=3, parameters={name: 1.7}).q
    assert np.abs(q - expected).max() < 1e-15
