"""Base class of systems defined by a Lagrangian or a Hamiltonian: names, parameters and one function.

All later stages use one thing, a function whose stationary action gives the equations of motion:

    L(q, v, t)            of a :class:`~scvi_codegen.systems.lagrangian.LagrangianSystem`, no auxiliary variables,
    p . v - H(q, p, t)    of a :class:`~scvi_codegen.systems.hamiltonian.HamiltonianSystem`, with the momenta p as
    auxiliary variables

(Hamilton's principle, and Hamilton's principle in phase space: paper, section 1.1). Auxiliary variables are further
unknowns at every point where the function is evaluated; the action is stationary in them, too.

Arrays whose sizes each run determines (:class:`~scvi_codegen.systems.arrays.system.ArraySystem`) answer the same
questions, with an array in place of the coordinates that are its entries; they have no formula as a whole.

A new kind of system is a frozen dataclass derived from :class:`MechanicalSystem` with the properties ``lagrangian``
and ``auxiliaries``, and ``formula``, the user's function; it validates itself on construction. Methods and lowering
use nothing else, and expressions derived from them only through
:func:`~scvi_codegen.systems.derived_expressions.forms_of`. Matrix-free solvers also use an equivalent Lagrangian, if
one is known (:func:`~scvi_codegen.systems.legendre.transform.equivalent_lagrangian`).

Formulas of systems defined by text are read only when they are first needed.
An integrator that was compiled before needs no formulas, hence no SymPy: the cache contains the key of its system under
all arguments of ``from_text``, its class and the versions of this package and of SymPy. The entry is written by
:meth:`Deferred.store_key`, and only for text that was read without error or warning.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

from scvi_codegen.common.cache import key_of, store_text, stored_text
from scvi_codegen.common.display.cards import Html, card, listed, plain
from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.common.validation import ArgumentType, ExactNumber, of
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.formulas.symbols import DOT, number, symbol

if TYPE_CHECKING:
    from sympy import Expr, Symbol

    from scvi_codegen.systems.constraints.kind import Reaction
    from scvi_codegen.systems.contact import ContactLike
    from scvi_codegen.systems.formulas.rotations import Homogeneous, Reduced
    from scvi_codegen.systems.formulas.table import Table


class Deferred:
    """Base of frozen dataclasses with slots: fields without a value are read from text when they are first accessed.

    ``_text`` contains the arguments of ``from_text`` as JSON, and ``_key`` the key found in the cache; both are
    ``None`` for objects made in another way.
    """

    __slots__ = ("_key", "_text")
    _key: str | None
    _text: str | None

    @classmethod
    def _read(cls, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
        """Return the system of these arguments, and whether warnings were issued."""
        raise NotImplementedError

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
        return (self._key or key_of(self),)

    def store_key(self) -> None:
        """Store the key of a system that was read from text, so that later processes need not read the text."""
        if self._text is not None and self._key is None:
            (key,) = self.key()
            store_text(("system", self._text), key)
            object.__setattr__(self, "_key", key)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Read the text if ``name`` is a field; called only for attributes without a value."""
            if name in Deferred.__slots__:
                return None
            names = [field.name for field in fields(self)]
            if name not in names or self._text is None:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
            system, _ = self._read(json.loads(self._text)[1])
            for field_name in names:
                object.__setattr__(self, field_name, getattr(system, field_name))
            return getattr(self, name)


def _text_of(cls: type, arguments: Mapping[str, Any]) -> str | None:
    """Return the class and the arguments as JSON; ``None`` for arrays, derived classes and other objects."""
    if cls.__module__.partition(".")[0] != __name__.partition(".")[0] or are_arrays(
        arguments["coordinates"], arguments["parameters"] or (), arguments["tables"]
    ):
        return None
    if any(isinstance(value, ExactNumber) for value in (arguments["parameters"] or {}).values()):
        return None  # JSON has one word
    plain = {name: dict(value) if isinstance(value, Mapping) else value for name, value in arguments.items()}
    try:
        return json.dumps([f"{cls.__module__}.{cls.__qualname__}", plain])
    except (TypeError, ValueError):
        return None


def tables_of_contacts(contacts: Iterable[Any]) -> list[dict[str, Any]]:
    """Return contacts and tables as tables of their arguments, as of ``[[contacts]]`` in model files."""
    plain = (item if isinstance(item, Mapping) else item.table for item in contacts)
    return [dict(table) for table in plain]


def are_arrays(*declarations: Any) -> bool:
    """Return whether one of the coordinates, parameters or tables is an array."""
    return any("[" in str(declaration) for group in declarations for declaration in group)


BATH_ENERGY = "a heat bath exchanges it"
"""Reason why the energy is not conserved; followed by those of further changes."""
MAX_OPERATIONS = 200
"""Maximum number of operations of a formula shown in a notebook."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeTransformation:
    """Time transformation dt = g dtau of a system that moves in fictitious time tau (:func:`reparametrise`).

    Attributes:
        rate: g = dt/dtau, a function of the coordinates (for a Hamiltonian also of the momenta).
        energy: the parameter that is the energy of the initial state; the function of the system is then
            rate (energy of the state - energy), zero along trajectories.
        time_transformation: the rate as requested, by name or as text; it and ``plain`` are for model files.
        plain: the system in physical time.
    """

    rate: Expr
    energy: Symbol
    time_transformation: str | None = field(default=None, compare=False)
    plain: MechanicalSystem | None = field(default=None, compare=False, repr=False)


def zero() -> Expr:
    """Return SymPy's 0, the default value of fields."""
    from sympy import S

    return S.Zero


@dataclass(frozen=True, slots=True, kw_only=True)
class MechanicalSystem(Deferred, ABC):
    """Coordinates, time and parameters with default values; subclasses add the function.

    Attributes:
        name: name of the system.
        coordinates: the m coordinates, in order.
        time: the symbol ``t``.
        parameters: the symbols that stay adjustable in the compiled integrator; one may be absent from the function.
        defaults: their default values, parallel to ``parameters``.
        clock: time transformation, if any.
        forces: m generalised forces in addition to the function (:mod:`scvi_codegen.systems.derived_expressions`), in
            (q, v, t) for a Lagrangian and (q, p, t) for a Hamiltonian, or empty (:mod:`scvi_codegen.systems.forces`).
        damping: damping rate gamma of all momenta, a formula of parameters, 0 without damping
            (:mod:`scvi_codegen.systems.forces`).
        functions: tables by name, which texts of formulas call (:class:`~scvi_codegen.systems.formulas.table.Table`).
        inputs: names of inputs, each represented by five of the parameters
            (:mod:`scvi_codegen.systems.formulas.symbols`).
        input_ranges: name, smallest and largest value of inputs that runs clamp to these.
        constraints: expressions in (q, t), or linear in v, that are 0 along trajectories of a Lagrangian
            (:mod:`scvi_codegen.systems.forces`).
        reactions: masks and directions of force of the last constraints, as of contacts
            (:class:`~scvi_codegen.systems.constraints.kind.Reaction`).
        contacts: contacts and dry friction (:mod:`scvi_codegen.systems.contact`).
        arrays: declarations of the arrays of known sizes whose entries are coordinates and parameters.
        indices: sizes and index tables of these arrays by name, for events in index notation.
        lengths: cutoffs and periods of lists of neighbours
            (:class:`~scvi_codegen.systems.formulas.neighbours.Neighbours`).
        definition: the text with arrays or rotations that the system was read from, for model files; else empty.
        rotations: rotations, directions and spins, whose coordinates follow the ordinary ones
            (:mod:`scvi_codegen.systems.formulas.rotations`).
        bath: heat bath of a Lagrangian, with its friction (:mod:`scvi_codegen.systems.bath`).
    """

    KIND: ClassVar[ArgumentType]
    """Kind of an argument that is a system of known sizes, for ``checks_arguments``."""
    OR_ARRAYS: ClassVar[ArgumentType]
    """The same for systems that may have arrays of run-time sizes."""
    name: str
    coordinates: tuple[Symbol, ...]
    time: Symbol
    parameters: tuple[Symbol, ...]
    defaults: tuple[float, ...]
    clock: TimeTransformation | None = None
    forces: tuple[Expr, ...] = ()
    constraints: tuple[Expr, ...] = ()
    reactions: tuple[Reaction, ...] = ()
    contacts: tuple[ContactLike, ...] = ()
    functions: tuple[tuple[str, Table], ...] = ()
    inputs: tuple[str, ...] = ()
    input_ranges: tuple[tuple[str, float, float], ...] = ()
    damping: Expr = field(default_factory=zero)
    arrays: tuple[Array, ...] = field(default=(), compare=False)
    indices: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    definition: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    rotations: tuple[Homogeneous, ...] = ()
    lengths: tuple[tuple[str, ...], ...] = ()
    bath: Any = None

    @property
    @abstractmethod
    def lagrangian(self) -> Expr:
        """Function of (q, v, t) and of the auxiliary variables whose action is stationary."""

    @property
    @abstractmethod
    def auxiliaries(self) -> tuple[Symbol, ...]:
        """Auxiliary variables of :attr:`lagrangian`, m or none."""

    @property
    @abstractmethod
    def formula(self) -> Expr:
        """Function that defines the system: L or H."""

    @classmethod
    def __subclasshook__(cls, other: type) -> bool:
        """Count systems of arrays of run-time sizes as instances of the class that they name in ``ACTS_AS``, too."""
        return getattr(other, "ACTS_AS", None) == cls.__name__ or NotImplemented

    @property
    def reduced(self) -> Reduced | None:
        """Formulas of a Lagrangian in the names of rotations and directions; ``None`` without these."""
        return None

    @property
    def gauge(self) -> Expr:
        """Energy that is 0 on the states considered and makes the Legendre transform regular."""
        return zero()

    @property
    def dual_energy(self) -> Expr:
        """Kinetic energy of a Lagrangian in coordinates and momenta, 0 if it is not known."""
        return zero()

    @property
    def constrained_at_nodes(self) -> bool:
        """True if there are constraints or contacts, which an SVI imposes at its nodes; reads no formulas."""
        return self.has_contacts or bool(
            self.constraints if self._text is None else json.loads(self._text)[1]["constraints"]
        )

    @property
    def has_contacts(self) -> bool:
        """True if there are contacts whose modes are no parameters yet; reads no formulas."""
        if self._text is None:
            return bool(self.contacts) and not self.reactions
        return bool(json.loads(self._text)[1].get("contacts"))

    @property
    def is_prescribed(self) -> bool:
        """True if there are as many constraints as coordinates, which then prescribe the motion."""
        return 0 < len(self.constraints) - len(self.reactions) == self.dimension

    @property
    def is_rolling(self) -> bool:
        """True if a constraint is a condition on velocities that does not follow from one on positions."""
        from scvi_codegen.systems.constraints import velocity_conditions  # imported here: it imports SymPy

        return any(velocity_conditions(self))

    @property
    def has_friction(self) -> bool:
        """True if a constraint force is oblique, as of contacts with friction, and does work."""
        from scvi_codegen.systems.constraints import has_oblique_forces

        return bool(self.reactions) and has_oblique_forces(self)

    @property
    def is_first_order(self) -> bool:
        """True if the function is linear in the velocities, so that half of the variables are momenta."""
        return False

    @property
    def is_canonical(self) -> bool:
        """False if the momenta of a first-order system are functions of its variables."""
        return True

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of the sizes of arrays that each run determines; none of named coordinates."""
        return ()

    @property
    def mesh(self) -> Any:
        """Mesh of the fields of a density; ``None`` for other systems."""
        return None

    @property
    def drawn_links(self) -> tuple[Any, ...]:
        """Links of a robot from a file, for pictures; reads no formulas."""
        return ()

    @property
    def dimension(self) -> int:
        """Number m of coordinates."""
        return len(self.coordinates)

    @property
    def velocities(self) -> tuple[Symbol, ...]:
        """Symbols of the m velocities, parallel to ``coordinates``."""
        return tuple(symbol(coordinate.name + DOT) for coordinate in self.coordinates)

    @property
    def momentum_symbols(self) -> tuple[Symbol, ...]:
        """Symbols of the m momenta: for a Lagrangian ``p_`` and the coordinate, preceded by ``_`` if not unique."""
        taken = {symbol.name for symbol in (*self.coordinates, *self.velocities, *self.parameters)}
        return self.auxiliaries or tuple(symbol(_free(f"p_{q.name}", taken)) for q in self.coordinates)

    @property
    def _common_fields(self) -> dict[str, Any]:
        """Fields that a Lagrangian and its Hamiltonian have in common, by name."""
        names = (
            *("name", "coordinates", "time", "parameters", "defaults"),
            *("damping", "inputs", "input_ranges", "functions", "rotations", "lengths"),
        )
        return {name: getattr(self, name) for name in names}

    @property
    def constants(self) -> dict[Symbol, float]:
        """Default values by parameter."""
        return dict(zip(self.parameters, self.defaults, strict=True))

    @property
    def constants_by_name(self) -> dict[str, float]:
        """Default values by the names of parameters."""
        return {parameter.name: value for parameter, value in self.constants.items()}

    @property
    def integrands(self) -> tuple[Expr, ...]:
        """Functions integrated along the curve of each step: the rate dt/dtau of a time transformation."""
        return (self.clock.rate,) if self.clock else ()

    @property
    def in_time(self) -> MechanicalSystem:
        """The system in physical time: of one in transformed time that which was transformed, if it is known."""
        return (self.clock and self.clock.plain) or self

    @property
    def depends_on_time(self) -> bool:
        """True if time occurs in the function, a force or a constraint, so that energy is not conserved."""
        return any(self.time in formula.free_symbols for formula in (self.lagrangian, *self.forces, *self.constraints))

    @property
    def changes_energy(self) -> str | None:
        """Reason why energy is not conserved; ``None`` if it is."""
        if self.forces or self.damping != 0:
            return "forces act" if self.forces else "damping takes it"
        if self._constraints_work():
            return "constraints do work"
        if self.time in self.lagrangian.free_symbols:
            return f"{'H' if self.auxiliaries else 'L'} depends on time"
        return None

    @property
    def kinks(self) -> tuple[str, ...]:
        """Functions as text at whose zeros the function, forces or constraints are not smooth, by unit_step or rint."""
        from scvi_codegen.systems.formulas.expressions import kinks_of
        from scvi_codegen.systems.formulas.intermediates import LONGEST_WRITTEN

        kinks = kinks_of((self.lagrangian, *self.forces, *self.constraints))
        moving = (u for u in kinks if not u.free_symbols <= {*self.parameters})
        return tuple(sorted(self._shown(u, "a function", LONGEST_WRITTEN) for u in moving))

    @property
    def has_localised_forces(self) -> bool:
        """True if exponentials or hyperbolic functions may confine a force to a short time or a small region."""
        from sympy import exp
        from sympy.functions.elementary.hyperbolic import HyperbolicFunction

        from scvi_codegen.systems.formulas.expressions import parts_of_type

        formulas = (self.formula, *self.forces)
        return any(parts_of_type(kind, *formulas) for kind in (exp, HyperbolicFunction))

    @property
    def resists_motion(self) -> bool:
        """True if forces depend, or by intermediate quantities may depend, on velocities or momenta."""
        from scvi_codegen.systems.formulas.intermediates import intermediates

        rates = {*self.velocities, *self.auxiliaries}
        return any(rates & force.free_symbols or intermediates(force) for force in self.forces)

    @property
    def balances_energy(self) -> bool:
        """True if the energy changes by the work of forces, damping and contacts only."""
        works = self._constraints_work()
        acted = bool(self.forces) or self.damping != 0 or works
        return acted and not (self.time in self.formula.free_symbols or (works and not self.reactions))

    def _constraints_work(self) -> bool:
        from scvi_codegen.systems.constraints import constraints_work

        return bool(self.constraints) and constraints_work(self)

    def to_text(self) -> str:
        """Return the function as text that ``from_text`` accepts, in the names of rotations and directions."""
        return self.text_of(self._shown_formula)

    @property
    def _shown_formula(self) -> Expr:
        return self.reduced.lagrangian if self.reduced else self.formula

    @staticmethod
    def formula_text(formula: Expr) -> str:
        """Return a formula as text that ``parse_expression`` reads; SystemDefinitionError outside of the grammar."""
        from scvi_codegen.systems.formulas.translation import format_expression

        return format_expression(formula)

    @staticmethod
    def parameter_value(name: str, value: Any) -> float:
        """Return the default value of a parameter; SystemDefinitionError unless it is a finite real number."""
        return number(name, value)

    def text_of(self, formula: Expr) -> str:
        """Return a formula of the system as text, with its inputs by their names."""
        from scvi_codegen.systems.formulas.intermediates import written_out
        from scvi_codegen.systems.formulas.symbols import inputs_by_name
        from scvi_codegen.systems.formulas.translation import format_expression

        return format_expression(inputs_by_name(written_out(formula), self.inputs))

    def _shown(self, formula: Expr, name: str, longest: float) -> str:
        """Return a formula as text, or its name and size if it has more than so many terms and factors."""
        from scvi_codegen.systems.formulas.intermediates import written_size

        size = written_size(formula)
        return self.text_of(formula) if size <= longest else f"{name}, of {size} terms and factors"

    @property
    def constraint_texts(self) -> tuple[str, ...]:
        """Constraints g as text, without modes, in the names of the rotations and directions of a Lagrangian.

        Of those of contacts that would exceed ``LONGEST_SHOWN`` the text is a number.
        """
        from scvi_codegen.systems.formulas.intermediates import LONGEST_SHOWN
        from scvi_codegen.systems.formulas.kinks import without_modes

        formulas = (self.reduced or self).constraints
        first = len(formulas) - len(self.reactions)
        longest = [LONGEST_SHOWN if k >= first else math.inf for k in range(len(formulas))]
        return tuple(
            self._shown(without_modes(g), f"g_{k}", most)
            for k, (g, most) in enumerate(zip(formulas, longest, strict=True), 1)
        )

    def with_parameters(self, **values: float) -> Self:
        """Return a copy of the system with other default values for the named parameters."""
        names = [parameter.name for parameter in self.parameters]
        for key in values:
            if key not in names:
                raise SystemDefinitionError(
                    f"'{self.name}' has no parameter '{key}'{closest(key, names)} It has: {', '.join(names) or 'none'}"
                )
        changed = dict(zip(names, self.defaults, strict=True)) | values
        return replace(self, defaults=tuple(number(key, value) for key, value in changed.items()))

    def _repr_html_(self) -> str:
        from sympy import Symbol, count_ops

        from scvi_codegen.common.display.mathml import Typeset
        from scvi_codegen.systems.formulas.intermediates import LONGEST_WRITTEN, written_out, written_size

        letter = "H" if self.auxiliaries else "L"
        shown = self._shown_formula
        short = written_size(shown) <= LONGEST_WRITTEN
        size = count_ops(shown) if short else written_size(shown)
        formula = Typeset.terms(written_out(shown), Symbol(letter)) if size <= MAX_OPERATIONS else ()
        written = " ".join(formula) or plain(f"{letter}: {size} operations")
        rotations = [rotation.declaration for rotation in self.rotations]
        parameters = [f"{parameter.name} = {value:g}" for parameter, value in self.constants.items()]
        return card(
            self.name,
            (
                ("coordinates", listed([q.name for q in self.coordinates])),
                *([("rotations", listed(rotations))] if rotations else []),
                *([("momenta", listed([p.name for p in self.auxiliaries]))] if self.auxiliaries else []),
                ("parameters", listed(parameters)),
                *self._force_facts(),
            ),
            Html(f"<div>{written}</div>"),
        )

    def _force_facts(self) -> Iterator[tuple[str, Html]]:
        """Yield forces, damping and constraints as rows of a notebook's card."""
        by_coordinate = zip([q.name for q in self.coordinates], zip(self.forces), strict=False)
        forces = self.reduced.forces if self.reduced else by_coordinate
        for name, components in forces:
            if any(components):
                yield f"force on {name}", plain(", ".join(map(self.text_of, components)))
        if self.damping != 0:
            yield "damping", plain(self.text_of(self.damping))
        if self.bath:
            yield "temperature", plain(self.text_of(self.bath.temperature))
        for g in self.constraint_texts:
            yield "constraint", plain(f"{g} = 0")


def _free(name: str, taken: set[str]) -> str:
    return name if name not in taken else _free(f"_{name}", taken)


MechanicalSystem.KIND = of("a LagrangianSystem or a HamiltonianSystem", MechanicalSystem)
MechanicalSystem.OR_ARRAYS = ArgumentType(
    MechanicalSystem.KIND.words, lambda value: isinstance(value, MechanicalSystem)
)
