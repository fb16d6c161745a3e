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
AFFIXES = re.compile(r"^(ref|slider|crank|side)(?=site)|inparent$|[12]$")
"""What attributes are called beside the kind of element that they name: ``jointinparent``, ``body1``."""
Name = tuple[str, str]
"""Kind and name of an element."""


def write_out(root: Element, models: Mapping[str, Element], pose: Callable[[Element], Pose]) -> None:
    """Replace macros by frames with copies.

    Args:
        root: document, whose attributes are explicit.
        models: other documents by name, without macros.
        pose: function that returns the pose of a frame.
    """
    for macro, outer in [*_macros(root)]:
        frames = _replicas(root, macro, pose) if macro.tag == "replicate" else [_attached(root, macro, models)]
        at = [*outer].index(macro.node)
        outer[at : at + 1] = [frame.node for frame in frames]


def _macros(root: Element) -> Iterator[tuple[Element, Node]]:
    """Yield the macros and the nodes around them in order, the inner ones first."""
    pending = [(world.node, root.node, False) for world in reversed(root.children("worldbody"))]
    while pending:
        node, outer, inner_done = pending.pop()
        if inner_done:
            yield Element(node, root.places), outer
            continue
        pending += [(node, outer, True)] if node.tag in MACROS else []
        pending += [(child, node, False) for child in reversed(node)]


def _replicas(root: Element, macro: Element, pose: Callable[[Element], Pose]) -> list[Element]:
    """Return the frames of a ``<replicate>``, at x_(i+1) = x_i + R(i euler) offset."""
    count, euler, position = macro.number("count", least=1), macro.vector("euler", (0, 0, 0)), np.zeros(3)
    if count % 1:
        macro.refuse(f"has count='{macro.text('count')}', which must be a whole number")
    frames, inside = [], set[Name]()
    for i in range(int(count)):
        affix = "", f"{macro.text('sep', '')}{i:0{len(str(int(count)))}}"
        frames.append(_copies(root, macro, root, macro.children(), affix, inside, pos=position, euler=i * euler))
        position = position + pose(frames[-1]).rotation @ macro.vector("offset", (0, 0, 0))
    for section in root.children(*SECTIONS):
        for element in section.children():
            if not inside.isdisjoint(_references(element)):
                section.node.remove(element.node)
    return frames


def _attached(root: Element, macro: Element, models: Mapping[str, Element]) -> Element:
    """Return the frame of an ``<attach>``."""
    kinds, source = [kind for kind in ("body", "frame") if macro.has(kind)], root
    if len(kinds) > 1 or not (kinds or macro.has("model")):
        macro.refuse("needs a model, a body or a frame, and not both of these")
    if macro.has("model"):
        if (key := macro.text("model")) not in models:
            macro.refuse(f"names the model '{key}', which is not in <asset>{closest(key, models)}")
        source = models[key]
    worlds = source.children("worldbody")
    parts = [part for world in worlds for part in world.children()]
    for kind in kinds:
        nodes = {node.get("name", ""): node for world in worlds for node in world.node.iter(kind)}
        if (key := macro.text(kind)) not in nodes:
            macro.refuse(f"names the {kind} '{key}', which does not exist{closest(key, nodes)}")
        parts = [Element(nodes[key], source.places)]
    return _copies(root, macro, source, parts, (macro.text("prefix"), ""), set())


def _copies(
    root: Element,
    macro: Element,
    source: Element,
    parts: Iterable[Element],
    affix: tuple[str, str],
    inside: set[Name],
    **vectors: Iterable[float],
) -> Element:
    """Return a frame with copies of parts, whose names are added to ``inside``; add copies of what refers to them."""
    frame = Element(Node("frame", {key: " ".join(map(repr, map(float, x))) for key, x in vectors.items()}), root.places)
    root.places[frame.node] = root.places[macro.node]
    inside |= {(node.tag.removeprefix("free"), node.get("name", "")) for part in parts for node in part.node.iter()}
    frame.node.extend([_copied(root, part, affix, inside) for part in parts])
    for section in (section for tag in SECTIONS for section in source.children(tag)):
        for element in section.children():
            within = [name in inside for name in _references(element)]
            if any(within) and (all(within) or (section.tag == "tendon" and source is root)):
                SubElement(root.node, section.tag).append(_copied(root, element, affix, inside))
                inside.add((section.tag, element.node.get("name", "")))
    return frame


def _copied(root: Element, element: Element, affix: tuple[str, str], inside: set[Name]) -> Node:
    """Return a copy with a prefix and suffix of its name and of references to the inside."""
    copies: dict[Node, Node] = {}
    for old in element.node.iter():
        if old.tag in MACROS:
            Element(old, element.places).refuse("is attached before it is written out: write it further up")
        kinds = {key: AFFIXES.sub("", key) for key in old.attrib}
        changed = {key: old.attrib[key].join(affix) for key, kind in kinds.items() if (kind, old.attrib[key]) in inside}
        name = {"name": old.attrib["name"].join(affix)} if old.get("name") else {}
        copies[old] = Node(old.tag, {**old.attrib, **changed, **name})
        root.places[copies[old]] = element.places[old]
    for old, new in copies.items():
        new.extend([copies[child] for child in old])
    return copies[element.node]


def _references(element: Element) -> list[Name]:
    """Return the kinds and names of the elements that one and its children name."""
    keys = ((AFFIXES.sub("", key), value) for node in element.node.iter() for key, value in node.items() if value)
    return [(kind, name) for kind, name in keys if kind in ("body", "joint", "geom", "site", "tendon")]
