"""XML documents of robots: elements with strict numbers, and errors that name file and element."""

from __future__ import annotations

import errno
import math
import re
import stat
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from scvi_codegen.api.text import is_inside
from scvi_codegen.common.errors import SystemDefinitionError, SystemDefinitionWarning, closest, warn
from scvi_codegen.extras.robots.trees.schema import Kind
from scvi_codegen.extras.robots.trees.tree import Vector

LARGEST_FILE = 32 * 2**20
LARGEST_NUMBER = 1e40
"""Bound of the magnitude of numbers, whose products are finite: those of an inertia have five factors."""
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
XACRO = re.compile(r"\$[({]")
NAMED = 5
"""Number of names that a warning lists of each kind of parts."""

Part = TypeVar("Part")
Place = tuple[str, int, str, Any]
"""Path of a document, number of a line, the nearest element around it that has a name, and the outermost element."""


@dataclass(frozen=True, slots=True)
class Element:
    """Element of a document.

    Attributes:
        node: tag, attributes and children.
        places: of each node of the document and of included ones.
    """

    node: ElementTree.Element
    places: dict[ElementTree.Element, Place]

    @property
    def file(self) -> str:
        """Path of the document."""
        return self.places[self.node][0]

    @property
    def document(self) -> Element:
        """Outermost element of a document of MJCF, also of one that is attached to another."""
        document: Element = self.places[self.node][3]
        return document

    @property
    def settings(self) -> Element:
        """Settings of the compiler, the first element of the document."""
        return Element(self.document.node[0], self.document.places)

    @property
    def name(self) -> str:
        """Attribute ``name``, or the tag."""
        return self.node.get("name") or self.node.tag

    @property
    def tag(self) -> str:
        """Tag of the element."""
        return self.node.tag

    def text(self, key: str, default: str | None = None) -> str:
        """Return an attribute as text; raise an error if it is missing and has no default."""
        value = self.node.get(key, default)
        if value is None:
            self.refuse(f"has no attribute '{key}'")
        return value

    def choice(self, key: str, *options: str) -> str:
        """Return an attribute that is one of the options, of which the first is the default."""
        value = self.text(key, options[0])
        if value not in options:
            self.refuse(f"has {key}='{value}', which must be {' or '.join(options)}{closest(value, options)}")
        return value

    def has(self, key: str) -> bool:
        """Return whether an attribute is present."""
        return key in self.node.attrib

    def vector(self, key: str, default: Sequence[float] | None = None, sizes: Sequence[int] = (3,)) -> Vector:
        """Return an attribute as numbers, of which there must be one of ``sizes``."""
        if default is not None and not self.has(key):
            return np.array(default, float)
        text = self.text(key)
        values = text.split()
        if not all(map(NUMBER.fullmatch, values)):
            self.refuse(f"has {key}='{text}', which must be numbers")
        numbers = np.array([*map(float, values)])
        if len(numbers) not in sizes:
            self.refuse(f"has {key}='{text}', which must be {' or '.join(map(str, sizes))} finite numbers")
        if not (np.abs(numbers) < LARGEST_NUMBER).all():
            self.refuse(f"has {key}='{text}', whose magnitude must be less than {LARGEST_NUMBER:g}")
        return numbers

    def number(self, key: str, default: float | None = None, least: float = -np.inf) -> float:
        """Return an attribute as a number that must not be smaller than ``least``."""
        value = float(self.vector(key, None if default is None else [default], (1,))[0])
        if value < least:
            self.refuse(f"has the {key} {value:g}, which must not be < {least:g}")
        return value

    def named_by(self, key: str, kind: str, parts: Mapping[str, Part], default: str | None = None) -> Part:
        """Return the part that an attribute names, of the parts of this kind by name."""
        if (name := self.text(key, default)) not in parts:
            self.refuse(f"names the {kind} '{name}', which does not exist{closest(name, parts)}")
        return parts[name]

    def children(self, *tags: str) -> list[Element]:
        """Return the children with one of the tags, in order; all of them without tags."""
        return [Element(child, self.places) for child in self.node if not tags or child.tag in tags]

    def path(self, name: str) -> Path:
        """Return the path of a file in the folder of the document, or in one that the user names."""
        if not is_inside(folder := Path(self.document.file).parent, path := folder / name):
            place = path.resolve().parent
            remedy = f"copy it there, or name its folder: from_mjcf(.., folders=['{place}']), --folder {place}"
            self.refuse(f"names '{self.text('file')}' outside the folder of the document: {remedy}")
        return path

    def child(self, tag: str) -> Element | None:
        """Return the first child with a tag."""
        return next(iter(self.children(tag)), None)

    def optional(self, tag: str) -> Element:
        """Return the first child with a tag; one without attributes if there is none."""
        return self.child(tag) or Element(ElementTree.Element(tag), self.places)

    def unit(self, key: str, default: Sequence[float] | None = None) -> Vector:
        """Return an attribute as a vector of length 1."""
        vector = self.vector(key, default)
        length = math.hypot(*vector)
        if length == 0:
            self.refuse(f"has {key}='{self.text(key)}', which must not be zero")
        return vector / length

    def refuse(self, problem: str) -> NoReturn:
        """Raise an error that names the file, the line and the element."""
        file, line, around, _ = self.places[self.node]
        inside = f" in {around}" if around and not self.node.get("name") else ""
        raise SystemDefinitionError(f"{file}:{line}: <{self.tag}> '{self.name}'{inside} {problem}")

    def walk(self, kinds: Mapping[str, Kind]) -> Iterator[tuple[Element, Kind]]:
        """Yield this element and those inside it whose attributes are known, parents first, with their kinds.

        Raises:
            SystemDefinitionError: if an element or attribute is unknown or must not be repeated, or the element changes
                the motion and is not read.
        """
        pending = [(self, kinds[self.tag])]
        while pending:
            element, kind = pending.pop()
            element.check_attributes(kind)
            yield element, kind
            seen: set[str] = set()
            inner: list[tuple[Element, Kind]] = []
            for child in element.children():
                name = kind.children.get(child.tag)
                if child.tag.startswith("xacro:"):
                    child.refuse("is a macro: write the file that xacro makes of it")
                if name is None and ":" in child.tag:  # of another namespace
                    continue
                if name is None:
                    element.refuse(f"contains the unknown element <{child.tag}>{closest(child.tag, kind.children)}")
                if name == "refused":
                    child.refuse("changes the motion and is not read: remove it, or write out what it makes")
                if child.tag in seen and child.tag not in kind.repeated:
                    child.refuse(f"is the second <{child.tag}> of <{element.tag}> '{element.name}': one is allowed")
                seen.add(child.tag)
                if name != "unchecked":
                    inner.append((child, kinds[name]))
            pending += reversed(inner)

    def check_attributes(self, kind: Kind) -> None:
        """Raise an error if an attribute is unknown, or xacro did not write its value; prefixed ones are ignored."""
        for key, value in self.node.attrib.items():
            if XACRO.search(value):
                self.refuse(f"has {key}='{value}', a substitution: write the file that xacro makes of it")
            if key not in kind.attributes and ":" not in key and key != "xmlns":
                self.refuse(f"has the unknown attribute '{key}'{closest(key, kind.attributes)}")

    def check_neutral(self, kind: Kind) -> None:
        """Raise an error if an attribute that changes the motion and is not read has another value than its default."""
        for key, neutral in kind.refused.items():
            value = self.text(key, neutral)
            same = value == neutral or value in neutral.split()
            if not same and NUMBER.fullmatch(neutral):
                same = not (self.vector(key, sizes=range(100)) - float(neutral)).any()
            if not same:
                self.refuse(f"has {key}='{value}', which changes the motion and is not read: remove it")


class Unread:
    """Parts of a document that matter to users and are not read: names by kind of part."""

    def __init__(self) -> None:
        self.names: defaultdict[str, dict[str, None]] = defaultdict(dict)

    def add(self, part: str, *names: str) -> None:
        """Add parts of a kind."""
        self.names[part] |= dict.fromkeys(names)

    def warn(self, file: str) -> None:
        """Warn of all parts at once."""
        parts = []
        for part, names in self.names.items():
            more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
            parts.append(f"{part} {', '.join([*names][:NAMED])}{more}".strip())
        if parts:
            warn(f"{file}: the motion is computed without {'; '.join(parts)}", SystemDefinitionWarning)


def checked_limits(element: Element, low: float, high: float) -> tuple[float, float]:
    """Return the limits of a joint or tendon, of which the second must be the larger one."""
    if not low < high:
        element.refuse(
            f"has the limits {low:g} and {high:g}: the second must be larger; fix the joint, or limits='ignore'"
        )
    return low, high


def root_of(path: Path, *tags: str) -> Element:
    """Read a document whose outermost element must have one of the tags.

    Raises:
        SystemDefinitionError: if the file cannot be read, is no regular file or larger than 32 MiB, is no XML, declares
            entities, or has another outermost element.
    """
    data = bytes_of(path)
    try:
        node, places = _parsed(data, str(path))
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise SystemDefinitionError(f"{path} is not XML: {error}") from error
    if node.tag not in tags:
        other = {"robot": ": it is a URDF file, NAME.urdf", "mujoco": ": it is an MJCF file, NAME.xml"}.get(
            node.tag, ""
        )
        raise SystemDefinitionError(f"{path} begins with <{node.tag}>, not with <{tags[0]}>{other}")
    root = Element(node, places)
    places.update({node: (*place[:3], root) for node, place in places.items()})
    return root


def bytes_of(path: Path) -> bytes:
    """Return the contents of a file, which must be a regular one of at most 32 MiB."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a device may have no end
            raise OSError(errno.EINVAL, "it is no regular file")
        with path.open("rb") as file:
            data = file.read(LARGEST_FILE + 1)
    except (OSError, ValueError) as error:
        raise SystemDefinitionError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > LARGEST_FILE:
        raise SystemDefinitionError(f"{path} has more than {LARGEST_FILE} bytes, the most that are read")
    return data


def _parsed(data: bytes, file: str) -> tuple[ElementTree.Element, dict[ElementTree.Element, Place]]:
    """Return the outermost node of a document, with prefixes of namespaces as they are written, and all places."""
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    places: dict[ElementTree.Element, Place] = {}
    around = [""]

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = builder.start(tag, attributes)
        places[node] = file, parser.CurrentLineNumber, around[-1], None
        around.append(f"<{tag}> '{attributes['name']}'" if attributes.get("name") else around[-1])

    def end(tag: str) -> None:
        builder.end(tag)
        around.pop()

    def refuse(*_: object) -> None:
        raise SystemDefinitionError(f"{file} declares a document type or entities, which are not read: remove them")

    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = start, end, refuse
    parser.Parse(data, True)
    return builder.close(), places
