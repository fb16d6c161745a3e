"""Reader of MJCF, the model format of MuJoCo: bodies, joints, inertias of bodies and geoms, gravity, equalities.

Contacts, meshes, limits of joints, actuators and sensors are not read. Attributes and defaults are those of
https://mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from scvi_codegen.errors import closest
from scvi_codegen.formulas.rotations.members import matrix_of
from scvi_codegen.mechanics.multibody.trees.closures import Closure, Coupling, at_reference
from scvi_codegen.mechanics.multibody.trees.document import Element, root_of, warn_of_dry_friction
from scvi_codegen.mechanics.multibody.trees.shapes import SHAPES
from scvi_codegen.mechanics.multibody.trees.tree import SINGLE, Inertia, Joint, Link, Pose, Vector, about

REFUSED = ("attach", "replicate", "composite", "flexcomp", "plugin")
"""Elements inside bodies that are not read, and without which the model would be another one."""
WEIGHTLESS = ("plane", "hfield")
CHANGES = {"boundmass": "0", "boundinertia": "0", "balanceinertia": "false"}
"""Settings that change inertias and are not read, with their defaults."""
ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
MOST_INCLUDED = 20
AXES = dict(zip("xyz", np.eye(3), strict=True))


def links_of_mjcf(path: str | PathLike[str]) -> tuple[str, list[Link], Vector, list[Closure | Coupling]]:
    """Return the name of the model, its links with parents first, the acceleration of gravity, and its equalities.

    Raises:
        SystemDefinitionError: naming file and element, if something is malformed or changes the mechanics and is not
            read.
    """
    model = _MujocoModel(root_of(path, "mujoco"))
    for body in model.inside("worldbody"):
        model.read(body, -1, Pose(), "main")
    warn_of_dry_friction(path, model.rough)
    name, closures = model.root.node.get("model", Path(path).stem), [*model.closures()]
    return name, model.scaled(), model.gravity, closures


class _MujocoModel:
    """Settings, default classes and links of a document."""

    def __init__(self, root: Element) -> None:
        self.root = root
        self.sections = [*_sections(root, 0)]
        self.settings: dict[str, str] = {}
        options: dict[str, str] = {}
        flags = (flag.node for section in self.inside("option") for flag in section.children("flag"))
        self.disabled = {name for flag in flags for name, value in flag.items() if value == "disable"}
        self.rough: list[str] = []
        self.still: set[int] = set()
        self.classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for section in self.sections:
            if section.node.tag == "compiler":
                self.settings |= section.node.attrib
            elif section.node.tag == "option":
                options |= section.node.attrib
            elif section.node.tag == "default":
                self.read_defaults(section, {})
            elif section.node.tag == "deformable" and len(section.node):
                section.refuse(f"contains <{section.node[0].tag}>, which is not read: remove it or write a constraint")
            elif section.node.tag == "tendon":
                for tendon in section.children("spatial", "fixed"):
                    if tendon.has("stiffness"):
                        tendon.refuse("has a stiffness, which is not read")
        option = Element(root.file, root.node, options)
        self.gravity = option.vector("gravity", (0, 0, -9.81)) * ("gravity" not in self.disabled)
        if any(option.number(each, 0) != 0 for each in ("density", "viscosity")):
            warnings.warn(f"{root.file}: forces of the medium (density, viscosity) are not read", stacklevel=5)
        self.turn = 1.0 if self.settings.get("angle", "degree") == "radian" else np.pi / 180
        self.links: list[Link] = []
        self.places: dict[tuple[str, str], tuple[int, Pose]] = {("body", "world"): (-1, Pose())}
        """Link and pose in it of bodies and sites, by tag and name."""

    def read_defaults(self, element: Element, inherited: Mapping[str, Mapping[str, str]]) -> None:
        """Store the attributes of a default class, which inherits those of the class around it."""
        attributes = {tag: dict(values) for tag, values in inherited.items()}
        for node in element.node:
            if node.tag != "default":
                attributes[node.tag] = attributes.get(node.tag, {}) | node.attrib
        self.classes[element.node.get("class", "main")] = attributes
        for child in element.children("default"):
            self.read_defaults(child, attributes)

    def inside(self, tag: str) -> Iterator[Element]:
        """Yield the sections with a tag."""
        yield from (section for section in self.sections if section.node.tag == tag)

    def with_defaults(self, element: Element, inherited: str) -> Element:
        """Return an element with the defaults of its class, or of the class of the bodies around it."""
        name = element.node.get("class", inherited)
        if name not in self.classes:
            element.refuse(f"is of the class '{name}', which does not exist")
        return Element(element.file, element.node, self.classes[name].get(element.node.tag, {}))

    def read(self, body: Element, link: int, at: Pose, inherited: str) -> None:
        """Read what a body, a frame or the world contains, fixed to a link at a pose."""
        for child in body.children(*REFUSED):
            child.refuse("is not read: write its bodies out")
        inherited = body.node.get("childclass", inherited)
        for site in body.children("site"):
            self.places["site", site.name] = link, at @ self.pose(self.with_defaults(site, inherited))
        for frame in body.children("frame"):
            self.read(frame, link, at @ self.pose(frame), inherited)
        for inner in body.children("body"):
            pose = at @ self.pose(inner)
            self.places["body", inner.name] = (
                self.add(inner, link, pose, inner.node.get("childclass", inherited)),
                Pose(),
            )
            self.read(inner, self.places["body", inner.name][0], Pose(), inherited)

    def add(self, body: Element, parent: int, pose: Pose, inherited: str) -> int:
        """Add a link for each joint of a body and one that carries its inertia; return the position of the last."""
        name = body.node.get("name", f"body{len(self.links)}")
        anchor = np.zeros(3)
        for count, (element, frame) in enumerate(self.contents(body, "joint", "freejoint")):
            joint = self.with_defaults(element, inherited)
            at = frame.position + frame.rotation @ joint.vector("pos", (0, 0, 0))
            place = pose @ Pose(at - anchor)
            label = element.node.get("name", name if count == 0 else f"{name}_{count + 1}")
            self.links.append(Link(label, parent, self.joint(joint, label, place, frame, parent), Inertia()))
            parent, pose, anchor = len(self.links) - 1, Pose(), at
        carried = Joint(name=name, kind="fixed", pose=pose @ Pose(-anchor))
        fixed = (parent < 0 or parent in self.still) and "settotalmass" not in self.settings  # to the world
        inertia = Inertia() if fixed else self.inertia(body, inherited).compensated(body.number("gravcomp", 0))
        self.still |= {len(self.links)} if fixed else set()
        self.links.append(Link(name, parent, carried, inertia))
        return len(self.links) - 1

    def contents(self, body: Element, *tags: str) -> Iterator[tuple[Element, Pose]]:
        """Yield the children of a body with one of the tags, also in frames, with the pose of their frame."""
        for child in body.children("frame", *tags):
            if child.node.tag == "frame":
                for element, inner in self.contents(child, *tags):
                    yield element, self.pose(child) @ inner
            else:
                yield child, Pose()

    def closures(self) -> Iterator[Closure | Coupling]:
        """Yield the equalities that are active; their softness is not read.

        https://mujoco.readthedocs.io/en/stable/XMLreference.html#equality
        """
        for section in self.inside("equality"):
            for node in section.node:
                each = self.with_defaults(Element(section.file, node), "main")
                if each.text("active", "true") == "false" or "equality" in self.disabled:
                    continue
                if node.tag == "joint":
                    yield self.coupling(each)
                elif node.tag not in ("connect", "weld"):
                    each.refuse("is not read: remove it or write a constraint")
                else:
                    yield self.closure(each)

    def place(self, element: Element, key: str) -> tuple[int, Pose]:
        """Return the link and the pose in it of the body or site that an attribute names."""
        kind, name = key[:-1], element.text(key, "world" if key == "body2" else None)
        if (kind, name) not in self.places:
            known = [each for tag, each in self.places if tag == kind]
            element.refuse(f"names the {kind} '{name}', which does not exist{closest(name, known)}")
        return self.places[kind, name]

    def closure(self, equality: Element) -> Closure:
        """Return a connection or weld of two sites, or of bodies, by default as in the reference configuration."""
        kind = "site" if equality.has("site1") else "body"
        (one, at), (two, other) = (self.place(equality, f"{kind}{k}") for k in (1, 2))
        turning = equality.node.tag == "weld"
        if kind == "body" and turning:
            pose = equality.vector("relpose", (0, 1, 0, 0, 0, 0, 0), (7,))
            if pose[3:].any():
                at = Pose(pose[:3], _of_quaternion(equality, pose[3:]))
            else:
                at = at_reference(self.links, one).inverse @ at_reference(self.links, two)
        elif kind == "body":
            at = Pose(equality.vector("anchor"))
            other = at_reference(self.links, two).inverse @ at_reference(self.links, one) @ at
        return Closure((one, two), (at, other), turning)

    def coupling(self, equality: Element) -> Coupling:
        """Return a relation between two joints, or the fixed value of one."""
        zeros = {each.joint.name: each.joint.zero for each in self.links}
        joint, other = equality.text("joint1"), equality.text("joint2", "") or None
        given = equality.vector("polycoef", (0, 1, 0, 0, 0), range(1, 6))
        coefficients = tuple(map(float, given if other else given[:1]))
        return Coupling(joint, other, coefficients, zeros.get(joint, 0.0), zeros.get(other or "", 0.0))

    def joint(self, joint: Element, name: str, pose: Pose, frame: Pose, parent: int) -> Joint:
        """Return a joint whose link has a pose in its parent."""
        kind = "free" if joint.node.tag == "freejoint" else joint.text("type", "hinge")
        if kind not in ("hinge", "slide", "ball", "free"):
            joint.refuse(f"is of type '{kind}', which does not exist")
        if kind == "free" and parent >= 0:
            joint.refuse("is free, but its body is inside another body")
        turn = self.turn if kind == "hinge" else 1.0
        stiffness, rest, zero = (joint.number(each, 0) for each in ("stiffness", "springref", "ref"))
        if joint.vector("springdamper", (0, 0), (2,)).any():
            joint.refuse("has springdamper, which is not read: give its stiffness and damping")
        if kind in ("ball", "free") and stiffness != 0:
            joint.refuse("has a stiffness, which is read for hinges and slides only")
        if kind != "free" and joint.number("frictionloss", 0) != 0:
            self.rough.append(name)
        bare = joint.node.tag == "freejoint"
        return Joint(
            name=name,
            kind=kind,
            pose=pose,
            axis=frame.rotation @ joint.unit("axis", (0, 0, 1)) if kind in SINGLE else np.zeros(3),
            damping=0.0 if bare or "damper" in self.disabled else joint.number("damping", 0),
            stiffness=0.0 if "spring" in self.disabled else stiffness,
            rest=rest * turn,
            armature=0.0 if bare else joint.number("armature", 0),
            zero=zero * turn if kind in SINGLE else 0.0,
        )

    def inertia(self, body: Element, inherited: str) -> Inertia:
        """Return the inertia of a body, by its inertial or, as ``inertiafromgeom`` says, by its geoms."""
        rule = self.settings.get("inertiafromgeom", "auto")
        inertial = body.child("inertial")
        if rule == "false" or (rule == "auto" and inertial is not None):
            return Inertia() if inertial is None else self.inertial(inertial)
        total = Inertia()
        low, high = Element(self.root.file, self.root.node, self.settings).vector("inertiagrouprange", (0, 5), (2,))
        for element, frame in self.contents(body, "geom"):
            geom = self.with_defaults(element, inherited)
            if low <= geom.number("group", 0) <= high:
                total += self.geom(geom).seen_from(frame)
        return total

    def inertial(self, inertial: Element) -> Inertia:
        if inertial.has("fullinertia"):
            xx, yy, zz, xy, xz, yz = inertial.vector("fullinertia", sizes=(6,))
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            matrix = np.diag(inertial.vector("diaginertia", (0, 0, 0)))
        return Inertia(inertial.number("mass"), matrix=matrix).seen_from(self.pose(inertial))

    def geom(self, geom: Element) -> Inertia:
        """Return the inertia of a geom."""
        shape = geom.text("type", "mesh" if geom.has("mesh") and not geom.has("type") else "sphere")
        if shape in WEIGHTLESS or (geom.has("mass") and geom.number("mass") == 0):
            return Inertia()
        if shape not in SHAPES or geom.has("shellinertia"):
            geom.refuse(f"is a {shape} whose inertia is not computed: give its body an <inertial>")
        count, volume_and_inertia = SHAPES[shape]
        pose = self.pose(geom)
        if geom.has("fromto"):
            ends = geom.vector("fromto", sizes=(6,))
            line = (ends[3:] - ends[:3]) / 2
            half = float(np.linalg.norm(line))
            if half == 0 or shape == "sphere":
                geom.refuse("has fromto, which needs two different points and a shape with an axis")
            pose = Pose((ends[:3] + ends[3:]) / 2, _shortest_turn(line / half))
            radius = geom.vector("size", sizes=(1, 2, 3))[0]
            size = np.array([radius] * (count - 1) + [half])
        else:
            size = geom.vector("size", sizes=range(count, 4))[:count]
        volume, moments = volume_and_inertia(size)
        mass = geom.number("mass") if geom.has("mass") else geom.number("density", 1000) * volume
        return Inertia(mass, matrix=mass * np.diag(moments)).seen_from(pose)

    def pose(self, element: Element) -> Pose:
        """Return position and orientation of an element."""
        return Pose(element.vector("pos", (0, 0, 0)), self.orientation(element))

    def orientation(self, element: Element) -> Vector:
        """Return the rotation matrix of the one attribute of orientation that an element has."""
        present = [each for each in ORIENTATIONS if each in element.node.attrib]
        if len(present) > 1:
            element.refuse(f"has {' and '.join(present)}: one orientation is needed")
        kind = present[0] if present else ""
        if kind == "quat":
            return _of_quaternion(element, element.vector("quat", sizes=(4,)))
        if kind == "axisangle":
            *axis, angle = element.vector("axisangle", sizes=(4,))
            length = float(np.linalg.norm(axis))
            if length == 0:
                element.refuse("has an axis of length 0")
            return about(np.array(axis) / length, angle * self.turn)
        if kind == "euler":
            rotation = np.eye(3)
            sequence = self.settings.get("eulerseq", "xyz")
            if not re.fullmatch("[xyzXYZ]{3}", sequence):
                element.refuse(f"has euler, and eulerseq='{sequence}' is not three of the letters xyzXYZ")
            for letter, angle in zip(sequence, element.vector("euler"), strict=True):
                turned = about(AXES[letter.lower()], angle * self.turn)
                rotation = rotation @ turned if letter.islower() else turned @ rotation
            return rotation
        if kind == "xyaxes":
            axes = element.vector("xyaxes", sizes=(6,))
            x = axes[:3] / np.linalg.norm(axes[:3])
            y = axes[3:] - (axes[3:] @ x) * x
            y /= np.linalg.norm(y)
            return np.column_stack([x, y, np.cross(x, y)])
        return _shortest_turn(element.unit("zaxis")) if kind else np.eye(3)

    def scaled(self) -> list[Link]:
        """Return the links, with inertias scaled to ``settotalmass``."""
        settings = Element(self.root.file, self.root.node, self.settings)
        if changed := [each for each, usual in CHANGES.items() if settings.text(each, usual) != usual]:
            settings.refuse(f"has {changed[0]}, which is not read: remove it and adapt the inertias")
        total = settings.number("settotalmass", -1)
        masses = sum(link.inertia.mass for link in self.links)
        if total <= 0 or masses == 0:
            return self.links
        return [replace(each, inertia=each.inertia.scaled(total / masses)) for each in self.links]


def _sections(root: Element, depth: int) -> Iterator[Element]:
    """Yield the sections of a document and of those that it includes, in place of nested elements, too."""
    for node in root.node:
        section = Element(root.file, node)
        if node.tag != "include":
            if next(node.iter("include"), None) is not None:
                node[:] = [each.node for each in _sections(section, depth)]
            yield section
        elif depth == MOST_INCLUDED:
            section.refuse(f"is nested deeper than {MOST_INCLUDED} files")
        else:
            file = Path(root.file).parent / section.text("file")
            yield from _sections(root_of(file, "mujocoinclude", "mujoco"), depth + 1)


def _of_quaternion(element: Element, q: Vector) -> Vector:
    if not q.any():
        element.refuse("has a quaternion of length 0")
    return np.array(matrix_of([*map(float, q / np.linalg.norm(q))]), dtype=float)


def _shortest_turn(axis: Vector) -> Vector:
    """Return the shortest rotation that turns the z axis into a unit vector."""
    across = np.cross([0.0, 0.0, 1.0], axis)
    length = float(np.linalg.norm(across))
    if length < 1e-12:
        return np.diag([1.0, np.sign(axis[2]), np.sign(axis[2])])
    return about(across / length, float(np.arctan2(length, axis[2])))
