"""Suggestions for unknown keys of model files: synonyms of other programs, and keys of other sections."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from scvi_codegen.errors import closest
from scvi_codegen.validation import likely_names, synonym_hint

KEYS: Final = {
    "run": "step span steps tolerance save_every controller",
    "initial": "q q_dot p t",
    "method": "method degree quadrature",
    "system": "lagrangian hamiltonian damping dissipation constraints time_transformation inputs",
}
EVENTS: Final = "events are supported in Python only, as stepper.integrate(..., events=[...])"
LOCATIONS: Final = {
    **{key: f"'{key}' belongs in [{section}]" for section, keys in KEYS.items() for key in keys.split()},
    **{section: f"there is a section [{section}]" for section in ("parameters", "forces", "initial", "run")},
}
"""Location of each key in a model file."""


def key_hint(key: str, names: Iterable[str]) -> str:
    """Return ``"; did you mean 'step'?"`` or ``"; it belongs in [run], as 'step'."``, or a full stop.

    Args:
        key: the unknown key.
        names: known keys of its section.
    """
    known = list(names)
    if key in ("event", "events"):
        return f"; {EVENTS}."
    if here := synonym_hint(key, known):
        return here
    if (hint := closest(key, known)) != ".":
        return hint
    locations = [LOCATIONS[name] for name in ([key] if key in LOCATIONS else likely_names(key)) if name in LOCATIONS]
    return f"; {locations[0]}." if locations else "."
