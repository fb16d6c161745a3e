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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from scvi_codegen.codegen.native.building import PORTABLE_FLAGS, TARGETS, library_for, load
from scvi_codegen.codegen.pipeline import generate_source
from scvi_codegen.codegen.rendering.program_source import ExampleRun, with_fmu
from scvi_codegen.codegen.rendering.source import Interface, Source
from scvi_codegen.common.atomic import write_atomically
from scvi_codegen.common.errors import ModelFileError, PackageError
from scvi_codegen.common.validation import TEXTS, checks_arguments
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.model_file import model_texts
from scvi_codegen.interfaces.models.packages.example import example_of
from scvi_codegen.interfaces.models.packages.package import MODEL, prefix_of
from scvi_codegen.systems.formulas.symbols import DOT, PARTS, TIME
from scvi_codegen.version import __version__

ENERGY, HELD = "energy", "input, held from one communication point to the next"
LOGGED = {"logStatusError": "why a call failed", "logStatusDiscard": "why a step was not taken"}
"""Categories of log messages."""
ABLE = {
    "canGetAndSetFMUState": "true",
    "canSerializeFMUState": "true",
    "canHandleVariableCommunicationStepSize": "true",
}


class Variable(NamedTuple):
    """Variable of the FMU, whose value reference is its index; without a description it is not exported.

    An output without a start value is computed from the others.
    """

    name: str
    causality: str
    variability: str
    description: str = ""
    start: float | None = None


def model_description(
    interface: Interface, start: ExampleRun, *, by_velocity: bool, token: str, has_events: bool = False
) -> str:
    """Return the text of ``modelDescription.xml``.

    Args:
        interface: of the integrator, whose prefix is the model identifier.
        start: initial state, with velocities in place of p if ``by_velocity``; parameters, time, span and step.
        by_velocity: whether initial velocities are variables with start values, instead of momenta.
        token: instantiation token.
        has_events: whether the FMU has an event mode.
    """
    root = Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=interface.system,
        description=" ".join(interface.title.split()),
        instantiationToken=token,
        generationTool=f"scvi-codegen {__version__}",
        variableNamingConvention="flat",
    )
    able = ABLE | {"hasEventMode": "true"} if has_events else ABLE
    SubElement(root, "CoSimulation", able, modelIdentifier=interface.prefix, fixedInternalStepSize=repr(start.h))
    categories = SubElement(root, "LogCategories")
    for name, description in LOGGED.items():
        SubElement(categories, "Category", name=name, description=description)
    end = start.t + start.span
    SubElement(root, "DefaultExperiment", startTime=repr(start.t), stopTime=repr(end), stepSize=repr(start.h))
    variables = list(enumerate(_variables(interface, start, by_velocity=by_velocity)))
    exported = [(index, variable) for index, variable in variables if variable.description]
    SubElement(root, "ModelVariables").extend(_element(index, variable) for index, variable in exported)
    structure = SubElement(root, "ModelStructure")
    outputs = [(str(index), variable) for index, variable in variables if variable.causality == "output"]
    for reference, _ in outputs:
        SubElement(structure, "Output", valueReference=reference)
    for reference, variable in outputs:
        if variable.start is None:
            SubElement(structure, "InitialUnknown", valueReference=reference)
    return _text(root)


def build_description(prefix: str, sources: Sequence[str]) -> str:
    """Return the text of ``sources/buildDescription.xml``: one shared library of these files, and libm."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=prefix)
    files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        SubElement(files, "SourceFile", name=name)
    SubElement(configuration, "Library", name="m", external="true")
    return _text(root)


def _variables(interface: Interface, start: ExampleRun, *, by_velocity: bool) -> Iterator[Variable]:
    """Yield the variables by reference, as in C: t, positions, velocities, momenta, the energy, parameters."""
    names = interface.coordinates
    nothing: Sequence[None] = (None,) * len(names)
    velocities, momenta = (start.p, nothing) if by_velocity else (nothing, start.p)
    taken = {TIME, *names, *(name + DOT for name in names), *interface.parameters, *interface.inputs}
    yield Variable(TIME, "independent", "continuous", "time")
    for name, value in zip(names, start.q, strict=True):
        yield Variable(name, "output", "continuous", f"coordinate {name}", value)
    for name, rate in zip(names, velocities, strict=True):
        yield Variable(name + DOT, "output", "continuous", f"velocity of {name}", rate)
    for name, momentum_name, momentum in zip(names, interface.momenta, momenta, strict=True):
        yield Variable(_free(momentum_name, taken), "output", "continuous", f"momentum of {name}", momentum)
    yield Variable(_free(ENERGY, taken), "output", "continuous", "energy")
    yield from _parameters(interface, start.parameters)


def _parameters(interface: Interface, values: Sequence[float]) -> Iterator[Variable]:
    """Yield the parameters; an input is one variable of its own name, and its other coefficients are hidden."""
    inputs: Mapping[str, str] = {f"{name}_0": name for name in interface.inputs}
    hidden = {f"{name}_{part}" for name in interface.inputs for part in "123t"}
    for name, value in zip(interface.parameters, values, strict=True):
        if name in inputs:
            yield Variable(inputs[name], "input", "continuous", HELD, value)
        else:
            yield Variable(name, "parameter", "tunable", "" if name in hidden else f"parameter {name}", value)


def _free(name: str, taken: set[str]) -> str:
    """Return the name, with underscores appended until it is unused, and mark it as used."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _element(reference: int, variable: Variable) -> Element:
    start_attributes = {} if variable.start is None else {"start": repr(variable.start)}
    if variable.causality == "output":
        start_attributes["initial"] = "calculated" if variable.start is None else "exact"
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "causality": variable.causality,
        "variability": variable.variability,
        "description": variable.description,
    }
    return Element("Float64", attributes | start_attributes)


def _text(root: Element) -> str:
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, encoding="unicode")}\n'


DESCRIPTION = "modelDescription.xml"
EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time stamp of every file in the archive, so that equal models produce equal bytes."""
PROCESSORS = {"amd64": "x86_64", "arm64": "aarch64", "i686": "x86", "i386": "x86"}
SYSTEMS = {"linux": "linux", "darwin": "darwin", "win32": "windows"}
SUFFIXES = {"darwin": ".dylib", "windows": ".dll"}
"""File suffixes of libraries other than .so."""


@checks_arguments(model=MODEL, platforms=TEXTS)
def generate_fmu(
    model: Model, path: str | os.PathLike[str], *, platforms: tuple[str, ...] = (), force: bool = False
) -> Path:
    """Write a model as an FMU 3.0 for co-simulation: a library for this machine, and the sources for others.

    Positions, velocities, momenta and the energy are outputs; parameters are tunable; inputs of the system are
    continuous inputs with zero-order hold between communication points. The step size is the model's if it divides the
    communication step, else the largest smaller one that does.

    Args:
        model: system, method, initial state, and the step size. Arrays have the sizes of the model.
        path: target file, ``<name>.fmu``; the name is the prefix of the C names.
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
    prefix = prefix_of(target.with_suffix(""), "FMU", target.suffix)
    _check(platforms)
    if not force:
        _refuse_to_lose(target)
    model = model.with_known_sizes()
    source, texts = _texts(model, prefix)
    libraries = {_library_path(_this_platform(), prefix): load(source, flags=PORTABLE_FLAGS).path.read_bytes()}
    for name in sorted({*platforms} - {_this_platform()}):
        libraries[_library_path(name, prefix)] = library_for(name, source, flags=PORTABLE_FLAGS)
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
    events = model.events if any(event.changes_state for event in model.events) else ()
    source, interface = generate_source(
        model.system, model.method, solver=model.solver, prefix=prefix, events=events or None
    )
    searched = interface.searched(events)
    settings = [(event.direction, int(event.terminal), int(event.changes_state)) for event in searched]
    by_velocity = model.velocity is not None
    start = _start(model, interface)
    indices = tuple(interface.parameters.index(f"{name}_{PARTS[0]}") for name in interface.inputs)
    made_from = "\0".join([__version__, source.to_json(), repr(interface.to_record()), repr(start)])
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, made_from)}}}"
    source = with_fmu(
        source, interface, start, by_velocity=by_velocity, input_indices=indices, token=token, events=settings
    )
    texts = {
        DESCRIPTION: model_description(
            interface, start, by_velocity=by_velocity, token=token, has_events=bool(searched)
        ),
        **{f"sources/{name}": text for name, text in source.files.items()},
        "sources/buildDescription.xml": build_description(prefix, [f"{part.prefix}.c" for part in source.sources]),
        **{f"resources/{name}": text for name, text in model_texts(model).items()},
    }
    return source, {name: text.encode() for name, text in texts.items()}


def _start(model: Model, interface: Interface) -> ExampleRun:
    """Return the initial state, with velocities or momenta as in the model, and the step size."""
    if any(event.terminal for event in model.events) and not any(event.changes_state for event in model.events):
        raise ModelFileError("events of an FMU must change the state: omit terminal ones, and stop in the importer")
    if interface.temperature is not None:
        raise ModelFileError("an FMU has no heat bath: omit temperature and noise in [system]")
    if model.h is None or model.has_time_transformation:
        raise ModelFileError(
            "an FMU requires a fixed step size in time: give a step h (--step, [run] step), without a time "
            "transformation"
        )
    if model.h < 0:
        raise ModelFileError(f"the step size of an FMU must be positive, not {model.h:g}")
    model._check_located("an FMU")
    start = example_of(replace(model, inputs={}), interface, controlled=False)
    return start if model.velocity is None else replace(start, p=model.velocity)


def _this_platform() -> str:
    """Return the platform of this machine, as FMI names it."""
    processor = platform.machine().lower()
    system = SYSTEMS.get(sys.platform, re.sub(r"\W", "", sys.platform))
    return f"{PROCESSORS.get(processor, processor)}-{system}"


def _library_path(platform: str, prefix: str) -> str:
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
