"""Integration methods: each has an order, symmetry and symplecticity, and defines its stage equations for a system."""

from collections.abc import Callable, Mapping, Sequence
from inspect import Parameter, signature
from typing import Any, Final

from scvi_codegen.common.errors import MethodError, closest
from scvi_codegen.common.validation import checked_count
from scvi_codegen.methods.composition import Composition, StoermerVerlet
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
    SpectralCollocation,
)
from scvi_codegen.methods.shooting import SCVI
from scvi_codegen.systems.contacts.dry_friction import with_dry_friction
from scvi_codegen.systems.system import MechanicalSystem

__all__ = [
    "DEFAULT_NAME",
    "LOOSE",
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
    "sliding",
    "specification_of",
]

CALLED: Final = {
    "stoermer-verlet": "verlet leapfrog velocity-verlet stormer-verlet rattle shake",
    "gauss": "gauss-legendre",
    "gauss:1": "implicit-midpoint midpoint",
    "lobatto-iiia:2": "trapezoidal trapezoid",
    "explicit-euler": "euler",
    "radau-iia": "radau",
    "composition": "yoshida",
}
"""Names used elsewhere, by method."""
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
"""Constructors by the name used in model files and on the command line."""

ARGUMENTS: dict[str, tuple[str, ...]] = {name: tuple(signature(make).parameters) for name, make in METHODS.items()}
"""Arguments of each constructor, by name."""

REQUIRED: dict[str, tuple[str, ...]] = {
    name: tuple(key for key, value in signature(make).parameters.items() if value.default is Parameter.empty)
    for name, make in METHODS.items()
}


SIZES = ("degree", "stages", "order")
"""Arguments that can follow the name of a method, as in ``svi:6``."""
DEFAULT_SIZE = 8
"""Default of a required degree, number of stages or order."""
DEFAULT_NAME = "svi:8"
"""Name of the default method."""
LOOSE = 1e-4
"""Tolerance of adaptive steps from which on those of SVI(4) take less time than those of SVI(8) (docs/steps.md)."""


def as_method(method: Method | str | Specification, system: MechanicalSystem | None = None) -> Method:
    """Return a method from its name: ``"svi"`` (degree 8), ``"svi:6"``, ``"gauss:3"``; methods are returned unchanged.

    For a system with constraints an SVI gets the quadrature points that they require. Plain data of a method,
    ``{"method": "svi", "degree": 8}``, are accepted, too.

    Raises:
        MethodError: for an unknown name, an invalid number or one that the method does not accept, and other types.
    """
    if isinstance(method, Method):
        return method
    if isinstance(method, Mapping):
        return method_from_specification(method)
    if not isinstance(method, str):
        raise MethodError(f"method must be a method, as SVI(8), or a name such as 'svi:8', not {method!r}")
    return method_from_specification(fitted(sized(specification_of(method)), system))


def default_method(system: MechanicalSystem, tolerance: float | None = None) -> Method:
    """Return SVI(8), for adaptive steps of a tolerance from :data:`LOOSE` on SVI(4).

    For a system with constraints, contacts or dry friction it is SVI(8) with Gauss-Lobatto points, which impose them.
    """
    method = as_method(DEFAULT_NAME, system)
    return SVI(4) if tolerance is not None and tolerance >= LOOSE and method == SVI(8) else method


def finer_method(method: Method, *, constrained: bool) -> str:
    """Return the name of an SVI whose step has a negligible error beside that of a method's step.

    With s the degree, or half the order, of the method: degree min(2s, s + 4), which doubles the order or exceeds it by
    8; s + 2 with constraints and rotations, which Newton's method solves; 4 or 8 for explicit methods.
    """
    order = getattr(method, "order", None)
    degree = getattr(method, "degree", None) or max(1, -(-(order or DEFAULT_SIZE) // 2))
    if constrained:
        return f"svi:{degree + 2}"
    if not method.implicit:
        return "svi:4" if order is not None and order <= 2 else "svi:8"
    return f"svi:{min(2 * degree, degree + 4)}"


def fitted(specification: Specification, system: MechanicalSystem | None) -> Specification:
    """Add the default quadrature of an SVI for constraints: Gauss-Lobatto points, one more than the degree."""
    is_open = specification.get("method") == "svi" and "degree" in specification and "quadrature" not in specification
    if system is None or not is_open or not (system.constrained_at_nodes or with_dry_friction(system) is not system):
        return specification
    return {**specification, "quadrature": f"gauss-lobatto:{int(str(specification['degree'])) + 1}"}


def sliding(system: MechanicalSystem, method: Method | str) -> MechanicalSystem:
    """Return the system with contacts in place of the dry friction in its forces, if the method has constraints."""
    method = as_method(method, system)
    if not isinstance(method, SVI) or not method.curves.nodal:
        return system
    return with_dry_friction(system) if method.rule.name == f"gauss-lobatto:{method.degree + 1}" else system


def specification_of(name: str) -> dict[str, Any]:
    """Return the specification of a name, ``{"method": "svi", "degree": 6}`` for ``"svi:6"``; else MethodError."""
    method, colon, number = name.partition(":")
    _check_name(method)
    size = size_of(method)
    if not colon:
        return {"method": method}
    if size is None:
        raise MethodError(
            f"{name!r} is not a method: {method} does not take a number; its arguments are {_listed(ARGUMENTS[method])}"
        )
    if not (number.isascii() and number.isdigit()):
        example = f"{method}:{DEFAULT_SIZE}"
        raise MethodError(
            f"{name!r} is not a method: the colon must be followed by a number, its {size}, as in {example}"
        )
    return {"method": method, size: int(number)}


def sized(specification: Specification) -> Specification:
    """Add the default degree, number of stages or order if the method requires one that is missing."""
    name = str(specification.get("method"))
    size = size_of(name)
    needed = size is not None and size in REQUIRED[name]
    return {size: DEFAULT_SIZE, **specification} if needed and size else specification


def size_of(name: str) -> str | None:
    """Return the argument that follows a method's name: ``"degree"`` for ``"svi"``; ``None`` if it takes none."""
    return next((argument for argument in SIZES if argument in ARGUMENTS.get(name, ())), None)


def _check_name(name: object) -> None:
    if name not in METHODS:
        meant = [method for method, words in CALLED.items() if name in words.split()]
        hint = f"; did you mean {meant[0]!r}?" if meant else closest(str(name), METHODS)
        raise MethodError(f"there is no method {name!r}{hint} Known: {', '.join(METHODS)}")


def _listed(arguments: Sequence[str]) -> str:
    return ", ".join(arguments) or "no arguments"


def method_from_specification(specification: Specification) -> Method:
    """Return the method of plain data such as ``{"method": "svi", "degree": 8, ..}``; MethodError for other data."""
    arguments: dict[str, Any] = dict(specification)
    name: Any = arguments.pop("method", None)
    _check_name(name)
    accepted = ARGUMENTS[name]
    for argument in arguments:
        if argument not in accepted:
            raise MethodError(f"{name} does not take {argument!r}; its arguments are {_listed(accepted)}")
    for argument in {"degree", "stages", "order"} & set(arguments):
        checked_count(arguments[argument], argument, least=1, error=MethodError)
    if not isinstance(arguments.get("abscissae", ""), str | list | tuple):
        raise MethodError(f"abscissae must be a list of numbers or a name, not {arguments['abscissae']!r}")
    for argument in REQUIRED[name]:
        if argument not in arguments:
            raise MethodError(f"{name} needs {argument!r}")
    return METHODS[name](**arguments)
