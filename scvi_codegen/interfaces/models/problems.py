"""Catalogue of example problems: a system, an initial state, a step size and a time span, by command-line name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

from scvi_codegen.common.display.cards import Html, card, listed, plain
from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.common.representation import summary
from scvi_codegen.common.toml_text import package_table
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.interfaces.models import systems
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.system import MechanicalSystem


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """System with everything needed to integrate it once.

    Attributes:
        name: the name on the command line.
        title: one-line description.
        system: the Lagrangian or Hamiltonian.
        q: initial coordinates, m numbers.
        velocity: initial velocities, m numbers, or ``None`` if ``p`` is given.
        p: initial momenta, m numbers, or ``None``.
        step: a suitable step size for a method with eight points.
        span: a time span that shows the behaviour of the system.
        reference: bibliographic reference.
    """

    name: str
    title: str
    system: MechanicalSystem
    q: tuple[float, ...]
    velocity: tuple[float, ...] | None = None
    p: tuple[float, ...] | None = None
    step: float
    span: float
    reference: str

    __repr__ = summary("name", "system", "step")

    def _repr_html_(self) -> str:
        state = [("q", self.q), ("velocity", self.velocity), ("p", self.p)]
        facts = (
            ("name", plain(self.name)),
            *((name, listed([f"{x:g}" for x in numbers])) for name, numbers in state if numbers is not None),
            ("step, span", plain(f"{self.step:g}, {self.span:g}")),
            ("described in", plain(self.reference)),
        )
        return card(self.title, facts, Html(self.system._repr_html_()))

    def __post_init__(self) -> None:
        initial = [part for part in (self.velocity, self.p) if part is not None]
        if len(initial) != 1 or not len(self.q) == len(initial[0]) == self.system.dimension:
            raise SystemDefinitionError(
                f"problem '{self.name}' has {self.system.dimension} coordinates, but an initial state of "
                f"{len(self.q)} coordinates and {' and '.join(str(len(part)) for part in initial)} velocities or "
                "momenta"
            )


def _entry(name: str) -> Problem:
    fields: dict[str, Any] = dict(_TABLE[name])
    definition = fields.pop("system", None)
    fields |= {key: tuple(fields[key]) for key in ("q", "velocity", "p") if key in fields}
    system = LagrangianSystem.from_text(**definition) if definition else getattr(systems, name.replace("-", "_"))()
    return Problem(name=name, system=system, **fields)


def _fput_problem(n: int = 8) -> Problem:
    """Return the chain with its energy in the first mode, of amplitude 1."""
    system = systems.fput_chain(n)
    amplitude = math.sqrt(2 / (n + 1))
    return Problem(
        name="fput-chain" if n == 8 else f"fput-chain:{n}",
        title=f"Fermi-Pasta-Ulam-Tsingou chain of {n} masses, quartic springs, started in the first mode",
        system=system,
        q=tuple(amplitude * math.sin(math.pi * (index + 1) / (n + 1)) for index in range(n)),
        velocity=(0.0,) * n,
        step=0.5,
        span=1000.0,
        reference="E. Fermi, J. Pasta, S. Ulam, M. Tsingou, Studies of nonlinear problems, Los Alamos LA-1940 (1955)",
    )


_TABLE = package_table("interfaces/models/problems.toml")
PROBLEMS: Mapping[str, Callable[[], Problem]] = MappingProxyType(
    {name: partial(_entry, name) for name in _TABLE} | {"fput-chain": _fput_problem}
)
"""Catalogue: functions that build the entries, by command-line name."""


@checks_arguments()
def problem(name: str) -> Problem:
    """Return an entry of the catalogue; a chain takes a size, as in ``fput-chain:64``.

    Raises:
        SystemDefinitionError: if there is no such entry, or its size is invalid.
    """
    base, colon, size = name.partition(":")
    if base not in PROBLEMS:
        raise SystemDefinitionError(
            f"there is no problem '{base}'{closest(base, PROBLEMS)} Known: {', '.join(PROBLEMS)}"
        )
    if not colon:
        return PROBLEMS[base]()
    if base != "fput-chain":
        raise SystemDefinitionError(f"'{base}' has no size: only fput-chain takes one, as in fput-chain:64")
    if not (size.isascii() and size.isdigit() and len(size) < 10):
        raise SystemDefinitionError(f"the size of a chain must be a whole number, as in fput-chain:64, not '{size}'")
    return _fput_problem(int(size))
