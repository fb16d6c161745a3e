"""What a key of a model file may have been meant to say: words of other programs, and keys of other sections."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from scvi_codegen.errors import closest

__all__ = ["meant_by"]

WORDS: Final = {
    "step": "h dt delta_t timestep time_step stepsize step_size",
    "span": "T t_end t_span t_max tmax tend t_final tf duration length time",
    "steps": "n nsteps n_steps num_steps nt",
    "tolerance": "tol rtol atol eps epsilon accuracy",
    "every": "save_every stride output_every skip",
    "q": "x q0 x0 position positions",
    "q_dot": "v velocity velocities qdot dq v0",
    "p": "p0 momentum momenta",
    "t": "t0 time start",
    "lagrangian": "l",
    "hamiltonian": "h",
    "coordinates": "q variables coords x positions",
    "momenta": "p",
    "degree": "n s order stages degrees",
    "quadrature": "points k",
    "method": "solver integrator scheme name type kind",
    "parameters": "params param constants",
    "forces": "force",
    "initial": "init start state y0 initial_conditions",
    "run": "integrate integration simulation settings solve",
    "system": "model problem",
}
"""By the key, what it is called elsewhere."""
KEYS: Final = {
    "run": "step span steps tolerance every controller",
    "initial": "q q_dot p t",
    "method": "method degree quadrature",
    "system": "lagrangian hamiltonian damping dissipation constraints monitor inputs",
}
PLACES: Final = {
    **{key: f"'{key}' belongs in [{section}]" for section, keys in KEYS.items() for key in keys.split()},
    **{section: f"there is a section [{section}]" for section in ("parameters", "forces", "initial", "run")},
}
"""By the key, where it is said."""


def meant_by(key: str, names: Iterable[str]) -> str:
    """``"; did you mean 'step'?"`` or ``"; it belongs in [run], as 'step'."``, or a full stop.

    Args:
        key: one that is not known.
        names: those known in its place.
    """
    known = list(names)
    meant = [name for name, words in WORDS.items() if {key, key.lower()} & {*words.split()}]
    if here := [name for name in meant if name in known]:
        return f"; did you mean '{here[0]}'?"
    if (hint := closest(key, known)) != ".":
        return hint
    places = [PLACES[name] for name in ([key] if key in PLACES else meant) if name in PLACES]
    return f"; {places[0]}." if places else "."
