"""Generated folders: a complete integrator as C code for C programs, and as an importable package for Python.

    pendulum_svi/  pendulum_svi.h  pendulum_svi.c   the integrator, C99
                   support/                         headers, the same for every integrator except for the tables of
                                                    adaptive steps
                   main.c  Makefile                 ``make run`` runs the example with a C compiler and libm
                   __init__.py  interface.json      ``import pendulum_svi`` provides ``pendulum_svi.stepper``
                   model.toml  README.md            the model file, and instructions

The name of the folder is the prefix of all C names. Importing it compiles the C code once, without SymPy.
``interface.json`` also contains a checksum of each file, so that edited files are not overwritten unless forced.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from scvi_codegen.errors import MethodError, ModelFileError, PackageError, StateError
from scvi_codegen.models.folders import CERTIFICATE_FILE, INTERFACE_FILE, record_text, write_folder
from scvi_codegen.models.generated_folders import damaged, prefix_of, read_record, source_in
from scvi_codegen.rendering.source import Interface, Source, check_interface
from scvi_codegen.runtime.core.compiled_method import Variants
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.validation.argument_types import PATH, SWITCH, TEXT, ArgumentType, checks_arguments

if TYPE_CHECKING:
    from scvi_codegen.mechanics.system import MechanicalSystem
    from scvi_codegen.models.array_model import ArrayModel
    from scvi_codegen.models.model import Model
    from scvi_codegen.rendering.program_source import Embedded, ExampleRun

__all__ = ["CERTIFICATE_FILE", "MODEL", "example_of", "generate_package", "load_package", "model_text"]

OUTPUTS = 20
COMPARED = 1e-9
"""Tolerance of adaptive steps shown next to an example with a fixed step size."""
ADVANCE_TO = "_advance_to("
"""Declaration in the header of an integrator with adaptive steps."""


EITHER_MODEL = ArgumentType("a Model", lambda value: hasattr(value, "system") and hasattr(value, "method"))
MODEL = ArgumentType("a Model", lambda value: EITHER_MODEL.accepts(value) and not hasattr(value, "REQUIRES_SIZES"))


@checks_arguments(model=EITHER_MODEL, folder=PATH, solver=TEXT, force=SWITCH)
def generate_package(
    model: Model | ArrayModel,
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
        model: system, method, and the initial state and step size of the example. With arrays of run-time sizes the
            folder has C code for any sizes and the initial state as text files, but no Python package.
        folder: target; its name becomes the prefix of the C names and the name of the Python package.
        solver: of the stage equations, as for ``compile_stepper``.
        force: overwrite files of the same names that were edited or not generated.
        embedded: the precision, ``"double"`` or ``"single"``, of C for a microcontroller, without a Python package.
        single_file: include the support headers in the single source file instead of separate files.

    Returns:
        The folder.

    Raises:
        PackageError: if the name of the folder is invalid, it cannot be written, or a file in it would be lost.
        MethodError: for a solver that does not support the method, and for a number beyond single precision.
        StateError: if the initial velocities have no momenta.
    """
    target = Path(folder)
    from scvi_codegen.models.array_model import ArrayModel  # imported here: folders are loaded without SymPy

    if isinstance(model, ArrayModel):
        from scvi_codegen.models.array_package import generate_sums

        if embedded or single_file:
            option = "embedded" if embedded else "single_file"
            raise MethodError(f"{option} of generate_package() is not available for this model: {model.REQUIRES_SIZES}")
        return generate_sums(model if solver == "auto" else replace(model, solver=solver), folder, force=force)
    prefix = prefix_of(target)
    write_folder(target, _texts(model, prefix, solver, embedded, single_file=single_file), force=force)
    return target


@checks_arguments(folder=PATH)
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
        interface = Interface.from_json(json.dumps(record["interface"]))
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, PackageError):
            raise
        raise damaged(target, error) from error
    source = source_in(target, interface.prefix)
    try:
        check_interface(source, interface)
    except ValueError as error:
        raise damaged(target, error) from error
    controlled = source if ADVANCE_TO in source.declarations else None
    return Stepper(source, interface, variants=Variants({"controlled": controlled}))


def _texts(model: Model, prefix: str, solver: str, embedded: Embedded | None, *, single_file: bool) -> dict[str, str]:
    """Return texts by file name, ``interface.json`` last."""
    from scvi_codegen.pipeline.sources import generate_source
    from scvi_codegen.rendering.program_source import render_example

    source, interface = generate_source(
        model.system,
        model.method,
        solver=solver,
        prefix=prefix,
        embedded=embedded,
        controlled=not embedded or model.h is None,
        time_transformation=model.time_transformation,
    )
    if single_file:
        source = source.amalgamated()
    texts = source.files
    texts |= render_example(interface, example_of(model, controlled=ADVANCE_TO in source.header), embedded or "double")
    described = model_text(model)
    if described is not None:
        texts["model.toml"] = described
    texts["README.md"] = _readme(
        interface, with_model=described is not None, embedded=embedded, controlled=ADVANCE_TO in source.header
    )
    if not embedded:
        texts["__init__.py"] = _template("__init__.py")
    return {**texts, INTERFACE_FILE: _interface_text(source, interface, texts)}


def example_of(model: Model, *, controlled: bool) -> ExampleRun:
    """Return the example run: the whole run of the model with about twenty lines of output at most."""
    from scvi_codegen.models.input_tables import tables_of_example
    from scvi_codegen.rendering.program_source import ExampleRun

    clock = model.system.clock
    if model.h is None and (clock or model.time_transformation is not None):
        raise ModelFileError(
            "a step size in tau cannot be found for a tolerance without compiling: give one (--step, [run] step)"
        )
    if model.h is None and not controlled:
        raise MethodError(
            f"adaptive steps are unavailable for {model.method.name} and this system: give a step h "
            "(--step, [run] step)"
        )
    inputs_by_name = model.all_inputs() if model.inputs else {}
    inputs, parameters = tables_of_example(
        model.system, inputs_by_name, (model.t, model.end if inputs_by_name else model.t)
    )
    momenta = model.p if model.p is not None else _momenta(model, parameters)
    if clock and model.ends_at_time:
        steps = max(1, round(model.covered / (model.step * float(_rate(model.system, model.q, momenta)))))
    else:
        count = OUTPUTS if model.h is None or model.time_transformation is not None else None
        steps = count or max(1, model.step_count if model.system.inputs else model.whole_step_count())
    save_every = max(1, steps // OUTPUTS)
    return ExampleRun(
        q=model.q,
        p=momenta,
        parameters=parameters,
        t=model.t,
        h=model.h if model.time_transformation is None else None,
        span=model.covered,
        tolerance=_chosen_by(model),
        controlled=controlled,
        save_every=save_every,
        outputs=steps // save_every,
        to_end=bool(clock) and model.ends_at_time,
        inputs=inputs,
        end=model.end if inputs else 0.0,
    )


def _chosen_by(model: Model) -> float:
    """Return the tolerance of adaptive steps, or the step size in tau."""
    if model.time_transformation is not None and model.h is not None:
        return abs(model.h)
    return COMPARED if model.h is not None else model.tolerance or 0.0


def _momenta(model: Model, parameters: Sequence[float]) -> tuple[float, ...]:
    """Return the (m,) initial momenta from the velocities, in 60 digits, so that no C compiler is required."""
    from scvi_codegen.formulas.tape import evaluate
    from scvi_codegen.mechanics.derived_expressions import forms_of
    from scvi_codegen.mechanics.legendre import equivalent_lagrangian
    from scvi_codegen.tables.precision import mp

    system = equivalent_lagrangian(model.system)
    if system is None:
        raise StateError("velocities do not determine the momenta of this Hamiltonian: give p, not q_dot")
    rate = _rate(system, model.q, ()) if system.clock else 1.0
    symbols = (*system.coordinates, *system.velocities, system.time, *system.parameters)
    numbers = (*model.q, *(rate * mp.mpf(v) for v in model.velocity or ()), model.t, *parameters)
    point = dict(zip(symbols, map(mp.mpf, numbers), strict=True))
    try:
        return tuple(float(evaluate(expression, point)) for expression in forms_of(system).momentum)
    except ArithmeticError as error:
        raise StateError(f"the initial velocities have no momenta: {error}") from error


def _rate(system: MechanicalSystem, q: Sequence[float], p: Sequence[float]) -> Any:
    """Return dt/dtau at a state, in 60 digits."""
    from scvi_codegen.formulas.tape import evaluate
    from scvi_codegen.tables.precision import mp

    assert system.clock is not None
    symbols = (*system.coordinates, *system.auxiliaries, *system.parameters)
    numbers = (*q, *(p if system.auxiliaries else ()), *system.defaults)
    try:
        rate = evaluate(system.clock.rate, dict(zip(symbols, map(mp.mpf, numbers), strict=True)))
    except ArithmeticError as error:
        raise StateError(f"the time transformation has no value at the initial state: {error}") from error
    if not rate > 0:
        raise StateError(f"the time transformation is {float(rate):g} at the initial state: it must be positive")
    return rate


CLOCK = """
Time is transformed: steps `h` are of tau, dt = g dtau and `t` is integrated along. The parameter
`${energy}` is the energy of the initial state; `main.c` shows how it is set.
"""


def model_text(model: Model) -> str | None:
    """Return the model file, or ``None`` for a method that a file cannot represent (a user-defined quadrature)."""
    from scvi_codegen.models.model_file import dump_model

    try:
        return dump_model(model)
    except ModelFileError:
        return None


CONTROL = """By adaptive steps, each with a relative error of `tolerance` (0: round-off), to `t_end`:

```c
static ${prefix}_run run;
${prefix}_start(&run, t, 0.0, q0, p0);
int status = ${prefix}_advance_to(&run, t_end, tolerance, most_steps, most_steps, parameters, NULL, &t, q, p,
    &iterations, &report, workspace); /* there, if run.t == t_end and run.t_low == 0: the state is in run.q and run.p */
```
"""


DENSITY = """By steps of `tau` in a time with dt = g dtau, g = ${g}, the same forward and backward, to `t_end`:

```c
static ${prefix}_run run;
${prefix}_start(&run, t, 0.0, q0, p0);
int status = ${prefix}_advance_to(&run, t_end, tau, most_steps, most_steps, parameters, NULL, &t, q, p,
    &iterations, &report, workspace); /* there, if run.t == t_end and run.t_low == 0: the state is in run.q and run.p */
```
"""


INPUTS = """
Inputs ($inputs) are tables, `${prefix}_input` each. Steps end at their breakpoints; until `t_end`:

```c
for (long long steps; (steps = ${prefix}_next_steps(&run, t_end, h, inputs, parameters)) > 0;)
  status = ${prefix}_advance(&run, steps, save_every, parameters, NULL, t, q, p, iterations, &report, workspace);
```
"""


def _further(text: str, interface: Interface) -> str:
    """Return an optional part of the README."""
    inputs = ", ".join(f"`{name}`" for name in interface.inputs)
    return Template(text).substitute(prefix=interface.prefix, inputs=inputs, g=interface.time_transformation)


def _readme(interface: Interface, *, with_model: bool, embedded: Embedded | None, controlled: bool) -> str:
    defaults = zip(interface.parameters, interface.defaults, strict=True)
    listed = ", ".join(f"`{name}` ({value!r})" for name, value in defaults)
    advance, to_end = (DENSITY, "h=tau, t_end=t_end") if interface.time_transformation else (CONTROL, "t_end=t_end")
    return (
        Template(_template("README_embedded.md" if embedded else "README.md"))
        .substitute(
            real="float" if embedded == "single" else "double",
            prefix=interface.prefix,
            macro=interface.prefix.upper(),
            title=" ".join(interface.title.split()),
            notes=", ".join(interface.notes),
            coordinates=", ".join(f"`{name}`" for name in interface.coordinates),
            parameters=(f"Parameters, with default values: {listed}." if listed else "There are no parameters.")
            + Template(CLOCK if interface.energy_parameter else "").substitute(energy=interface.energy_parameter),
            control=_further(advance * controlled + INPUTS * bool(interface.inputs), interface),
            integrate=f"\ntrajectory = {interface.prefix}.stepper.integrate(q0, p0, {to_end})" if controlled else "",
            origin="`model.toml` is what it was generated from." if with_model else "",
        )
        .rstrip("\n")
        + "\n"
    )


def _template(name: str) -> str:
    from scvi_codegen.files.templates import template_folder

    return (template_folder() / "package" / name).read_text(encoding="utf-8")


def _interface_text(source: Source, interface: Interface, texts: Mapping[str, str]) -> str:
    described = {"interface": json.loads(interface.to_json()), "declarations": source.declarations.split("\n")}
    return record_text(texts, **described)
