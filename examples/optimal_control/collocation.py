"""Direct collocation at Gauss points in CasADi, the standard method, for comparison with discrete mechanics.

The equations of motion are solved for the accelerations by SymPy, from L and the forces; neither they nor the
collocation share code with the compiler.
"""

import casadi as ca
import numpy as np
import sympy as sp
from scipy.interpolate import BPoly

QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


class Motion:
    """Accelerations as functions of (q, v, inputs), and formulas of a problem, in any library's symbols."""

    def __init__(self, system):
        q, v = list(system.coordinates), list(system.velocities)
        values, held = system.constants, [sp.Symbol(f"{name}_0", real=True) for name in system.inputs]
        rest = {symbol: values[symbol] for symbol in system.parameters if symbol not in held}  # other powers of time: 0
        L, forces = system.lagrangian.subs(rest), [force.subs(rest) for force in system.forces]
        momenta = [sp.diff(L, each) for each in v]
        pushes = [
            sp.diff(L, q[i]) + forces[i] - sum(sp.diff(momenta[i], x) * x_dot for x, x_dot in zip(q, v, strict=True))
            for i in range(len(q))
        ]
        self.system, self.states, self.names = system, [q, v, held], [each.name for each in (*q, *v)]
        self.accelerations = list(sp.Matrix(momenta).jacobian(v).LUsolve(sp.Matrix(pushes)))
        self.seen = {each.name: each for each in (*q, *v)} | dict(zip(system.inputs, held, strict=True))

    def called(self, library, texts=()):
        """Return a function of lists q, v and inputs: the accelerations, then the values of formulas."""
        formulas = [*self.accelerations, *(sp.sympify(text, self.seen) for text in texts)]
        return sp.lambdify(self.states, formulas, library, cse=True)


def gauss_tableau(stages):
    """Return A, b and c of the Gauss method."""
    c = (np.polynomial.legendre.leggauss(stages)[0] + 1) / 2
    powers = np.arange(1, stages + 1)
    inverse = np.linalg.inv(np.vander(c, increasing=True))
    return (c[:, np.newaxis] ** powers / powers) @ inverse, (1 / powers) @ inverse, c


def collocated_step(motion, stages, degree, texts):
    """Return a function from (x, derivatives, inputs, h) to the next x, residuals, and formulas with integrals."""
    m, (A, b, c) = motion.system.dimension, gauss_tableau(stages)
    called = motion.called(ca, texts)
    x0, partials, h = ca.SX.sym("x", 2 * m), ca.SX.sym("k", 2 * m, stages), ca.SX.sym("h")
    u = ca.SX.sym("u", len(motion.system.inputs), degree + 1)
    residuals, along = [], []
    for line, place, at in zip(A, c, range(stages), strict=True):
        x = x0 + h * (partials @ line)
        basis = BPoly(np.eye(degree + 1)[:, np.newaxis], [0, 1])(place)
        found = called(ca.vertsplit(x[:m]), ca.vertsplit(x[m:]), ca.vertsplit(u @ basis))
        residuals.append(partials[:, at] - ca.vertcat(x[m:], *found[:m]))
        along.append(ca.vertcat(*found[m:]))
    along = ca.horzcat(*along)
    found = [x0 + h * (partials @ b), ca.vertcat(*residuals), along, h * along @ b]
    return ca.Function("step", [x0, partials, u, h], found)


def collocated(system, stages, *, steps, duration, start, end, cost, guess, bounds=None, degree=0):
    """Solve a problem with the main arguments of :func:`scvi_codegen.optimal_control`; return a dictionary."""
    motion, bounds, m, k = Motion(system), bounds or {}, system.dimension, len(system.inputs)
    between = [text for text in bounds if text not in system.inputs]
    step = collocated_step(motion, stages, degree, [cost, *between])
    x, partials = ca.MX.sym("x", 2 * m, steps + 1), ca.MX.sym("partials", 2 * m, stages * steps)
    u, lasting = ca.MX.sym("u", k, steps * (degree + 1)), ca.MX.sym("duration")
    reached, residuals, along, integrals = step.map(steps)(x[:, :-1], partials, u, ca.repmat(lasting / steps, 1, steps))
    constraints = [(x[:, 1:] - reached, 0, 0), (residuals, 0, 0)]
    for column, conditions in ((x[:, 0], start), (x[:, -1], end)):
        constraints += [(column[motion.names.index(name)], value, value) for name, value in conditions.items()]
    constraints += [(along[row, :], *limits(bounds[text])) for row, text in enumerate(between, 1)]

    unknowns = ca.veccat(x, partials, u, lasting)
    program = {"x": unknowns, "f": ca.sum2(integrals[0, :]), "g": ca.veccat(*(each for each, _, _ in constraints))}
    solver = ca.nlpsol("collocation", "ipopt", program, QUIET)
    pushes = np.array([limits(bounds.get(name, (None, None))) for name in system.inputs])
    lasts = np.broadcast_to(duration, 2)
    free = np.full(x.numel() + partials.numel(), np.inf)
    lowest, highest = (
        np.concatenate([sign * free, np.tile(pushes[:, side], steps * (degree + 1)), lasts[[side]]])
        for side, sign in ((0, -1), (1, 1))
    )
    least, largest = (np.concatenate([np.full(each[0].numel(), each[side]) for each in constraints]) for side in (1, 2))
    first = first_guess(system, stages, steps, guess, guess.get("duration", lasts.mean()))
    beginning = np.concatenate([*first, np.zeros(u.numel()), [guess.get("duration", lasts.mean())]])
    found = solver(x0=beginning, lbx=lowest, ubx=highest, lbg=least, ubg=largest)
    states, inputs, lasted = (each.full() for each in ca.Function("split", [unknowns], [x, u, lasting])(found["x"]))
    t = np.linspace(0, lasted.item(), steps + 1)
    inputs = inputs.reshape(k, steps, degree + 1)
    return {
        "t": t,
        "x": states.T,
        "inputs": {name: BPoly(own.T, t) for name, own in zip(system.inputs, inputs, strict=True)},
        "cost": float(found["f"]),
        "iterations": solver.stats()["iter_count"],
        "unknowns": unknowns.numel(),
        "solved": solver.stats()["success"],
    }


def limits(pair):
    """Return least and largest value, without ``None``."""
    return (-np.inf if pair[0] is None else pair[0], np.inf if pair[1] is None else pair[1])


def first_guess(system, stages, steps, guess, duration):
    """Return states and derivatives of the guess, flat."""
    fractions = np.linspace(0, 1, steps + 1)
    given = [np.atleast_1d(guess[q.name]) for q in system.coordinates]
    q = np.array([np.interp(fractions, np.linspace(0, 1, len(own)), own) for own in given])
    x = np.concatenate([q, np.gradient(q, fractions * duration, axis=1)])
    partials = np.diff(x) * steps / duration
    return x.ravel("F"), np.repeat(partials, stages, axis=1).ravel("F")
