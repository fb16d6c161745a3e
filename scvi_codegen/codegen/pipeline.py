"""C sources of one integrator and its variants.

    MechanicalSystem, Method
      -> discretise  StageSystem   points, kernel and tables: the equations of one step
                                   (:mod:`scvi_codegen.methods.discretise`)
      -> iteration   Iteration     fixed-point iteration, if the system admits one; splitting_of: explicit splitting
                                   (:mod:`scvi_codegen.codegen.lowering.program`)
      -> symmetries  Symmetry      conserved quantities (:mod:`scvi_codegen.systems.symmetry.symmetry`)
      -> lower       Program       kernels, tables, loops: intermediate form (:mod:`.lowering.program`)
      -> render      Source        header, source: from ``templates/`` (:mod:`.rendering.program_source`), and from the
                                   statements of explicit and constrained steps (:mod:`.statements.steps`);
                                   plus event detection, if requested (:mod:`scvi_codegen.codegen.rendering.events`)

Two other consumers read a ``StageSystem``: :func:`scvi_codegen.extras.derivation.equations.derive` prints the
equations in the paper's notation, and :func:`scvi_codegen.extras.exact.step.derived_step` solves them in 60-digit
arithmetic. :mod:`scvi_codegen.extras.frameworks` extends the C source of one step and its derivatives to many steps
for JAX, PyTorch and CasADi; :func:`scvi_codegen.extras.frameworks.casadi.casadi_step` exports the stage equations
as CasADi expressions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, cast

from sympy import Expr

from scvi_codegen.codegen.ir.derivatives import PointDerivatives
from scvi_codegen.codegen.ir.equations import Control
from scvi_codegen.codegen.ir.program import ArrayProgram, Program
from scvi_codegen.codegen.ir.variants import (
    BY_STEPS,
    Acting,
    Crossings,
    Derivatives,
    Energies,
    Lanes,
    NewtonFallback,
    Observing,
    StepTerms,
    Sums,
    TangentVectors,
    Variant,
)
from scvi_codegen.codegen.lowering.arrays import check_solver
from scvi_codegen.codegen.lowering.bath import heat_bath_of
from scvi_codegen.codegen.lowering.constraints import terms_of_steps
from scvi_codegen.codegen.lowering.control import control_of, error_growth_of
from scvi_codegen.codegen.lowering.derivatives import correction_of, derivatives_of
from scvi_codegen.codegen.lowering.loops import transforms, with_sums
from scvi_codegen.codegen.lowering.program import lower, lower_arrays, summing_splitting
from scvi_codegen.codegen.lowering.solvers.points import summing_action
from scvi_codegen.codegen.lowering.stage_groups import system_kernel
from scvi_codegen.codegen.native.announcements import announced
from scvi_codegen.codegen.rendering.kernels.simd import Fallback
from scvi_codegen.codegen.rendering.program_source import (
    EMBEDDED,
    Embedded,
    in_pairs,
    render,
    render_arrays,
    render_derivatives,
    render_double_double,
    render_embedded,
    render_ensemble,
    render_ensemble_in_pairs,
    render_step_terms,
    workspace_in_pairs,
    workspace_size,
)
from scvi_codegen.codegen.rendering.source import DOUBLE_DOUBLE, ArrayLayout, Interface, Source
from scvi_codegen.common.collection import without_collection
from scvi_codegen.common.errors import MethodError, MethodWarning, SizesRequiredError, SystemDefinitionError, warn
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.methods import as_method, sliding
from scvi_codegen.methods.controllers import controller_named
from scvi_codegen.methods.discretise import discretise, discretised_form
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import tables_in_two_words
from scvi_codegen.systems.arrays.symmetry import momentum_maps
from scvi_codegen.systems.constraints import dissipates, masks_of_contacts
from scvi_codegen.systems.contacts.rows import ContactRows
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.derived_systems import with_tangent_vectors
from scvi_codegen.systems.event import EventLike, Kink, as_events
from scvi_codegen.systems.formulas.expressions import gradient_tuple
from scvi_codegen.systems.formulas.indices import SIZES_REQUIRED
from scvi_codegen.systems.formulas.intermediates import inner_of
from scvi_codegen.systems.formulas.tables import tables_in
from scvi_codegen.systems.kinks import located_kinks
from scvi_codegen.systems.legendre.transform import energy_of_states, equivalent_lagrangian
from scvi_codegen.systems.symmetry.symmetry import SYMMETRIES, Symmetry, all_symmetries
from scvi_codegen.systems.system import BATH_ENERGY, MechanicalSystem
from scvi_codegen.systems.term_groups import roll_terms

if TYPE_CHECKING:
    from scvi_codegen.systems.legendre.of_arrays import SiteHamiltonian

LONGEST_PREFIX = 64
MOST_OPERATIONS = 120_000
"""Largest number of operations in kernels that are derived and compiled within a minute.

A thousand take half a second of a processor (gcc 12, -O3): 59,000 of a beam of 40 angles 27 s, 408,000 of a chain of
100 angles 200 s.
"""
NEWTON_PARTS = 2.1
"""Operations of Newton's method in units of those of the iteration that it is the fallback of, if masses are full.

2.2 for chains of 30 and 60 angles, 1.9 for a beam of 40.
"""
C_HEADERS = frozenset(
    """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef
    stdint stdio stdlib string tgmath time wchar wctype unistd
    """.split()  # noqa: SIM905  (a paragraph of words reads better than thirty quoted ones)
)


def program_of(
    system: MechanicalSystem,
    method: Method,
    *,
    solver: str = "auto",
    prefix: str | None = None,
    symmetries: Sequence[Symmetry] = (),
    lanes: bool = True,
    fallback: bool = True,
    without_modes: MechanicalSystem | None = None,
) -> Program:
    """Return the lowered program of an integrator; other arguments as of :func:`compile_stepper`.

    ``without_modes`` is the same system with kinks by its formulas, whose symmetries are sought. ``lanes``
    and ``fallback`` are those of :func:`~scvi_codegen.codegen.lowering.program.lower`.
    """
    name = c_identifier(prefix or f"{system.name}_{method.name}")
    tracked = all_symmetries(without_modes or system, symmetries)
    program_part = partial(
        lower, method=method, prefix=name, solver=solver, symmetries=tracked, lanes=lanes, fallback=fallback
    )
    for moving in (True, False):
        parts = roll_terms(system, moving=moving)
        if parts and (rolled := with_sums(program_part(parts.rest), parts)):
            return rolled
    return program_part(system)


def lower_unrolled(
    system: MechanicalSystem,
    method: Method,
    *,
    prefix: str,
    symmetries: Sequence[Symmetry] = (),
    without_modes: MechanicalSystem,
    **further: Any,
) -> Program:
    """Return the program without loops over terms, which kernels in double-double arithmetic do not have."""
    tracked = all_symmetries(without_modes, symmetries)
    return lower(system, method, prefix=c_identifier(prefix), symmetries=tracked, **further)


def c_identifier(name: str) -> str:
    """Return a name of lower-case letters, digits and underscores that begins with a letter, of limited length.

    Single letters (``X_OK`` is a POSIX macro) and names of C headers get a suffix.
    """
    cleaned = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:LONGEST_PREFIX].strip("_")
    if not cleaned[:1].isalpha():
        return f"integrator_{cleaned}".rstrip("_")
    return f"{cleaned}_integrator" if len(cleaned) == 1 or cleaned in C_HEADERS else cleaned


def with_bath(program: Program, system: MechanicalSystem, **others: Any) -> Program:
    """Return the program in the heat bath of a system, without error estimates; steps alone conserve momentum maps.

    ``others`` are arguments without which a bath is not available.
    """
    if system.bath is None:
        return program
    if passed := [name for name, value in others.items() if value not in (None, "double")]:
        raise MethodError(f"{passed[0]}={others[passed[0]]!r} is not available with a heat bath: omit it")
    maps = tuple(replace(momentum, exact=False) for momentum in program.quantities.momentum_maps)
    quantities = replace(program.quantities, momentum_maps=maps)
    equations = replace(program.equations, stage_curve=None)
    bath = heat_bath_of(system)
    return replace(program, bath=bath, polynomial_curves=False, quantities=quantities, equations=equations)


def describe(
    program: Program,
    system: MechanicalSystem,
    method: Method,
    *,
    uses_fallback_library: bool = False,
    g: str | Expr | None = None,
) -> Interface:
    """Return the interface of a program; ``uses_fallback_library``: a separate library has Newton's iteration."""
    maps = program.quantities.momentum_maps
    interface = _interface(
        system,
        method,
        prefix=program.prefix,
        title=program.title,
        notes=program.notes,
        coordinates=program.layout.names,
        unknowns=program.equations.unknowns,
        workspace=workspace_size(program) + uses_fallback_library,
        has_action=program.action or (uses_fallback_library and program.equations.acts),
        sums_action=program.quantities.integrates,
        map_names=tuple(conserved.name for conserved in maps),
        map_formulas=tuple(conserved.formula for conserved in maps),
        map_exact=tuple(conserved.exact for conserved in maps),
        has_fallback=uses_fallback_library or (program.newton and program.fixed_point is not None),
        momentum_names=tuple(momentum.name for momentum in system.momentum_symbols),
        time_transformation=None if g is None else str(g),
        exchange_names=program.quantities.work_and_impulses,
        constraints=program.constraints.formulas,
        masked=len(system.reactions),
        conserves_energy=not system.changes_energy and not system.inputs,
        dissipates=bool(system.reactions) and dissipates(system),
        has_unseen_growth=program.has_unseen_growth,
        arrays=_arrays_of(system),
        indices=tuple(f"{name} = {value}" for name, value in system.indices.items()),
        rotations=tuple(rotation.declaration for rotation in system.rotations),
        energy_parameter=system.clock.energy.name if system.clock else None,
        solver=_solver_of(program),
        variables=tuple(variable.name for variable in getattr(system, "variables", ())),
        ranges=tuple(
            (system.text_of(value), system.text_of(argument), repr(x[0]), repr(x[-1]))
            for value in tables_in(system.lagrangian, *system.forces, *system.constraints)
            if (table := value.function.table).outside == "refuse"
            for argument, x in zip(value.arguments, table.axes, strict=True)
        ),
    )
    if program.bath is None:
        return interface
    changes = " and ".join(filter(None, (BATH_ENERGY, interface.changes_energy)))
    account: dict[str, Any] = {"conserves_energy": False, "changes_energy": changes, "balances_energy": False}
    return replace(interface, **account, temperature=program.bath.temperature, friction=program.bath.friction)


def _interface(system: MechanicalSystem, method: Method, **of_kind: Any) -> Interface:
    """Return the interface of an integrator; ``of_kind``: what named coordinates and arrays have each in their way."""
    inputs_act = "inputs act" if system.inputs else None
    return Interface(
        system=system.name,
        method=method.name,
        parameters=tuple(parameter.name for parameter in system.parameters),
        defaults=system.defaults,
        functions=tuple((name, json.dumps(asdict(table))) for name, table in system.functions),
        inputs=system.inputs,
        input_ranges=system.input_ranges,
        changes_energy=system.changes_energy or inputs_act,
        balances_energy=system.balances_energy,
        lengths=system.lengths,
        kinks=system.kinks,
        **of_kind,
    )


def _arrays_of(system: MechanicalSystem) -> tuple[str, ...]:
    """Return the declarations of the arrays whose entries are all of the coordinates, or parameters."""
    names = [variable.name for variable in (*system.coordinates, *system.parameters)]
    complete = [array for array in system.arrays if set(array.elements) <= set(names)]
    listed = [name for array in complete for name in array.elements]
    whole = listed[: system.dimension] == names[: system.dimension]
    return tuple(str(array) for array in complete if array.axes or whole) if whole else ()


def _solver_of(program: Program) -> str:
    kinds: dict[str, Any] = {
        "explicit": program.splitting,
        "rattle": program.rattle,
        "fixed-point": program.fixed_point,
    }
    kinds["newton"] = program.equations.stage_groups
    return next((name for name, part in kinds.items() if part), BY_STEPS)


class Sources:
    """C sources of one integrator and its variants; the equations are derived on first use."""

    def __init__(
        self,
        system: MechanicalSystem,
        method: Method,
        solver: str = "auto",
        prefix: str | None = None,
        symmetries: Sequence[Symmetry] = (),
        g: str | Expr | None = None,
        controller: str | None = None,
        precision: str = "double",
        *,
        locates: bool = False,
    ) -> None:
        self.method, self.solver, self.g, self.precision = method, solver, g, precision
        self._arguments = system, method, solver, prefix, symmetries, g, controller
        self._locates = locates and g is None and system.bath is None
        self.symmetries = symmetries
        self.controller = controller_named(controller, in_tau=g is not None)
        self.prefix = c_identifier(prefix or f"{system.name}_{method.name}")
        self._programs: dict[bool, Program] = {}
        self.kinks: tuple[Kink, ...] = ()
        self.system: Any = self._form_of(system)

    def _form_of(self, system: MechanicalSystem) -> MechanicalSystem:
        """Return the system in the form that the method discretises, with a mode for each kink that runs locate."""
        form = self._without_modes = discretised_form(system, self.method)
        if self._locates:
            form, self.kinks = located_kinks(form)
        return form

    def _derived(self, *, solver: str, fallback: bool = True) -> Program:
        """Return the lowered program; ``fallback``: with Newton's iteration as a fallback."""
        derive = lower_unrolled if self.precision == DOUBLE_DOUBLE else program_of
        program = derive(
            self.system,
            self.method,
            prefix=self.prefix,
            symmetries=self.symmetries,
            solver=solver,
            fallback=fallback,
            without_modes=self._without_modes,
        )
        return with_bath(program, self._arguments[0], precision=self.precision, time_transformation=self.g)

    @cached_property
    def _in_double(self) -> Sources:
        return Sources(*self._arguments)

    def program(self, *, fallback: bool = False) -> Program:
        """Return the lowered program; with ``fallback`` it also contains Newton's iteration as a fallback."""
        if fallback not in self._programs:
            with announced(f"deriving the equations of {self.system.name} by {self.method.name}"):
                estimated = fallback and self.program().has_full_masses and not inner_of(self.system.formula)
                if estimated:
                    self._warn_of_size(NEWTON_PARTS * self.program().operations, by_newton=True)
                program = self._derived(solver=self.solver, fallback=fallback)
                if not estimated:
                    self._warn_of_size(program.operations_in_text, by_newton=program.newton)
                if self.precision == DOUBLE_DOUBLE and not (self._corrected(program) or self._in_pairs(program)):
                    with tables_in_two_words():  # RATTLE is an iteration for the solution of Newton's equations
                        by_newton = self.solver == "auto" and not (program.rattle or self._correction(program))
                        program = self._derived(solver="newton" if by_newton else self.solver)
                self._programs[fallback] = program
        return self._programs[fallback]

    def _warn_of_size(self, operations: float, *, by_newton: bool) -> None:
        """Warn of kernels that take minutes, with statements of the system that do not."""
        if operations <= MOST_OPERATIONS:
            return
        remedies = ["shorten the steps, or pass solver='fixed-point', which never needs it"] if by_newton else []
        if not (self.system.auxiliaries or inner_of(self.system.formula)):
            remedies.append(
                "state a chain or tree of bodies by its joints in a file (LagrangianSystem.from_mjcf), whose mass "
                "matrix is not formed, or by points of arrays with rods: coordinates=['r[N, 2]'], constraints=["
                "'(r[i+1,0] - r[i,0])**2 + (r[i+1,1] - r[i,1])**2 = 1 for i in 0..N-2']"
            )
        what = "Newton's iteration" if by_newton else "the step"
        warn(
            f"{what} of '{self.system.name}' by {self.method.name} has about "
            f"{operations:,.0f} operations; above {MOST_OPERATIONS:,} it takes more than a minute to derive and compile"
            f"{': ' if remedies else ''}{'; or '.join(remedies)}",
            MethodWarning,
        )

    @property
    def uses_fallback_library(self) -> bool:
        """Return whether Newton's iteration comes from a separate fallback library."""
        if self.precision == DOUBLE_DOUBLE:
            return False
        return self.solver == "auto" and self.program().fixed_point is not None and not self.program().newton

    @cached_property
    def interface(self) -> Interface:
        """Interface of the generated library."""
        program = self.program()
        interface = describe(
            program, self.system, self.method, uses_fallback_library=self.uses_fallback_library, g=self.g
        )
        if self.kinks:
            interface = replace(interface, kinks=self._without_modes.kinks, modes=_modes_of(self.kinks))
        if self.precision != DOUBLE_DOUBLE:
            return interface
        size = workspace_in_pairs(program) if in_pairs(program) else interface.workspace
        return replace(interface, words=2, workspace=size)

    @without_collection
    def integrator(self, *, controlled: bool = True) -> tuple[Source, Interface]:
        """Return the C source and its interface.

        It has fixed steps and, if ``controlled`` and the method has an error estimate, those of the controller.
        """
        program = self.program()
        if self.precision == DOUBLE_DOUBLE:
            self._check_double_double()
            correction = self._correction(program)
            control = control_of(program, self.controller, self.system, self.g) if controlled else None
            return render_double_double(program, correction, control), self.interface
        control = None if self.solver == BY_STEPS else control_of(program, self.controller, self.system, self.g)
        if control and controlled and not control.density:
            control = self._with_growth(control)
        fallback: Fallback | None = "external" if self.uses_fallback_library else None
        return render(program, control if controlled else None, fallback=fallback), self.interface

    def _with_growth(self, control: Control) -> Control:
        """Return the control with the growth of errors along runs, where it is computed."""
        return replace(control, growth=error_growth_of(self.system, self.program()))

    def _correction(self, program: Program) -> PointDerivatives | None:
        """Return the kernels for the correction of a fixed-point iteration to two words, if it has one."""
        return correction_of(self.system, program.fixed_point) if program.fixed_point else None

    def _corrected(self, program: Program) -> PointDerivatives | None:
        """Return the same for constant masses, and forces of position and time, without Newton's method."""
        separable = program.fixed_point and program.fixed_point.name == "separable"
        return self._correction(program) if separable else None

    def _in_pairs(self, program: Program) -> bool:
        """Return whether double-double steps are explicit."""
        return in_pairs(program) and self.g is None and self.system.clock is None

    def _check_double_double(self) -> None:
        """Raise :class:`MethodError` if the system or the method has no steps in double-double arithmetic."""
        reason = ""
        if self.solver == "fixed-point" and not self._corrected(self.program()):
            reason = (
                f"solver={self.solver!r} requires constant diagonal masses and forces of position and time: omit it"
            )
        elif self.solver == "explicit" and not self._in_pairs(self.program()):
            reason = "solver='explicit' requires constant diagonal masses and fixed steps h in physical time: omit it"
        if reason:
            raise MethodError(
                f"precision='double-double' is not available for '{self.system.name}' by {self.method.name}: {reason}"
            )

    def fallback(self) -> Source | None:
        """Return the source with Newton's iteration if the integrator itself contains none."""
        return render(self.program(fallback=True), fallback="provided") if self.uses_fallback_library else None

    @without_collection
    def tangent(self, *, second: bool = False) -> Source | None:
        """Return the source with first, or also second, derivatives of steps with respect to all their arguments.

        Second derivatives are unavailable in transformed time, for damped and for first-order systems, and derivatives
        of first-order systems in transformed time.
        """
        excluding = second, bool(self.system.clock), bool(forms_of(self.system).one_form)  # each excludes the others
        if sum(excluding) > 1 or (second and self.system.damping):
            return None
        program = self.program(fallback=True)
        if not program.newton:  # explicit steps
            program = self._derived(solver="newton")
        stages = discretise(self.system, self.method)
        with announced(f"deriving the {'second ' * second}derivatives of {self.system.name} by {self.method.name}"):
            return render_derivatives(derivatives_of(self.system, stages, program, second=second))

    def lanes(self, precision: Literal["double", "single"]) -> Source | None:
        """Return the source of trajectories in SIMD lanes; ``None`` if the method has none."""
        if precision == "single" and self.system.bath is not None:
            raise MethodError("precision='single' is not available with a heat bath: omit it")
        return render_ensemble(self.program(), precision=precision)

    def step_terms(self) -> Source:
        """Return the source of the terms of contacts by steps with their derivatives by all inputs of a step."""
        system = self.system
        with announced(f"deriving the derivatives of contacts of {system.name} by steps"):
            kernel, entries = terms_of_steps(system)
        values = 3 * (system.dimension + len(system.contacts)) + 2 * len(system.constraints)
        columns = 2 * system.dimension + len(system.parameters) - len(masks_of_contacts(system)) + 1
        return render_step_terms(self.prefix, system, kernel, entries, values, columns)

    def _acting_program(self) -> Program | None:
        """Return the program of runs that sum the action of their steps; ``None`` if they are computed again for it."""
        program = self.program()
        if not program.quantities.integrates or self.g is not None or self.system.integrands:
            return None
        if program.splitting:
            summing = summing_splitting(program.splitting, self.system)
            return replace(program, splitting=summing, acts_along=True) if summing else None
        if program.fixed_point is None:
            return replace(program, summed=True, acts_along=True)
        shape = discretise(self.system, self.method).shape
        with_action = summing_action(program.fixed_point, self.system, shape)
        if with_action is None or not self.uses_fallback_library:
            return None
        return replace(program, fixed_point=with_action, acts_along=True)

    def acting(self) -> Source | None:
        """Return the source of runs that sum the action of their steps, or ``None``."""
        program = self._acting_program()
        if program is None:
            return None
        control = control_of(self.program(), self.controller, self.system, None)
        if control:
            control = self._with_growth(control)
        return render(program, control, fallback="external" if self.uses_fallback_library else None)

    def acting_ensemble(self) -> Source | None:
        """Return the source of trajectories in SIMD lanes that sum the action; ``None`` unless forces are stored."""
        program = self._acting_program()
        separable = program and program.fixed_point and program.fixed_point.name == "separable"
        return render_ensemble(program) if program and separable else None

    def changes(self, count: int) -> Source | None:
        """Return the ensemble source with tangent vectors; ``None`` unless it is a fixed point with constant mass."""
        twin, fixed_point = equivalent_lagrangian(self.system), self.program().fixed_point
        if not (twin and fixed_point and fixed_point.serves_many and fixed_point.constant_mass):
            return None
        varied = with_tangent_vectors(twin, count)
        if varied is None:
            return None
        program = lower(varied, self.method, prefix=self.prefix, solver="fixed-point")
        return render_ensemble(program, tangents=count)

    def observing(self, observed: Observing) -> Source | None:
        """Return the ensemble source that observes functions of the state; ``None`` without trajectories in lanes."""
        system, program = self.system, self.program()
        if program.rattle or render_ensemble(program) is None:
            return None
        states = *system.coordinates, *system.momentum_symbols
        match observed:
            case Crossings(functions):
                from scvi_codegen.codegen.rendering.events import EventFormulas

                formulas = EventFormulas(self.interface, as_events(functions))
                momenta = dict(zip(formulas.p, system.momentum_symbols, strict=True))
                values: Sequence[Expr] = [value.xreplace(momenta) for value in formulas.functions]
                if any(value.free_symbols & {*system.velocities} for value in values):
                    values = self._at_momenta(values)
            case Energies():
                values = [self._energy_of_states()]
            case _:
                values = states
        counts = isinstance(observed, Crossings)
        return render_ensemble(program, system_kernel(system, "observed_lanes", values, u=states), counts=counts)

    def _energy_of_states(self) -> Expr:
        """Return the energy as a function of positions and momenta."""
        system = self.system
        try:
            return energy_of_states(system)
        except SystemDefinitionError as error:
            raise MethodError(
                f"ensembles of '{system.name}' cannot observe velocities or energies, whose formulas are unknown "
                f"({error}): save states, or observe functions of coordinates and momenta"
            ) from error

    def _at_momenta(self, values: Sequence[Expr]) -> Sequence[Expr]:
        """Return functions of velocities as functions of momenta."""
        # Hamilton's equation, v = dH/dp
        velocities = gradient_tuple(self._energy_of_states(), self.system.momentum_symbols)
        at_momenta = dict(zip(self.system.velocities, velocities, strict=True))
        return [value.xreplace(at_momenta) for value in values]

    @without_collection
    def variant(self, variant: Variant) -> Source | None:
        """Return the source of a variant; ``None`` if the method lacks it."""
        if self.solver == BY_STEPS and not isinstance(variant, StepTerms):
            return None
        if self.precision == DOUBLE_DOUBLE:
            return self._variant_in_pairs(variant)
        match variant:
            case Lanes(precision):
                source = self.lanes(precision)
            case NewtonFallback():
                source = self.fallback()
            case Derivatives(order):
                source = self.tangent(second=order == 2)
            case StepTerms():
                source = self.step_terms()
            case Acting(in_lanes):
                source = self.acting_ensemble() if in_lanes else self.acting()
            case TangentVectors(count):
                source = self.changes(count)
            case Observing():
                source = self.observing(variant)
            case _:
                raise NotImplementedError(variant)
        return source

    def _variant_in_pairs(self, variant: Variant) -> Source | None:
        """Return the source of a variant in double-double arithmetic; derivatives are those of the step in double."""
        if isinstance(variant, Lanes):
            return render_ensemble_in_pairs(self.program(), self._corrected(self.program()))
        return None if variant.of_one_word else self._in_double.variant(variant)


class ArraySources(Sources):
    """C source of an integrator of arrays whose sizes are known at run time: loops over the arrays, without variants.

    Other systems of velocities than m v**2/2 are integrated by their Hamiltonian, if its terms are those of elements.

    Attributes:
        sums: of the increments of explicit steps.
    """

    sums: Sums = "compensated"

    def _form_of(self, system: MechanicalSystem) -> MechanicalSystem:
        self.solver = "fixed-point" if self.solver == "auto" else self.solver
        check_solver(self.solver)
        return system

    @cached_property
    def sites(self) -> SiteHamiltonian | None:
        """Hamiltonian by which the system is integrated, of a Lagrangian with other velocities than m v**2/2."""
        by_momenta = self.g is None and self.solver == "fixed-point" and self.system.coupled_terms
        if self.system.bath or not by_momenta:
            return None
        from scvi_codegen.systems.legendre.of_arrays import site_hamiltonian

        return site_hamiltonian(self.system)

    @without_collection
    def integrator(self, *, controlled: bool = True) -> tuple[Source, Interface]:
        """Return the C source and its interface; arguments as of :meth:`Sources.integrator`."""
        program = self.program()
        assert isinstance(program, ArrayProgram)
        control = control_of(program, self.controller, self.system, self.g) if controlled else None
        return render_arrays(program, control), self.interface

    def _derived(self, **_: Any) -> ArrayProgram:
        """Return the lowered program; raise :class:`SizesRequiredError` if there is none for run-time sizes."""
        system = self.sites.system if self.sites else self.system
        system.check_run_time_sizes()
        try:
            if self.g is not None:
                raise SizesRequiredError("time_transformation is not available for arrays of run-time sizes")
            program = lower_arrays(system, self.method, prefix=self.prefix, solver=self.solver, sums=self.sums)
        except SizesRequiredError as error:
            raise SizesRequiredError(f"{error}. This concerns '{self.system.name}': {SIZES_REQUIRED}") from error
        layout = self.interface.layout
        functions: dict[str, Any] = transforms(self.sites) if self.sites else {}
        loops = replace(program.loops, maps=layout.maps, continued=layout.continued, **functions)
        return replace(program, loops=loops)

    @cached_property
    def interface(self) -> Interface:
        """Interface of the generated library."""
        system, sites = self.system, self.sites
        arrays = ("sizes", "momenta", "fields", "field_defaults", "tables", "accesses")
        declared = {name: getattr(system, name) for name in (*arrays, "depends_on_time", "data", "mesh")}
        layout = ArrayLayout(
            **declared,
            coordinates=system.positions,
            maps=momentum_maps(system),
            constraints=tuple(term.loops for term in system.constraints),
            continued=not (self.method.fractions or system.constraints),
            momentum_formulas=sites.momenta if sites else (),
            couplings=(*system.potentials, *system.applied_forces) if self.solver == "newton" else (),
            symmetric=not (system.momenta or system.velocities),
            neighbours=tuple(near.name for near in system.neighbours),
        )
        return _interface(
            system,
            self.method,
            prefix=self.prefix,
            title=f"{system.name}: {self.method.title}",
            coordinates=tuple(array.name for array in system.positions),
            conserves_energy=not (system.momenta or system.changes_energy or system.inputs),
            solver="rattle" if system.constraints else self.solver,
            layout=layout,
            temperature=system.text_of(system.bath.temperature) if system.bath else None,
            friction=_friction_of(system),
        )

    def variant(self, variant: Variant) -> None:
        """Return ``None``: variants are those of known sizes."""


def _friction_of(system: Any) -> tuple[tuple[str, str], ...]:
    """Return names and formulas of the coefficients of the friction of a heat bath of arrays."""
    terms = [(f"dissipation of {at.array.name}_dot", c) for force in system.bath_terms[0] for at, c in force.targets]
    damping = [("damping", system.bath.damping)] if system.bath else []
    return tuple((name, system.text_of(formula)) for name, formula in [*damping, *terms])


def _modes_of(kinks: Iterable[Kink]) -> tuple[tuple[str, ...], ...]:
    """Return the modes of kinks in an interface."""
    return tuple(
        (u.mode, str(u.function), "jumps" * u.is_wall, u.held, u.lacks, *map(str, u.power_sides)) for u in kinks
    )


@checks_arguments(system=MechanicalSystem.KIND, symmetries=SYMMETRIES)
@without_collection
def generate_source(
    system: MechanicalSystem,
    method: Method | str,
    *,
    solver: str = "auto",
    prefix: str | None = None,
    symmetries: Sequence[Symmetry] = (),
    events: EventLike | Sequence[EventLike] | None = None,
    embedded: Embedded | None = None,
    controlled: bool = False,
    time_transformation: str | Expr | None = None,
    controller: str | None = None,
) -> tuple[Source, Interface]:
    """Return the C source of an integrator and its interface; other arguments as of :func:`compile_stepper`.

    The source has support headers beside it; ``source.single_file()`` includes them. Located kinks and contacts are
    those of ``_advance_with_changes``.

    Args:
        embedded: precision, ``"double"`` or ``"single"``, of source for a microcontroller. Its solver is explicit or
            Newton, which needs half the stack of the SIMD fixed-point iteration without vector registers.
        controlled: use adaptive steps, if the method has an error estimate.
        time_transformation: use constant steps in tau instead, dt = g dtau, by the reversible controller.
        controller: step-size controller, as of :func:`compile_stepper`.

    Raises:
        MethodError: if the solver is not available for the method, if a constant exceeds single precision, and if
            events are combined with ``embedded="single"``.
    """
    method = as_method(method, system)
    locates = not embedded and time_transformation is None
    if locates and controller is None:
        system = sliding(system, method)
    original, rows = system, cast("tuple[ContactRows, ...]", ())
    if system.has_contacts and time_transformation is not None:
        raise MethodError(f"time_transformation={str(time_transformation)!r} is not available with contacts: omit it")
    if system.has_contacts:
        from scvi_codegen.systems.contacts.modes import bound_contacts

        system, rows = bound_contacts(system, system.contacts)
    form = discretised_form(system, method)
    system, located = located_kinks(form) if locates and original.bath is None else (form, ())
    if embedded not in (None, *EMBEDDED):
        raise MethodError(f"embedded must be {' or '.join(EMBEDDED)}, not {embedded!r}")
    if embedded and solver == "fixed-point":
        raise MethodError("solver='fixed-point' is unavailable with embedded: use 'newton' or 'explicit'")
    if embedded == "single" and (rows or as_events(events)):
        raise MethodError("events require double precision, in which they are located: use embedded='double'")
    program = program_of(
        system, method, solver=solver, prefix=prefix, symmetries=symmetries, lanes=embedded is None, without_modes=form
    )
    program = with_bath(program, original, embedded=embedded, time_transformation=time_transformation)
    g = time_transformation
    of_steps = controller_named(controller, in_tau=g is not None)
    control = control_of(program, of_steps, system, g) if controlled or g is not None else None
    source = render_embedded(program, embedded, control) if embedded else render(program, control)
    interface = replace(describe(program, system, method, g=g), contacts=rows)
    if located:
        interface = replace(interface, kinks=form.kinks, modes=_modes_of(located))
    searched = interface.searched(as_events(events))
    if searched:
        from scvi_codegen.codegen.rendering.events import with_events

        source = with_events(source, interface, searched)
    return (source.single_file() if embedded else source), interface
