"""The vector functions of the generated C, against libm in extended precision."""

import ctypes
import platform
import subprocess

import numpy as np
import pytest
from notation import lagrange
from programs import needs

import scvi_codegen as sc

pytestmark = [pytest.mark.usefixtures("as_users_compile"), pytest.mark.rotated]

CHECK = """
#include "power.c"

void check(const double *x, double *y, double *three)
{
  for (int n = 0; n < 8; n += LANES) {
    lane_view view, times;
    memcpy(view.lane, x + n, sizeof view);
    times.all = lanes_inverse_root_%d_times(view.all, lanes_of(3.0));
    view.all = lanes_inverse_root_%d(view.all);
    memcpy(y + n, view.lane, sizeof view);
    memcpy(three + n, times.lane, sizeof times);
  }
}
"""

TOTALS = """
#include "power.c"

int check(const double *x)
{
#ifdef SUMS_OF_EIGHT
  lanes all[8];
  lane_view totals;
  memcpy(all, x, sizeof all); /* of any alignment */
  totals.all = totals_of_eight(all);
  for (int k = 0; k < 8; k++)
    if (totals.lane[k] != lanes_total(all[k]))
      return k + 1;
#endif
  return 0;
}
"""


def test_sums_of_eight_vectors_have_the_bits_of_single_ones(tmp_path):
    compiler = needs("cc")
    system = sc.LagrangianSystem.from_text(name="power", coordinates=["q"], lagrangian="q_dot**2/2 - q**4")
    sc.generate_source(system, sc.SVI(8), prefix="power")[0].write(tmp_path)
    (tmp_path / "check.c").write_text(TOTALS)
    command = [compiler, "-march=native", "-O2", "-shared", "-fPIC", "check.c", "-o", "check.so", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    x = np.random.default_rng(5).standard_normal(64)
    assert ctypes.CDLL(str(tmp_path / "check.so")).check(x.ctypes.data_as(ctypes.c_void_p)) == 0


@pytest.mark.sampled(2)
@pytest.mark.covering
@pytest.mark.parametrize("flags", ["-march=native -O2", "-O2"])
@pytest.mark.parametrize("k", [1, 3, 5, 7])
def test_inverse_roots_are_right_to_two_units(tmp_path, k, flags):
    compiler = needs("cc")
    system = lagrange("power", "q", f"q_dot**2/2 - q**({2 - k}/2)")
    source, _ = sc.generate_source(system, sc.SVI(8), prefix="power")
    source.write(tmp_path)
    (tmp_path / "check.c").write_text(CHECK % (k, k))
    command = [compiler, *flags.split(), "-shared", "-fPIC", "check.c", "-o", "check.so", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    check = ctypes.CDLL(str(tmp_path / "check.so")).check
    generator = np.random.default_rng(3)
    worst = 0.0
    for _ in range(2000):
        x = generator.uniform(1.0, 4.0, 8) * 2.0 ** generator.integers(-80, 80, 8)
        y, three = np.empty(8), np.empty(8)
        check(*(array.ctypes.data_as(ctypes.c_void_p) for array in (x, y, three)))
        exact = np.longdouble(x) ** (np.longdouble(-k) / 2)
        for found, expected in ((y, exact), (three, 3 * exact)):
            worst = max(worst, float(np.max(np.abs((found - expected) / expected))))
    assert worst < 2 * 2.0**-52 + k * 2.0**-54


SHORT, LONG = ("-O1", "-march=x86-64"), ("-O1", "-march=native")


@pytest.mark.sampled(2)
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the lengths of vectors of other processors are not chosen")
@pytest.mark.parametrize("points", [2, 3, 8, 10])
def test_sums_over_points_are_the_same_in_vectors_of_any_length(points):
    top = lagrange("top", (), "(w_1**2 + 2*w_2**2 + 3*w_3**2)/2 - R_33 - R_12", rotations={"R": "w"})
    ends = []
    for flags in (SHORT, LONG):
        stepper = sc.compile_stepper(top, sc.SVI(points), flags=flags)
        run = stepper.integrate({"R": [0.9, 0.3, -0.2, 0.1]}, velocity={"w": [0.7, -0.4, 1.5]}, h=0.1, steps=20)
        assert run.iterations.max() < 20  # by fixed-point iteration
        ends.append(np.concatenate([run.q[-1], run.p[-1]]))
    adaptive = stepper.integrate({"R": [0.9, 0.3, -0.2, 0.1]}, velocity={"w": [0.7, -0.4, 1.5]}, t_end=2.0)
    assert np.abs(ends[0] - ends[1]).max() < 1e-13
    if points > 7:
        assert np.abs(adaptive.rotation()[-1] - run.rotation()[-1]).max() < 1e-12
