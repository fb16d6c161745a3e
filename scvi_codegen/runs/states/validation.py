"""States and parameters of an integrator: validation against its interface, and arrays and single names by name."""

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import BINARY64, checked_number, real_array
from scvi_codegen.codegen.rendering.source import NAME_IN_FORMULA, NUMBER, Interface
from scvi_codegen.common.errors import ContactError, StateError, closest
from scvi_codegen.common.representation import counted
from scvi_codegen.runs.states.words import Shapes

Array = NDArray[np.float64]


class EntryNames(Sequence[str]):
    """Names of all entries of arrays in order, ``q_0``, ``q_1``, .., which are made when they are read."""

    def __init__(self, arrays: Shapes) -> None:
        self.arrays = tuple(arrays)
        self.firsts: list[int] = [0, *np.cumsum([math.prod(shape) for _, shape in arrays], dtype=int).tolist()]

    def __len__(self) -> int:
        return self.firsts[-1]

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return tuple(self[k] for k in range(*row.indices(len(self))))
        k = int(range(len(self))[row])
        which = int(np.searchsorted(self.firsts, k, side="right")) - 1
        name, shape = self.arrays[which]
        return "_".join([name, *map(str, np.unravel_index(k - self.firsts[which], shape))]) if shape else name

    def index(self, name: Any, *_: Any) -> int:
        """Return the position of a name; raise ``ValueError`` if there is none."""
        for (array, shape), first in zip(self.arrays, self.firsts, strict=False):
            if array == name and not shape:
                return first
            parts = name.removeprefix(f"{array}_").split("_")
            if shape and name.startswith(f"{array}_") and len(parts) == len(shape) and all(map(str.isdigit, parts)):
                index = tuple(map(int, parts))
                if all(k < size for k, size in zip(index, shape, strict=True)):
                    return first + int(np.ravel_multi_index(index, shape))
        raise ValueError(f"{name!r} is no entry")

    def __contains__(self, name: object) -> bool:
        try:
            return isinstance(name, str) and self.index(name) >= 0
        except ValueError:
            return False


def flat_state(interface: Interface, value: Any, name: str) -> Any:
    """Return a state given by the names of its arrays as (.., m) numbers in order, and other values as they are.

    Momenta of a Hamiltonian have the names of their arrays or of those of the coordinates. The only array of a system
    need not be named: numbers of its shape suffice.
    """
    if not interface.arrays and (type(value) is np.ndarray or not isinstance(value, Mapping)):
        return value
    if not interface.arrays and len(value) == interface.dimension:
        numbers = [*map(value.get, interface.coordinates)]
        if NUMBERS.issuperset(map(type, numbers)):
            return np.array(numbers, BINARY64)
    arrays = coordinate_shapes(interface)
    if isinstance(value, Mapping):
        coordinates = dict(zip((momentum.name for momentum in interface.layout.momenta), arrays, strict=False))
        named = {coordinates[key][0] if name == "p" and key in coordinates else key: value[key] for key in value}
        return _joined(arrays, named, name)
    (_, shape), *others = arrays
    if others or len(shape) < 2:
        return value
    array = real_array(value, name)
    whole = array.shape[-len(shape) :] == shape
    return array.reshape(*array.shape[: -len(shape)], -1) if whole and array.ndim != 1 else value


def shapes_of(interface: Interface) -> Shapes | None:
    """Return the names and shapes of the arrays of coordinates; ``None`` without arrays."""
    return coordinate_shapes(interface) if interface.arrays else None


def common_shape(shapes: Mapping[str, tuple[int, ...]]) -> tuple[int, ...]:
    """Return the shape of the states by name, of which one counts for all; StateError for two numbers of states."""
    if len(different := {*shapes.values()}) == 1:
        return different.pop()
    try:
        return np.broadcast_shapes(*different)
    except ValueError:
        pairs = combinations(shapes, 2)
        first, second = next(pair for pair in pairs if not _agree(*(shapes[name] for name in pair)))
        raise _different_states(shapes, first, second, ", or one for all") from None


def _agree(first: tuple[int, ...], second: tuple[int, ...]) -> bool:
    return all(m == n or 1 in (m, n) for m, n in zip(reversed(first), reversed(second), strict=False))


def _different_states(shapes: Mapping[str, tuple[int, ...]], first: str, second: str, remedy: str = "") -> StateError:
    has, other = (counted(math.prod(shapes[name]), "state") for name in (first, second))
    return StateError(f"{first} has {has} and {second} {other}: give as many of each{remedy}")


def _joined(arrays: Sequence[tuple[str, tuple[int, ...]]], by_name: Mapping[str, Any], label: str) -> Array:
    if len(by_name) == len(arrays):
        values: list[tuple[Any, tuple[int, ...]]] = [(by_name.get(name), shape) for name, shape in arrays]
        if all(type(x) is np.ndarray and x.dtype is BINARY64 and x.shape == shape for x, shape in values):
            return np.concatenate([x.reshape(-1) for x, _ in values])
    check_named(by_name, [name for name, _ in arrays], label)
    parts = []
    for name, shape in arrays:
        part = real_array(by_name[name], f"{label}: '{name}'")
        if part.shape[max(0, part.ndim - len(shape)) :] != shape:
            raise StateError(f"{label}: '{name}' must have the shape {shape}, not {part.shape}")
        parts.append(part.reshape(*part.shape[: part.ndim - len(shape)], math.prod(shape)))
    shapes = {f"{label}: '{name}'": part.shape[:-1] for (name, _), part in zip(arrays, parts, strict=True)}
    if len({*shapes.values()}) > 1:
        first, *others = shapes
        raise _different_states(shapes, first, next(name for name in others if shapes[name] != shapes[first]))
    return np.concatenate(parts, axis=-1)


def check_named(values: Mapping[str, object], names: Sequence[str], label: str, *, whole: bool = True) -> None:
    """Raise :class:`StateError` for a name that is unknown, or with ``whole`` missing."""
    for name in values:
        if name not in names:
            raise StateError(
                f"there is no '{name}' in {label}{closest(str(name), names)} Known: {', '.join(names) or 'none'}"
            )
    for name in names:
        if whole and name not in values:
            raise StateError(f"'{name}' is missing in {label}")


def coordinate_shapes(interface: Interface) -> list[tuple[str, tuple[int, ...]]]:
    """Return the name and shape of each array of coordinates; without arrays, each coordinate is one."""
    return [*_first_declared(interface.arrays or interface.coordinates, interface.dimension)]


@lru_cache(maxsize=256)
def _first_declared(declarations: Sequence[str], dimension: int) -> Shapes:
    coordinates, total = [], 0
    for name, shape in declared(declarations):
        if total < dimension:
            coordinates.append((name, shape))
            total += math.prod(shape)
    return coordinates


def declared(declarations: Sequence[str]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield the name and shape of each declaration; a single name has the shape ()."""
    yield from map(_declared, declarations)


@lru_cache(maxsize=256)
def _declared(declaration: str) -> tuple[str, tuple[int, ...]]:
    return declaration.partition("[")[0], tuple(map(int, re.findall(r"\d+", declaration.partition("[")[2])))


FEW = 64
SEQUENCES, NUMBERS = (list, tuple), frozenset((float, int, np.float64))
"""Types of short vectors, and of their entries, that are converted without NumPy."""
States = ArrayLike | Mapping[str, Any]
"""Positions, momenta or velocities: numbers in order, or arrays by name."""
Parameters = Mapping[str, Any] | Sequence[Any] | Array | None
"""Parameters, also arrays of known sizes, by name (others have their defaults), or all in order.

Of an ensemble a value by name may be one of all trajectories or one of each, and several rows are those of each.
"""


def is_vector(value: Any) -> bool:
    """Return whether a value is certainly a vector of real numbers, as most are: as quickly as possible."""
    if type(value) is np.ndarray:
        return value.ndim == 1 and value.dtype is BINARY64
    return type(value) in SEQUENCES and NUMBERS.issuperset(map(type, value))


def short_vector(value: Any, count: int) -> Array | None:
    """Return a copy of a short vector of finite numbers, faster than by NumPy's functions; else ``None``."""
    kind = type(value)
    try:
        if count > FEW:
            return None
        if kind is np.ndarray and value.dtype is BINARY64 and value.shape == (count,):
            return value.copy() if math.isfinite(sum(value.tolist())) else None
        if kind in SEQUENCES and 0 < len(value) == count and NUMBERS.issuperset(map(type, value)):
            return np.array(value, BINARY64) if math.isfinite(sum(value)) else None
    except OverflowError:  # of an integer above all floats
        pass
    return None


def parameter_values(interface: Interface, parameters: Parameters, base: Array | None = None) -> Array:
    """Return the (k,) parameter values in order; by default those of ``base``, or the defaults."""
    names, values = interface.parameters, np.array(interface.defaults if base is None else base, dtype=float)
    if isinstance(parameters, Mapping):
        for name, where, value in parameter_columns(interface, parameters):
            if isinstance(where, slice) and value.ndim > 1:
                raise StateError(f"the parameter {name} must have the shape of one state, not {value.shape}")
            values[where] = value if isinstance(where, slice) else checked_number(value, f"the parameter {name}")
    elif parameters is not None:
        array = _with_modes(interface, real_array(parameters, "parameters"))
        if array.shape != values.shape:
            listed = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
            raise StateError(f"parameters must have {len(values)} values ({listed or 'none'}), not {array.size}")
        values = array
    if not np.isfinite(values).all():
        worst = int(np.flatnonzero(~np.isfinite(values))[0])
        raise StateError(f"the parameter {names[worst]} is {values[worst]}: it must be finite")
    return values


def _with_modes(interface: Interface, values: Array) -> Array:
    """Return (.., k) parameters in order, with those of the modes of kinks, which may be omitted: they are 0."""
    if not (interface.modes or interface.contacts):
        return values
    modes = len(interface.mode_names)
    if modes and values.ndim and values.shape[-1] == len(interface.parameters) - modes:
        return np.concatenate([values, np.zeros((*values.shape[:-1], modes))], axis=-1)
    return values


def parameters_of_each(interface: Interface, argument: Parameters, count: int, defaults: Array) -> Array:
    """Return (k, number of parameters) values: defaults replaced by name, one or k numbers each, or by an array."""
    names = interface.parameters
    values = np.empty((count, len(defaults)))
    values[:] = defaults
    if isinstance(argument, Mapping):
        for name, where, value in parameter_columns(interface, argument):
            column = real_array(value, f"the parameter {name}")
            outer = column.shape[:-1] if isinstance(where, slice) else column.shape
            if outer not in ((), (count,)):
                raise StateError(
                    f"the parameter {name} must be one number or {count} numbers, not of shape {column.shape}"
                )
            values[:, where] = column
    elif argument is not None:
        array = _with_modes(interface, real_array(argument, "parameters"))
        if array.shape not in ((len(names),), (count, len(names))):
            raise StateError(f"parameters must have shape ({count}, {len(names)}), not {array.shape}")
        values[:] = array
    if not np.isfinite(values).all():
        j, i = (int(index[0]) for index in np.nonzero(~np.isfinite(values)))
        raise StateError(f"the parameter {names[i]} of trajectory {j} is {values[j, i]}: it must be finite")
    return values


def check_lengths(interface: Interface, values: Array, where: str = "") -> None:
    """Raise :class:`StateError` unless lengths of lists of neighbours are positive and periods two cutoffs or more.

    ``where`` follows the value in a message, as of which trajectory.
    """
    cutoffs: dict[str, tuple[str, float]] = {}
    for near, kind, formula in interface.lengths:
        length = _length(formula, interface.parameters, values)
        label = f"the {kind} of the neighbours '{near}'{where} is {formula}"
        label += "" if NUMBER.fullmatch(formula) else f" = {length:.15g}"
        if not 0 < length < math.inf:
            raise StateError(f"{label}: it must be a positive number")
        if kind == "cutoff":
            cutoffs[near] = formula, length
        elif kind == "box" and length < 2 * (cutoff := cutoffs[near])[1]:
            raise StateError(
                f"{label}: it must be at least two cutoffs, 2*({cutoff[0]}) = {2 * cutoff[1]:.15g}, since only the "
                "nearest image of a point counts. Enlarge the box or reduce the cutoff"
            )


def _length(formula: str, names: Sequence[str], values: Array) -> float:
    """Return the value of a formula of parameters; NaN where it is undefined."""
    if NUMBER.fullmatch(formula):
        return float(formula)
    if formula.isidentifier() and formula in names:
        return float(values[names.index(formula)])
    evaluate, used = evaluation(formula)
    try:
        return evaluate([float(values[names.index(name)]) for name in used])
    except ArithmeticError:
        return math.nan


@lru_cache(maxsize=64)
def evaluation(formula: str) -> tuple[Callable[[Sequence[float]], float], tuple[str, ...]]:
    """Return the function of a formula and the names of its arguments."""
    # imported here because SymPy is slow to import, and most lengths are parameters
    from scvi_codegen.common.precision import mp
    from scvi_codegen.systems.formulas.expressions import Tape
    from scvi_codegen.systems.formulas.grammar import parse_expression
    from scvi_codegen.systems.formulas.symbols import symbol

    used = tuple(sorted({*NAME_IN_FORMULA.findall(formula)} - {"pi"}))
    symbols = {name: symbol(name) for name in used}
    tape = Tape([parse_expression(formula, symbols)], list(symbols.values()))
    return lambda numbers: float(tape([mp.mpf(x) for x in numbers])[0]), used


def parameter_columns(interface: Interface, parameters: Mapping[str, Any]) -> Iterator[tuple[str, int | slice, Any]]:
    """Yield the name, the index and the value of each parameter; of an array the slice and its (.., size) entries.

    A number is the value of all entries of an array.
    """
    arrays = dict(declared(interface.arrays)) if interface.arrays else {}
    for name, value in parameters.items():
        shape = () if name in interface.parameters else arrays.get(name, ())
        if not shape:
            yield name, interface.parameter_index(name), value
            continue
        array = real_array(value, f"the parameter {name}")
        if array.ndim and array.shape[max(0, array.ndim - len(shape)) :] != shape:
            raise StateError(f"the parameter {name} must have the shape {shape}, not {array.shape}")
        size = math.prod(shape)
        first = interface.parameter_index("_".join([name, *("0" for _ in shape)])) if size else 0
        leading = array.shape[: array.ndim - len(shape)]
        yield name, slice(first, first + size), array.reshape(*leading, size) if array.ndim else array


def inputs_not_given(interface: Interface, parameters: Any) -> tuple[str, ...]:
    """Return the names of inputs that the parameters do not set; parameters in order set all."""
    if not interface.inputs or (parameters is not None and not isinstance(parameters, Mapping)):
        return ()
    return tuple(name for name in interface.inputs if f"{name}_0" not in (parameters or {}))


def check_inputs_given(interface: Interface, parameters: Any) -> None:
    """Raise :class:`StateError` if an input is not set."""
    if missing := inputs_not_given(interface, parameters):
        raise missing_input(missing[0])


def check_step_given(interface: Interface, parameters: Any) -> None:
    """Raise an error if inputs of a single step, or modes of its contacts, are not set; those in order set all."""
    check_inputs_given(interface, parameters)
    masks = [name for contact in interface.contacts for name in contact.masks]
    if masks and (parameters is None or (isinstance(parameters, Mapping) and parameters.keys().isdisjoint(masks))):
        raise ContactError(
            "single steps do not choose the modes of contacts: use the run integrate(.., h=h, steps=1), its "
            "multipliers(), sensitivity(), tangent and pullback, or set modes, as "
            f"parameters={{'{masks[0]}': 1}}, all of stepper.modes"
        )


def check_left_to_inputs(interface: Interface, parameters: Any) -> None:
    """Raise :class:`StateError` if named parameters belong to inputs given as data."""
    for k in columns_of_inputs(interface):
        if isinstance(parameters, Mapping) and (name := interface.parameters[k]) in parameters:
            raise StateError(f"the parameter {name} belongs to the input '{name[:-2]}', set by inputs=: omit it")


def missing_input(name: str) -> StateError:
    """Return the error for an input that is not set."""
    return StateError(
        f"the input '{name}' is not set: pass inputs={{'{name}': (t, values)}}, or a number for a constant, to "
        f"stepper.integrate, call run.set_inputs({name}=...), or give parameters={{'{name}_0': ...}}"
    )


def no_input(name: str, inputs: Collection[str]) -> StateError:
    """Return the error for an unknown input name."""
    if inputs:
        return StateError(f"{name!r} is not an input; the system has {', '.join(inputs)}{closest(name, inputs)}")
    return StateError(
        f"{name!r} is not an input: the system has none. Declare it by inputs=['{name}'] in the system definition"
    )


def columns_of_inputs(interface: Interface) -> list[int]:
    """Return the indices of the parameters of inputs: coefficients by power, and the breakpoint they refer to."""
    return [interface.parameters.index(f"{name}_{part}") for name in interface.inputs for part in "0123t"]
