"""Geoms of MJCF, and the contacts of pairs of them.

https://mujoco.readthedocs.io/en/stable/computation/index.html#selection and #parameters
"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from scvi_codegen.systems.multibody.trees.closures import at_reference
from scvi_codegen.systems.multibody.trees.contacts import Touch
from scvi_codegen.systems.multibody.trees.document import Element
from scvi_codegen.systems.multibody.trees.tree import Link, Pose, Vector

PARTS = {"capsule": "end", "box": "corner"}
"""Names of the spheres of geoms that have several."""


class Geom(NamedTuple):
    """Shape of a body: its element, its link, and its pose in the frame of that."""

    element: Element
    link: int
    pose: Pose

    @property
    def shape(self) -> str:
        """Type of the geom."""
        return self.element.text("type", "mesh" if self.element.has("mesh") else "sphere")

    @property
    def title(self) -> str:
        """Name for messages; of one without a name its line and its body."""
        _, line, around, _ = self.element.places[self.element.node]
        name = self.element.node.get("name")
        return f"geom '{name}'" if name else f"geom in line {line} of {around or 'the world'}"

    @property
    def types(self) -> tuple[int, int]:
        """``contype`` and ``conaffinity``."""
        return int(self.element.number("contype", 1)), int(self.element.number("conaffinity", 1))

    def spheres(self) -> list[tuple[Vector, float]]:
        """Return the spheres, corners with radius 0, of which the geom is the convex hull; none of other shapes."""
        size = self.element.vector("size", (0,), (1, 2, 3))
        if self.shape == "sphere":
            return [(np.zeros(3), size[0])]
        if self.shape == "box":
            return [(np.array(signs) * size, 0.0) for signs in product((-1, 1), repeat=3)]
        if self.shape != "capsule":
            return []
        half = np.array([0.0, 0.0, size[-1]])
        if self.element.has("fromto"):
            ends = self.element.vector("fromto", sizes=(6,))
            half[2] = np.linalg.norm(ends[3:] - ends[:3]) / 2
        return [(-half, size[0]), (half, size[0])]


class Pair(NamedTuple):
    """Two geoms that may touch, the number of their directions of friction, and its coefficient."""

    geoms: tuple[Geom, Geom]
    dimensions: int
    friction: float

    @classmethod
    def of(cls, first: Geom, second: Geom) -> "Pair":
        """Return the pair with the friction of the geom of the higher priority, or the larger values of both."""
        priority = [geom.element.number("priority", 0) for geom in (first, second)]
        leading = [geom.element for geom, its in zip((first, second), priority, strict=True) if its == max(priority)]
        dimensions = max(int(element.number("condim", 3)) for element in leading)
        friction = max(element.vector("friction", (1,), (1, 2, 3))[0] for element in leading)
        return cls((first, second), dimensions, float(friction))

    @classmethod
    def of_element(cls, pair: Element, first: Geom, second: Geom) -> "Pair":
        """Return the pair that an element defines."""
        friction = np.append(pair.vector("friction", (1, 1), range(1, 6)), 1)
        dimensions = int(pair.number("condim", 3))
        if friction[0] != friction[1] and dimensions > 1:
            pair.refuse(
                f"has two coefficients of sliding friction, {friction[0]:g} and {friction[1]:g}: write one twice"
            )
        return cls((first, second), dimensions, float(friction[0]))

    def touches(self, links: Sequence[Link]) -> Iterator[Touch]:
        """Yield the contacts of spheres with a plane, which is fixed to the world."""
        plane, body = sorted(self.geoms, key=lambda geom: geom.shape != "plane")
        friction = self.friction if self.dimensions > 1 else None
        spheres = body.spheres() if plane.shape == "plane" else []
        for number, (center, radius) in enumerate(spheres, start=1):
            at = body.pose.position + body.pose.rotation @ center
            world = at_reference(links, plane.link) @ plane.pose
            part = f"{PARTS[body.shape]} {number} of " if len(spheres) > 1 else ""
            yield Touch(f"{part}{body.title} on {plane.title}", body.link, at, radius, world, friction)
