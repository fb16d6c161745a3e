"""Contacts of the spheres of links with planes of the world.

A sphere of radius r at the point x of a link, above the plane through o with the unit normal n, has the gap n . (x - o)
- r. It slips with the velocity of the point of the link at x - r n: with the axes R of the link, in a direction e,

    w = e . d/dt (x + R s)  for the constant s = -r R^T n.

Directions in which it cannot slip, as those across the plane of a planar robot, are omitted.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sympy import Matrix

from scvi_codegen.systems.contact import ContactLike, contact
from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.multibody.trees.closures import frames_in_common
from scvi_codegen.systems.multibody.trees.energies import exact_number
from scvi_codegen.systems.multibody.trees.tendons import rate_of
from scvi_codegen.systems.multibody.trees.tree import Link, Pose, Vector


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


def contacts_of(links: Sequence[Link], touches: Iterable[Touch], law: Mapping[str, Any]) -> list[ContactLike]:
    """Return the contacts of spheres with planes that they may reach; ``law``: restitution and law of their impacts."""
    return [made for touch in touches for made in _contact(links, touch, law)]


def _contact(links: Sequence[Link], touch: Touch, law: Mapping[str, Any]) -> list[ContactLike]:
    ends = (touch.link, Pose(touch.center)), (-1, touch.plane)
    (position, axes), (origin, directions) = frames_in_common(links, ends)
    radius, normal = exact_number(touch.radius), directions[:, 2]
    gap = normal.dot(position - origin) - radius
    if gap.is_number and gap > 0:
        return []
    fixed = Matrix([symbol(f"{touch.name} {k}") for k in range(3)])
    arm = dict(zip(fixed, (-radius * axes.T * normal).applyfunc(intermediate), strict=True))
    rates = (rate_of(links, directions[:, k].dot(position + axes * fixed)) for k in range(2) if touch.friction)
    slips = [rate.xreplace(arm) for rate in rates if rate != 0]
    slip = slips[0] if len(slips) == 1 else slips or None
    mu = exact_number(touch.friction or 0) if slips else None
    return [contact(gap, slip=slip, friction=mu, name=touch.name, **law)]
