"""States of robots by name: the reference configuration at rest, and the keyframes of MJCF files."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np

from scvi_codegen.api.formulas import Rotation, Tape, mp, symbol
from scvi_codegen.extras.robots.trees.document import NAMED
from scvi_codegen.extras.robots.trees.tree import rotation_by
from scvi_codegen.systems.contact import Contact

SMALL = 1e-9
"""Size of negative gaps with which runs begin."""


IDENTITY = [1.0, 0.0, 0.0, 0.0]
"""Quaternion of no rotation, and that by which MuJoCo replaces 0."""


def keyframe(links: Iterable[Any], inputs: Sequence[str], numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of ``integrate`` for the ``qpos``, ``qvel`` and controls of a file; by default those of rest."""
    places, rates = (iter(numbers.get(key, ())) for key in ("qpos", "qvel"))
    q, velocity = dict[str, Any](), dict[str, Any]()
    for link in (link for link in links if link.follows is None):
        names = {"free": [f"{axis}_{link.name}" for axis in "xyz"], "ball": []}.get(link.kind, [link.name])
        q |= {
            name: next(places, x) for name, x in zip(names, link.position if names[1:] else [link.zero], strict=False)
        }
        velocity |= {name: next(rates, 0.0) for name in names}
        if len(names) != 1:
            q[f"R_{link.name}"] = rotation_in(places, link)
            velocity[f"omega_{link.name}"] = [*islice(rates, 3)] or [0.0, 0.0, 0.0]
    controls = {"inputs": {name: numbers.get(name, 0.0) for name in inputs}} if inputs else {}
    return {"q": q, "velocity": velocity, **controls}


def rotation_in(places: Iterator[float], link: Any) -> list[Any]:
    """Return the quaternion among further numbers, of which 0 is no rotation, or the reference without any."""
    turn = [*islice(places, 4)]
    if turn:
        return turn if any(turn) else IDENTITY
    return [*map(list, link.rotation)] if link.kind == "free" else IDENTITY


def outside_limits(contacts: Iterable[Any], states: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the states and the limits of joints and tendons whose gaps are negative there; no text without any."""
    limits = [item for item in contacts if isinstance(item, Contact) and "limit of " in item.name]
    gaps: list[Any] = [item.gap for item in limits]
    variables = sorted(set().union(*(gap.free_symbols for gap in gaps)), key=str)
    tape, beyond = Tape(gaps, variables), list[str]()
    for state, q in ((state, values["q"]) for state, values in states.items()):
        numbers = {symbol(name): x for name, x in q.items()}
        for name, x in q.items():
            if np.ndim(x):
                turn = np.array(x) if np.ndim(x) > 1 else rotation_by(np.array(x))
                numbers |= zip(Rotation(name, "").entries, turn.flat, strict=True)
        values = map(float, tape([mp.mpf(float(numbers[x])) for x in variables]))
        outside = [(item, gap) for item, gap in zip(limits, values, strict=True) if gap < -SMALL]
        beyond += [f"'{state}' with the {item.name} at {gap:.6g}" for item, gap in outside]
    return ", ".join(beyond[:NAMED]) + (f" and {len(beyond) - NAMED} more" if beyond[NAMED:] else "")
