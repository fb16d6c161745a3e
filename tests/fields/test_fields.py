"""Fields from densities: conservation, frequencies, and errors by name."""

import numpy as np
import pytest
import sympy
from numpy import cos, pi, sin
from samples import QUICK_FLAGS

import scvi_codegen as sc


def string(density="u_t**2/2 - u_x**2/2", **others):
    return sc.FieldSystem.from_text("string", ["u"], {"x": (0, 1)}, density, **others)


PLANE = {"x": (0, "2*pi"), "y": (0, "2*pi")}
PERIODIC = dict.fromkeys(PLANE, "periodic")


@pytest.mark.second
def test_momentum_of_waves_is_conserved_by_fourier():
    field = sc.FieldSystem.from_text(
        "Klein-Gordon", ["u"], {"x": (0, "2*pi")}, "u_t**2/2 - u_x**2/2 - u**2/2", boundary={"x": "periodic"}
    )
    mesh = field.discretise("fourier", points=24)
    draw = np.random.default_rng(0).normal(size=(2, 24))
    stepper = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS)
    run = stepper.integrate({"u": draw[0]}, velocity={"u": draw[1]}, h=0.02, steps=200)
    momentum = mesh.integral(run.p["u"] / mesh.weights * mesh.derivative(run.q["u"], "x"))
    assert np.ptp(momentum) < 2e-13 < abs(momentum[0])


@pytest.mark.parametrize(
    ("method", "options"), [("spectral-elements", {"degree": 9, "elements": 5}), ("fourier", {"points": 24})]
)
def test_integral_derivative_and_resolution(method, options):
    field = sc.FieldSystem.from_text("torus", ["u"], PLANE, "u_t**2/2 - u_x**2/2 - u_y**2/2", boundary=PERIODIC)
    mesh = field.discretise(method, **options)
    x, y = mesh.points["x"], mesh.points["y"]
    u = sin(2 * x) * cos(y)
    assert mesh.integral(np.stack([u**2, 0 * u + 1])) == pytest.approx([pi**2, 4 * pi**2], rel=1e-9)
    assert mesh.derivative(u, "x") == pytest.approx(2 * cos(2 * x) * cos(y), abs=1e-5)
    assert mesh.derivative(u, "y") == pytest.approx(-sin(2 * x) * sin(y), abs=1e-5)
    assert mesh.unresolved(u) < 1e-8
    assert mesh.unresolved(np.random.default_rng(0).normal(size=(3, *u.shape))).shape == (3,)
    assert mesh.unresolved(np.random.default_rng(0).normal(size=u.shape)) > 0.02
    assert mesh.unresolved(0 * u) == 0


def test_derivative_at_prescribed_ends_and_between_elements():
    mesh = string(boundary={"x": (0, "natural")}).discretise("spectral-elements", degree=8, elements=[0, 0.3, 1])
    x = mesh.points["x"]
    assert mesh.derivative(x * (1 + x), "x") == pytest.approx(1 + 2 * x, abs=1e-12)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("field", "method", "options"),
    [
        (string(boundary={"x": (0, 0)}), "spectral-elements", {"degree": 6, "elements": [0, 0.4, 1]}),
        (string("u_t**2 - 3*u_x**2/2 - 50*u**2", boundary={"x": "periodic"}), "fourier", {"points": 16}),
        (string(boundary={"x": "periodic"}), "finite-differences", {"order": 4, "points": 16}),
        (string("u_t**2/2 - u_xx**2/2", boundary={"x": "periodic"}), "finite-differences", {"order": 2, "points": 16}),
        (
            string("(1 + 9*x)*u_t**2/2 - (3 - x)*u_x**2/2", boundary={"x": (0, 0)}),
            "finite-differences",
            {"order": 2, "points": 32},
        ),
        (
            string("(9 - 8*x)*u_t**2/2 - u_x**2/2 - (1 + 5000*x)*u**2/2"),
            "spectral-elements",
            {"degree": 4, "elements": 8},
        ),
    ],
)
def test_highest_frequency_is_a_close_upper_bound(field, method, options):
    mesh = field.discretise(method, **options)
    count = len(mesh.points["x"])
    stepper = sc.compile_stepper(mesh.system, "svi:1", flags=QUICK_FLAGS)
    h = 1e-4
    jacobian = np.asarray(stepper.jacobian({"u": np.zeros(count)}, np.zeros(count), h))
    highest = np.abs(np.log(np.linalg.eigvals(jacobian).astype(complex)).imag).max() / h
    assert highest * (1 - 1e-6) < mesh.highest_frequency() < 2 * highest


def test_equations_are_those_of_euler_and_lagrange():
    x, y, t = sympy.symbols("x y t")
    u = sympy.Function("u")(x, y, t)
    field = sc.FieldSystem.from_text(
        "plate", ["u"], {"x": (0, 1), "y": (0, 1)}, "2*u_t**2 - u_xy**2/2 - y*u_x**2/2 - u**4/4", parameters={}
    )
    equation = field.euler_lagrange()["u"]
    expected = (y * u.diff(x, 2) - u**3 - u.diff(x, 2, y, 2)) / 4
    assert str(equation.rhs) == str(sympy.expand(expected))
    density = 2 * u.diff(t) ** 2 - u.diff(x, y) ** 2 / 2 - y * u.diff(x) ** 2 / 2 - u**4 / 4
    space = {"x": (0, 1), "y": (0, 1)}
    assert sc.FieldSystem.from_sympy(name="plate", fields=[u], space=space, density=density) == field


def test_sympy_expressions_of_momenta_damping_and_places_are_those_of_text():
    x, t, k = sympy.symbols("x t k")
    u, p, X = (sympy.Function(name)(*arguments) for name, *arguments in (("u", x, t), ("p", x, t), ("X", t)))
    common = {"space": {"x": (0, 1)}, "parameters": {"k": 2.0}, "boundary": {"x": ("natural", 0)}}
    text = sc.FieldSystem.from_text("a", ["u"], hamiltonian="u_x**2/2 + p_x**2/2 + k*u*p", momenta=["p"], **common)
    hamiltonian = u.diff(x) ** 2 / 2 + p.diff(x) ** 2 / 2 + k * u * p
    assert sc.FieldSystem.from_sympy(name="a", fields=[u], momenta=[p], hamiltonian=hamiltonian, **common) == text
    place = "X_t**2/2 - k*(u - X)**2/2"
    text = sc.FieldSystem.from_text(
        "b",
        ["u"],
        density="u_t**2/2",
        dissipation="x*u_t**2",
        scalars=["X"],
        point_lagrangians=[{"x": "1/2", "lagrangian": place}],
        **common,
    )
    symbolic = sc.FieldSystem.from_sympy(
        name="b",
        fields=[u],
        density=u.diff(t) ** 2 / 2,
        dissipation=x * u.diff(t) ** 2,
        scalars=[X],
        point_lagrangians=[{"x": 0.5, "lagrangian": X.diff(t) ** 2 / 2 - k * (u - X) ** 2 / 2}],
        **common,
    )
    assert symbolic == text
    assert symbolic.derive().to_text().endswith("conservation laws: none found, the density is damped\n")


@pytest.mark.rotated
def test_other_parameters_and_arrays_of_a_run_replace_those_of_the_mesh():
    mesh = string("u_t**2/2 - c*u_x**2/2", boundary={"x": (0, 0)}, parameters={"c": 1}).discretise(
        "spectral-elements", degree=6, elements=2
    )
    x = mesh.points["x"]
    stepper = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS)
    one, two = (
        stepper.integrate({"u": sin(pi * x)}, h=0.01, steps=20, parameters=each).q["u"][-1]
        for each in ({"c": 4.0}, {"c": 4.0, "weight_x": 4 * mesh.weights})
    )
    assert one == pytest.approx(sin(pi * x) * cos(0.4 * pi), abs=2e-4)
    assert two == pytest.approx(sin(pi * x) * cos(0.2 * pi), abs=2e-4)


def test_korteweg_de_vries_needs_fourier_modes():
    """Its density is one of u = q_x/2 + p alone, -u^3 has no lower bound; with u^4 all meshes serve."""
    arguments = {"space": {"x": (0, 1)}, "fields": ["q"], "momenta": ["p"], "boundary": {"x": "periodic"}}
    for power, refused in (("- (q_x/2 + p)**3", True), ("+ (q_x/2 + p)**4", False), ("- p**3", False)):
        field = sc.FieldSystem.from_text("kdv", hamiltonian=f"(q_xx/2 + p_x)**2/2 {power}", **arguments)
        field.discretise("fourier", points=15)
        for method, options in (("finite-differences", {"order": 2, "points": 9}), ("legendre", {"degree": 4})):
            if refused:
                with pytest.raises(sc.SystemDefinitionError, match="Use 'fourier' with an odd number of points"):
                    field.discretise(method, **options)
            else:
                field.discretise(method, **options)


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("ends", ["natural", (0, 0), (0, "natural"), ("natural", 0)])
@pytest.mark.parametrize("others", ["natural", (0, 0)])
def test_mixed_derivatives_are_exact_for_polynomials_at_all_ends(ends, others):
    """Int u_xy^2/2 of u = x (1 - x) y (1 - y), which is 1/18, in elements at prescribed and natural ends."""
    field = sc.FieldSystem.from_text(
        "plate", ["u"], {"x": (0, 1), "y": (0, 1)}, "u_t**2/2 - u_xy**2/2", boundary={"x": ends, "y": others}
    )
    mesh = field.discretise("spectral-elements", degree=3, elements=2)
    x, y = mesh.points["x"], mesh.points["y"]
    stepper = sc.compile_stepper(mesh.system, "stoermer-verlet", flags=QUICK_FLAGS)
    u = x * (1 - x) * y * (1 - y)
    assert stepper.energy({"u": u}, {"u": 0 * u}) == pytest.approx(1 / 18, rel=1e-13)


@pytest.mark.parametrize(
    ("ends", "method", "options"),
    [
        (("sin(t)", "natural"), "spectral-elements", {"degree": 3, "elements": [0, 0.25, 1]}),
        (("clamped", 0), "spectral-elements", {"degree": 4, "elements": 4}),
        ("periodic", "finite-differences", {"order": 2, "points": 16}),
        ("periodic", "fourier", {"points": 32}),
        ("periodic", "fourier", {"points": 8}),
    ],
)
def test_semi_discrete_lagrangian_is_read_back_from_its_text(ends, method, options):
    second = "" if ends == ("sin(t)", "natural") else " - u_xx**4*u"
    system = string(f"(1 + x)*u_t**2/2 - x*u_x**2/2 - u_x**3{second}", boundary={"x": ends}).discretise(
        method, **options
    )
    system = system.system
    known = system.definition
    read = sc.LagrangianSystem.from_text(
        "read",
        known["coordinates"],
        known["lagrangian"],
        tables=known.get("tables", ()),
        parameters={str(array): 1.0 for array in system.fields},
    )
    at = {str(slot): k / 8 for k, slot in enumerate(sorted({s for term in read.terms for s, _ in term.slots}, key=str))}
    rule = {sympy.Symbol(name, real=True): value for name, value in {**at, "t": 0.3}.items()}
    assert [(term.loops, term.slots) for term in read.terms] == [(term.loops, term.slots) for term in system.terms]
    for one, other in zip(read.terms, system.terms, strict=True):
        assert float(one.formula.xreplace(rule)) == pytest.approx(float(other.formula.xreplace(rule)), rel=1e-12)


@pytest.mark.parametrize("method", [{"degree": 6, "elements": 2}, {"degree": 9}])
def test_derivatives_take_prescribed_ends(method):
    """The interpolant of 1 + x**2 has the prescribed values 1 and 2 at its ends, which are not among the points."""
    string = sc.FieldSystem.from_text(
        "string", ["u"], {"x": (0, 1)}, "u_t**2/2 - u_x**2/2", boundary={"x": [{"u": "1"}, {"u": "2"}]}
    )
    mesh = string.discretise("legendre" if "elements" not in method else "spectral-elements", **method)
    x = mesh.points["x"]
    with pytest.raises(sc.StateError, match="prescribes values other than 0 at an end of x"):
        mesh.derivative(1 + x**2, "x")
    assert mesh.derivative(1 + x**2, "x", ends=(1.0, 2.0)) == pytest.approx(2 * x, abs=1e-12)
    several = np.array([1 + x**2, 1 + x**2 + 3 * x])
    ends = np.array([1.0, 1.0]), np.array([2.0, 5.0])
    assert mesh.derivative(several, "x", ends=ends) == pytest.approx(np.array([2 * x, 2 * x + 3]), abs=1e-12)


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.MethodWarning")
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
def test_densities_with_steps_and_positive_parts_have_a_highest_frequency():
    """A step in the stiffness from 1 to 4 lies between the frequencies of both."""

    def frequency(stiffness):
        density = f"u_t**2/2 - ({stiffness})*u_x**2/2 - positive_part(u - 1)**2 - rint(x)*u**2/2"
        ring = sc.FieldSystem.from_text("ring", ["u"], {"x": (0, 1)}, density, boundary={"x": "periodic"})
        return ring.discretise("finite-differences", order=2, points=32)

    between = frequency("1 + 3*unit_step(x - 1/2)")
    assert between.highest_frequency() == pytest.approx(frequency("4").highest_frequency(), rel=1e-12)
    assert between.largest_step("svi:2") < frequency("1").largest_step("svi:2")
    stepper = sc.compile_stepper(between.system, "svi:2")
    run = stepper.integrate({"u": np.ones(32)}, h=0.01, steps=2)
    assert run.t[-1] == 0.02
