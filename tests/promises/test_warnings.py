"""Warnings name the line of the user's that they are about."""

import pytest
from notation import lagrange

import scvi_codegen as sc

ROD = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 - 1"])


def too_long():
    sc.compile_stepper(ROD, "svi:2").integrate([1.0, 0.0], velocity=[0.0, 3.0], h=0.4, steps=10)


def off_its_constraints():
    sc.compile_stepper(ROD, "svi:2").start([1.001, 0.0], velocity=[0.0, 0.0], h=0.01)


def of_few_points():
    sc.SVI(4, "gauss-legendre:3")


@pytest.mark.parametrize("act", [too_long, off_its_constraints, of_few_points])
def test_warning_points_to_the_calling_line(act):
    with pytest.warns((sc.AccuracyWarning, sc.MethodWarning)) as heard:
        act()
    assert {warning.filename for warning in heard} == {__file__}
    first = act.__code__.co_firstlineno
    assert {warning.lineno for warning in heard} == {first + 1}


@pytest.mark.parametrize(
    ("q", "velocity", "reported"),
    [
        ([1.001, 0.0], [0.0, 1.0], r"x\*\*2 \+ y\*\*2 - 1 is 0.002, not 0"),
        ([0.6006, 0.8008], [-0.8, 0.6], r"\(relative\): x\*\*2 \+ y\*\*2 - 1 is 0.002, not 0"),  # its rate is 1e-16
        ([1.0, 0.0], [0.001, 1.0], r"the rate of x\*\*2 \+ y\*\*2 - 1 is 0.002, not 0"),
        (
            [1.001, 0.0],
            [0.001, 1.0],
            r"x\*\*2 \+ y\*\*2 - 1 is 0.002 and the rate of x\*\*2 \+ y\*\*2 - 1 is 0.002, not 0",
        ),
    ],
)
def test_start_off_its_constraints_warns_with_the_violation(q, velocity, reported):
    with pytest.warns(sc.AccuracyWarning, match=reported):
        sc.compile_stepper(ROD, "svi:2").start(q, velocity=velocity, h=0.01)
