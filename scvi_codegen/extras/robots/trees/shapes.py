"""Poses of elements of MJCF in their parents, and sizes and inertias of geoms.

https://mujoco.readthedocs.io/en/stable/modeling.html#frame-orientations
"""

import math
import re
from collections.abc import Callable
from xml.etree.ElementTree import Element as Node

import numpy as np

from scvi_codegen.extras.robots.trees.document import Element
from scvi_codegen.extras.robots.trees.meshes import inertia_of
from scvi_codegen.extras.robots.trees.schema import TURN
from scvi_codegen.extras.robots.trees.tree import Inertia, Pose, Vector, about, rotation_by, times

ORIENTATIONS = TURN.split()
AXES = dict(zip("xyz", np.eye(3), strict=True))


def pose_of(element: Element) -> Pose:
    """Return the pose of an element in its parent, by position and orientation or by ``fromto``."""
    if not element.has("fromto"):
        return Pose(element.vector("pos", (0, 0, 0)), rotation_of(element))
    if element.vector("pos", (0, 0, 0)).any():
        element.refuse("has pos and fromto: one is needed")
    ends = element.vector("fromto", sizes=(6,))
    line = ends[:3] - ends[3:]
    length = math.hypot(*line)
    if length == 0:
        element.refuse("has fromto, which needs two different points")
    return Pose((ends[:3] + ends[3:]) / 2, _shortest_turn(line / length))


def rotation_of(element: Element) -> Vector:
    """Return the rotation matrix of the one attribute of orientation that an element has."""
    present = [attribute for attribute in ORIENTATIONS if attribute in element.node.attrib]
    if len(present) > 1:
        element.refuse(f"has {' and '.join(present)}: one orientation is needed")
    kind = present[0] if present else ""
    if kind == "quat":
        return of_quaternion(element, element.vector("quat", sizes=(4,)))
    if kind == "axisangle":
        *axis, angle = element.vector("axisangle", sizes=(4,))
        length = math.hypot(*axis)
        if length == 0:
            element.refuse("has an axis of length 0")
        return about(np.array(axis) / length, angle * unit_of_angles(element))
    if kind == "euler":
        rotation = np.eye(3)
        sequence = element.settings.text("eulerseq", "xyz")
        if not re.fullmatch("[xyzXYZ]{3}", sequence):
            element.refuse(f"has euler, and eulerseq='{sequence}' is not three of the letters xyzXYZ")
        for letter, angle in zip(sequence, element.vector("euler"), strict=True):
            turned = about(AXES[letter.lower()], angle * unit_of_angles(element))
            rotation = times(rotation, turned) if letter.islower() else times(turned, rotation)
        return rotation
    if kind == "xyaxes":
        axes = element.vector("xyaxes", sizes=(6,))
        z = np.cross(axes[:3], axes[3:])
        if not z.any():
            element.refuse(f"has xyaxes='{element.text('xyaxes')}', which must be two different directions")
        x, z = axes[:3] / math.hypot(*axes[:3]), z / math.hypot(*z)
        return np.column_stack([x, np.cross(z, x), z])
    return _shortest_turn(element.unit("zaxis")) if kind else np.eye(3)


def unit_of_angles(element: Element) -> float:
    """Return the radians of a unit of angles."""
    return np.pi / 180 if element.settings.choice("angle", "degree", "radian") == "degree" else 1.0


def of_quaternion(element: Element, q: Vector) -> Vector:
    """Return the rotation matrix of a quaternion of an element."""
    if not q.any():
        element.refuse("has a quaternion of length 0")
    return rotation_by(q)


def _shortest_turn(axis: Vector) -> Vector:
    """Return the shortest rotation that turns the z axis into a unit vector."""
    across = np.cross([0.0, 0.0, 1.0], axis)
    length = math.hypot(*across)
    if length < 1e-12:
        return np.diag([1.0, np.sign(axis[2]), np.sign(axis[2])])
    return about(across / length, float(np.arctan2(length, axis[2])))


def _solid(size: Vector, volume: float, share: float) -> tuple[float, Vector]:
    return volume * float(np.prod(size)), (np.sum(size**2) - size**2) / share


def _cylinder(size: Vector) -> tuple[float, Vector]:
    r, half = size
    across = r**2 / 4 + half**2 / 3
    return 2 * np.pi * r**2 * half, np.array([across, across, r**2 / 2])


def _capsule(size: Vector) -> tuple[float, Vector]:
    """Return those of a cylinder with two half spheres, whose centers lie 3 r/8 beyond its ends."""
    r, half = size
    tube, moments = _cylinder(size)
    ball = 4 / 3 * np.pi * r**3
    across = 2 / 5 * r**2 + half**2 + 3 / 4 * half * r
    caps = np.array([across, across, 2 / 5 * r**2])
    return tube + ball, (tube * moments + ball * caps) / (tube + ball)


SHAPES: dict[str, tuple[int, Callable[[Vector], tuple[float, Vector]]]] = {
    "sphere": (1, lambda size: _solid(np.repeat(size[0], 3), 4 / 3 * np.pi, 5)),
    "ellipsoid": (3, lambda size: _solid(size, 4 / 3 * np.pi, 5)),
    "box": (3, lambda size: _solid(size, 8.0, 3)),
    "cylinder": (2, _cylinder),
    "capsule": (2, _capsule),
}
"""By shape: the number of its sizes, and a function of these that returns the volume and the three principal moments of
inertia by mass, about the center and the axes x, y, z. Sizes are the radius; half axes; half lengths; radius and half
length along z, of a capsule without its caps."""
WEIGHTLESS = ("plane", "hfield")


def shape_of(geom: Element) -> str:
    """Return the type of a geom."""
    return geom.text("type", "mesh" if geom.has("mesh") else "sphere")


def inertia_of_geom(geom: Element, meshes: dict[Node, Inertia]) -> Inertia:
    """Return the inertia of a geom of uniform density."""
    shape = shape_of(geom)
    density, mass = geom.number("density", 1000, 0), geom.number("mass", np.nan, 0)
    if shape in WEIGHTLESS or mass == 0:
        return Inertia()
    shell = geom.choice("shellinertia", "false", "true") == "true"
    if shape == "mesh" and not shell:
        inertia = inertia_of(geom, meshes)
        return inertia.scaled(density if np.isnan(mass) else mass / inertia.mass).seen_from(pose_of(geom))
    if shape not in SHAPES or geom.has("mesh") or shell:
        geom.refuse(f"is a {shape} whose inertia is not computed: give its body an <inertial>")
    size = size_of(geom, shape)
    with np.errstate(all="ignore"):
        volume, moments = SHAPES[shape][1](size)
    if not (0 < volume < np.inf and np.isfinite(moments).all()):
        geom.refuse(f"has size='{geom.text('size')}', whose volume is {volume:g}: use other units of length")
    mass = density * volume if np.isnan(mass) else mass
    return Inertia(mass, matrix=mass * np.diag(moments)).seen_from(pose_of(geom))


def size_of(geom: Element, shape: str) -> Vector:
    """Return the sizes of a geom, by ``size`` and ``fromto``."""
    count, size = SHAPES[shape][0], geom.vector("size", sizes=(1, 2, 3))
    if geom.has("fromto"):
        ends = geom.vector("fromto", sizes=(6,))
        if shape == "sphere":
            geom.refuse("has fromto, which needs a shape with an axis")
        size = np.array([size[0]] * (count - 1) + [math.hypot(*(ends[3:] - ends[:3])) / 2])
    if len(size) < count or (size[:count] <= 0).any():
        geom.refuse(f"is a {shape} and has size='{geom.text('size')}': {count} numbers > 0 are needed")
    return size[:count]
