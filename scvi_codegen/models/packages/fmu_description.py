"""XML descriptions of an FMU, ``modelDescription.xml`` and ``buildDescription.xml``, as specified by FMI 3.0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from scvi_codegen.formulas.symbols import DOT, TIME
from scvi_codegen.rendering.program_source import ExampleRun
from scvi_codegen.rendering.source import Interface
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


def model_description(interface: Interface, start: ExampleRun, *, by_velocity: bool, token: str) -> str:
    """Return the text of ``modelDescription.xml``.

    Args:
        interface: of the integrator, whose prefix is the model identifier.
        start: initial state, with velocities in place of p if ``by_velocity``; parameters, time, span and step.
        by_velocity: whether initial velocities are variables with start values, instead of momenta.
        token: instantiation token.
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
    SubElement(root, "CoSimulation", ABLE, modelIdentifier=interface.prefix, fixedInternalStepSize=repr(start.h))
    categories = SubElement(root, "LogCategories")
    for name, what in LOGGED.items():
        SubElement(categories, "Category", name=name, description=what)
    end = start.t + start.span
    SubElement(root, "DefaultExperiment", startTime=repr(start.t), stopTime=repr(end), stepSize=repr(start.h))
    variables = list(enumerate(_variables(interface, start, by_velocity=by_velocity)))
    SubElement(root, "ModelVariables").extend(_element(index, one) for index, one in variables if one.description)
    structure = SubElement(root, "ModelStructure")
    outputs = [(str(index), one) for index, one in variables if one.causality == "output"]
    for reference, _ in outputs:
        SubElement(structure, "Output", valueReference=reference)
    for reference, one in outputs:
        if one.start is None:
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
            yield Variable(
                inputs[name], "input", "continuous", "input, held from one communication point to the next", value
            )
        else:
            yield Variable(name, "parameter", "tunable", "" if name in hidden else f"parameter {name}", value)


def _free(name: str, taken: set[str]) -> str:
    """Return the name, with underscores appended until it is unused, and mark it as used."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _element(reference: int, one: Variable) -> Element:
    start_attributes = {} if one.start is None else {"start": repr(one.start)}
    if one.causality == "output":
        start_attributes["initial"] = "calculated" if one.start is None else "exact"
    attributes = {"name": one.name, "valueReference": str(reference), "causality": one.causality}
    return Element(
        "Float64", attributes | {"variability": one.variability, "description": one.description} | start_attributes
    )


def _text(root: Element) -> str:
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, encoding="unicode")}\n'
