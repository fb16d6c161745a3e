"""Systems defined by text whose formulas are read only when they are first needed.

An integrator that was compiled before needs no formulas, hence no SymPy: the cache contains the key of its system under
all arguments of ``from_text``, its class and the versions of this package and of SymPy. The entry is written by
:meth:`Deferred.store_key`, and only for text that was read without error or warning.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Self

from scvi_codegen.files.cache import key_of, store_text, stored_text


class Deferred:
    """Base of frozen dataclasses with slots: fields without a value are read from text when they are first accessed.

    ``_text`` contains the arguments of ``from_text`` as JSON, and ``_key`` the key found in the cache; both are unset
    for objects made in another way.
    """

    __slots__ = ("_key", "_text")
    _key: str
    _text: str

    @classmethod
    @abstractmethod
    def _read(cls, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
        """Return the system of these arguments, and whether warnings were issued."""

    @classmethod
    def _of_text(cls, arguments: Mapping[str, Any]) -> Self:
        """Return the system of these arguments of ``from_text``, unread if its key is in the cache."""
        text = _text_of(cls, arguments)
        key = None if text is None else stored_text(("system", text))
        if key is not None:
            system = object.__new__(cls)
            object.__setattr__(system, "_key", key)
        else:
            system, warned = cls._read(arguments)
            text = None if warned else text
        if text is not None:
            object.__setattr__(system, "_text", text)
        return system

    def key(self) -> tuple[str, ...]:
        """Return the key of this system in caches, made from its type and all of its fields."""
        return (getattr(self, "_key", None) or key_of(self),)

    def store_key(self) -> None:
        """Store the key of a system that was read from text, so that later processes need not read the text."""
        if hasattr(self, "_text") and not hasattr(self, "_key"):
            (key,) = self.key()
            store_text(("system", self._text), key)
            object.__setattr__(self, "_key", key)

    def _argument(self, name: str) -> Any:
        """Return an argument of ``from_text`` of a system whose key is in the cache."""
        return json.loads(self._text)[1][name]

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Read the text if ``name`` is a field; called only for attributes without a value."""
            names = [field.name for field in fields(self)]
            if name not in names or not hasattr(self, "_text"):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
            system, _ = self._read(json.loads(self._text)[1])
            for each in names:
                object.__setattr__(self, each, getattr(system, each))
            return getattr(self, name)


def _text_of(cls: type, arguments: Mapping[str, Any]) -> str | None:
    """Return the class and the arguments as JSON, which differs for different systems; ``None`` if that is impossible.

    Arrays and derived classes are not deferred.
    """
    if cls.__module__.partition(".")[0] != __name__.partition(".")[0] or are_arrays(
        arguments["coordinates"], arguments["parameters"] or (), arguments["tables"]
    ):
        return None
    plain = {name: dict(value) if isinstance(value, Mapping) else value for name, value in arguments.items()}
    try:
        return json.dumps([f"{cls.__module__}.{cls.__qualname__}", plain])
    except (TypeError, ValueError):
        return None


def are_arrays(*declarations: Any) -> bool:
    """Return whether one of the coordinates, parameters or tables is an array."""
    return any("[" in str(each) for group in declarations for each in group)
