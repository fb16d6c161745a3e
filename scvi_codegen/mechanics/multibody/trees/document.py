"""XML documents of robots: elements with numbers, vectors and errors that name file and element."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree

import numpy as np

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.mechanics.multibody.trees.tree import Vector

LARGEST_FILE = 32 * 2**20


@dataclass(frozen=True, slots=True)
class Element:
    """Element of a document, with the defaults of its attributes.

    Attributes:
        file: path of the document, for messages.
        node: tag, attributes and children.
        defaults: values of attributes that it does not have.
    """

    file: str
    node: ElementTree.Element
    defaults: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Attribute ``name``, or the tag."""
        return self.node.get("name", self.node.tag)

    def text(self, key: str, default: str | None = None) -> str:
        """Return an attribute as text; raise an error if it is missing and has no default."""
        value = self.node.get(key, self.defaults.get(key, default))
        if value is None:
            self.refuse(f"has no attribute '{key}'")
        return value

    def has(self, key: str) -> bool:
        """Return whether an attribute is present."""
        return key in self.node.attrib or key in self.defaults

    def vector(self, key: str, default: Sequence[float] | None = None, sizes: Sequence[int] = (3,)) -> Vector:
        """Return an attribute as finite numbers, of which there must be one of ``sizes``."""
        if default is not None and not self.has(key):
            return np.array(default, float)
        text = self.text(key)
        try:
            values = np.array([float(each) for each in text.split()])
        except ValueError:
            self.refuse(f"has {key}='{text}', which must be numbers")
        if len(values) not in sizes or not np.isfinite(values).all():
            self.refuse(f"has {key}='{text}', which must be {' or '.join(map(str, sizes))} finite numbers")
        return values

    def number(self, key: str, default: float | None = None) -> float:
        """Return an attribute as a finite number."""
        return float(self.vector(key, None if default is None else [default], (1,))[0])

    def children(self, *tags: str) -> list[Element]:
        """Return the children with one of the tags, in order."""
        return [Element(self.file, child) for child in self.node if child.tag in tags]

    def child(self, tag: str) -> Element | None:
        """Return the first child with a tag."""
        node = self.node.find(tag)
        return None if node is None else Element(self.file, node)

    def unit(self, key: str, default: Sequence[float] | None = None) -> Vector:
        """Return an attribute as a vector of length 1."""
        vector = self.vector(key, default)
        length = float(np.linalg.norm(vector))
        if length == 0:
            self.refuse(f"has {key}='{self.text(key)}', which must not be zero")
        return vector / length

    def refuse(self, what: str) -> NoReturn:
        """Raise an error that names the file and the element."""
        raise SystemDefinitionError(f"{self.file}: <{self.node.tag}> '{self.name}' {what}")


def warn_of_dry_friction(path: str | PathLike[str], joints: Sequence[str]) -> None:
    """Warn that dry friction of joints is not read."""
    if joints:
        message = f"{path}: dry friction of {', '.join(joints)} is not read: it is no smooth force"
        warnings.warn(message, stacklevel=5)


def root_of(path: str | PathLike[str], *tags: str) -> Element:
    """Read a document whose outermost element must have one of the tags.

    Raises:
        SystemDefinitionError: if the file cannot be read, is larger than 32 MiB, is no XML, declares entities, or has
            another outermost element.
    """
    file = Path(path)
    try:
        size = file.stat().st_size
        data = file.read_bytes() if size <= LARGEST_FILE else b""
    except OSError as error:
        raise SystemDefinitionError(f"{file} cannot be read: {error.strerror}") from error
    if size > LARGEST_FILE:
        raise SystemDefinitionError(f"{file} has {size} bytes; at most {LARGEST_FILE} are read")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise SystemDefinitionError(f"{file} declares a document type or entities, which are not read: remove them")
    try:
        node = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise SystemDefinitionError(f"{file} is not XML: {error}") from error
    if node.tag not in tags:
        raise SystemDefinitionError(f"{file} begins with <{node.tag}>, not with <{tags[0]}>")
    return Element(str(file), node)
