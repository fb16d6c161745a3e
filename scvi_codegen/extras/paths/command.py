"""Command ``scvi-codegen path``: motions between two positions in a given time, and closed paths."""

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import click
import numpy as np

from scvi_codegen.api.commands import check_writable, model_arguments, read_model, reporting, tell
from scvi_codegen.api.text import counted
from scvi_codegen.common.errors import MethodError, ModelFileError
from scvi_codegen.extras.paths.path import Path, different_paths
from scvi_codegen.extras.pictures.services import check_picture
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.runs.trajectory import Trajectory

MOST_SHOWN = 6
"""Largest number of coordinates whose initial momenta are printed."""


@click.command()
@model_arguments("solver", "path")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="States of the first path, as of 'run'.")
@click.option("--plot", type=click.Path(), metavar="FILE", help="Plot of the first path (.png, .svg, .pdf).")
@reporting
def path(model_name: str, output: str | None, plot: str | None, **choices: Any) -> None:
    """Find motions of MODEL from one position to another in the time --span (boundary-value problem).

    A path is a stationary point of the discrete action. Its steps are those of MODEL (--step), its start is --from, by
    default the initial position of MODEL. A problem may have several solutions: --starts tries curves at random as
    well, --revolutions curves around the centre of a rotational symmetry; all different paths are printed, that of
    least action first. With --energy the duration is unknown and --span is an estimate. --closed finds a closed path
    near the run of MODEL over --span: 'true' for a periodic orbit, or the coordinates that follow after --span, with
    signs, as in choreographies.

    \b
    Examples:
      scvi-codegen path kepler --from 1,0 --to=-0.5,0.8 --span 2 --step 0.1
      scvi-codegen path kepler --from 1,0 --to=-0.4,0.9 --span 2.2 --step 0.2 --energy -0.5 --json
      scvi-codegen path henon-heiles --from 0,0 --to 0.1,0.3 --span 10 --step 0.5 --starts 5
      scvi-codegen path planar-pendulum --closed=-q --q 0 --velocity 1.5 --span 4 --step 0.2
    """
    if output is not None:
        check_writable(FilePath(output), "'-o'", states=True)
    if plot is not None:
        check_writable(FilePath(plot), "'--plot'")
        check_picture(plot)
    model = read_model(model_name, choices, unused=_unused).with_known_sizes("path")
    paths = _paths(model)
    title = f"{model.system.name}\n{model.method.title}; {counted(len(paths), 'path')}"
    tell("\n".join([title, *map(_described, paths)]), **_numbers(model, paths))
    trajectory = _trajectory(paths[0]) if output or plot else None
    for target, write in ((output, "save"), (plot, "plot")):
        if target is not None:
            getattr(trajectory, write)(target)
            tell(f"wrote {target}")
    if written := [target for target in (output, plot) if target]:
        tell(written=written)


def _unused(document: Any) -> tuple[str, ...]:
    """Return what paths do not start from: a velocity, and where they start elsewhere the coordinates."""
    settings = document.get("path", {})
    return () if "closed" in settings else ("q_dot", "q") if "from" in settings else ("q_dot",)


def _paths(model: Model) -> list[Path]:
    """Return the paths of a model, that of least action first."""
    settings = dict(model.path)
    if model.h is None:
        raise ModelFileError("a path has steps of one size: give a step size (--step, [run] step)")
    closed = settings.get("closed")
    if (closed is None) == ("to" not in settings):
        raise ModelFileError("give the end of the path (--to, [path] to) or closed (--closed, [path] closed), not both")
    for key in ("from", "to"):
        if len(settings.get(key, model.q)) != model.dimension:
            names = ", ".join(str(coordinate) for coordinate in model.system.coordinates)
            raise ModelFileError(f"[path] {key} has {len(settings[key])} numbers: give those of {names}")
    steps, stepper = max(2, math.ceil(model.covered / abs(model.h) * (1.0 - 1e-9))), model.stepper()
    arguments: dict[str, Any] = {"steps": steps, "t": model.t, "parameters": model.parameters}
    arguments |= {"options": model.solver_options, "energy": settings.get("energy")}
    if model.system.inputs:
        arguments["inputs"] = model.all_inputs()
    span = math.copysign(model.covered, model.h)
    if closed is None:
        q0, q1 = settings.get("from", model.q), settings["to"]
        arguments |= {"starts": settings.get("starts", 0), "revolutions": settings.get("revolutions")}
        return different_paths(stepper, q0, q1, span, **arguments)
    near = model.integrate()
    start = near.at(np.linspace(near.t[0], near.t[-1], steps + 1))[0]
    symmetry = True if closed in ("true", ["true"]) else closed
    return [stepper.path(T=span, start=np.asarray(start), closed=symmetry, **arguments)]


def _described(path: Path) -> str:
    p, names = np.asarray(path.p)[0], path.stepper.interface.momentum_columns
    number, times = _indices(path)
    index = "" if number is None else f", Morse index {number}"
    conjugate = "".join(f"\n  conjugate time between {low:g} and {high:g}" for low, high in times)
    dropped = "\n  stationary points of the discrete action that are no motions, dropped: "
    shown = ", ".join(f"{name} = {x:.12g}" for name, x in list(zip(names, p, strict=True))[:MOST_SHOWN])
    period = f", period {path.period:.12g}" if path.solution.intervals.symmetry is not None else ""
    return (
        f"action {path.action:.12g}{index}; duration {path.t[-1] - path.t[0]:.12g}{period}; largest jump of the "
        f"momentum {path.residual:.1e}, discretisation error {path.error:.1e} (relative){conjugate}"
        f"{f'{dropped}{path.dropped}' if path.dropped else ''}\n  {shown}"
    )


def _indices(path: Path) -> tuple[int | None, Any]:
    """Return the Morse index and the conjugate times, ``None`` and none where they are undefined."""
    with suppress(MethodError):
        return path.index, path.conjugate_times
    return None, np.empty((0, 2))


def _numbers(model: Model, paths: list[Path]) -> dict[str, Any]:
    names, columns = model.system.coordinates, paths[0].stepper.interface.momentum_columns

    def numbers(path: Path) -> dict[str, Any]:
        q, p = np.asarray(path.q), np.asarray(path.p)
        return {
            **{
                name: getattr(path, name)
                for name in ("action", "residual", "error", "energy_change", "at_rest", "iterations", "dropped")
            },
            **dict(zip(("index", "conjugate_times"), _indices(path), strict=True)),
            "duration": float(path.t[-1] - path.t[0]),
            "period": path.period if path.solution.intervals.symmetry is not None else None,
            "energy": float(path.stepper.energy(q[0], p[0], model.t, path.solution.intervals.parameters_at_start)),
            "start": {str(name): float(x) for name, x in zip(names, q[0], strict=True)},
            "end": {str(name): float(x) for name, x in zip(names, q[-1], strict=True)},
            "momenta": {name: float(x) for name, x in zip(columns, p[0], strict=True)},
        }

    about = {"system": model.system.name, "method": model.method.name, "run": model._run_section()}
    return {**about, "paths": [numbers(path) for path in paths]}


def _trajectory(path: Path) -> Trajectory:
    """Return the states of a path as a trajectory, of a closed one over its period."""
    run = path.run()
    return run if len(run) != len(path.t) else replace(run, q=path.q, p=path.p)
