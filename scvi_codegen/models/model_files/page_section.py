"""Section ``[page]`` of model files: ranges of sliders, speed and plots of a page in the browser."""

from __future__ import annotations

from typing import Any

import numpy as np

from scvi_codegen.errors import ModelFileError
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_files.sections import Section, check_keys
from scvi_codegen.models.options import real

PAGE_KEYS = ("ranges", "speed", "plots")


def slider_names(model: Model) -> list[str]:
    """Return the names of sliders: scalar parameters, coordinates other than those of rotations, and velocities."""
    names = [name for name, value in model.parameters.items() if np.ndim(value) == 0]
    if model.array_system is not None or model.mesh is not None:
        return names
    turning = {name for each in model.system.rotations for name in each.coordinates}
    free = [each.name for each in model.system.coordinates if each.name not in turning]
    return [*names, *free, *(f"{name}_dot" for name in free)]


def check_page(section: Section, model: Model, where: str = "[page]") -> None:
    """Raise ModelFileError for unknown keys and sliders, and values of the wrong form.

    A range need not contain the value of its parameter, which options of the command line change, and names of plots
    are known when the page is made: see :func:`scvi_codegen.page`.
    """
    check_keys(section, PAGE_KEYS, "key", where)
    ranges = section.get("ranges", {})
    if not isinstance(ranges, dict):
        raise ModelFileError(f"{where} ranges must be a table, {{ v = [0.1, 0.9] }}, not {ranges!r}")
    check_keys(ranges, slider_names(model), "slider", f"{where} ranges")
    for name, limits in ranges.items():
        place = f"{where} ranges {name}"
        if not isinstance(limits, list | tuple) or len(limits) != 2:
            raise ModelFileError(f"{place} must be two numbers, [lowest, highest], not {limits!r}")
        low, high = (real(each, place) for each in limits)
        if not low < high:
            raise ModelFileError(f"{place} is {low:g} .. {high:g}: the first number must be less than the second")
    if real(section.get("speed", 1.0), f"{where} speed") <= 0:
        raise ModelFileError(f"{where} speed is {section['speed']:g}: it must be positive")
    plots: Any = section.get("plots", [])
    pairs = isinstance(plots, list | tuple) and all(isinstance(each, list | tuple) and len(each) == 2 for each in plots)
    if not pairs or not all(isinstance(name, str) for each in plots for name in each):
        raise ModelFileError(f'{where} plots must be pairs of names, [["t", "energy"]], not {plots!r}')
