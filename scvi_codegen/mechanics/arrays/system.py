"""Systems of arrays: Lagrangians in index notation, of few kinds of terms (lattices, fields, N bodies).

    L = sum_f sum_(e in loops of f) l_f(array entries at e, parameters, t)

Only the kernels l_f are differentiated, so neither compile time nor code size depends on the number of coordinates,
which is determined by the arrays that a run starts from; kinetic energy is then a sum of m v**2/2 with constant m that
may differ between elements, or quadratic in the velocities of each element
(:mod:`scvi_codegen.mechanics.arrays.legendre`). With known sizes they are systems of named coordinates
(:mod:`scvi_codegen.mechanics.arrays.rolling`), without restrictions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, ClassVar

from sympy import Expr, S, Symbol

from scvi_codegen.errors import SizesRequiredError, SystemDefinitionError
from scvi_codegen.files.cache import key_of
from scvi_codegen.formulas.array_notation import latex_sum
from scvi_codegen.formulas.array_statements import ArrayForce
from scvi_codegen.formulas.arrays import ArrayTerm
from scvi_codegen.formulas.expressions import hessian, unsupported_part
from scvi_codegen.formulas.neighbours import Neighbours
from scvi_codegen.formulas.rotations.arrays import MemberArray
from scvi_codegen.formulas.symbols import DOT, check_names, input_formulas, symbol
from scvi_codegen.indices import SIZES_REQUIRED, Access, Array, Convolution, Loop
from scvi_codegen.mechanics.arrays.terms import (
    check_constraint,
    constraint_text,
    force_of,
    friction_of,
    has_constant_mass,
    masses_of,
    substituted,
    terms_at_rest,
    velocity_symbols,
)
from scvi_codegen.mechanics.definition_checks import warn_of_negative, warn_of_unused
from scvi_codegen.mechanics.forces import check_damping
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.representation import LONGEST, clipped
from scvi_codegen.validation import of


@dataclass(frozen=True, slots=True, kw_only=True)
class ArraySystem:
    """Lagrangian or Hamiltonian in index notation; ``LagrangianSystem.from_text(coordinates=["q[N]"])`` returns it.

    Attributes:
        name: name of the system.
        coordinates: arrays of coordinates, single ones without axes; the array of the velocities of ``q`` is called
            ``q_dot``.
        momenta: of a Hamiltonian, arrays parallel to ``coordinates``; empty for a Lagrangian.
        time: the symbol ``t``.
        parameters, defaults: adjustable numbers and their default values.
        fields: arrays of parameters, whose values, one per element, are passed to each run.
        field_defaults: default value of all elements of each field.
        tables: index tables, ``bonds[B, 2]``, passed to each run.
        neighbours: lists of the pairs closer than a cutoff.
        terms: of the Lagrangian or the Hamiltonian.
        forces: generalised forces of coordinates, velocities (momenta of a Hamiltonian) and time.
        inputs: names of functions of time passed to each run, each represented by five of the parameters.
        constraints: g = 0 at every element of loops (:mod:`scvi_codegen.mechanics.arrays.terms`).
        damping: damping rate of all momenta, see :class:`~scvi_codegen.mechanics.system.MechanicalSystem`.
        rotations: rotations, directions and spins, which require known sizes.
        definition: the arguments of ``from_text`` other than name and parameters, for model files.
        data: values of fields and tables by name for runs that pass none.
        mesh: of the fields of a density, their :class:`~scvi_codegen.fields.mesh.Mesh`.
    """

    name: str
    coordinates: tuple[Array, ...]
    momenta: tuple[Array, ...]
    time: Symbol
    parameters: tuple[Symbol, ...]
    defaults: tuple[float, ...]
    fields: tuple[Array, ...]
    field_defaults: tuple[float, ...]
    tables: tuple[Array, ...]
    terms: tuple[ArrayTerm, ...]
    neighbours: tuple[Neighbours, ...] = ()
    forces: tuple[ArrayForce, ...] = ()
    inputs: tuple[str, ...] = ()
    constraints: tuple[ArrayTerm, ...] = ()
    damping: Expr = S.Zero
    rotations: tuple[MemberArray, ...] = ()
    definition: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    data: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    mesh: Any = field(default=None, compare=False, repr=False)
    REQUIRES_SIZES: ClassVar[str] = SIZES_REQUIRED

    def __repr__(self) -> str:
        shown = ", ".join(map(str, self.coordinates))
        return clipped(f"{self.function}System(name={self.name!r}, coordinates=({shown}))", LONGEST)

    def __post_init__(self) -> None:
        self._check_names()
        for term in self.terms:
            if problem := unsupported_part(term.formula):
                raise SystemDefinitionError(f"in the {self.function} of '{self.name}': {problem}")
        for force in self.forces:
            for access, formula in force.targets:
                if problem := unsupported_part(formula):
                    raise SystemDefinitionError(f"in the force on {access} of '{self.name}': {problem}")
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
            if self.damping != 0 and self.momenta:
                raise SizesRequiredError("damping of a Hamiltonian requires known sizes: write it as forces")
            moving = (*self.state, *self.velocities)
            if still := [each for each, _ in self.accesses if each.sums and each.array not in moving]:
                raise SizesRequiredError(
                    f"'{still[0]}' is a convolution of parameters, not of coordinates or momenta: declare its values "
                    "as an array of parameters"
                )
            for array in self.coordinates:
                if len(array.axes) > 1 and any(not axis.name for axis in array.axes[:-1]):
                    raise SizesRequiredError(f"of the axes of {array} only the last may be a number: name the others")
        except SizesRequiredError as error:
            raise SizesRequiredError(f"{error}. This concerns '{self.name}': {SIZES_REQUIRED}") from error

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of the sizes, in the order in which arrays declare them."""
        return tuple(dict.fromkeys(chain(*(array.names for array in self.arrays))))

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Coordinates, those of rotations, momenta, fields, tables."""
        return (*self.positions, *self.momenta, *self.fields, *self.tables)

    @property
    def positions(self) -> tuple[Array, ...]:
        """Coordinates, and homogeneous coordinates of rotations, directions and spins."""
        return (*self.coordinates, *(each.array for each in self.rotations))

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
        slots = [(access, term.loops) for term in self.terms for _, access in term.slots]
        slots += [(access, force.loops) for force in self.applied_forces for _, access in force.slots]
        slots += [(access, term.loops) for term in self.constraints for _, access in term.slots]
        return (*slots, *((access, force.loops) for force in self.applied_forces for access, _ in force.targets))

    @property
    def sums(self) -> tuple[tuple[Convolution, ...], ...]:
        """Convolutions of the state, each once."""
        return tuple(dict.fromkeys(access.sums for access, _ in self.accesses if access.sums))

    @property
    def changes_energy(self) -> str:
        """Reason why energy is not conserved; empty if it is."""
        if self.forces:
            return "forces act"
        if self.damping != 0:
            return "damping takes it"
        if any(self.time in term.formula.free_symbols for term in self.constraints):
            return "constraints depend on time"
        return f"the {self.function} depends on time" if self.depends_on_time else ""

    @property
    def is_first_order(self) -> bool:
        """True if L contains velocities, all of them linearly (:mod:`scvi_codegen.mechanics.first_order`)."""
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

    def _repr_latex_(self) -> str:
        return rf"$\displaystyle {self.latex}$"

    @property
    def latex(self) -> str:
        """L or H in LaTeX."""
        arguments = ", ".join(array.name for array in self.state)
        shown = (latex_sum(substituted(term, self._by_name)) for term in self.terms)
        return rf"{self.function[0]}({arguments}) = {' + '.join(shown).replace('+ -', '-')}"

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
        """Arrays of coordinates by the names of their velocities."""
        return {} if self.momenta else {array.name + DOT: array for array in self.coordinates}

    def warn_of_mistakes(self, others: Iterable[Symbol] = ()) -> None:
        """Warn of parameters and inputs that occur in no formula and not among ``others``, and of negative masses."""
        terms = [*self.terms, *self.constraints]
        formulas = [term.formula for term in terms] + [f for force in self.forces for _, f in force.targets]
        formulas.append(self.damping)
        used = {symbol(access.array.name) for access, _ in self.accesses}.union(
            *(f.free_symbols for f in formulas),
            (symbol(each.coefficients.name) for sums in self.sums for each in sums),
            others,
        )
        scalars = {symbol(array.name): value for array, value in zip(self.fields, self.field_defaults, strict=True)}
        values = scalars | dict(zip(self.parameters, self.defaults, strict=True))
        warn_of_unused(self.name, self.function, values, self.inputs, used)
        moving = {array.name: array for array in self.momenta} or self._velocities
        for name in moving:
            this = {name: moving[name]}
            kinetic = [term for term in self.terms for _ in velocity_symbols(term, this)]
            if len(kinetic) == 1:  # masses of several loops are added where these meet
                (mass,) = masses_of(kinetic[0], this)
                uniform = {slot: symbol(access.array.name) for slot, access in mass.slots}
                warn_of_negative(
                    self.name, {f"d2{self.function[0]}/d{name}2": mass.targets[0][1].xreplace(uniform)}, values
                )

    def _check_names(self) -> None:
        check_names(*([each.name for each in group] for group in (self.positions, self.parameters, self.momenta)))
        known = [each.name for each in (*self.arrays, *self.parameters, *self.neighbours)]
        known += [array.name for each in self.rotations for array in each.formulas if array.name != each.member.name]
        for name in known:
            if known.count(name) > 1 or name in self.sizes:
                raise SystemDefinitionError(f"the name '{name}' is used twice: rename one")
        for table in self.tables:
            if len(table.axes) != 2 or not table.axes[0].name or table.axes[1].name:
                raise SystemDefinitionError(
                    f"the table {table} must be declared with a size and a number of columns, as bonds[B, 2]"
                )


class ArrayLagrangian(ArraySystem):
    """Lagrangian of arrays whose sizes are known at run time."""

    __slots__ = ()
    ACTS_AS: ClassVar[str] = "LagrangianSystem"


class ArrayHamiltonian(ArraySystem):
    """Hamiltonian of arrays whose sizes are known at run time."""

    __slots__ = ()
    ACTS_AS: ClassVar[str] = "HamiltonianSystem"


ARRAYS = of("a system with arrays whose sizes are known at run time, as coordinates=['q[N]']", ArraySystem)
"""Type check of systems of arrays, for :func:`~scvi_codegen.validation.checks_arguments`."""

SYSTEM_OR_ARRAYS = of("a LagrangianSystem or a HamiltonianSystem", MechanicalSystem, ArraySystem)
"""Type check of systems, also of those with arrays of run-time sizes."""
