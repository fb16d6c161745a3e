"""Tables whose range a motion leaves (``outside="refuse"``), named in the message of the failed step."""

from contextlib import suppress

import numpy as np

from scvi_codegen.common.errors import ScviCodegenError, StepFailedError
from scvi_codegen.runs.states.validation import evaluation
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.formulas.symbols import DOT

NEAR = 0.1
"""Distance from an end, relative to the range, within which an argument at the last state is named."""


def end_run(failure: StepFailedError, run: Memory, trajectory: Trajectory) -> None:
    """Give a failure the states before it, and once the argument of a table that leaves its range."""
    if failure.trajectory is None:
        failure.args = (f"{failure}{_left_range(run)}",)
    failure.trajectory = trajectory


def _left_range(run: Memory) -> str:
    stepper, t, q, p = run.stepper, run.t, np.array(run.q), np.array(run.p)
    interface = stepper.interface
    if not interface.ranges:
        return ""
    values = {"t": float(t), **dict(zip(interface.parameters, run.parameters, strict=True))}
    values |= {**dict(zip(interface.momenta, p, strict=False)), **dict(zip(interface.coordinates, q, strict=False))}
    with suppress(ScviCodegenError):
        v = stepper.velocity(q, p, t, run.parameters)
        values |= {name + DOT: rate for name, rate in zip(interface.coordinates, v, strict=True)}
    for call, argument, *ends in interface.ranges:
        with suppress(ScviCodegenError, ArithmeticError, KeyError):
            evaluate, names = evaluation(argument)
            u, (low, high) = evaluate([float(values[name]) for name in names]), map(float, ends)
            if not low + NEAR * (high - low) < u < high - NEAR * (high - low):
                return (
                    f". The table {call} is given for {low:g} <= {argument} <= {high:g}; before this step {argument} = "
                    f'{u:.6g}: extend it, or give it outside="constant" or "linear"'
                )
    return ""
