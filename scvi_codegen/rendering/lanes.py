"""Sweeps in vectors as C: which support headers a sweep takes, and its tables, for either meaning of a lane.

A lane is a point of one trajectory's step, or a trajectory of many; the sweeps themselves are the same text for both
(``templates/support``), and so are the kernels but for what differs from lane to lane.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import Number, NumberTable
from scvi_codegen.ir.sweeps import (
    CollocationSweep,
    CoupledSweep,
    CurveSweep,
    GuessTables,
    HamiltonianSweep,
    PointSweep,
    SeparableSweep,
    ShootingSweep,
    Sweep,
)
from scvi_codegen.rendering.layout import table
from scvi_codegen.rendering.printer import INVERSE_ROOT, Sources, lane_functions, print_number
from scvi_codegen.rendering.target import DOUBLE

__all__ = ["POINTS", "TRAJECTORIES", "Lanes", "SweepText", "sweep_text"]

LIBRARY = ("sin", "cos", "exp", "log", "pow")
"""What glibc's libmvec has for every x86-64 vector width since 2.22."""

OF_TWO = ("pow", "atan2")

Values: TypeAlias = tuple[Number, ...]


@dataclass(frozen=True, slots=True)
class Lanes:
    """What a lane means.

    Attributes:
        sources: loads of a kernel that differ from lane to lane.
        meaning: its support header, before the tables.
        before, memory: what sweeps in such lanes take beside, after the tables.
    """

    sources: Sources
    meaning: str
    before: tuple[str, ...]
    memory: str

    @property
    def are_points(self) -> bool:
        """Whether they are points of one trajectory."""
        return "t" in self.sources

    def type_of(self, source: str) -> str:
        """Of the time or of a parameter."""
        return "lanes" if source in self.sources else "double"


POINTS = Lanes(("u", "t"), "points", (), "one_trajectory")
TRAJECTORIES = Lanes(("u", "parameters"), "trajectories", ("crowd_step",), "many_trajectories")


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepText:
    """What the templates write of a sweep.

    Attributes:
        lanes: in a vector.
        meaning: of a lane.
        defines: macro and value that the support headers want.
        functions: lines that make functions of vectors.
        tables: C text of each.
        kernels: with lanes.
        mass: the constant masses, if there are such.
        support: headers from the tables on.
        error_defines, highest: macro and value, and the table, that the error of a curve is found with.
    """

    lanes: int
    meaning: Lanes
    defines: Mapping[str, str]
    functions: tuple[str, ...]
    tables: tuple[str, ...]
    kernels: tuple[Kernel, ...]
    mass: Kernel | None
    support: tuple[str, ...]
    error_defines: Mapping[str, str]
    highest: str

    @property
    def inverse_roots(self) -> bool:
        """Whether there are some."""
        return any("INVERSE_ROOT" in line for line in self.functions)

    @property
    def library(self) -> bool:
        """Whether the vector library has functions that occur."""
        return any("LIBRARY" in line for line in self.functions)


def sweep_text(sweep: Sweep, meaning: Lanes, lanes: int, *, newton: bool, hamiltonian: bool) -> SweepText:
    """A sweep in vectors of ``lanes`` lanes.

    Args:
        sweep: what is written.
        meaning: of a lane.
        lanes: in a vector.
        newton: whether Newton's iteration is tried where it fails.
        hamiltonian: whether a Hamiltonian is given.
    """
    mass = sweep.mass if isinstance(sweep, SeparableSweep) else None
    applied = (*sweep.kernels, *((mass,) if mass and not meaning.are_points else ()))
    functions = set().union(*(lane_functions(kernel, meaning.sources) for kernel in applied))
    solver = _solver(sweep, newton=newton) if meaning.are_points else ()
    return SweepText(
        lanes=lanes,
        meaning=meaning,
        defines={
            "SWEEPS_AFTER": str(sweep.sweeps_after),
            **_facts(sweep, hamiltonian=hamiltonian),
        },
        functions=tuple(map(_function, sorted(functions))),
        tables=tuple(_tables(sweep, meaning)),
        kernels=sweep.kernels,
        mass=mass,
        support=(*meaning.before, "contraction", meaning.memory, *_support(sweep), *solver),
        error_defines=_kept(sweep),
        highest=_vector("HIGHEST", sweep.guess.highest),
    )


def _kept(sweep: Sweep) -> dict[str, str]:
    """What is kept of a step. Coefficient k of velocities is h / (4k - 2) times coefficient k - 1 of accelerations."""
    velocities, degree = isinstance(sweep, PointSweep), sweep.guess.degree
    forces = isinstance(sweep, SeparableSweep)
    return {
        "KEPT": str(len(sweep.guess.abscissae)),
        "KEPT_VELOCITIES": str(int(velocities)),
        "KEPT_UNIT(i)": "(data->square * data->inverse_mass[i])" if forces else "(step->h)",
        "RESOLVED": f"{4 * degree - 2 if velocities else 1}.0",
    }


def _function(name: str) -> str:
    """The line that makes a function of vectors."""
    if name.startswith(INVERSE_ROOT):
        k = int(name.removeprefix(INVERSE_ROOT))
        powers = " * ".join(["square"] * (k // 2) + ["y"])
        return f"LANES_INVERSE_ROOT({k}, {powers}, {' * '.join(['inverse'] * ((k + 1) // 2))})"
    return f"LANES_{'LIBRARY_' * (name in LIBRARY)}FUNCTION{'_OF_TWO' * (name in OF_TWO)}({name})"


def _facts(sweep: Sweep, *, hamiltonian: bool) -> dict[str, str]:
    """What the headers of one kind of sweep ask of it."""
    if isinstance(sweep, CoupledSweep):
        return {"PROJECTED": "1"} if sweep.projected else {}
    if isinstance(sweep, CurveSweep):
        return {"NODES": str(sweep.nodes.count)} if sweep.points else {"HAMILTONIAN": str(int(hamiltonian))}
    return {}


def _support(sweep: Sweep) -> tuple[str, ...]:
    """Headers of a kind of sweep, in order."""
    mass = "diagonal_mass" if sweep.diagonal else "full_mass"
    match sweep:
        case SeparableSweep():
            return ("separable_sweep",)
        case CoupledSweep():
            return ("point_weights", mass, "coupled_sweep")
        case HamiltonianSweep():
            return ("point_weights", "hamiltonian_sweep")
        case ShootingSweep():
            return (mass, "unknown_velocity", "curve", "curve_points", "shooting_sweep")
        case CollocationSweep(ends=None):
            return (mass, "known_velocity", "curve", "ends_by_transform", "collocation_sweep")
        case _:
            return (mass, "unknown_velocity", "curve", "curve_points", "ends_by_quadrature", "collocation_sweep")


def _solver(sweep: Sweep, *, newton: bool) -> tuple[str, ...]:
    """Headers of the solver around a sweep whose lanes are points, in order."""
    solver = ("newton_fallback" if newton else "no_fallback", "sweep_solver")
    if not isinstance(sweep, PointSweep) or sweep.integrands is None:
        return solver
    return (*solver, f"{sweep.kind}_integrals", "integrals_after_fallback" if newton else "integrals_after_sweep")


def _tables(sweep: Sweep, meaning: Lanes) -> Iterator[str]:
    if isinstance(sweep, CurveSweep):
        yield from _curve_tables(sweep)
    elif isinstance(sweep, SeparableSweep):
        yield from _separable_tables(sweep, *_printers(meaning, sweep.points))
    else:
        yield from _point_tables(sweep, *_printers(meaning, sweep.points))


PrintVector: TypeAlias = Callable[[str, Values], str]
PrintMatrix: TypeAlias = Callable[[str, NumberTable], str]


def _printers(meaning: Lanes, points: int) -> tuple[PrintVector, PrintMatrix]:
    """How vectors and matrices over points are written: all points in a vector, or a number each."""
    if meaning.are_points:
        return (lambda name, values: _lanes(f"{name}[1]", (values,))), _columns
    size = f"[{points}]"

    def vector(name: str, values: Values) -> str:
        return table(f"static const double {name}{size}", _numbers(values[:points]))

    def matrix(name: str, rows: NumberTable) -> str:
        return table(f"static const double {name}{size}{size}", [_numbers(row[:points]) for row in rows[:points]])

    return vector, matrix


def _numbers(values: Sequence[Number]) -> list[str]:
    return [print_number(value) for value in values]


def _lanes(name: str, rows: Sequence[Values]) -> str:
    return table(f"static const lanes {name}", [_numbers(row) for row in rows])


def _columns(name: str, rows: NumberTable) -> str:
    """A table whose column j is a vector, what point j gives to all."""
    return _lanes(f"{name}[{len(rows[0])}]", tuple(zip(*rows, strict=True)))


def _vector(name: str, values: Values) -> str:
    return table(f"static const lanes {name}", _numbers(values))


def _separable_tables(sweep: SeparableSweep, vector: PrintVector, matrix: PrintMatrix) -> Iterator[str]:
    yield vector("ABSCISSA", sweep.abscissae)
    yield vector("DRIFT", sweep.drift)
    yield vector("DRIFT_LOW", _rest(sweep.drift))
    yield matrix("PRODUCT", sweep.product)
    yield matrix("PRODUCT_LOW", _rests(sweep.product))
    yield vector("POINT_END_POSITION", sweep.end_position)
    yield vector("POINT_END_POSITION_LOW", _rest(sweep.end_position))
    yield vector("POINT_END_MOMENTUM", sweep.end_momentum)
    yield vector("POINT_END_MOMENTUM_LOW", _rest(sweep.end_momentum))
    yield from _guess_tables(sweep.guess, matrix)


def _rest(values: Values) -> Values:
    """What rounding cuts off the numbers of a table."""
    return tuple(map(DOUBLE.rest, values))


def _rests(rows: NumberTable) -> NumberTable:
    return tuple(map(_rest, rows))


def _point_tables(sweep: PointSweep, vector: PrintVector, matrix: PrintMatrix) -> Iterator[str]:
    yield vector("ABSCISSA", sweep.abscissae)
    yield matrix("POSITION", sweep.position)
    yield vector("POSITION_WEIGHT", sweep.position_weights)
    yield matrix("MOMENTUM", sweep.momentum)
    yield vector("MOMENTUM_WEIGHT", sweep.momentum_weights)
    yield vector("POINT_END_POSITION", sweep.end_position)
    yield vector("POINT_END_MOMENTUM", sweep.end_momentum)
    if isinstance(sweep, CoupledSweep) and sweep.projected:
        yield matrix("VELOCITY", sweep.velocity)
        yield matrix("PROJECTION", sweep.projection)
    yield from _guess_tables(sweep.guess, matrix)


def _curve_tables(sweep: CurveSweep) -> Iterator[str]:
    yield _vector("NODE_TIME", sweep.nodes.abscissae)
    yield _columns("COLLOCATION", sweep.nodes.collocation)
    yield _vector("NODE_END", sweep.nodes.end)
    yield _vector("NODE_MASK", sweep.nodes.mask)
    if sweep.points:
        yield _vector("POINT_TIME", sweep.points.abscissae)
        yield _columns("POINT_POSITION", sweep.points.position)
        yield _columns("POINT_VELOCITY", sweep.points.velocity)
    if isinstance(sweep, ShootingSweep):
        yield _columns("COLLOCATION_T", sweep.collocation_transposed)
        yield _columns("POINT_POSITION_T", sweep.position_transposed)
        yield _columns("POINT_VELOCITY_T", sweep.velocity_transposed)
        yield _vector("POINT_WEIGHT", sweep.weights)
        yield _vector("NODE_CONSISTENCY", sweep.consistency)
    if isinstance(sweep, CollocationSweep) and sweep.ends:
        yield _vector("START_FORCE", sweep.ends.start_force)
        yield _vector("START_MOMENTUM", sweep.ends.start_momentum)
        yield _vector("END_FORCE", sweep.ends.end_force)
        yield _vector("END_MOMENTUM", sweep.ends.end_momentum)
    yield from _guess_tables(sweep.guess, _columns)


def _guess_tables(guess: GuessTables, matrix: PrintMatrix) -> Iterator[str]:
    yield matrix("LAST_ALONE", guess.last_alone)
    yield matrix("LAST", guess.last)
    yield matrix("BEFORE", guess.before)
