"""Runs of ``scvi-codegen run --ensemble``: trajectories of a grid or a table, and their summary."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from scvi_codegen.codegen.native.capacity import TOO_MANY_STATES
from scvi_codegen.codegen.native.options import FAILURES
from scvi_codegen.common.representation import counted
from scvi_codegen.interfaces.cli.reports import LARGE_ERROR, duration, momentum_report
from scvi_codegen.interfaces.cli.supervision import check_memory, interruptions, progress_bar
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.ensemble_file import EnsembleStates
from scvi_codegen.runs.ensembles.ensemble import Ensemble, EnsembleSettings
from scvi_codegen.runs.ensembles.individual import IndividualRuns, runs_of
from scvi_codegen.runs.ensembles.lanes import CommonRuns
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory
from scvi_codegen.runs.results.energy import MOST_BALANCED_STEPS, energy_account, energy_reason
from scvi_codegen.runs.stepper import Stepper

SHOWN_FAILURES = 8
"""Largest number of failed trajectories that are listed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EnsembleOutcome:
    """Result of an ensemble run.

    Attributes:
        result: saved states, of each trajectory up to its last completed step.
        preparation: seconds to derive, compile and load the stepper.
        seconds: seconds spent in steps.
        interrupted: True if a signal ended the run.
    """

    result: EnsembleTrajectory
    preparation: float
    seconds: float
    interrupted: bool


class _Stop(Exception):  # noqa: N818  (no error)
    """Raised from the progress callback to end the run after a signal."""


def integrate_states(states: EnsembleStates) -> EnsembleOutcome:
    """Integrate the model from each initial state, with a progress bar, until all end or a signal arrives."""
    model, began = states.model, time.perf_counter()
    check_memory(model, trajectories=len(states))
    stepper = model.stepper()
    runs = _runs(model, stepper, states)
    started, interrupted = time.perf_counter(), False
    length = runs.length
    with interruptions() as caught, progress_bar(length) as show_progress:

        def look(done: int) -> None:
            show_progress(done)
            if caught and done < length:
                raise _Stop

        try:
            runs.run(progress=look)
        except _Stop:
            interrupted = True
    return EnsembleOutcome(
        result=runs.result(),
        preparation=started - began,
        seconds=time.perf_counter() - started,
        interrupted=interrupted,
    )


def _runs(model: Model, stepper: Stepper, states: EnsembleStates) -> CommonRuns | IndividualRuns:
    """Return the compiled ensemble; Ctrl-C still ends the process here."""
    settings = EnsembleSettings(
        options=model.solver_options, observe=model.observe, parameters=states.parameters, **model._run_arguments()
    )
    return runs_of(Ensemble.of(stepper, states.q, states.momenta(stepper), settings))


def ensemble_summary(model: Model, outcome: EnsembleOutcome, balance: float | None) -> str:
    """Return a summary of an ensemble in a few lines."""
    result = outcome.result
    steps = int(result.steps.sum())
    counts = Counter(result.status.tolist())
    lines = [
        model.system.name,
        model.method_of_runs.title,
        f"{counted(len(result), 'trajectory').replace('trajectorys', 'trajectories')} of "
        f"{_describe_steps(model, result)} saved of each",
        f"{outcome.seconds:.3g} s, {duration(outcome.seconds / max(steps, 1))} per step of a trajectory; "
        f"prepared in {outcome.preparation:.2f} s",
        ", ".join(f"{number} {status}" for status, number in [("ok", counts.pop("ok", 0)), *sorted(counts.items())]),
    ]
    reports = _failures(result), _extremes(result), [_energy_report(result, balance)], momentum_report(result)
    return "\n".join([*lines, *chain(*reports)])


def _extremes(result: EnsembleTrajectory) -> Iterator[str]:
    if result.observed is None or result.observed.ndim < 3:
        return
    interface = result.stepper.interface
    least, largest = np.nanmin(result.observed[0], axis=0), np.nanmax(result.observed[1], axis=0)
    for name, lowest, highest in zip((*interface.coordinates, *interface.momenta), least, largest, strict=True):
        yield f"  {name}: {lowest:.6g} to {highest:.6g} over all steps"


def _describe_steps(model: Model, result: EnsembleTrajectory) -> str:
    if model.h is None:
        steps = f"{int(result.steps.min())} to {int(result.steps.max())} adaptive steps"
        return f"{steps} from t = {model.t:g} to t = {model.t + model.covered:g}; up to {len(result.t)} states"
    steps = f"{counted(int(result.steps.max()), 'step')} of {model.h:g}"
    return f"{steps} from t = {model.t:g}; {counted(len(result.t), 'state')}"


def _failures(result: EnsembleTrajectory) -> Iterator[str]:
    lost = np.flatnonzero(~result.ok & (result.status != "interrupted"))
    for j in lost[:SHOWN_FAILURES]:
        equal = result.h is not None and not result.spans and result.t.ndim == 1
        t = result.t[0] + result.steps[j] * result.h if equal else result.ends[0][j]
        status = str(result.status[j])
        why = FAILURES[status][0] if status in FAILURES else result.failures[int(j)]
        failed = f"step {result.steps[j]} at t = {t:g} failed"
        if status == TOO_MANY_STATES:
            failed, why = f"ended after step {result.steps[j]} at t = {t:g}", f"{why}: use --save-every"
        yield f"  trajectory {j}: {failed}: {why}"
    if len(lost) > SHOWN_FAILURES:
        yield f"  and {len(lost) - SHOWN_FAILURES} more"


def energy_balance(result: EnsembleTrajectory) -> float | None:
    """Return the largest |E - E0 - W| of all trajectories where forces act; ``None`` if their work W is unknown."""
    if not energy_reason(result.stepper) or result.steps.sum() > MOST_BALANCED_STEPS:
        return None
    accounts = [energy_account(result[int(j)], limited=True) for j in np.flatnonzero(result.ok)]
    if not accounts or any(account.work is None for account in accounts):
        return None
    return max(float(np.abs(account.values).max()) for account in accounts)


def _energy_report(result: EnsembleTrajectory, balance: float | None) -> str:
    """Return one line: the largest error or change of the energy among all trajectories."""
    energies, where = result.energy(), ""
    if result.observed is not None and result.observed.ndim == 2:
        energies, where = np.concatenate([energies, result.observed]), " over all steps"
    sizes = np.abs(energies[0])
    reason = energy_reason(result.stepper)
    relative = bool((sizes > 0.0).all()) and not reason
    changes = np.abs(energies - energies[0]) / (sizes if relative else 1.0)
    if not np.isfinite(changes).any():
        return "energy: not finite in any state"
    state, worst = (int(index) for index in np.unravel_index(np.nanargmax(changes), changes.shape))
    is_large = relative and changes[state, worst] > LARGE_ERROR
    if is_large and energy_account(result[worst], limited=True).initial is None:
        relative, changes = False, np.abs(energies - energies[0])  # an energy that is a rounding error of its terms
        state, worst = (int(index) for index in np.unravel_index(np.nanargmax(changes), changes.shape))
    if reason:
        changed = f"energy: {reason}, it changed by {changes[state, worst]:.3g} at most{where}"
        return changed if balance is None else f"{changed}; energy balance |E - E0 - W| {balance:.1e} at most"
    title = "relative energy error" if relative else "energy error"
    return f"{title}: {changes[state, worst]:.2e} at most{where}, of trajectory {worst}"
