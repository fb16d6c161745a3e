"""Generated folders of systems with inputs: C goes from breakpoint to breakpoint as Python does, to the bit."""

import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from notation import lagrange
from numpy.testing import assert_allclose

from scvi_codegen import SVI, Model, compile_stepper, load_package
from scvi_codegen.interfaces.models.packages.package import generate_package
from scvi_codegen.runs.driver.segments import checked_inputs
from scvi_codegen.systems.event import Event, impact

KNOTS, VALUES = (0.0, 0.37, 0.9, 1.41, 2.05, 2.6), (0.0, 1.2, -0.7, 0.4, 1.9, -1.0)
STRICT = "-O1 -std=c99 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wno-unused-parameter -Werror -ffp-contract=off"


@pytest.fixture(scope="module")
def model():
    """A pushed pendulum whose hook is shaken."""
    system = lagrange(
        "pushed pendulum", "q", "(1 + w)*q_dot**2/2 + cos(q)", c=0.2, forces={"q": "u - c*q_dot"}, inputs="w u"
    )
    inputs = {"u": (KNOTS, VALUES, "cubic"), "w": ((-1.0, 0.5, 1.41, 3.0), (0.0, 0.3, 0.1, 0.2))}
    return Model(system=system, method=SVI(4), q=(0.3,), velocity=(0.5,), h=0.03, span=2.3, inputs=inputs)


def states_printed(folder, flags=STRICT):
    """(n, 4) t, q, p and changes of the energy that the example prints."""
    subprocess.run(["make", f"CFLAGS={flags}"], cwd=folder, check=True, capture_output=True)
    command = [str(folder / f"{folder.name}_main")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return np.loadtxt(printed.splitlines(), comments="#"), printed


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("h", [0.03, None])
@pytest.mark.parametrize("restitution", [0.8, None])
def test_events_of_a_system_with_inputs(model, h, restitution, tmp_path):
    """Impacts and crossings, where inputs end steps, are those of Python."""
    event = Event("q_dot") if restitution is None else impact("2/5 - q", restitution)
    model = replace(model, h=h, events=(event,))
    folder = generate_package(model, tmp_path / "pushed")
    states, printed = states_printed(folder)
    plan = {"t_end": 2.3} | ({"h": h} if h else {})
    run = load_package(folder).integrate(model.q, velocity=model.velocity, inputs=dict(model.inputs), **plan)
    found = [float(t) for t in re.findall(r"# event .* at t = (\S+)", printed)]
    assert len(found) == len(run.events[0]) > 0
    assert_allclose(found, run.events[0].t, rtol=0, atol=1e-11)
    assert_allclose(states[-1, :3], [2.3, run.q[-1, 0], run.p[-1, 0]], rtol=0, atol=1e-11)


@pytest.mark.second
def test_step_longer_than_the_segment_is_shortened(model):
    stepper = compile_stepper(model.system, model.method)
    given = {"u": ([0.0, 0.4, 1.0], [0.1, 0.2, 0.3]), "w": ([0.0, 1.0], [0.0, 0.0])}
    inputs = checked_inputs(stepper.interface, given)
    run = stepper.start([0.3], [0.1], h=1e11)
    table, saved = _tables(stepper, inputs)
    values = np.array(stepper.defaults)
    taken = []
    while stepper.binding.function("next_steps")(run._memory, 0.9, 1e11, table, stepper.binding.pointer(values)) == 1:
        taken.append(run.h)
        run.update(parameters=values)
        run.advance(1)
    assert_allclose(taken, [0.4, 0.5])
    assert run.t == 0.9
    assert len(saved) == 4


def _tables(stepper, inputs):
    """Return the data as C structs, and the objects that must stay alive while C uses them."""
    table, saved = stepper.binding.new(f"input[{len(inputs)}]"), []
    for entry, name in zip(table, stepper.interface.inputs, strict=True):
        data = inputs[name]
        saved += [np.ascontiguousarray(data.breakpoints), np.ascontiguousarray(data.pieces[:, :4])]
        entry.t, entry.coefficients = map(stepper.binding.pointer, saved[-2:])
        entry.pieces, entry.piece = len(data.pieces), 0
    return table, saved


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("precision", ["double", "single"])
def test_inputs_on_a_microcontroller(model, precision, tmp_path):
    folder = generate_package(model, tmp_path / "pushed", embedded=precision)
    states, _ = states_printed(folder, STRICT.replace("-Wconversion", ""))
    run = compile_stepper(model.system, model.method).integrate(
        model.q, velocity=model.velocity, inputs=dict(model.inputs), h=0.03, t_end=2.3
    )
    size = 1e-13 if precision == "double" else 3e-6
    assert_allclose(states[-1, :3], [2.3, run.q[-1, 0], run.p[-1, 0]], rtol=0, atol=size)
    assert abs(len(states) - 20) < 6
