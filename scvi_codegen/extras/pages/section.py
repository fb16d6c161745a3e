"""Sections ``[page]`` and ``[picture]`` of model files: sliders, speed and plots of a page, and what is drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.api.commands import ModelSection
from scvi_codegen.common.errors import ModelFileError
from scvi_codegen.extras.pictures.shape import MARKS, DrawnSystem, entry_names, shape_of_picture
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.systems.hamiltonian import HamiltonianSystem

PAGE_KEYS = ("ranges", "speed", "plots")
PICTURE_KEYS = ("points", "fields", *MARKS)


def starts_from_momenta(model: Model) -> bool:
    """Return whether a page starts from momenta instead of velocities: of a Hamiltonian, and in transformed time."""
    if model.array_system is not None:
        return model.p is not None
    return model.in_transformed_time or (isinstance(model.system, HamiltonianSystem) and not model.system.rotations)


def slider_names(model: Model) -> list[str]:
    """Return the names of sliders: scalar parameters, inputs, coordinates without rotations, velocities or momenta."""
    names = [name for name, value in model.parameters.items() if np.ndim(value) == 0]
    names += model.system.inputs
    if model.array_system is not None or model.mesh is not None:
        return names
    turning = {name for rotation in model.system.rotations for name in rotation.coordinates}
    free = [coordinate.name for coordinate in model.system.coordinates if coordinate.name not in turning]
    if starts_from_momenta(model):
        momenta = getattr(model.system, "momenta", None) or [f"p_{name}" for name in free]
        return [*names, *free, *map(str, momenta)]
    return [*names, *free, *(f"{name}_dot" for name in free)]


def check_page(section: Mapping[str, Any], model: Model, where: str = "[page]") -> None:
    """Raise ModelFileError for unknown keys and sliders, and values of the wrong form.

    A range need not contain the value of its parameter, which options of the command line change, and names of plots
    are known when the page is made: see :func:`scvi_codegen.page`.
    """
    ModelSection.check_keys(section, PAGE_KEYS, "key", where)
    ranges = section.get("ranges", {})
    if not isinstance(ranges, dict):
        raise ModelFileError(f"{where} ranges must be a table, {{ v = [0.1, 0.9] }}, not {ranges!r}")
    ModelSection.check_keys(ranges, slider_names(model), "slider", f"{where} ranges")
    for name, limits in ranges.items():
        place = f"{where} ranges {name}"
        if not isinstance(limits, list | tuple) or len(limits) != 2:
            raise ModelFileError(f"{place} must be two numbers, [lowest, highest], not {limits!r}")
        low, high = (ModelSection.real(limit, place) for limit in limits)
        if not low < high:
            raise ModelFileError(f"{place} is {low:g} .. {high:g}: the first number must be less than the second")
    if ModelSection.real(section.get("speed", 1.0), f"{where} speed") <= 0:
        raise ModelFileError(f"{where} speed is {section['speed']:g}: it must be positive")
    plots: Any = section.get("plots", [])
    if not isinstance(plots, list | tuple) or not all(map(_is_pair_of_names, plots)):
        raise ModelFileError(f'{where} plots must be pairs of names, [["t", "energy"]], not {plots!r}')


def _is_pair_of_names(plot: Any) -> bool:
    return isinstance(plot, list | tuple) and len(plot) == 2 and all(isinstance(name, str) for name in plot)


def drawn_system_of_model(model: Model) -> DrawnSystem:
    """Return what formulas of a picture may use of a model: names of coordinates, momenta, parameters and rotations."""
    system = model.system
    if model.array_system is not None:
        shapes = {name: np.shape(values) for name, values in model.q.items()}
        return DrawnSystem(
            coordinates=entry_names(shapes),
            momenta=[],
            parameters=[name for name, value in model.parameters.items() if np.ndim(value) == 0],
            shapes=shapes,
            mesh=model.mesh,
            lengths=system.lengths,
            tables=model.tables,
        )
    shapes = {}
    for array in system.arrays:
        if sum(map(math.prod, shapes.values())) < system.dimension:
            shapes[array.name] = array.shape({})
    return DrawnSystem(
        coordinates=[coordinate.name for coordinate in system.coordinates],
        momenta=[momentum.name for momentum in system.momentum_symbols],
        parameters=[parameter.name for parameter in system.parameters],
        rotations=[rotation.declaration for rotation in system.rotations],
        shapes=shapes,
        mesh=model.mesh,
        links=system.drawn_links,
        lengths=system.lengths,
    )


def check_picture(model: Model) -> None:
    """Raise ModelFileError for mistakes in the section ``[picture]`` of a model."""
    if model.picture:
        shape_of_picture(drawn_system_of_model(model), model.picture, "[picture]")


page = ModelSection(keys=PAGE_KEYS, check=lambda model: check_page(model.page, model))
picture = ModelSection(keys=PICTURE_KEYS, check=check_picture)
