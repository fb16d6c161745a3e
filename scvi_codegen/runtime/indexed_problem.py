"""What runs over arrays are of: sizes, tables and parameters, as C takes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

from numpy.typing import ArrayLike

from scvi_codegen.native.arguments import checked_number
from scvi_codegen.native.binding import Binding
from scvi_codegen.runtime.indexed_interface import IndexedInterface, Numbers, RunArrays, field_values, number_values
from scvi_codegen.runtime.inputs import inputs_not_given, no_input

__all__ = ["IndexedProblem"]


class IndexedProblem:
    """The C struct, and the arrays that it points to.

    Attributes:
        interface, binding: of the integrator.
        arrays: what it is made from; its state is that of the start.
        awaited: inputs that nobody gave: no step is made before.
        struct: of C.
    """

    def __init__(
        self, interface: IndexedInterface, binding: Binding, arrays: RunArrays, awaited: tuple[str, ...] = ()
    ) -> None:
        self.interface, self.binding, self.arrays, self.awaited = interface, binding, arrays, awaited
        self.struct = binding.new("problem *")
        for k, name in enumerate(interface.sizes):
            self.struct.size[k] = arrays.sizes[name]
        for k, array in enumerate(interface.fields):
            self.struct.field[k] = binding.pointer(arrays.fields[array.name].reshape(-1))
        for k, table in enumerate(interface.tables):
            self.struct.table[k] = binding.pointer(arrays.places[table.name].reshape(-1))
        for k, value in enumerate(arrays.numbers):
            self.struct.parameters[k] = value

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, self.binding, self.arrays, self.awaited)

    @property
    def count(self) -> int:
        """Of coordinates."""
        return int(self.binding.function("coordinates")(self.struct))

    @property
    def parameters(self) -> dict[str, Any]:
        """Numbers and arrays by name."""
        return self._numbers | self.arrays.fields

    @property
    def _numbers(self) -> dict[str, float]:
        return dict(zip(self.interface.parameters, self.arrays.numbers, strict=True))

    def with_parameters(self, given: Mapping[str, ArrayLike] | Sequence[float] | Numbers) -> Self:
        """The same with others: by name, the rest staying; or all numbers in order.

        Raises:
            StateError: for names, shapes and numbers that do not fit.
        """
        missing = inputs_not_given(self.interface, given)
        if not isinstance(given, Mapping):
            given = dict(zip(self.interface.parameters, given, strict=True))
        known = self.parameters | dict(given)
        fields = field_values(self.interface, known, self.arrays.sizes)
        numbers = number_values(self.interface, known)
        return self._with(replace(self.arrays, numbers=numbers, fields=fields), missing)

    def held(self, inputs: Mapping[str, float]) -> Self:
        """The same with inputs held at numbers.

        Raises:
            StateError: for a name that is no input.
        """
        values: dict[str, float] = {}
        for name, value in inputs.items():
            if name not in self.interface.inputs:
                raise no_input(name, self.interface.inputs)
            values |= {f"{name}_0": checked_number(value, f"the input {name}")}
            values |= {f"{name}_{part}": 0.0 for part in "123t"}
        numbers = number_values(self.interface, self._numbers | values)
        missing = tuple(name for name in self.awaited if name not in inputs)
        return self._with(replace(self.arrays, numbers=numbers), missing)

    def _with(self, arrays: RunArrays, missing: tuple[str, ...]) -> Self:
        """The same with other numbers, of which these inputs are not yet some."""
        awaited = tuple(name for name in self.awaited if name in missing)
        return type(self)(self.interface, self.binding, arrays, awaited)
