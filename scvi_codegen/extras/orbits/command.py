"""Command ``scvi-codegen family``: a family of periodic orbits, by energy or along a parameter."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np

from scvi_codegen.api.commands import check_writable, model_arguments, part, progress_bar, read_model, reporting, tell
from scvi_codegen.api.text import counted
from scvi_codegen.common.errors import ModelFileError
from scvi_codegen.extras.orbits import family as families
from scvi_codegen.extras.orbits.continuation import Formula
from scvi_codegen.extras.orbits.equilibrium import Equilibrium, equilibrium
from scvi_codegen.extras.orbits.solver import PeriodicOrbit, periodic_orbit
from scvi_codegen.extras.pictures.services import check_picture
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.runs.stepper import Stepper

NAMES, COUNT = {"vary": "parameter", "stride": "step"}, 50
"""Arguments of the function with other names here, and the largest number of orbits."""
OF_START = (
    *("parameter", "q", "p", "velocity", "keyframe", "time"),
    *("amplitude", "mode", "period", "vary", "fixed", "reversor", "backward", "stride"),
)
"""Options of the first orbit, which the file of a family contains."""


@click.command()
@model_arguments("solver", "family")
@click.option("--resume", type=click.Path(), metavar="FILE", help="Continue a family that -o wrote.")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="Orbits: .npz.")
@click.option("--plot", type=click.Path(), metavar="FILE", help="Plot (.png, .svg, .pdf).")
@click.option("--page", type=click.Path(), metavar="FILE", help="Page with a slider along the family (.html).")
@reporting
def family(model_name: str, resume: str | None, output: str | None, plot: str | None, **choices: Any) -> None:
    """Continue a family of periodic orbits of MODEL, and locate its bifurcations.

    The family begins at an orbit near the initial state of MODEL (--period), or at the equilibrium near its positions
    (--amplitude). It is one by energy, or along a parameter (--vary). After Ctrl-C the orbits so far are written.

    \b
    Examples:
      scvi-codegen family planar-pendulum --q 0 --amplitude 0.1 --count 20 --plot pendulum.png
      scvi-codegen family henon-heiles --q 0,0.9 --amplitude 0.01 --until 'energy > 0.2' -o family.npz
    """
    if resume is not None:
        _check_resumed(click.get_current_context())
    page = choices.pop("page")
    for target in (output, plot, page):
        if target is not None:
            check_writable(Path(target), "'-o', '--plot', '--page'")
    if output is not None and Path(output).suffix != ".npz":
        raise ModelFileError(f"orbits of a family are saved as .npz, not as '{output}'")
    if plot is not None:
        check_picture(plot)
    model = read_model(model_name, choices, unused=_unused).with_known_sizes("family")
    with progress_bar(model.family.get("count", COUNT), "orbits") as progress:
        members = _members(model, resume, progress)
    tell(_described(members), **_numbers(members))
    moving = part("services", "page")(model, family=members) if page else members
    for target, write in ((output, members.save), (plot, members.plot), (page, moving.save)):
        if target is not None:
            write(target)
            tell(f"wrote {target}")
    if written := [target for target in (output, plot, page) if target]:
        tell(written=written)


def _unused(document: Any) -> tuple[str, ...]:
    """Return what families do not use: a duration, and near an equilibrium a velocity."""
    settings = document.get("family", {})
    return ("span", "q_dot") if "amplitude" in settings and "period" not in settings else ("span",)


def _check_resumed(context: click.Context) -> None:
    for name in OF_START:
        if context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT:
            defines = "the file defines the family; give --count or --until"
            raise click.UsageError(f"--{name.replace('_', '-')} is not allowed with --resume: {defines}")


def _members(model: Model, resume: str | None, progress: Callable[[int], None]) -> families.Family:
    """Return the family of a model, or that of a file with further orbits."""
    stepper, settings = model.stepper(), {"count": COUNT} | {NAMES.get(key, key): x for key, x in model.family.items()}
    if resume is not None:
        further = {key: settings[key] for key in ("count", "until") if key in settings}
        return families.Family.load(stepper, resume).more(**further, progress=progress)
    text = settings.pop("period", None)
    period = None if text is None else Formula.of(text, stepper.parameters)
    varies = period is not None and settings.get("parameter") in {str(name) for name in period.expression.free_symbols}
    settings["fixed"] = [name.strip() for name in settings.get("fixed", "").split(",") if name.strip()]
    own = {"fixed_period": varies, "reversor": settings.get("reversor")}
    start = _start(model, stepper, settings.get("amplitude"), period, **own)
    return families.family(stepper, start, period=text if varies else None, progress=progress, **settings)


def _start(
    model: Model, stepper: Stepper, amplitude: float | None, period: Formula | None, **own: Any
) -> PeriodicOrbit | Equilibrium:
    """Return the orbit or the equilibrium near the initial state of a model."""
    at: dict[str, Any] = {"t": model.t, "parameters": model.parameters}
    if amplitude is not None and period is None:
        return equilibrium(stepper, model.q, **at)
    if period is None or amplitude is not None:
        ways = "the period of an orbit (--period) or the amplitude next to an equilibrium (--amplitude)"
        raise ModelFileError(f"give {ways}")
    value = period(dict(zip(stepper.parameters, stepper.products.parameters(model.parameters), strict=False)))
    return periodic_orbit(stepper, model.q, model.p, velocity=model.velocity, period=value, **own, **at)


def _described(members: families.Family) -> str:
    name, stepper = members.parameter or "energy", members[0].stepper
    first, last = members.values[[0, -1]]
    lines = [
        f"{stepper.title}: {counted(len(members), 'periodic orbit')}",
        f"{name} {first:.12g} to {last:.12g}, period {members.periods[0]:.12g} to {members.periods[-1]:.12g}",
        f"discretisation errors up to {max(orbit.error for orbit in members):.1e}",
        f"{sum(orbit.stable for orbit in members)} are stable",
        *(
            f"{at.kind} at {name} {members.value_of(at.orbit):.12g}, period {at.orbit.period:.12g}"
            for at in members.bifurcations
        ),
        f"ended: {members.ended}",
    ]
    return "\n".join(lines)


def _numbers(members: families.Family) -> dict[str, Any]:
    def numbers(orbit: PeriodicOrbit) -> dict[str, Any]:
        return {
            "value": members.value_of(orbit),
            "period": orbit.period,
            "energy": orbit.energy,
            "error": orbit.error,
            "stable": orbit.stable,
            "start": dict(zip(orbit.stepper.coordinates, np.asarray(orbit.q).tolist(), strict=True)),
        }

    return {
        "parameter": members.parameter,
        "ended": members.ended,
        "orbits": [numbers(orbit) for orbit in members],
        "bifurcations": [{"kind": at.kind, "after": at.after, **numbers(at.orbit)} for at in members.bifurcations],
    }
