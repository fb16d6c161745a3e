"""C text and what is needed to call it: all that a stepper remembers of the symbolic world."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

from scvi_codegen.version import __version__

__all__ = ["Interface", "Source"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """C text of an integrator, files ``<prefix>.h`` and ``<prefix>.c``; ``declarations`` is the header's inner part."""

    prefix: str
    header: str
    code: str
    declarations: str

    def to_json(self) -> str:
        """Text read back by :meth:`from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Source:
        """The source written by :meth:`to_json`."""
        return cls(**json.loads(text))


@dataclass(frozen=True, slots=True, kw_only=True)
class Interface:
    """What a caller must know of a compiled integrator.

    Attributes:
        prefix: beginning of every exported C name.
        title: system and method, one line.
        notes: order, symplecticity, symmetry in words.
        system, method: their names.
        coordinates, parameters: names in order.
        defaults: parameter values used unless others are given.
        unknowns: length of the run's memory of its last stages.
        workspace: doubles of workspace per call.
        has_action: whether the method has a discrete Lagrangian.
        map_names, map_formulas: of the momentum maps, what symmetries conserve.
        map_exact: whether the method is known to conserve them exactly, to round-off.
        momentum_names: of a Hamiltonian; see :attr:`momenta`.
    """

    prefix: str
    title: str
    notes: tuple[str, ...]
    system: str
    method: str
    coordinates: tuple[str, ...]
    parameters: tuple[str, ...]
    defaults: tuple[float, ...]
    unknowns: int
    workspace: int
    has_action: bool
    map_names: tuple[str, ...] = ()
    map_formulas: tuple[str, ...] = ()
    map_exact: tuple[bool, ...] = ()
    momentum_names: tuple[str, ...] = ()

    @property
    def dimension(self) -> int:
        """Degrees of freedom m."""
        return len(self.coordinates)

    def about(self) -> dict[str, str]:
        """Title, system, method, and version of this package: what belongs beside every number computed."""
        return {"title": self.title, "system": self.system, "method": self.method, "version": __version__}

    @property
    def momenta(self) -> tuple[str, ...]:
        """Names of the momenta: those of a Hamiltonian, else ``p_`` before the coordinate's."""
        return self.momentum_names or tuple(f"p_{name}" for name in self.coordinates)

    def to_json(self) -> str:
        """Text read back by :meth:`from_json`."""
        return json.dumps(asdict(self), indent=2, ensure_ascii=True) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Interface:
        """The interface written by :meth:`to_json`."""
        fields: dict[str, Any] = json.loads(text)
        arguments: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in fields.items()}
        return cls(**arguments)
