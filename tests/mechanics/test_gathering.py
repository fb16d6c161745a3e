"""Written-out Lagrangians gathered into sums over indices: the same motion, few families, and what is refused."""

from itertools import pairwise

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.errors import SystemDefinitionError


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


@pytest.mark.parametrize("system", [bodies(4), bodies(12), lattice(5), lattice(13)], ids=lambda each: each.name)
def test_the_motion_is_the_same(system):
    found = sc.gather_sums(system)
    q, v = np.random.default_rng(3).normal(size=(2, len(system.coordinates)))
    run = sc.compile_indexed(found.system, "svi:4").integrate(
        q, velocity=v, h=0.01, steps=5, tables=found.tables, parameters=found.parameters
    )
    other = sc.compile_stepper(system, "svi:4").integrate(q, velocity=v, h=0.01, steps=5)
    assert np.abs(run.q["q"] - other.q).max() < 1e-13 * np.abs(q).max()
    assert np.abs(run.energy() - other.energy()).max() < 1e-12 * np.abs(run.energies).max()


def test_the_text_does_not_grow():
    few, many = (sc.gather_sums(bodies(count)) for count in (6, 20))
    assert str(few.system) == str(many.system)
    assert len(few.system.terms) == 2
    assert len(sc.gather_sums(lattice(40)).system.terms) < 10  # some constants are 0, 1 or reduced


def test_parameters_that_all_have_in_common_stay():
    found = sc.gather_sums(bodies(4))
    assert [str(name) for name in found.system.parameters] == ["G"]
    assert found.system.defaults == (0.5,)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (lagrangian(["x"], "x_dot**2*x**2/2"), "m\\*v\\*\\*2/2 alone"),
        (
            lagrangian(["x"], "x_dot**2/2 + " + " + ".join(f"x**{k} + sin(x)*x**{k}" for k in range(3, 50))),
            "more than 64 kinds",
        ),
        (
            sc.LagrangianSystem.from_text(
                name="damped", coordinates=["x"], lagrangian="x_dot**2/2", forces={"x": "-x_dot"}
            ),
            "forces beside the Lagrangian",
        ),
    ],
)
def test_what_is_refused(system, message):
    with pytest.raises(SystemDefinitionError, match=message):
        sc.gather_sums(system)
