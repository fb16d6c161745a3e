"""Systems of arrays: Lagrangians in index notation, of few kinds of terms (lattices, fields, N bodies).

    L = sum_f sum_(e in loops of f) l_f(array entries at e, parameters, t)

Only the kernels l_f are differentiated, so neither compile time nor code size depends on the number of coordinates,
which is determined by the arrays that a run starts from; kinetic energy is then a sum of m v**2/2 with constant m that
may differ between elements, or quadratic in the velocities of each element
(:mod:`scvi_codegen.mechanics.arrays.legendre`). With known sizes they are systems of named coordinates
(:mod:`scvi_codegen.mechanics.arrays.rolling`), without restrictions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, ClassVar

import numpy as np
from sympy import Expr, S, Symbol

from scvi_codegen.errors import SizesRequiredError, SystemDefinitionError
from scvi_codegen.files.cache import key_of
from scvi_codegen.formulas.array_notation import array_text, latex_sum
from scvi_codegen.formulas.array_statements import ArrayForce, parse_constraint, parse_force
from scvi_codegen.formulas.arrays import ArrayTerm, parse_array, parse_coordinate, parse_sums
from scvi_codegen.formulas.expressions import unsupported_part
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.rotations.arrays import MemberArray, member_arrays, torque_components
from scvi_codegen.formulas.symbols import DOT, TIME, check_names, input_formulas, number, symbol, with_inputs
from scvi_codegen.indices import SIZES_REQUIRED, Access, Array, Loop
from scvi_codegen.mechanics.arrays.terms import (
    check_constraint,
    constraint_text,
    force_of,
    friction,
    friction_of,
    has_constant_mass,
    masses_of,
    momenta_of,
    substituted,
    table_of,
    terms_at_rest,
)
from scvi_codegen.mechanics.definition_checks import warn_of_negative, warn_of_unused
from scvi_codegen.mechanics.forces import check_damping, damping_rate
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.representation import LONGEST, clipped
from scvi_codegen.validation import FORMULA, MAPPING, NAMES, TABLES, TEXT, TEXTS, checks_arguments, of


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
        terms: of the Lagrangian or the Hamiltonian.
        forces: generalised forces of coordinates, velocities (momenta of a Hamiltonian) and time.
        inputs: names of functions of time passed to each run, each represented by five of the parameters.
        constraints: g = 0 at every element of loops (:mod:`scvi_codegen.mechanics.arrays.terms`).
        damping: damping rate of all momenta, see :class:`~scvi_codegen.mechanics.system.MechanicalSystem`.
        rotations: rotations, directions and spins, which require known sizes.
        definition: the arguments of :meth:`from_text` other than name and parameters, for model files.
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
        for array in () if self.momenta else self.coordinates:
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
                raise SizesRequiredError("rotations, directions and spins are not available for arrays of any size")
            for term in self.coupled_terms:
                raise SizesRequiredError(
                    f"'{term}' contains velocities in another form: arrays of any size have velocities as m*v**2/2 "
                    "only, with a constant mass m"
                )
            inputs = "|".join(f"{name}_[0123t]" for name in self.inputs)
            for term in self.constraints:
                check_constraint(term, self.coordinates, self.fields, inputs)
            if self.damping != 0 and self.momenta:
                raise SizesRequiredError("damping of a Hamiltonian requires known sizes: write it as forces")
            for array in self.coordinates:
                if len(array.axes) > 1 and any(not axis.name for axis in array.axes[:-1]):
                    raise SizesRequiredError(f"of the axes of {array} only the last may be a number: name the others")
        except SizesRequiredError as error:
            raise SizesRequiredError(f"{error}. This concerns '{self.name}': {SIZES_REQUIRED}") from error

    @classmethod
    @checks_arguments(
        SystemDefinitionError,
        name=TEXT,
        coordinates=TEXTS,
        lagrangian=TEXT,
        hamiltonian=TEXT,
        momenta=TEXTS,
        parameters=MAPPING,
        tables=TABLES,
        forces=MAPPING,
        dissipation=TEXT,
        damping=FORMULA,
        inputs=NAMES,
        constraints=TEXTS,
    )
    def from_text(
        cls,
        name: str,
        coordinates: Sequence[str],
        lagrangian: str | None = None,
        *,
        hamiltonian: str | None = None,
        momenta: Sequence[str] | None = None,
        parameters: Mapping[str, float] | None = None,
        tables: Sequence[str] | Mapping[str, Any] = (),
        forces: Mapping[str, str] | None = None,
        dissipation: str | None = None,
        damping: str | float | None = None,
        inputs: Sequence[str] = (),
        constraints: Sequence[str] = (),
        rotations: Mapping[str, str] | None = None,
        directions: Sequence[str] | None = None,
        spins: Sequence[str] | None = None,
        torques: Mapping[str, Sequence[str]] | None = None,
        torques_space: Mapping[str, Sequence[str]] | None = None,
    ) -> ArraySystem:
        """Read L or H from text of the grammar in :mod:`scvi_codegen.formulas.arrays`.

        Args:
            name: name of the system.
            coordinates: declarations, as ``["x", "q[N]", "r[N, 3]"]``; sizes are names or whole numbers.
            lagrangian: the formula; the velocity of ``q[i]`` is written ``q_dot[i]``, time ``t``.
            hamiltonian: in place of ``lagrangian``, H in coordinates and momenta, of any form.
            momenta: of H, declarations like those of the coordinates; by default ``["p_q[N]"]``.
            parameters: default value by name, or by declaration of an array, as ``{"k": 1, "m[N]": 1}``; the values of
                an array, one per element, are passed to each run, or are default values here, ``{"m[N]": [1, 2, 3]}``.
            tables: declarations of index tables with their columns, as ``["bonds[B, 2]"]``, or ``["pins[P]"]``; a
                mapping from them to default values.
            forces: formula by coordinate, ``{"q[i]": "-c*q_dot[i]"}`` for every index, ``{"q[0]": "cos(t)"}`` for one.
            dissipation: Rayleigh's function, a sum of sums over velocities, whose forces -dD/dq_dot are added.
            damping: damping rate of all momenta, a number or a formula of parameters.
            inputs: names of functions of time whose values are passed to each run
                (:mod:`scvi_codegen.formulas.symbols`).
            constraints: formulas in coordinates and time that are 0, or equations, followed by the loops over which
                they hold, ``"(q[i+1] - q[i])**2 = 1 for i in 0..N-2"``.
            rotations, directions, spins, torques, torques_space: as of :meth:`LagrangianSystem.from_text`, single or in
                arrays, ``rotations={"R[N]": "omega"}`` with ``R_33[i]``, ``omega_1[i]`` in formulas and torques on
                ``"R[i]"``.

        Raises:
            SystemDefinitionError: for text outside the grammar.

        >>> chain = ArraySystem.from_text(
        ...     name="chain", coordinates=["q[N]"], parameters={"k": 2},
        ...     lagrangian="sum(i in N, q_dot[i]**2/2) - k*sum(i in N periodic, (q[i+1] - q[i])**2/2)")
        >>> print(chain)
        chain: L(q[N]) = sum(i in N, q_dot[i]**2/2) + sum(i in N periodic, -k*(q[i+1] - q[i])**2/2)
        """
        definition = {
            "coordinates": list(coordinates),
            "momenta": None if momenta is None else list(momenta),
            "lagrangian": lagrangian,
            "hamiltonian": hamiltonian,
            "tables": list(tables),
            "forces": dict(forces or {}),
            "dissipation": dissipation,
            "damping": damping,
            "inputs": list(inputs),
            "constraints": list(constraints),
            "rotations": dict(rotations or {}),
            "directions": list(directions or ()),
            "spins": list(spins or ()),
            "torques": dict(torques or {}),
            "torques_space": dict(torques_space or {}),
        }
        arrays = tuple(map(parse_coordinate, coordinates))
        conjugate = momenta_of(arrays, momenta, lagrangian, hamiltonian)
        index_tables = tuple(map(table_of, tables))
        data = {key: value for key, value in (parameters or {}).items() if "[" in key and np.ndim(value)}
        numbers = {key: 1.0 if key in data else number(key, value) for key, value in (parameters or {}).items()}
        data |= tables if isinstance(tables, Mapping) else {}
        values = with_inputs(numbers, inputs)
        fields = {key: parse_array(key) for key in values if "[" in key}
        scalars = {key: value for key, value in values.items() if key not in fields}
        velocities = () if conjugate else tuple(Array(array.name + DOT, array.axes) for array in arrays)
        text = lagrangian if hamiltonian is None else hamiltonian
        assert text is not None
        known = {key: symbol(key) for key in (*scalars, *inputs, TIME)}
        driven = input_formulas(inputs, symbol(TIME))
        turning = member_arrays(rotations, directions, spins, momentum=hamiltonian is not None)
        turned = [array for each in turning for array in each.formulas]
        everything = (*arrays, *conjugate, *velocities, *fields.values(), *turned)
        targets = [(*pair, arrays) for pair in (forces or {}).items() if isinstance(pair[1], str)]
        vectors = {target: force for target, force in (forces or {}).items() if not isinstance(force, str)}
        for by_name, in_space in (({**vectors, **(torques or {})}, False), (torques_space or {}, True)):
            for target, torque in by_name.items():
                targets += torque_components(turning, target, torque, in_space=in_space)
        applied = [
            parse_force(target, force, on, (*everything, *on), known, index_tables) for target, force, on in targets
        ]
        if dissipation is not None:
            dissipated = parse_sums(dissipation, everything, known, index_tables)
            moving = dict(zip(velocities, arrays, strict=False))
            for each in turning:
                moving |= zip(each.rates, each.torques(), strict=False)
            applied.append(friction(dissipated, moving))
        kind = ArrayLagrangian if hamiltonian is None else ArrayHamiltonian
        system = kind(
            name=name,
            coordinates=arrays,
            momenta=conjugate,
            time=symbol(TIME),
            parameters=tuple(known[key] for key in scalars),
            defaults=tuple(scalars.values()),
            fields=tuple(fields.values()),
            field_defaults=tuple(values[key] for key in fields),
            tables=index_tables,
            terms=tuple(substituted(term, driven) for term in parse_sums(text, everything, known, index_tables)),
            forces=tuple(substituted(force, driven) for force in chain(*applied)),
            inputs=tuple(inputs),
            constraints=tuple(parse_constraint(each, everything, known, index_tables) for each in constraints),
            damping=damping_rate(damping, lambda formula: parse_expression(str(formula), known)),
            rotations=turning,
            definition={key: value for key, value in definition.items() if value not in (None, [], {})},
            data={parse_array(key).name: value for key, value in data.items()},
        )
        system.warn_of_mistakes()
        return system

    @classmethod
    @checks_arguments(SystemDefinitionError, name=TEXT, coordinates=TEXTS, parameters=MAPPING, tables=TABLES)
    def from_sympy(
        cls,
        *,
        name: str,
        coordinates: Sequence[str],
        lagrangian: Expr,
        parameters: Mapping[str, float] | None = None,
        tables: Sequence[str] | Mapping[str, Any] = (),
    ) -> ArraySystem:
        """Create the system from a SymPy expression of ``Sum`` and ``Indexed``; see also :meth:`from_text`.

        A periodic index is ``Mod(i + 1, N)``, pairs are ``(j, i + 1, N - 1), (i, 0, N - 2)``, a table entry is
        ``q[bonds[b, 0]]``, the velocity of ``q[i]`` is that of ``IndexedBase("q_dot")``.

        >>> from sympy import IndexedBase, Sum, symbols
        >>> q, v, (i, N) = IndexedBase("q"), IndexedBase("q_dot"), symbols("i N", integer=True)
        >>> kinetic, springs = Sum(v[i] ** 2 / 2, (i, 0, N - 1)), Sum((q[i + 1] - q[i]) ** 2 / 2, (i, 0, N - 2))
        >>> chain = ArraySystem.from_sympy(name="chain", coordinates=["q[N]"], lagrangian=kinetic - springs)
        >>> print(*sorted(map(str, chain.terms)), sep=chr(10))
        sum(i in 0..N-2, -(q[i+1] - q[i])**2/2)
        sum(i in N, q_dot[i]**2/2)
        """
        if not isinstance(lagrangian, Expr):
            what = type(lagrangian).__name__
            raise SystemDefinitionError(f"the Lagrangian is a {what}, not a SymPy expression (text goes to from_text)")
        text = array_text(lagrangian)
        return cls.from_text(name=name, coordinates=coordinates, lagrangian=text, parameters=parameters, tables=tables)

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

    def warn_of_mistakes(self) -> None:
        """Warn of parameters and inputs that occur in no formula, and of negative masses."""
        terms = [*self.terms, *self.constraints]
        formulas = [term.formula for term in terms] + [f for force in self.forces for _, f in force.targets]
        formulas.append(self.damping)
        used = {symbol(access.array.name) for access, _ in self.accesses}.union(*(f.free_symbols for f in formulas))
        scalars = {symbol(array.name): value for array, value in zip(self.fields, self.field_defaults, strict=True)}
        values = scalars | dict(zip(self.parameters, self.defaults, strict=True))
        warn_of_unused(self.name, self.function, values, self.inputs, used)
        moving = {array.name: array for array in self.momenta} or self._velocities
        for name in moving:
            kinetic = [mass for term in self.terms for mass in masses_of(term, {name: moving[name]})]
            if len(kinetic) == 1:  # masses of several loops are added where these meet
                uniform = {slot: symbol(access.array.name) for slot, access in kinetic[0].slots}
                warn_of_negative(
                    self.name, {f"d2{self.function[0]}/d{name}2": kinetic[0].targets[0][1].xreplace(uniform)}, values
                )

    def _check_names(self) -> None:
        check_names(*([each.name for each in group] for group in (self.positions, self.parameters, self.momenta)))
        known = [each.name for each in (*self.arrays, *self.parameters)]
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
