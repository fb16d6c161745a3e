"""Discrete mechanics and collocation of the same order on one problem: sizes, iterations, and true final states."""

import time
import warnings
from itertools import pairwise

import numpy as np
from collocation import Motion, collocated
from scipy.integrate import solve_ivp

import scvi_codegen as sc

HEADING = f"{'':19} steps  unknowns  iterations     ms  {'cost':12}  end off by"


def truly(system, x, t, inputs):
    """Return (2m,) final positions and velocities for given inputs by SciPy's DOP853, from breakpoint to breakpoint."""
    m, called = system.dimension, Motion(system).called("numpy")
    for begin, end in pairwise(t):
        edge = 1e-12 * (end - begin)  # an input may jump at breakpoints

        def partials(now, x, first=begin + edge, last=end - edge):
            pushes = [float(inputs[name](min(max(now, first), last))) for name in system.inputs]
            return np.concatenate([x[m:], called(x[:m], x[m:], pushes)])

        x = solve_ivp(partials, (begin, end), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return x


def timed(function, *given, **named):
    """Return the result of a function, and the smallest processor time of three calls in milliseconds."""
    lasted = []
    for _ in range(3):
        begun = time.process_time()
        found = function(*given, **named)
        lasted.append(1e3 * (time.process_time() - begun))
    return found, min(lasted)


def compared(system, points, task, momentum=None):
    """Print a line for each method, with the error of a momentum (q, v) that should be 0; return ours."""
    method = f"svi:{points}"
    motion, lasted = timed(sc.optimal_control, system, method, **task)
    theirs, waited = timed(collocated, system, points, **task)
    stepper = sc.compile_stepper(system, method)
    with warnings.catch_warnings(action="ignore", category=sc.AccuracyWarning):
        # the table shows the errors of coarse grids
        again = stepper.integrate(motion.q[0], motion.p[0], inputs=motion.inputs, h=motion.h, t_end=motion.t[-1])
    x = np.concatenate([motion.q, stepper.velocity(motion.q, motion.p)], axis=1)
    ours = {"t": motion.t, "x": x, "inputs": motion.inputs, "cost": motion.cost, "solved": True}
    ours |= {"iterations": motion.iterations, "unknowns": motion.unknowns}
    for name, way, milliseconds in (("discrete mechanics", ours, lasted), ("collocation", theirs, waited)):
        off = abs(way["x"][-1] - truly(system, way["x"][0], way["t"], way["inputs"])).max()
        line = f"{name:19} {task['steps']:5} {way['unknowns']:9} {way['iterations']:11} {milliseconds:6.0f}"
        line += f"  {way['cost']:<12.8g}  {off:.0e}"
        if momentum:
            line += f"  momentum {abs(momentum(*way['x'].T)).max():.0e}"
        print(line if way["solved"] else f"{line}  (not solved)")
    print(f"the stepper with the inputs found ends {abs(again.q[-1] - motion.q[-1]).max():.0e} from there")
    return motion
