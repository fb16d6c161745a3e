"""Documents of MJCF: included files, attributes of classes, and macros, which are written out.

Macros are ``<replicate>``, and ``<attach>`` of bodies, frames and whole models. A copy has names with a prefix or
suffix, and so have copies of the elements outside of the tree that refer only to its inside; tendons may refer to
other parts of the same model as well. Elements that refer to the inside of a ``<replicate>`` exist as such copies only.
https://mujoco.readthedocs.io/en/stable/XMLreference.html#replicate
"""

import re
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element as Node
from xml.etree.ElementTree import SubElement

import numpy as np

from scvi_codegen.common.errors import closest
from scvi_codegen.extras.robots.trees.actuators import as_general, inherited_by
from scvi_codegen.extras.robots.trees.document import Element, root_of
from scvi_codegen.extras.robots.trees.schema import MJCF
from scvi_codegen.extras.robots.trees.shapes import ORIENTATIONS, pose_of
from scvi_codegen.extras.robots.trees.tree import times

Defaults = dict[str, dict[str, str]]
"""Attributes by kind of element."""
MACROS, SECTIONS = ("replicate", "attach"), ("tendon", "equality", "actuator", "contact")
MOST = 10_000
"""Largest number of elements that the macros of a document make."""
AFFIXES = re.compile(r"^(ref|slider|crank|side)(?=site)|inparent$|[12]$")
"""What attributes are called beside the kind of element that they name: ``jointinparent``, ``body1``."""
Names = tuple[str, str]
"""Kind and name of an element; prefix and suffix."""


def document_of(path: Path, around: tuple[Path, ...] = ()) -> Element:
    """Return a document, a part of those ``around``, with included files and explicit attributes, without macros."""
    root, around = root_of(path, "mujoco"), (*around, path.resolve())
    _include(root)
    settings = merged(root, "compiler", root.children("compiler"))
    root.node.insert(0, settings.node)
    root.places.update(settings.places)
    _apply_defaults(root)
    models = {}
    for asset in (model for assets in root.children("asset") for model in assets.children("model")):
        if (file := asset.path(asset.text("file"))).resolve() in around:
            asset.refuse(f"names '{file}', which contains this document")
        model = document_of(file, around)
        models[asset.node.get("name", model.node.get("model", ""))] = model
    Macros(root, models)
    return root


def merged(root: Element, tag: str, parts: list[Element]) -> Element:
    """Return one element with the attributes of several, of which the later ones win."""
    attributes = {key: value for part in parts for key, value in part.node.attrib.items()}
    node = Node(tag, attributes)
    return Element(node, {node: root.places[(parts[0] if parts else root).node]})


def _include(root: Element) -> None:
    """Replace ``<include>`` by the contents of the file.

    Its path is relative to the folder of the main document or, where it does not exist there, of the including one.
    """
    read, pending = {Path(root.file).resolve()}, [root]
    while pending:
        outer = pending.pop()
        nodes, children = [], deque(outer.children())
        while children:
            child = children.popleft()
            if child.tag != "include":
                nodes.append(child)
                continue
            name = Path(child.text("file"))
            if set(child.node.attrib) != {"file"} or len(child.node):
                child.refuse("must have the attribute file, and nothing else")
            folders = [Path(file).parent for file in (root.file, child.file)]
            path = next((folder / name for folder in folders if (folder / name).exists()), folders[0] / name)
            child.path(str(path.resolve()))
            if path.resolve() in read:
                child.refuse(f"names '{name}', which is included already")
            read.add(path.resolve())
            included = root_of(path, "mujocoinclude", "mujoco")
            root.places.update({node: (*place[:3], root) for node, place in included.places.items()})
            children.extendleft(Element(node, root.places) for node in reversed(included.node))
        outer.node[:] = [element.node for element in nodes]
        pending += nodes


def _apply_defaults(root: Element) -> None:
    """Give elements the attributes of their class, or of the class of the bodies around them, and check them all."""
    elements, classes = [*root.walk(MJCF)], _classes(root)
    of_classes = {node for section in root.children("default") for node in section.node.iter()}
    for element, kind in elements:
        if element.node in of_classes:
            continue
        inherited = element.node.get("childclass", "")
        for child in element.node if inherited else ():
            if child.tag in ("body", "frame", "replicate") or (child.tag in MJCF and MJCF[child.tag].defaults):
                child.attrib.setdefault("class" if MJCF[child.tag].defaults else "childclass", inherited)
        name = inherited or element.text("class", "main")
        if name not in classes:
            element.refuse(f"is of the class '{name}', which does not exist{closest(name, classes)}")
        if kind.defaults:
            _inherit(element, classes[name], kind.defaults)
        element.check_neutral(kind)


def _classes(root: Element) -> dict[str, Defaults]:
    """Return the default attributes of each class, which inherits those of the class around it."""
    classes: dict[str, Defaults] = {"main": {}}
    for section in root.children("default"):
        if section.text("class", "main") != "main":
            section.refuse("is an outermost one, whose class is 'main'")
        pending = [(section, "main")]
        while pending:
            element, name = pending.pop()
            for child in element.children():
                kind = MJCF.get(MJCF["default"].children[child.tag])
                if kind is not None and kind.defaults:
                    if wrong := {"class", "name"} & {*child.node.attrib}:
                        child.refuse(f"has {min(wrong)}, which defaults do not have")
                    _inherit(child, classes[name], kind.defaults)
                    classes[name] |= {kind.defaults: child.node.attrib}
            for child in element.children("default"):
                if child.text("class") in classes:
                    child.refuse(f"is the second of the class '{child.text('class')}': one is allowed")
                classes[child.text("class")] = dict(classes[name])
                pending.append((child, child.text("class")))
    return classes


def _inherit(element: Element, defaults: Defaults, kind: str) -> None:
    """Give an element the attributes of a class that it has not."""
    own, inherited = element.node.attrib, defaults.get(kind, {})
    own.update(_over(inherited_by(element.tag, inherited) if kind == "actuator" else inherited, own))
    if kind == "actuator":
        as_general(element)


def _over(defaults: dict[str, str], attributes: dict[str, str]) -> dict[str, str]:
    """Return attributes over their defaults: one orientation replaces another, and numbers of a size the first ones."""
    turned = any(key in attributes for key in ORIENTATIONS)
    merged = {key: value for key, value in defaults.items() if not (turned and key in ORIENTATIONS)} | attributes
    for key in {"size", "gear", "gainprm", "biasprm"} & {*defaults} & {*attributes}:
        sizes = attributes[key].split()
        merged[key] = " ".join(sizes + defaults[key].split()[len(sizes) :])
    return merged


class Macros:
    """Macros of a document with explicit attributes, which are replaced by frames with copies.

    Args:
        root: document.
        models: other documents by name, without macros.
    """

    def __init__(self, root: Element, models: Mapping[str, Element]) -> None:
        self.root, self.models, self.size = root, models, 0
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
        frames, inside, referring = list[Element](), set[Names](), self.referring(self.root)
        for i in range(int(count)):
            affix = "", f"{macro.text('sep', '')}{i:0{len(str(int(count)))}}"
            frames.append(self.copies(macro, macro.children(), affix, inside, referring, pos=position, euler=i * euler))
            position = position + times(pose_of(frames[-1]).rotation, macro.vector("offset", (0, 0, 0)))
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
            parts = [Element(macro.named_by(kind, kind, nodes), models[key].places)]
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
        affix: Names,
        inside: set[Names],
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

    def copied(self, element: Element, affix: Names, inside: set[Names]) -> Node:
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


def _references(element: Element) -> list[Names]:
    """Return the kinds and names of the elements that one and its children name."""
    keys = ((AFFIXES.sub("", key), value) for node in element.node.iter() for key, value in node.items() if value)
    return [(kind, name) for kind, name in keys if kind in ("body", "joint", "geom", "site", "tendon")]
