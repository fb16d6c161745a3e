"""Macros of MJCF, which are written out: ``<replicate>``, and ``<attach>`` of bodies, frames and whole models.

A copy has names with a prefix or suffix, and so have copies of the elements outside of the tree (equalities, tendons,
actuators, contacts) all references of which exist with it; a tendon needs one of them, and keeps the others. Elements
that refer to the inside of a ``<replicate>`` exist as such copies only.

https://mujoco.readthedocs.io/en/stable/XMLreference.html#replicate and #body-attach
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from xml.etree import ElementTree

import numpy as np

from scvi_codegen.common.errors import closest
from scvi_codegen.systems.multibody.trees.document import Element
from scvi_codegen.systems.multibody.trees.tree import Pose

KINDS = {
    "body": "body body1 body2",
    "joint": "joint joint1 joint2 jointinparent",
    "geom": "geom geom1 geom2",
    "site": "site site1 site2 refsite slidersite cranksite sidesite",
    "tendon": "tendon tendon1 tendon2",
}
REFERENCES = {key: kind for kind, keys in KINDS.items() for key in keys.split()}
"""Kind of the element that an attribute names."""
TAGS = {"freejoint": "joint", "spatial": "tendon", "fixed": "tendon"}
MACROS = ("replicate", "attach")
SECTIONS = ("tendon", "equality", "actuator", "contact")
MOST = 100_000
"""Largest number of replicas."""
Node = ElementTree.Element
Name = tuple[str, str]
Affix = tuple[str, str]
"""Kind and name of an element; prefix and suffix."""


class Macros:
    """Macros of a document, which are replaced by frames with copies.

    Args:
        root: document, whose attributes are explicit.
        read: function that returns the document of a file without macros.
        pose: function that returns the pose of a frame.
    """

    def __init__(self, root: Element, read: Callable[[Element], Element], pose: Callable[[Element], Pose]) -> None:
        self.root, self.read, self.pose = root, read, pose
        self.names = {*_names(node for part in root.children("worldbody", "tendon") for node in part.node.iter())}
        self.models: dict[str, Element] = {}
        for macro, outer in [*self.macros()]:
            frames = self.replicas(macro) if macro.tag == "replicate" else [self.attached(macro)]
            at = [*outer].index(macro.node)
            outer[at : at + 1] = frames

    def macros(self) -> Iterator[tuple[Element, Node]]:
        """Yield the macros and the nodes around them in order, the inner ones first."""
        pending = [(world.node, self.root.node, False) for world in reversed(self.root.children("worldbody"))]
        while pending:
            node, outer, inner_done = pending.pop()
            if inner_done:
                yield Element(node, self.root.places), outer
                continue
            pending += [(node, outer, True)] if node.tag in MACROS else []
            pending += [(child, node, False) for child in reversed(node)]

    def replicas(self, macro: Element) -> list[Node]:
        """Return the frames of a ``<replicate>``, at x_(i+1) = x_i + R(i euler) offset."""
        count, euler, position = macro.number("count", least=1), macro.vector("euler", (0, 0, 0)), np.zeros(3)
        if count % 1 or count > MOST:
            macro.refuse(f"has count='{macro.text('count')}', which must be a whole number, at most {MOST}")
        frames, inside = [], {*_names(macro.node.iter())}
        sections = _sections(self.root)
        for i in range(int(count)):
            frame = self.frame(macro, pos=position, euler=i * euler)
            affix = "", f"{macro.text('sep', '')}{i:0{len(str(int(count)))}}"
            self.place(frame, macro.children(), ("name",), affix)
            self.refer(sections, affix)
            frames.append(frame.node)
            position = position + self.pose(frame).rotation @ macro.vector("offset", (0, 0, 0))
        for section, elements in sections:
            for element in elements:
                if not inside.isdisjoint(chain(*map(_references, (element, *element.children())))):
                    section.node.remove(element.node)
        self.names -= inside
        return frames

    def attached(self, macro: Element) -> Node:
        """Return the frame of an ``<attach>``."""
        other, affix = macro.has("model"), (macro.text("prefix"), "")
        kinds = [kind for kind in ("body", "frame") if macro.has(kind)]
        if len(kinds) > 1 or not (kinds or other):
            macro.refuse("needs a model, a body or a frame, and not both of these")
        source = self.model(macro) if other else self.root
        worlds = source.children("worldbody")
        parts = [part for world in worlds for part in world.children()]
        for kind in kinds:
            nodes = {node.get("name", ""): node for world in worlds for node in world.node.iter(kind)}
            if (key := macro.text(kind)) not in nodes:
                macro.refuse(f"names the {kind} '{key}', which does not exist{closest(key, nodes)}")
            parts = [Element(nodes[key], source.places)]
        frame = self.frame(macro)
        self.place(frame, parts, ("name", "mesh") if other else ("name",), affix)
        for assets in source.children("asset") if other else ():
            section = ElementTree.SubElement(self.root.node, "asset")
            self.place(Element(section, self.root.places), assets.children("mesh"), ("name",), affix)
        self.refer(_sections(source), affix)
        return frame.node

    def model(self, macro: Element) -> Element:
        """Return the document that an ``<attach>`` names."""
        assets = [model for section in self.root.children("asset") for model in section.children("model")]
        for asset in assets:
            if not asset.has("name"):
                asset.node.set("name", self.read(asset).node.get("model", ""))
        documents, key = {asset.name: asset for asset in assets}, macro.text("model")
        if key not in documents:
            macro.refuse(f"names the model '{key}', which is not in <asset>{closest(key, documents)}")
        if key not in self.models:
            self.models[key] = self.read(documents[key])
            self.root.places.update(self.models[key].places)
        return self.models[key]

    def frame(self, macro: Element, **vectors: Iterable[float]) -> Element:
        """Return a frame in place of a macro."""
        node = Node("frame", {key: " ".join(map(repr, map(float, x))) for key, x in vectors.items()})
        self.root.places[node] = self.root.places[macro.node]
        return Element(node, self.root.places)

    def place(self, outer: Element, elements: Iterable[Element], keys: Iterable[str], affix: Affix) -> None:
        """Append copies, in which the attributes ``keys`` have a prefix and suffix."""
        pending = [(outer.node, element) for element in elements]
        for into, element in pending:
            if element.tag in MACROS:
                element.refuse("is attached before it is written out: write it before the <attach>")
            copied = self.copied(into, element, keys, affix)
            self.names |= {*_names([copied])}
            pending += [(copied, child) for child in element.children()]

    def refer(self, sections: Iterable[tuple[Element, list[Element]]], affix: Affix) -> None:
        """Add copies of the elements whose references, of tendons one of them, exist with a prefix and suffix."""
        for section, elements in sections:
            into = Node(section.tag)
            for element in elements:
                parts = [(part, self.exists(part, affix)) for part in element.children()]
                if not (self.exists(element, affix) or any(inner for _, inner in parts)):
                    continue
                if all(inner or not _references(part) or self.exists(part, ("", "")) for part, inner in parts):
                    copied = self.copied(into, element, ("name", *REFERENCES), affix)
                    self.names |= {*_names([copied])}
                    for part, inner in parts:
                        self.copied(copied, part, REFERENCES, affix if inner else ("", ""))
            self.root.node.extend([into] if len(into) else [])

    def exists(self, element: Element, affix: Affix) -> bool:
        """Return whether all that an element names exists with a prefix and suffix."""
        references = _references(element)
        return bool(references) and all((kind, name.join(affix)) in self.names for kind, name in references)

    def copied(self, into: Node, element: Element, keys: Iterable[str], affix: Affix) -> Node:
        """Return a copy without children, which is appended to a node."""
        changed = {key: element.text(key).join(affix) for key in keys if element.node.get(key)}
        node = ElementTree.SubElement(into, element.tag, {**element.node.attrib, **changed})
        self.root.places[node] = self.root.places[element.node]
        return node


def _sections(document: Element) -> list[tuple[Element, list[Element]]]:
    """Return the sections whose elements name others, with these."""
    return [(section, section.children()) for tag in SECTIONS for section in document.children(tag)]


def _names(nodes: Iterable[Node]) -> Iterator[Name]:
    """Yield the kinds and names of nodes."""
    return ((TAGS.get(node.tag, node.tag), node.get("name", "")) for node in nodes)


def _references(element: Element) -> list[Name]:
    """Return kinds and names of the elements that the attributes of one name."""
    return [(kind, element.text(key)) for key, kind in REFERENCES.items() if element.node.get(key)]
