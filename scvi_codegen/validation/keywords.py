"""Suggestions for keyword arguments that a function does not have."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from scvi_codegen.errors import closest
from scvi_codegen.validation.synonyms import likely_names, synonym_hint

EXPLANATIONS: Final = {
    "inputs": "pass them to .integrate(..., inputs={'u': (t, values)}) or .integrate_ensemble, and values that change "
    "during a run to run.set_inputs(u=...)",
    "t_eval": "save all states, and interpolate the run: run.at(times)",
    "events": "pass them to .integrate(..., events=...) or compile_stepper(..., events=...)",
    "threads": "threads share the steps of arrays whose sizes are known at run time only, coordinates=['q[N]']; others "
    "are too short to be shared",
    "observe": "it reduces states of arrays whose sizes are known at run time only, coordinates=['q[N]']; here save "
    "fewer states by save_every",
    "tables": "with sizes, tables are passed when compiling: compile_stepper(system, method, sizes=..., tables=...)",
    "save_every": "pass it to run.record(n, save_every=...) or .integrate",
    "steps": "pass the number to run.advance(n) or run.record(n)",
    "h": "pass it to a stepper: compile_stepper(...).integrate(q, p, h=..., steps=...)",
    "parameters": "pass their values to the run, .integrate(..., parameters={...}), and their names to the system",
    "velocity": "use momenta, p = stepper.momentum(q, velocity)",
    "t_end": "for adaptive steps use .integrate(..., t_end=...); for a fixed number of steps give h = (t_end "
    "- t) / steps",
    "degree": "include it in the method, 'svi:8' or SVI(8)",
    "solver": "pass it when compiling: compile_stepper(system, method, solver=...)",
    "method": "pass it when compiling: compile_stepper(system, method)",
}
"""Explanations by keyword, for functions that do not have it."""


def keyword_hint(name: str, known: Collection[str]) -> str:
    """Return ``"; did you mean 'h'?"``, or ``": "`` and an explanation, or the list of keywords.

    Args:
        name: a keyword that the function does not have.
        known: keywords that it has.
    """
    if here := synonym_hint(name, known):
        return here
    for word in (name, *likely_names(name)):
        if word in EXPLANATIONS and word not in known:
            return f": {EXPLANATIONS[word]}"
    hint = closest(name, known)
    return f": it takes {', '.join(known)}" if hint == "." else hint
