"""Compiled method: generated C source, its loaded libraries and its interface."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.ir.variants import (
    BY_STEPS,
    Acting,
    Derivatives,
    Lanes,
    NewtonFallback,
    StepTerms,
    Variant,
    WithEvents,
)
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.native.binding import Binding, with_calls
from scvi_codegen.codegen.rendering.source import Interface, Source
from scvi_codegen.common.cache import cached_source
from scvi_codegen.common.display.cards import card, listed, plain
from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.representation import LONGEST, clipped
from scvi_codegen.runs.states.layout import layout_of
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.features import Support, check_features, refusal_of, require
from scvi_codegen.systems.event import Event, EventLike, as_events, modes_of

if TYPE_CHECKING:
    from scvi_codegen.runs.stepping.array_interface import RunSizes

MOST_EVENT_SETS = 16
"""Number of event sets whose compiled integrators are cached, so that repeated calls do not parse formulas again."""


class Variants:
    """C sources of the variants of a method, derived on first use.

    Args:
        sources: sources that exist; ``None`` for a variant that the method lacks.
        make: derives a source that is not among them.
        lacking: returns whether the method lacks a variant, without deriving it.
    """

    def __init__(
        self,
        sources: Mapping[Variant, Source | None] | None = None,
        make: Callable[[Variant], Source | None] = lambda _: None,
        lacking: Callable[[Variant], bool] = lambda _: True,
    ) -> None:
        self._made: dict[Variant, Source | None] = dict(sources or {})
        self._make, self._lacking = make, lacking

    def __getitem__(self, variant: Variant) -> Source | None:
        if variant not in self._made:
            self._made[variant] = self._make(variant)
        return self._made[variant]

    def with_events(self, events: tuple[Event, ...]) -> Source | None:
        """Return the source with event detection, ``None`` unless it was loaded with the method."""
        return self._made.get(WithEvents(events))

    def lacks(self, variant: Variant, *, of_sizes: bool = False) -> bool:
        """Return whether the method lacks a variant, without deriving it; ``of_sizes``: that of other sizes."""
        if variant in self._made and not of_sizes:
            return self._made[variant] is None
        return self._lacking(variant)

    def __reduce__(self) -> tuple[Any, ...]:
        # second derivatives and tangent-vector variants are slow to derive: included only if already made
        for variant in (Lanes(), NewtonFallback(), Derivatives()):
            _ = self[variant]
        return (Variants, (self._made,))


class CompiledMethod:
    """A method compiled for one system.

    Attributes:
        title: system and method, in one line.
        coordinates, parameters: names, in order.
        defaults: (k,) default parameter values.
        dimension: degrees of freedom m.
        momentum_map_names: names of the conserved quantities.
        source: the C source it was compiled from; ``None`` of arrays that are compiled with the sizes of each call.
        fallback: source with Newton's iteration, if the main source contains only the fixed-point iteration.
        events: events that every run records.
        searched: functions whose zeros every run locates: of the events, the contacts and the kinks of the system.
        modes: names of the parameters that runs change: by events, as modes of contacts, and of kinks.
        mode_columns: their indices among the values of parameters.
        divides_steps: whether steps end at zeros: of events that change the state, transitions and kinks.
        changes_states: whether an event changes the states of runs.
        changing_events: the events if one of them does, without which the motion is another.
        in_tau: whether the system is one in transformed time, whose steps are steps of tau.
        run_time_sizes: whether the sizes of its arrays are those of each call; the stepper is bound to them, or
            compiled with them if an integrator of run-time sizes is impossible.
        origin, problem: of a bound stepper, the stepper of run-time sizes, and the sizes and tables; else ``None``.
    """

    run_time_sizes = False

    def __init__(
        self,
        source: Source | None,
        interface: Interface,
        *,
        variants: Variants | None = None,
        flags: tuple[str, ...] = building.TUNED_FLAGS,
        events: tuple[Event, ...] = (),
        of_sizes: Callable[..., Any] | None = None,
        reason: str | None = None,
        origin: Self | None = None,
        problem: RunSizes | None = None,
        looser: Callable[[], Self] | None = None,
    ) -> None:
        self.interface, self.flags, self.events = interface, flags, events
        self.in_tau = interface.in_tau
        self.searched = interface.searched(events)
        self.modes = modes_of(events, interface.parameters, interface.mode_names)
        self.mode_columns = [*map(interface.parameters.index, self.modes)]
        self.changes_states = any(event.changes_state for event in events)
        self.changing_events = events if self.changes_states else ()
        self.divides_steps = self.changes_states or bool(interface.mode_names)
        self.origin, self.problem, self._of_sizes, self._reason = origin, problem, of_sizes, reason
        self._variants, self._looser = Variants() if variants is None else variants, looser
        self._event_variants: dict[tuple[Event, ...], Self] = {}
        self._released_runs: list[Any] = []
        self.warned_of_kinks = False
        self._known: dict[Hashable, Self] = {}
        self._with_action: Self | None = None
        self.sums_action = False  # whether runs sum the action of their steps
        self.by_steps = interface.solver == BY_STEPS  # whether contacts of runs act in steps, without transitions
        self.strict_energy = False  # whether none of these steps may raise energy
        self._entries: dict[Event, tuple[Event, ...]] = {}
        self._plain = cast(Source, source)
        self._states = layout_of(interface)
        self.shapes = self._states.shapes
        self.source = self._with_search()
        if looser is None:
            self._load()

    def _with_search(self) -> Source:
        """Return the source, with the search for zeros of events."""
        interface, events = self.interface if self.origin is None else self.origin.interface, self._located
        if not self.searched or self.run_time_sizes:
            return self._plain
        if interface.temperature is not None:
            require(self, "events")
        if not events:
            return self._plain
        return self._variants.with_events(events) or self._derived_with_events(interface, events)

    @property
    def _located(self) -> tuple[Event, ...]:
        """The functions whose zeros C locates; those of runs in double-double by the integrator in double."""
        return () if self.interface.words > 1 else self.searched

    def _load(self) -> None:
        _ = self.binding

    @cached_property
    def binding(self) -> Binding:
        """The library, compiled at once, or on first use if loose runs have a method of their own."""
        library = building.load(with_calls(self.source), flags=self.flags)
        if self.problem is None or self.origin is None:
            interface = self.interface
            return Binding(library, interface.prefix, interface.workspace, fallback=self._load_fallback)
        from scvi_codegen.runs.stepping.array_binding import ArrayBinding, EventBinding

        arrays = library, self.origin.interface, self.problem
        return EventBinding(*arrays, self._located) if self._located else ArrayBinding(*arrays)

    def _derived_with_events(self, interface: Interface, events: tuple[Event, ...]) -> Source:
        """Return the source with the search for zeros, from the cache if the formulas are text and were read before."""

        def derived() -> Source:
            from scvi_codegen.codegen.rendering.events import with_events  # here, because it imports SymPy

            return with_events(self._plain, interface, events)

        if interface.layout.coordinates or not all(event.is_text for event in events):
            return derived()
        key = "zeros", self._plain.to_json(), json.dumps(interface.to_record()), repr(events)
        return Source.from_json(cached_source(key, lambda: derived().to_json()))

    @property
    def acting(self) -> Self:
        """The stepper whose runs sum the action of their steps; itself if they are computed again for it."""
        stepper = self.known
        if stepper._with_action is None:
            source = stepper._variants[Acting()]
            acting = stepper._with_action = stepper._copy(stepper.events, source) if source else stepper
            acting._with_action, acting.sums_action = acting, source is not None
        return stepper._with_action

    @cached_property
    def with_steps_of_contacts(self) -> Self:
        """The integrator whose runs have contacts by steps."""
        require(self, "by_steps")
        if self.by_steps:
            return self
        stepper = self._copy(self.events)
        stepper.by_steps = True
        return stepper

    def _copy(self, events: tuple[Event, ...], source: Source | None = None) -> Self:
        sizes = source.contents.sizes if source else None
        return type(self)(
            source or self._plain,
            replace(self.interface, workspace=sizes.workspace) if sizes else self.interface,
            variants=self._variants,
            flags=self.flags,
            events=events,
            of_sizes=self._of_sizes,
            reason=self._reason,
            origin=self.origin,
            problem=self.problem,
            looser=self._looser,
        )

    def bind(
        self, q: Any, parameters: Any = None, tables: Mapping[str, ArrayLike] | None = None, threads: int | None = None
    ) -> tuple[Self, Any]:
        """Return the stepper bound to the sizes and tables of these arrays, and their states as vectors.

        A stepper of known sizes is returned itself, with q as it is; it has no tables and threads per step.

        Raises:
            StateError: if a name, shape or number is invalid, or an index would leave its array.
        """
        self._check_not_of_run(tables, threads)
        return self, q

    def _check_not_of_run(self, tables: object, threads: object) -> None:
        """Raise :class:`MethodError` for arguments of arrays of run-time sizes."""
        for name, value in (("tables", tables), ("threads", threads)):
            if value is not None:
                require(self, name)

    @property
    def known(self) -> Self:
        """Stepper compiled with known sizes; raises as :meth:`with_sizes`, and for a stepper of run-time sizes."""
        if self.problem is None or self.origin is None:
            return self
        return self.origin.with_sizes(self.problem.sizes, tables=self.problem.places)

    @property
    def _known_with_events(self) -> Self:
        return self.known.with_events(self.events)

    def _events_of_entries(self, event: Event) -> tuple[Event, ...]:
        """Return the events of :attr:`known` that an event in index notation defines, one for each element."""
        if event not in self._entries:
            from scvi_codegen.codegen.rendering.events import EventFormulas  # here, because it imports SymPy

            self._entries[event] = cast("tuple[Event, ...]", tuple(EventFormulas(self.known.interface, [event]).events))
        return self._entries[event]

    def with_sizes(
        self, sizes: Mapping[str, int] | None = None, /, *, tables: Mapping[str, ArrayLike] | None = None, **named: int
    ) -> Self:
        """Return the stepper of arrays of run-time sizes compiled with these sizes, ``with_sizes(N=9)``, once.

        It has every feature.

        Raises:
            MethodError: if a size is missing, there are more than 2000 coordinates, or the stepper was unpickled or
                loaded from a folder and hence lacks its system.
        """
        from scvi_codegen.runs.stepping.array_interface import check_few_coordinates

        values = {**(sizes or {}), **named}
        if not self.run_time_sizes:
            require(self, "with_sizes")
        check_few_coordinates(self.interface, values, self._reason)
        if self._of_sizes is None:
            raise MethodError(f"{self!r} lacks its system: call compile_stepper(system, method, sizes={values})")
        key = (tuple(sorted(values.items())), *((name, np.asarray(x).tobytes()) for name, x in (tables or {}).items()))
        if key not in self._known:
            require(self, "with_sizes")
            self._known[key] = self._of_sizes(sizes=values, tables=dict(tables) if tables else None)
        return self._known[key]

    def named(self, values: Array) -> Array:
        """Return (.., m) numbers of states that arrays of coordinates index by name; without arrays unchanged."""
        return self._states.named(values)

    def __repr__(self) -> str:
        return f"<Stepper {clipped(self.title, LONGEST - 20)}>"

    def _repr_html_(self) -> str:
        interface = self.interface
        parameters = zip(interface.parameters, interface.defaults, strict=True)
        return card(
            interface.title,
            (
                ("method", plain(", ".join(interface.notes))),
                ("coordinates", listed(interface.coordinates)),
                ("parameters", listed([f"{name} = {value:g}" for name, value in parameters])),
                ("C", plain(f"{interface.prefix}.c, {len(self.source.code.splitlines())} lines")),
            ),
        )

    @property
    def ensemble(self) -> Source | None:
        """C source of the ensemble variant, derived on first use; ``None`` if the method has none."""
        return self._variants[Lanes()]

    @property
    def fallback(self) -> Source | None:
        """C source of the fallback library with Newton's iteration, derived on first use; ``None`` if not needed."""
        return self._variants[NewtonFallback()]

    @property
    def derivatives(self) -> Source | None:
        """C source with the derivatives of steps, derived on first use."""
        return self._variants[Derivatives()]

    @property
    def second_derivatives(self) -> Source | None:
        """C source with second derivatives of steps, derived on first use; ``None`` if unavailable."""
        return self._variants[Derivatives(order=2)]

    def prepare(
        self,
        *,
        tangent: bool = False,
        second: bool = False,
        ensemble: bool = False,
        events: EventLike | Sequence[EventLike] | None = None,
    ) -> None:
        """Compile the variants that later calls would compile on first use, so that a run never waits for the compiler.

        The Newton fallback of a fixed-point iteration is always compiled. Variants that the method lacks are skipped.

        Args:
            tangent: derivatives of steps, for ``jacobian``, ``tangent``, ``sensitivity``, ``pullback`` and the like.
            second: second derivatives, for ``hessian_product``.
            ensemble: the variant for many trajectories at once.
            events: the formulas that later calls pass as ``events=``, all those of one call together.
        """
        for stepper in dict.fromkeys((self, self.with_events(events))):
            stepper._compile()
        if self._looser is not None:
            self._looser().prepare(tangent=tangent, second=second, ensemble=ensemble, events=events)
        requested = {self.linear_variant: tangent, Derivatives(order=2): second, Lanes(): ensemble}
        for variant in [variant for variant, is_requested in requested.items() if is_requested]:
            if (source := self._variants[variant]) is not None:
                building.load(source, flags=self.flags)

    def _compile(self) -> None:
        self.binding.set_fallback()

    @cached_property
    def tangent(self) -> Binding:
        """Library with derivatives of steps, or of the terms of contacts by steps, compiled on first use."""
        return self._linearised(self.linear_variant, "tangent" if self.by_steps else "jacobian")

    @property
    def linear_variant(self) -> Variant:
        """Variant with first derivatives."""
        return StepTerms() if self.by_steps else Derivatives()

    @cached_property
    def _ensemble_binding(self) -> Binding | None:
        """Library of trajectories in SIMD lanes, compiled on first use; ``None`` if the method has none."""
        source = self._variants[Acting(in_lanes=True)] if self.sums_action else self.ensemble
        return None if source is None else Binding(building.load(source, flags=self.flags), source.prefix)

    @cached_property
    def _binding_in_single(self) -> Binding | None:
        """The same in single precision."""
        source = self._variants[Lanes("single")]
        return None if source is None else Binding(building.load(source, flags=self.flags), source.prefix)

    @cached_property
    def _second_derivatives(self) -> Binding:
        """Library with second derivatives of steps, compiled on first use; raises ``MethodError`` if unavailable."""
        return self._linearised(Derivatives(order=2), "hessian")

    def _linearised(self, variant: Variant, operation: str) -> Binding:
        require(self, operation)
        source = cast(Source, self._variants[variant])
        binding = Binding(building.load(source, flags=self.flags), source.prefix)
        return binding.with_workspace(binding.constant("LINEARISED_WORKSPACE"))

    def _load_fallback(self) -> building.Library:
        source = self.fallback
        if source is None:
            raise MethodError(
                f"the fallback source with Newton's iteration is missing for '{self.title}': recompile it"
            )
        return building.load(source, flags=self.flags)

    @property
    def title(self) -> str:
        """System and method, in one line."""
        return self.interface.title

    @property
    def method(self) -> str:
        """Name of the method, ``"svi-8-gauss-legendre-8"``; :attr:`Trajectory.method` is that of a run."""
        return self.interface.method

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Coordinate names."""
        return self.interface.coordinates

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameter names, without those of the modes of contacts and kinks, which follow them in vectors of values."""
        return self.interface.own_parameters

    @property
    def defaults(self) -> Array:
        """(k,) default parameter values."""
        return np.array(self.interface.defaults, dtype=float)

    @property
    def constraints(self) -> tuple[str, ...]:
        """Formulas g of the constraints g(q, t) = 0, in the order of multipliers."""
        return self.interface.constraints

    @property
    def impulse_names(self) -> tuple[str, ...]:
        """Names of the momentum maps of L alone that forces change, in the order of :meth:`Trajectory.impulses`."""
        return self.known.interface.exchange_names[1:]

    @property
    def momentum_map_names(self) -> tuple[str, ...]:
        """Names of the conserved quantities of the system: ``"angular momentum"``, ``"boost of x"``."""
        return self.interface.map_names or tuple(quantity.name for quantity in self.interface.layout.maps)

    @property
    def dimension(self) -> int:
        """Degrees of freedom m."""
        return self.interface.dimension

    def supports(self, feature: str, *together: str) -> Support:
        """Return whether an operation is available for this system and method, without an attempt.

        The result is true or false; its ``reason`` is the message of the error that the operation raises, with the
        remedy, empty if the operation is available. :ref:`features` lists the names. For arrays of run-time sizes,
        ``with_sizes(..)`` also answers what follows from the sizes, such as ``"work"``.

        Args:
            feature: name of the operation: ``"adaptive"``, ``"hessian"``, ``"fit"``.
            together: names of further arguments of the same run: ``supports("t_eval", "inputs")``.

        Raises:
            StateError: if a name is unknown.
        """
        check_features(feature, *together)
        return Support(str(refusal_of(self, feature, *together) or ""))

    def with_events(self, events: EventLike | Sequence[EventLike] | None) -> Self:
        """Return the integrator with these events in place of its own, which ``None`` leaves."""
        events_of_runs = self.events if events is None else as_events(events)
        if events_of_runs == self.events:
            return self
        if events_of_runs not in self._event_variants:
            while len(self._event_variants) >= MOST_EVENT_SETS:
                self._event_variants.pop(next(iter(self._event_variants)), None)
            self._event_variants[events_of_runs] = self._copy(events_of_runs)
        return self._event_variants[events_of_runs]

    def _lacks(self, variant: Variant) -> bool:
        """Return whether the method lacks a variant; arrays of run-time sizes take it from their system."""
        source = self.origin or self
        if source.run_time_sizes:
            return source._of_sizes is None or source._variants.lacks(variant, of_sizes=True)
        return self._variants.lacks(variant)

    @property
    def _carries_errors(self) -> bool:
        """True if runs have a tangent vector to which the errors of their steps are added."""
        return not (self.run_time_sizes or self.changes_states) and "measures_growth" in self.source.contents.run_fields

    @property
    def _has_error_estimate(self) -> bool:
        """True if the method has adaptive steps for this system; also if that follows from sizes at run time."""
        return "advance_to" in self.source.contents.functions and not self.by_steps
