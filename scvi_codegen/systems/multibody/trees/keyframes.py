"""States of robots by name: the reference configuration at rest, and the keyframes of MJCF files."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any

from scvi_codegen.systems.multibody.trees.document import NAMED
from scvi_codegen.systems.multibody.trees.tree import SINGLE, Link


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
            q[f"R_{link.name}"] = [*islice(places, 4)] or (
                [*map(list, link.rotation)] if names else [1.0, 0.0, 0.0, 0.0]
            )
            velocity[f"omega_{link.name}"] = [*islice(rates, 3)] or [0.0, 0.0, 0.0]
    controls = {"inputs": {name: numbers.get(name, 0.0) for name in inputs}} if inputs else {}
    return {"q": q, "velocity": velocity, **controls}


def outside_limits(links: Sequence[Link], states: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the states, and their joints, that are outside the limits of joints; no text without any."""
    joints = (link.joint for link in links)
    ranges = [(joint.label, joint.name, *joint.limits) for joint in joints if joint.limits and joint.kind in SINGLE]
    beyond = [
        f"'{state}' with joint '{label}' at {q[name]:.9g}, of the range {low:g} to {high:g}"
        for state, q in ((state, values["q"]) for state, values in states.items())
        for label, name, low, high in ranges
        if name in q and not low <= q[name] <= high  # those that follow others are not in q
    ]
    return ", ".join(beyond[:NAMED]) + (f" and {len(beyond) - NAMED} more" if beyond[NAMED:] else "")
