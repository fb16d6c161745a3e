"""Newton's method on meshes: factors of the linear part, whose corrections depend on the step size alone."""

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen import FieldSystem

RANDOM = np.random.default_rng(2)
LINEAR = "u_t**2/2 - u_x**2/2 - u**2/2"
GRADED = [0, 0.02, 0.1, 0.3, 1.0, 2.0, 2.5]
MESHES = {
    "ring": ("periodic", "spectral-elements", {"degree": 5, "elements": 8}),
    "natural": (("natural", "natural"), "spectral-elements", {"degree": 8, "elements": GRADED}),
    "prescribed": ((0, "sin(t)"), "spectral-elements", {"degree": 12, "elements": 3}),
    "differences": ("periodic", "finite-differences", {"order": 6, "points": 70}),
}


def mesh_of(name, density=LINEAR, fields=("u",)):
    boundary, method, options = MESHES[name]
    field = FieldSystem.from_text(name, [*fields], {"x": (0, 2.5)}, density, boundary={"x": boundary})
    return field.discretise(method, **options)


@pytest.mark.covering
@pytest.mark.filterwarnings("ignore:the mesh does not resolve")
@pytest.mark.parametrize("method", ["svi:1", "svi:2", "svi:3", "svi:8", "gauss:5"])
@pytest.mark.parametrize("name", MESHES)
def test_one_correction_solves_linear_densities(name, method):
    """Random initial values contain the highest frequencies; a second correction confirms the first."""
    mesh = mesh_of(name)
    stepper = sc.compile_stepper(mesh.system, method, solver="newton", flags=QUICK_FLAGS)
    h = 30 * mesh.largest_step("svi:2")
    run = stepper.integrate({"u": RANDOM.normal(size=mesh.weights.shape)}, h=h, steps=4)
    assert run.iterations.max() <= 2
    if name != "prescribed":
        assert run.energy_error() < 1e-12


@pytest.mark.parametrize("threads", [1, 2])
def test_corrections_depend_on_the_step_size_alone(threads):
    counts = []
    for degree, elements in ((4, 30), (8, 30), (8, 60), (16, 30)):
        field = FieldSystem.from_text(
            "fields",
            ["u", "v"],
            {"x": (-20, 20)},
            "u_t**2/2 + v_t**2/2 - u_x**2/2 - v_x**2/2 - (1 - cos(u)) - (1 - cos(u - v))",
            boundary={"x": "periodic"},
        )
        mesh = field.discretise("spectral-elements", degree=degree, elements=elements)
        x = mesh.points["x"]
        stepper = sc.compile_stepper(mesh.system, "svi:4", solver="newton", flags=QUICK_FLAGS)
        start = {"u": np.exp(-x * x / 4), "v": 0 * x}
        run = stepper.integrate(start, h=0.2, steps=20, threads=threads)
        counts.append(run.iterations.sum())
    assert max(counts) <= 1.1 * min(counts) <= 5 * 20


def test_steps_equal_those_of_fixed_point_iteration_and_of_other_threads():
    mesh = mesh_of("natural", "u_t**2/2 - u_x**2/2 - (1 - cos(3*u))")
    start = {"u": np.cos(np.pi * mesh.points["x"] / 2.5)}
    h, ends = mesh.largest_step("svi:4") / 2, []
    for solver, threads in (("fixed-point", 1), ("newton", 1), ("newton", 3)):
        stepper = sc.compile_stepper(mesh.system, "svi:4", solver=solver, flags=QUICK_FLAGS)
        ends.append(stepper.integrate(start, h=h, steps=20, threads=threads).q["u"][-1])
    assert np.abs(ends[0] - ends[1]).max() < 1e-13
    assert ends[1].tobytes() == ends[2].tobytes()


def test_restored_runs_and_other_parameters_have_the_right_factors():
    field = FieldSystem.from_text(
        "string", ["u"], {"x": (0, 1)}, "u_t**2/2 - c*u_x**2/2 - u**2", boundary={"x": (0, 0)}, parameters={"c": 1}
    )
    mesh = field.discretise("spectral-elements", degree=9, elements=5)
    stepper = sc.compile_stepper(mesh.system, "svi:4", solver="newton", flags=QUICK_FLAGS)
    run = stepper.start({"u": np.sin(np.pi * mesh.points["x"])}, h=0.2)
    run.advance(3)
    again = stepper.from_checkpoint(run.checkpoint())
    for each in (run, again):
        each.advance(3)
    assert run.q["u"].tobytes() == again.q["u"].tobytes()
    before = run.iterations
    run.update(parameters={"c": 25.0})
    run.advance(3)
    assert run.iterations - before <= 6
