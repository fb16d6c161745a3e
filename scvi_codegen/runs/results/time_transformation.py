"""Time transformation dt = g dtau: partial steps that end at a time t, and dense output.

A run in transformed time takes steps of tau and integrates t with the method's own quadrature. Arguments and results
refer to t: velocities are dq/dt and energies are those of the original system.
"""

from fractions import Fraction

import numpy as np

from scvi_codegen.codegen.native.options import step_failure
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.times import number_until
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import block_of, fraction_of
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed

MOST_CORRECTIONS, MET, SHORT = 5, Fraction(1, 2**104), Fraction(1, 2**40)
"""Largest number of corrections of a partial step; difference of its end from the time, relative to its duration; part
of a step in which the rate dt/dtau is nearly constant."""


def part_of_step(
    along: SavedStates | Memory, t: float, h: float, end: float | Fraction, q: Array, p: Array
) -> tuple[Array, Array, float]:
    """Return the state at the time ``end`` within a step of h from (q, p) at t, and the fraction of the step taken.

    ``along``: the run or its states, with the parameters and options of the step.
    """
    if along.stepper.interface.words > 1:  # systems in transformed time are autonomous
        return _part_of_two_words(along, h, fraction_of(end) - fraction_of(t), q, p)
    return _located(along, t, h, float(end), q, p)


def _located(
    along: SavedStates | Memory, t: float, h: float, end: float, q: Array, p: Array
) -> tuple[Array, Array, float]:
    """Return the result of :func:`part_of_step`, to the precision of a double."""
    binding = along.stepper.binding
    start_q, start_p, q1, p1 = (np.array(block_of(x), dtype=float) for x in (q, p, q, p))
    part, report = binding.numbers("double *"), binding.new("report *")
    status = binding.function("part_of_step")(
        t,
        h,
        end,
        *map(binding.pointer, (start_q, start_p, block_of(along.parameters))),
        binding.options(along.options),
        *map(binding.pointer, (q1, p1)),
        part,
        report,
        binding.workspace(),
    )
    if status:
        raise step_failure(status, report, step=0, h=h)
    return q1, p1, float(part[0])


def _part_of_two_words(
    along: SavedStates | Memory, h: float, span: Fraction, q: Array, p: Array
) -> tuple[Array, Array, float]:
    """Return the result of :func:`part_of_step` after a time in double-double arithmetic.

    Newton's method: the step size s in tau with t(s) = span is corrected by (span - t(s)) / (dt/dtau).
    """
    stepper, parameters = along.stepper, along.parameters
    run = Memory.started(stepper, q, p, plan=Fixed(h), parameters=parameters, options=along.options)
    before, whole = run.snapshot, Fraction(h)
    size = span / Fraction(float(stepper.rates(q, p, parameters)[0]))
    if abs(size) > SHORT * abs(whole):
        size = whole * Fraction(_located(along, 0.0, h, float(span), q, p)[2])
    for _ in range(MOST_CORRECTIONS):
        run.rollback(before)
        run._set_step(size)
        run.advance(1)
        miss = span - run._exact_time
        if abs(miss) <= MET * abs(span):
            break
        size += miss / Fraction(float(stepper.rates(run.q, run.p, run.parameters)[0]))
    return run.q, run.p, float(size / whole)


def states_in_transformed_time(states: SavedStates, times: Array) -> tuple[Array, Array, Array]:
    """Return (n, m) positions and momenta, and (n,) tau, at (n,) times within the range of the saved states."""
    assert states.tau is not None
    left = number_until(states.t, times, states.forward) - 1
    q, p, tau = states.q[left], states.p[left], np.empty(len(times))
    for saved in np.unique(left):
        t_near, q_near, p_near, h = _steps_from(states, int(saved))
        for k in np.flatnonzero(left == saved):
            j = int(number_until(t_near, times[k], states.forward)) - 1
            q[k], p[k], part = q_near[j], p_near[j], 0.0
            if t_near[j] - times[k] != 0.0:
                q[k], p[k], part = part_of_step(states, t_near[j], h, times[k], q[k], p[k])
            tau[k] = states.tau[saved] + (j + part) * h
    return q, p, tau


def _steps_from(states: SavedStates, saved: int) -> tuple[Array, Array, Array, float]:
    """Return the states of all steps from a saved state up to the next one, and the size of these steps."""
    assert states.tau is not None
    t, q, p = (array[saved : saved + 1] for array in (states.t, states.q, states.p))
    h = float(np.nan_to_num(states.step_sizes[saved], nan=states.h))
    count = round((states.tau[saved + 1] - states.tau[saved]) / h) if saved + 1 < len(states) else 1
    if count <= 1:
        return t, q, p, h
    further = states._restarted(saved, h)._fill(count - 1)
    t, q, p = (np.concatenate(columns) for columns in zip((t, q, p), further, strict=True))
    return t, q, p, h
