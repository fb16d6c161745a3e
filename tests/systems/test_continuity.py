"""Jumps of L and H across surfaces that are not located, and corners of constraints, are refused; others are not."""

from typing import Any

import pytest

import scvi_codegen as sc

FALL = "(x_dot**2 + y_dot**2)/2 - y"
JUMPS = {
    "a step of the potential": "x_dot**2/2 - 3*unit_step(x)",
    "a step of the mass": "(1 + unit_step(x))*x_dot**2/2",
    "a height that is 0 by default": "x_dot**2/2 - k*unit_step(x - a)",
    "a sawtooth": "x_dot**2/2 - wrap(x, 2)",
    "whole numbers": "x_dot**2/2 - rint(x)",
    "pieces that do not meet": "x_dot**2/2 - where(x > a, x, 0)",
    "a thin layer": "x_dot**2/2 - unit_step(x - a)*unit_step(a + 1/10 - x)",
}
CONTINUOUS = {
    "a wall": "x_dot**2/2 - 1e5*positive_part(-x)**2",
    "a corner": "x_dot**2/2 - 5*positive_part(x)",
    "a product that vanishes on the surface": "x_dot**2/2 - unit_step(x)*x**2",
    "two jumps that cancel": "x_dot**2/2 - unit_step(x) - unit_step(-x)",
    "a power that is not whole": "x_dot**2/2 - 1000*positive_part(-x)**(5/2)",
    "the size of a coordinate as mass": "(1 + abs(x))*x_dot**2/2",
    "powers of sizes": "x_dot**2/2 - abs(x)**2.5 - abs(x - a)**3 - k*abs(x)",
    "an infinite potential": "x_dot**2/2 - 1/abs(x) + log(abs(x - a))",
    "pieces that meet": "x_dot**2/2 - where(x > a, x - a, 0) - min(x, 2*x, 3)",
    "a time": "x_dot**2/2 - unit_step(t - a)*x",
    "a periodic spring": "x_dot**2/2 - wrap(x, 3)**2",
    "a shifted potential": "x_dot**2/2 - unit_step(4 - x**2)*(1/(1 + x**2) - 1/5)",
}


def line(text: str, **further: Any) -> sc.LagrangianSystem:
    known = {"k": 0.0, "a": 5.0}
    parameters = {name: value for name, value in known.items() if f"{name}*" in text or f" {name}" in text}
    return sc.LagrangianSystem.from_text("line", ["x"], text, parameters=parameters, **further)


@pytest.mark.parametrize("name", JUMPS)
def test_jumps_are_refused_with_the_term(name: str) -> None:
    """Those of rint by the definition, others by steps that do not locate them."""
    error = sc.SystemDefinitionError if "rint" in JUMPS[name] or "wrap" in JUMPS[name] else sc.MethodError
    with pytest.raises(error, match=r" of 'line' jumps where .* = 0: its term .*forces"):
        sc.compile_stepper(line(JUMPS[name]), "svi:1", time_transformation="1/(1 + x**2)")


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_functions_are_not(name: str) -> None:
    line(CONTINUOUS[name])


def test_forces_and_coefficients_of_space_may_jump() -> None:
    line("x_dot**2/2", forces={"x": "unit_step(x)"})
    string = "sum(i in N, (1 + unit_step(x[i] - 1/2))*u_dot[i]**2/2 - u[i]**2)"
    sc.LagrangianSystem.from_text("string", ["u[N]"], string, parameters={"x[N]": 1.0})


@pytest.mark.parametrize("text", ["y - positive_part(x)**2", "y - positive_part(t - 1)"])
def test_smooth_constraints_and_those_of_time_are_not(text: str) -> None:
    sc.LagrangianSystem.from_text("ramp", ["x", "y"], FALL, constraints=[text])
