"""Contacts with dry friction: definitions, and the constraints and forces of all their modes.

A contact has a gap g(q, t) >= 0 and a slip w = T(q, t) v + b(q, t). Its mode is open (lambda = 0), stick (g = 0, w = 0)
or slip in a direction d = w/|w| (g = 0, tau = 0), +-1 in a plane; the constraint forces are

    (G - mu d T)^T lambda + T^T tau,     G = g_q,     lambda >= 0,     |tau| <= mu_s lambda.

Sliding friction is thus a constraint with an oblique force. Friction without a gap has a limit F in place of mu lambda:
w = 0 with |tau| <= F_s, or the force -F d T^T. The modes are parameters of the compiled step: ``closed``, ``sticks``
(0 or 1) and ``direction`` (d, or 0) of each contact, all 0 by default, in space vectors (``support/run/contacts.h``).

Sources: F. Pfeiffer, Ch. Glocker, *Multibody Dynamics with Unilateral Contacts* (1996); J. J. Moreau, in *Nonsmooth
Mechanics and Applications*, CISM 302 (1988). That the multipliers of the stages suffice for the order of the step is
measured (:mod:`scvi_codegen.methods.constraints`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum, auto
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.systems.event import Formula, conditions_of

if TYPE_CHECKING:
    from sympy import Basic, Expr, Symbol


WORDS = ("name", "impacts")
"""Arguments that are no formulas."""


MOST_ROWS = 192
"""Gaps and slips of a contact problem, by steps of near ones: matrices of 295 kB are on the stack."""


def _number(formula: Formula) -> float | None:
    """Return the value of a formula that is a number, else ``None``."""
    with suppress(TypeError, ValueError):
        return float(cast(float, formula))
    return None


def _check_limits(shown: str, kinetic: tuple[str, Formula], static: tuple[str, Formula | None]) -> None:
    """Raise :class:`SystemDefinitionError` for a negative coefficient, or a static one below that of sliding."""
    slides, sticks = _number(kinetic[1]), None if static[1] is None else _number(static[1])
    for (name, formula), value in zip((kinetic, static), (slides, sticks), strict=True):
        if value is not None and not 0.0 <= value < float("inf"):
            raise SystemDefinitionError(f"{name}={formula!r} of {shown} is invalid: give a number >= 0 or a formula")
    if slides is not None and sticks is not None and sticks < slides:
        raise SystemDefinitionError(
            f"{static[0]}={static[1]!r} of {shown} is less than {kinetic[0]}={kinetic[1]!r}: give at least that, or "
            f"omit {static[0]}"
        )


class Impacts(StrEnum):
    """Law of the impacts of a contact beside those of others that it meets at the same time.

    One contact after another until none approaches, as the balls of a cradle: the last one alone leaves. Or all that
    touch at once by Newton's law, 0 <= v_n+ + e v_n-, 0 <= Lambda, of which one is 0 (C. Glocker, *Set-Valued Force
    Laws*, 2001): -1/3, 2/3, 2/3 of three balls, and a box that falls flat does not turn.
    """

    SEQUENTIAL = auto()
    SIMULTANEOUS = auto()


@dataclass(frozen=True, slots=True)
class Contact:
    """Unilateral contact, made by :func:`contact`.

    Attributes:
        gap: distance g(q, t) that is >= 0; with ``of`` a function with its zeros and its sign.
        slip: slip velocity w, linear in the velocities, or its two components in space; ``None`` without friction.
        friction: coefficient mu of sliding, a formula of (q, v, t) and parameters; ``None`` without friction.
        static_friction: coefficient mu_s up to which the contact sticks; ``None``: mu.
        restitution: coefficient e of impacts, v_n+ = -e v_n-.
        where: condition, or several of them, of places and times where the contact exists; elsewhere, and where a
            state is behind its surface, it is open.
        of: coordinates by whose gradient the gap is divided, so that it is a distance to first order.
        name: name in messages; by default the formula of the gap.
        impacts: their law beside those of others, ``"sequential"`` or ``"simultaneous"``
            (:class:`Impacts`).

    Raises:
        SystemDefinitionError: for friction without slip or slip without friction, and invalid coefficients.
    """

    gap: Formula
    slip: Formula | tuple[Formula, ...] | None = None
    friction: Formula | None = None
    static_friction: Formula | None = None
    restitution: Formula = 0.0
    where: str | Basic | tuple[str | Basic, ...] | None = None
    of: tuple[str | Symbol, ...] = ()
    name: str = ""
    impacts: str = Impacts.SEQUENTIAL

    @property
    def conditions(self) -> tuple[Formula, ...]:
        """Formulas that are >= 0 where the contact exists."""
        return conditions_of(self.where)

    @property
    def table(self) -> dict[str, Any]:
        """Arguments by name, as in ``[[contacts]]`` of a model file."""
        return _table(self)

    @property
    def laws(self) -> tuple[Expr, Expr, Expr]:
        """Coefficients of friction and static friction, 0 without, and of restitution, of expressions."""
        friction: Any = zero() if self.friction is None else self.friction
        return friction, zero() if self.friction is None else limits_of(self)[1], cast("Expr", self.restitution)

    @property
    def rows(self) -> int:
        """Number of gaps and slips, of which a contact problem may have ``MOST_ROWS``."""
        return 1 + len(slips_of(self))

    def __post_init__(self) -> None:
        shown = f"the contact '{self.gap}'"
        _set_slip(self, shown)
        if (self.slip is None) != (self.friction is None):
            passed, lacking = ("friction", "slip") if self.slip is None else ("slip", "friction")
            raise SystemDefinitionError(
                f"{shown} has {passed}={getattr(self, passed)!r} without {lacking}=: friction requires the slip "
                "velocity, such as 'x_dot - r*a_dot', and a coefficient; omit both for a smooth contact"
            )
        if self.friction is None and self.static_friction is not None:
            raise SystemDefinitionError(f"{shown} has static_friction= without friction=: give slip= and friction=")
        if self.friction is not None:
            _check_limits(shown, ("friction", self.friction), ("static_friction", self.static_friction))
        e = _number(self.restitution)
        if e is not None and not 0.0 <= e <= 1.0:
            raise SystemDefinitionError(f"restitution={self.restitution!r} of {shown} is invalid: give 0 to 1")
        if self.impacts not in [*Impacts]:
            laws = " or ".join(f"'{law}'" for law in Impacts)
            raise SystemDefinitionError(f"impacts={self.impacts!r} of {shown} is unknown: give {laws}")
        for name in ("where", "of"):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        _ = self.conditions


@dataclass(frozen=True, slots=True)
class Friction:
    """Dry friction without a gap, made by :func:`friction`.

    Attributes:
        slip: slip velocity w, linear in the velocities, or its two components in space.
        limit: friction force F of sliding, a formula of (q, v, t) and parameters.
        static_limit: force up to which it sticks; ``None``: F.
        name: name in messages; by default the formula of the slip.
    """

    slip: Formula | tuple[Formula, ...]
    limit: Formula
    static_limit: Formula | None = None
    name: str = ""

    @property
    def table(self) -> dict[str, Any]:
        """Arguments by name, as in ``[[contacts]]`` of a model file."""
        return _table(self)

    @property
    def laws(self) -> tuple[Expr, Expr, Expr]:
        """Limits of friction and static friction, and 0, of expressions."""
        return *limits_of(self), zero()

    @property
    def rows(self) -> int:
        """Number of gaps and slips, of which a contact problem may have ``MOST_ROWS``."""
        return len(slips_of(self))

    def __post_init__(self) -> None:
        _set_slip(self, f"the friction '{self.slip}'")
        _check_limits(f"the friction '{self.slip}'", ("limit", self.limit), ("static_limit", self.static_limit))


def _set_slip(item: Any, shown: str) -> None:
    """Replace a list of slips by a tuple; raise unless it has two components, of which one alone is no list."""
    if isinstance(item.slip, list | tuple):
        if len(item.slip) != 2:
            raise SystemDefinitionError(
                f"slip={item.slip!r} of {shown} has {len(item.slip)} components: give one formula in a plane, or two"
            )
        object.__setattr__(item, "slip", tuple(item.slip))


def slips_of(item: Any) -> tuple[Any, ...]:
    """Return the components of the slip of a contact."""
    if item.slip is None:
        return ()
    return item.slip if isinstance(item.slip, tuple) else (item.slip,)


def _number_or_text(value: Any) -> float | str:
    return value if isinstance(value, int | float) else str(value)


def _table(item: Any) -> dict[str, Any]:
    """Return the table of a contact: its formulas as text, and its numbers."""
    values = {name: getattr(item, name) for name in item.__dataclass_fields__}
    plain = {
        name: [*map(str, value)] if isinstance(value, tuple) else _number_or_text(value)
        for name, value in values.items()
        if value is not None
    }
    named = {"surface" if name == "gap" and plain.get("of") else name: value for name, value in plain.items()}
    defaults: dict[str, Any] = {"restitution": 0.0, "of": [], "name": "", "impacts": Impacts.SEQUENTIAL}
    return {name: value for name, value in named.items() if name not in defaults or value != defaults[name]}


ContactLike: TypeAlias = "Contact | Friction"


def contacts_of(tables: Sequence[Mapping[str, Any]]) -> tuple[ContactLike, ...]:
    """Return the contacts of tables of their arguments: those with a gap, and friction without."""
    contacts: list[ContactLike] = []
    for table in tables:
        kind: Any = Friction if {"gap", "surface"}.isdisjoint(table) else Contact
        arguments = [*kind.__dataclass_fields__, *(("surface",) if kind is Contact else ())]
        if unknown := sorted(set(table) - set(arguments)):
            raise SystemDefinitionError(
                f"'{unknown[0]}' of a contact is unknown{closest(unknown[0], arguments)} Known: {', '.join(arguments)}"
            )
        lacking = [name for name in ("slip", "limit") if kind is Friction and name not in table]
        if lacking:
            raise SystemDefinitionError(f"a contact requires gap=, or slip= and limit= of friction: give {lacking[0]}=")
        contacts.append((contact if kind is Contact else Friction)(**table))
    return tuple(contacts)


def names_in(tables: Iterable[Mapping[str, Any]]) -> set[str]:
    """Return the names in the formulas of contacts, by the tables of these."""
    formulas = (str(value) for table in tables for key, value in table.items() if key not in WORDS)
    return set(re.findall(r"[A-Za-z_]\w*", " ".join(formulas)))


def contact(
    gap: Formula | None = None,
    *,
    surface: Formula | None = None,
    of: Sequence[str | Symbol] = (),
    slip: Formula | Sequence[Formula] | None = None,
    friction: Formula | None = None,
    static_friction: Formula | None = None,
    restitution: Formula = 0.0,
    where: str | Basic | Sequence[str | Basic] | None = None,
    name: str = "",
    impacts: str = Impacts.SEQUENTIAL,
) -> Contact:
    """Return a unilateral contact of a system: gap >= 0 with normal force and Coulomb friction.

    The gap must be a distance to first order, ``|g_q| = 1`` in the units of the slip, because friction is mu times the
    normal *force*. ``surface="z - x**2/2", of=["x", "z"]`` is the gap ``(z - x**2/2)/sqrt(1 + x**2)``.

    Args:
        gap: g(q, t), a formula in coordinates, entries of rotations and directions, time and parameters;
            ``"y[i] for i in 4"`` for each element.
        surface, of: instead of a gap a function that is 0 on the surface and positive outside, which is divided by the
            norm of its gradient with respect to the position of the point, the Cartesian coordinates ``of``.
        slip: w = T(q, t) v + b(q, t), the velocity of sliding, ``"x_dot - r*a_dot"``; in space its two components in
            orthonormal directions of the surface, ``["x_dot", "y_dot"]``. It is linear in angular velocities, too.
        friction, static_friction: coefficients of sliding and of sticking friction, numbers or formulas.
        restitution: coefficient of impacts, 0 to 1; with 0 the contact closes at once.
        where: condition of the places and times where the contact exists, ``"x < 1"`` of a table with an edge, or a
            list of them. It opens where one fails; what is behind its surface passes freely.
        name: name in messages; by default the formula of the gap.
        impacts: with other contacts at the same time: ``"sequential"``, one after another until none approaches, or
            ``"simultaneous"``, by Newton's law for all of this kind that touch.

    >>> contact("y - r", slip="x_dot - r*a_dot", friction=0.3).friction
    0.3
    """
    if (gap is None) == (surface is None) or (surface is None) == bool(of):
        raise SystemDefinitionError("give a contact either its gap=, a distance, or surface= and the coordinates of=")
    distance = cast("Formula", surface if gap is None else gap)
    further = cast(Any, where), tuple(of), name, impacts
    return Contact(distance, cast(Any, slip), friction, static_friction, restitution, *further)


def friction(
    slip: Formula | Sequence[Formula], *, limit: Formula, static_limit: Formula | None = None, name: str = ""
) -> Friction:
    """Return dry friction without a gap, of joints and belts: sticking up to ``static_limit``, sliding with ``limit``.

    >>> friction("x_dot - 0.3", limit="0.25", static_limit="0.4").limit
    '0.25'
    """
    return Friction(cast(Any, slip), limit, static_limit, name)


def limits_of(item: Any) -> tuple[Any, Any]:
    """Return the coefficients or the forces of friction: with which a contact slides, and up to which it sticks."""
    sliding, static = (
        (item.friction, item.static_friction) if isinstance(item, Contact) else (item.limit, item.static_limit)
    )
    return sliding, sliding if static is None else static


def coefficients(system: Any) -> list[Expr]:
    """Return the ``laws`` of each contact, one after another."""
    return [law for item in system.contacts for law in item.laws]


def zero() -> Any:
    """Return 0 as an expression."""
    from sympy import S

    return S.Zero
