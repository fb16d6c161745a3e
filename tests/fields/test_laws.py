"""Conservation laws of densities: symmetries found, laws that hold on solutions, and values along runs."""

import numpy as np
import pytest
import sympy
from numpy import cos, exp, pi, sin
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.extras.fields.laws import vanishes

pytestmark = pytest.mark.second

PLANE = {"x": (0, "2*pi"), "y": (0, "2*pi")}
PERIODIC = dict.fromkeys(PLANE, "periodic")
LINE = {"x": (-1, 1)}
SPEED = {"c": 2}


def lagrangian(density, fields="u", space=LINE, **others):
    return sc.FieldSystem.from_text("field", [*fields], space, density, **others)


def schroedinger(fields, momenta, hamiltonian, bounds=(-20, 20)):
    return sc.FieldSystem.from_text(
        "Schroedinger",
        [*fields],
        {"x": bounds},
        hamiltonian=hamiltonian,
        momenta=[*momenta],
        boundary={"x": "periodic"},
    )


SOLID = "u_t**2/2 + v_t**2/2 - (u_x + v_y)**2/2 - (u_x**2 + v_y**2 + (v_x + u_y)**2/2)"
CUBIC = "(a_x**2 + b_x**2)/4 - (a**2 + b**2)**2/4"
TRANSLATIONS = "energy momentum_x"
LAWS = {
    "sine-Gordon": (lagrangian("u_t**2/2 - u_x**2/2 + cos(u)"), f"{TRANSLATIONS} boost_x"),
    "waves": (lagrangian("u_t**2 - c*u_x**2/2", parameters=SPEED), f"{TRANSLATIONS} shift boost_x"),
    "medium": (lagrangian("u_t**2/2 - (1 + x**2)*u_x**2/2 - u**2/2"), "energy"),
    "driven": (lagrangian("u_t**2/2 - u_x**2/2 + sin(t)*u**2/2"), "momentum_x"),
    "beam": (lagrangian("u_t**2/2 - u_xx**2/2"), f"{TRANSLATIONS} shift"),
    "pair": (lagrangian("u_t**2/2 + v_t**2/2 - u_x**2/2 - v_x**2/2 - (u**2 + v**2)**2", "uv"),
             f"{TRANSLATIONS} charge boost_x"),
    "two speeds": (lagrangian("u_t**2/2 + v_t**2/2 - u_x**2/2 - 2*v_x**2/2 - u**2*v**2", "uv"), TRANSLATIONS),
    "membrane": (lagrangian("u_t**2/2 - sqrt(1 + u_x**2 + u_y**2)", space=PLANE),
                 f"{TRANSLATIONS} momentum_y shift"),
    "plate": (lagrangian("u_t**2/2 - u_xy**2/2 - u_xx**2/2", space=PLANE), f"{TRANSLATIONS} momentum_y shift"),
    "solid": (lagrangian(SOLID, "uv", PLANE), f"{TRANSLATIONS} momentum_y shift_u shift_v"),
    "cubic": (schroedinger("a", "b", CUBIC), f"{TRANSLATIONS} charge boost_x"),
    "two waves": (schroedinger("ac", "bd", "(a_x**2 + b_x**2 + c_x**2 + d_x**2)/4 - (a**2 + b**2)*(c**2 + d**2)"),
                  f"{TRANSLATIONS} charge_a_b charge_c_d charge boost_x"),
    "mixed waves": (schroedinger("ac", "bd", "(a_x**2 + b_x**2 + c_x**2 + d_x**2)/4 - a*c - b*d"),
                    f"{TRANSLATIONS} charge boost_x"),
}  # fmt: skip


@pytest.mark.tiers(3, 3)
@pytest.mark.sampled(6)
@pytest.mark.parametrize("name", LAWS)
def test_laws_found_hold_on_solutions(name):
    field, expected = LAWS[name]
    derived = field.derive()
    assert [law.name for law in derived.laws] == expected.split()
    for law in derived.laws:
        total = law.density.diff(sympy.Symbol("t", real=True))
        total += sum(part.diff(sympy.Symbol(axis, real=True)) for axis, part in law.flux.items())
        for _ in range(2):  # the right-hand sides of equations of first order contain no derivatives in time
            total = total.doit().subs({each.lhs: each.rhs for each in derived.equations.values()}).doit()
        assert vanishes(total), law


@pytest.mark.quick
def test_formulas_are_zero_only_if_identically():
    x, y = sympy.symbols("x y")
    assert vanishes(sympy.sin(x + y) - sympy.sin(x) * sympy.cos(y) - sympy.cos(x) * sympy.sin(y))
    assert not vanishes(sympy.sin(x + y) - sympy.sin(x) * sympy.cos(y))


@pytest.mark.quick
def test_derivation_contains_equations_energy_and_laws():
    field = lagrangian("u_t**2/2 - u_x**2/2 - u_xx**2/2", boundary={"x": "periodic"})
    text = field.discretise("finite-differences", order=2, points=16).derive().to_text()
    assert "u_tt = u_xx - u_xxxx" in text
    assert "semi-discrete Lagrangian\n  sum(ix in Nx, " in text
    energy = text.split("semi-discrete energy\n")[1].split("\n\n")[0]
    assert energy.count("\n  - ") == text.split("semi-discrete Lagrangian\n")[1].split("\n\n")[0].count("\n  + ") > 0
    assert "momentum_x: translation in x\n    Jt = -u_t*u_x\n" in text
    cubic = LAWS["cubic"][0]
    assert "a_t = -a**2*b - b**3 - b_xx/2" in cubic.derive().to_text()
    assert "semi-discrete Hamiltonian" in cubic.discretise("fourier", points=16).derive().to_text()
    with pytest.raises(sc.SystemDefinitionError, match="first order"):
        cubic.euler_lagrange()


def run_of(mesh, start, velocity, *, h=0.01, steps=40, by="svi:4", **others):
    stepper = sc.compile_stepper(mesh.system, by, flags=QUICK_FLAGS)
    return stepper.integrate(start, velocity=velocity, h=h, steps=steps, **others)


def waves_between_moving_ends(degree):
    """Laws of a wave that leaves an interval through ends of prescribed motion, and the exact energy density."""
    field = lagrangian(
        "m*u_t**2/2 - m*u_x**2/2", boundary={"x": ("sin(k*(t + 1))", "sin(k*(t - 1))")}, parameters={"m": 3, "k": 2}
    )
    mesh = field.discretise("spectral-elements", degree=degree, elements=[-1, -0.2, 0.5, 1])
    x = mesh.points["x"]
    run = run_of(mesh, {"u": sin(3 * -x)}, {"u": 3 * cos(3 * -x)}, parameters={"k": 3.0, "m": 2.0})
    return mesh, mesh.local_laws(run), 2 * 9 * cos(3 * (run.t[:, None] - x)) ** 2, run


@pytest.mark.rotated
def test_local_laws_hold_to_the_accuracy_of_the_mesh():
    found = []
    for degree in (6, 9, 12):
        mesh, laws, exact, run = waves_between_moving_ends(degree)
        assert [*laws] == ["energy", "momentum_x", "shift", "boost_x"]
        found.append([np.abs(law.residual).max() for law in laws.values()])
    assert (np.array(found[:-1]) > 50 * np.array(found[1:])).all(), found
    assert max(found[-1]) < 1e-4
    assert laws["energy"].density == pytest.approx(exact, abs=1e-5)
    assert laws["energy"].flux["x"] == pytest.approx(exact, abs=1e-5)
    assert laws["energy"].total == pytest.approx(18 * (1 + sin(6) * cos(6 * run.t) / 6), abs=1e-8)
    assert mesh.conserved(run, "energy")["energy"] == pytest.approx(laws["energy"].total, abs=1e-12)


@pytest.mark.rotated
@pytest.mark.parametrize("save_every", [1, 20])
def test_residuals_of_distant_states_take_dense_output(save_every):
    """The error of one-sided differences at the ends in time was 1e-1 for states 0.2 apart."""
    mesh = lagrangian("u_t**2/2 - u_x**2/2", space={"x": (0, 1)}, boundary={"x": "periodic"}).discretise(
        "spectral-elements", degree=12, elements=2
    )
    start = np.cos(2 * np.pi * mesh.points["x"])
    run = run_of(mesh, {"u": start}, {"u": 0 * start}, steps=180, save_every=save_every)
    assert np.abs(mesh.local_laws(run, "energy")["energy"].residual).max() < 1e-5


@pytest.mark.rotated
@pytest.mark.parametrize("boundary", [(0, 0), ("natural", 0), "periodic"])
def test_integral_of_the_energy_density_is_the_energy(boundary):
    mesh = lagrangian("u_t**2/2 - u_x**2/2 - u**4", boundary={"x": boundary}).discretise(
        "spectral-elements", degree=4, elements=3
    )
    draw = np.random.default_rng(0).normal(size=(2, len(mesh.points["x"])))
    run = run_of(mesh, {"u": draw[0]}, {"u": draw[1]})
    assert mesh.conserved(run)["energy"] == pytest.approx(run.energy(), rel=1e-13)


@pytest.mark.full
def test_laws_of_elastic_waves_in_the_plane():
    mesh = lagrangian(SOLID, "uv", PLANE, boundary=PERIODIC).discretise("finite-differences", order=8, points=32)
    x, y = mesh.points.values()
    start = {"u": exp(sin(x)) * cos(y), "v": sin(x + y)}
    run = run_of(mesh, start, {"u": 0 * x, "v": sin(2 * y) * cos(x)}, h=0.01, steps=12)
    laws = mesh.local_laws(run)
    assert laws["energy"].residual.shape == (13, 32, 32)
    assert max(np.abs(law.residual).max() for law in laws.values()) < 1e-3
    assert max(np.ptp(laws[name].total) for name in ("momentum_x", "momentum_y", "shift_u", "shift_v")) < 1e-11


@pytest.mark.rotated
def test_conserved_quantities_of_a_soliton():
    mesh = LAWS["cubic"][0].discretise("fourier", points=128)
    x = mesh.points["x"]
    psi = exp(0.5j * x) / np.cosh(x)
    stepper = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS)
    run = stepper.integrate({"a": psi.real}, p={"a": mesh.weights * psi.imag}, h=0.01, steps=50)
    laws = mesh.local_laws(run)
    assert laws["charge"].total == pytest.approx(1, abs=1e-11)  # half of the mass
    assert np.ptp(laws["charge"].total) < 5e-15
    assert laws["momentum_x"].total == pytest.approx(0.5, abs=1e-9)
    assert laws["boost_x"].total == pytest.approx(0, abs=1e-6)  # the centre moves with the velocity 1/2
    assert laws["charge"].density[0] == pytest.approx(np.abs(psi) ** 2 / 2, abs=1e-14)
    assert laws["charge"].flux["x"][0] == pytest.approx(np.abs(psi) ** 2 / 4, abs=1e-5)
    assert max(np.abs(law.residual).max() for law in laws.values()) < 1e-4  # u_t by the equations, h^4 by SVI(2)


def test_unknown_laws_and_runs_without_states_are_refused():
    mesh = lagrangian("u_t**2/2 - u_x**2/2", boundary={"x": "periodic"}).discretise("fourier", points=16)
    x = mesh.points["x"]
    run = run_of(mesh, {"u": sin(pi * x)}, {"u": 0 * x}, steps=3)
    with pytest.raises(sc.StateError, match="no conservation law 'momentum'"):
        mesh.local_laws(run, "momentum")
    with pytest.raises(sc.StateError, match="at least two states"):
        mesh.local_laws(run_of(mesh, {"u": sin(pi * x)}, {"u": 0 * x}, steps=0))
    with pytest.raises(sc.StateError, match="observe"):
        mesh.conserved(run_of(mesh, {"u": sin(pi * x)}, {"u": 0 * x}, observe=lambda state: state.t))
