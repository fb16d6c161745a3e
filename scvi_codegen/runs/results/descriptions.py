"""Short descriptions of runs and results for ``repr``."""

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.representation import one_line
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import FixedSteps, InTau, StepPlan


def describe_run(run: Memory) -> str:
    """Return ``<Run of TITLE; t = 3 after 30 steps of 0.1, solver fixed-point>``."""
    interface, unset = run.stepper.interface, ", ".join(run._unset_inputs)
    plan = "" if isinstance(run.plan, FixedSteps) else f", t_end = {run.plan.t_end:g}"
    solved = f", solver {interface.solver}" if interface.solver else ""
    steps = f"{run.steps} steps{describe_step_size(run._step_size, run.plan, tau=interface.in_tau)}"
    waits = f", inputs not set: {unset}" if unset else ""
    return one_line(run, short_title(interface), f"t = {run.t:g} after {steps}{plan}{solved}{waits}")


def describe_states(result: SavedStates, lengths: str) -> str:
    """Return ``<Trajectory of TITLE; 31 states from t = 0 to 3, 30 steps of 0.1>``; ``lengths`` follows "steps"."""
    span = f"{len(result.t)} states from t = {result.t[0]:g} to {result.t[-1]:g}"
    return one_line(result, short_title(result.stepper.interface), f"{span}, {result.steps} steps{lengths}")


def short_title(interface: Interface) -> str:
    """Return the system and the short name of the method."""
    return f"{interface.system}, {interface.method}"


def describe_step_size(h: float, plan: StepPlan, *, tau: bool) -> str:
    """Describe the step size of a run."""
    if isinstance(plan, FixedSteps):
        return f" of {h:g} in tau" if tau else f" of {h:g}"
    return f" of {plan.tau:g} in tau" if isinstance(plan, InTau) else " of adaptive size"
