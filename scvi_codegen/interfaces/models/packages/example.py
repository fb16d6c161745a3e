"""Example runs of generated folders and FMUs, with the model's initial state and output interval; README of folders."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from scvi_codegen.codegen.native.option_table import LOCATED
from scvi_codegen.codegen.rendering.environment import template_environment
from scvi_codegen.codegen.rendering.program_source import Embedded, ExampleArrays, ExampleRun
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.cache import template_folder
from scvi_codegen.common.errors import MethodWarning, ModelFileError, StateError, warn
from scvi_codegen.common.precision import mp
from scvi_codegen.interfaces.models.input_tables import tables_of_example
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.options import RUN_FIELDS
from scvi_codegen.runs.stepping.array_interface import read_state, table_limits
from scvi_codegen.runs.stepping.features import check_strict_energy, refusal
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.event import Event
from scvi_codegen.systems.formulas.expressions import evaluate
from scvi_codegen.systems.legendre.transform import equivalent_lagrangian
from scvi_codegen.systems.system import MechanicalSystem


def readme_text(
    interface: Interface,
    package: str,
    events: tuple[Event, ...],
    *,
    with_model: bool,
    embedded: Embedded | None,
    controlled: bool,
) -> str:
    """Return the text of ``README.md`` in the folder ``package``."""
    template = template_environment().get_template(f"package/README{'_embedded' if embedded else ''}.md.jinja")
    searched = interface.searched(events)
    of_model = {"contacts": interface.contacts, "kinks": interface.modes, "events": events}
    text = template.render(
        interface=interface,
        package=package,
        searched=searched,
        acting=any(event.changes_state for event in searched),
        what=" and ".join(name for name, parts in of_model.items() if parts),
        embedded=embedded,
        g=interface.time_transformation,
        real="float" if embedded == "single" else "double",
        with_model=with_model,
        controlled=controlled,
    )
    return text.rstrip("\n") + "\n"


def package_template(name: str) -> str:
    """Return a file of ``templates/package``."""
    return (template_folder() / "package" / name).read_text(encoding="utf-8")


OUTPUTS = 20
COMPARED = 1e-9
"""Tolerance of adaptive steps shown next to an example with a fixed step size."""


def check_example(model: Model, *, controlled: bool) -> None:
    """Raise an error for a model whose example cannot be derived; warn of options without effect in programs.

    ``controlled``: whether the C code has adaptive steps.
    """
    _check_options(model)
    if model.h is None and model.has_time_transformation:
        raise ModelFileError(
            "a step size in tau cannot be found for a tolerance without compiling: give one (--step, [run] step)"
        )
    if model.h is None and not controlled:
        raise refusal("adaptive", "without an error estimate", f"{model.method.name}, --step, [run] step")


def example_of(model: Model, interface: Interface, *, controlled: bool) -> ExampleRun:
    """Return the example run: the whole run of the model with twenty states after the first at most."""
    check_example(model, controlled=controlled)
    clock = model.system.clock
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
    tolerance = COMPARED if model.h is not None else model.tolerance or 0.0
    if model.time_transformation is not None and model.h is not None:
        tolerance = abs(model.h)  # the step size in tau
    save_every = math.ceil(steps / OUTPUTS)
    outputs = math.ceil(steps / save_every)
    if model.strict_energy:
        check_strict_energy(interface, by_steps=model.transitions != LOCATED)
    return ExampleRun(
        q=model.q,
        p=momenta,
        parameters=(*parameters, *(0.0 for _ in interface.mode_names)),
        t=model.t,
        h=model.h if model.time_transformation is None else None,
        span=model.covered,
        tolerance=tolerance,
        max_step=model.max_step,
        first_step=model.first_step,
        absolute_tolerances=model.absolute_tolerances(interface),
        controlled=controlled,
        save_every=save_every,
        outputs=outputs,
        last=steps - (outputs - 1) * save_every,
        to_end=bool(clock) and model.ends_at_time,
        inputs=inputs,
        end=model.end if inputs else 0.0,
        events=interface.searched(model.events),
        by_steps=model.transitions != LOCATED,
        strict_energy=model.strict_energy,
    )


def _check_options(model: Model) -> None:
    """Reject double-double arithmetic, and a controller of fixed steps; warn of options without effect in programs."""
    model._check_double("a generated program or FMU")
    model._check_controller()
    names = [option.key for option in RUN_FIELDS if option.solver_option and getattr(model, option.field) is not None]
    if names:
        warn(
            f"generated programs and FMUs use the default convergence criterion, not {' and '.join(names)} of [run]: "
            "pass them to the C functions as options",
            MethodWarning,
        )


def _momenta(model: Model, parameters: Sequence[float]) -> tuple[float, ...]:
    """Return the (m,) initial momenta from the velocities, in 60 digits, so that no C compiler is required."""
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


def array_example_of(model: Model, interface: Interface) -> tuple[ExampleRun, dict[str, Any]]:
    """Return the run of a model with array sizes known at run time, and its arrays by the name of their text file."""
    _check_options(model)
    problem = model.arrays(interface)
    files = {"q": _joined(problem.state)}
    moving = "p" if model.velocity is None else "velocity"
    if (state := getattr(model, moving)) is not None:
        files[moving] = _joined(read_state(interface, state, moving))
    fields = {f"field_{name}": values for name, values in problem.fields.items()}
    arrays = ExampleArrays(
        count=files["q"].size,
        sizes={name: problem.sizes[name] for name in interface.layout.sizes},
        fields={name: values.size for name, values in fields.items()},
        tables={
            f"table_{name}": (problem.places[name].size, limits)
            for name, limits in table_limits(interface, problem.sizes)
        },
        moving=moving if moving in files else "",
    )
    steps = model.whole_step_count()
    run = ExampleRun(
        q=(),
        p=(),
        parameters=tuple(problem.numbers),
        t=model.t,
        h=model.step,
        span=model.covered,
        tolerance=0.0,
        controlled=False,
        save_every=model.save_every,
        outputs=steps,
        arrays=arrays,
    )
    return run, {**files, **fields, **{f"table_{name}": values for name, values in problem.places.items()}}


def _joined(state: dict[str, Any]) -> Any:
    return np.concatenate([values.reshape(-1) for values in state.values()])
