"""States of robots by name: the reference configuration at rest, and the keyframes of MJCF files."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any


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
