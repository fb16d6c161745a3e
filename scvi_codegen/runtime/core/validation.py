"""Validation of states and parameters against the interface of an integrator."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError, closest
from scvi_codegen.native.arguments import checked_number, real_array
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.core.named_arrays import declared, flat_state

Array = NDArray[np.float64]
BINARY64, FEW = np.dtype(np.float64), 64
States = ArrayLike | Mapping[str, ArrayLike]
"""Positions, momenta or velocities: numbers in order, or arrays by name."""
Parameters = Mapping[str, Any] | Sequence[float] | Array | None
"""Parameters, also arrays of known sizes, by name (others have their defaults), or all in order."""


class TakesInputs(Protocol):
    """Part of an interface that concerns inputs."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""

    @property
    def energy_parameter(self) -> str:
        """Name of the energy parameter of transformed time, or ""."""


def checked_vector(interface: Interface, value: States, name: str) -> Array:
    """Return a finite, contiguous (m,) copy; for one coordinate a number suffices."""
    if (
        type(value) is np.ndarray
        and value.dtype is BINARY64
        and value.shape == (len(interface.coordinates),)
        and len(value) <= FEW  # faster than NumPy's functions
        and math.isfinite(sum(value.tolist()))  # else an entry, or only the sum, is not finite
    ):
        return value.copy()
    array, coordinates = real_array(flat_state(interface, value, name), name), interface.coordinates
    if array.ndim == 0 and interface.dimension == 1:
        array = array.reshape(1)
    if array.shape != (interface.dimension,):
        names = ", ".join(coordinates[:6]) + (", ..." if interface.dimension > 6 else "")
        raise StateError(f"{name} must have shape ({interface.dimension},) for ({names}), not {array.shape}")
    if not np.isfinite(array).all():
        worst = int(np.flatnonzero(~np.isfinite(array))[0])
        raise StateError(f"{name}[{worst}] ({coordinates[worst]}) is {array[worst]}: it must be finite")
    return array


def checked_states(
    interface: Interface, q: States, p: States, t: ArrayLike, *, second: str = "p"
) -> tuple[Array, Array, Array]:
    """Return (n,) times and contiguous (n, m) positions and momenta (or what ``second`` names) of one or n states."""
    positions = real_array(flat_state(interface, q, "q"), "q")
    momenta = real_array(flat_state(interface, p, second), second)
    if positions.ndim <= 1:
        positions, momenta = checked_vector(interface, q, "q"), checked_vector(interface, p, second)
    elif positions.ndim != 2 or positions.shape != momenta.shape or positions.shape[1] != interface.dimension:
        raise StateError(
            f"states must have shape (n, {interface.dimension}), not q {positions.shape} and {second} {momenta.shape}"
        )
    count = positions.size // interface.dimension
    times = real_array(t, "the time t")
    if not np.isfinite(times).all():
        raise StateError("the time t must be finite")
    if times.shape not in ((), (count,)):
        raise StateError(f"the time t must be one number or {count}, one for each state, not of shape {times.shape}")
    times = np.ascontiguousarray(np.broadcast_to(times, (count,)))
    return times, np.ascontiguousarray(positions), np.ascontiguousarray(momenta)


def is_one_state(interface: Interface, q: States) -> bool:
    """Return whether these are the positions of one state, not of several."""
    plain = not isinstance(q, Mapping) and np.ndim(q) == 1
    return plain or np.ndim(flat_state(interface, q, "q")) == 1


def checked_parameters(interface: Interface, parameters: Parameters, base: Array | None = None) -> Array:
    """Return the (k,) parameter values in order; by default those of ``base``, or the defaults."""
    names, values = interface.parameters, np.array(interface.defaults if base is None else base, dtype=float)
    if parameters is None:
        return values
    if isinstance(parameters, Mapping):
        for name, where, value in parameter_columns(interface, parameters):
            if isinstance(where, slice) and value.ndim > 1:
                raise StateError(f"the parameter {name} must have the shape of one state, not {value.shape}")
            values[where] = value if isinstance(where, slice) else checked_number(value, f"the parameter {name}")
    else:
        array = real_array(parameters, "parameters")
        if array.shape != values.shape:
            known = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
            raise StateError(f"parameters must have {len(values)} values ({known or 'none'}), not {array.size}")
        values = array
    if not np.isfinite(values).all():
        worst = int(np.flatnonzero(~np.isfinite(values))[0])
        raise StateError(f"the parameter {names[worst]} is {values[worst]}: it must be finite")
    return values


def parameter_columns(interface: Interface, parameters: Mapping[str, Any]) -> Iterator[tuple[str, int | slice, Any]]:
    """Yield the name, the index and the value of each parameter; of an array the slice and its (.., size) entries.

    A number is the value of all entries of an array.
    """
    arrays = dict(declared(interface.arrays)) if interface.arrays else {}
    for name, value in parameters.items():
        shape = () if name in interface.parameters else arrays.get(name, ())
        if not shape:
            yield name, parameter_index(interface, name), value
            continue
        array = real_array(value, f"the parameter {name}")
        if array.ndim and array.shape[max(0, array.ndim - len(shape)) :] != shape:
            raise StateError(f"the parameter {name} must have the shape {shape}, not {array.shape}")
        size = math.prod(shape)
        first = parameter_index(interface, "_".join([name, *("0" for _ in shape)])) if size else 0
        leading = array.shape[: array.ndim - len(shape)]
        yield name, slice(first, first + size), array.reshape(*leading, size) if array.ndim else array


def inputs_not_given(interface: TakesInputs, parameters: Any) -> tuple[str, ...]:
    """Return the names of inputs that the parameters do not set; parameters in order set all."""
    if not interface.inputs or (parameters is not None and not isinstance(parameters, Mapping)):
        return ()
    return tuple(name for name in interface.inputs if f"{name}_0" not in (parameters or {}))


def check_inputs_given(interface: TakesInputs, parameters: Any) -> None:
    """Raise :class:`StateError` if an input is not set."""
    if missing := inputs_not_given(interface, parameters):
        raise missing_input(missing[0])


def check_left_to_inputs(interface: TakesInputs, parameters: Any) -> None:
    """Raise :class:`StateError` if named parameters belong to inputs given as data."""
    for k in columns_of_inputs(interface):
        if isinstance(parameters, Mapping) and (name := interface.parameters[k]) in parameters:
            raise StateError(f"the parameter {name} belongs to the input '{name[:-2]}', set by inputs=: omit it")


def missing_input(name: str) -> StateError:
    """Return the error for an input that is not set."""
    return StateError(
        f"the input '{name}' is not set: pass inputs={{'{name}': (t, values)}} to stepper.integrate, call "
        f"run.set_inputs({name}=...), or give parameters={{'{name}_0': ...}} for a constant"
    )


def no_input(name: str, inputs: Collection[str]) -> StateError:
    """Return the error for an unknown input name."""
    if inputs:
        return StateError(f"{name!r} is not an input; the system has {', '.join(inputs)}{closest(name, inputs)}")
    return StateError(
        f"{name!r} is not an input: the system has none. Declare it by inputs=['{name}'] in the system definition"
    )


def columns_of_inputs(interface: TakesInputs) -> list[int]:
    """Return the indices of the parameters of inputs: coefficients by power, and the breakpoint they refer to."""
    return [interface.parameters.index(f"{name}_{part}") for name in interface.inputs for part in "0123t"]


def parameter_index(interface: Interface, name: str) -> int:
    """Return the index of a parameter; raise ``StateError`` with the nearest name if unknown."""
    names = interface.parameters
    if name in names:
        return names.index(name)
    folded = {parameter.lower(): parameter for parameter in names}
    near = [folded[key] for key in difflib.get_close_matches(str(name).lower(), folded, 1)]
    if not names:
        raise StateError(f"there is no parameter {name!r}: '{interface.system}' has none. Declare it in its definition")
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise StateError(f"there is no parameter {name!r} among {', '.join(names)}{hint}")
