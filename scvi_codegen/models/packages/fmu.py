"""Export of models as FMUs: co-simulation by FMI 3.0, for Modelica tools, Simulink, FMPy and others.

    pendulum.fmu   modelDescription.xml          variables, step size, capabilities
                   binaries/x86_64-linux/..      the library, compiled here, and those for requested platforms
                   sources/                      the integrator and FMI's functions, C99, for any other machine
                   resources/model.toml          the model file

The name of the file, without its suffix, is the prefix of all C names and the model identifier.
"""

from __future__ import annotations

import os
import platform
import re
import sys
import uuid
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO

from scvi_codegen.errors import ModelFileError, PackageError
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.formulas.symbols import PARTS
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_files.model_file import model_texts
from scvi_codegen.models.packages.example import example_of
from scvi_codegen.models.packages.fmu_description import build_description, model_description
from scvi_codegen.models.packages.generated_folders import prefix_of
from scvi_codegen.models.packages.package import MODEL
from scvi_codegen.native.building import PORTABLE_FLAGS, load
from scvi_codegen.native.cross import TARGETS, library_for
from scvi_codegen.pipeline import generate_source
from scvi_codegen.rendering.program_source import ExampleRun, with_fmu
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.validation import PATH, SWITCH, TEXT, TEXTS, checks_arguments
from scvi_codegen.version import __version__

DESCRIPTION = "modelDescription.xml"
EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time stamp of every file in the archive, so that equal models produce equal bytes."""
PROCESSORS = {"amd64": "x86_64", "arm64": "aarch64", "i686": "x86", "i386": "x86"}
SYSTEMS = {"linux": "linux", "darwin": "darwin", "win32": "windows"}
SUFFIXES = {"darwin": ".dylib", "windows": ".dll"}
"""File suffixes of libraries other than .so."""


@checks_arguments(model=MODEL, path=PATH, solver=TEXT, flags=TEXTS, platforms=TEXTS, force=SWITCH)
def generate_fmu(
    model: Model,
    path: str | os.PathLike[str],
    *,
    solver: str = "auto",
    flags: tuple[str, ...] = PORTABLE_FLAGS,
    platforms: tuple[str, ...] = (),
    force: bool = False,
) -> Path:
    """Write a model as an FMU 3.0 for co-simulation: a library for this machine, and the sources for others.

    Positions, velocities, momenta and the energy are outputs; parameters are tunable; inputs of the system are
    continuous inputs with zero-order hold between communication points. The step size is the model's if it divides the
    communication step, else the largest smaller one that does.

    Args:
        model: system, method, initial state, and the step size. Arrays have the sizes of the model.
        path: target file, ``<name>.fmu``; the name is the prefix of the C names.
        solver: of the stage equations, as for ``compile_stepper``; by default that of the model.
        flags: for the C compiler; by default those with bitwise equal results on all processors of a kind.
        platforms: further platforms of libraries, as FMI names them: ``x86_64-windows``, ``aarch64-darwin``, ..
        force: overwrite a file that is not an FMU.

    Returns:
        The path.

    Raises:
        ModelFileError: for a model with adaptive steps, a negative step size or a time transformation.
        PackageError: for an invalid name, or if the file cannot be written or is not an FMU.
        MethodError: for a solver that does not support the method.
        BuildError: without a C compiler, or for further platforms without the extra ``compiler``.
    """
    target = Path(path)
    if target.suffix != ".fmu":
        raise PackageError(f"the name of an FMU must end with .fmu, as in {target.name or 'model'}.fmu")
    prefix = prefix_of(target.with_suffix(""))
    _check(platforms)
    if not force:
        _refuse_to_lose(target)
    model = (model if solver == "auto" else replace(model, solver=solver)).with_known_sizes()
    source, texts = _texts(model, prefix)
    libraries = {_library_path(_this_platform(), prefix): load(source, flags=flags).path.read_bytes()}
    for name in sorted({*platforms} - {_this_platform()}):
        libraries[_library_path(name, prefix)] = library_for(name, source, flags=flags)
    try:
        write_atomically(target, lambda file: _write(texts | libraries, file))
    except OSError as error:
        raise PackageError(f"{target} cannot be written: {error.strerror or error}") from error
    return target


def _check(platforms: tuple[str, ...]) -> None:
    for name in platforms:
        if name not in TARGETS:
            raise PackageError(f"{name!r} is not a platform of FMUs; use one of {', '.join(TARGETS)}")


def _texts(model: Model, prefix: str) -> tuple[Source, dict[str, bytes]]:
    """Return the source to compile, and the archive's text files by name."""
    source, interface = generate_source(model.system, model.method, solver=model.solver, prefix=prefix)
    by_velocity = model.velocity is not None
    start = _start(model)
    indices = tuple(interface.parameters.index(f"{name}_{PARTS[0]}") for name in interface.inputs)
    token = _token(source.to_json(), interface, start)
    source = with_fmu(source, interface, start, by_velocity=by_velocity, input_indices=indices, token=token)
    texts = {
        DESCRIPTION: model_description(interface, start, by_velocity=by_velocity, token=token),
        **{f"sources/{name}": text for name, text in source.files.items()},
        "sources/buildDescription.xml": build_description(prefix, [f"{each.prefix}.c" for each in source.sources]),
        **{f"resources/{name}": text for name, text in model_texts(model).items()},
    }
    return source, {name: text.encode() for name, text in texts.items()}


def _start(model: Model) -> ExampleRun:
    """Return the initial state, with velocities or momenta as in the model, and the step size."""
    if model.h is None or model.has_time_transformation:
        raise ModelFileError(
            "an FMU requires a fixed step size in time: give a step h (--step, [run] step), without a time "
            "transformation"
        )
    if model.h < 0:
        raise ModelFileError(f"the step size of an FMU must be positive, not {model.h:g}")
    start = example_of(replace(model, inputs={}), controlled=False)
    return start if model.velocity is None else replace(start, p=model.velocity)


def _token(text: str, interface: Interface, start: ExampleRun) -> str:
    """Return the instantiation token, a hash of everything that determines library and description."""
    made_from = "\0".join([__version__, text, repr(interface.to_record()), repr(start)])
    return f"{{{uuid.uuid5(uuid.NAMESPACE_URL, made_from)}}}"


def _this_platform() -> str:
    """Return the platform of this machine, as FMI names it."""
    processor = platform.machine().lower()
    system = SYSTEMS.get(sys.platform, re.sub(r"\W", "", sys.platform))
    return f"{PROCESSORS.get(processor, processor)}-{system}"


def _library_path(platform: str, prefix: str) -> str:
    """Return the path of a library in the archive."""
    return f"binaries/{platform}/{prefix}{SUFFIXES.get(platform.rpartition('-')[2], '.so')}"


def _refuse_to_lose(target: Path) -> None:
    """Raise :class:`PackageError` if the target exists and is not an FMU."""
    if target.exists() and not (zipfile.is_zipfile(target) and DESCRIPTION in zipfile.ZipFile(target).namelist()):
        raise PackageError(
            f"{target} exists and is not an FMU: choose another name, or overwrite it with --force (force=True)"
        )


def _write(files: Mapping[str, bytes], file: IO[bytes]) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, EPOCH)
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
