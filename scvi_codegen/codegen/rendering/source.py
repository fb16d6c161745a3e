"""C source of an integrator, and the interface that is needed to call it.

An integrator is one header and one source file, ``<prefix>.h`` and ``<prefix>.c``. The latter includes support headers,
plain C that is the same for every integrator, from a folder ``support``; amalgamated, it contains them. To be read it
contains the step and its run, and includes the rest of what an integrator uses.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from scvi_codegen.codegen.rendering.own_names import with_distinct_names, with_exported_names, with_own_names
from scvi_codegen.codegen.rendering.preprocessor import preprocessed
from scvi_codegen.common.errors import StateError
from scvi_codegen.systems.contact import Impacts
from scvi_codegen.systems.contacts.rows import ContactRows
from scvi_codegen.systems.event import Event, Kink, Refraction, Transition
from scvi_codegen.systems.formulas.indices import Access, ArrayDeclarations, ArrayMap, Loop
from scvi_codegen.version import __version__

if TYPE_CHECKING:
    from scvi_codegen.codegen.rendering.reachable import Function

TEXTS = ("header", "code", "declarations")
PREFIX = re.compile(r"[A-Za-z_]\w*", re.ASCII)
SUPPORT = re.compile(r"(?:support/(?:\w+/)?)?\w+\.h", re.ASCII)
"""Names of files, which are written into a folder and must not lead out of it."""
KINDS: dict[str, Callable[[Any], bool]] = {
    "str": lambda value: isinstance(value, str),
    "str | None": lambda value: value is None or isinstance(value, str),
    "int": lambda value: type(value) is int and 0 <= value < 2**40,
    "bool": lambda value: isinstance(value, bool),
    "tuple[str, ...]": lambda value: isinstance(value, tuple) and all(isinstance(entry, str) for entry in value),
    "tuple[bool, ...]": lambda value: isinstance(value, tuple) and all(isinstance(entry, bool) for entry in value),
    "tuple[float, ...]": lambda value: isinstance(value, tuple) and all(map(_is_number, value)),
    "tuple[tuple[str, ...], ...]": lambda value: isinstance(value, tuple) and all(map(KINDS["tuple[str, ...]"], value)),
    "tuple[tuple[str, float, float], ...]": lambda value: all(map(_is_number, (x for _, *pair in value for x in pair))),
    "ArrayLayout": lambda value: False,
    "tuple[ContactRows, ...]": lambda value: all(isinstance(row, ContactRows) for row in value),
    "Sizes | None": lambda value: value is None or isinstance(value, Sizes),
    "LaneContents | None": lambda value: value is None or isinstance(value, LaneContents),
}
"""Checks of values read from JSON against the annotations of :class:`Interface` and :class:`Contents`."""


def _checked(cls: type, record: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of a dataclass from JSON; raise :class:`ValueError` for a value of another type."""
    arguments: dict[str, Any] = {key: _as_tuples(value) for key, value in record.items()}
    for attribute in fields(cls):
        name, kind = attribute.name, str(attribute.type)
        if name in arguments and not KINDS[kind](arguments[name]):
            raise ValueError(f"{name} is {arguments[name]!r:.60}: it must be of type {kind}")
    return arguments


def _contact_of(row: Sequence[Any]) -> ContactRows:
    """Return the places of a contact from JSON; raise :class:`ValueError` for values of other types."""
    contact = ContactRows._make(_as_tuples(value) for value in row)
    if not (
        all(number is None or KINDS["int"](number) for number in (contact.normal, contact.tangential, contact.slips))
        and all(map(KINDS["str | None"], (contact.closed, contact.held)))
        and all(map(KINDS["tuple[str, ...]"], (contact.sticks, (*contact.directions, contact.title))))
        and all(map(KINDS["tuple[tuple[str, ...], ...]"], (contact.transitions, contact.quantities)))
        and contact.impacts in [*Impacts]
        and KINDS["bool"](contact.varies)
    ):
        raise ValueError(f"contacts contain {contact!r:.60}: these are not the places of a contact")
    return contact


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """Numbers of an integrator of named coordinates; ``workspace``: doubles per call."""

    coordinates: int
    parameters: int
    unknowns: int
    workspace: int
    maps: int
    constraints: int
    sums: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneContents:
    """Number of observed functions of the state."""

    observed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """What the C of a source offers its callers, recorded where it is rendered.

    Attributes:
        functions: functions that its header declares, without the prefix.
        run_fields: fields of the struct of a run that not every integrator has.
        divided: whether kernels are divided into functions.
        rolled: whether short loops over coordinates must not be unrolled.
        points_in_loops: whether kernels are in loops over the points of a step.
        threads: whether threads may share its steps.
        sizes: of an integrator of named coordinates, else ``None``.
        lanes: of trajectories in SIMD lanes, else ``None``.
    """

    functions: tuple[str, ...] = ()
    run_fields: tuple[str, ...] = ()
    divided: bool = False
    rolled: bool = False
    points_in_loops: bool = False
    threads: bool = False
    sizes: Sizes | None = None
    lanes: LaneContents | None = None

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Contents:
        """Return the contents from plain data; raises ValueError and TypeError for other fields and types."""
        sizes, lanes = record["sizes"], record["lanes"]
        kinds = {"sizes": sizes and Sizes(**_checked(Sizes, sizes))}
        kinds["lanes"] = lanes and LaneContents(**_checked(LaneContents, lanes))
        return cls(**_checked(cls, {**record, **kinds}))


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """C source of an integrator.

    Attributes:
        prefix: of every exported C name.
        header, code: contents of ``<prefix>.h`` and ``<prefix>.c``.
        declarations: the header's inner part.
        support: names and contents of the headers that the code includes, in order.
        beside: a further header and source that call this one: the search for zero crossings, or FMI.
        contents: functions and sizes, for callers.
    """

    prefix: str
    header: str
    code: str
    declarations: str
    support: tuple[tuple[str, str], ...] = ()
    beside: Source | None = None
    contents: Contents = Contents()

    @property
    def files(self) -> dict[str, str]:
        """File contents by file name, ``/`` between folders."""
        files = {f"{self.prefix}.h": self.header, f"{self.prefix}.c": self.code, **dict(self.support)}
        return files | (self.beside.files if self.beside else {})

    def write(self, folder: Path) -> None:
        """Write all files into a folder."""
        for name, text in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")

    @property
    def sources(self) -> tuple[Source, ...]:
        """Sources to compile: this one, and those of :attr:`beside`."""
        return (self, *self.beside.sources) if self.beside else (self,)

    def amalgamated(self) -> Source:
        """Return the source as one file: support headers inserted, without alternatives that it does not use."""
        code = preprocessed(self.code, dict(self.support).__getitem__)
        beside = self.beside.amalgamated() if self.beside else None
        return replace(self, code=code, support=(), beside=beside)

    @property
    def _readable_files(self) -> dict[str, str]:
        """Files without what no exported function uses, by name; that of the step first."""
        from scvi_codegen.codegen.rendering.reachable import readable

        return with_exported_names(readable(self.amalgamated().code))

    @property
    def functions(self) -> dict[str, Function]:
        """Functions of the code and its support headers with a body, by name, in order."""
        from scvi_codegen.codegen.rendering.reachable import functions_of

        return functions_of(self.amalgamated().code)

    def with_distinct_names(self, prefix: str) -> Source:
        """Return the source with names of its own beside the exported ones, which have the prefix."""
        code, *support = with_distinct_names({"": self.code, **dict(self.support)}, self.header, prefix).items()
        return replace(self, code=code[1], support=tuple(support))

    def readable(self) -> Source:
        """Return the source without what no exported function uses, the step first; the code includes what follows."""
        (_, code), *rest = self._readable_files.items()
        support = tuple(
            (f"{self.prefix}_{name}.h", f"/* Included by {self.prefix}.c. */\n\n{text}") for name, text in rest
        )
        code += "".join(f'\n#include "{name}"' for name, _ in support) + "\n" * bool(support)
        return replace(self, code=code, support=support, beside=self.beside.readable() if self.beside else None)

    def single_file(self) -> Source:
        """Return the source as one file whose names have the integrator's prefix.

        Files of several integrators can be included in one translation unit.
        """
        code = with_own_names("\n".join(self._readable_files.values()), self.prefix, self.header)
        return replace(self, code=code, support=(), beside=self.beside.single_file() if self.beside else None)

    def to_record(self) -> dict[str, Any]:
        """Return plain data, contents line by line, for :meth:`from_record`."""
        return {
            "prefix": self.prefix,
            **{name: getattr(self, name).split("\n") for name in TEXTS},
            "support": {name: text.split("\n") for name, text in self.support},
            "beside": self.beside.to_record() if self.beside else None,
            "contents": asdict(self.contents),
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Source:
        """Return the source from :meth:`to_record`; ValueError for invalid names of files, and other contents."""
        names = record["prefix"], *record["support"]
        for name, pattern in zip(names, (PREFIX, *[SUPPORT] * len(names)), strict=False):
            if not (isinstance(name, str) and pattern.fullmatch(name)):
                raise ValueError(
                    f"{name!r} is not the name of a file of an integrator: a C identifier, NAME.h, or support/NAME.h"
                )
        beside = record["beside"]
        return cls(
            prefix=record["prefix"],
            **{name: "\n".join(record[name]) for name in TEXTS},
            support=tuple((name, "\n".join(lines)) for name, lines in record["support"].items()),
            beside=cls.from_record(beside) if beside else None,
            contents=Contents.from_record(record["contents"]),
        )

    def to_json(self) -> str:
        """Return text for :meth:`from_json`."""
        return json.dumps(self.to_record())

    @classmethod
    def from_json(cls, text: str) -> Source:
        """Return the source from :meth:`to_json`."""
        return cls.from_record(json.loads(text))


DOUBLE_DOUBLE = "double-double"
"""Precision of states of two words, 31 digits."""
AUTO = "auto"
"""Precision of runs with ``error=``: double where it suffices, else double-double."""
PRECISIONS = ("double", DOUBLE_DOUBLE, AUTO)
COMPONENTS = {"rotation": 4, "direction": 3, "spin": 2}
"""Number of homogeneous coordinates by kind."""
NUMBER = re.compile(r"\d+(\.\d*)?", re.ASCII)
NAME_IN_FORMULA = re.compile(r"(?<![\w.])[A-Za-z_]\w*(?!\w*\()")
"""Names in formulas but those of functions."""
DECLARED = re.compile(r"rotation [A-Za-z]\w* [A-Za-z]\w*( momentum)?|(direction|spin) [A-Za-z]\w*", re.ASCII)


def _as_tuples(value: Any) -> Any:
    """Return a value of JSON with tuples in place of lists, and of lists in them."""
    if not isinstance(value, list):
        return value
    return tuple(tuple(entry) if isinstance(entry, list) else entry for entry in value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def check_interface(source: Source, interface: Interface) -> None:
    """Raise :class:`ValueError` if an interface has other sizes than the C source, which determine those of arrays."""
    of_source = source.contents.sizes
    if of_source is None:
        raise ValueError("contents: the source must be that of an integrator of named coordinates, with its sizes")
    sizes = {
        "COORDINATES": (interface.dimension, of_source.coordinates),
        "PARAMETERS": (len(interface.parameters), of_source.parameters),
        "UNKNOWNS": (interface.unknowns, of_source.unknowns),
        "WORKSPACE": (interface.workspace, of_source.workspace),
        "MAPS": (len(interface.map_names), of_source.maps),
        "CONSTRAINTS": (len(interface.constraints), of_source.constraints),
    }
    if interface.exchange_names and of_source.sums:
        sizes["SUMS"] = (len(interface.exchange_names) + 1, of_source.sums)
    for name, (described, compiled) in sizes.items():
        if described != compiled:
            raise ValueError(
                f"{name} is {described} in the interface and {compiled} in the C source: they must be equal"
            )
    lengths: dict[str, tuple[object, object]] = {"prefix": (interface.prefix, source.prefix)}
    lengths["defaults"] = (len(interface.defaults), len(interface.parameters))
    lengths["momentum_names"] = (len(interface.momentum_names), interface.dimension if interface.momentum_names else 0)
    lengths["map_formulas"] = (len(interface.map_formulas), len(interface.map_names))
    for name, (length, required) in lengths.items():
        if length != required:
            raise ValueError(f"{name}: the interface has {length}; {required} is required")
    _check_lengths(interface)
    _check_names(source, interface)


def _check_lengths(interface: Interface) -> None:
    """Raise :class:`ValueError` if the lengths of neighbours are not those of lists with a cutoff, in parameters."""
    with_cutoff: set[str] = set()
    for length in interface.lengths:
        with_cutoff |= {length[0]} if length[1:2] == ("cutoff",) else set()
        if len(length) != 3 or length[0] not in with_cutoff or length[1] not in ("cutoff", "skin", "box"):
            raise ValueError(
                f"lengths: {length!r} must be neighbours, cutoff, skin or box, and a formula, cutoffs first"
            )
        formula = length[2]
        unknown = {*NAME_IN_FORMULA.findall(formula)} - {*interface.parameters, "pi"}
        if unknown or not (NUMBER.fullmatch(formula) or re.search("[A-Za-z]", formula)):
            raise ValueError(f"lengths: {formula!r} must be a formula of the parameters {interface.parameters}")


def _check_names(source: Source, interface: Interface) -> None:
    """Raise :class:`ValueError` if names that others refer to are missing."""
    first = {name[:-2] for name in interface.parameters if name.endswith("_0")}
    if not set(interface.inputs) <= first:
        raise ValueError(f"the inputs {interface.inputs} must each have a first parameter NAME_0")
    parameter = interface.energy_parameter
    if ("rates" in source.contents.functions) != interface.in_tau or not {parameter} <= {None, *interface.parameters}:
        raise ValueError(f"energy_parameter: {parameter!r} must be a parameter of systems in transformed time")
    if interface.variables and not len(interface.variables) == 2 * len(interface.momentum_names):
        raise ValueError(f"variables: {interface.variables} must be the coordinates and momenta")


class ExampleInput(NamedTuple):
    """Input as a function of time: (n + 1,) breakpoints, and (n, 4) coefficients of powers of the time since."""

    name: str
    breakpoints: tuple[float, ...]
    coefficients: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayLayout(ArrayDeclarations):
    """Arrays of an integrator, whose sizes follow from those of a run.

    Attributes:
        field_defaults: fill values of fields that are not passed.
        maps: momentum maps.
        accesses: every array access, with the loops around it.
        depends_on_time: whether L or H depends on t explicitly.
        constraints: loops of each constraint.
        continued: whether the predictor extrapolates previous steps instead of reusing the forces at their end.
        momentum_formulas: L_v in (q, v) of a Lagrangian that is integrated by its Hamiltonian
            (:class:`~scvi_codegen.systems.formulas.array_statements.ArrayForce`).
        couplings: terms of the potential energy and forces, which couple the coordinates that occur in them.
        symmetric: whether the linear part of a step is symmetric: without momenta and forces of velocities.
        data: values of fields and tables by name for runs that pass none.
        neighbours: names of the lists of neighbours.
        mesh: of the fields of a density (:class:`~scvi_codegen.extras.fields.mesh.Mesh`).
        links: of a robot from a file.
    """

    field_defaults: tuple[float, ...] = ()
    maps: tuple[ArrayMap, ...] = ()
    accesses: tuple[tuple[Access, tuple[Loop, ...]], ...] = ()
    depends_on_time: bool = False
    constraints: tuple[tuple[Loop, ...], ...] = ()
    continued: bool = False
    momentum_formulas: tuple[Any, ...] = ()
    couplings: tuple[Any, ...] = ()
    symmetric: bool = True
    data: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    neighbours: tuple[str, ...] = ()
    mesh: Any = field(default=None, compare=False, repr=False)
    links: tuple[Any, ...] = field(default=(), compare=False, repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Interface:
    """Interface of a compiled integrator.

    Attributes:
        prefix: of every exported C name.
        title: system and method, one line.
        notes: order, symplecticity, symmetry as text.
        system, method: their names.
        coordinates, parameters: names in order.
        defaults: default values of the parameters.
        unknowns: length of the run's memory of its last stages.
        workspace: doubles of workspace per call.
        has_action: whether the method has a discrete Lagrangian.
        sums_action: whether it sums L along the curve of a step, also with forces and constraints.
        has_fallback: whether Newton's method is tried if the fixed-point iteration fails.
        map_names, map_formulas: of the momentum maps, the first integrals from symmetries.
        map_exact: whether the method is known to conserve them exactly, to round-off.
        momentum_names: in order; none of arrays of run-time sizes with a Lagrangian: see :attr:`momenta`.
        exchange_names: of work and impulses of forces in a step: energy and momentum maps; none without forces.
        constraints: formulas g of the constraints g = 0.
        masked: number of the last constraints, which are imposed in some modes only.
        ranges: call, argument and its bounds of each table that is undefined beyond them.
        functions: name and arguments as JSON of each table that formulas call.
        inputs: names of tabulated inputs, each of which has five parameters.
        input_ranges: name, smallest and largest value of those that are clamped.
        energy_parameter: of a time-transformed system, the parameter that is the energy of the initial state.
        time_transformation: time-rescaling function g in dt = g dtau that determines its step sizes.
        conserves_energy: whether energy is a first integral.
        changes_energy: reason why it is not conserved; ``None`` if it is.
        has_unseen_growth: whether the error estimate of a step does not see that masses grow.
        balances_energy: whether it changes by the work of forces or damping only.
        dissipates: whether it has contacts and cannot grow.
        arrays: declarations of arrays of known sizes, first those whose entries are the coordinates in order, then
            those whose entries are parameters; none without arrays.
        indices: sizes and index tables of these arrays, ``"N = 3"``, ``"pairs = [[0, 1], [1, 2]]"``.
        solver: of the stage equations, as in ``compile_stepper``, with or without a fallback.
        rotations: declarations of rotations, directions and spins, ``"rotation R omega"``, ``"direction n"``, ``"spin
            s"``, in the order of their coordinates, which follow the ordinary ones.
        layout: of arrays whose sizes are known at run time; the coordinates are their names.
        variables: of a first-order system all coordinates in the order of the user, half of which are ``coordinates``
            and half of which take the place of momenta; else none.
        lengths: cutoffs, skins and periods of lists of neighbours, ``("near", "cutoff", "5*s/2")``, which every run
            checks.
        words: number of doubles of each number of a state, 2 in double-double arithmetic.
        kinks: functions at whose zeros the equations are not smooth, for events.
        modes: parameter, switching function, "jumps" or "", masks of contacts, and sides of powers of located kinks
            (:mod:`scvi_codegen.systems.kinks`).
        contacts: places of each contact (:mod:`scvi_codegen.systems.contacts.modes`).
        temperature: formula of kT of a heat bath, ``None`` without one.
        friction: names and formulas of the coefficients of its friction, which must not be negative.
    """

    prefix: str
    title: str
    notes: tuple[str, ...] = ()
    system: str
    method: str
    coordinates: tuple[str, ...]
    parameters: tuple[str, ...]
    defaults: tuple[float, ...]
    unknowns: int = 0
    workspace: int = 0
    has_action: bool = False
    sums_action: bool = False
    map_names: tuple[str, ...] = ()
    map_formulas: tuple[str, ...] = ()
    map_exact: tuple[bool, ...] = ()
    momentum_names: tuple[str, ...] = ()
    has_fallback: bool = False
    energy_parameter: str | None = None
    time_transformation: str | None = None
    exchange_names: tuple[str, ...] = ()
    constraints: tuple[str, ...] = ()
    masked: int = 0
    functions: tuple[tuple[str, ...], ...] = ()
    ranges: tuple[tuple[str, ...], ...] = ()
    inputs: tuple[str, ...] = ()
    input_ranges: tuple[tuple[str, float, float], ...] = ()
    conserves_energy: bool = False
    changes_energy: str | None = None
    has_unseen_growth: bool = False
    balances_energy: bool = False
    dissipates: bool = False
    solver: str = ""
    arrays: tuple[str, ...] = ()
    indices: tuple[str, ...] = ()
    rotations: tuple[str, ...] = ()
    layout: ArrayLayout = ArrayLayout()
    variables: tuple[str, ...] = ()
    lengths: tuple[tuple[str, ...], ...] = ()
    words: int = 1
    kinks: tuple[str, ...] = ()
    modes: tuple[tuple[str, ...], ...] = ()
    contacts: tuple[ContactRows, ...] = ()
    temperature: str | None = None
    friction: tuple[tuple[str, ...], ...] = ()

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Names of the parameters that runs change: modes of contacts and of kinks; they are the last ones."""
        return tuple(name for contact in self.contacts for name in contact.masks) + tuple(
            name for name, *_ in self.modes
        )

    @property
    def imposed(self) -> tuple[str, ...]:
        """Constraints of all modes, without the masked ones."""
        return self.constraints[: len(self.constraints) - self.masked]

    @property
    def own_parameters(self) -> tuple[str, ...]:
        """Names of the parameters of the system, without those of modes."""
        return self.parameters[: len(self.parameters) - len(self.mode_names)]

    @staticmethod
    def bodies(names: Sequence[str]) -> tuple[Any, ...]:
        """Return the bodies, ``name`` and ``columns``, whose positions are coordinates such as ``sun_x``."""
        from scvi_codegen.systems.symmetry.sampling import bodies  # imports SymPy

        return bodies(names)

    def parameter_index(self, name: str) -> int:
        """Return the index of a parameter; raise ``StateError`` with the nearest name if unknown."""
        names = self.parameters
        if name in names:
            return names.index(name)
        folded = {parameter.lower(): parameter for parameter in names}
        near = [folded[key] for key in difflib.get_close_matches(str(name).lower(), folded, 1)]
        if not names:
            raise StateError(f"there is no parameter {name!r}: '{self.system}' has none. Declare it in its definition")
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise StateError(f"there is no parameter {name!r} among {', '.join(self.own_parameters)}{hint}")

    def searched(self, events: Iterable[Event]) -> tuple[Event, ...]:
        """Return the events that runs search for: some events, the transitions of contacts, and the kinks."""
        transitions = (
            Transition(function, -1, where=tuple(where) or None, contact=number, kind=kind, gap=contact.title)
            for number, contact in enumerate(self.contacts)
            for kind, function, *where in contact.transitions
        )
        kinks = (
            (Refraction if jumps else Kink)(
                function, mode=mode, held=held, lacks=lacks, power_sides=tuple(map(int, sides))
            )
            for mode, function, jumps, held, lacks, *sides in self.modes
        )
        return *events, *transitions, *kinks

    @property
    def in_tau(self) -> bool:
        """Whether the system is one in transformed time, whose steps are steps of tau."""
        return self.energy_parameter is not None

    @property
    def energy_index(self) -> int:
        """Index of :attr:`energy_parameter` of transformed time among the parameters."""
        assert self.energy_parameter is not None
        return self.parameters.index(self.energy_parameter)

    @property
    def dimension(self) -> int:
        """Degrees of freedom m."""
        return len(self.coordinates)

    @property
    def index_values(self) -> dict[str, Any]:
        """:attr:`indices` by name: whole numbers, and rows of whole numbers."""
        return {name: json.loads(value) for name, value in (declaration.split(" = ") for declaration in self.indices)}

    def about(self) -> dict[str, str]:
        """Return title, system, method, and version of this package, to accompany every computed number."""
        return {"title": self.title, "system": self.system, "method": self.method, "version": __version__}

    @property
    def momenta(self) -> tuple[str, ...]:
        """Names of the momenta: those of a Hamiltonian, else ``p_`` and the coordinate's name."""
        return self.momentum_names or tuple(f"p_{name}" for name in self.coordinates)

    @property
    def momentum_columns(self) -> tuple[str, ...]:
        """Names of columns with p: ``p_`` and the coordinate's name, or the variables in its place."""
        return self.momentum_names if self.variables else tuple(f"p_{name}" for name in self.coordinates)

    def to_record(self) -> dict[str, Any]:
        """Return the fields for :meth:`from_record`, which supports named coordinates only."""
        return {name: value for name, value in asdict(self).items() if name != "layout"}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Interface:
        """Return the interface from :meth:`to_record`, also from its JSON; ValueError or TypeError for other fields."""
        contacts = tuple(_contact_of(row) for row in record.get("contacts", ()))
        interface = cls(**_checked(cls, {**record, "contacts": contacts}))
        if interface.words not in (1, 2):
            raise ValueError(f"words is {interface.words}: it must be 1 or, in double-double arithmetic, 2")
        try:
            valid = all(isinstance(value, int | list) for value in interface.index_values.values())
        except RecursionError:
            valid = False
        if not valid:
            raise ValueError(f"indices is {interface.indices!r:.60}: it must contain whole numbers")
        kinds = [kind for kind, *_ in map(str.split, filter(DECLARED.fullmatch, interface.rotations))]
        if len(kinds) < len(interface.rotations) or sum(COMPONENTS[kind] for kind in kinds) > interface.dimension:
            raise ValueError(f"rotations is {interface.rotations!r:.60}: it must declare some of the coordinates")
        return interface
