"""Systems of arrays with the sizes and the array parameters of a call."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.api.formulas import Array
from scvi_codegen.api.systems import ArraySystem, MechanicalSystem
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.rolling import unroll_sums


def unrolled_at(system: MechanicalSystem, q: Mapping[str, Any] | Any, parameters: Any = None) -> tuple[Any, Any]:
    """Return the system with the sizes and the array parameters of a call, and the other parameters.

    Of several states, whose arrays have one more axis, all have the sizes of the first; parameters of each are others.
    """
    if not isinstance(system, ArraySystem):
        return system, parameters
    if parameters is not None and not isinstance(parameters, Mapping):
        raise SystemDefinitionError("parameters of arrays of run-time sizes must be given by name")
    state = q if isinstance(q, Mapping) else {system.coordinates[0].name: q}
    arrays_by_name = {array.name: array for array in system.arrays}
    others = dict(parameters or {})
    arguments = (*state.items(), *others.items())
    declared = [(arrays_by_name[name], values) for name, values in arguments if name in arrays_by_name]
    sizes = {
        axis.name: length
        for array, values in declared
        for axis, length in zip(array.axes, np.shape(values)[_states_axes(array, values) :], strict=False)
        if axis.name
    }
    shared = [array.name for array, values in declared if np.ndim(values) and not _states_axes(array, values)]
    arrays = {name: others.pop(name) for name in shared if name in others}
    return unroll_sums(system, sizes, parameters=arrays), others


def _states_axes(array: Array, values: Any) -> int:
    """Return the number of axes of values before those of an array: 1 of several states, else 0."""
    shape = np.shape(values)
    of_matrices = array.letters == "wxyz" and shape[-2:] == (3, 3)
    return max(0, len(shape) - len(array.axes) - of_matrices)
