"""Tables in formulas against SciPy's splines: values, ends, arrays, model files, messages."""

import numpy as np
import pytest
from notation import lagrange
from scipy.interpolate import make_interp_spline

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.systems.formulas.expressions import Tape, gradient

X = np.array([-2.0, -1.1, -0.4, 0.3, 0.7, 1.5, 2.0])


def spline(x, y, degree, outside, u):
    """Return value and slope of a spline of SciPy that goes on as a polynomial of degree 0 or 1 beyond its ends."""
    f, at = make_interp_spline(x, y, degree), np.clip(u, x[0], x[-1])
    slope = f(at, 1) * (outside == "linear" or x[0] <= u <= x[-1])
    return f(at) + slope * (u - at), slope


@pytest.mark.parametrize("degree", range(1, 6))
@pytest.mark.parametrize("outside", ["refuse", "constant", "linear"])
@pytest.mark.parametrize("order", [1, -1])
def test_values_and_slopes(degree, outside, order):
    table = sc.Table(X[::order], np.exp(X[::order]), degree=degree, outside=outside)
    system = lagrange("table", "x", "x_dot**2/2 + 3*F(2*x - 1)", functions={"F": table})
    x, v = *system.coordinates, *system.velocities
    tape = Tape([system.lagrangian, *gradient(system.lagrangian, [x]).values()], [x, v])
    for u in (-1.95, -1.0, *(X[1:-1] + 1e-9), 1.99, *([-3.1, 2.7] if outside != "refuse" else [])):
        value, slope = (float(number) for number in tape([mp.mpf((u + 1) / 2), mp.mpf(0)]))
        exact = spline(X, np.exp(X), degree, outside, u)
        assert abs(value - 3 * exact[0]) < 1e-13
        assert abs(slope - 6 * exact[1]) < 1e-12
    if outside == "refuse":
        with pytest.raises(ArithmeticError):
            tape([mp.mpf(1.6), mp.mpf(0)])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_values_of_two_arguments(degree):
    """The spline along the first axis of splines along the second."""
    y, z = X[:5] ** 2, np.cos(X)[:, None] + np.outer(X, np.arange(5.0) ** 2)
    y = np.cumsum(np.abs(y) + 0.1)
    table = sc.Table((X, y), z, degree=degree, outside="constant")
    system = lagrange("table", "x y", "(x_dot**2 + y_dot**2)/2 - F(x, y)", functions={"F": table})
    tape = Tape([system.lagrangian], [*system.coordinates, *system.velocities])
    for u, w in np.random.default_rng(0).uniform([-2.2, y[0] - 0.2], [2.2, y[-1] + 0.2], (9, 2)):
        rows = [spline(y, row, degree, "constant", w)[0] for row in z]
        exact = spline(X, np.array(rows), degree, "constant", u)[0]
        assert abs(float(tape([*map(mp.mpf, (u, w, 0.0, 0.0))])[0]) + exact) < 1e-12


TABLED = """
[system]
name = "cam"
coordinates = ["x", "y"]
lagrangian = "(x_dot**2 + y_dot**2)/2 - 9.81*y - G(x, y)"
constraints = ["y = F(x)"]
[functions.F]
x = [-1, 0, 1, 2, 3]
y = [1, 0, 1, 4, 9]
degree = 2
outside = "linear"
[functions.G]
x = [[-3, 1, 5], [9, 5, 0]]
y = [[0, 1, 0], [1, 1, 1]]
outside = "constant"
[forces]
x = "-F(x_dot)"
[initial]
q = [0.5, 0.25]
q_dot = [0.1, 0.1]
[run]
span = 1.0
[method]
method = "svi"
degree = 2
[[events]]
function = "F(x) - 0.3"
"""


@pytest.mark.rotated
def test_model_files():
    model = parse_model(TABLED.replace("[[0, 1, 0], [1, 1, 1]]", "[[0, 1, 0], [1, 1, 1], [2, 0, 2]]"))
    assert parse_model(dump_model(model)) == model
    stepper = sc.compile_stepper(model.system, model.method).with_events(model.events)
    run = stepper.integrate(model.q, velocity=[0.1, 0.1], t_end=1.0)
    x = run.events[0].q[0, 0]
    assert abs(x**2 - 0.3) < 1e-12
    assert abs(run.q[-1, 1] - run.q[-1, 0] ** 2) < 1e-12
    with pytest.raises(sc.ModelFileError, match=r"function 'G': y of a table must be .* shape \(3, 3"):
        parse_model(TABLED)


@pytest.mark.rotated
@pytest.mark.parametrize("plan", [{"h": 0.01, "steps": 500}, {"t_end": 5.0}])
def test_runs_end_where_a_table_ends(plan):
    system = lagrange("ramp", "x", "x_dot**2/2 - F(x - 1)", functions={"F": sc.Table([0, 1, 3], [0, 1, 2])})
    message = r"The table F\(x - 1\) is given for 0 <= x - 1 <= 3; before this step x - 1 = (2.9|3)"
    with pytest.raises(sc.StepFailedError, match=message) as failure:
        sc.compile_stepper(system, "svi:2").integrate([1.5], [3.0], **plan)
    assert 3.9 < failure.value.trajectory.q[-1, 0] < 4.03
