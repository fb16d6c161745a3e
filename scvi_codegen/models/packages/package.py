"""Generated folders: a complete integrator as C code for C programs, and as an importable package for Python.

    pendulum_svi/  pendulum_svi.h  pendulum_svi.c   the integrator, C99
                   support/                         headers, without alternatives that the integrator does not use
                   main.c  Makefile                 ``make run`` runs the example with a C compiler and libm
                   __init__.py  interface.json      ``import pendulum_svi`` provides ``pendulum_svi.stepper``
                   model.toml  README.md            the model file, and instructions

With arrays whose sizes are known at run time the C code is for all sizes; ``q.txt``, ``velocity.txt``, ``field_m.txt``,
.. contain the arrays that ``main.c`` reads, one number per line.

The name of the folder is the prefix of all C names. Importing it compiles the C code once, without SymPy.
``interface.json`` also contains a checksum of each file, so that edited files are not overwritten unless forced.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scvi_codegen.errors import PackageError
from scvi_codegen.models.packages.folders import (
    CERTIFICATE_FILE,
    INTERFACE_FILE,
    damaged,
    prefix_of,
    read_record,
    record_text,
    source_in,
    write_folder,
)
from scvi_codegen.rendering.source import Interface, check_interface
from scvi_codegen.runtime.core.compiled_method import Variants
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.core.validation import checked_parameters
from scvi_codegen.runtime.events.event import Event
from scvi_codegen.validation import ArgumentType, checks_arguments

if TYPE_CHECKING:
    from scvi_codegen.models.model import Model
    from scvi_codegen.rendering.program_source import Embedded

__all__ = ["CERTIFICATE_FILE", "MODEL", "MODEL_FILE", "generate_package", "load_package"]

MODEL_FILE = "model.toml"
ADVANCE_TO = "_advance_to("
"""Declaration in the header of an integrator with adaptive steps."""
MODEL = ArgumentType("a Model", lambda value: hasattr(value, "system") and hasattr(value, "method"))


@checks_arguments(model=MODEL)
def generate_package(
    model: Model,
    folder: str | os.PathLike[str],
    *,
    solver: str = "auto",
    force: bool = False,
    embedded: Embedded | None = None,
    single_file: bool = False,
) -> Path:
    """Write the integrator of a model into a folder, created if necessary; other files in it are not changed.

    Obsolete files of an older integrator, and the verification report of other code, are removed.

    Args:
        model: system, method, and the initial state and step size of the example. The code for arrays of run-time
            sizes is for run-time sizes, unless steps are adaptive.
        folder: target; its name becomes the prefix of the C names and the name of the Python package.
        solver: of the stage equations, as for ``compile_stepper``; by default that of the model.
        force: overwrite files of the same names that were edited or not generated.
        embedded: the precision, ``"double"`` or ``"single"``, of C for a microcontroller, without a Python package;
            arrays have the sizes of the model.
        single_file: include the support headers in the single source file instead of separate files.

    Returns:
        The folder.

    Raises:
        PackageError: if the name of the folder is invalid, it cannot be written, or a file in it would be lost.
        MethodError: for a solver that does not support the method, and for a number beyond single precision.
        StateError: if the initial velocities have no momenta, or cutoffs and boxes of neighbours are invalid.
    """
    target = Path(folder)
    prefix = prefix_of(target)
    model = model if solver == "auto" else replace(model, solver=solver)
    of_run_time_sizes = model.array_system is not None and model.h is not None and not embedded and not model.events
    write = _texts_of_arrays if of_run_time_sizes else _texts
    write_folder(target, write(model, prefix, embedded, single_file=single_file), force=force)
    return target


@checks_arguments()
def load_package(folder: str | os.PathLike[str]) -> Stepper:
    """Return the stepper of a generated folder, compiled from the C code in it (from the cache if that is unchanged).

    Raises:
        PackageError: if the folder lacks a file or was written by another version.
        BuildError: without a C compiler, or if compilation fails.
    """
    target, record = Path(folder), read_record(folder)
    try:
        if "__init__.py" not in record["files"]:
            raise PackageError(
                f"{target} was generated for a microcontroller: for Python generate it without --embedded"
            )
        if "interface" not in record:
            return _stepper_of_arrays(target)
        interface = Interface.from_record(record["interface"])
        events = tuple(Event(**table) for table in record.get("events", ()))
        source = source_in(target, interface.prefix)
        check_interface(source, interface)
    except PackageError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise damaged(target, error) from error
    variants = Variants({events: source}) if events else None
    return Stepper(replace(source, beside=None), interface, events=events, variants=variants)


def _stepper_of_arrays(folder: Path) -> Stepper:
    """Return the stepper of a folder with arrays whose sizes are known at run time; its model has their layout."""
    from scvi_codegen.models.model_files.model_file import load_model
    from scvi_codegen.pipeline import Sources

    model, prefix = load_model(folder / MODEL_FILE), prefix_of(folder)
    if model.array_system is None:
        raise damaged(folder, KeyError("interface"))
    interface = Sources(model.array_system, model.method, model.solver, prefix).interface
    return Stepper(source_in(folder, prefix), interface)


def _texts(model: Model, prefix: str, embedded: Embedded | None, *, single_file: bool) -> dict[str, str]:
    """Return texts by file name, ``interface.json`` last."""
    from scvi_codegen.models.model_files.model_file import model_texts
    from scvi_codegen.models.packages.example import example_of, package_template, readme_text
    from scvi_codegen.pipeline import generate_source
    from scvi_codegen.rendering.program_source import render_example

    written = model_texts(model if model.events else model.with_known_sizes())  # events may contain loops over arrays
    model = model.with_known_sizes()
    source, interface = generate_source(
        model.system,
        model.method,
        solver=model.solver,
        prefix=prefix,
        events=model.events,
        embedded=embedded,
        controlled=not embedded or model.h is None,
        time_transformation=model.time_transformation,
        controller=model.controller,
    )
    checked_parameters(interface, model.parameters)  # C does not check cutoffs and boxes
    source = source.single_file() if single_file else source.specialised()
    texts = source.files
    texts |= render_example(interface, example_of(model, controlled=ADVANCE_TO in source.header), embedded or "double")
    texts |= written
    texts["README.md"] = readme_text(
        interface, model.events, with_model=bool(written), embedded=embedded, controlled=ADVANCE_TO in source.header
    )
    if not embedded:
        texts["__init__.py"] = package_template("__init__.py")
    described: dict[str, Any] = {"interface": interface.to_record(), "declarations": source.declarations.split("\n")}
    if source.beside is not None:
        described["event_declarations"] = source.beside.declarations.split("\n")
        described["events"] = [event.table for event in model.events]
    return {**texts, INTERFACE_FILE: record_text(texts, **described)}


def _texts_of_arrays(model: Model, prefix: str, embedded: Embedded | None, *, single_file: bool) -> dict[str, str]:
    """Return the texts of a model whose array sizes are known at run time."""
    from scvi_codegen.models.model_files.model_file import model_texts
    from scvi_codegen.models.packages.example import array_example_of, package_template
    from scvi_codegen.pipeline import Sources
    from scvi_codegen.rendering.program_source import render_example

    assert model.array_system is not None  # by the caller
    source, interface = Sources(model.array_system, model.method, model.solver, prefix).integrator(controlled=False)
    scalars = {name: value for name, value in dict(model.parameters or {}).items() if name in interface.parameters}
    checked_parameters(interface, scalars)  # C does not check cutoffs and boxes; fields are checked with the sizes
    example, arrays = array_example_of(model, interface)
    lines = {f"{name}.txt": "".join(f"{x!r}\n" for x in each.reshape(-1).tolist()) for name, each in arrays.items()}
    source = source.single_file() if single_file else source.specialised()
    texts = {**source.files, **render_example(interface, example), **lines}
    if described := model_texts(model):
        texts |= {**described, "__init__.py": package_template("__init__.py")}
    about = {"title": interface.title, "sizes": model.sizes, "declarations": source.declarations.split("\n")}
    return {**texts, INTERFACE_FILE: record_text(texts, **about)}
