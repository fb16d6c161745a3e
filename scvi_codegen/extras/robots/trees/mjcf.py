"""Reader of MJCF, the model format of MuJoCo: bodies, joints, inertias of bodies and geoms, gravity, equalities.

Attributes and defaults are those of https://mujoco.readthedocs.io/en/stable/XMLreference.html;
:mod:`scvi_codegen.extras.robots.trees.schema` lists which are read.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, zip_longest
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from sympy import Expr, S

from scvi_codegen.api.formulas import symbol
from scvi_codegen.extras.robots.trees.actuators import (
    ACTED,
    JOINTED,
    Actuator,
    Motion,
    Range,
    activation_of,
    actuator_of,
    clamped,
    damping_ratio,
    in_shared_ranges,
    is_servo,
    motion_of,
    motion_of_sites,
)
from scvi_codegen.extras.robots.trees.closures import Closure, Coupling, at_reference
from scvi_codegen.extras.robots.trees.contacts import Geom, Pair, Touch
from scvi_codegen.extras.robots.trees.document import Element, Unread, checked_limits
from scvi_codegen.extras.robots.trees.fluid import box, ellipsoid, principal_axes
from scvi_codegen.extras.robots.trees.shapes import (
    AXES,
    ORIENTATIONS,
    SHAPES,
    inertia_of_geom,
    of_quaternion,
    pose_of,
    shape_of,
    size_of,
    unit_of_angles,
)
from scvi_codegen.extras.robots.trees.sources import document_of, merged
from scvi_codegen.extras.robots.trees.tendons import Tendon, length_of, mean_inverses, reference_length
from scvi_codegen.extras.robots.trees.tree import SINGLE, Inertia, Joint, Link, Pose, Vector, named, times

PARTS = {"limits": "limits", "friction": "dry friction"}
SLIDING = 3
"""Dimension of contacts with sliding friction; of higher ones friction opposes rotations, too."""
NO_MASS, LIGHT = 1e-15, 1e-14
"""Bodies with less mass are without forces of a medium, and boxes have no smaller sums of moments of inertia; geoms
with less than the second have no axes."""
OF_SITES = ["site", "refsite"]


def links_of_mjcf(path: str | PathLike[str], parts: Collection[str] = ()) -> tuple[Any, ...]:
    """Return name, links with parents first, gravity, equalities, tendons, touching geoms, actuators, and keyframes.

    ``parts``: among ``"limits"``, ``"friction"`` of joints, ``"contacts"``, ``"actuators"``; a warning names others.

    Raises:
        SystemDefinitionError: naming file and element, if something is malformed or unknown, or changes the motion and
            is not read.
    """
    root = document_of(Path(path))
    model = _MujocoModel(root, parts)
    acting = model.actuators(tendons := [*model.tendons()])
    keys = dict(model.keyframes([x[1] for x in acting]))
    others = [*model.closures(tendons)], tendons, [*model.touches()], acting, keys
    model.unread.warn(root.file)
    return root.node.get("model") or Path(path).stem, model.completed(), model.gravity, *others


class _MujocoModel:
    """Links of a document whose attributes are explicit."""

    def __init__(self, root: Element, parts: Collection[str]) -> None:
        self.root, self.unread, self.parts = root, Unread(), parts
        option = merged(root, "option", root.children("option"))
        flags = merged(root, "flag", [flag for element in root.children("option") for flag in element.children("flag")])
        self.disabled = {key for key in flags.node.attrib if flags.choice(key, "enable", "disable") == "disable"}
        self.gravity = option.vector("gravity", (0, 0, -9.81)) * ("gravity" not in self.disabled)
        passive = not {"spring", "damper"} <= self.disabled
        self.idle = option.vector("actuatorgroupdisable", (), range(32))
        """Groups of actuators without forces."""
        self.medium = [option.number(key, 0, 0) * passive for key in ("density", "viscosity")]
        self.links: list[Link] = []
        self.compensating: list[Element] = []
        self.meshes: dict[ElementTree.Element, Inertia] = {}
        self.joints = dict[str, Element]()
        self.responses = dict[str, Vector]()
        self.activated = set[str]()
        """Inputs that are activations of actuators."""
        self.carriers, self.parents = {-1: -1}, dict[int, int]()
        """Of each body, by its link: the moving body that it is fixed to, and the one that this is connected with."""
        self.geoms: list[Geom] = []
        self.places = defaultdict[str, dict[str, tuple[int, Pose]]](dict, body={"world": (-1, Pose())})
        """Link and pose in it of bodies, joints and sites, and number and pose of geoms, by tag and name."""
        for world in root.children("worldbody"):
            self.read(world)
        self.links = named(self.links)
        for name, (place, pose) in self.places["site"].items():
            if place >= 0:
                self.links[place] = replace(self.links[place], frames=(*self.links[place].frames, (name, pose)))
        self.singles = {link.joint.label: link.joint for link in self.links if link.joint.kind in SINGLE}
        self.read_actuators()
        if self.compensating and any(link.inertia.lift[0] for link in self.links):
            self.compensating[0].refuse("has actuatorgravcomp, which is not read where bodies have gravcomp")

    def entries(self, section: str, *tags: str) -> Iterator[Element]:
        """Yield the elements in all sections of a name, all of them or those with one of the tags."""
        for element in self.root.children(section):
            yield from element.children(*tags)

    def tendons(self) -> Iterator[Tendon]:
        """Yield the tendons with forces, rotors, limits, actuators or equalities.

        https://mujoco.readthedocs.io/en/stable/XMLreference.html#tendon
        """
        acting = self.entries("actuator") if "actuators" in self.parts else ()
        acted = {actuator.text("tendon", "") for actuator in acting}
        acted |= {equality.text(f"tendon{k}", "") for equality in self.equalities() for k in (1, 2)}
        for tendon in self.entries("tendon"):
            limits, friction = self.read_limits(tendon, "tendons", tendon.name)
            stiffness, damping = (self.coefficients(tendon, key) for key in ("stiffness", "damping"))
            armature = tendon.number("armature", 0, 0)
            forces = *stiffness, *damping, armature, limits, friction, tendon.node.get("name") in acted
            if not any(forces):
                continue
            for part in tendon.children("geom", "pulley"):
                part.refuse(f"is on the tendon '{tendon.name}', which is read through sites only, without wrapping")
            factors = tuple((self.single(part, "joint").name, part.number("coef")) for part in tendon.children("joint"))
            points = tuple(self.place(part, "site") for part in tendon.children("site"))
            low, *high = map(float, tendon.vector("springlength", (-1,), (1, 2)))
            slack = None if low == -1 else (low, [*high, low][0])
            pull = self.bounds(tendon, "actuatorfrc")
            if armature and self.responses:
                tendon.refuse(f"has armature, which is not read with the springdamper of '{min(self.responses)}'")
            own = slack, tendon.name, pull, limits, friction
            yield Tendon(factors, points, stiffness, damping, armature, *own)

    def read(self, world: Element) -> None:
        """Add links, places and shapes of a world body and of all bodies in it, parents first."""
        pending = [(world, -1, Pose())]
        while pending:
            element, link, at = pending.pop()
            if element.tag == "body":
                link, at = self.add(element, link, at @ pose_of(element)), Pose()
                self.put(element, link, at)
            elif element.tag == "frame":
                at = at @ pose_of(element)
            if element.tag != "frame":
                for geom, frame in self.contents(element, "geom"):
                    self.put(geom, len(self.geoms), frame)
                    self.geoms.append(Geom(geom, link, at @ frame @ pose_of(geom)))
            for site in element.children("site"):
                self.put(site, link, at @ pose_of(site))
            pending += [(child, link, at) for child in reversed(element.children("frame", "body"))]

    def put(self, element: Element, link: int, at: Pose) -> None:
        """Store the place of a body, joint, geom or site, if it has a name."""
        places, name = self.places[element.tag.removeprefix("free")], element.node.get("name")
        if name in places:
            element.refuse("is defined twice: rename one")
        if name:
            places[name] = link, at

    def add(self, body: Element, parent: int, pose: Pose) -> int:
        """Add a link for each joint of a body and one that carries its inertia; return the position of the last."""
        name = body.node.get("name") or f"body{len(self.links)}"
        joints = [*self.contents(body, "joint", "freejoint")]
        above, anchor = self.carriers[parent], np.zeros(3)
        for count, (joint, frame) in enumerate(joints):
            free = joint.tag == "freejoint" or joint.text("type", "hinge") == "free"  # has no place in the body
            at = np.zeros(3) if free else frame.position + times(frame.rotation, joint.vector("pos", (0, 0, 0)))
            moved = pose @ Pose(at - anchor)
            label = joint.node.get("name") or (name if count == 0 else f"{name}_{count + 1}")
            self.put(joint, len(self.links), Pose())
            self.joints[label] = joint
            self.links.append(Link(label, parent, self.joint(joint, label, moved, frame, parent), Inertia()))
            parent, pose, anchor = len(self.links) - 1, Pose(), at
        place = len(self.links)
        self.carriers[place] = place if joints else above
        if joints:
            self.parents[place] = above
        if body.choice("mocap", "false", "true") == "true":
            self.unread.add("motion of mocap bodies", name)
        carried = Joint(name=name, kind="fixed", pose=pose @ Pose(-anchor))
        fixed = self.carriers[place] < 0 and not self.root.settings.has("settotalmass")  # to the world
        lift = body.number("gravcomp", 0) * (not {"spring", "damper"} <= self.disabled)
        inertia = Inertia() if fixed else self.bounded(body, sum((part for part, _ in self.inertias(body)), Inertia()))
        lifted = lift * inertia.mass, lift * inertia.mass * inertia.center
        self.links.append(Link(name, parent, carried, replace(inertia, lift=lifted, drag=self.drag(body, inertia))))
        return place

    def contents(self, body: Element, *tags: str) -> Iterator[tuple[Element, Pose]]:
        """Yield the children of a body with one of the tags, also in frames, with the pose of their frame."""
        pending = [(body, Pose())]
        while pending:
            element, at = pending.pop()
            if element.tag in tags:
                yield element, at
            elif element.tag == "frame" or element is body:
                inner = at @ pose_of(element) if element.tag == "frame" else at
                pending += [(child, inner) for child in reversed(element.children("frame", *tags))]

    def pairs(self) -> Iterator[Pair]:
        """Yield the pairs of geoms of different bodies that may touch, in MuJoCo's rules."""
        if self.disabled & {"contact", "constraint"}:
            return
        written = set[tuple[int, ...]]()
        for pair in self.entries("contact", "pair"):
            first, second = sorted(self.place(pair, key)[0] for key in ("geom1", "geom2"))
            written.add((first, second))
            yield Pair.of_element(pair, self.geoms[first], self.geoms[second])
        excluded = {
            frozenset(self.place(element, key)[0] for key in ("body1", "body2"))
            for element in self.entries("contact", "exclude")
        }
        near = set() if "filterparent" in self.disabled else {*self.parents.items()}
        shapes = [(k, geom.link, self.carriers[geom.link], *geom.types) for k, geom in enumerate(self.geoms)]
        for (i, first, a, *types), (j, second, b, *others) in combinations(shapes, 2):
            filtered = a == b or (min(a, b) >= 0 and not near.isdisjoint({(a, b), (b, a)})) or (i, j) in written
            if not filtered and (types[0] & others[1] or others[0] & types[1]) and {first, second} not in excluded:
                yield Pair.of(self.geoms[i], self.geoms[j])

    def touches(self) -> Iterator[Touch]:
        """Yield the contacts of spheres with planes; other pairs of geoms are listed as unread."""
        pairs, unread = self.pairs(), 0
        adhesive = [geom.element.name for geom in self.geoms if geom.element.number("adhesion", 0)]
        if adhesive and not self.disabled & {"contact", "constraint"}:
            self.unread.add("adhesion of geoms", *adhesive)
        if "contacts" not in self.parts:
            if next(pairs, None):
                self.unread.add("contacts")
            return
        for pair in pairs:
            touches = [*pair.touches(self.links)]
            unread += not touches
            if touches and pair.dimensions > SLIDING:
                self.unread.add("torsional and rolling friction of", touches[0].name)
            yield from touches
        if unread:
            self.unread.add(f"contacts of {unread} pairs of geoms")

    def read_actuators(self) -> None:
        """Add the inertias of rotors and the damping of actuators, which are those of lengths gear q, to joints."""
        places = {link.joint.label: i for i, link in enumerate(self.links) if link.joint.kind in SINGLE}
        for actuator in self.entries("actuator"):
            if not ("actuators" in self.parts or "actuation" in self.disabled):
                self.unread.add("actuators", actuator.name)
            armature, damping = actuator.number("armature", 0, 0), self.coefficients(actuator, "damping")
            if armature or any(damping):
                place = places.get(actuator.text("joint", actuator.text("jointinparent", "")))
                if place is None:
                    actuator.refuse("has armature or damping, which is read of actuators of hinges and slides only")
                joint = self.links[place].joint
                factor = actuator.vector("gear", (1,), range(1, 7))[0] ** 2
                total = _added(joint.damping, [factor * b for b in damping])
                joint = replace(joint, damping=total, armature=joint.armature + factor * armature)
                self.links[place] = replace(self.links[place], joint=joint)

    def read_limits(self, element: Element, part: str, name: str) -> tuple[tuple[float, float] | None, float]:
        """Return the range and the dry friction of a joint or tendon, in the units of the file, that are in force."""
        unlimited = self.disabled & {"limit", "constraint"} or element.text("type", "") == "free"
        limits = None if unlimited else self.bounds(element)
        friction = element.number("frictionloss", 0, 0) * (not self.disabled & {"frictionloss", "constraint"})
        present = {"limits": limits is not None, "friction": friction > 0}
        for what in (what for what in present if present[what] and what not in self.parts):
            self.unread.add(f"{PARTS[what]} of {part}", name)
        return limits if "limits" in self.parts else None, friction if "friction" in self.parts else 0.0

    def bounds(self, element: Element, prefix: str = "", inherited: Sequence[float] = (0.0, 0.0)) -> Range:
        """Return the attribute ``range`` with a prefix, by default the inherited one, if it is in force."""
        limited = element.choice(f"{prefix}limited", "auto", "true", "false")
        low, high = map(float, element.vector(f"{prefix}range", inherited, (2,)))
        if limited == "true" and not low < high and element.text("type", "") != "ball":
            element.refuse(f"is limited to {prefix}range='{low:g} {high:g}': the second number must be larger")
        if limited == "auto" and (low or high) and element.settings.choice("autolimits", "true", "false") == "false":
            element.refuse(f"has {prefix}range without {prefix}limited, which autolimits='false' requires: give it")
        return (low, high) if limited == "true" or (limited == "auto" and low < high) else None

    def actuators(self, tendons: Sequence[Tendon]) -> list[Actuator]:
        """Return the actuators, if they are read."""
        acting: list[Actuator] = []
        elements = [*self.entries("actuator")] if "actuators" in self.parts and "actuation" not in self.disabled else []
        names = {name: "" for element in elements if (name := element.node.get("name"))}
        targets = [next(((x, element.text(x)) for x in ACTED if element.has(x)), ("", "")) for element in elements]
        paths = {tendon.name: tendon for tendon in tendons}
        joints = {link.joint.label: link.joint for link in self.links if link.joint.kind != "fixed"}
        rated = {label for x, (_, label) in zip(elements, targets, strict=True) if damping_ratio(x)}
        inverses = self.inverses(self.singles.keys() & rated)
        for element, target in zip(elements, targets, strict=True):
            gear = np.append(element.vector("gear", (1,), range(1, 7)), np.zeros(5))[:6]
            motion = self.acted_on(element, target[0], gear, {"tendon": paths, **dict.fromkeys(JOINTED, joints)})
            pull, several = paths[target[1]].pull if target[0] == "tendon" else None, targets.count(target) > 1
            if pull and several and not pull[0] < 0 < pull[1]:
                element.refuse("is one of several on a tendon with actuatorfrcrange, which must contain 0")
            law = activation_of(element)
            controls = self.controls(element, law, self.inherited(element, target))
            forces = clamped(self.bounds(element, "force"), None if several else pull, 1.0)
            inverse = inverses.get(target[1]) if target[0] in JOINTED else None
            actuator = actuator_of(self.links, element, motion, gear[0], names, controls, forces, inverse)
            names[actuator[0]] = actuator[1]
            if element.number("group", 0) in self.idle:
                actuator = *actuator[:-1], (S.Zero, S.Zero)
            if law != "none":
                self.activated.add(actuator[1])
                self.unread.add(f"the law of activations (dyntype '{law}'), which are the inputs, of", actuator[0])
            acting.append(actuator)
        return in_shared_ranges(acting, targets, tendons)

    def inverses(self, joints: Collection[str]) -> dict[str, float]:
        """Return the mean diagonals of M^-1 at the reference over the rates of joints."""
        if not joints:
            return {}
        return {self.links[k].joint.label: m for k, m in mean_inverses(self.completed(), joints)}

    def acted_on(self, element: Element, kind: str, gear: Vector, parts: Mapping[str, Mapping[str, Any]]) -> Motion:
        """Return the motion of the part of a kind on which an actuator acts."""
        places = [key for key in (*ACTED, "refsite") if element.has(key)]
        if places != OF_SITES and len(places) > 1:
            element.refuse(f"acts on {' and '.join(places)}: give one, or a site and its refsite")
        if not kind:
            element.refuse("acts on no joint, tendon or site, which are the parts that are read")
        if kind == "site":
            return motion_of_sites(self.links, [self.place(element, key) for key in places], gear)
        part = element.named_by(kind, kind.removesuffix("inparent"), parts[kind])
        return motion_of(self.links, part, gear, kind == "jointinparent")

    def controls(self, element: Element, law: str, inherited: Sequence[float]) -> Range:
        """Return the range of the input of an actuator: of its control, or of its activation by a law."""
        controls = self.bounds(element, "ctrl", inherited)
        activations = self.bounds(element, "act", inherited if law == "integrator" else (0, 0))
        if law == "none" and activations:
            element.refuse("has actrange, the range of an activation, which its dyntype does not have")
        unclamped = law == "integrator" or "clampctrl" in self.disabled
        return clamped(None if unclamped else controls, activations, 1.0)

    def inherited(self, element: Element, target: tuple[str, str]) -> Sequence[float]:
        """Return the range of a control by ``inheritrange``, this multiple of that of its part; (0, 0) without."""
        if not (share := element.number("inheritrange", 0, 0)) or not is_servo(element):
            return 0.0, 0.0
        parts = {(kind, label): self.joints[label] for kind in JOINTED for label in self.singles}
        parts |= {("tendon", tendon.name): tendon for tendon in self.entries("tendon")}
        low, high = parts[target].vector("range", (0, 0), (2,)) if target in parts else (0.0, 0.0)
        if low == high or element.has("ctrlrange") or element.has("actrange"):
            element.refuse("has an inheritrange, which is read of parts with a range, without ctrlrange and actrange")
        middle, radius = (low + high) / 2, (high - low) / 2 * share
        turns = target[0] in JOINTED and self.singles[target[1]].kind == "hinge"
        unit = unit_of_angles(element) if turns else 1.0
        return (middle - radius) * unit, (middle + radius) * unit

    def keyframes(self, controls: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield names and numbers of keyframes."""
        sizes = [{"free": 7, "ball": 4, "fixed": 0}.get(link.joint.kind, 1) for link in self.links]
        lengths = {"qpos": sum(sizes), "qvel": sum(size - (size > 1) for size in sizes)}
        names = set[str]()
        for number, key in enumerate(self.entries("keyframe")):
            if (name := key.node.get("name") or str(number)) in names:
                key.refuse("is the second keyframe of this name: rename one")
            names.add(name)
            values: dict[str, Any] = {x: key.vector(x, (), [size]).tolist() for x, size in lengths.items()}
            states = [name for name in controls if name in self.activated]
            for inputs, attribute in ((controls, "ctrl"), (states, "act")):
                if inputs:
                    numbers = key.vector(attribute, (0,) * len(inputs), [len(inputs)])
                    values |= zip(inputs, numbers.tolist(), strict=True)
            yield name, values

    def equalities(self) -> Iterator[Element]:
        """Yield the equalities that are active."""
        for equality in [] if self.disabled & {"equality", "constraint"} else self.entries("equality"):
            if equality.choice("active", "true", "false") == "true":
                yield equality

    def closures(self, tendons: Sequence[Tendon]) -> Iterator[Closure | Coupling]:
        """Yield the equalities that are active; their softness is not read.

        https://mujoco.readthedocs.io/en/stable/XMLreference.html#equality
        """
        paths = {tendon.name: tendon for tendon in tendons}
        for equality in self.equalities():
            if equality.tag in ("joint", "tendon"):
                yield self.coupling(equality, paths)
            elif equality.tag in ("connect", "weld"):
                yield self.closure(equality)
            else:
                equality.refuse("is not read: remove it or write a constraint")

    def place(self, element: Element, key: str) -> tuple[int, Pose]:
        """Return the place of the body, site or geom that an attribute names."""
        kind = key.rstrip("12").removeprefix("ref")
        return element.named_by(key, kind, self.places[kind], "world" if key == "body2" else None)

    def closure(self, equality: Element) -> Closure:
        """Return a connection or weld of two sites, or of bodies, by default as in the reference configuration."""
        kind = "site" if equality.has("site1") else "body"
        mixed = [key for key in ("body1", "body2", "anchor", "relpose") if equality.has(key)]
        if mixed and kind == "site":
            equality.refuse(f"has site1 and {mixed[0]}: sites or bodies are needed")
        (first, at), (second, end) = (self.place(equality, f"{kind}{k}") for k in (1, 2))
        if first == second:
            equality.refuse("is between a body and itself")
        turning = equality.tag == "weld"
        if turning and equality.number("torquescale", 1) <= 0:
            equality.refuse("has a torquescale that is not > 0: use a <connect>")
        if kind == "body" and turning:
            pose = equality.vector("relpose", (0, 1, 0, 0, 0, 0, 0), (7,))
            if pose[3:].any():
                at = Pose(pose[:3], of_quaternion(equality, pose[3:]))
            else:
                at = at_reference(self.links, first).inverse @ at_reference(self.links, second)
        elif kind == "body":
            at = Pose(equality.vector("anchor"))
            end = at_reference(self.links, second).inverse @ at_reference(self.links, first) @ at
        return Closure(((first, at), (second, end)), turning)

    def coupling(self, equality: Element, paths: Mapping[str, Tendon]) -> Coupling:
        """Return a relation between two joints or tendons, or the fixed value of one."""
        first, second = (f"{equality.tag}{k}" for k in (1, 2))
        length = self.length(equality, first, paths)
        other = self.length(equality, second, paths) if equality.text(second, "") else None
        if length == other:
            equality.refuse(f"is between {equality.tag} '{equality.text(first)}' and itself")
        written = equality.vector("polycoef", (0,), range(1, 6))
        polynomial = (*written, *(0, 1, 0, 0, 0)[len(written) :])  # those that are not written keep their defaults
        coefficients = tuple(map(float, polynomial[:1] if other is None else polynomial))
        zeros = [reference_length(self.links, S.Zero if part is None else part) for part in (length, other)]
        return Coupling(length, other, coefficients, *zeros)

    def length(self, element: Element, key: str, paths: Mapping[str, Tendon]) -> Expr:
        """Return the length of the joint or tendon that an attribute names."""
        if key.startswith("joint"):
            return symbol(self.single(element, key).name)
        return length_of(self.links, element.named_by(key, "tendon", paths))

    def single(self, element: Element, key: str) -> Joint:
        """Return the hinge or slide that an attribute names."""
        return element.named_by(key, "hinge or slide", self.singles)

    def joint(self, joint: Element, name: str, pose: Pose, frame: Pose, parent: int) -> Joint:
        """Return a joint of a link, whose pose is that in its parent."""
        bare = joint.tag == "freejoint"
        kind = "free" if bare else joint.choice("type", "hinge", "slide", "ball", "free")
        if kind == "free" and parent >= 0:
            joint.refuse("is free, but its body is inside another body")
        turn = unit_of_angles(joint) if kind in ("hinge", "ball") else 1.0
        rest, zero = (joint.number(key, 0) for key in ("springref", "ref"))
        if joint.choice("actuatorgravcomp", "false", "true") == "true":
            self.compensating.append(joint)
        limits, friction = self.read_limits(joint, "joints", name)
        stiffness, damping = (self.coefficients(joint, key) for key in ("stiffness", "damping"))
        if (response := joint.vector("springdamper", (0, 0), (2,))).min() > 0:
            self.responses[name], damping = response, (0.0, *damping[1:])
        return Joint(
            name=name,
            kind=kind,
            pose=pose,
            axis=times(frame.rotation, joint.unit("axis", (0, 0, 1))) if kind in SINGLE else np.zeros(3),
            damping=damping,
            stiffness=stiffness,
            rest=rest * turn,
            armature=joint.number("armature", 0, 0),
            zero=zero * turn if kind in SINGLE else 0.0,
            limits=limits and checked_limits(joint, limits[0] * turn, limits[1] * turn),
            dry_friction=friction,
            pull=self.bounds(joint, "actuatorfrc") if kind in SINGLE else None,
        )

    def coefficients(self, element: Element, key: str) -> tuple[float, ...]:
        """Return the stiffness or damping of an element by power; none where a flag disables it."""
        values = element.vector(key, (0,), (1, 2, 3))
        if key == "damping" and values.min() < 0:
            element.refuse(f"has the {key} {element.text(key)}, which must not be < 0")
        disabled = {"stiffness": "spring", "damping": "damper"}[key] in self.disabled
        return () if disabled else tuple(map(float, values))

    def inertias(self, body: Element) -> list[tuple[Inertia, Vector]]:
        """Return the inertial of a body or, as ``inertiafromgeom`` says, its geoms: inertias and rotations."""
        rule = body.settings.choice("inertiafromgeom", "auto", "true", "false")
        inertials = [*self.contents(body, "inertial")]
        if len(inertials) > 1:
            inertials[1][0].refuse("is the second of its body: one is allowed")
        if rule == "true" or (rule == "auto" and not inertials):
            low, high = body.settings.vector("inertiagrouprange", (0, 5), (2,))
            geoms = (x for x in self.contents(body, "geom") if low <= x[0].number("group", 0) <= high)
            parts = [(inertia_of_geom(geom, self.meshes), geom, frame) for geom, frame in geoms]
        else:
            parts = [(self.inertial(element), element, frame) for element, frame in inertials]
        return [(inertia.seen_from(frame), (frame @ pose_of(part)).rotation) for inertia, part, frame in parts]

    @staticmethod
    def bounded(body: Element, inertia: Inertia) -> Inertia:
        """Return an inertia with the smallest mass and moments of the compiler, and balanced if no body has it."""
        low, least = (body.settings.number(key, 0, 0) for key in ("boundmass", "boundinertia"))
        balanced = body.settings.choice("balanceinertia", "false", "true") == "true"
        moments, axes = np.linalg.eigh(inertia.matrix)
        bounds = np.maximum(moments, least)
        if balanced and bounds[2] > bounds[0] + bounds[1]:
            bounds[:] = bounds.mean()
        same = (bounds == moments).all()
        return replace(inertia, mass=max(inertia.mass, low), matrix=inertia.matrix if same else axes * bounds @ axes.T)

    def inertial(self, inertial: Element) -> Inertia:
        inertial.vector("pos")
        if inertial.has("fullinertia"):
            if others := [key for key in ("diaginertia", *ORIENTATIONS) if inertial.has(key)]:
                inertial.refuse(f"has fullinertia and {others[0]}: one is needed")
            xx, yy, zz, xy, xz, yz = inertial.vector("fullinertia", sizes=(6,))
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            matrix = np.diag(inertial.vector("diaginertia", (0, 0, 0)))
        return Inertia(inertial.number("mass", least=0), matrix=matrix).seen_from(pose_of(inertial))

    def drag(self, body: Element, inertia: Inertia) -> tuple[tuple[Pose, Any], ...]:
        """Return the drag of the ellipsoids of a body in a medium; without any, of the box of its mass and inertia."""
        if not any(self.medium) or inertia.mass < NO_MASS:
            return ()
        ellipsoids: list[tuple[Pose, Any]] = []
        for geom, frame in self.contents(body, "geom"):
            if geom.choice("fluidshape", "none", "ellipsoid") == "ellipsoid":
                if (shape := shape_of(geom)) not in SHAPES or geom.has("mesh"):
                    geom.refuse(f"is a {shape} with fluidshape='ellipsoid', which is read of {', '.join(SHAPES)}")
                size = size_of(geom, shape)
                r = size[[0, 0, -1] if len(size) < 3 else [0, 1, 2]] + (shape == "capsule") * size[0] * AXES["z"]
                coefficients = geom.vector("fluidcoef", (0.5, 0.25, 1.5, 1, 1), (5,))
                ellipsoids.append((frame @ pose_of(geom), partial(ellipsoid, r, coefficients, *self.medium)))
        if ellipsoids:
            return tuple(ellipsoids)
        heavy = [turn for part, turn in self.inertias(body) if part.mass > LIGHT]
        turn = heavy[0] if len(heavy) == 1 else np.eye(3)
        turn = turn @ principal_axes(turn.T @ inertia.matrix @ turn)
        moments = np.diag(turn.T @ inertia.matrix @ turn)
        b = np.sqrt(6 * np.maximum(moments.sum() - 2 * moments, NO_MASS) / inertia.mass)
        return ((Pose(inertia.center, turn), partial(box, b, *self.medium)),)

    def completed(self) -> list[Link]:
        """Return the links, with inertias scaled to ``settotalmass``, and with the springs of ``springdamper``.

        With the time constant t, the damping ratio z, and the mean m of the diagonal of M^-1 in the reference
        configuration over the rates of a joint, the stiffness is 1/(m t^2 z^2) and the damping 2/(m t).
        """
        total, links = self.root.settings.number("settotalmass", -1), self.links
        masses = sum(link.inertia.mass for link in links)
        if total > 0 and masses:
            links = [replace(link, inertia=link.inertia.scaled(total / masses)) for link in links]
        on = [flag not in self.disabled for flag in ("spring", "damper")]
        for k, m in mean_inverses(links, self.responses):
            joint, (t, z) = links[k].joint, self.responses[links[k].joint.label]
            stiffness = on[0] / (m * t**2 * z**2), *joint.stiffness[1:]
            damping = _added(joint.damping, [2 * on[1] / (m * t)])
            links[k] = replace(links[k], joint=replace(joint, stiffness=stiffness, damping=damping))
        return links


def _added(first: Sequence[float], second: Sequence[float]) -> tuple[float, ...]:
    """Return the sum of coefficients by power."""
    return tuple(a + b for a, b in zip_longest(first, second, fillvalue=0.0))
