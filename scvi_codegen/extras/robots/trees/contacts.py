"""Geoms of MJCF that may touch, and contacts of the spheres of links with planes of the world.

https://mujoco.readthedocs.io/en/stable/computation/index.html#selection and #parameters

A sphere of radius r at the point x of a link, above the plane through o with the unit normal n, has the gap n . (x - o)
- r. It slips with the velocity of the point of the link at x - r n: with the axes R of the link, in a direction e,

    w = e . d/dt (x + R s)  for the constant s = -r R^T n.

Directions in which it cannot slip, as those across the plane of a planar robot, are omitted.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from sympy import Matrix

from scvi_codegen.api.formulas import Intermediate, symbol
from scvi_codegen.extras.robots.trees.closures import at_reference, frames_in_common
from scvi_codegen.extras.robots.trees.document import Element
from scvi_codegen.extras.robots.trees.energies import exact_number
from scvi_codegen.extras.robots.trees.shapes import shape_of, size_of
from scvi_codegen.extras.robots.trees.tendons import rate_of
from scvi_codegen.extras.robots.trees.tree import Link, Pose, Vector, times
from scvi_codegen.systems.contact import Contact, Friction, contact

PARTS = {"capsule": "end", "box": "corner"}
"""Names of the spheres of geoms that have several."""


@dataclass(frozen=True, slots=True)
class Touch:
    """Sphere of a link and the plane z = 0 of a frame in the world.

    Attributes:
        name: of both, for messages.
        link, center, radius: of the sphere, in the frame of the link.
        plane: pose of the frame.
        friction: coefficient of sliding friction, or none.
    """

    name: str
    link: int
    center: Vector
    radius: float
    plane: Pose
    friction: float | None


class Geom(NamedTuple):
    """Shape of a body: its element, its link, and its pose in the frame of that."""

    element: Element
    link: int
    pose: Pose

    @property
    def shape(self) -> str:
        """Type of the geom."""
        return shape_of(self.element)

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
        if self.shape not in ("sphere", *PARTS) or self.element.has("mesh"):  # of a fitted size
            return []
        size = size_of(self.element, self.shape)
        if self.shape == "box":
            return [(np.array(signs) * size, 0.0) for signs in product((-1, 1), repeat=3)]
        ends = (0,) if self.shape == "sphere" else (-1, 1)
        return [(np.array([0.0, 0.0, end * size[-1]]), size[0]) for end in ends]


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
            at = body.pose.position + times(body.pose.rotation, center)
            world = at_reference(links, plane.link) @ plane.pose
            part = f"{PARTS[body.shape]} {number} of " if len(spheres) > 1 else ""
            yield Touch(f"{part}{body.title} on {plane.title}", body.link, at, radius, world, friction)


def contacts_of(links: Sequence[Link], touches: Iterable[Touch], law: Mapping[str, Any]) -> list[Contact | Friction]:
    """Return the contacts of spheres with planes that they may reach; ``law``: restitution and law of their impacts."""
    return [made for touch in touches for made in _contact(links, touch, law)]


def _contact(links: Sequence[Link], touch: Touch, law: Mapping[str, Any]) -> list[Contact | Friction]:
    ends = (touch.link, Pose(touch.center)), (-1, touch.plane)
    (position, axes), (origin, directions) = frames_in_common(links, ends)
    radius, normal = exact_number(touch.radius), directions[:, 2]
    gap = normal.dot(position - origin) - radius
    if gap.is_number and gap > 0:
        return []
    fixed = Matrix([symbol(f"{touch.name} {k}") for k in range(3)])
    arm = dict(zip(fixed, (-radius * axes.T * normal).applyfunc(Intermediate.named), strict=True))
    rates = (rate_of(links, directions[:, k].dot(position + axes * fixed)) for k in range(2) if touch.friction)
    slips = [rate.xreplace(arm) for rate in rates if rate != 0]
    slip = slips[0] if len(slips) == 1 else slips or None
    mu = exact_number(touch.friction or 0) if slips else None
    return [contact(gap, slip=slip, friction=mu, name=touch.name, **law)]
