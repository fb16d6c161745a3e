"""Optimal control by discrete mechanics (DMOC): the step equations are the constraints of a nonlinear program.

Unknowns are the states (q, p) between steps, the stages and inputs of each step and, if free, the duration. The
solution is a trajectory of the variational integrator, step for step: momentum maps on which no input acts are
conserved.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.errors import ControlError, MethodError, StateError, imported
from scvi_codegen.frameworks.casadi import own_parameters
from scvi_codegen.frameworks.control_task import Conditions, ControlledMotion, Task, check_known, interval
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem
from scvi_codegen.methods import as_method
from scvi_codegen.methods.method import Method
from scvi_codegen.native.arguments import checked_number
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.validation import MAPPING, checked_count, checks_arguments


@checks_arguments(StateError, system=SYSTEM, start=MAPPING, end=MAPPING, bounds=MAPPING)
def optimal_control(
    system: MechanicalSystem,
    method: Method | str,
    *,
    steps: int,
    duration: float | tuple[float, float],
    start: Conditions,
    end: Conditions,
    cost: str = "0",
    end_cost: str = "0",
    bounds: Conditions | None = None,
    degree: int = 0,
    t: float = 0.0,
    parameters: Mapping[str, float] | None = None,
    guess: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
) -> ControlledMotion:
    """Minimise a cost over inputs, subject to the dynamics, conditions at both ends and bounds between.

    A nonlinear program with exact sparse Hessian is solved by IPOPT (through CasADi, extra ``casadi``). Conditions are
    ``{formula: number}`` or ``{formula: (least, largest)}``, with ``None`` for no bound.

    Args:
        system: system with inputs.
        method: an SVI, SCVI or Gauss method, or its name.
        steps: number of steps of equal size.
        duration: duration of the trajectory; two numbers, least and largest, to optimise it.
        start, end: conditions in coordinates, velocities, momenta (``p_`` and the coordinate), t and parameters, in
            addition to the constraints of the system: fix what these leave free.
        cost: formula in coordinates, velocities, inputs, parameters and t, integrated by the method's quadrature.
        end_cost: formula without inputs, also with momenta, evaluated at the end and added to the integral.
        bounds: by name of an input, everywhere; for formulas as in the cost, at the points of the quadrature.
        degree: degree of inputs within a step, 0 (constant) to 3.
        t: initial time.
        parameters: values by name, others keep their defaults.
        guess: initial guess by name of a coordinate, an input or "duration": a number, or values at equidistant times;
            by default interpolated between conditions, 0 and the mean. A :attr:`ControlledMotion.guess` fits any number
            of steps.
        options: options of ``casadi.nlpsol``, as ``{"ipopt.max_iter": 500}``.

    Raises:
        ControlError: if IPOPT finds no solution; its ``motion`` is the last iterate.
        ExpressionError: for a formula outside the grammar.
        MethodError: for systems without inputs, and methods without a quadrature along a curve.
        MissingLibraryError: without CasADi.
        StateError: for unknown names, or invalid bounds.

    Source: S. Ober-Bloebaum, O. Junge, J. E. Marsden, ESAIM: COCV 17 (2011) 322; C. M. Campos, S. Ober-Bloebaum,
    E. Trelat, Discrete and Continuous Dynamical Systems 35 (2015) 4193.
    """
    ca = imported("casadi", "casadi")
    if not system.inputs:
        raise MethodError(f"'{system.name}' has no inputs: define it with inputs=[..] that its forces contain")
    shortest, longest = interval("duration", duration)
    if not 0 < shortest <= longest < np.inf:
        raise StateError(f"duration must be a positive number, or two numbers (least, largest), not {duration}")
    task = Task(
        ca=ca,
        system=system,
        method=as_method(method, system),
        steps=checked_count(steps, "steps", least=1),
        duration=(shortest, longest),
        start=start,
        end=end,
        cost=cost,
        end_cost=end_cost,
        bounds=bounds or {},
        degree=degree,
        t=checked_number(t, "the time t"),
        parameters=_parameter_values(system, parameters or {}),
    )
    program = task.program()
    motion = task.motion(program, *program.solved(task.first(guess or {}), options or {}))
    if not motion.solved:
        raise ControlError(
            f"no optimal control was found: IPOPT ended with {motion.status} after {motion.iterations} iterations; try "
            "a better guess, a longer duration or wider bounds",
            motion,
        )
    return motion


def _parameter_values(system: MechanicalSystem, chosen: Mapping[str, float]) -> Array:
    values = {name.name: value for name, value in own_parameters(system).items()}
    check_known(chosen, tuple(values), "parameter")
    return np.array([checked_number(value, name) for name, value in {**values, **chosen}.items()])
