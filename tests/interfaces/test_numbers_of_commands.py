"""Numbers in the JSON of ``derive``, ``methods``, ``systems`` and ``verify``, recomputed by other code."""

import re
from typing import Any

import numpy as np
import pytest
import sympy
from commands import json_of
from scipy.optimize import fsolve

import scvi_codegen as sc
from scvi_codegen.analysis.advice.tolerance_check import Known
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.interfaces.cli.running import final_state


@pytest.mark.tiers(0, 2)
@pytest.mark.parametrize(
    ("model", "method", "q", "p", "h"),
    [
        ("planar-pendulum", "svi:2", [0.75], [0.5], 0.375),
        ("kepler", "sc:2", [0.5, 0.25], [-0.25, 1.5], 0.0625),
        ("duffing", "scvi:3", [0.75], [-0.25], 0.25),
    ],
)
def test_printed_equations_have_the_compiled_step_as_solution(model, method, q, p, h):
    """SciPy solves the residuals of the JSON from its first guess; its end is that of the compiled step."""
    system, numbers = sc.problem(model).system, json_of("derive", model, "--method", method)
    velocity = sc.compile_stepper(system, method).velocity(q, p)
    known = {"h": h, "t_k": 0.0, **numbers["entries"]}
    known |= dict(zip(map(str, system.parameters), system.defaults, strict=True))
    for i, coordinate in enumerate(system.coordinates):
        known |= {f"{coordinate}_k": q[i], f"p_{coordinate}_k": p[i], f"{coordinate}_dot_k": velocity[i]}
    if system.dimension == 1:
        known |= {"q_k": q[0], "p_k": p[0], "q_dot_k": velocity[0]}
    symbols = {name: sympy.Symbol(name) for name in (*known, *numbers["unknowns"])}

    def value(text: str, unknowns: Any = ()) -> float:
        values = known | dict(zip(numbers["unknowns"], unknowns, strict=False))
        expression = sympy.sympify(text, locals=symbols)
        return float(expression.subs({symbols[name]: x for name, x in values.items()}))

    residuals = [sympy.sympify(each["residual"], locals=symbols) for each in numbers["equations"]]
    residuals = [each.subs({symbols[name]: x for name, x in known.items()}) for each in residuals]
    unknowns = [symbols[name] for name in numbers["unknowns"]]
    function = sympy.lambdify([unknowns], residuals)
    guess = [value(numbers["initial_guess"][name]) for name in numbers["unknowns"]]
    assert np.abs(function(guess)).max() > 1e-6  # the guess is not the solution
    solution = fsolve(function, guess, xtol=1e-12)
    run = sc.compile_stepper(system, method).integrate(q, p, h=h, steps=1)
    end = [value(text, solution) for name in ("q", "p") for text in numbers["end"][name]]
    assert end == pytest.approx([*run.q[-1], *run.p[-1]], abs=1e-11)


def test_systems_have_their_coordinates_and_parameters():
    entries = json_of("systems")["systems"]
    assert len(entries) > 10
    for entry in entries:
        system = sc.problem(entry["name"]).system
        assert entry["coordinates"] == [str(q) for q in system.coordinates]
        names = [str(name) for name in system.parameters]
        assert entry["parameters"] == dict(zip(names, system.defaults, strict=True))
        assert entry["description"]


@pytest.mark.rotated
def test_checks_of_verify_compare_what_they_measured_with_their_bounds():
    numbers = json_of("verify", "planar-pendulum", "--method", "svi:2")
    checks = {check["name"]: check for check in numbers["checks"] if check["bound"] is not None}
    assert numbers["passed"] is True
    assert len(checks) > 20
    order = checks.pop("order")
    assert 4.2 > order["measured"] > order["bound"]
    assert all(0 <= check["measured"] <= check["bound"] for check in checks.values())
    assert len({check["outcome"] for check in checks.values()}) == 1


def test_positions_and_momenta_are_printed_with_their_correct_digits():
    known = Known(q=np.array([1e-3, 1e-9]), p=np.array([1e-9, 1e-3]), tenfold=np.inf)
    interface = Interface(
        prefix="two", title="", system="", method="", coordinates=("x", "y"), parameters=(), defaults=()
    )
    lines = list(final_state(interface, np.array([1 / 3, 2 / 3]), np.array([1 / 7, 1 / 9]), known))
    digits = [[len(text) for text in re.findall(r"0\.(\d*[1-9])", line)] for line in lines[1:]]
    assert digits[0][0] == digits[1][1] < digits[0][1] == digits[1][0]
