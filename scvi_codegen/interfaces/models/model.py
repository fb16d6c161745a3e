"""Validated model: a system with a method, an initial state and a time span."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from dataclasses import fields as fields_of
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.codegen.ir.variants import SUMS
from scvi_codegen.codegen.lowering.arrays import check_solver
from scvi_codegen.codegen.native.option_table import VELOCITY, check_agreement
from scvi_codegen.common.display.cards import Html, card, listed, plain
from scvi_codegen.common.errors import ArgumentError, ModelFileError, StateError, speaking
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import check_kind, keyword_hint
from scvi_codegen.interfaces.models.options import (
    FURTHER,
    ROWS,
    RUN_FIELDS,
    STATE,
    checked_value,
    real,
    with_exact_numbers,
)
from scvi_codegen.interfaces.models.problems import Problem
from scvi_codegen.interfaces.models.time_span import TimeSpan, check_length
from scvi_codegen.methods import Method, as_method, default_method
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.first_order import FirstOrderSystem
from scvi_codegen.systems.formulas.symbols import input_parameters
from scvi_codegen.systems.rolling import unroll_sums
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.codegen.native.options import SolverOptions
    from scvi_codegen.codegen.rendering.source import Interface
    from scvi_codegen.interfaces.models.input_tables import InputTable
    from scvi_codegen.runs.accuracy.global_error import GlobalError
    from scvi_codegen.runs.driver.run import Run
    from scvi_codegen.runs.driver.segments import Input
    from scvi_codegen.runs.states.validation import Array
    from scvi_codegen.runs.stepper import Stepper
    from scvi_codegen.runs.stepping.array_interface import RunArrays
    from scvi_codegen.runs.trajectory import Trajectory
    from scvi_codegen.systems.event import Event

MOST_COORDINATES = 2000
"""Largest number of coordinates of an array model that commands compile with its sizes: its equations are unrolled."""
DEFAULT_METHOD = SVI(8)
"""Default method; this object, unlike an equal one, says that none was named."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model(TimeSpan):
    """System, method, initial state and time span; equality is structural.

    For a system of arrays whose sizes are known at run time, q, p and velocity are arrays by the name of their
    coordinate array, the shapes of q determine the sizes, and p or velocity may be omitted: the default is 0.

    Attributes:
        system: the mechanical system, with the parameter values of the run as its defaults.
        method: its discretisation; a name, ``"svi:8"``, is converted to the method. Of models without a named method it
            is the object :data:`DEFAULT_METHOD`, and adaptive runs have that of their tolerance, as of
            :func:`~scvi_codegen.compile_stepper`.
        solver: of the stage equations, as of :func:`~scvi_codegen.compile_stepper`.
        q: (m,) initial coordinates, or all variables of a first-order system, by name or in order, without p; with
            rotations also by name, as of :meth:`Stepper.integrate`: attitudes as quaternions, matrices, Euler angles,
            or axis and angle.
        p: (m,) initial momenta, or ``None`` if ``velocity`` is given.
        velocity: (m,) initial velocities, or ``None`` if ``p`` is given.
        h, tolerance, error, span, steps, save_every, t_eval, t, time_transformation, controller, precision, sums,
            observe, solver_tolerance, max_iterations, threads, action: as of
                :class:`~scvi_codegen.interfaces.models.time_span.TimeSpan`.
        inputs: by name a table of values, ``(t, values)`` or ``(t, values, kind)`` as :meth:`Stepper.integrate` accepts
            it, or a number; a run requires all inputs of the system.
        fields: arrays of parameters by name, for array sizes known at run time; others keep their default value.
        tables: index tables of shape (rows, columns) by name, for array sizes known at run time.
        events: zero crossings that runs record, which may change the state.
        mesh: of the fields of a density.
        path: ends and kind of the paths of ``scvi-codegen path``, by the keys of the section ``[path]``.
        family: continuation of ``scvi-codegen family``, by the keys of the section ``[family]``.
        page: ranges of sliders, speed and plots of :func:`~scvi_codegen.page`, as its arguments.
        picture: points, and rods, springs, walls, bodies and trails between them, as of :func:`~scvi_codegen.page`.

    Raises:
        ModelFileError: naming the field, unless exactly one of p and velocity, at most one of h, tolerance and error,
            and exactly one of span and steps is given, each vector has m entries, and every number is finite and valid.
            Arrays of run-time sizes are validated when a run begins.
    """

    system: MechanicalSystem
    method: Method
    q: Any
    p: Any = None
    velocity: Any = None
    solver: str = "auto"
    inputs: Mapping[str, InputTable | float] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)
    tables: Mapping[str, Any] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    mesh: Any = field(default=None, compare=False, repr=False)
    path: Mapping[str, Any] = field(default_factory=dict)
    family: Mapping[str, Any] = field(default_factory=dict)
    page: Mapping[str, Any] = field(default_factory=dict)
    picture: Mapping[str, Any] = field(default_factory=dict)

    __repr__ = summary("system", "method", "h", "span", "steps")

    def _repr_html_(self) -> str:
        state = [(name, getattr(self, name)) for name in STATE.values() if getattr(self, name) is not None]
        named = {**self.inputs, **self.fields, **self.tables}
        facts = (
            ("method", plain(self.method.title)),
            *((name, _vector(values)) for name, values in state),
            ("run", listed([f"{name} = {value}" for name, value in self._run_section().items()])),
            *([("events", listed([event.function for event in self.events]))] if self.events else []),
            *([("inputs, arrays", listed(list(named)))] if named else []),
        )
        formula = self.system._repr_html_()
        return card(self.system.name, facts, Html(formula) if formula else plain(repr(self.system)))

    @speaking("model")
    def __post_init__(self) -> None:
        check_kind(MechanicalSystem.OR_ARRAYS, self.system, "system", ModelFileError)
        if self.mesh is None:
            object.__setattr__(self, "mesh", self.system.mesh)
        object.__setattr__(self, "page", _with_lists(self.page))
        for section in ("path", "family"):
            values = {key: checked_value(section, key, value) for key, value in getattr(self, section).items()}
            object.__setattr__(self, section, values)
        object.__setattr__(self, "picture", _with_lists(self.picture))
        object.__setattr__(self, "method", as_method(self.method, self.system))
        if isinstance(self.system, FirstOrderSystem) and self.p is self.velocity is None:
            for name, half in zip(("q", "p"), self.system.halves(self.q), strict=True):
                object.__setattr__(self, name, half)
        if (arrays := self.array_system) is not None:
            self._take_arrays(arrays)
        else:
            self._take_vectors()
        if self.time_transformation is not None and (self.system.clock is not None or self.span is None):
            raise ModelFileError(
                f"the reversible controller of the time transformation {self.time_transformation} requires a time "
                "span (give span, not steps), and a system without a time transformation"
            )
        self._check_time_span()
        if self.inputs:
            from scvi_codegen.interfaces.models.input_tables import checked_tables  # not needed for reading a model

            object.__setattr__(self, "inputs", checked_tables(self.system, self.inputs))

    def _take_vectors(self) -> None:
        """Check the fields of a model of named coordinates, whose state becomes numbers in order."""
        self._take_attitudes()
        state = {name: getattr(self, name) for name in STATE.values()}
        check_agreement(state, ModelFileError, required=VELOCITY)
        if self.threads is not None:
            raise ModelFileError(
                f"{ROWS['threads']} requires arrays whose sizes are names, coordinates = ['q[N]']: omit it"
            )
        for name in STATE.values():
            if (vector := getattr(self, name)) is not None:
                object.__setattr__(self, name, self._vector(name, vector))

    def _take_attitudes(self) -> None:
        """Replace a state by name of rotations, directions and spins by that of all coordinates."""
        if not (self.system.rotations and isinstance(self.q, Mapping)):
            return
        from scvi_codegen.runs.states.rotations import state_by_name  # not needed for other systems

        try:
            state = state_by_name(self.system, self.q, self.p, self.velocity)
        except StateError as error:
            raise ModelFileError(str(error)) from error
        for name, vector in zip(STATE.values(), state, strict=True):
            object.__setattr__(self, name, vector)

    def _take_arrays(self, arrays: ArraySystem) -> None:
        """Check the fields of a model of arrays, and supplement the values of arrays and tables by their defaults."""
        if self.solver != "auto":
            check_solver(self.solver, ModelFileError)
        check_agreement({name: getattr(self, name) for name in STATE.values()}, ModelFileError)
        if self.time_transformation is not None:
            raise ModelFileError(
                "a time transformation requires known array sizes: use that of the model with_known_sizes()"
            )
        for name, declared in (("fields", arrays.fields), ("tables", arrays.tables)):
            default = {array.name: arrays.data[array.name] for array in declared if array.name in arrays.data}
            object.__setattr__(self, name, default | dict(getattr(self, name)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Model):
            return NotImplemented
        return all(
            _equal(getattr(self, entry.name), getattr(other, entry.name)) for entry in fields_of(self) if entry.compare
        )

    def __hash__(self) -> int:
        return hash((self.system, self.method, self.h, self.tolerance, self.span, self.steps, self.t))

    @classmethod
    def from_problem(cls, entry: Problem, method: Method = DEFAULT_METHOD) -> Model:
        """Return the model of a catalogue entry with a method."""
        return cls(
            system=entry.system,
            method=method,
            q=entry.q,
            p=entry.p,
            velocity=entry.velocity,
            h=entry.step,
            span=entry.span,
        )

    @classmethod
    def of_arguments(cls, function: str, system: MechanicalSystem, arguments: Mapping[str, Any]) -> Model:
        """Return the model of a system with the other attributes as ``arguments`` of a function.

        Raises:
            ArgumentError: for an argument that is no attribute, with the likely name.
        """
        accepted = [name for name in cls.__dataclass_fields__ if name not in ("system", *FURTHER)]
        for name in arguments:
            if name not in accepted:
                raise ArgumentError(f"{function}() takes no {name!r}{keyword_hint(name, accepted)}")
        return cls(**{"system": system, "method": DEFAULT_METHOD, **arguments})

    def arrays(self, interface: Interface) -> RunArrays:
        """Return sizes, state, fields and tables of array sizes known at run time; StateError if they do not agree."""
        from scvi_codegen.runs.stepping.array_interface import read_arrays

        return read_arrays(interface, self.q, self.fields, self.tables)

    def absolute_tolerances(self, interface: Interface) -> tuple[float, ...]:
        """Return the absolute tolerance of each coordinate; none if all are 0."""
        if self.absolute_tolerance is None:
            return ()
        from scvi_codegen.runs.stepping.step_plan import Steps, absolute_tolerances

        values = Steps(absolute_tolerance=self.absolute_tolerance).checked()["absolute_tolerance"]
        return tuple(absolute_tolerances(interface, interface.dimension, values).tolist())

    @property
    def method_of_runs(self) -> Method:
        """Method of runs with the steps of this model: that of their tolerance if no method was named."""
        if self.method is not DEFAULT_METHOD or self.h is not None or self.has_time_transformation:
            return self.method
        return default_method(self.system, self.tolerance)

    @property
    def array_system(self) -> ArraySystem | None:
        """The system if it has arrays whose sizes are known at run time only, else ``None``."""
        return self.system if isinstance(self.system, ArraySystem) else None

    @property
    def sizes(self) -> dict[str, int]:
        """Array sizes known at run time, by name; empty for a system of named coordinates."""
        if not self.system.sizes:
            return {}
        of_rotations = {name: attitude.as_quat() for name, attitude in self.q.items() if hasattr(attitude, "as_quat")}
        values = {**self.q, **self.fields, **self.tables, **of_rotations}
        arrays = [array for array in self.system.arrays if array.name in values]
        axes = [(array, np.shape(values[array.name])) for array in arrays]
        return {size.name: length for array, shape in axes for size, length in zip(array.axes, shape) if size.name}  # noqa: B905

    @property
    def dimension(self) -> int:
        """Number m of coordinates."""
        return len(self.q) if self.array_system is None else sum(map(np.size, self.q.values()))

    def with_known_sizes(self, option: str = "") -> Model:
        """Return the model of the same motion with all array entries as named coordinates, which has every feature.

        Compiling it takes time that grows with the number of coordinates.

        Raises:
            ModelFileError: above ``MOST_COORDINATES`` if an option of a command requires it, which the error names.
        """
        if (system := self.array_system) is None:
            return self
        if option and self.dimension > MOST_COORDINATES:
            raise ModelFileError(
                f"{option} compiles an array model with its sizes, which is limited to {MOST_COORDINATES} coordinates: "
                f"omit {option}, or reduce the sizes ({self.dimension} coordinates here)"
            )
        unrolled = unroll_sums(system, self.sizes, tables=self.tables, parameters=self.fields)
        state = {name: getattr(self, name) for name in STATE.values() if getattr(self, name) is not None}
        if not system.rotations:
            names = [array.name for array in system.coordinates]
            state = {key: [x for name in names for x in np.ravel(arrays[name])] for key, arrays in state.items()}
        has_spins = any(rotation.declaration.startswith("spin") for rotation in unrolled.rotations)
        if len(state) == 1 and not has_spins:  # at rest
            state["p" if unrolled.auxiliaries else "velocity"] = (0.0,) * unrolled.dimension
        changed: dict[str, Any] = {"fields": {}, "tables": {}, **state}
        if system.mesh is not None and self.method is DEFAULT_METHOD:
            changed["method"] = SVI(8)  # runs by another method would lack the mesh, which unrolled systems do not have
        return replace(self, system=unrolled, mesh=system.mesh, **changed)

    @property
    def ends_at_time(self) -> bool:
        """True if the run ends at a time, after a number of steps that is not known in advance."""
        return self.h is None or (self.has_time_transformation and self.span is not None)

    @property
    def has_time_transformation(self) -> bool:
        """True if there is a time transformation, so that a step size is one in tau."""
        return self.time_transformation is not None or self.in_transformed_time

    @property
    def in_transformed_time(self) -> bool:
        """True if the system moves in fictitious time tau."""
        return self.system.clock is not None

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name: the system's defaults, without the energy of a transformation and inputs; and fields."""
        clock = self.system.clock
        others = {clock.energy.name if clock else "", *input_parameters(self.system.inputs)}
        constants = self.system.constants_by_name
        return {name: value for name, value in constants.items() if name not in others} | {**self.fields}

    def first_step_size(self, stepper: Stepper) -> float:
        """Return h, or the size of the first adaptive step; with a time transformation, the step size in tau."""
        if self.h is not None and self.time_transformation is None:
            return self.h
        self.all_inputs()
        run = self.start(stepper)
        if self.in_transformed_time:
            return run._step_size
        run.advance(1)
        return run.t - self.t

    def stepper(self) -> Stepper:
        """Compile a stepper for runs of this model; raises as :func:`~scvi_codegen.compile_stepper`."""
        from scvi_codegen.runs.compiler import compile_stepper  # imported here: not needed for reading a model

        self._check_controller()
        stepper = compile_stepper(
            self.system,
            None if self.method is DEFAULT_METHOD else self.method,
            solver=self.solver,
            time_transformation=self.time_transformation,
            controller=self.controller,
            precision=self.precision or "double",
            sums=self.sums or SUMS[0],
            transitions=self.transitions,
        )
        if self.mesh is not None and stepper.interface.layout.mesh is None:
            stepper.interface = replace(stepper.interface, layout=replace(stepper.interface.layout, mesh=self.mesh))
        if self.action:
            from scvi_codegen.runs.stepping.features import require  # not needed for reading a model

            require(stepper, "action")
            stepper = stepper.acting
        return stepper.by_transitions(None, strict_energy=self.strict_energy).with_events(self.events)

    def momenta(self, stepper: Stepper) -> Array:
        """Return the (m,) initial momenta: ``p``, or the Legendre transform of the velocities."""
        if self.p is not None:
            return self.p if self.in_double_double else np.array(self.p)
        assert self.velocity is not None  # by construction
        return stepper.momentum(self.q, self.velocity, self.t, self.parameters_at_start(stepper))

    def initial_state(self, stepper: Stepper) -> dict[str, Any]:
        """Return the arguments of :meth:`Stepper.start` for the initial state: q, p or velocity, t, and tables."""
        if self.array_system is None:
            return {"q": self.q, "p": self.momenta(stepper), "t": self.t}
        return {"t": self.t, "tables": self.tables, **{name: getattr(self, name) for name in STATE.values()}}

    def parameters_at_start(self, stepper: Stepper) -> Mapping[str, Any] | Array:
        """Return the initial parameters, including components of inputs if these are given."""
        if not self.inputs or self.array_system is not None:
            return self.parameters
        from scvi_codegen.runs.driver.segments import first_inner_time

        return self._inputs_and_parameters(stepper)[1](first_inner_time(self.t, self.end))

    def segments(self, run: Run) -> Iterator[int | None]:
        """Prepare a run of this model for its end, or for each segment between breakpoints of its inputs.

        Yields:
            Number of steps of the segment; ``None`` for steps up to the target time of the run.

        Raises:
            ModelFileError, StateError: for inputs that are missing, or do not cover the whole run.
        """
        if not self.system.inputs:
            from scvi_codegen.runs.stepping.step_plan import Fixed, ending_at  # not needed for reading a model

            if self.has_shorter_last_step or (self.in_transformed_time and self.ends_at_time):
                run.plan = ending_at(run.plan, self.t + self.covered)
            yield self.step_count if isinstance(run.plan, Fixed) else None
            return
        from scvi_codegen.runs.driver.segments import prepared_segments

        inputs, values = self._inputs_and_parameters(run)
        yield from prepared_segments(run, inputs, self.end, values)

    def output_times(self, run: Run, steps: int | None) -> Array | None:
        """Return the times at which a run of ``steps``, ``None`` to its target time, saves states; ``None``: steps."""
        if self.t_eval is None:
            return None
        from scvi_codegen.runs.stepping.features import check_together  # not needed for reading a model

        stride = None if self.save_every == 1 else self.save_every
        check_together(t_eval=self.t_eval, save_every=stride, inputs=self.system.inputs or None)
        stepper: Any = run.stepper
        return stepper._output_times(self.t_eval, self.t, run.plan, steps)  # type: ignore[no-any-return]

    @property
    def end(self) -> float:
        """Final time."""
        from scvi_codegen.runs.driver.segments import final_time

        return final_time(self.t, self.h, self.steps, None if self.span is None else self.t + self.covered)

    def all_inputs(self) -> Mapping[str, InputTable | float]:
        """Return the inputs; ModelFileError unless all inputs of the system are given."""
        for name in self.system.inputs:
            if name not in self.inputs:
                way = f'[inputs] {name} = {{ file = "{name}.csv" }}, or --input {name}=FILE'
                raise ModelFileError(f"the input {name} is not set: give {way}")
        return self.inputs

    def _inputs_and_parameters(self, integrator: Stepper | Run) -> tuple[dict[str, Input], Callable[[float], Array]]:
        """Return the inputs, and the scalar parameters as a function of time."""
        from scvi_codegen.runs.driver.segments import checked_inputs, parameters_at

        stepper: Any = getattr(integrator, "stepper", integrator)
        inputs, names = checked_inputs(stepper.interface, self.all_inputs()), stepper.interface.parameters
        return inputs, partial(parameters_at, names, stepper._parameters(self.parameters), inputs)

    def start(
        self, stepper: Stepper | None = None, *, options: SolverOptions | None = None, threads: int | None = None
    ) -> Run:
        """Start the run of this model at its initial state, to be advanced by its :meth:`segments` or to its end.

        Args:
            stepper: that of :meth:`stepper`, which is compiled by default.
            options: convergence criterion of the solver; by default :attr:`solver_options`.
            threads: number of threads per step, for array sizes known at run time; by default those of the model.
        """
        self._check_alone()
        stepper = stepper or self.stepper()
        state, h, common = self.initial_state(stepper), self.h, self._common(options, threads)
        control = {"tolerance": self.tolerance, **self._control}
        if self.error is not None:
            result = self.confirmed(stepper, options=options, threads=threads)
            h, control = result.steps.get("h"), control | result.steps
            if result.precision != "double":
                stepper = stepper._in_double_double or stepper
        elif h is None and self.has_time_transformation:
            from scvi_codegen.runs.driver.largest_step import largest_step  # imported here: not needed for reading

            if self.system.inputs:
                raise ModelFileError(
                    "with inputs, a step size in tau cannot be found by a pilot run: give one (--step, [run] step)"
                )
            arguments: dict[str, Any] = {"t": self.t, "parameters": self.parameters, "options": common["options"]}
            h = largest_step(stepper, self.q, state["p"], self.covered, self.tolerance or 0.0, **arguments)
        to_end = h is None or self.time_transformation is not None
        return stepper.start(
            **state,
            **control | {"h": abs(h) if h is not None and to_end else h} | ({} if h is None else {"tolerance": None}),
            t_end=self.t + self.covered if to_end else None,
            parameters=self.parameters_at_start(stepper),
            seed=self.seed,
            metropolis=self.metropolis,
            **common,
        )

    def confirmed(
        self, stepper: Stepper, *, options: SolverOptions | None = None, threads: int | None = None
    ) -> GlobalError:
        """Return the local tolerance (or step of tau) for :attr:`error`, confirmed by runs with other steps.

        A run with it is bitwise equal to the one that was confirmed.
        """
        arguments = {**self.initial_state(stepper), **self._common(options, threads), "parameters": self.parameters}
        arguments["inputs"] = self.all_inputs()
        span = {"t_end": self.t + self.covered, "error": self.error, **self._control}
        trajectory: Trajectory = stepper.integrate(**arguments, **span)
        assert trajectory.confirmation is not None  # by construction
        return trajectory.confirmation

    def integrate(self, *, progress: Callable[[int], None] | None = None, threads: int | None = None) -> Trajectory:
        """Integrate over the whole span; raises as :meth:`Stepper.integrate`."""
        self._check_alone()
        stepper, arguments = self.stepper(), self._run_arguments()
        if self.h is None and self.has_time_transformation and self.error is None:
            arguments |= {"h": self.start(stepper).plan.size, "tolerance": None}
        arguments |= {**self.initial_state(stepper), **self._common(None, threads), "parameters": self.parameters}
        trajectory: Trajectory = stepper.integrate(**arguments, progress=progress)
        return trajectory

    def _run_arguments(self) -> dict[str, Any]:
        """Return the arguments of :meth:`Stepper.integrate` and ensembles for time, steps, saved states and inputs."""
        others = (
            "span",
            "threads",
            "action",
            "precision",
            "sums",
            "controller",
            "observe",
            "transitions",
            "strict_energy",
        )  # those of the stepper
        arguments = {
            option.field: getattr(self, option.field)
            for option in RUN_FIELDS
            if option.field not in others and not option.solver_option
        }
        arguments["inputs"] = self.all_inputs()
        if self.ends_at_time or self.has_shorter_last_step or (self.system.inputs and self.span is not None):
            if self.h is not None and self.time_transformation is not None:
                arguments["h"] = abs(self.h)  # the end determines the direction
            return arguments | {"t_end": self.t + self.covered, "steps": None}
        return arguments | {"steps": self.step_count}

    def _common(self, options: SolverOptions | None, threads: int | None) -> dict[str, Any]:
        options, threads = options or self.solver_options, threads or self.threads
        return {"options": options} if threads is None else {"options": options, "threads": threads}

    def _vector(self, name: str, values: Sequence[float]) -> tuple[float, ...]:
        names = [coordinate.name for coordinate in self.system.coordinates]
        if not isinstance(values, Iterable):
            raise ModelFileError(f"{name} must be {len(names)} numbers, not {values!r}")
        values = tuple(values)
        check_length(values, names, name)
        if self.in_double_double:
            values = tuple(with_exact_numbers(values))
        return tuple(real(value, f"{name}[{i}] ({names[i]})") for i, value in enumerate(values))


def _vector(values: Any) -> Html:
    """Return a vector, or arrays by name, for a card."""
    if isinstance(values, Mapping):
        return listed([f"{name} of shape {np.shape(value)}" for name, value in values.items()])
    return listed([f"{float(value):g}" for value in values])


def _with_lists(value: Any) -> Any:
    """Return a value with lists for tuples, as in model files."""
    if isinstance(value, Mapping):
        return {name: _with_lists(entry) for name, entry in value.items()}
    return [_with_lists(entry) for entry in value] if isinstance(value, list | tuple) else value


def _equal(first: Any, second: Any) -> bool:
    """Return whether two values are equal, arrays and mappings of arrays by their entries."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(_equal(first[name], second[name]) for name in first)
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        return np.array_equal(first, second)
    return bool(first == second)
