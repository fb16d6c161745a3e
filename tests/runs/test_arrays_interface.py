"""C interface of arrays whose sizes are known at run time: that of named coordinates, and runs bound to sizes."""

import inspect

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.runs.array_stepper import StepperOfRunTimeSizes

SYSTEMS = {
    "ring": {
        "coordinates": ["q[N]"],
        "lagrangian": "sum(i in N, m[i]*q_dot[i]**2/2) - c*sum(i in N periodic, (q[i+1] - q[i])**2/2)",
        "parameters": {"c": 0.5, "m[N]": 1.0},
    },
    "masses that depend on positions": {
        "coordinates": ["q[N]"],
        "lagrangian": "sum(i in N, (1 + q[i]**2)*q_dot[i]**2/2) - c*sum(i in N periodic, (q[i+1] - q[i])**2/2)",
        "parameters": {"c": 0.5},
    },
    "plane": {
        "coordinates": ["r[N, 2]"],
        "lagrangian": "sum(i in N, sum(a in 2, r_dot[i, a]**2)/2) - c*sum(i in N, j in N, sum(a in 2, (r[i, a] "
        "- r[j, a])**2))",
        "parameters": {"c": 0.5},
    },
}


@pytest.fixture(scope="module", params=SYSTEMS)
def steppers(request):
    """The integrator of any size and that of 3 elements, their states and parameters."""
    system = sc.LagrangianSystem.from_text(name="test", **SYSTEMS[request.param])
    any_size = sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS)
    known = sc.compile_stepper(system, "svi:2", sizes={"N": 3}, flags=QUICK_FLAGS)
    states = np.random.default_rng(0).standard_normal((2, 4, known.dimension))
    shape = (3, 2) if request.param == "plane" else (3,)
    parameters = {"c": 0.7} | ({"m": np.array([1.0, 2.0, 3.0])} if request.param == "ring" else {})
    return any_size, known, states.reshape(2, 4, *shape), parameters


@pytest.mark.rotated
def test_functions_of_states_equal_those_of_known_sizes(steppers) -> None:
    """Of states that are not adjacent in memory, all in one call."""
    any_size, known, (q, p), parameters = steppers
    array = any_size.interface.coordinates[0]
    for function in ("energy", "momentum", "velocity"):
        ours, theirs = (
            np.asarray(getattr(each, function)({array: q}, {array: p}, parameters=parameters))
            for each in (any_size, known)
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-13)
    if any_size.momentum_map_names:
        flat = p.reshape(4, -1)
        bound, states = any_size.bind({array: q}, parameters)
        values, sizes = bound._momentum_maps_and_sizes(states, flat, 0.0, parameters)
        assert (np.abs(values) <= sizes).all()
        if "momentum of q" in any_size.momentum_map_names:
            assert values[:, any_size.momentum_map_names.index("momentum of q")] == pytest.approx(flat.sum(axis=1))


def test_methods_of_states_bind_the_sizes_of_their_arrays():
    """A new method of steppers whose first argument is a position needs a line in the class of run-time sizes."""
    methods = {name: method for name, method in inspect.getmembers(sc.Stepper, inspect.isfunction) if name[0] != "_"}
    positions = {"q", "q0", "q_previous"}
    of_states = {name for name, each in methods.items() if positions & set([*inspect.signature(each).parameters][1:2])}
    assert len(of_states) > 20
    assert {name for name in of_states if getattr(StepperOfRunTimeSizes, name) is methods[name]} == set()
