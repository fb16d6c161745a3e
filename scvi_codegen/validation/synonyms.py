"""Synonyms of function arguments and of keys of model files in this and other programs."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Final

SYNONYMS: Final = {
    "h step": "dt delta_t timestep time_step stepsize step_size max_step first_step",
    "steps": "n N nsteps n_steps num_steps nt",
    "t": "t0 time start_time t_start start",
    "t_end span": "T tf t_final t_max tmax tend t_span t_bound duration length time",
    "tolerance": "tol rtol atol eps epsilon accuracy error",
    "save_every": "every stride output_every skip",
    "t_eval": "times saveat t_out",
    "q y0": "x q0 x0 position positions state coords",
    "p": "p0 momentum momenta",
    "velocity q_dot": "v v0 qdot dq velocities",
    "parameters": "params param args constants",
    "options": "solver_options",
    "degree": "n s stages order degrees",
    "quadrature": "points k",
    "method": "solver integrator scheme name type kind",
    "coordinates": "q variables coords x positions",
    "momenta": "p",
    "lagrangian": "L l",
    "hamiltonian": "H h",
    "forces": "force",
    "constraints": "constraint",
    "inputs": "input control controls u",
    "initial": "init start state y0 initial_conditions",
    "run": "integrate integration simulation settings solve",
    "system": "model problem",
}
"""Synonyms in other programs, by the names used here for arguments and keys."""


def likely_names(word: str) -> Iterator[str]:
    """Yield the names used here for a word, the likeliest first."""
    for here, elsewhere in SYNONYMS.items():
        if {word, word.lower()} & {*here.split(), *elsewhere.split()}:
            yield from here.split()


def synonym_hint(word: str, known: Collection[str]) -> str:
    """Return ``"; did you mean 'h'?"`` if a known word has the same meaning, else an empty string."""
    return next((f"; did you mean '{meant}'?" for meant in likely_names(word) if meant in known), "")
