"""Methods as data. Each knows its order, symmetry and symplecticity, and gives its stage equations for a system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import Parameter, signature
from typing import Any, Final

from scvi_codegen.errors import MethodError, closest
from scvi_codegen.given.counts import checked_count
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.collocation import SpectralCollocation
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method, Specification
from scvi_codegen.methods.runge_kutta import (
    TABLEAU_METHODS,
    ChebyshevGauss,
    ChebyshevLobatto,
    CollocationRK,
    ExplicitEuler,
    Gauss,
    LobattoIIIA,
    RadauIA,
    RadauIIA,
    RungeKutta,
)
from scvi_codegen.methods.shooting import SCVI
from scvi_codegen.methods.stoermer_verlet import StoermerVerlet

__all__ = [
    "METHODS",
    "SCVI",
    "SVI",
    "ChebyshevGauss",
    "ChebyshevLobatto",
    "CollocationRK",
    "Composition",
    "ExplicitEuler",
    "Gauss",
    "LobattoIIIA",
    "Method",
    "RadauIA",
    "RadauIIA",
    "RungeKutta",
    "Specification",
    "SpectralCollocation",
    "StoermerVerlet",
    "as_method",
    "default_method",
    "fitted",
    "method_from_specification",
    "size_of",
    "sized",
    "specification_of",
]

CALLED: Final = {
    "stoermer-verlet": "verlet leapfrog velocity-verlet stormer-verlet",
    "gauss": "gauss-legendre",
    "gauss:1": "implicit-midpoint midpoint",
    "explicit-euler": "euler",
    "radau-iia": "radau",
    "composition": "yoshida",
}
"""By the name, what a method is called elsewhere."""
METHODS: dict[str, Callable[..., Method]] = {
    "svi": SVI,
    "scvi": SCVI,
    "sc": SpectralCollocation,
    **TABLEAU_METHODS,
    "collocation": CollocationRK,
    "stoermer-verlet": StoermerVerlet,
    "composition": Composition.of,
    "explicit-euler": ExplicitEuler,
}
"""Constructors by the name used in model files and on the command line; their signatures say what they take."""

ARGUMENTS: dict[str, tuple[str, ...]] = {name: tuple(signature(make).parameters) for name, make in METHODS.items()}
"""What each takes, by name."""

REQUIRED: dict[str, tuple[str, ...]] = {
    name: tuple(key for key, value in signature(make).parameters.items() if value.default is Parameter.empty)
    for name, make in METHODS.items()
}


SIZES = ("degree", "stages", "order")
"""The number that a name may end in: ``svi:6``."""
DEFAULT_SIZE = 8
"""Where the name has none and the method needs one."""


def as_method(method: Method | str, system: MechanicalSystem | None = None) -> Method:
    """A method as it is, or of a name as the command line takes it: ``"svi"`` (degree 8), ``"svi:6"``, ``"gauss:3"``.

    With the points that the constraints of a system want.

    Raises:
        MethodError: for an unknown name, a number that is none or that the method does not take, and other types.
    """
    if isinstance(method, Method):
        return method
    if not isinstance(method, str):
        raise MethodError(f"a method is wanted, as SVI(8), or a name such as 'svi:8', not {method!r}")
    return method_from_specification(fitted(sized(specification_of(method)), system))


def default_method(system: MechanicalSystem) -> Method:
    """SVI(8); of a system with constraints, which hold at Lobatto's points, SVI(6) with these."""
    return as_method("svi:6", system) if system.constraints else SVI(8)


def fitted(specification: Specification, system: MechanicalSystem | None) -> Specification:
    """With Lobatto's points, one more than the degree, for an SVI of constraints whose quadrature is not said."""
    wants = system is not None and system.constraints and specification.get("method") == "svi"
    if not wants or "quadrature" in specification or "degree" not in specification:
        return specification
    return {**specification, "quadrature": f"gauss-lobatto:{int(str(specification['degree'])) + 1}"}


def specification_of(name: str) -> dict[str, Any]:
    """What a name says of a method: ``{"method": "svi", "degree": 6}`` of ``"svi:6"``.

    Raises:
        MethodError: for an unknown name, a number that is none or that the method does not take.
    """
    method, colon, number = name.partition(":")
    _check_name(method)
    size = size_of(method)
    if not colon:
        return {"method": method}
    if size is None:
        raise MethodError(f"{name!r} is no method: no number follows {method}; it takes {_listed(ARGUMENTS[method])}")
    if not (number.isascii() and number.isdigit()):
        example = f"{method}:{DEFAULT_SIZE}"
        raise MethodError(f"{name!r} is no method: a number, its {size}, follows the colon, as in {example}")
    return {"method": method, size: int(number)}


def sized(specification: Specification) -> Specification:
    """With the default degree, number of stages or order where a method needs one that is not given."""
    name = str(specification.get("method"))
    size = size_of(name)
    needed = size is not None and size in REQUIRED[name]
    return {size: DEFAULT_SIZE, **specification} if needed and size else specification


def size_of(name: str) -> str | None:
    """What the number after a method's name is: ``"degree"`` of ``"svi"``, ``None`` of ``"explicit-euler"``."""
    return next((argument for argument in SIZES if argument in ARGUMENTS.get(name, ())), None)


def _check_name(name: object) -> None:
    if name not in METHODS:
        known = [each for each, words in CALLED.items() if name in words.split()]
        hint = f"; did you mean {known[0]!r}?" if known else closest(str(name), METHODS)
        raise MethodError(f"there is no method {name!r}{hint} Known: {', '.join(METHODS)}")


def _listed(arguments: Sequence[str]) -> str:
    return ", ".join(arguments) or "no arguments"


def method_from_specification(specification: Specification) -> Method:
    """The method described by plain data such as ``{"method": "svi", "degree": 8, "quadrature": "gauss-legendre:8"}``.

    Raises:
        MethodError: on an unknown method, an argument it does not take, or one it needs.
    """
    arguments: dict[str, Any] = dict(specification)
    name: Any = arguments.pop("method", None)
    _check_name(name)
    accepted = ARGUMENTS[name]
    for argument in arguments:
        if argument not in accepted:
            raise MethodError(f"{name} takes no {argument!r}; it takes {_listed(accepted)}")
    for argument in {"degree", "stages", "order"} & set(arguments):
        checked_count(arguments[argument], argument, least=1, error=MethodError)
    if not isinstance(arguments.get("abscissae", ""), str | list | tuple):
        raise MethodError(f"abscissae must be a list of numbers or a name, not {arguments['abscissae']!r}")
    for argument in REQUIRED[name]:
        if argument not in arguments:
            raise MethodError(f"{name} needs {argument!r}")
    return METHODS[name](**arguments)
