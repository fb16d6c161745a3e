"""Reader of URDF, the robot description format of ROS: links, inertials, joints.

Axes and angles are those of https://docs.ros.org/en/rolling/p/urdfdom: ``rpy`` are rotations about the fixed axes x, y,
z, in this order. :mod:`scvi_codegen.systems.multibody.trees.schema` lists the attributes that are read.
"""

from os import PathLike
from pathlib import Path

import numpy as np

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.systems.multibody.trees.document import Element, Unread, root_of
from scvi_codegen.systems.multibody.trees.schema import URDF
from scvi_codegen.systems.multibody.trees.tree import SINGLE, Inertia, Joint, Link, Pose, Vector, about, named

LIMITED = ("revolute", "prismatic")
KINDS = {"fixed": "fixed", "revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "floating": "free"}
"""Kind of joint by URDF's name."""
RIGHT_ANGLE = np.pi / 2
PRINTED = 5e-6
"""Angles that differ less from a multiple of pi/2 are this multiple: files print 1.5708 or 1.57079632."""


def links_of_urdf(path: str | PathLike[str], *, floating: bool, limits: bool = False) -> tuple[str, list[Link]]:
    """Return the name of the robot and its links, parents first.

    Args:
        path: the file.
        floating: whether the base moves freely; otherwise it is fixed to the world.
        limits: whether those of joints and dry friction are read; otherwise a warning names them.

    Raises:
        SystemDefinitionError: naming file and element, if a link or joint is missing, named twice or malformed, the
            links are no tree, or a joint is of a kind that is not read.
    """
    robot = root_of(Path(path), "robot")
    for element, kind in robot.walk(URDF):
        element.check_neutral(kind)
    links = _by_name(robot, "link")
    joints: dict[str, Element] = {}  # by the name of the child
    outgoing: dict[str, list[str]] = {name: [] for name in links}
    for joint in _by_name(robot, "joint").values():
        ends = {end: _linked(joint, end) for end in ("parent", "child")}
        for name in ends.values():
            if name not in links:
                joint.refuse(f"names the link '{name}', which does not exist{closest(name, links)}")
        if ends["child"] in joints:
            joint.refuse(f"moves the link '{ends['child']}', which joint '{joints[ends['child']].name}' moves as well")
        joints[ends["child"]] = joint
        outgoing[ends["parent"]].append(ends["child"])
    roots = [name for name in links if name not in joints]
    if len(roots) != 1:
        raise SystemDefinitionError(f"{path}: the links must form one tree, but without parents are {roots or 'none'}")
    base = Joint(name=roots[0], kind="free" if floating else "fixed", pose=Pose())
    tree = [Link(roots[0], -1, base, _inertia(links[roots[0]]))]
    places = {roots[0]: 0}
    for parent in (order := [roots[0]]):
        for child in outgoing[parent]:
            tree.append(Link(child, places[parent], _joint(joints[child], limits), _inertia(links[child])))
            places[child] = len(order)
            order.append(child)
    if len(order) < len(links):
        raise SystemDefinitionError(f"{path}: the links {sorted(set(links) - set(order))} form a circle")
    _unread(robot, limits).warn(str(path))
    return robot.node.get("name") or Path(path).stem, named(tree)[0]


def _unread(robot: Element, limits: bool) -> Unread:
    """Return the parts of a document that matter and are not read."""
    unread = Unread()
    for joint in robot.children("joint") if not limits else ():
        bounds, friction = _limits(joint)
        if bounds:
            unread.add("limits of joints", joint.name)
        if friction:
            unread.add("dry friction of joints", joint.name)
    if any(link.child("collision") for link in robot.children("link")):
        unread.add("contacts")
    for actuator in robot.children("transmission", "ros2_control"):
        unread.add("actuators", actuator.name)
    return unread


def _limits(joint: Element) -> tuple[tuple[float, float] | None, float]:
    """Return the smallest and the largest value of a joint, if they limit it, and its dry friction."""
    limit, dynamics = joint.child("limit"), joint.child("dynamics")
    low, high = (0.0, 0.0) if limit is None else (limit.number("lower", 0), limit.number("upper", 0))
    friction = 0.0 if dynamics is None else dynamics.number("friction", 0, 0)
    return (low, high) if (low or high) and joint.text("type") in LIMITED else None, friction


def _by_name(robot: Element, tag: str) -> dict[str, Element]:
    elements: dict[str, Element] = {}
    for element in robot.children(tag):
        name = element.text("name")
        if name in elements:
            element.refuse("is defined twice")
        elements[name] = element
    return elements


def _linked(joint: Element, end: str) -> str:
    element = joint.child(end)
    if element is None:
        joint.refuse(f"has no <{end}>")
    return element.text("link")


def _joint(joint: Element, limits: bool) -> Joint:
    kind = joint.text("type")
    if kind not in KINDS:
        joint.refuse(f"is of type '{kind}', which is not read; possible: {', '.join(KINDS)}")
    axis, dynamics, mimic = (joint.child(tag) for tag in ("axis", "dynamics", "mimic"))
    single = KINDS[kind] in SINGLE
    follows = None
    if mimic is not None and kind != "fixed":
        if not single:
            joint.refuse(f"is of type '{kind}', which cannot mimic another joint")
        follows = (mimic.text("joint"), mimic.number("multiplier", 1), mimic.number("offset", 0))
    bounds, friction = _limits(joint) if limits and single else (None, 0.0)
    return Joint(
        name=joint.name,
        kind=KINDS[kind],
        pose=_pose(joint),
        axis=axis.unit("xyz", (1, 0, 0)) if axis is not None and single else np.array([1.0, 0.0, 0.0]),
        damping=0.0 if dynamics is None else dynamics.number("damping", 0, 0),
        limits=bounds,
        dry_friction=friction,
        follows=follows,
    )


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
    origin = element.child("origin")
    if origin is None:
        return Pose()
    return Pose(origin.vector("xyz", (0, 0, 0)), rotation_of_rpy(origin.vector("rpy", (0, 0, 0))))


def rotation_of_rpy(angles: Vector) -> Vector:
    """Return Rz(yaw) Ry(pitch) Rx(roll)."""
    nearest = np.round(angles / RIGHT_ANGLE) * RIGHT_ANGLE
    roll, pitch, yaw = np.where(np.abs(angles - nearest) < PRINTED, nearest, angles)
    x, y, z = np.eye(3)
    return about(z, yaw) @ about(y, pitch) @ about(x, roll)
