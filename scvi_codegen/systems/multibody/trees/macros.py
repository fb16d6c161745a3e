"""Macros of MJCF, which are written out: ``<replicate>``, and ``<attach>`` of bodies, frames and whole models.

A copy has names with a prefix or suffix, and so have copies of the elements outside of the tree that refer only to its
inside; tendons may refer to other parts of the same model as well. Elements that refer to the inside of a
``<replicate>`` exist as such copies only. https://mujoco.readthedocs.io/en/stable/XMLreference.html#replicate
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from xml.etree.ElementTree import Element as Node
from xml.etree.ElementTree import SubElement

import numpy as np

from scvi_codegen.common.errors import closest
from scvi_codegen.systems.multibody.trees.document import Element
from scvi_codegen.systems.multibody.trees.tree import Pose

MACROS, SECTIONS = ("replicate", "attach"), ("tendon", "equality", "actuator", "contact")
MOST = 10_000
"""Largest number of elements that the macros of a document make."""
AFFIXES = re.compile(r"^(ref|slider|crank|side)(?=site)|inparent$|[12]$")
"""What attributes are called beside the kind of element that they name: ``jointinparent``, ``body1``."""
Pair = tuple[str, str]
"""Kind and name of an element; prefix and suffix."""


class Macros:
    """Macros of a document with explicit attributes, which are replaced by frames with copies.

    Args:
        root: document.
        models: other documents by name, without macros.
        pose: function that returns the pose of a frame.
    """

    def __init__(self, root: Element, models: Mapping[str, Element], pose: Callable[[Element], Pose]) -> None:
        self.root, self.models, self.pose, self.size = root, models, pose, 0
        for macro, outer in [*self.macros()]:
            frames = self.replicas(macro) if macro.tag == "replicate" else [self.attached(macro)]
            at = [*outer].index(macro.node)
            outer[at : at + 1] = [frame.node for frame in frames]

    def macros(self) -> Iterator[tuple[Element, Node]]:
        """Yield the macros and the nodes around them in order, the inner ones first."""
        pending = [(world.node, self.root.node, False) for world in reversed(self.root.children("worldbody"))]
        while pending:
            node, outer, inner_done = pending.pop()
            if inner_done:
                yield Element(node, self.root.places), outer
            else:
                pending += [(node, outer, True)] * (node.tag in MACROS)
                pending += [(child, node, False) for child in reversed(node)]

    def replicas(self, macro: Element) -> list[Element]:
        """Return the frames of a ``<replicate>``, at x_(i+1) = x_i + R(i euler) offset."""
        count, euler, position = macro.number("count", least=1), macro.vector("euler", (0, 0, 0)), np.zeros(3)
        if count % 1:
            macro.refuse(f"has count='{macro.text('count')}', which must be a whole number")
        frames, inside, referring = list[Element](), set[Pair](), self.referring(self.root)
        for i in range(int(count)):
            affix = "", f"{macro.text('sep', '')}{i:0{len(str(int(count)))}}"
            frames.append(self.copies(macro, macro.children(), affix, inside, referring, pos=position, euler=i * euler))
            position = position + self.pose(frames[-1]).rotation @ macro.vector("offset", (0, 0, 0))
        for section in self.root.children(*SECTIONS):
            for element in section.children():
                if not inside.isdisjoint(_references(element)):
                    section.node.remove(element.node)
        return frames

    def attached(self, macro: Element) -> Element:
        """Return the frame of an ``<attach>``."""
        kinds, models = [kind for kind in ("body", "frame") if macro.has(kind)], {"": self.root, **self.models}
        if len(kinds) > 1 or not (kinds or macro.has("model")):
            macro.refuse("needs a model, a body or a frame, and not both of these")
        if (key := macro.text("model", "")) not in models:
            macro.refuse(f"names the model '{key}', which is not in <asset>{closest(key, models)}")
        worlds = models[key].children("worldbody")
        parts = [part for world in worlds for part in world.children()]
        for kind in kinds:
            nodes = {node.get("name", ""): node for world in worlds for node in world.node.iter(kind)}
            parts = [Element(macro.among(kind, kind, nodes), models[key].places)]
        return self.copies(macro, parts, (macro.text("prefix"), ""), set(), self.referring(models[key]))

    def referring(self, source: Element) -> list[tuple[str, bool, Element]]:
        """Return the section of each element outside of the tree, whether one inner reference suffices, the element."""
        sections = [section for tag in SECTIONS for section in source.children(tag)]
        own = source.node is self.root.node
        return [(part.tag, own and part.tag == "tendon", element) for part in sections for element in part.children()]

    def copies(
        self,
        macro: Element,
        parts: list[Element],
        affix: Pair,
        inside: set[Pair],
        referring: list[tuple[str, bool, Element]],
        **at: Iterable[float],
    ) -> Element:
        """Return a frame with copies of parts, and add their names to ``inside``; copy what refers to them."""
        node = Node("frame", {key: " ".join(map(repr, map(float, x))) for key, x in at.items()})
        self.root.places[node] = self.root.places[macro.node]
        inside |= {(old.tag.removeprefix("free"), old.get("name", "")) for part in parts for old in part.node.iter()}
        self.size += 1 + sum(1 for part in parts for _ in part.node.iter())
        if self.size > MOST:
            macro.refuse(f"makes more than {MOST} elements, with other macros: reduce its count")
        node.extend([self.copied(part, affix, inside) for part in parts])
        for section, loose, element in referring:
            within = [name in inside for name in _references(element)]
            if any(within) and (loose or all(within)):
                SubElement(self.root.node, section).append(self.copied(element, affix, inside))
                inside.add((section, element.node.get("name", "")))
        return Element(node, self.root.places)

    def copied(self, element: Element, affix: Pair, inside: set[Pair]) -> Node:
        """Return a copy with a prefix and suffix of its name and of references to the inside."""
        copies: dict[Node, Node] = {}
        for old in element.node.iter():
            if old.tag in MACROS:
                Element(old, element.places).refuse("is attached before it is written out: write it further up")
            new = {k: x.join(affix) for k, x in old.items() if x and (k == "name" or (AFFIXES.sub("", k), x) in inside)}
            copies[old] = Node(old.tag, {**old.attrib, **new})
            self.root.places[copies[old]] = element.places[old]
        for old, copy in copies.items():
            copy.extend([copies[child] for child in old])
        return copies[element.node]


def _references(element: Element) -> list[Pair]:
    """Return the kinds and names of the elements that one and its children name."""
    keys = ((AFFIXES.sub("", key), value) for node in element.node.iter() for key, value in node.items() if value)
    return [(kind, name) for kind, name in keys if kind in ("body", "joint", "geom", "site", "tendon")]
