"""Problem data of runs over arrays: sizes, tables and parameters in a C struct."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

from numpy.typing import ArrayLike

from scvi_codegen.native.arguments import checked_number
from scvi_codegen.native.binding import Binding
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import Numbers, RunArrays, field_values, number_values
from scvi_codegen.runtime.core.validation import inputs_not_given, no_input

__all__ = ["ArrayProblem"]


class ArrayProblem:
    """C struct of a problem and the arrays to which it points.

    Attributes:
        interface, binding: those of the integrator.
        arrays: the data of the problem; its state is the initial one.
        unset_inputs: inputs that are not set; steps require all inputs to be set.
        struct: the C struct.
    """

    def __init__(
        self, interface: Interface, binding: Binding, arrays: RunArrays, unset_inputs: tuple[str, ...] = ()
    ) -> None:
        self.interface, self.binding, self.arrays, self.unset_inputs = interface, binding, arrays, unset_inputs
        self.struct = binding.new("problem *")
        for k, name in enumerate(interface.layout.sizes):
            self.struct.size[k] = arrays.sizes[name]
        for k, array in enumerate(interface.layout.fields):
            self.struct.field[k] = binding.pointer(arrays.fields[array.name].reshape(-1))
        for k, table in enumerate(interface.layout.tables):
            self.struct.table[k] = binding.pointer(arrays.places[table.name].reshape(-1))
        for k, value in enumerate(arrays.numbers):
            self.struct.parameters[k] = value

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, self.binding, self.arrays, self.unset_inputs)

    @property
    def count(self) -> int:
        """Number of coordinates."""
        return int(self.binding.function("coordinates")(self.struct))

    @property
    def parameters(self) -> dict[str, Any]:
        """Scalar and array parameters by name."""
        return self._numbers | self.arrays.fields

    @property
    def _numbers(self) -> dict[str, float]:
        return dict(zip(self.interface.parameters, self.arrays.numbers, strict=True))

    def with_parameters(self, argument: Mapping[str, ArrayLike] | Sequence[float] | Numbers) -> Self:
        """Return the problem with other parameters: by name, the others unchanged; or all scalars in order.

        Raises:
            StateError: if a name, shape or number is invalid.
        """
        missing = inputs_not_given(self.interface, argument)
        if not isinstance(argument, Mapping):
            argument = dict(zip(self.interface.parameters, argument, strict=True))
        known = self.parameters | dict(argument)
        fields = field_values(self.interface, known, self.arrays.sizes)
        numbers = number_values(self.interface, known)
        return self._with(replace(self.arrays, numbers=numbers, fields=fields), missing)

    def with_constant_inputs(self, inputs: Mapping[str, float]) -> Self:
        """Return the problem with inputs set to constant values.

        Raises:
            StateError: if a name is no input.
        """
        values: dict[str, float] = {}
        for name, value in inputs.items():
            if name not in self.interface.inputs:
                raise no_input(name, self.interface.inputs)
            values |= {f"{name}_0": checked_number(value, f"the input {name}")}
            values |= {f"{name}_{part}": 0.0 for part in "123t"}
        numbers = number_values(self.interface, self._numbers | values)
        missing = tuple(name for name in self.unset_inputs if name not in inputs)
        return self._with(replace(self.arrays, numbers=numbers), missing)

    def _with(self, arrays: RunArrays, missing: tuple[str, ...]) -> Self:
        """Return the problem with other arrays, in which the inputs ``missing`` are still not set."""
        unset_inputs = tuple(name for name in self.unset_inputs if name in missing)
        return type(self)(self.interface, self.binding, arrays, unset_inputs)
