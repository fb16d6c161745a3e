"""Table of what goes with what: the operations of a stepper, the properties that exclude them, reasons and remedies."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from scvi_codegen.codegen.ir.variants import Derivatives
from scvi_codegen.codegen.native.option_table import OPTION, in_words
from scvi_codegen.common.errors import MethodError, ScviCodegenError, StateError, closest
from scvi_codegen.systems.event import warn_of_formulas
from scvi_codegen.systems.formulas.indices import SIZES_REQUIRED

OPERATIONS = {
    "adaptive": "adaptive step size ({t_end} without {h})",
    "error": "{error=}",
    "run_error": "run.error",
    "check_growth": "check_growth=True",
    "t_eval": "{t_eval}",
    "observe": "observe",
    "events": "events=",
    "inputs": "inputs=",
    "threads": "{threads=}",
    "tables": "tables=",
    "with_sizes": "with_sizes",
    "by_steps": "{transitions} 'by steps'",
    "ensembles": "integrate_ensemble",
    "ensemble_events": "integrate_ensemble of a stepper with events",
    "observe_ensemble": "integrate_ensemble(observe=)",
    "single": "integrate_ensemble(precision='single')",
    "crossings": "run.crossings",
    "checkpoint": "checkpoint",
    "recording": "record_run",
    "dense_output": "dense output",
    "project": "project",
    "multipliers": "multipliers",
    "work": "work_and_impulses",
    "discrete_lagrangian": "discrete_lagrangian",
    "action": "action",
    "shadow_energy": "shadow_energy",
    "path": "path",
    "momentum_maps": "momentum_maps",
    "unresolved": "unresolved",
    "jacobian": "jacobian",
    "tangent": "tangent",
    "pullback": "pullback",
    "sensitivity": "sensitivity",
    "hessian": "hessian_product",
    "chaos": "chaos_indicators",
    "chaos_ensemble": "chaos_indicators_ensemble",
    "periodic_orbit": "periodic_orbit",
    "energy": "periodic_orbit(energy=)",
    "fit": "fit",
    "flow": "flow of JAX, PyTorch or CasADi",
    "advice": "--advise",
}
"""Names of :meth:`~scvi_codegen.Stepper.supports`, and what messages call them, options in the words of a face."""

BY_FORMULAS = ("flow", "chaos_ensemble", "path")
"""Operations with many steps that do not locate kinks."""
SHORT_STEPS = ("svi-1-", "svi-2-", "stoermer-verlet", "composition")
"""Beginnings of the names of methods whose steps are short enough for the interpolation of the shadow energy."""
PROPERTIES: dict[str, str | Callable[[Any], Any]] = {
    "with a time transformation": "interface.time_transformation",
    "in transformed time": "in_tau",
    "in transformed time of a first-order system": "in_tau interface.variables",
    "for a first-order system": "interface.variables",
    "in a heat bath": "interface.temperature",
    "with events that change the state": "changes_states",
    "with constraints": lambda stepper: stepper.interface.imposed or stepper.interface.layout.constraints,
    "with nonholonomic constraints": lambda stepper: any(
        name in formula
        for name in ("_dot", *(f"{rate}_" for text in stepper.interface.rotations for rate in text.split()[2:]))
        for formula in stepper.interface.imposed
    ),
    "with constraints of arrays": "interface.layout.constraints",
    "with constraints of arrays by a composition": lambda stepper: (
        stepper.interface.layout.constraints and stepper.interface.method.startswith("composition")
    ),
    "with kinks that runs locate": "interface.modes",
    "where L or H jumps": lambda stepper: any("jumps" in mode for mode in stepper.interface.modes),
    "with events that set parameters": lambda stepper: len(stepper.modes) > len(stepper.interface.mode_names),
    "with contacts": "interface.masked",
    "with contacts by steps": "by_steps",
    "without steps of contacts": lambda stepper: "motion_terms" not in stepper._plain.contents.functions,
    "without constraints": "!interface.constraints !interface.layout.constraints",
    "with the long steps of this method": lambda stepper: not stepper.interface.method.startswith(SHORT_STEPS),
    "where the energy changes": "interface.changes_energy",
    "without a mesh": "!interface.layout.mesh",
    "with sizes known when compiled": "!run_time_sizes",
    "with sizes known at run time": "run_time_sizes",
    "with precision='double-double'": lambda stepper: stepper.interface.words > 1,
    "without trajectories in SIMD lanes": "!run_time_sizes !ensemble",
    "without derivatives": lambda stepper: stepper._lacks(stepper.linear_variant),
    "without second derivatives": lambda stepper: stepper._lacks(Derivatives(order=2)),
    "without a tangent vector along runs": "!_carries_errors",
    "without an error estimate": "!_has_error_estimate !_has_tau",
}
"""Whether a stepper has a property: attributes that are then all true, or false after a ``!``, or a function."""

PROPERTIES_OF_SIZES: dict[str, str | Callable[[Any], Any]] = {
    "with constraints that prescribe the motion": lambda stepper: len(stepper.interface.imposed) == stepper.dimension,
    "with forces": "interface.exchange_names",
    "without the work of forces": "!interface.exchange_names",
    "without an action": "!interface.has_action",
    "without a sum of L along steps": "!interface.sums_action",
}
"""Properties of a stepper of known sizes; one of arrays of run-time sizes has none of them."""


_FIRST = "jacobian tangent pullback sensitivity"
_DERIVATIVES = f"{_FIRST} chaos chaos_ensemble periodic_orbit fit flow"
_CURVE = "SVI, SCVI or a Gauss method"
_ACTIONS = "action shadow_energy path"
_IN_DOUBLE = (
    f"observe_ensemble single work discrete_lagrangian chaos_ensemble periodic_orbit energy fit flow {_ACTIONS}"
)
_RUNS = "chaos chaos_ensemble periodic_orbit fit flow work"
_ORIGINAL = "compile the original system, with fixed steps {h}, or with time_transformation=... or {t_end}"
FEATURES = {
    (operation, property_): remedy
    for property_, operations, remedy in (
        (
            "in a heat bath",
            "adaptive error run_error t_eval dense_output events advice single tangent pullback sensitivity "
            f"hessian {_RUNS} {_ACTIONS}",
            "give {h} and {steps}, and use saved states and averages of them; steps alone have derivatives",
        ),
        (
            "with a time transformation",
            "ensembles observe_ensemble single chaos_ensemble periodic_orbit fit flow",
            "this requires fixed steps {h}; compile the stepper without time_transformation",
        ),
        ("with precision='double-double'", _IN_DOUBLE, "omit it, or use precision='double'"),
        ("with a time transformation", "adaptive", "give {h} (constant step in tau) and {t_end}, and no {tolerance}"),
        ("with a time transformation", "advice", "use {tolerance} (local error)"),
        ("in transformed time", "advice", "use {tolerance} (local error)"),
        ("in transformed time", "adaptive", "give {h} (fixed step in tau)"),
        ("in transformed time", "inputs", "compile the original system"),
        ("in transformed time", "observe_ensemble single chaos chaos_ensemble periodic_orbit fit flow", _ORIGINAL),
        ("in transformed time", _ACTIONS, _ORIGINAL),
        ("in transformed time", "ensemble_events", "integrate each trajectory, or pass stepper.with_events(())"),
        ("with a time transformation", "shadow_energy path", "compile the stepper without time_transformation"),
        (
            "with the long steps of this method",
            "shadow_energy",
            "differences of the states are less accurate than the energy; use energy(), or SVI of degree 1 or 2, "
            "StoermerVerlet or a Composition",
        ),
        ("where the energy changes", "shadow_energy", "it is not conserved; use energy()"),
        ("with constraints", "shadow_energy", "use energy()"),
        ("for a first-order system", _ACTIONS, "use a system whose velocities determine its momenta"),
        ("without a sum of L along steps", _ACTIONS, f"it requires {_CURVE}"),
        ("in transformed time", "hessian", f"use first derivatives, or {_ORIGINAL}"),
        ("in transformed time of a first-order system", _FIRST, "use the system in physical time"),
        ("for a first-order system", "hessian", "use first derivatives and differences of them"),
        ("with events that set parameters", _DERIVATIVES, "make them terminal, and restart with the new parameters"),
        (
            "with events that change the state",
            "observe_ensemble single hessian chaos_ensemble flow advice shadow_energy",
            "make them terminal and restart",
        ),
        ("with kinks that runs locate", "observe_ensemble single", "save states of runs in double precision"),
        ("with kinks that runs locate", "hessian", "use first derivatives and differences of them"),
        ("where L or H jumps", "shadow_energy", "use energy()"),
        ("where L or H jumps", " ".join(BY_FORMULAS), "use runs, ensembles of runs and their first derivatives"),
        (
            "with contacts",
            f"observe_ensemble single hessian chaos_ensemble flow advice {_ACTIONS}",
            "use runs and ensembles with {h}, or with {t_end} and a {tolerance}, without it",
        ),
        ("with contacts", "crossings", "pass events= to the run"),
        ("with contacts by steps", "adaptive error recording", "give {h}, or omit {transitions=}"),
        (
            "with contacts by steps",
            "run_error chaos periodic_orbit fit",
            "locate the transitions: omit {transitions=}; runs have tangent, pullback and sensitivity",
        ),
        ("with nonholonomic constraints", "by_steps", "locate the transitions"),
        ("with events that change the state", "by_steps", "make them terminal and restart"),
        ("with kinks that runs locate", "by_steps", "locate the transitions"),
        (
            "without steps of contacts",
            "by_steps",
            "it requires contacts and svi:1 in double precision, named coordinates or known sizes, a kinetic energy "
            "that is quadratic in the velocities, no kinks and no damping=",
        ),
        ("with constraints", "observe_ensemble", "use coordinates without constraints, or omit it"),
        ("with constraints", "fit", "use coordinates without constraints, such as the angles of rods"),
        ("with nonholonomic constraints", "periodic_orbit", "use coordinates without constraints, or integrate"),
        ("with constraints of arrays", "threads", "omit {threads}; the step uses one"),
        (
            "with constraints of arrays by a composition",
            f"{_FIRST} chaos chaos_ensemble hessian work discrete_lagrangian with_sizes recording",
            "it compiles known sizes, whose constraints require an SVI; use SVI(1, 'gauss-lobatto:2'), which is RATTLE",
        ),
        (
            "with constraints that prescribe the motion",
            "chaos chaos_ensemble periodic_orbit",
            "leave out a constraint, or use jacobian",
        ),
        ("without constraints", "project multipliers", "the system has none"),
        ("with forces", "energy", "they change the energy; omit energy"),
        (
            "without the work of forces",
            "work",
            f"it requires forces, and {_CURVE}, or Newton's StoermerVerlet; that of driven constraints follows from "
            "run.multipliers()",
        ),
        ("without an action", "discrete_lagrangian", f"it requires {_CURVE}, no forces, and a second-order system"),
        (
            "without an error estimate",
            "adaptive error",
            "it requires forces at two or more stages, or velocities that vary along a step; give {h} and {steps} "
            "(fixed step size)",
        ),
        (
            "without a tangent vector along runs",
            "check_growth",
            "it requires forces or accelerations of at most 1000 operations, by the fixed-point iteration of SVI or a "
            "Gauss method in double precision, without constraints, rotations, contacts, damping=, inputs, arrays of "
            "run-time sizes, a time transformation and events that change the state; omit it, or use {error=}",
        ),
        (
            "with sizes known at run time",
            "flow observe_ensemble single",
            f"pass stepper.with_sizes(..); {SIZES_REQUIRED}",
        ),
        (
            "without trajectories in SIMD lanes",
            "observe_ensemble single",
            "it requires explicit steps or a fixed-point iteration, as of SVI and Gauss methods without constraints, "
            "without the moving frame of a symmetric top; omit it",
        ),
        ("without derivatives", f"{_DERIVATIVES} {_ACTIONS}", "it was loaded without their source; compile the system"),
        (
            "without second derivatives",
            "hessian",
            "systems with damping have first derivatives only, and a pickled stepper has second derivatives only if "
            "stepper.second_derivatives was used before pickling",
        ),
        ("without a mesh", "unresolved", "it requires a mesh; discretise the system from a density"),
        ("with sizes known when compiled", "tables with_sizes", "omit it"),
        (
            "with sizes known when compiled",
            "threads",
            "threads share the steps of arrays whose sizes are known at run time only; omit {threads}, compile without "
            "sizes, or compile roll_sums(system).system, whose runs take its tables and parameters",
        ),
        ("with save_every", "t_eval", "give either {t_eval} or {save_every}, not both"),
        ("with inputs", "t_eval", "omit {t_eval}"),
        ("with inputs", "observe", "omit observe"),
        ("with inputs", "sensitivity chaos", "use tangent or pullback, or run.pieces"),
        (
            "with precision='single'",
            "adaptive error t_eval events observe_ensemble action",
            "give {h} and {steps} (fixed step size), and save states; or omit precision",
        ),
        ("with events", "observe_ensemble", "count them by observe='events', or pass stepper.with_events(())"),
        ("with t_eval", "observe", "omit observe"),
        ("with observe", "error run_error dense_output", "omit observe"),
    )
    for operation in operations.split()
}
"""Remedies of the operations that a property of the stepper, or another argument of the run, excludes; by face."""


_EXCLUDING: dict[str, list[str]] = {}
for _operation, _property in FEATURES:
    _EXCLUDING.setdefault(_operation, []).append(_property)


@dataclass(frozen=True, slots=True)
class Support:
    """Answer of :meth:`~scvi_codegen.Stepper.supports`: true if the operation is available, else with the reason."""

    reason: str = ""

    def __bool__(self) -> bool:
        return not self.reason


def check_features(*names: str) -> None:
    """Raise :class:`StateError` for a name that is not of the table."""
    for name in names:
        if name not in OPERATIONS:
            raise StateError(f"unknown feature '{name}'{closest(name, OPERATIONS)} Known: {', '.join(OPERATIONS)}")


def refusal(operation: str, property_: str, title: str = "") -> ScviCodegenError:
    """Return the error of an operation that a property excludes, ``StateError`` for other arguments of the run."""
    of_stepper = property_ in PROPERTIES or property_ in PROPERTIES_OF_SIZES
    called, remedy = in_words(OPERATIONS[operation]), in_words(FEATURES[operation, property_])
    other = OPTION.get(property_.removeprefix("with "))
    where = f"with {other.word}" if other else property_
    reason = f"{called} is not available {where}{title and f' ({title})'}"
    return (MethodError if of_stepper else StateError)(f"{reason}: {remedy}")


def check_together(**arguments: Any) -> None:
    """Raise the refusal of an argument of a run that another one excludes; ``None``: not passed."""
    passed = [name for name, value in arguments.items() if value is not None]
    if len(passed) < 2:
        return
    for operation, property_ in FEATURES:
        if operation in passed and property_.removeprefix("with ") in passed:
            raise refusal(operation, property_)


def require(stepper: Any, operation: str, *together: str) -> None:
    """Raise the refusal of an operation of a stepper, or of one together with others; warn once of kinks."""
    if error := refusal_of(stepper, operation, *together):
        raise error
    if operation in BY_FORMULAS and stepper.interface.modes and not stepper.warned_of_kinks:
        stepper.warned_of_kinks = True
        warn_of_formulas(stepper.interface, OPERATIONS[operation])


def _has(stepper: Any, trait: str | Callable[[Any], Any]) -> bool:
    """Return whether a stepper has a property of the table."""
    if callable(trait):
        return bool(trait(stepper))
    return all(bool(attrgetter(name.lstrip("!"))(stepper)) != (name[0] == "!") for name in trait.split())


def refusal_of(stepper: Any, operation: str, *together: str) -> ScviCodegenError | None:
    """Return the refusal of an operation of a stepper, or of one together with others; ``None`` if it is available."""
    for property_ in _EXCLUDING.get(operation, ()):
        if property_ in PROPERTIES_OF_SIZES:
            applies = not stepper.run_time_sizes and _has(stepper.known, PROPERTIES_OF_SIZES[property_])
        else:
            applies = _has(stepper, PROPERTIES[property_]) if property_ in PROPERTIES else property_[5:] in together
        if applies:
            return refusal(operation, property_, stepper.title)
    return None


def check_strict_energy(interface: Any, *, by_steps: bool) -> None:
    """Raise :class:`MethodError` where steps that may not raise energy are not available."""
    if not by_steps:
        raise MethodError(in_words("{strict_energy} requires contacts by steps: give {transitions} 'by steps'"))
    if not interface.dissipates:
        raise MethodError(
            in_words("{strict_energy} is not available where forces or moving surfaces may supply energy, as in ")
            + f"'{interface.system}': omit it"
        )
