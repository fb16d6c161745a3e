"""Systems of arrays: Lagrangians in index notation, of few kinds of terms (lattices, fields, N bodies).

    L = sum_f sum_(e in loops of f) l_f(array entries at e, parameters, t)

Only the kernels l_f are differentiated, so neither compile time nor code size depends on the number of coordinates,
which is determined by the arrays that a run starts from; kinetic energy is then a sum of m v**2/2 with constant m that
may differ between elements, or quadratic in the velocities of each element
(:mod:`scvi_codegen.systems.legendre.of_arrays`). With known sizes they are systems of named coordinates
(:mod:`scvi_codegen.systems.rolling`), without restrictions.

Terms of array systems: masses, potentials, forces, and constraints.

Velocities occur as m v**2/2 with a constant m that may differ between elements. Constraints g(array entries at e,
parameters, t) = 0 hold for every element e of loops,

    m q'' = F + G^T lambda,        g(q, t) = 0,        G = g_q,        hidden constraint G v + g_t = 0

with a multiplier lambda for every element. Rods between nodes ``bonds[b, 0]`` and ``bonds[b, 1]`` of a net are
``sum(k in 3, (r[bonds[b, 0], k] - r[bonds[b, 1], k])**2) = l[b]**2 for b in B``. Each constraint contains few entries,
so G M^-1 G^T is sparse; its pattern is that of the net and is known when a run begins.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain
from typing import Any, ClassVar, NoReturn, TypeVar

import sympy
from sympy import Add, Expr, S, Symbol

from scvi_codegen.common.cache import key_of
from scvi_codegen.common.errors import SizesRequiredError, SystemDefinitionError
from scvi_codegen.common.representation import LONGEST, clipped
from scvi_codegen.common.validation import OfRunTimeSizes, of
from scvi_codegen.systems.checks.continuity import corner_in, irregularity
from scvi_codegen.systems.checks.definition import warn_of_negative, warn_of_unused
from scvi_codegen.systems.forces import check_damping
from scvi_codegen.systems.formulas.array_statements import (
    ArrayForce,
    array_text,
    formula_of_entries,
    is_indexed,
    latex_entry,
    latex_sum,
    latex_sums,
)
from scvi_codegen.systems.formulas.arrays import MAX_UNROLLED_TERMS, ArrayTerm, parse_array, parse_coordinate, term_of
from scvi_codegen.systems.formulas.expressions import gradient, gradient_tuple, hessian, kinks_of, unsupported_part
from scvi_codegen.systems.formulas.indices import SIZES_REQUIRED, Access, Array, Convolution, Loop, Size
from scvi_codegen.systems.formulas.neighbours import Neighbours
from scvi_codegen.systems.formulas.numpy_values import Elements
from scvi_codegen.systems.formulas.rotations import MemberArray
from scvi_codegen.systems.formulas.symbols import DOT, check_names, input_formulas, symbol
from scvi_codegen.systems.system import BATH_ENERGY, MechanicalSystem

Term = TypeVar("Term", ArrayTerm, ArrayForce)


@lru_cache(maxsize=256)
def force_of(term: ArrayTerm, state: tuple[Array, ...]) -> ArrayForce:
    """Return the derivatives of a term with respect to its entries of the state."""
    moving = entries_of(term, state)
    partials = gradient_tuple(term.formula, [slot for slot, _ in moving])
    targets = tuple((access, partial) for (_, access), partial in zip(moving, partials, strict=True))
    return ArrayForce(loops=term.loops, slots=term.slots, targets=targets)


def gathered(force: ArrayForce) -> ArrayForce:
    """Return forces with one target instead of targets that differ in periodic indices, so that no sum is continued.

    The terms V(x_i, x_(i+1)) of all i act on x_i by V_1(x_i, x_(i+1)) + V_2(x_(i-1), x_i). The entries of ``force`` are
    kept, for V. ``force`` is returned if distances from the index become larger, or are no numbers.
    """
    accesses, periodic = dict(force.slots), {loop.index for loop in force.loops if loop.periodic}
    if any(access.sums or any(place.table or place.minus for place in access.places) for access in accesses.values()):
        return force
    names, targets = {access: slot for slot, access in force.slots}, dict[Access, Expr]()
    for target, formula in force.targets:
        by = {place.index: -place.base.number for place in target.places if place.index in periodic}
        moved = {slot: _shifted(accesses[slot], by) for slot in formula.free_symbols & {*accesses}}
        renamed = {slot: names.setdefault(access, symbol(str(access))) for slot, access in moved.items()}
        here = _shifted(target, by)
        targets[here] = targets.get(here, S.Zero) + _with_one_number(formula.xreplace(renamed))
    if _farthest(names) > _farthest(accesses.values()):
        return force
    slots = sorted(((slot, access) for access, slot in names.items()), key=str)
    return replace(force, slots=tuple(slots), targets=tuple(targets.items()))


def _shifted(access: Access, by: Mapping[str, int]) -> Access:
    """Return an entry at other values of some indices."""
    places = (replace(place, base=place.base + by.get(place.index, 0)) for place in access.places)
    return replace(access, places=tuple(places))


def _farthest(accesses: Iterable[Access]) -> int:
    """Return the largest distance of entries from their indices."""
    return max((abs(place.base.number) for access in accesses for place in access.places if place.index), default=0)


def _with_one_number(formula: Expr) -> Expr:
    """Return a sum in whose terms the common numbers of all factors are one: -w (2 x - 2 y)/2 is -w (x - y)."""
    products = (sympy.Mul.make_args(term) for term in Add.make_args(formula))
    primitive = (zip(*(factor.primitive() for factor in factors), strict=True) for factors in products)
    return Add(*(sympy.Mul(*numbers, *factors) for numbers, factors in primitive))


def entries_of(term: ArrayTerm | ArrayForce, arrays: Collection[Array]) -> tuple[tuple[Symbol, Access], ...]:
    """Return the accesses of certain arrays in a term, with their symbols."""
    return tuple(pair for pair in term.slots if pair[1].array in arrays)


def friction(terms: Sequence[ArrayTerm], coordinates: Mapping[Array, Array]) -> tuple[ArrayForce, ...]:
    """Return the forces -dD/dv of Rayleigh's dissipation function; ``coordinates``: by the arrays of velocities."""
    forces = []
    for term in terms:
        force = force_of(term, tuple(coordinates))
        targets = tuple((replace(access, array=coordinates[access.array]), -rate) for access, rate in force.targets)
        if not targets:
            raise SystemDefinitionError(
                f"the dissipation {term} contains no velocity: Rayleigh's function defines the forces "
                "-dD/dq_dot. Add velocities, or remove it"
            )
        forces.append(replace(force, targets=targets))
    return tuple(forces)


def friction_of(mass: ArrayForce, rate: Expr) -> ArrayForce:
    """Return the force -rate m v of a mass."""
    ((access, m),) = mass.targets
    velocity = replace(access, array=Array(access.array.name + DOT, access.array.axes))
    v = symbol(str(velocity))
    return ArrayForce(loops=mass.loops, slots=(*mass.slots, (v, velocity)), targets=((access, -rate * m * v),))


def masses_of(term: ArrayTerm, velocities: Mapping[str, Array]) -> tuple[ArrayForce, ...]:
    """Return the mass contributions of a term, one per velocity."""
    accesses, masses, symbols = dict(term.slots), [], velocity_symbols(term, velocities)
    for v, derivative in zip(symbols, gradient_tuple(term.formula, symbols), strict=True):
        mass = derivative.diff(v)  # d^2 L / dv^2
        free = mass.free_symbols
        slots = tuple(pair for pair in term.slots if pair[0] in free)
        access = replace(accesses[v], array=velocities[accesses[v].array.name])
        masses.append(ArrayForce(loops=term.loops, slots=slots, targets=((access, mass),)))
    return tuple(masses)


def velocity_symbols(term: ArrayTerm, velocities: Mapping[str, Array]) -> tuple[Symbol, ...]:
    """Return the symbols of a term that denote velocities."""
    return tuple(slot for slot, access in term.slots if access.array.name in velocities)


@lru_cache(maxsize=256)
def has_constant_mass(term: ArrayTerm, coordinates: tuple[Array, ...], time: Symbol) -> bool:
    """Return whether velocities occur as m v**2/2 with a constant m."""
    velocities = {array.name + DOT: array for array in coordinates}
    varies = {slot for slot, access in term.slots if access.array.name in velocities or access.array in coordinates}
    slots, accesses = velocity_symbols(term, velocities), dict(term.slots)
    if any(accesses[v].sums for v in slots):
        return False
    for v, derivative in zip(slots, gradient_tuple(term.formula, slots), strict=True):
        mass = derivative.diff(v)
        if mass.free_symbols & (varies | {time}) or sympy.expand(derivative - mass * v) != 0:
            return False
    return True


def terms_at_rest(
    terms: Sequence[ArrayTerm], velocities: Mapping[str, Array], state: Sequence[Array], *, negative: bool, moving: bool
) -> tuple[ArrayTerm, ...]:
    """Return the non-zero terms at zero velocity that depend on the state, or those that do not.

    Args:
        terms: of a Lagrangian or a Hamiltonian.
        velocities: the array of coordinates by the name of its velocities.
        state: coordinates and momenta.
        negative: whether to change the signs, as for -H.
        moving: whether to return the terms that depend on the state.
    """
    results = []
    for term in terms:
        at_rest = term.formula.xreplace(dict.fromkeys(velocity_symbols(term, velocities), S.Zero))
        free = at_rest.free_symbols
        slots = tuple(pair for pair in term.slots if pair[0] in free)
        if at_rest and moving == any(access.array in state for _, access in slots):
            results.append(replace(term, formula=-at_rest if negative else at_rest, slots=slots))
    return tuple(results)


def constraint_text(term: ArrayTerm) -> str:
    """Return the constraint as text."""
    return f"{term.formula} = 0{loops_text(term.loops)}"


def loops_text(loops: Sequence[Loop]) -> str:
    """Return loops as the text that follows a formula, ``" for i in N"``; empty without loops."""
    behind = {loop.behind for loop in loops}
    return f" for {', '.join(str(loop) for loop in loops if loop.index not in behind)}" if loops else ""


def check_constraint(term: ArrayTerm, coordinates: Sequence[Array], fields: Sequence[Array], inputs: str) -> None:
    """Raise SystemDefinitionError unless a constraint has coordinates, but neither velocities nor ``inputs``."""
    shown = constraint_text(term)
    if problem := unsupported_part(term.formula):
        raise SystemDefinitionError(f"in the constraint '{shown}': {problem}")
    if moving := {access.array for _, access in term.slots} - {*coordinates, *fields}:
        name = min(array.name for array in moving)
        raise SizesRequiredError(
            f"the constraint '{shown}' contains the velocity {name}: constraints of array systems "
            "must be holonomic (coordinates and time only)"
        )
    if any(access.sums for _, access in term.slots):
        raise SizesRequiredError(f"the constraint '{shown}' contains a convolution")
    if not entries_of(term, coordinates):
        raise SystemDefinitionError(
            f"the constraint '{shown}' contains no coordinate: remove it, or write the condition in terms "
            "of the coordinates"
        )
    if inputs and any(re.fullmatch(inputs, variable.name) for variable in term.formula.free_symbols):
        raise SystemDefinitionError(
            f"the constraint '{shown}' depends on an input, which may be discontinuous: use a "
            "parameter or a formula in t instead"
        )


def constraint_gradient(term: ArrayTerm, coordinates: Sequence[Array], time: Symbol) -> tuple[Expr, ...]:
    """Return the row of G of one element, by its coordinates, followed by g_t."""
    return gradient_tuple(term.formula, [*(slot for slot, _ in entries_of(term, coordinates)), time])


def constraint_second_rate(
    term: ArrayTerm, coordinates: Sequence[Array], time: Symbol, velocities: Sequence[Symbol]
) -> Expr:
    """Return d^2 g / dt^2 at zero acceleration: v^T g_qq v + 2 g_qt v + g_tt."""
    variables = [*(slot for slot, _ in entries_of(term, coordinates)), time]
    rates = [*velocities, S.One]
    rate = Add(*(derivative * rates[k] for k, derivative in gradient(term.formula, variables).items()))
    return Add(*(derivative * rates[k] for k, derivative in gradient(rate, variables).items()))


def substituted(term: Term, rule: Mapping[Any, Expr]) -> Term:
    """Return a term, or forces, with expressions substituted by ``rule``."""
    if not rule:
        return term
    if isinstance(term, ArrayForce):
        return replace(term, targets=tuple((access, formula.xreplace(rule)) for access, formula in term.targets))
    return replace(term, formula=term.formula.xreplace(rule))


def table_of(text: str) -> Array:
    """Parse the declaration of an index table; one with a single axis gets one column."""
    array = parse_array(text)
    return array if len(array.axes) > 1 else replace(array, axes=(*array.axes, Size("", 1)))


def momenta_of(
    coordinates: Sequence[Array], names: Sequence[str] | None, lagrangian: str | None, hamiltonian: str | None
) -> tuple[Array, ...]:
    """Return the arrays of momenta of a Hamiltonian; none for a Lagrangian."""
    if (lagrangian is None) == (hamiltonian is None):
        raise SystemDefinitionError("give exactly one of lagrangian and hamiltonian")
    if hamiltonian is None:
        if names is not None:
            raise SystemDefinitionError(
                "momenta were given for a Lagrangian, which has velocities, q_dot[i]: leave them out, or "
                "give a hamiltonian"
            )
        return ()
    if names is None:
        return tuple(Array(f"p_{array.name}", array.axes) for array in coordinates)
    arrays = tuple(map(parse_coordinate, names))
    if [array.axes for array in arrays] != [array.axes for array in coordinates]:
        shown = ", ".join(map(str, coordinates))
        raise SystemDefinitionError(
            f"momenta must be arrays with the axes of the coordinates, {shown}, not {', '.join(names)}"
        )
    return arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class ArraySystem(OfRunTimeSizes, MechanicalSystem):
    """Lagrangian or Hamiltonian in index notation; ``LagrangianSystem.from_text(coordinates=["q[N]"])`` returns it.

    Attributes:
        name, time, parameters, defaults, inputs, damping: see
            :class:`~scvi_codegen.systems.system.MechanicalSystem`.
        coordinates: arrays of coordinates, single ones without axes; the array of the velocities of ``q`` is called
            ``q_dot``.
        momenta: of a Hamiltonian, arrays parallel to ``coordinates``; empty for a Lagrangian.
        fields: arrays of parameters, whose values, one per element, are passed to each run.
        field_defaults: default value of all elements of each field.
        tables: index tables, ``bonds[B, 2]``, passed to each run.
        neighbours: lists of the pairs closer than a cutoff.
        terms: of the Lagrangian or the Hamiltonian.
        forces: generalised forces of coordinates, velocities (momenta of a Hamiltonian) and time.
        friction: terms of the dissipation function of a heat bath.
        constraints: g = 0 at every element of loops (:mod:`scvi_codegen.systems.arrays.system`).
        rotations: rotations, directions and spins, which require known sizes.
        arrays: coordinates, those of rotations, momenta, fields, tables.
        definition: the arguments of ``from_text`` other than name and parameters, for model files.
        data: values of fields and tables by name for runs that pass none.
        mesh: of the fields of a density, their :class:`~scvi_codegen.extras.fields.mesh.Mesh`.
    """

    coordinates: tuple[Array, ...]
    momenta: tuple[Array, ...]
    fields: tuple[Array, ...]
    field_defaults: tuple[float, ...]
    tables: tuple[Array, ...]
    terms: tuple[ArrayTerm, ...]
    neighbours: tuple[Neighbours, ...] = ()
    forces: tuple[ArrayForce, ...] = ()
    friction: tuple[ArrayTerm, ...] = ()
    constraints: tuple[ArrayTerm, ...] = ()
    rotations: tuple[MemberArray, ...] = ()  # type: ignore[assignment]  # each stands for many
    arrays: tuple[Array, ...] = field(init=False, compare=False, repr=False)
    lengths: tuple[tuple[str, ...], ...] = field(init=False, compare=False, repr=False)
    data: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    mesh: Any = field(default=None, compare=False, repr=False)
    REQUIRES_SIZES: ClassVar[str] = SIZES_REQUIRED

    def __repr__(self) -> str:
        shown = ", ".join(map(str, self.coordinates))
        return clipped(f"{self.function}System(name={self.name!r}, coordinates=({shown}))", LONGEST)

    def __post_init__(self) -> None:
        arrays = (*self.positions, *self.momenta, *self.fields, *self.tables)
        object.__setattr__(self, "arrays", arrays)
        object.__setattr__(self, "lengths", tuple(length for near in self.neighbours for length in near.lengths))
        self._check_names()
        formulas = [(f"the {self.function}", term.formula) for term in self.terms]
        formulas += [(f"the force on {access}", formula) for force in self.forces for access, formula in force.targets]
        for where, formula in formulas:
            if problem := unsupported_part(formula):
                raise SystemDefinitionError(f"in {where} of '{self.name}': {problem}")
        self._check_continuity()
        if self.constraints and self.momenta:
            raise SystemDefinitionError(
                f"'{self.name}' is a Hamiltonian with constraints, which are supported for Lagrangians only: write the "
                "system by its Lagrangian"
            )
        used = {access.array.name for term in self.terms for _, access in term.slots}
        for array in () if self.momenta or self.is_first_order else self.coordinates:
            if array.name + DOT not in used:
                entry = f"sum(i in {array.axes[0]}, {array.name}{DOT}[i]**2/2)" if array.axes else f"{array}{DOT}**2/2"
                raise SystemDefinitionError(
                    f"no term contains {array.name}{DOT}: add a kinetic energy for '{array.name}', such as {entry}"
                )
        check_damping(self.name, self.damping, self.parameters)

    def _check_continuity(self) -> None:
        """Raise :class:`SystemDefinitionError` for kinks of L or H that no step follows and corners of constraints."""
        constant = {array.name for array in self.fields}
        moving = {
            term: {slot: access.array.name for slot, access in term.slots if access.array.name not in constant}
            for term in (*self.terms, *self.constraints)
        }
        for term in () if self.neighbours else self.terms:  # lists end at their cutoff
            velocities = [slot for slot, name in moving[term].items() if name in self._velocities and not self.momenta]
            subject = f"the {self.function} of '{self.name}'"
            if problem := irregularity(term.formula, subject, moving[term], velocities, self.constants):
                raise SystemDefinitionError(problem)
        for term in self.constraints:
            subject = f"the constraint '{term}' of '{self.name}'"
            if corner := corner_in(term.formula, subject, moving[term], self.constants):
                raise SystemDefinitionError(corner)

    def check_run_time_sizes(self) -> None:
        """Raise :class:`SizesRequiredError` for a system that cannot be compiled for sizes known at run time."""
        try:
            if self.rotations:
                raise SizesRequiredError("rotations, directions and spins are not available for run-time sizes")
            if self.is_first_order:
                raise SizesRequiredError(
                    "Lagrangians linear in the velocities are not available for arrays of run-time sizes"
                )
            for term in self.coupled_terms:
                raise SizesRequiredError(
                    f"'{term}' contains velocities in another form: arrays of run-time sizes have velocities as "
                    "m*v**2/2 only, with a constant mass m"
                )
            inputs = "|".join(f"{name}_[0123t]" for name in self.inputs)
            for term in self.constraints:
                check_constraint(term, self.coordinates, self.fields, inputs)
            self._check_bath()
            if self.damping != 0 and self.momenta:
                raise SizesRequiredError("damping of a Hamiltonian requires known sizes: write it as forces")
            moving = (*self.state, *self.velocities)
            if still := [access for access, _ in self.accesses if access.sums and access.array not in moving]:
                raise SizesRequiredError(
                    f"'{still[0]}' is a convolution of parameters, not of coordinates or momenta: declare its values "
                    "as an array of parameters"
                )
            for array in self.coordinates:
                if not all(axis.name for axis in array.axes[:-1]):
                    raise SizesRequiredError(f"of the axes of {array} only the last may be a number: name the others")
        except SizesRequiredError as error:
            raise SizesRequiredError(f"{error}. This concerns '{self.name}': {SIZES_REQUIRED}") from error

    def _check_bath(self) -> None:
        """Raise :class:`SizesRequiredError` for a heat bath that arrays of run-time sizes do not have."""
        if self.bath is None:
            return
        is_plain = all(has_constant_mass(term, self.coordinates, self.time) for term in self.friction)
        if self.constraints or self.velocities or not is_plain or self.bath.symbols.difference(self.parameters):
            raise SizesRequiredError(
                "a heat bath of arrays of run-time sizes has no constraints, no forces of velocities but those of "
                "c*v**2/2, c constant, and a temperature and a damping that depend on parameters only"
            )

    @property
    def bath_terms(self) -> tuple[tuple[ArrayForce, ...], tuple[ArrayForce, ...]]:
        """Friction coefficients of velocities, and kT times their masses, of a heat bath."""
        if self.bath is None:
            return (), ()
        own = tuple(chain(*(masses_of(term, self._velocities) for term in self.friction)))
        damped, heated = (
            tuple(replace(mass, targets=tuple((at, factor * m) for at, m in mass.targets)) for mass in self.masses)
            for factor in (self.bath.damping, self.bath.temperature)
        )
        return (*own, *damped), heated

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of the sizes, in the order in which arrays declare them."""
        return tuple(dict.fromkeys(chain(*(array.names for array in self.arrays))))

    @property
    def constrained_at_nodes(self) -> bool:
        """False: steps of arrays with constraints are those of RATTLE."""
        return False

    @property
    def is_prescribed(self) -> bool:
        """False: a constraint of arrays stands for one of every element, whose number each run determines."""
        return False

    @property
    def is_rolling(self) -> bool:
        """False: constraints of arrays contain no velocities."""
        return False

    @property
    def auxiliaries(self) -> tuple[Array, ...]:
        """Momenta."""
        return self.momenta

    @property
    def lagrangian(self) -> NoReturn:
        """Unavailable: it is a sum over all elements."""
        raise SizesRequiredError(f"'{self.name}' has no formula but those of its terms: {SIZES_REQUIRED}")

    formula = lagrangian

    @property
    def has_localised_forces(self) -> bool:
        """False: free flights of arrays of run-time sizes are not examined in pieces."""
        return False

    @property
    def positions(self) -> tuple[Array, ...]:
        """Coordinates, and homogeneous coordinates of rotations, directions and spins."""
        return (*self.coordinates, *(rotation.array for rotation in self.rotations))

    @property
    def state(self) -> tuple[Array, ...]:
        """Coordinates, and the momenta of a Hamiltonian."""
        return (*self.coordinates, *self.momenta)

    @property
    def velocities(self) -> tuple[Array, ...]:
        """Arrays of velocities that forces depend on: all of them if any occurs, else none; none for a Hamiltonian."""
        names = {access.array.name for force in self.applied_forces for _, access in force.slots}
        arrays = tuple(Array(name, array.axes) for name, array in self._velocities.items())
        return arrays if any(array.name in names for array in arrays) else ()

    @property
    def accesses(self) -> tuple[tuple[Access, tuple[Loop, ...]], ...]:
        """Array accesses, each with its enclosing loops."""
        slots = [(access, term.loops) for term in (*self.terms, *self.friction) for _, access in term.slots]
        slots += [(access, force.loops) for force in self.applied_forces for _, access in force.slots]
        slots += [(access, term.loops) for term in self.constraints for _, access in term.slots]
        return (*slots, *((access, force.loops) for force in self.applied_forces for access, _ in force.targets))

    @property
    def sums(self) -> tuple[tuple[Convolution, ...], ...]:
        """Convolutions of the state, each once."""
        return tuple(dict.fromkeys(access.sums for access, _ in self.accesses if access.sums))

    @property
    def changes_energy(self) -> str | None:
        """Reason why energy is not conserved; ``None`` if it is."""
        if self.bath:
            return BATH_ENERGY
        if self.forces:
            return "forces act"
        if self.damping != 0:
            return "damping takes it"
        if any(self.time in term.formula.free_symbols for term in self.constraints):
            return "constraints depend on time"
        return f"the {self.function} depends on time" if self.depends_on_time else None

    @property
    def kinks(self) -> tuple[str, ...]:
        """Functions as text at whose zeros terms, forces or constraints are not smooth, by unit_step or rint.

        None with lists of neighbours, whose pairs are too many to search.
        """
        if self.neighbours:
            return ()
        terms = [(term.loops, [term.formula]) for term in (*self.terms, *self.constraints)]
        forces = [(force.loops, [formula for _, formula in force.targets]) for force in self.applied_forces]
        zeros = ((u, loops) for loops, formulas in (*terms, *forces) for u in kinks_of(formulas))
        constants = {
            *self.parameters,
            *(symbol(str(access)) for access, _ in self.accesses if access.array in self.fields),
        }
        return tuple(sorted({f"{u}{loops_text(loops)}" for u, loops in zeros if not u.free_symbols <= constants}))

    @property
    def is_first_order(self) -> bool:
        """True if L contains velocities, all of them linearly (:mod:`scvi_codegen.systems.first_order`)."""
        slots = [[slot for slot, access in term.slots if access.array.name in self._velocities] for term in self.terms]
        return any(slots) and not any(hessian(term.formula, v) for term, v in zip(self.terms, slots, strict=True))

    @property
    def coupled_terms(self) -> tuple[ArrayTerm, ...]:
        """Terms that contain velocities other than as m v**2/2 with a constant m."""
        coordinates = () if self.momenta else self.coordinates
        return tuple(term for term in self.terms if not has_constant_mass(term, coordinates, self.time))

    @property
    def _plain_terms(self) -> tuple[ArrayTerm, ...]:
        coupled = self.coupled_terms
        return tuple(term for term in self.terms if term not in coupled)

    @property
    def masses(self) -> tuple[ArrayForce, ...]:
        """Constant masses (second derivatives of L with respect to velocities); empty for a Hamiltonian."""
        return tuple(chain(*(masses_of(term, self._velocities) for term in self._plain_terms)))

    @property
    def potentials(self) -> tuple[ArrayTerm, ...]:
        """Terms of -V or -H that depend on coordinates or momenta, at zero velocity."""
        return terms_at_rest(self._plain_terms, self._velocities, self.state, negative=bool(self.momenta), moving=True)

    @property
    def energy_offsets(self) -> tuple[ArrayTerm, ...]:
        """Terms of -V or -H without coordinates and momenta, which change the energy but not the trajectory."""
        return terms_at_rest(self._plain_terms, self._velocities, self.state, negative=bool(self.momenta), moving=False)

    @property
    def applied_forces(self) -> tuple[ArrayForce, ...]:
        """The forces, and for run-time sizes those of a damping, -gamma m v for each mass m."""
        return (*self.forces, *(friction_of(mass, self.damping) for mass in self.masses if self.damping != 0))

    @property
    def all_forces(self) -> tuple[ArrayForce, ...]:
        """Derivatives of the terms of -V or -H with respect to the state, then the other forces."""
        return (*(force_of(term, self.state) for term in self.potentials), *self.applied_forces)

    def _repr_html_(self) -> None:  # type: ignore[override]
        """Leave notebooks to :meth:`_repr_latex_`."""

    def _repr_latex_(self) -> str:
        return rf"$\displaystyle {self.latex}$"

    @property
    def latex(self) -> str:
        """L or H in LaTeX."""
        arguments = ", ".join(array.name for array in self.state)
        shown = (latex_sum(substituted(term, self._by_name)) for term in self.terms)
        return rf"{self.function[0]}({arguments}) = {' + '.join(shown).replace('+ -', '-')}"

    @property
    def balances_energy(self) -> bool:
        """True if the energy changes by the work of forces or damping only."""
        return (bool(self.forces) or self.damping != 0) and not (self.depends_on_time or self.bath)

    @property
    def depends_on_time(self) -> bool:
        """True if time occurs explicitly, so that energy is not conserved."""
        formulas = [term.formula for term in self.terms] + [f for force in self.forces for _, f in force.targets]
        return any(self.time in formula.free_symbols for formula in formulas)

    def key(self) -> tuple[str, ...]:
        """Return the key of this system in caches, made from all of its fields but the data of runs."""
        return (key_of(replace(self, data={}, mesh=None)),)

    def __str__(self) -> str:
        arguments = ", ".join(map(str, self.state))
        terms = " + ".join(str(substituted(term, self._by_name)) for term in self.terms)
        applied = "; ".join(str(substituted(force, self._by_name)) for force in self.forces)
        constraints = "; ".join(map(constraint_text, self.constraints))
        others = f"{f'; forces {applied}' if applied else ''}{f'; {constraints}' if constraints else ''}"
        return f"{self.name}: {self.function[0]}({arguments}) = {terms}{others}"

    @property
    def _by_name(self) -> dict[Expr, Expr]:
        """Names of inputs by the formulas that represent them, for display."""
        return {formula: name for name, formula in input_formulas(self.inputs, self.time).items()}

    @property
    def function(self) -> str:
        """Kind of the defining function: "Hamiltonian" or "Lagrangian"."""
        return "Hamiltonian" if isinstance(self, ArrayHamiltonian) else "Lagrangian"

    @property
    def _velocities(self) -> dict[str, Array]:
        return {} if self.momenta else {array.name + DOT: array for array in self.coordinates}

    def warn_of_mistakes(self, others: Iterable[Symbol] = ()) -> None:
        """Warn of parameters and inputs that occur in no formula and not among ``others``, and of negative masses."""
        formulas = [term.formula for term in (*self.terms, *self.constraints, *self.friction)]
        formulas += [self.damping, *(formula for force in self.forces for _, formula in force.targets)]
        arrays = [access.array for access, _ in self.accesses]
        arrays += [convolution.coefficients for sums in self.sums for convolution in sums]
        used = {*others, *(symbol(array.name) for array in arrays), *(self.bath.symbols if self.bath else ())}
        used = used.union(*(formula.free_symbols for formula in formulas))
        scalars = {symbol(array.name): value for array, value in zip(self.fields, self.field_defaults, strict=True)}
        values = scalars | self.constants
        warn_of_unused(self.name, self.function, values, self.inputs, used)
        moving = {array.name: array for array in self.momenta} or self._velocities
        for name, array in moving.items():
            this = {name: array}
            kinetic = [term for term in self.terms for _ in velocity_symbols(term, this)]
            if len(kinetic) == 1:  # masses of several loops are added where these meet
                (mass,) = masses_of(kinetic[0], this)
                uniform = {slot: symbol(access.array.name) for slot, access in mass.slots}
                second = {f"d2{self.function[0]}/d{name}2": mass.targets[0][1].xreplace(uniform)}
                warn_of_negative(self.name, second, values)

    def _check_names(self) -> None:
        variables = self.positions, self.parameters, self.momenta
        check_names(*([variable.name for variable in kind] for kind in variables))
        names = [declared.name for declared in (*self.arrays, *self.parameters, *self.neighbours)]
        for rotation in self.rotations:
            names += [array.name for array in rotation.formulas if array.name != rotation.member.name]
        for name in names:
            if names.count(name) > 1 or name in self.sizes:
                raise SystemDefinitionError(f"the name '{name}' is used twice: rename one")
        for table in self.tables:
            if len(table.axes) != 2 or not table.axes[0].name or table.axes[1].name:
                raise SystemDefinitionError(
                    f"the table {table} must be declared with a size and a number of columns, as bonds[B, 2]"
                )

    def derivatives(self, term: ArrayTerm, variables: tuple[Array, ...]) -> tuple[tuple[Access, Expr], ...]:
        """Return the derivatives of a term by its entries of arrays."""
        return force_of(term, variables).targets

    MAX_UNROLLED_TERMS = MAX_UNROLLED_TERMS
    """Largest number of terms of a sum that may be written out."""

    @staticmethod
    def assembled(**fields: Any) -> ArraySystem:
        """Return the system of its fields, a Hamiltonian if these have momenta."""
        system = (ArrayHamiltonian if fields.get("momenta") else ArrayLagrangian)(**fields)
        system.warn_of_mistakes()
        return system

    @staticmethod
    def term(loops: tuple[Loop, ...], formula: Expr, accesses: Mapping[Symbol, Access]) -> ArrayTerm:
        """Return the term of a formula over loops, with the accesses by symbol that occur in it."""
        return term_of(loops, formula, accesses)

    @staticmethod
    def rayleigh(terms: Sequence[ArrayTerm], coordinates: Mapping[Array, Array]) -> tuple[ArrayForce, ...]:
        """Return the forces -dD/dv of Rayleigh's dissipation function; ``coordinates``: by the arrays of velocities."""
        return friction(terms, coordinates)

    @staticmethod
    def elements(loops: Sequence[Loop], sizes: Mapping[str, int], tables: Mapping[str, Any]) -> Elements:
        """Return all index values of loops, and the values of formulas there, in NumPy."""
        return Elements(loops, sizes, tables)

    @staticmethod
    def formula_text(formula: Expr) -> str:
        """Return a formula in index notation as text."""
        return array_text(formula)

    @staticmethod
    def is_indexed(text: str) -> bool:
        """Return whether a formula contains entries or sums of arrays."""
        return is_indexed(text)

    @staticmethod
    def formula_of_entries(text: str, arrays: Sequence[Array], symbols: Mapping[str, Symbol]) -> Expr:
        """Return a formula in index notation of arrays of known sizes as a formula of their entries."""
        return formula_of_entries(text, arrays, symbols)

    @staticmethod
    def constraint_text(term: ArrayTerm) -> str:
        """Return a constraint as text."""
        return constraint_text(term)

    def latex_derivatives(self, term: ArrayTerm) -> Iterator[str]:
        """Yield the derivatives of a term by its entries of the state in LaTeX, with its summation signs."""
        from sympy import latex

        entries = {slot: latex_entry(access) for slot, access in term.slots}
        for access, derivative in self.derivatives(term, self.state):
            by = rf"\frac{{\partial}}{{\partial {latex_entry(access)}}}"
            yield rf"{latex_sums(term)} \; {by}: \quad {latex(derivative, symbol_names=entries)}"


class ArrayLagrangian(ArraySystem):
    """Lagrangian of arrays whose sizes are known at run time."""

    __slots__ = ()
    ACTS_AS: ClassVar[str] = "LagrangianSystem"


class ArrayHamiltonian(ArraySystem):
    """Hamiltonian of arrays whose sizes are known at run time."""

    __slots__ = ()
    ACTS_AS: ClassVar[str] = "HamiltonianSystem"


ARRAYS = of("a system with arrays whose sizes are known at run time, as coordinates=['q[N]']", ArraySystem)
"""Type check of systems of arrays, for :func:`~scvi_codegen.common.validation.checks_arguments`."""
