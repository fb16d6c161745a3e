"""Constraints, forces and transitions of contacts in all their modes, for one compiled step.

Masks of the modes multiply the rows of constraints (:class:`~scvi_codegen.systems.constraints.kind.Reaction`);
the functions of transitions are 1 in modes that they do not end. Runs choose the modes (``support/run/contacts.h``).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import repeat
from operator import mul, sub
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.contact import WORDS, Contact, ContactLike, Friction, Impacts, limits_of, slips_of
from scvi_codegen.systems.contacts.rows import ContactRows
from scvi_codegen.systems.event import LOOPS, Formula
from scvi_codegen.systems.formulas.expressions import gradient_tuple
from scvi_codegen.systems.formulas.indices import Array, Size
from scvi_codegen.systems.formulas.intermediates import intermediates, parts
from scvi_codegen.systems.formulas.symbols import DOT

if TYPE_CHECKING:
    from sympy import Expr, Symbol

    from scvi_codegen.systems.lagrangian import LagrangianSystem


EQUAL = Fraction(1, 10**10)
"""Part by which static friction may be less than that of sliding, ``CONTACT_ROUNDING`` of ``contact_rows.h``."""
LEAST_SLIP = 10**200
"""Inverse fourth power of a slip that is no direction: formulas of a vector that may be 0 are finite."""


class Slipping(NamedTuple):
    """Direction of a slip, the function that vanishes where it stops, and the names of the parameters of both."""

    direction: tuple[Expr, ...]
    ahead: Expr
    names: tuple[str, ...]


class BoundContacts(NamedTuple):
    """System whose step has the modes of its contacts as parameters, with what a run needs of them.

    Attributes:
        system: with masked constraints and, as ``contacts``, the formulas as expressions.
        rows: places of each contact.
    """

    system: LagrangianSystem
    rows: tuple[ContactRows, ...]


def bound_contacts(system: Any, contacts: Sequence[ContactLike]) -> BoundContacts:
    """Return the system with the constraints and forces of contacts in all their modes.

    Raises:
        SystemDefinitionError: for a system without contacts of this kind, unknown symbols, a gap with velocities, and a
            slip that is not linear in them; the message names the formula and the symbol.
    """
    from scvi_codegen.systems.lagrangian import LagrangianSystem

    if not isinstance(system, LagrangianSystem) or system.clock or system.gauge != 0:
        raise SystemDefinitionError(
            f"contacts of '{system.name}' are not supported: they require a Lagrangian in named coordinates with "
            "masses, and in physical time"
        )
    return _Binding(system).bound(contacts)


def in_all_modes(system: Any) -> Any:
    """Return a system with the constraints and forces of its contacts, if it has any, in all their modes."""
    is_bound = any(getattr(system, "reactions", ()))
    return system if is_bound or not getattr(system, "contacts", ()) else bound_contacts(system, system.contacts).system


class _Binding:
    """Constraints, forces, parameters and events of the contacts of a system."""

    def __init__(self, system: LagrangianSystem) -> None:
        import sympy

        from scvi_codegen.systems.formulas.grammar import named_tables
        from scvi_codegen.systems.formulas.rotations import RotationNames
        from scvi_codegen.systems.formulas.symbols import input_formulas, symbol

        self.sympy, self.system, self.symbol = sympy, system, symbol
        self.turning = RotationNames(system.rotations)
        ordinary = system.dimension - len(self.turning.coordinates)
        moving = [*system.velocities[:ordinary], *(x for member in system.rotations for x in member.rates)]
        own = (*system.coordinates[:ordinary], *moving, *self.turning.values, system.time, *system.parameters)
        self.names = {x.name: x for x in own} | {name: symbol(name) for name in system.inputs}
        self.moving = {*moving}
        self.functions = named_tables(system.functions)
        self.driven = input_formulas(system.inputs, system.time)
        self.masks: list[Symbol] = []
        self.quantities: dict[Expr, Symbol] = {}
        self.constraints: list[Expr] = []
        self.reactions: list[Any] = []
        self.forces = [*(system.forces or (sympy.S.Zero,) * system.dimension)]

    def bound(self, contacts: Sequence[ContactLike]) -> BoundContacts:
        """Return the system with these contacts."""
        expressions, rows = [], []
        elements = [element for item in contacts for element in self._elements(item)]
        for number, item in enumerate(elements, 1):
            named = mapped(item, partial(self._read, item))
            if getattr(named, "of", ()):
                named = replace(named, gap=self._distance(item, named.gap, named.of), of=())
            expressions.append(mapped(named, lambda formula, _: self.turning.in_coordinates(formula)))
            rows.append(self._add(number, named))
        reduced = self.system.reduced
        system = replace(
            self.system,
            parameters=(*self.system.parameters, *self.masks),
            defaults=(*self.system.defaults, *(0.0 for _ in self.masks)),
            constraints=(*self.system.constraints, *map(self.turning.in_coordinates, self.constraints)),
            forces=tuple(self.forces) if any(self.forces) else (),
            reactions=tuple(self.reactions),
            contacts=tuple(expressions),
            reduced=reduced and replace(reduced, constraints=(*reduced.constraints, *self.constraints)),
        )
        return BoundContacts(system, tuple(rows))

    def _distance(self, item: ContactLike, surface: Expr, position: Sequence[Symbol]) -> Expr:
        """Return the distance from a surface to first order, g/|g_x|."""
        if other := [x for x in position if x not in self.system.coordinates]:
            raise SystemDefinitionError(
                f"of= of the contact '{surface}' contains '{other[0]}': give coordinates of the point, among "
                f"{', '.join(map(str, self.system.coordinates))}"
            )
        gradient = self._gradient(item, surface, position, "gap")
        return surface / self.sympy.sqrt(self.sympy.Add(*(x**2 for x in gradient)))

    def _elements(self, item: ContactLike) -> list[ContactLike]:
        """Return the contacts of the elements of the loops of a contact, with formulas of the entries of arrays."""
        from scvi_codegen.systems.formulas.array_statements import EntryRules, entry_names, parse_constraint

        if not isinstance(item, Contact | Friction):
            raise SystemDefinitionError(f"contacts are made by contact(..) and friction(..), not {item!r}")
        mapped(item, self._check_multipliers)
        formula = item.gap if isinstance(item, Contact) else slips_of(item)[0]
        first = str(formula)
        loops, arrays, indices = "".join(LOOPS.findall(first)), self.system.arrays, self.system.indices
        if not arrays and loops:
            raise SystemDefinitionError(f"'{first}' of a contact has loops: declare coordinates as arrays, 'y[4]'")
        if not arrays or not isinstance(formula, str):
            return [item]
        sizes = {name: size for name, size in indices.items() if isinstance(size, int)}
        entries = (
            *arrays,
            *(Array(array.name + DOT, array.axes) for array in arrays),
            Array("", tuple(map(Size, sizes))),
        )
        rules = EntryRules(sizes, {}, {array.name: entry_names(array, {}) for array in arrays})

        def formulas(value: Any) -> Iterable[Any]:
            if isinstance(value, tuple) and value:
                return zip(*map(formulas, value), strict=True)
            if not isinstance(value, str):
                return repeat(value)
            term = parse_constraint(value if value == first else value + loops, entries, self.names | self.functions)
            return rules.formulas(term)

        fields = {name: getattr(item, name) for name in item.__dataclass_fields__ if name not in WORDS}
        if fields.get("where") is not None:
            fields["where"] = tuple(map(str, cast("Contact", item).conditions))  # formulas that are >= 0
        elements = []
        for values in zip(*map(formulas, fields.values()), strict=False):
            element = dict(zip(fields, values, strict=True))
            if element.get("where") is not None:
                element["where"] = tuple(self.sympy.Ge(part, 0, evaluate=False) for part in element["where"])
            elements.append(replace(cast("Any", item), **element))
        return elements

    def _check_multipliers(self, formula: Formula, role: str) -> Formula:
        """Raise for multipliers, which friction changes: they are unknowns of the contact problem, no numbers in it."""
        from scvi_codegen.systems.formulas.grammar import declaration_of

        for name in re.findall(r"\blambda_\d+\b", str(formula)):
            if name not in self.names:
                raise SystemDefinitionError(
                    f"'{name}' in {role}='{formula}' of a contact of '{self.system.name}': {declaration_of(name)}"
                )
        return formula

    def _read(self, item: ContactLike, formula: Formula, role: str) -> Expr:
        """Return a formula in the names of rotations and directions."""
        if isinstance(formula, str):
            expression = self.turning.read(formula, self.names | self.functions)
        else:
            expression = self.sympy.sympify(formula)
            decimals = [part for part in parts(expression) if part.is_Float]  # each once, unlike nsimplify
            expression = expression.xreplace({x: self.sympy.nsimplify(x, rational=True) for x in decimals})
            expression = expression.xreplace({x: self.names.get(x.name, x) for x in expression.free_symbols})
        if unknown := sorted(x.name for x in expression.free_symbols - {*self.names.values()}):
            raise SystemDefinitionError(
                f"'{unknown[0]}' in {role}='{formula}' of a contact of '{self.system.name}' is not among its names: "
                f"{', '.join(self.names)}"
            )
        return cast("Expr", expression.xreplace(self.driven))

    def _named(self, number: int, role: str) -> Symbol:
        name = f"contact_{number}_{role}"
        if name in self.names:
            raise SystemDefinitionError(f"the name '{name}' of '{self.system.name}' is that of a contact: rename it")
        return self.symbol(name)

    def _mask(self, number: int, role: str) -> Symbol:
        self.masks.append(self._named(number, role))
        return self.masks[-1]

    def _add_quantities(self, number: int, formulas: Sequence[Expr]) -> tuple[tuple[str, str], ...]:
        """Name the intermediate quantities in formulas; return the names and formulas of new ones."""
        first = len(self.quantities)
        of_tables = {quantity for quantity in intermediates(*formulas) if quantity.arguments}
        new = [part for part in intermediates(*formulas, without=of_tables) if part not in self.quantities]
        self.quantities |= {part: self._named(number, f"quantity_{k}") for k, part in enumerate(new, first + 1)}
        return tuple((self.quantities[part].name, self._text_of(part.definition)) for part in new)

    def _text_of(self, formula: Expr) -> str:
        """Return a formula in the names of quantities."""
        return self.system.text_of(formula.xreplace(self.quantities))

    def _row(self, formula: Expr, active: Symbol, direction: Sequence[Expr]) -> int:
        """Add a masked constraint; return its number among them."""
        from scvi_codegen.systems.constraints.kind import Reaction

        self.constraints.append(formula)
        self.reactions.append(Reaction(active=active, direction=tuple(map(self.turning.in_coordinates, direction))))
        return len(self.constraints) - 1

    def _multiplier(self, row: int) -> Symbol:
        return self.symbol(f"lambda_{len(self.system.constraints) + row + 1}")

    def _gradient(self, item: ContactLike, formula: Expr, variables: Sequence[Symbol], role: str) -> list[Expr]:
        """Return the derivatives of a gap or a slip; raise unless they contain no velocities and do not vanish."""
        in_coordinates = self.turning.in_coordinates(formula)
        gradient = [*gradient_tuple(in_coordinates, variables)]
        moving = formula.free_symbols & self.moving
        if role == "slip":
            moving &= {x for slope in gradient_tuple(formula, [*moving]) for x in slope.free_symbols}
        if moving or not any(gradient):
            form = "a function of positions and time" if role == "gap" else "linear in velocities, and contain one"
            raise SystemDefinitionError(
                f"{role}='{formula}' of a contact of '{self.system.name}' must be {form}"
                f"{f': it contains {min(map(str, moving))}' if moving else ''}"
            )
        return gradient

    def _check_friction(self, item: Any) -> None:
        """Raise if friction jumps where a slip vanishes: its value at rest would be that of the motion before."""
        from scvi_codegen.systems.formulas.kinks import switching_function, unit_step

        for slip, name in itertools.product(slips_of(item), ("friction", "static_friction", "limit", "static_limit")):
            formula = self.sympy.sympify(getattr(item, name, None) or 0)
            signs = {u: switching_function(u.args[0]) for u in formula.atoms(unit_step)}
            at_zero = [u for u, (function, _) in signs.items() if function == switching_function(slip)[0]]
            above, below = (formula.xreplace({u: int(signs[u][1] == side) for u in at_zero}) for side in (1, -1))
            velocity = min(slip.free_symbols & self.moving, key=str)
            if at_zero and self.sympy.simplify((above - below).subs(velocity, self.sympy.solve(slip, velocity)[0])):
                raise SystemDefinitionError(
                    f"{name}='{formula}' of a contact of '{self.system.name}' jumps where its slip '{slip}' vanishes: "
                    "friction at rest would depend on the motion before. Give one that is continuous there, and "
                    "static_friction= or static_limit= at rest"
                )

    def _add(self, number: int, item: Any) -> ContactRows:
        of_gap, slips = isinstance(item, Contact), slips_of(item)
        along = [*map(partial(self._gradient, item, variables=self.system.velocities, role="slip"), slips)]
        self._check_friction(item)
        closed = self._mask(number, "closed") if of_gap else self.sympy.S.One
        sticks = [self._mask(number, f"sticks_{k}") for k, _ in enumerate(slips, 1)]
        moving = self._slipping(number, slips)
        held = self._mask(number, "held")
        sliding, static = limits_of(item)
        drag = [sliding * self.sympy.Add(*map(mul, moving.direction, column)) for column in zip(*along, strict=True)]
        normal, pressure = None, self.sympy.S.One
        transitions: list[tuple[str, Expr]] = []
        conditions: list[Expr] = []
        if of_gap:
            force = self._gradient(item, item.gap, self.system.coordinates, "gap")
            normal = self._row(item.gap, closed, [*map(sub, force, drag)] or force)
            pressure = self._multiplier(normal)
            transitions += ("closes", item.gap + closed + held), ("lifts", _in_mode(closed, pressure))
            conditions += map(partial(self._read, item, role="where"), item.conditions)
        else:
            self.forces = [*map(sub, self.forces, map(self.turning.in_coordinates, drag))]
        rows = [*map(self._row, slips, sticks, along)]
        leaves = [("leaves", closed * u + (1 - closed) ** 2) for u in conditions]  # u if closed
        if slips:
            margins = _margins(pressure * static, [*map(self._multiplier, rows)])
            begins = [(kind, _in_mode(sticks[0], margin)) for kind, margin in margins.items()]
            drives = zip(repeat("drives"), self._watched(sliding, static, closed, sticks), strict=False)
            transitions += ("stops", (1 - held) * moving.ahead + held), *begins, *leaves, *drives
        else:
            transitions += leaves
        quantities = self._add_quantities(number, [*(function for _, function in transitions), *conditions])
        where = [f"{self._text_of(u)} >= 0" for u in conditions]
        functions = tuple(
            (kind, self._text_of(function), *(where if kind == "closes" else ())) for kind, function in transitions
        )
        return ContactRows(
            normal=normal,
            tangential=next(iter(rows), None),
            slips=len(slips),
            closed=str(closed) if of_gap else None,
            sticks=tuple(map(str, sticks)),
            directions=moving.names,
            held=held.name,
            title=item.name or self._title(item),
            transitions=functions,
            impacts=getattr(item, "impacts", Impacts.SEQUENTIAL),
            quantities=quantities,
            varies=bool(slips) and not sliding.free_symbols <= {*self.system.parameters},
        )

    def _title(self, item: ContactLike) -> str:
        """Return the formulas of a contact without a name, for messages."""
        part, formulas = ("gap", (item.gap,)) if isinstance(item, Contact) else ("slip", slips_of(item))
        return f"{part} '{' and '.join(map(self.system.text_of, formulas))}'"

    def _watched(self, sliding: Expr, static: Expr, closed: Expr, sticks: Sequence[Symbol]) -> Iterator[Expr]:
        """Yield what must not become negative: friction, and by how much that at rest exceeds it; 1 in other modes."""
        excess = self.sympy.S.Zero if static == sliding else static - (1 - EQUAL) * sliding
        for formula, mask in ((sliding, closed), (excess, sticks[0])):
            if not (formula.is_nonnegative or formula.free_symbols <= {*self.system.parameters}):
                yield _in_mode(mask, formula)

    def _slipping(self, number: int, slips: Sequence[Expr]) -> Slipping:
        """Return the direction of a slip w: a parameter d in a plane, else that of (ahead.w) w + start."""
        if not slips:
            return Slipping((), self.sympy.S.One, ())
        if len(slips) == 1:
            d = self._mask(number, "direction")
            return Slipping((d,), d * slips[0] + 1 - d**2, (d.name,))
        slides, *vectors = (self._mask(number, role) for role in ("slides", "start_1", "start_2", "ahead_1", "ahead_2"))
        ahead = self.sympy.Add(*(w * a for w, a in zip(slips, vectors[2:], strict=True)))
        vector = [ahead * w + start for w, start in zip(slips, vectors[:2], strict=True)]
        length = self.sympy.sqrt(
            self.sympy.Add(*(x**2 for x in vector)) + 1 - slides + self.sympy.Rational(1, LEAST_SLIP)
        )
        names = (slides.name, *(vector.name for vector in vectors))
        return Slipping(tuple(slides * x / length for x in vector), slides * ahead + 1 - slides, names)


def _in_mode(mask: Expr, function: Expr) -> Expr:
    """Return a function that is 1 where its mask is 0."""
    return mask * function + 1 - mask


def _margins(limit: Expr, tau: Sequence[Expr]) -> dict[str, Expr]:
    """Return by how much friction at rest stays within its limit, by the kind of slip that begins where it is 0.

    In a plane the slip begins against the force: backward at tau = limit, forward at tau = -limit.
    """
    if len(tau) == 1:
        return {"backward": limit - tau[0], "forward": limit + tau[0]}
    return {"begins": limit**2 - tau[0] ** 2 - tau[1] ** 2}


def mapped(item: ContactLike, function: Callable[[Any, str], Any]) -> Any:
    """Return a contact with the values of a function of each of its formulas and the role of this."""

    def of(formulas: Any, role: str) -> Any:
        return (
            tuple(function(part, role) for part in formulas)
            if isinstance(formulas, tuple)
            else function(formulas, role)
        )

    fields = {name: getattr(item, name) for name in item.__dataclass_fields__ if name not in ("where", *WORDS)}
    return replace(cast("Any", item), **{name: of(value, name) for name, value in fields.items() if value is not None})
