"""What a keyword that a function does not have may have been meant to say."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from scvi_codegen.errors import closest

__all__ = ["keyword_meant"]

WORDS: Final = {
    "h": "dt step delta_t timestep time_step stepsize step_size max_step first_step",
    "steps": "n N nsteps n_steps num_steps nt",
    "t_end": "T tf t_final t_max tmax tend t_span t_bound span duration",
    "t": "t0 time start_time t_start",
    "tolerance": "tol rtol atol eps epsilon accuracy error",
    "every": "save_every stride output_every skip",
    "t_eval": "times saveat t_out",
    "q": "x q0 x0 y0 position positions state coords",
    "p": "p0 momentum momenta",
    "velocity": "v v0 qdot q_dot dq velocities",
    "parameters": "params args constants",
    "y0": "q q0 x0 state",
    "options": "solver_options",
    "degree": "stages order",
    "method": "integrator scheme",
    "coordinates": "q variables coords",
    "lagrangian": "L",
    "hamiltonian": "H",
    "forces": "force",
    "constraints": "constraint",
    "inputs": "input control controls u",
}
"""By the keyword, what it is called elsewhere."""
ELSEWHERE: Final = {
    "inputs": "a system with inputs runs by .drive(..., inputs={'u': (t, values)}), many at once by "
    ".drive_ensemble, and between samples by run.hold(u=...)",
    "t_eval": "keep all states, and ask the run for those at times: run.at(times)",
    "events": "they are of .integrate(..., events=...) or of compile_stepper(..., events=...)",
    "every": "it is of run.record(n, every=...), and of .integrate",
    "steps": "their number goes to run.advance(n) or run.record(n)",
    "h": "steps of h are taken by a stepper: compile_stepper(...).integrate(q, p, h=..., steps=...)",
    "parameters": "their values go to the run, .integrate(..., parameters={...}), their names to the system",
    "velocity": "it takes momenta, p = stepper.momentum(q, velocity)",
    "degree": "it goes with the name of the method, 'svi:8', or with its class, SVI(8)",
    "method": "the method is said where it is compiled: compile_stepper(system, method)",
}
"""By the keyword, where it is said, for functions that do not have it."""


def keyword_meant(name: str, known: Collection[str]) -> str:
    """``"; did you mean 'h'?"``, or ``": "`` and where it is said, or what it takes.

    Args:
        name: a keyword that the function does not have.
        known: those that it has.
    """
    meant = [word for word, others in WORDS.items() if name in others.split()]
    for word in meant:
        if word in known:
            return f"; did you mean '{word}'?"
    for word in (name, *meant):
        if word in ELSEWHERE and word not in known:
            return f": {ELSEWHERE[word]}"
    hint = closest(name, known)
    return f": it takes {', '.join(known)}" if hint == "." else hint
