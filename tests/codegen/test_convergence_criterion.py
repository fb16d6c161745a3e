"""Slowly converging iterations end at round-off, as fast ones do: compared with the same equations in 60 digits."""

import ctypes
import re
import subprocess
from contextlib import nullcontext, suppress
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from either_system import either_system
from notation import hamilton, lagrange
from programs import needs
from samples import QUICK_FLAGS

from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StepFailedError
from scvi_codegen.extras.exact.step import derived_step
from scvi_codegen.interfaces.models.problems import problem
from scvi_codegen.methods import SCVI, SVI, SpectralCollocation
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.systems.hamiltonian import HamiltonianSystem

ROUNDING = 5e-16
Q, P, STEPS = [1.2], [0.7], 5


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("method", [SVI(1), SCVI(2), SVI(3, "clenshaw-curtis:4")], ids=lambda method: method.name)
def test_long_steps_of_an_oscillator_equal_those_in_an_ensemble(method):
    system = problem("harmonic-oscillator").system
    stepper, derived = compile_stepper(system, method, flags=QUICK_FLAGS), derived_step(system, method)
    for h in (0.9, 1.2, 1.5):
        q, p = np.array(Q), np.array(P)
        for _ in range(STEPS):
            exact = derived(q, p, h, 0.0)
            q, p = exact.q, exact.p
        run = stepper.integrate(Q, P, h=h, steps=STEPS)
        many = stepper.integrate_ensemble([Q] * 8, [P] * 8, h=h, steps=STEPS)
        for found in (run.q[-1, 0], many.q[-1, 0, 0]):
            assert abs(found - float(q[0])) < 2 * STEPS * ROUNDING


@pytest.mark.rotated
def test_slow_convergence_is_not_mistaken_for_rounding():
    """Near its limit the iteration of a coupled system stops shrinking a while, at 1e-10 of the state, and fails."""
    heavy = lagrange("heavy", "x", "x_dot**2*(1 + x**2/100)/2 - x**2/2")
    method = SVI(4)
    iterations, newton = (
        compile_stepper(heavy, method, solver=solver, flags=QUICK_FLAGS) for solver in ("fixed-point", "newton")
    )
    for h in (1.0, 2.0, 3.0, 3.86, 3.88, 3.9, 3.92, 3.94, 3.96, 3.98):
        with nullcontext() if h < 3.5 else suppress(StepFailedError):
            found = np.concatenate(iterations.step([1.0], [0.3], h))
            assert found == pytest.approx(np.concatenate(newton.step([1.0], [0.3], h)), abs=1e-12)


@pytest.mark.rotated
@pytest.mark.parametrize("deviation", [1e-9, 1e-11])
def test_rotating_iteration_that_stagnates_has_not_converged(deviation):
    """A rotation about a moving point contracts by h**2 in two iterations, the first of which enlarges the change."""
    rotation = hamilton("rotation", "x y", "p_x + p_y + 2*(x - t - 1)*(p_y - 1) - (y - t - 1)*(p_x - 1)/2")
    method, state = SpectralCollocation(1, form="phase-space"), 1 + deviation * np.array([1, 0.3, -0.6, 0.8])
    iterations, newton = (
        compile_stepper(rotation, method, solver=solver, flags=QUICK_FLAGS) for solver in ("fixed-point", "newton")
    )
    for h in (0.6, 0.9):
        with nullcontext() if h < 0.8 else suppress(StepFailedError):
            found = np.concatenate(iterations.step(state[:2], state[2:], h))
            assert found == pytest.approx(np.concatenate(newton.step(state[:2], state[2:], h)), abs=2e-15)


VERDICTS = """
#include <float.h>
#include <math.h>
#include <string.h>
enum {{ M = 3, FINAL_ITERATIONS = {after} }};
typedef double number;
typedef struct {{ double tolerance; long long max_iterations; int absolute; }} solver_options;
#define SELDOM
#define REAL_EPSILON DBL_EPSILON
#define REAL_MIN DBL_MIN
typedef double real;
static double larger(double a, double b) {{ return a > b ? a : b; }}
static double smaller(double a, double b) {{ return a < b ? a : b; }}
static double largest_number(const number *x) {{ return larger(x[0], larger(x[1], x[2])); }}
static double number_of(double x) {{ return x; }}
{header}
int verdict(double change, double last, double before, double tolerance, int absolute, int k)
{{
  const solver_options options = {{tolerance, 40, absolute}};
  return iteration_status(change * change, last * last, before * before, &options, k, FINAL_ITERATIONS);
}}
int continued(long long steps, double change) {{ return (int)steps_to_continue(steps, change * change); }}
void scales(double absolute, double *size)
{{
  const solver_options options = {{1e-7, 40, absolute > 0.0}};
  invert_sizes(&options, absolute, size);
}}
"""


@cache
def header(folder: Path, after: int):
    """The functions of the headers alone, of changes that are not squared."""
    compiler = needs("cc")
    text = (Path(__file__).parents[2] / "templates/support/iteration/convergence.h").read_text()
    (folder / f"{after}.c").write_text(VERDICTS.format(after=after, header=re.sub(r'#include ".*"', "", text)))
    command = [compiler, "-std=c99", "-shared", "-fPIC", f"{after}.c", "-o", f"{after}.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    found = ctypes.CDLL(str(folder / f"{after}.so"))
    found.verdict.argtypes = [ctypes.c_double] * 4 + [ctypes.c_int] * 2
    found.continued.argtypes = [ctypes.c_longlong, ctypes.c_double]
    found.scales.argtypes = [ctypes.c_double, ctypes.c_void_p]
    return found


ON, DONE, GIVEN_UP = 0, 1, -1
ROUNDED = 2.0**-53
TABLE = [
    # change, the one before, tolerance, absolute, iteration; verdict; perhaps the change before both
    ("shrinking", 1e-6, 1e-4, ROUNDED, 0, 3, ON),
    ("shrinking, but slowly where iterations are far from convergence", 0.8e-6, 1e-6, ROUNDED, 0, 5, GIVEN_UP),
    ("slowly in one iteration, but not in two", 0.8e-6, 1e-6, ROUNDED, 0, 5, ON, 2e-6),
    ("slowly in two", 0.8e-6, 1e-6, ROUNDED, 0, 5, GIVEN_UP, 1.5e-6),
    ("as slowly, among the first iterations", 0.8e-6, 1e-6, ROUNDED, 0, 4, ON),
    ("fast enough, a little", 0.7e-6, 1e-6, ROUNDED, 0, 5, ON),
    ("as slowly, near convergence", 0.8e-10, 1e-10, ROUNDED, 0, 5, ON),
    ("too many iterations", 1e-6, 1e-4, ROUNDED, 0, 40, GIVEN_UP),
    ("one iteration less", 1e-6, 1e-4, ROUNDED, 0, 39, ON),
    ("growing at 1e-9 of the state: no rounding is that large", 1.1e-9, 1e-9, ROUNDED, 0, 3, ON),
    ("growing at 1e-12", 1.1e-12, 1e-12, ROUNDED, 0, 3, ON),
    ("growing at 4e-13", 4e-13, 3.9e-13, ROUNDED, 0, 3, ON),
    ("growing at the level of rounding", 2.5e-13, 2.4e-13, ROUNDED, 0, 3, DONE),
    ("the same by chance", 2.5e-13, 2.5e-13, ROUNDED, 0, 2, DONE),
    ("growing after an iteration that contracted by chance", 2.7e-13, 2.0e-13, ROUNDED, 0, 3, ON, 1.7e-10),
    ("the same below 1e-14", 0.9e-14, 0.8e-14, ROUNDED, 0, 3, DONE, 1.7e-10),
    ("far below the last by chance", 2e-14, 2e-11, ROUNDED, 0, 3, DONE, 2e-8),
    ("as far, after slower ones", 5e-13, 5e-10, ROUNDED, 0, 3, ON, 1e-9),
    ("shrinking at the level of rounding", 1e-13, 2e-13, ROUNDED, 0, 3, ON),
    ("nothing at all", 0.0, 1e-3, ROUNDED, 0, 2, DONE),
    ("nothing at all, at once", 0.0, np.inf, ROUNDED, 0, 0, DONE),
    ("not a number", np.nan, 1e-3, ROUNDED, 0, 2, GIVEN_UP),
    ("infinite", np.inf, 1e-3, ROUNDED, 0, 2, GIVEN_UP),
    ("slowly, well below the tolerance", 1e-8, 1.1e-8, 1e-7, 0, 3, DONE),
    ("the first, far below the tolerance", 1e-17, np.inf, ROUNDED, 0, 0, DONE),
    ("the first, large", 1e-12, np.inf, ROUNDED, 0, 0, ON),
    ("absolute, below", 0.9e-6, 1e-3, 1e-6, 1, 2, DONE),
    ("absolute, above", 1.1e-6, 1e-3, 1e-6, 1, 2, ON),
    *(
        (f"growing at {x:.0e}", x, x / 1e28, ROUNDED, 0, 6, GIVEN_UP, x / 1e56)
        for x in (1e56, 1e84, 1e112, 1e140, 1e154)
    ),
    ("growing at once beyond all numbers whose squares are finite", 1e140, 1e10, ROUNDED, 0, 2, GIVEN_UP),
    ("growing at once above a thousand states", 1.1e3, 1e3, ROUNDED, 0, 2, GIVEN_UP),
    ("growing at once below a thousand states", 0.9e3, 0.5e3, ROUNDED, 0, 2, ON),
    ("decreasing above a thousand states", 1.1e3, 1e4, ROUNDED, 0, 2, ON),
]


@pytest.mark.parametrize(
    ("change", "last", "tolerance", "absolute", "k", "expected", "before"),
    [(*x[1:7], x[7] if len(x) > 7 else x[2]) for x in TABLE],
    ids=[x[0] for x in TABLE],
)
@pytest.mark.parametrize("after", [0, 1])
def test_convergence_criterion_of_the_fixed_point_iteration(
    tmp_path_factory, after, change, last, before, tolerance, absolute, k, expected
):
    """If the change before the last one is missing, the last iteration did not contract."""
    verdict = header(tmp_path_factory.getbasetemp(), after).verdict
    assert verdict(change, last, before, tolerance, absolute, k) == expected


@pytest.mark.parametrize("after", [0, 1])
@pytest.mark.parametrize("rate", [0.01, 0.1, 0.3, 0.6])
def test_residual_at_convergence_is_a_part_of_the_tolerance(tmp_path_factory, after, rate):
    """Changes decrease geometrically: compare the sum of the omitted ones with the criterion.

    A quarter of the tolerance, or all of it where an iteration follows, whose remainder is extrapolated. At most; up to
    twice that where they contract slowly, for 1 / (1 - r) is taken from squares.
    """
    tolerance, change = 1e-7, 1e-5
    verdict = header(tmp_path_factory.getbasetemp(), after).verdict
    ends = [k for k in range(60) if verdict(*(change * rate ** (k - j) for j in (0, 1, 2)), tolerance, 0, 3) == DONE]
    left = [change * rate ** (k + 1 + after) / (1 - rate) for k in (ends[0], ends[0] - 1)]
    wanted = (1 + rate) * (tolerance if after else tolerance / 4)
    assert left[0] < wanted * 1.001
    assert left[1] > wanted


def test_predictor_uses_two_steps_after_an_accurate_guess(tmp_path_factory):
    continued = header(tmp_path_factory.getbasetemp(), 0).continued
    cases = {(0, 1e-9): 1, (1, 1e-9): 2, (2, 0.9e-3): 2, (1, 1.1e-3): 1, (2, 1.1e-3): 1}
    assert {case: continued(*case) for case in cases} == cases


@pytest.mark.parametrize("absolute", [0.0, 0.25])
def test_inverse_sizes_are_finite_for_zero_coordinates(tmp_path_factory, absolute):
    scales = header(tmp_path_factory.getbasetemp(), 0).scales
    for sizes in ([4.0, 0.5, 0.0], [0.0, 2.0**-40, 8.0], [0.0, 0.0, 0.0], [1.0, np.inf, 2.0]):
        found = np.array(sizes)
        scales(absolute, found.ctypes.data)
        if not np.isfinite(max(sizes)):
            assert np.isnan(found).all()
        elif absolute:
            assert np.array_equal(found, [absolute] * 3)
        else:
            least = np.finfo(float).eps * max(sizes) + np.finfo(float).tiny
            assert found == pytest.approx(1.0 / (np.array(sizes) + least), rel=1e-15)


HEAVY_TOP = (
    "((w*p_x - x*p_w + z*p_y - y*p_z)**2 + (w*p_y - y*p_w + x*p_z - z*p_x)**2/2)/8"
    "+ (w*p_z - z*p_w + y*p_x - x*p_y)**2/24"
    "+ (w**2 - x**2 - y**2 + z**2 + (x*z - w*y)/4)/(w**2 + x**2 + y**2 + z**2)"
)


@pytest.mark.rotated
def test_rotating_fixed_point_iterations_converge_to_rounding():
    """Factors of contraction are complex: one change may be as large as the last, though two are a hundredth of it."""
    system = HamiltonianSystem.from_text(name="top", coordinates=["w", "x", "y", "z"], hamiltonian=HEAVY_TOP)
    stepper = compile_stepper(system, SVI(8), solver="fixed-point", flags=QUICK_FLAGS)
    for h in (0.3, 0.35, 0.4):
        energy = stepper.integrate([1.0, 0, 0, 0], [0.0, 0.6, -1.0, 4.0], h=h, steps=50000).energy()
        assert np.abs(np.diff(energy)).max() < 5e-14


SITES = 12
NAMES = [f"q{i}" for i in range(SITES)]
NEIGHBOURS = np.eye(SITES, k=1) + np.eye(SITES, k=-1) + np.eye(SITES, k=SITES - 1) + np.eye(SITES, k=1 - SITES)
SPRINGS = " + ".join(f"(q{(i + 1) % SITES} - q{i})**2" for i in range(SITES))
LATTICES = {
    "array": {
        "coordinates": ["q[N]"],
        "lagrangian": "sum(i in N, q_dot[i]**2) - sum(i in N periodic, (q[i+1]-q[i])**2)",
    },
    "array, matrix of pairs": {
        "coordinates": ["q[N]"],
        "lagrangian": "sum(i in N, q_dot[i]**2) - sum(i < j in N, c[i, j]*(q[i] - q[j])**2)",
        "parameters": {"c[N, N]": NEIGHBOURS.tolist()},
    },
    "array, matrix of products": {
        "coordinates": ["q[N]"],
        "lagrangian": "sum(i in N, q_dot[i]**2) - sum(i in N, j in N, c[i, j]*q[i]*q[j])",
        "parameters": {"c[N, N]": (2 * np.eye(SITES) - NEIGHBOURS).tolist()},
    },
    "array of momenta": {
        "coordinates": ["q[N]"],
        "momenta": ["p[N]"],
        "hamiltonian": "sum(i in N, p[i]**2)/4 + sum(i in N periodic, (q[i+1]-q[i])**2)",
    },
    "separable": {"coordinates": NAMES, "lagrangian": f"{' + '.join(f'{q}_dot**2' for q in NAMES)} - ({SPRINGS})"},
    "coupled": {
        "coordinates": NAMES,
        "lagrangian": f"{' + '.join(f'{q}_dot**2*(1 + {q}**2/1000)' for q in NAMES)} - ({SPRINGS})",
    },
    "momenta": {"coordinates": NAMES, "hamiltonian": f"{' + '.join(f'p_{q}**2' for q in NAMES)}/4 + {SPRINGS}"},
}


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", LATTICES)
@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
def test_standing_waves_converge_up_to_the_largest_step(name, method):
    """Sites at nodes are at rest, and their forces are rounding errors; named ones need a few more iterations."""
    phase = 4 * np.pi * np.arange(SITES) / SITES
    system = either_system(name="ring", **LATTICES[name])
    h = (0.8 if name == "momenta" else 0.95) * (1.1 if method == "svi:4" else 1.75)
    for sizes in ({"N": SITES}, None) if "array" in name else (None,):
        stepper, counts = compile_stepper(system, method, solver="fixed-point", sizes=sizes, flags=QUICK_FLAGS), []
        for shift in (0.0, 0.3):
            run = stepper.start(np.cos(phase + shift), np.zeros(SITES), h=h)
            run.advance(20)
            counts.append(run.iterations / 20)
        assert counts[0] <= (1.1 * counts[1] + 0.2 if "array" in name else counts[1] + 5)


def test_bodies_of_known_number_are_measured_one_by_one():
    """Bodies that do not move do not make the criterion of others looser: only fields are measured as a whole."""
    system = lagrange("pairs", "x[4]", "sum(i in 4, x_dot[i]**2/2) + sum(i < j in 4, 1/sqrt((x[i] - x[j])**2 + 1))")
    assert not any(array.is_field for array in system.arrays)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("name", ["kepler", "heavy top"])
def test_tolerance_of_adaptive_steps_ends_the_iteration_early(name):
    """About half of the iterations, and momentum maps to their error, or to round-off with a criterion of one's own."""
    if name == "kepler":
        system, state = problem("kepler").system, {"q": [0.5, 0.0], "p": [0.0, 3**0.5]}
    else:
        system = lagrange("top", (), "(omega_1**2 + omega_2**2 + omega_3**2/2)/2 - R_33", rotations={"R": "omega"})
        turned = np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])
        state = {"q": {"R": turned}, "velocity": {"omega": [0.1, 0.2, 3.0]}}
    stepper = compile_stepper(system, "svi:6")
    loose, tight = (
        stepper.integrate(**state, t_end=20.0, tolerance=1e-5, options=options, check_growth=False)
        for options in (None, SolverOptions())
    )
    assert loose.iterations.sum() < 0.65 * tight.iterations.sum()
    assert 1e-13 < np.abs(loose.momentum_errors()).max() < 1e-7
    assert np.abs(tight.momentum_errors()).max() < 1e-14
