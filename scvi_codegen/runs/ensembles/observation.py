"""Extremes of states and energies, and counts of events, over all steps of an ensemble, without saving its states.

The source of the ensemble contains the observed functions (``templates/support/run/observation.h``), so they are
evaluated in SIMD lanes. States of a trajectory that has left its lane are included one by
one, by the same C function.
"""

from __future__ import annotations

from functools import cached_property
from typing import cast

import numpy as np

from scvi_codegen.codegen.ir.variants import Crossings, Energies, Extremes, Observing
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.common.errors import EventError, MethodError, StateError, closest
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.integrator import Integrator

OBSERVED = ("extremes", "energy", "events")
"""Values of ``observe=`` of ensembles."""
LAST, LEAST, LARGEST, RISES, FALLS = range(5)
"""Rows of :attr:`EnsembleObservation.values`."""


class EnsembleObservation:
    """Observed functions of all trajectories of an ensemble.

    Args:
        stepper: the integrator, with the events to count.
        name: one of :data:`OBSERVED`.
        count: number of trajectories k.

    Raises:
        StateError: for another name.
        EventError: without events, and for events that end runs or have conditions.
        MethodError: of a stepper that was loaded, and for velocities and energies without a formula.

    Attributes:
        source: of the ensemble.
        values: (5, number of functions, k) last, least and largest values, and numbers of rises and falls through 0.
    """

    def __init__(self, stepper: Integrator, name: str, count: int) -> None:
        if name not in OBSERVED:
            raise StateError(
                f"ensembles have no observer {name!r}{closest(str(name), OBSERVED)} Known: {', '.join(OBSERVED)}"
            )
        self.stepper, self.name = stepper, name
        source = stepper._variants[self._variant()]
        if source is None:
            raise MethodError(
                f"observe={name!r} is not available in ensembles of '{stepper.title}', which was loaded without their "
                "source: compile the system, or omit observe and save states"
            )
        self.source = source
        lanes = source.contents.lanes
        assert lanes is not None  # of an ensemble
        self.values = np.full((5, lanes.observed, count), np.nan)
        self.values[RISES:] = 0.0

    def _variant(self) -> Observing:
        """Return the variant of the method that computes the functions."""
        if self.name == "extremes":
            return Extremes()
        if self.name == "energy":
            return Energies()
        events = self.stepper.events
        for event in events:
            if event.terminal or event.conditions or event.loops:
                raise EventError(
                    f"observe='events' counts crossings of '{event.function}' at all times: omit terminal, where and "
                    "loops over elements, or record the events of each trajectory by integrate"
                )
        if not events:
            raise EventError("observe='events' counts the events of the stepper, which has none: use with_events(..)")
        return Crossings(tuple(str(event.function) for event in events))

    @cached_property
    def binding(self) -> Binding:
        """Library of the source, compiled on first use."""
        return Binding(building.load(self.source, flags=self.stepper.flags), self.source.prefix)

    def include(self, j: int, t: Array, q: Array, p: Array, parameters: Array) -> None:
        """Include the states (n,), (n, m), (n, m) of trajectory j."""
        binding = self.binding
        block = binding.new("block *")
        width, functions = len(block.active), self.values.shape[1]
        lanes = np.frombuffer(binding.buffer(block.parameters), dtype=np.float64).reshape(-1, width)
        lanes[: len(parameters)] = parameters[:, np.newaxis]
        seen = np.frombuffer(binding.buffer(block.observed), dtype=np.float64).reshape(5, functions, width)
        seen[:, :, 0] = self.values[:, :, j]
        binding.function("observe")(block, 0, len(t), *map(binding.pointer, map(np.ascontiguousarray, (t, q, p))))
        self.values[:, :, j] = seen[:, :, 0]

    def keep(self, part: slice, observed: Array) -> None:
        """Store ``observed`` of the result of a slice of the trajectories that was integrated elsewhere."""
        if self.name == "events":
            falls = np.array([event.direction < 0 for event in self.stepper.events])
            self.values[RISES, ~falls, part] = observed.T[~falls]
            self.values[FALLS, falls, part] = observed.T[falls]
        else:
            self.values[LEAST : LARGEST + 1, :, part] = np.atleast_3d(observed).swapaxes(1, 2)

    def result(self) -> Array:
        """Return ``observed`` of the result."""
        extremes = self.values[LEAST : LARGEST + 1].swapaxes(1, 2)
        if self.name == "extremes":
            return extremes
        if self.name == "energy":
            return cast(Array, extremes[:, :, 0])
        directions = np.array([event.direction for event in self.stepper.events])[:, np.newaxis]
        return np.asarray(self.values[RISES] * (directions >= 0) + self.values[FALLS] * (directions <= 0)).T
