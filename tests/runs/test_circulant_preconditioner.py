"""Circulant preconditioner: steps on lattices far beyond the limit of fixed-point iterations need few products."""

from functools import cache

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.lowering.program import lower_arrays
from scvi_codegen.runs.stepping import array_envelope as envelope

pytestmark = pytest.mark.rotated

RANDOM = np.random.default_rng(1)
ROUNDING = 2.0**-52
KINETIC = {1: "sum(i in N, q_dot[i]**2/2)", 2: "sum(i in NX, j in NY, q_dot[i, j]**2/2)"}
LATTICES = {
    "ring": "sum(i in N periodic, k*(q[i+1] - q[i])**2/2)",
    "ring to the fourth": "sum(i in N periodic, k*(q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/4)",
    "chain": "sum(i in 0..N-2, k*(q[i+1] - q[i])**2/2) - sum(i in N, cos(q[i]))",
    "beam": "sum(i in 1..N-2, k*(q[i+1] - 2*q[i] + q[i-1])**2/2)",
    "plane": "sum(i in NX periodic, j in NY periodic, k*((q[i+1, j] - q[i, j])**2 + 3*(q[i, j+1] - q[i, j])**2)/2)",
    "held plane": "sum(i in NX periodic, j in 0..NY-2, k*((q[i+1, j] - q[i, j])**2 + (q[i, j+1] - q[i, j])**2)/2)"
    "+ sum(i in NX, k*(q[i, 0]**2 + q[i, NY-1]**2)/2 + q[i, 1]**4)",
}


@pytest.fixture(autouse=True)
def no_factors(monkeypatch):
    """Lattices in one dimension have factors of the linear part, too."""
    monkeypatch.setattr(envelope, "MOST_WITHOUT_TABLES", 0)


@cache
def stepper_of(name, method="svi:4", solver="newton"):
    return sc.compile_stepper(lattice(name), method, solver=solver)


def lattice(name):
    potential = LATTICES[name]
    text = f"{KINETIC[2 if 'NX' in potential else 1]} - ({potential})"
    return lagrange(name, ["q[NX, NY]" if "NX" in potential else "q[N]"], text, k=1)


def smooth(shape):
    """Waves of a few dozen places."""
    return np.cos(sum(np.ix_(*(np.arange(size) / 5 for size in np.atleast_1d(shape)))))


def products_of(stepper, q, h, *, steps=1, **given):
    """Return the number of products of steps, which must converge."""
    run = stepper.start(q, h=h, **given)
    memory, binding = run._memory, run.stepper.binding
    report, null = binding.new("report *"), binding.null
    assert binding.function("advance")(memory, steps, 1, run._arguments[0], *[null] * 5, report, null) == 0
    return report.products


@pytest.mark.sampled(9)
@pytest.mark.parametrize("size", [8, 12, 13, 34, 60, 77, 169, 500, 1001])
@pytest.mark.parametrize("method", ["svi:2", "svi:4", "gauss:3"])
def test_fourier_modes_of_a_linear_ring_decouple(size, method):
    """With the transform of each size and the exact symbol, one product leaves only rounding."""
    q = RANDOM.normal(size=size)
    assert products_of(stepper_of("ring", method), q, 1.0, parameters={"k": 1e3}) <= 3


@pytest.mark.parametrize("shape", [(12, 35), (11, 26), (64, 48), (4, 62)])
def test_fourier_modes_of_a_plane_decouple(shape):
    """Also where threads compute sections of the roots of unity."""
    q = RANDOM.normal(size=shape)
    for threads in (1, 3):
        assert products_of(stepper_of("plane"), q, 1.0, parameters={"k": 1e3}, threads=threads) <= 3


def test_each_array_has_its_circulant_preconditioner():
    """Components, and arrays of other axes: all are asked at a time, and none answers for another."""
    text = (
        "sum(i in N, sum(a in 3, r_dot[i, a]**2/2)) + sum(i in NX, j in NY, u_dot[i, j]**2/2)"
        "- sum(i in N periodic, 9*(r[i+1, 0] - r[i, 0])**2 + 900*(r[i+2, 1] - r[i, 1])**2 + r[i, 2]**2)"
        "- sum(i in NX periodic, j in NY periodic, 300*(u[i+1, j] - u[i, j+1])**2)"
    )
    arrays = lagrange("arrays", ["r[N, 3]", "u[NX, NY]"], text)
    stepper = sc.compile_stepper(arrays, "svi:4", solver="newton")
    start = {"r": RANDOM.normal(size=(60, 3)), "u": RANDOM.normal(size=(20, 33))}
    assert products_of(stepper, start, 1.0) <= 3


@pytest.mark.sampled(3)
@pytest.mark.covering
@pytest.mark.parametrize("name", LATTICES)
@pytest.mark.parametrize("k", [1e2, 1e4])
def test_preconditioned_steps_equal_those_of_the_unrolled_system(name, k):
    """Compare with Newton's iteration with full matrices; very small lattices have no preconditioner."""
    for shape in [(2, 7), (7, 12)] if "plane" in name else [4, 34]:
        sizes = dict(zip(("NX", "NY"), shape, strict=True)) if "plane" in name else {"N": shape}
        small = sc.unroll_sums(lattice(name), sizes)
        q, v = smooth(shape), smooth(shape)
        run = stepper_of(name).start(q, velocity=v, h=0.5, parameters={"k": k})
        run.advance(1)
        end, momenta = sc.compile_stepper(small, "svi:4", solver="newton").step(
            q.ravel(), v.ravel(), 0.5, parameters={"k": k}
        )
        grain = 64 * ROUNDING * (1.0 + 16 * 0.25 * k) * np.abs(run.q["q"]).max()
        assert np.abs(run.q["q"].ravel() - end).max() < grain
        assert np.abs(run.p["q"].ravel() - momenta).max() < 16 * grain


@pytest.mark.parametrize("name", ["chain", "beam"])
def test_corrections_are_accurate_in_badly_scaled_systems(name):
    """The size has a factor that is not transformed, and the diagonal is a poor preconditioner for long waves."""
    run = stepper_of(name).start(smooth(503), h=0.5, parameters={"k": 1e5})
    with pytest.raises(sc.StepFailedError, match="GMRES"):
        run.advance(1)


def test_diagonal_preconditioner_is_used_for_nonuniform_lattices():
    """Places that differ by a factor of a million, with springs between them that are soft to most."""
    text = "sum(i in N, q_dot[i]**2/2 - w[i]*q[i]**2/2) - sum(i in N periodic, 2*(q[i+1] - q[i])**2)"
    places = lagrange("places", "q[N]", text, parameters={"w[N]": 1})
    stepper, w = sc.compile_stepper(places, "svi:4", solver="newton"), 10.0 ** RANDOM.uniform(0, 6, size=400)
    assert products_of(stepper, RANDOM.normal(size=400), 1.0, parameters={"w": w}) <= 120


@pytest.mark.quick
@pytest.mark.parametrize(
    ("term", "reach"),
    [
        ("sum(i in N periodic, (u[i+1, 0] - u[i, 0])**2)", 1),
        ("sum(i in 2..N-4, u[i-2, 0]*u[i+3, 0])", 5),
        ("sum(i in N, (u[i, 0] - u[i, 1])**2)", 0),
        ("sum(i in N, u[i, 0]*u[0, 0])", 0),
        ("sum(b in B, w[b]*u[0, 0]*u[1, 0])", 0),
        ("sum(i < j in N, u[i, 0]*u[j, 0])", 0),
        ("sum(b in B, u[bonds[b, 0], 0]*u[bonds[b, 1], 0])", 0),
        ("sum(i in N periodic, u[i, 0]*u[i+1, 0]) - sum(b in B, u[bonds[b, 0], 0]*u[bonds[b, 1], 0])", 0),
    ],
)
def test_systems_with_a_circulant_preconditioner(term, reach):
    text = f"sum(i in N, sum(a in 2, u_dot[i, a]**2/2)) - {term}"
    system = lagrange("some", ["u[N, 2]"], text, parameters={"w[B]": 1}, tables=["bonds[B, 2]"])
    assert lower_arrays(system, sc.as_method("svi:2"), prefix="some", solver="newton").loops.reach == reach


@pytest.mark.quick
@pytest.mark.parametrize(("coordinates", "reach"), [(["u[N]"], 1), (["u[N]", "s"], 0), (["u[N]", "r[3]"], 0)])
def test_circulant_preconditioner_requires_lattices_only(coordinates, reach):
    text = (
        "sum(i in N, u_dot[i]**2/2) - sum(i in N periodic, (u[i+1] - u[i])**2)"
        + {1: "", 0: " + s_dot**2/2 - s**2" if "s" in coordinates else " + sum(a in 3, r_dot[a]**2/2 - r[a]**2)"}[reach]
    )
    system = lagrange("some", coordinates, text)
    assert lower_arrays(system, sc.as_method("svi:2"), prefix="some", solver="newton").loops.reach == reach
