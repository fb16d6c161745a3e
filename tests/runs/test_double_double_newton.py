"""Double-double steps whose stage equations Newton's method solves, against 60 digits and other coordinates."""

from fractions import Fraction

import numpy as np
import pytest
from mpmath import mp
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.extras.exact.step import derived_step
from scvi_codegen.methods import as_method
from scvi_codegen.methods.discretise import discretised_form
from scvi_codegen.runs.states.attitudes import momenta_of_body
from scvi_codegen.runs.states.words import fraction_of, two_words, word

pytestmark = pytest.mark.rotated

LINKS = "(x_dot**2 + y_dot**2)/2 + 0.75*(u_dot**2 + w_dot**2)/2 - y - 0.75*w"
MUTUAL = "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + 2*cos(a) + cos(b)"
RELATIVISTIC = "-sqrt(1 - x_dot**2 - y_dot**2) + 1/sqrt(x**2 + y**2) + sin(t)*x/8"
ROD, SECOND = "x**2 + y**2 - 1", "(u - x)**2 + (w - y)**2 - "
PLANE, FOUR = ["x", "y"], ["x", "y", "u", "w"]
PAIRS = [(3, 2), (5, 2), (7, 4), (9, 4)]
STATES = {
    "rod": ([0.6, -0.8], [0.8, 0.6]),
    "rods": ([0.6, -0.8, 1.6, -0.8], [0.8, 0.6, 0.8, 0.3]),
    "four-bar": ([0.0, 1.0, 3**0.5, 2.0], [0.0, 0.0, 0.0, 0.0]),
    "masses": ([0.7, -0.4], [0.3, 0.5]),
    "friction": ([0.7], [0.3]),
    "charge": ([0.7, 0.2], [0.1, 0.4]),
    "kepler": ([0.8, 0.0], [0.0, 1.2]),
    "sleigh": ([0.1, 0.2, 0.0], [0.5, 0.0, 0.2]),
    "damped": ([0.7, 0.2], [0.1, 0.4]),
    "relativistic": ([2.0, 0.125], [0.125, 0.5]),
}


def system(name: str) -> sc.LagrangianSystem:
    texts = {
        "rod": (PLANE, "m*(x_dot**2 + y_dot**2)/2 - m*y", {"parameters": {"m": 1.25}, "constraints": [ROD]}),
        "rods": (FOUR, LINKS, {"constraints": [ROD, f"{SECOND}1"]}),
        "four-bar": (FOUR, LINKS, {"constraints": [ROD, f"{SECOND}4", "(u - 2)**2 + w**2 - 2.25"]}),
        "masses": (["a", "b"], MUTUAL, {}),
        "friction": (["q"], "q_dot**2/2 - q**2/2", {"forces": {"q": "-q_dot/10"}}),
        "charge": (PLANE, "(x_dot**2 + y_dot**2)/2 + (x*y_dot - y*x_dot)/2 - (x**2 + y**2)**2/4", {}),
        "damped": (PLANE, "(x_dot**2 + y_dot**2)/2 - x**2/2 - x**2*y**2", {"damping": "g", "parameters": {"g": 0.3}}),
        "relativistic": (PLANE, RELATIVISTIC, {}),
        "kepler": (PLANE, "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)", {}),
        "sleigh": (
            [*PLANE, "phi"],
            "(x_dot**2 + y_dot**2 + phi_dot**2)/2 - x/3",
            {"constraints": ["x_dot*sin(phi) - y_dot*cos(phi)"]},
        ),
    }
    coordinates, text, further = texts[name]
    return sc.LagrangianSystem.from_text(name=name, coordinates=coordinates, lagrangian=text, **further)


def compiled(name: str, method: str) -> sc.Stepper:
    return sc.compile_stepper(system(name), method, precision="double-double")


def consistent(stepper: sc.Stepper, name: str) -> tuple:
    """Return the initial state on the constraints to 32 digits."""
    q, v = STATES[name]
    p = stepper.momentum(q, v)
    return stepper.project(q, p) if stepper.constraints else (q, p)


def largest(values) -> object:
    return max(map(abs, values))


def check_step(stepper: sc.Stepper, form, method: str, q, p, t: float = 0.0) -> None:
    """Compare the first step and a later one with the solution of the paper's equations in 60 digits."""
    h = 0.125
    run, derived = stepper.integrate(q, p, h=h, steps=3, t=t), derived_step(form, as_method(method, form))
    with mp.workdps(60):
        for k in (0, 2):
            exact = derived(*(list(run.mp(part)[k]) for part in "qp"), h, t + k * h)
            for part in "qp":
                values = getattr(exact, part)
                assert largest(a - b for a, b in zip(run.mp(part)[k + 1], values, strict=True)) < 3e-31 * largest(
                    values
                )


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("name", "method"),
    [
        *((name, "svi:3") for name in ("rod", "rods", "four-bar", "masses", "charge", "sleigh", "damped")),
        ("rod", "svi:1"),
        ("relativistic", "svi:4"),
        ("friction", "stoermer-verlet"),
        ("masses", "sc:3"),
        ("masses", "scvi:3"),
        ("kepler", "composition:4"),
    ],
)
def test_steps(name: str, method: str) -> None:
    """Steps are accurate to 3e-31: constraints, variable masses, velocities in forces, explicit methods."""
    stepper = compiled(name, method)
    check_step(stepper, system(name), method, *consistent(stepper, name), t=0.5)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("top", [False, True])
def test_rotations(top: bool) -> None:
    """The same for a free body and, in the moving frame, a heavy top, whose quaternions keep their length."""
    text = "w_1**2 + w_2**2 + w_3**2/2 - R_33" if top else "w_1**2/2 + w_2**2 + 3*w_3**2/2"
    body = sc.LagrangianSystem.from_text("body", rotations={"R": "w"}, lagrangian=text)
    q = np.full(4, 0.5)
    p = momenta_of_body(q, np.array([0.3, 0.4, 1.5]))
    stepper = sc.compile_stepper(body, "svi:2", precision="double-double")
    check_step(stepper, discretised_form(body, as_method("svi:2", body)), "svi:2", q, p)
    run = stepper.integrate(q, p, h=0.125, steps=200)
    with mp.workdps(40):
        assert largest(sum(x * x for x in row) - 1 for row in run.mp("q")) < 1e-30
        maps = run.mp("momentum_maps")
        assert largest(maps[-1] - maps[0]) < 1e-30


def test_first_order() -> None:
    """Steps of a guiding centre are accurate to 3e-31, and it stays where H has its value."""
    text = "(1 + x**2 + y**2)*(x*y_dot - y*x_dot)/2 - cos(x) - sin(y)"
    particle = sc.LagrangianSystem.from_text(name="particle", coordinates=PLANE, lagrangian=text)
    stepper = sc.compile_stepper(particle, "svi:4", precision="double-double")
    form = discretised_form(particle, as_method("svi:4", particle))
    check_step(stepper, form, "svi:4", {"x": 1.0, "y": 0.75}, None, t=0.5)
    run = stepper.integrate({"x": 1.0, "y": 0.75}, h=1 / 1024, steps=100)
    assert run.energy_error() < 1e-30
    v = stepper.velocity(run.q[-1], run.p[-1])
    with mp.workdps(40):
        y, x = run.mp("q")[-1][0], run.mp("p")[-1][0]  # b y' = H_x, b = 1 + 2 (x^2 + y^2)
        assert abs(v.mp()[0] + mp.sin(x) / (1 + 2 * (x * x + y * y))) < 1e-31


@pytest.mark.parametrize("h", [0.02, 0.001, 1e-5])
def test_constraints_from_rest_at_zero(h: float) -> None:
    """A four-bar linkage that starts from rest where its angles are 0 moves as with another origin of an angle.

    The constraints round at their terms, of size 5, not at the angles.
    """

    def run(c: str, start: int) -> sc.Trajectory:
        loop = [f"cos(a) - 4*cos(a + b) - 5*sin({c}) + 3", f"sin(a) - 4*sin(a + b) + 5*cos({c}) - 5"]
        linkage = lagrange(
            "linkage", "a b c", "(a_dot**2 + b_dot**2 + c_dot**2)/2", forces={"a": "1"}, constraints=loop
        )
        stepper = sc.compile_stepper(linkage, "svi:4", precision="double-double")
        return stepper.integrate([0, 0, start], velocity=[0, 0, 0], h=h, steps=5)

    runs = run("c", 0), run("(c - 1)", 1)
    with mp.workdps(40):
        q, moved = (each.mp("q")[-1] for each in runs)
        assert largest(q - moved + [0, 0, 1]) < 2e-31
        assert largest(runs[0].mp("p")[-1] - runs[1].mp("p")[-1]) < 2e-31 / h
    assert all(np.abs(values).max() < 1e-30 / h for values in runs[0].constraint_values())


def test_initial_states() -> None:
    """A state that violates the constraints is projected to 32 digits, and one that satisfies them is not moved."""
    stepper = compiled("rod", "svi:1")
    q, p = stepper.project([0.6, -0.8001], [0.8, 0.6])
    g, rate = stepper.constraint_values(q, p)
    assert max(abs(g).max(), abs(rate).max()) < 1e-31
    again = stepper.integrate(q, p, h=0.1, steps=1)
    assert (again.mp("q")[0] == q.mp()).all()
    assert (again.mp("p")[0] == p.mp()).all()
    assert np.abs(again.constraint_values()).max() < 1e-30
    with pytest.warns(sc.AccuracyWarning, match=r"violates the constraints by 1\.0e-04"):
        stepper.integrate([0.6, -0.8], velocity=[0.80006, 0.59992], h=0.1, steps=1)
    many = stepper.integrate_ensemble([q, [0.6, -0.8]], velocity=[stepper.velocity(q, p), [0.8, 0.6]], h=0.1, steps=1)
    assert np.abs(many[1].constraint_values()).max() < 1e-30
    circle = [(Fraction(a * a - b * b, a * a + b * b), Fraction(2 * a * b, a * a + b * b)) for a, b in PAIRS]
    exact = [[x, y] for x, y in circle], [[-y / 3, x / 3] for x, y in circle]
    many = stepper.integrate_ensemble(*exact, h=0.1, steps=1)
    for k, (x, y) in enumerate(zip(*exact, strict=True)):
        one = stepper.integrate(x, y, h=0.1, steps=1)
        for states in (one.q[0], many.q[0, k]):
            assert [fraction_of(each) for each in states] == [fraction_of(word(*two_words(each, ""))) for each in x]
        for states in (one.p[0], many.p[0, k]):
            assert [fraction_of(each) for each in states] == [fraction_of(word(*two_words(each, ""))) for each in y]
    many = stepper.integrate_ensemble([q, q], [p, p], h=0.1, steps=1)
    assert (many.q[-1] == again.q[-1]).all()
    assert (many.q.low[-1] == again.q.low[-1]).all()


@pytest.mark.parametrize("degree", [2, 5, 9, 18])
def test_iterations_of_mixed_precision(degree: int) -> None:
    """RATTLE, and iterations for velocities, continued in two words agree with the factors of all unknowns."""
    bar = "(x_dot**2 + x_dot*u_dot + u_dot**2 + y_dot**2 + y_dot*w_dot + w_dot**2)/6 - (y + w)/2"
    moved = "(x_dot**2 + m*y_dot**2)/2 - y - exp(-x*y)*sin(t)"
    bars = lagrange("bar", FOUR, bar, constraints=[ROD, f"{SECOND}1"])
    pivot = lagrange("moved", PLANE, moved, m=1.1, constraints=["x**2 + (y - sin(t)/10)**2 - 1"])
    for moving, state in (
        *((system(name), name) for name in ("rods", "masses", "relativistic")),
        *((bars, "rods"), (pivot, "rod"), (sc.reparametrise(system("kepler"), "frequency"), "kepler")),
    ):
        if moving.constraints and degree == 18:
            continue
        one, other = (
            sc.compile_stepper(moving, f"svi:{degree}", solver=solver, precision="double-double")
            for solver in ("auto", "newton")
        )
        words = "RATTLE_IN_PAIRS" if moving.constraints else "MIXED_VELOCITIES"
        assert (words in one.source.code, words in other.source.code) == (True, False)
        q, v = STATES[state]
        start = {"q": q, "velocity": v}
        if moving.constraints:
            start = dict(zip("qp", one.project(q, velocity=v), strict=True))
        for plan in ({"h": 0.0625, "steps": 5}, {"h": -0.0625, "t_end": -0.2}):
            runs = [stepper.integrate(**start, **plan) for stepper in (one, other)]
            assert moving.constraints or runs[0].fallback_steps == 0
            for name in ("q", "p", "t"):
                assert abs(runs[0].mp(name) - runs[1].mp(name)).max() < 1e-30
            if moving.constraints:
                assert max(abs(each).max() for each in runs[0].constraint_values()) < 5e-31
