"""Predictor of fixed-point iterations: exact where the motion is a polynomial of the degree of the method's curves."""

import pytest
from notation import lagrange
from numpy.polynomial import Polynomial

import scvi_codegen as sc
from scvi_codegen.codegen.lowering.control import predictor_of
from scvi_codegen.codegen.lowering.program import lower
from scvi_codegen.methods.tables.basis import identity_matrix

ENERGIES = {
    "separable": ("x_dot**2/2", "x**2/2", "x", 1.0),
    "coupled": ("(x_dot**2 + y_dot**2)/2 + x_dot*y_dot/3", "(x**2 + y**2)/2", "x + y", 4 / 3),
    "hamiltonian": ("p_x**2/2", "x**2/2", "x", 1.0),
    "array": ("sum(i in N, x_dot[i]**2/2)", "sum(i in N, x[i]**2/2)", "sum(i in N, x[i])", 1.0),
    "array with friction": ("sum(i in N, x_dot[i]**2/2)", "sum(i in N, x[i]**2/2)", "sum(i in N, x[i])", 1.0),
    "array hamiltonian": ("sum(i in N, p_x[i]**2/2)", "sum(i in N, x[i]**2/2)", "sum(i in N, x[i])", 1.0),
}
"""Kinetic energy, potential, sum of the coordinates, and mass of the motion in which all coordinates are equal."""
STEPS, MOST, FRICTION = 6, 3, 0.25


def motion(degree):
    return Polynomial([0.3, 0.7, *(0.4 / k for k in range(1, degree))])


def oscillators(kind, degree):
    """Return oscillators with a force for which the polynomial is the solution, and their masses."""
    kinetic, potential, coordinates, mass = ENERGIES[kind]
    friction = FRICTION * ("friction" in kind)
    force = motion(degree) + friction * motion(degree).deriv() + mass * motion(degree).deriv(2)
    pushed = "(" + " + ".join(f"{float(c)!r}*t**{k}" for k, c in enumerate(force.coef)) + f")*({coordinates})"
    if "hamiltonian" in kind:
        group, given = sc.HamiltonianSystem, {"hamiltonian": f"{kinetic} + {potential} - {pushed}"}
    else:
        group, given = sc.LagrangianSystem, {"lagrangian": f"{kinetic} - {potential} + {pushed}"}
    if "array" in kind:
        forces = {"x[i]": f"-{friction}*x_dot[i]"} if friction else None
        system = group.from_text(name=kind, coordinates=["x[N]"], forces=forces, **given)
        return system, [mass] * 3
    names = ["x", "y"] if "y" in coordinates else ["x"]
    system = group.from_text(name=kind, coordinates=names, **given)
    return system, [mass] * len(names)


@pytest.mark.rotated
@pytest.mark.covering
@pytest.mark.parametrize("degree", [3, 9], ids=["one vector of points", "several"])
@pytest.mark.parametrize("kind", ENERGIES)
def test_polynomial_motions_need_no_iterations_after_the_first_step(kind, degree):
    system, masses = oscillators(kind, degree)
    made = sc.compile_stepper(system, f"svi:{degree}", solver="fixed-point")
    exact = motion(degree)
    run = made.start([exact(0.0)] * len(masses), [mass * exact.deriv()(0.0) for mass in masses], h=0.2)
    counts = []
    for _ in range(STEPS):
        before = run.iterations
        run.advance(1)
        counts.append(run.iterations - before)
    assert counts[0] > MOST >= max(counts[1:])
    q = run.q["x"] if "array" in kind else run.q
    assert q == pytest.approx([exact(STEPS * 0.2)] * len(masses), rel=1e-14)


@pytest.mark.parametrize("kind", ["separable", "coupled", "hamiltonian"])
def test_curves_of_rejected_steps_are_interpolated(kind):
    """A step that is 2^(-k/4) times as long as the rejected one and begins with it."""
    system, _ = oscillators(kind, 4)
    iteration = lower(system, sc.SVI(4), prefix="inside", solver="fixed-point").fixed_point
    inside, points = predictor_of(iteration).inside, [float(c) for c in iteration.guess.abscissae]
    through = iteration.predictor_matrix or identity_matrix(len(points))
    of = Polynomial([0.3, -1.0, 0.7, 2.0])
    for k, table in enumerate(inside, start=1):
        shorter = [of(2 ** (-k / 4) * c) for c in points]
        for row, into in zip(table[:4], through, strict=False):
            predicted = sum(a * of(c) for a, c in zip(row, points, strict=False))
            assert predicted == pytest.approx(sum(float(a) * x for a, x in zip(into, shorter, strict=False)), abs=1e-14)


@pytest.mark.rotated
def test_rejected_steps_cost_few_iterations():
    system = lagrange("kepler", "x y", "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)")
    run = sc.compile_stepper(system, "svi:8").integrate([1.5, 0.0], [0.0, 3**-0.5], t_end=2000.0, tolerance=1e-5)
    assert run.rejected_steps > run.steps / 10
    assert run.iterations.sum() / run.steps < 4.6  # 4.9 from the straight line
