"""One fixed-point iteration agrees to round-off with its formulas, with SymPy's derivatives, for one point.

The next iterations correct errors of one as long as they converge, so that the solution does not show them.
"""

import itertools
from functools import partial

import numpy as np
import pytest
import sympy
from notation import lagrange
from samples import QUICK_FLAGS, pumped_cart_pole, tangle

from scvi_codegen import SVI, LagrangianSystem, SolverOptions, Stepper, compile_stepper, hamiltonian_of, problem
from scvi_codegen.systems.system import MechanicalSystem

H, T, STATES = 0.1, 0.7, 20
ONE_ITERATION = SolverOptions(tolerance=1e300, absolute=True)
ROUNDING = 64 * 2.0**-52


def iterated(system: MechanicalSystem) -> Stepper:
    return compile_stepper(system, SVI(1), solver="fixed-point", flags=QUICK_FLAGS)


def functions(system: MechanicalSystem):
    """Slopes of L by q and v, or of H by q and p, and second ones by the latter; of (q, v or p, t)."""
    q, second, t = system.coordinates, system.auxiliaries or system.velocities, system.time
    formula = system.formula.subs(system.constants)
    by_q, by_second = ([formula.diff(x) for x in symbols] for symbols in (q, second))
    curvature = sympy.Matrix(by_second).jacobian(second)
    return tuple(map(partial(as_numbers, [q, second, t]), (by_q, by_second, curvature)))


def partials(system: MechanicalSystem):
    """F_q, F_v and L_vq."""
    q, v, L = system.coordinates, system.velocities, system.formula.subs(system.constants)
    by_q, by_v = (sympy.Matrix([L.diff(x) for x in symbols]) for symbols in (q, v))
    matrices = by_q.jacobian(q), by_q.jacobian(v), by_v.jacobian(q)
    return tuple(map(partial(as_numbers, [q, v, system.time]), matrices))


def rotating() -> LagrangianSystem:
    """A plane rotating frame: constant masses, momenta that depend on positions, forces that are no polynomials."""
    return lagrange("rotating", "x y", "(x_dot**2 + y_dot**2)/2 + x*y_dot - y*x_dot + 1/sqrt(x**2 + y**2 + 2)")


def leaning() -> LagrangianSystem:
    """Three coordinates whose constant masses all meet."""
    text = "x_dot**2 + y_dot**2 + z_dot**2 + x_dot*y_dot/2 + y_dot*z_dot/3 + x_dot*z_dot/5 + x*y*z_dot - x**4"
    return lagrange("leaning", "x y z", text)


def relativistic() -> LagrangianSystem:
    """Masses that depend on velocities alone."""
    return lagrange("relativistic", "x y", "-sqrt(1 - x_dot**2/2 - y_dot**2/3) - x**2*y")


def as_numbers(arguments, expression):
    function = sympy.lambdify(arguments, expression)
    return lambda *values: np.array(function(*values), dtype=float)


def states(dimension: int):
    generator = np.random.default_rng(7)
    return generator.uniform(-0.6, 0.6, (STATES, 2, dimension))


def close(found, expected) -> bool:
    return bool(np.max(np.abs(np.concatenate(found) - np.concatenate(expected))) < ROUNDING)


@pytest.mark.rotated
@pytest.mark.parametrize("system", [tangle(), pumped_cart_pole(), rotating()], ids=lambda system: system.name)
def test_velocities_are_updated_by_the_full_mass_matrix_to_first_order(system):
    stepper, (force, momentum, mass) = iterated(system), functions(system)
    assert "#define FOLLOWED" in stepper.source.code
    F_q, F_v, P_q = partials(system)
    for q0, v0 in states(system.dimension):
        p0, t = momentum(q0, v0, T), T + H / 2
        at = q0 + H / 2 * v0, v0, t
        residual = p0 + H / 2 * force(*at) - momentum(*at)
        r = np.linalg.solve(mass(*at), residual)
        residual += H / 2 * (H / 2 * F_q(*at) @ r + F_v(*at) @ r) - H / 2 * P_q(*at) @ r
        r = np.linalg.solve(mass(*at), residual)
        expected = q0 + H * (v0 + r), p0 + H * (force(*at) + H / 2 * F_q(*at) @ r + F_v(*at) @ r)
        assert close(stepper.step(q0, p0, H, T, options=ONE_ITERATION), expected)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    "system", [problem("charged-particle").system, leaning(), relativistic()], ids=lambda system: system.name
)
def test_constant_masses_update_velocities_and_forces_at_the_same_iterate(system):
    stepper, (force, momentum, mass) = iterated(system), functions(system)
    assert "#define FOLLOWED" not in stepper.source.code
    for q0, v0 in states(system.dimension):
        p0, t = momentum(q0, v0, T), T + H / 2
        x = q0 + H / 2 * v0
        v = v0 + np.linalg.solve(mass(x, v0, t), p0 + H / 2 * force(x, v0, t) - momentum(x, v0, t))
        expected = q0 + H * v, p0 + H * force(q0 + H / 2 * v, v, t)
        assert close(stepper.step(q0, p0, H, T, options=ONE_ITERATION), expected)


@pytest.mark.rotated
def test_many_coordinates_do_not_request_the_jacobian():
    """The Jacobian has the square of their number of entries; masses of the chain of nine depend on positions."""
    names = [f"a{k}" for k in range(9)]
    coupled = " + ".join(f"{a}_dot**2 + {a}_dot*{b}_dot*cos({a} - {b})" for a, b in itertools.pairwise([*names, "a0"]))
    chain = LagrangianSystem.from_text(name="ring of nine", coordinates=names, lagrangian=coupled)
    assert "support/iteration/corrections.h" in iterated(chain).source.files


@pytest.mark.second
def test_momenta_follow_forces_and_velocities_follow_momenta():
    system = hamiltonian_of(problem("charged-particle").system)
    stepper, (derivative, velocity, _) = iterated(system), functions(system)
    assert "support/iteration/hamiltonian_iteration.h" in stepper.source.files
    for q0, p0 in states(system.dimension):
        t, v0 = T + H / 2, velocity(q0, p0, T)
        p = p0 - H / 2 * derivative(q0 + H / 2 * v0, p0, t)
        v = velocity(q0 + H / 2 * v0, p, t)
        expected = q0 + H * v, p0 - H * derivative(q0 + H / 2 * v, p, t)
        assert close(stepper.step(q0, p0, H, T, options=ONE_ITERATION), expected)
