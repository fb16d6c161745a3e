"""Documents of ``scvi-codegen run --json``: the numbers behind the summaries of runs."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from scvi_codegen.common.errors import StateError
from scvi_codegen.interfaces.cli.ensembles import EnsembleOutcome
from scvi_codegen.interfaces.cli.recording import RecordedOutcome
from scvi_codegen.interfaces.cli.running import RunOutcome
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.runs.accuracy.run_error import RunError
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory
from scvi_codegen.runs.recording import RecordedRun
from scvi_codegen.runs.results.energy import EnergyAccount
from scvi_codegen.runs.states.words import low_words
from scvi_codegen.runs.stepping.step_plan import FixedSteps
from scvi_codegen.runs.trajectory import Trajectory


def _step_size(model: Model, run: Any) -> float | None:
    """Return the fixed step size, or step of tau; ``None`` for adaptive steps."""
    size: float | None = run.plan.size
    return size if model.h is None or not isinstance(run.plan, FixedSteps) else model.h


def run_numbers(
    model: Model, outcome: RunOutcome, final_error: RunError | None, account: EnergyAccount | None = None
) -> dict[str, Any]:
    """Return the numbers of a run in memory."""
    run, trajectory = outcome.run, outcome.trajectory
    t, q, p = outcome.end
    iterations = int(np.sum(trajectory.iterations)) + run.iterations
    arrays = {"sizes": model.sizes, "tolerance": model.allowed_error, "iterations": iterations}
    errors = final_error and {name: _named(model, of[-1]) for name, of in zip("qp", final_error.bounds, strict=True)}
    return {
        **_about(model),
        **(arrays if model.array_system else {}),
        "steps": trajectory.steps,
        "rejected_steps": run.rejected_steps,
        "fallback_steps": run.fallback_steps,
        "h": _step_size(model, run),
        "states": len(trajectory),
        "seconds": outcome.seconds,
        "preparation_seconds": outcome.preparation,
        **_conserved(trajectory),
        "work": None if account is None or account.work is None else float(account.work[-1]),
        "energy_balance": None if account is None or account.work is None else _largest(account.values),
        "action": trajectory.action() if model.action else None,
        "step_error": trajectory.step_error,
        "worst_step_time": trajectory.worst_step_time,
        "final": {"t": t, "q": _named(model, q), "p": _named(model, p), **_low_words(model, q, p)},
        "final_error": errors,
        "lost": None if final_error is None else final_error.lost,
        "failure": failure_text(outcome),
        "missed": outcome.missed or _missed_end(outcome, t, f"t = {model.t + model.covered:g}"),
    }


def _low_words(model: Model, q: Any, p: Any) -> dict[str, Any]:
    """Return the low words of a state in double-double arithmetic."""
    if not model.in_double_double:
        return {}
    return {"q_low": _named(model, low_words(q)), "p_low": _named(model, low_words(p))}


def failure_text(outcome: RunOutcome | RecordedOutcome) -> str | None:
    """Return the reason why a run is incomplete; ``None`` if it is complete."""
    if outcome.interrupted:
        return "interrupted"
    return None if outcome.failure is None else str(outcome.failure)


def _missed_end(outcome: RunOutcome | RecordedOutcome, t: float, end: str) -> str | None:
    """Return the message that a run is incomplete; ``None`` if it is complete."""
    return None if failure_text(outcome) is None else f"the run ended at t = {t:g}, before {end}"


def outcome_numbers(outcome: RecordedOutcome) -> dict[str, Any]:
    """Return the numbers of a run that was recorded or resumed in a folder."""
    end = _missed_end(outcome, float(outcome.recorded.t[-1]), "its end")
    return {**recorded_numbers(outcome.recorded), "failure": failure_text(outcome), "missed": end}


def recorded_numbers(recorded: RecordedRun) -> dict[str, Any]:
    """Return the numbers of a run in a folder."""
    interface = recorded.manifest.interface
    words = (("q", recorded.q), ("p", recorded.p)) if interface.words > 1 else ()
    return {
        "system": interface.system,
        "method": interface.method,
        "folder": recorded.folder,
        "steps": recorded.steps,
        "states": len(recorded),
        "final": {
            "t": float(recorded.t[-1]),
            "q": _by_name(interface.coordinates, recorded.q[-1]),
            "p": _by_name(interface.coordinates, recorded.p[-1]),
            **{f"{name}_low": _by_name(interface.coordinates, states[-1].low) for name, states in words},
        },
        "finished": recorded.finished,
    }


def ensemble_numbers(model: Model, outcome: EnsembleOutcome, balance: float | None) -> dict[str, Any]:
    """Return the numbers of an ensemble."""
    result = outcome.result
    lost = len(result) - np.count_nonzero(result.ok)
    return {
        **_about(model),
        "trajectories": len(result),
        "statuses": Counter(result.status.tolist()),
        "steps": {"least": int(result.steps.min()), "most": int(result.steps.max())},
        "states": len(result.t),
        "seconds": outcome.seconds,
        "preparation_seconds": outcome.preparation,
        **_conserved(result),
        "action": result.action() if model.action else None,
        "energy_balance": balance,
        "failure": "interrupted" if outcome.interrupted else None,
        "missed": f"{lost} of {len(result)} trajectories ended before their final time" if lost else None,
    }


def _about(model: Model) -> dict[str, Any]:
    method = {"method": model.method_of_runs.name, "order": model.method_of_runs.order}
    return {"system": model.system.name, **method, "run": model._run_section()}


def _named(model: Model, vector: Any) -> dict[str, Any]:
    if model.array_system is not None:
        return {array.name: vector[array.name] for array in model.array_system.coordinates}
    return _by_name([coordinate.name for coordinate in model.system.coordinates], vector)


def _by_name(names: Sequence[str], vector: np.ndarray[Any, Any]) -> dict[str, float]:
    return dict(zip(names, vector.tolist(), strict=True))


def _conserved(result: Trajectory | EnsembleTrajectory) -> dict[str, Any]:
    """Return the largest changes of the energy and of the momentum maps, these relative to the size of their terms."""
    values_by_name: dict[str, Any] = {"energy_change": None, "energy": None, "momentum_errors": None}
    try:
        with np.errstate(all="ignore"):
            energy = result.energy()  # a row, unlike a number, has both words
            values_by_name["energy"] = energy[0]
            values_by_name["energy_change"] = _largest(energy - energy[:1])
            errors = np.asarray(result.momentum_errors())
            names = result.stepper.interface.map_names
            values_by_name["momentum_errors"] = {name: _largest(errors[..., k]) for k, name in enumerate(names)}
    except StateError:
        pass  # a state without a velocity; the summary reports it
    return values_by_name


def _largest(changes: np.ndarray[Any, Any]) -> float | None:
    """Return the largest finite absolute value; ``None`` if there is none."""
    sizes = np.abs(changes)[np.isfinite(changes)]
    return float(sizes.max()) if sizes.size else None
