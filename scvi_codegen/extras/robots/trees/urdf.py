"""Reader of URDF, the robot description format of ROS: links, inertials, joints.

Axes and angles are those of https://docs.ros.org/en/rolling/p/urdfdom: ``rpy`` are rotations about the fixed axes x, y,
z, in this order. :mod:`scvi_codegen.extras.robots.trees.schema` lists the attributes that are read.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import product
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from scvi_codegen.common.errors import closest
from scvi_codegen.extras.robots.trees.document import Element, Unread, checked_limits, root_of
from scvi_codegen.extras.robots.trees.schema import URDF
from scvi_codegen.extras.robots.trees.tree import (
    SINGLE,
    Inertia,
    Joint,
    Link,
    Pose,
    Vector,
    about,
    axes_of,
    named,
    times,
)

LIMITED = ("revolute", "prismatic")
KINDS = {"fixed": "fixed", "revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "floating": "free"}
KINDS |= {"spherical": "ball", "ball": "ball", "planar": "planar"}
"""Kind of joint by URDF's and Drake's name; a planar joint is two slides across the axis and a hinge about it."""
RIGHT_ANGLE = np.pi / 2
PRINTED = 5e-6
"""Angles that differ less from a multiple of pi/2 are this multiple: files print 1.5708 or 1.57079632."""


def links_of_urdf(path: str | PathLike[str], *, floating: bool, parts: Collection[str] = ()) -> tuple[str, list[Link]]:
    """Return the name of the robot and its links, parents first.

    Args:
        path: the file.
        floating: whether the base moves freely; otherwise it is fixed to the world.
        parts: among ``"limits"`` and ``"friction"`` of joints; a warning names others.

    Raises:
        SystemDefinitionError: naming file and element, if a link or joint is missing, named twice or malformed, the
            links are no tree, or a joint is of a kind that is not read.
    """
    robot = root_of(Path(path), "robot")
    unread = _checked(robot, parts)
    links = _links(robot)
    joints = _by_child(robot, links)
    roots = [name for name in links if name not in joints]
    if len(roots) != 1:
        robot.refuse(f"must have links that form one tree, but without parents are {roots or 'none'}")
    outgoing = defaultdict[str, list[str]](list)
    for child, joint in joints.items():
        outgoing[_linked(joint, "parent")].append(child)
    base = Joint(name=roots[0], kind="free" if floating else "fixed", pose=Pose())
    tree = [Link(roots[0], -1, base, _inertia(links[roots[0]]))]
    places, rotors, resting = {roots[0]: 0}, _rotors(robot), {roots[0]: not floating}
    for parent in (order := [roots[0]]):
        for child in outgoing[parent]:
            place, kind = places[parent], joints[child].text("type")
            if kind == "floating" and not resting[parent]:
                joints[child].refuse("is free, but its parent moves: remove the joint, or omit floating=True")
            resting[child] = resting[parent] and kind == "fixed"
            for moved in _joints(joints[child], parts, rotors.get(joints[child].name, 0.0)):
                tree.append(Link(child, place, moved, Inertia()))
                place = len(tree) - 1
            tree[-1] = replace(tree[-1], inertia=_inertia(links[child]))
            places[child] = place
            order.append(child)
    if len(order) < len(links):
        circle = sorted(set(links) - set(order))
        joints[circle[0]].refuse(f"closes a loop: the links {circle} form a circle")
    _check_followed(robot)
    unread.warn(str(path))
    return robot.node.get("name") or Path(path).stem, named(tree)


def _by_child(robot: Element, links: Mapping[str, Element]) -> dict[str, Element]:
    """Return the joints by the names of the links that they move, after checks of these."""
    joints: dict[str, Element] = {}
    for joint in _by_name(robot, "joint").values():
        for name in (_linked(joint, "parent"), child := _linked(joint, "child")):
            if name not in links:
                joint.refuse(f"names the link '{name}', which does not exist{closest(name, links)}")
        if child in joints:
            joint.refuse(f"moves the link '{child}', which joint '{joints[child].name}' moves as well")
        joints[child] = joint
    return joints


def _check_followed(robot: Element) -> None:
    """Raise an error for a joint that follows itself, also through others, or one that is no hinge or slide."""
    followed, single = dict[str, str](), list[str]()
    for joint in robot.children("joint"):
        kind, mimic = KINDS[joint.text("type")], joint.child("mimic")
        single += [joint.name] * (kind in SINGLE)
        if mimic is not None and kind != "fixed":
            followed[joint.name] = mimic.text("joint")
    for joint in robot.children("joint"):
        seen = [joint.name]
        while (other := followed.get(seen[-1])) is not None:
            if other not in single:
                joint.refuse(f"follows '{other}', which is no moving joint{closest(other, single)}")
            if other in seen:
                joint.refuse(f"follows itself: {', '.join((*seen, other))}")
            seen.append(other)


def _rotors(robot: Element) -> dict[str, float]:
    """Return inertias of rotors as seen from their joints, I gear_ratio^2, by the names of these (Drake)."""
    rotors: dict[str, float] = {}
    for transmission in robot.children("transmission"):
        for actuator, joint in product(*map(transmission.children, ("actuator", "joint"))):
            inertia, ratio = (actuator.child(f"drake:{tag}") for tag in ("rotor_inertia", "gear_ratio"))
            factor = ratio.number("value") ** 2 if ratio else 1.0
            rotors[joint.name] = factor * inertia.number("value", least=0) if inertia else 0.0
    return rotors


def _checked(robot: Element, parts: Collection[str]) -> Unread:
    """Check elements and attributes of a document; return its parts that matter and are not read."""
    unread = Unread()
    for node in robot.node.iter("drake:joint"):
        node.tag = "joint"
    for element, kind in robot.walk(URDF):
        element.check_neutral(kind)
        if others := [f"<{child.tag}>" for child in element.node if ":" in child.tag or child.tag == "frame"]:
            unread.add("elements", *others)
    for joint in robot.children("joint"):
        bounds, friction = _limits(joint)
        if bounds and "limits" not in parts:
            unread.add("limits of joints", joint.name)
        if friction and "friction" not in parts:
            unread.add("dry friction of joints", joint.name)
    if any(link.child("collision") for link in robot.children("link")):
        unread.add("contacts")
    for actuator in robot.children("transmission", "ros2_control"):
        unread.add("actuators", actuator.name)
    return unread


def _limits(joint: Element) -> tuple[tuple[float, float] | None, float]:
    """Return the smallest and the largest value of a joint, if they limit it, and its dry friction."""
    low, high = (joint.optional("limit").number(key, 0) for key in ("lower", "upper"))
    friction = joint.optional("dynamics").number("friction", 0, 0)
    return (low, high) if (low or high) and joint.text("type") in LIMITED else None, friction


def _by_name(robot: Element, tag: str) -> dict[str, Element]:
    elements: dict[str, Element] = {}
    for element in robot.children(tag):
        name = element.text("name")
        if name in elements:
            element.refuse("is defined twice")
        elements[name] = element
    return elements


def _links(robot: Element) -> dict[str, Element]:
    """Return the links by name, of which ``world`` needs no declaration."""
    links = _by_name(robot, "link")
    if "world" in {_linked(joint, "parent") for joint in robot.children("joint")} - {*links}:
        world = ElementTree.Element("link", name="world")
        links["world"] = Element(world, {world: robot.places[robot.node]})
    return links


def _linked(joint: Element, end: str) -> str:
    element = joint.child(end)
    if element is None:
        joint.refuse(f"has no <{end}>")
    return element.text("link")


def _joints(joint: Element, parts: Collection[str], armature: float) -> list[Joint]:
    """Return a joint, or those that a planar one consists of, from the parent to the child."""
    kind = joint.text("type")
    if kind not in KINDS:
        joint.refuse(f"is of type '{kind}', which is not read; possible: {', '.join(KINDS)}")
    dynamics, mimic, older = joint.optional("dynamics"), joint.child("mimic"), joint.optional("joint_properties")
    if older.number("damping", 0) or older.number("friction", 0):
        older.refuse("has damping or friction, which is not read: write <dynamics>")
    single = KINDS[kind] in SINGLE
    follows = None
    if mimic is not None and kind != "fixed":
        if not single:
            joint.refuse(f"is of type '{kind}', which cannot mimic another joint")
        follows = (mimic.text("joint"), mimic.number("multiplier", 1), mimic.number("offset", 0))
    bounds, friction = _limits(joint)
    turns = single or kind == "planar"
    along = joint.optional("axis").unit("xyz", (1, 0, 0)) if turns else np.array([1.0, 0.0, 0.0])
    spring = dynamics.number("spring_stiffness", 0, 0)
    if spring and not single:
        joint.refuse("has a spring_stiffness, which is read of revolute, continuous and prismatic joints only")
    read = Joint(
        name=joint.name,
        kind=KINDS[kind],
        pose=_pose(joint),
        axis=along,
        damping=(dynamics.number("damping", 0, 0),),
        stiffness=(spring,),
        rest=dynamics.number("spring_reference", 0),
        armature=armature,
        limits=checked_limits(joint, *bounds) if bounds and "limits" in parts else None,
        dry_friction=friction if "friction" in parts else 0.0,
        follows=follows,
    )
    if kind != "planar":
        return [read]
    moved = zip(("x", "y", "angle"), ("slide", "slide", "hinge"), axes_of(along).T, strict=True)
    x, *others = (replace(read, name=f"{part}_{joint.name}", kind=motion, axis=e) for part, motion, e in moved)
    return [x, *(replace(other, pose=Pose()) for other in others)]


def _inertia(link: Element) -> Inertia:
    inertial = link.child("inertial")
    if inertial is None:
        return Inertia()
    mass, inertia = inertial.child("mass"), inertial.child("inertia")
    if mass is None or inertia is None:
        link.refuse("has an <inertial>, which needs <mass> and <inertia>")
    xx, xy, xz, yy, yz, zz = (inertia.number(f"i{indices}") for indices in ("xx", "xy", "xz", "yy", "yz", "zz"))
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Inertia(mass.number("value", least=0), matrix=matrix).seen_from(_pose(inertial))


def _pose(element: Element) -> Pose:
    origin = element.optional("origin")
    return Pose(origin.vector("xyz", (0, 0, 0)), rotation_of_rpy(origin.vector("rpy", (0, 0, 0))))


def rotation_of_rpy(angles: Vector) -> Vector:
    """Return Rz(yaw) Ry(pitch) Rx(roll)."""
    nearest = np.round(angles / RIGHT_ANGLE) * RIGHT_ANGLE
    roll, pitch, yaw = np.where(np.abs(angles - nearest) < PRINTED, nearest, angles)
    x, y, z = np.eye(3)
    return np.asarray(times(times(about(z, yaw), about(y, pitch)), about(x, roll)))
