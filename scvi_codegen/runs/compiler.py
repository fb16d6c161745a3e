"""Compilation: from a mechanical system and a method to a stepper.

    MechanicalSystem, Method
      -> Sources   header, source and interface, derived once (:mod:`scvi_codegen.codegen.pipeline`) and cached
      -> build     library, compiled once (:mod:`scvi_codegen.codegen.native.building`); Newton's iteration is
                   added when a fixed point first fails (:mod:`scvi_codegen.codegen.rendering.kernels.simd`)
      -> Stepper   step, integrate (:mod:`scvi_codegen.runs.stepper`)

Each stage is a pure function of frozen data; only ``build`` touches the disk. Sources and compiled libraries are
cached in the user's cache folder (:mod:`scvi_codegen.common.cache`). If everything is in the cache, including the
key of a system defined by text (:mod:`scvi_codegen.systems.system`), neither SymPy nor the pipeline is imported.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from scvi_codegen.codegen.ir.variants import BY_STEPS, Derivatives, Sums, Variant
from scvi_codegen.codegen.native.building import TUNED_FLAGS
from scvi_codegen.codegen.native.compilers import REORDERING_FLAGS
from scvi_codegen.codegen.native.option_table import LOCATED, OPTION
from scvi_codegen.codegen.rendering.source import AUTO, DOUBLE_DOUBLE, Interface, Source
from scvi_codegen.common.cache import cached_source, key_of
from scvi_codegen.common.errors import MethodError, MethodWarning, SizesRequiredError
from scvi_codegen.common.once import Once
from scvi_codegen.common.validation import TEXTS, OfRunTimeSizes, check_kind, checks_arguments
from scvi_codegen.methods import (
    DEFAULT_NAME,
    LOOSE,
    SVI,
    StoermerVerlet,
    as_method,
    default_method,
    finer_method,
    sliding,
)
from scvi_codegen.methods.method import Method
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.stepping.compiled_method import Variants
from scvi_codegen.systems.contact import MOST_ROWS, ContactLike
from scvi_codegen.systems.contacts.rows import ContactRows
from scvi_codegen.systems.event import Event, EventLike, as_events, warn_of_formulas
from scvi_codegen.systems.formulas.indices import SIZES_REQUIRED
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from sympy import Expr

    from scvi_codegen.codegen.pipeline import Sources
    from scvi_codegen.systems.symmetry.symmetry import Symmetry


@checks_arguments(system=MechanicalSystem.OR_ARRAYS, flags=TEXTS)
def compile_stepper(
    system: MechanicalSystem,
    method: Method | str | None = None,
    *,
    solver: str = "auto",
    flags: tuple[str, ...] = TUNED_FLAGS,
    prefix: str | None = None,
    symmetries: Sequence[Symmetry] = (),
    events: EventLike | Sequence[EventLike] | None = None,
    time_transformation: str | Expr | None = None,
    controller: str | None = None,
    sizes: Mapping[str, int] | None = None,
    tables: Mapping[str, ArrayLike] | None = None,
    precision: str = "double",
    sums: str = "compensated",
    contacts: Sequence[ContactLike] = (),
    transitions: str = LOCATED,
) -> Stepper:
    """Derive, generate, compile and load the integrator of ``system`` by ``method``.

    Args:
        system: the mechanical system.
        method: the discretisation, or a name as on the command line: ``"svi"``, ``"svi:6"``. By default the degree
            follows the tolerance: adaptive runs of a tolerance of 1e-4 and more are by SVI(4), all others by SVI(8);
            with constraints, contacts or dry friction all are by SVI(8) with Gauss-Lobatto points. ``run.method`` is
            that of a run. The C of each degree is then compiled when a call first needs it, or by
            :meth:`Stepper.prepare`.
        solver: solver of the stage equations. ``"fixed-point"`` is fast (stages are SIMD lanes) and available for
            methods with at most 32 stages, except variational SCVI with more than 8 coordinates and SVI with fewer
            points than its degree; ``"newton"`` is always available, also for stiff systems and large steps;
            ``"explicit"`` requires Stoermer-Verlet or a composition and a separable system; ``"auto"`` takes explicit
            or fixed point if available and falls back to Newton, compiled when first needed.
        flags: flags for the C compiler; the default is tuned to this processor. The variable ``SCVI_CODEGEN_CFLAGS``
            adds flags to these, so that it cannot replace them by those that give the same bits on every machine.
        prefix: prefix of the C names; by default made from the names of system and method.
        symmetries: symmetries to track in addition to those that are detected
            (:func:`~scvi_codegen.systems.symmetry.checking.check_symmetry`).
        events: zero crossings that every run of this stepper records, see :meth:`Stepper.integrate`.
        time_transformation: time-rescaling function g(q, t) > 0 (g(q, p, t) of a Hamiltonian), or a name accepted by
            :func:`~scvi_codegen.reparametrise`. Runs with h and t_end then take constant steps h in tau, dt = g dtau,
            by the reversible controller of Hairer and Soederlind; time-dependent and forced systems are supported.
            Momentum maps are preserved. Entries and sums of arrays are written in index notation.
        controller: step-size controller of runs to t_end, by default ``"predictive"`` (adaptive steps), and
            ``"reversible"`` with a time transformation; a name among ``scvi_codegen.methods.controllers.CONTROLLERS``.
        sizes: whole numbers for the sizes of arrays, ``{"N": 8}``: the system of all entries q_0, q_1, .. is compiled,
            which has every feature. Without them arrays have the sizes that each run gives them: neither the length of
            the C source nor its compile time depends on the number of coordinates, and the solver is ``"fixed-point"``,
            without fallback, or ``"newton"``, with factors of the linear part of a step (meshes, chains, Hamiltonians)
            or Newton-GMRES with the diagonal of the Jacobian or its circulant (Fourier) average. Methods are explicit,
            or have a fixed-point iteration over stage positions (SVI, SC, Runge-Kutta); others, and systems without
            such loops, are compiled with the sizes of each call, once.
        tables: with ``sizes``, index tables of shape (rows, columns) by name.
        precision: ``"double"``; or ``"double-double"`` for states and results of 31 digits (docs/digits.md); or
            ``"auto"``: double, and double-double for runs with ``error=`` that double does not confirm, as
            ``run.confirmation.precision`` reports.
        sums: of the increments of steps: ``"compensated"``, whose rounding errors are added to later steps (Kahan), or
            ``"plain"``, for explicit methods and arrays of run-time sizes: faster, with rounding errors that grow with
            the number of steps (docs/lattices.md).
        contacts: contacts and dry friction of the system, made by :func:`~scvi_codegen.contact` and
            :func:`~scvi_codegen.friction`, in addition to its own. The method is an SVI of degree s with s + 1 Lobatto
            points, ``"svi:3"``, in double precision.
        transitions: ``"by steps"``: all runs have contacts by steps (:meth:`Stepper.integrate`), and the equations of
            located steps are neither derived nor compiled, which takes half to two thirds of the time of robots.

    Raises:
        BuildError: if there is no C compiler.
        MethodError: if the method, the solver or another argument is not available for the system.
    """
    check_precision(precision, flags)
    _check_symmetries(symmetries)
    if OPTION["transitions"].checked(transitions) == BY_STEPS and solver == "auto":
        solver = BY_STEPS  # that of contacts by steps alone
    choices: dict[str, Any] = {
        "solver": solver,
        "flags": flags,
        "prefix": prefix,
        "symmetries": symmetries,
        "time_transformation": time_transformation,
        "controller": controller,
        "sizes": sizes,
        "tables": tables,
        "precision": precision,
        "sums": OPTION["sums"].checked(sums, MethodError),
    }
    stepper = _compiled(system, method, tuple(contacts), as_events(events), choices)
    stepper._finer = Once(partial(_finer_stepper, system, method, tuple(contacts), choices))
    return stepper.by_transitions(transitions)


def _compiled(
    stated: MechanicalSystem,
    method: Method | str | None,
    contacts: tuple[ContactLike, ...],
    events: tuple[Event, ...],
    choices: Mapping[str, Any],
) -> Stepper:
    """Return the stepper of :func:`compile_stepper`, by its further arguments: of each sizes, precision or system."""
    named = DEFAULT_NAME if method is None else method
    system, rows = _with_contacts(stated, named, contacts, choices)
    if rows:  # contacts have no second precision for "auto"
        choices = {**choices, "precision": "double"}
    looser = _looser(stated, choices) if method is None and not rows else None
    has_sizes = not choices["sizes"] is choices["tables"] is None
    if isinstance(system, OfRunTimeSizes) and not has_sizes:
        return _compile_arrays(system, method, events, choices, looser)
    if choices["sums"] == "plain":
        raise MethodError(
            f"sums='plain' is not available for '{system.name}' with named coordinates or known sizes: leave out "
            "sums=, or declare arrays, q[N], whose sizes each run gives"
        )
    if choices["precision"] == AUTO:
        return _in_both_precisions(partial(compile_stepper, system, method), events, choices)
    shape: dict[str, Any] = {"mesh": system.mesh, "links": system.drawn_links}
    if has_sizes:
        system, g = _at_sizes(system, choices["time_transformation"], choices["sizes"] or {}, choices["tables"])
        choices = {**choices, "time_transformation": g, "sizes": None, "tables": None}
        system, rows = _with_contacts(system, named, (), choices)
    discretisation, flags = as_method(named, system), choices["flags"]
    of_sources: list[Any] = [choices[name] for name in OF_SOURCES]

    def made(precision: str, events: tuple[Event, ...] = (), *, locates: bool = False) -> Stepper:
        sources = CachedSources(system, discretisation, *of_sources, precision, locates=locates)
        source, interface = sources.integrator()
        interface = replace(interface, layout=replace(interface.layout, **shape), contacts=rows)
        return Stepper(source, interface, variants=sources.variants, flags=flags, events=events, looser=looser)

    precision = choices["precision"]
    stepper = made(precision, events, locates=precision != DOUBLE_DOUBLE)
    if precision == DOUBLE_DOUBLE:
        stepper._doubles = cache(partial(made, "double"))
    if not stepper.interface.modes:
        warn_of_formulas(stepper.interface, f"the stepper of '{stepper.interface.system}'")
    system.store_key()
    return stepper


def _finer_stepper(
    system: MechanicalSystem, method: Method | str | None, contacts: tuple[ContactLike, ...], choices: Mapping[str, Any]
) -> Stepper:
    """Return the stepper of :func:`~scvi_codegen.methods.finer_method`, in physical time."""
    constrained = bool(contacts or system.constraints or system.has_contacts or system.rotations)
    named = default_method(system) if method is None else as_method(method, system)
    name = finer_method(named, constrained=constrained)
    options = {option: choices[option] for option in ("sizes", "tables", "flags", "precision")}
    precision = DOUBLE_DOUBLE if options["precision"] == DOUBLE_DOUBLE else "double"
    return _compiled_silently(system, name, {**options, "precision": precision, "contacts": contacts})


def _looser(system: MechanicalSystem, arguments: Mapping[str, Any]) -> Once[Stepper] | None:
    """Return a function that compiles the stepper of loose adaptive runs; ``None`` if their method is no other one."""
    method = default_method(system, LOOSE)
    return None if method == default_method(system) else Once(partial(_compiled_silently, system, method, arguments))


def _compiled_silently(system: MechanicalSystem, method: Method | str, arguments: Mapping[str, Any]) -> Stepper:
    """Return a further stepper of a system, without the warnings of its formulas that the first one issued."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MethodWarning)
        return compile_stepper(system, method, **arguments)


def _check_symmetries(symmetries: Any) -> None:
    """Raise an error for symmetries of other types."""
    if symmetries != ():
        from scvi_codegen.systems.symmetry.symmetry import SYMMETRIES

        check_kind(SYMMETRIES, symmetries, "symmetries")


OF_SOURCES = "solver", "prefix", "symmetries", "time_transformation", "controller"
"""Arguments of :class:`~scvi_codegen.codegen.pipeline.Sources` in order."""
WITHOUT_CONTACTS = "precision", "sizes", "tables", "controller", "time_transformation"
"""Arguments of which other values than the default exclude contacts."""


def _with_contacts(
    system: MechanicalSystem, method: Method | str, contacts: Sequence[ContactLike], choices: Mapping[str, Any]
) -> tuple[MechanicalSystem, tuple[ContactRows, ...]]:
    """Return the system with the modes of its contacts as parameters, and their places."""
    passed = [name for name in WITHOUT_CONTACTS if choices[name] not in (None, "auto", "double")]
    if not passed:
        system = sliding(system, method)
    if not any((*contacts, system.has_contacts)):
        return system, ()
    if passed:
        raise MethodError(f"{passed[0]}={choices[passed[0]]!r} is not available with contacts: omit it")
    from scvi_codegen.systems.contacts.modes import bound_contacts

    system, rows = bound_contacts(system, (*system.contacts, *contacts))
    if choices["solver"] == BY_STEPS:
        return system, tuple(row.stepped for row in rows)
    if (count := len(system.reactions)) > MOST_ROWS:
        raise MethodError(
            f"'{system.name}' has {count} gaps and slips of contacts, located transitions at most {MOST_ROWS}: compile "
            f"it with transitions='{BY_STEPS}', of whose steps that is the number of near ones, or leave some out"
        )
    return system, rows


def _compile_arrays(
    system: MechanicalSystem,
    method: Method | str | None,
    events: tuple[Event, ...],
    choices: Mapping[str, Any],
    looser: Once[Stepper] | None,
) -> Stepper:
    """Return the stepper of arrays whose sizes each run determines, by the arguments of :func:`_compiled`."""
    from scvi_codegen.runs.array_stepper import StepperOfRunTimeSizes

    precision = choices["precision"]
    if precision == AUTO:
        raise MethodError(f"precision='auto' is not available with arrays of run-time sizes: {SIZES_REQUIRED}")
    if choices["symmetries"]:
        raise MethodError(f"symmetries= is unavailable for '{system.name}': {SIZES_REQUIRED}")
    if precision == DOUBLE_DOUBLE:
        raise MethodError("precision='double-double' is not available with arrays of run-time sizes: pass sizes={..}")
    discretisation = as_method(DEFAULT_NAME if method is None else method, system)
    sources = CachedArraySources(system, discretisation, *(choices[name] for name in OF_SOURCES))
    sources.use_sums(choices["sums"])
    source, interface, reason = sources.of_run_time_sizes()
    if source is None and choices["sums"] == "plain":
        raise MethodError(f"sums='plain' is not available for '{system.name}': {reason}")
    if system.constraints and isinstance(discretisation, StoermerVerlet):
        method = SVI(1, "gauss-lobatto:2")  # the name of RATTLE for known sizes
    warn_of_formulas(interface, f"the stepper of '{interface.system}' with sizes of each run")
    common = {name: choices[name] for name in (*OF_SOURCES, "flags")}
    of_sizes = partial(compile_stepper, system, method, **common)
    arguments: dict[str, Any] = {"flags": choices["flags"], "events": events, "looser": looser, "reason": reason}
    return StepperOfRunTimeSizes(source, interface, variants=sources.variants, of_sizes=of_sizes, **arguments)


def _in_both_precisions(
    compiled: Callable[..., Stepper], events: tuple[Event, ...], choices: Mapping[str, Any]
) -> Stepper:
    """Return the stepper in double of precision="auto", with that in double-double if there is one."""

    @cache
    def in_double_double() -> Stepper | None:
        with suppress(MethodError):  # of this system or method
            return compiled(**{**choices, "precision": DOUBLE_DOUBLE})
        return None

    stepper = compiled(**{**choices, "precision": "double"}, events=events)
    stepper._precise = in_double_double
    return stepper


def check_precision(precision: str, flags: Sequence[str]) -> None:
    """Raise :class:`MethodError` for an unknown precision, and for flags that would destroy it."""
    if precision == "single":
        raise MethodError(
            "precision='single' is that of ensembles, integrate_ensemble(.., precision='single'), and of C for "
            "microcontrollers, generate_source(.., embedded='single'): omit it here"
        )
    OPTION["precision"].checked(precision, MethodError)
    if precision == DOUBLE_DOUBLE and (worst := [flag for flag in flags if flag in REORDERING_FLAGS]):
        raise MethodError(
            f"the compiler flag {worst[0]!r} reorders sums, which destroys precision='double-double': omit it "
            "(-fno-math-errno, -fno-trapping-math and -ffp-contract=fast are harmless)"
        )


def _at_sizes(
    system: Any, g: str | Expr | None, sizes: Mapping[str, int], tables: Mapping[str, ArrayLike] | None
) -> tuple[Any, str | Expr | None]:
    """Return a system of arrays and its time-rescaling function at known sizes."""
    from scvi_codegen.systems.arrays.elements import formula_at_sizes
    from scvi_codegen.systems.formulas.array_statements import is_indexed
    from scvi_codegen.systems.rolling import unroll_sums

    if isinstance(g, str) and is_indexed(g):
        g = formula_at_sizes(system, g, sizes, tables)
    return unroll_sums(system, sizes, tables=tables), g


class CachedSources:
    """C sources of one integrator and its variants, from the cache if they were derived before.

    ``choices``: the solver and further arguments of :class:`~scvi_codegen.codegen.pipeline.Sources`, in order.
    """

    def __init__(self, system: MechanicalSystem, method: Method, *choices: Any, locates: bool = False) -> None:
        self.system, self.method, self.choices, self.locates = system, method, choices, locates
        solver, prefix, symmetries, g, controller, *precision = choices
        others = [*(of for of in precision if of != "double"), *["located"] * locates]
        self.key = (*system.key(), *method.key(), key_of((solver, prefix, tuple(symmetries), g, controller, *others)))

    @cached_property
    def derived(self) -> Sources:
        """The sources that are not in the cache."""
        from scvi_codegen.codegen.pipeline import Sources

        return Sources(self.system, self.method, *self.choices, locates=self.locates)

    @property
    def variants(self) -> Variants:
        """The variants of the source."""

        def lacking(variant: Variant) -> bool:  # asks the system last, whose text need not be read before
            return variant == Derivatives(order=2) and self.system.damping != 0

        return Variants(make=self.variant, lacking=lacking)

    def integrator(self) -> tuple[Source, Interface]:
        """Return the C source and its interface."""

        def derive() -> str:
            source, interface = self.derived.integrator()
            return json.dumps([source.to_record(), interface.to_record()])

        source, interface = json.loads(cached_source((*self.key, "integrator"), derive))
        return Source.from_record(source), Interface.from_record(interface)

    def variant(self, variant: Variant) -> Source | None:
        """Return the source of a variant; ``None`` if the method lacks it."""

        def derive() -> str:
            source = self.derived.variant(variant)
            return "" if source is None else source.to_json()

        text = cached_source((*self.key, repr(variant)), derive)
        return Source.from_json(text) if text else None


class CachedArraySources(CachedSources):
    """C source of an integrator of arrays of run-time sizes, from the cache if it was derived before."""

    sums: Sums = "compensated"

    def use_sums(self, sums: Sums) -> None:
        """Use these sums for the increments of explicit steps, others than before in the cache."""
        self.sums, self.key = sums, (*self.key, *([sums] if sums == "plain" else []))

    @cached_property
    def derived(self) -> Sources:
        """The source that is not in the cache, and its interface."""
        from scvi_codegen.codegen.pipeline import ArraySources

        sources = ArraySources(self.system, self.method, *self.choices)
        sources.sums = self.sums
        return sources

    def of_run_time_sizes(self) -> tuple[Source | None, Interface, str | None]:
        """Return the C source for run-time sizes, or ``None``; the interface; the reason why there is none."""

        def derive() -> str:
            try:
                return json.dumps([self.derived.integrator()[0].to_record(), None])
            except SizesRequiredError as error:
                return json.dumps([None, str(error)])

        record, reason = json.loads(cached_source((*self.key, "integrator"), derive))
        interface = self.derived.interface
        if record:
            return Source.from_record(record), interface, None
        return None, replace(interface, layout=replace(interface.layout, maps=())), reason
