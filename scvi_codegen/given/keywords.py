"""Suggestions for keyword arguments that a function does not have."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from scvi_codegen.errors import closest
from scvi_codegen.given.words import meanings, same_here

__all__ = ["keyword_meant"]

ELSEWHERE: Final = {
    "inputs": "data belong to .integrate(..., inputs={'u': (t, values)}) and .integrate_ensemble, values that change "
    "during a run to run.set_inputs(u=...)",
    "t_eval": "keep all states, and ask the run for those at times: run.at(times)",
    "events": "they are of .integrate(..., events=...) or of compile_stepper(..., events=...)",
    "save_every": "it is of run.record(n, save_every=...), and of .integrate",
    "steps": "their number goes to run.advance(n) or run.record(n)",
    "h": "steps of h are taken by a stepper: compile_stepper(...).integrate(q, p, h=..., steps=...)",
    "parameters": "their values go to the run, .integrate(..., parameters={...}), their names to the system",
    "velocity": "it takes momenta, p = stepper.momentum(q, velocity)",
    "t_end": "adaptive steps belong to .integrate(..., t_end=...); a fixed number of steps takes steps of h: "
    "h = (t_end - t) / steps",
    "degree": "it goes with the name of the method, 'svi:8', or with its class, SVI(8)",
    "solver": "it is chosen where a stepper is compiled: compile_stepper(system, method, solver=...)",
    "method": "the method is said where it is compiled: compile_stepper(system, method)",
}
"""Explanations by keyword, for functions that do not have it."""


def keyword_meant(name: str, known: Collection[str]) -> str:
    """Return ``"; did you mean 'h'?"``, or ``": "`` and an explanation, or the list of keywords.

    Args:
        name: a keyword that the function does not have.
        known: keywords that it has.
    """
    if here := same_here(name, known):
        return here
    for word in (name, *meanings(name)):
        if word in ELSEWHERE and word not in known:
            return f": {ELSEWHERE[word]}"
    hint = closest(name, known)
    return f": it takes {', '.join(known)}" if hint == "." else hint
