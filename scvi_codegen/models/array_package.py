"""Generated folders of array systems: C code, and a program that runs it from the initial state in files.

ring_svi/  ring_svi.h  ring_svi.c  support/         the integrator, for any number of coordinates
           main.c  Makefile                         ``make run`` runs it with a C compiler and libm
           q.txt  velocity.txt  field_m.txt  ..     arrays, one number per line
           model.toml  model_q.csv  ..              the model file, for ``scvi-codegen verify ring_svi``
           interface.json                           checksums, so that edited files are not overwritten
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scvi_codegen.models.array_document import model_texts
from scvi_codegen.models.array_model import ArrayModel
from scvi_codegen.models.folders import INTERFACE_FILE, record_text, write_folder
from scvi_codegen.models.generated_folders import prefix_of, source_in
from scvi_codegen.pipeline.sources import generate_array_source
from scvi_codegen.rendering.program_source import render_array_example
from scvi_codegen.runtime.arrays.interface import read_arrays, read_state, table_limits
from scvi_codegen.runtime.arrays.stepper import ArrayStepper
from scvi_codegen.validation.argument_types import PATH, SWITCH, checks_arguments, of

__all__ = ["generate_sums", "load_sums"]


@checks_arguments(model=of("an ArrayModel", ArrayModel), folder=PATH, force=SWITCH)
def generate_sums(model: ArrayModel, folder: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the integrator of a model of an array system into a folder, as :func:`generate_package` does.

    Raises:
        PackageError: if the folder's name is invalid, it cannot be written, or a file in it would be lost.
        MethodError: for a method without fixed-point iteration, and a solver that does not support it.
        StateError: for arrays of wrong shape.
    """
    target = Path(folder)
    source, interface = generate_array_source(model.system, model.method, solver=model.solver, prefix=prefix_of(target))
    problem = read_arrays(interface, model.q, model.parameters, model.tables)
    arrays = {"q": _flat(problem.state)}
    moving = "p" if model.velocity is None else "velocity"
    if (state := getattr(model, moving)) is not None:
        arrays[moving] = _flat(read_state(interface, state, moving))
    arrays |= {f"field_{name}": values for name, values in problem.fields.items()}
    arrays |= {f"table_{name}": values for name, values in problem.places.items()}
    example = render_array_example(
        source.prefix,
        title=interface.title,
        momenta=bool(interface.layout.momenta),
        numbers=problem.numbers,
        sizes={name: problem.sizes[name] for name in interface.layout.sizes},
        fields={f"field_{name}": values.size for name, values in problem.fields.items()},
        tables={
            f"table_{name}": (problem.places[name].size, limits)
            for name, limits in table_limits(interface, problem.sizes)
        },
        moving=moving if moving in arrays else "",
        constraints=bool(interface.layout.constraints),
        run={"t": model.t, "h": model.step, "steps": model.whole_step_count(), "save_every": model.save_every},
    )
    texts = {**source.files, **example, **{f"{name}.txt": _lines(values) for name, values in arrays.items()}}
    texts |= model_texts(model)
    described = {"title": interface.title, "sizes": problem.sizes, "declarations": source.declarations.split("\n")}
    write_folder(target, {**texts, INTERFACE_FILE: record_text(texts, **described)}, force=force)
    return target


def load_sums(folder: str | os.PathLike[str], model: ArrayModel) -> ArrayStepper:
    """Return the stepper of a generated folder of a model, compiled from the C code in it.

    Raises:
        PackageError: if the folder lacks a file or was written by another version.
    """
    target = Path(folder)
    prefix = prefix_of(target)
    _, interface = generate_array_source(model.system, model.method, solver=model.solver, prefix=prefix)
    return ArrayStepper(source_in(target, prefix), interface)


def _flat(state: Mapping[str, Any]) -> Any:
    return np.concatenate([values.reshape(-1) for values in state.values()])


def _lines(values: Any) -> str:
    return "".join(f"{value!r}\n" for value in values.reshape(-1).tolist())
