"""Trial curves other than polynomials, and quadratures other than Gauss's, for which they are better (paper, 4.2.3)."""

import math
import warnings

import numpy as np

import scvi_codegen as sc

warnings.simplefilter("ignore", sc.AccuracyWarning)  # the steps are large on purpose


def compare(what, system, start, *, h, steps, methods):
    """Print errors of the final position relative to SVI(10) with a sixteenth of the step size."""
    reference = sc.compile_stepper(system, sc.SVI(10)).integrate(*start, h=h / 16, steps=16 * steps).q[-1]
    print(what)
    for label, method in methods.items():
        end = sc.compile_stepper(system, method).integrate(*start, h=h, steps=steps).q[-1]
        print(f"  {label:44} {np.abs(end - reference).max():.1e}")


compare(
    "A perturbed oscillator of frequency 1, 200 steps of 1 radian:",
    sc.problem("henon-heiles").system,
    ([0.05, 0.02], [0.03, 0.06]),
    h=1.0,
    steps=200,
    methods={
        "polynomials of degree 4": sc.SVI(4, "gauss-legendre:10"),
        "two harmonics, degree 4": sc.SVI(4, space=sc.Trigonometric(1.0)),
    },
)
compare(
    "A force with a kink in the middle of each step:",
    sc.LagrangianSystem.from_text(
        name="kinked drive", coordinates=["q"], lagrangian="q_dot**2/2 + cos(q) + q*asin(sin(t))/5"
    ),
    ([0.5], [0.0]),
    h=math.pi,
    steps=8,
    methods={
        "polynomials of degree 15, 16 Gauss points": sc.SVI(15, "gauss-legendre:16"),
        "splines of degree 8, two pieces of 8 points": sc.SVI(8, space=sc.Splines(2)),
    },
)
compare(
    "A pendulum, L evaluated at the ends of the steps alone:",
    sc.problem("planar-pendulum").system,
    ([1.0], [0.0]),
    h=0.5,
    steps=40,
    methods={
        "trapezoidal rule": sc.SVI(2, "gauss-lobatto:2"),
        "with L and dL/dt, order 4": sc.SVI(2, sc.hermite(2)),
        "with three derivatives of L, order 8": sc.SVI(4, sc.hermite(2, 3)),
    },
)
