"""Regular and chaotic motions with recorded states of 30 digits (``motions.npz``, by ``tools/record_motions.py``).

Numbers in formulas are dyadic, so that formulas, doubles and the extended precision of the records mean the same.
"""

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

RECORDS = Path(__file__).with_name("motions.npz")


class Motion(NamedTuple):
    """A Lagrangian with optional forces, an initial state (q, p), the first and the last time, and a method."""

    coordinates: str
    lagrangian: str
    q: list[float]
    p: list[float]
    span: tuple[float, float]
    method: str = "svi:8"
    forces: dict[str, str] = {}  # noqa: RUF012  (read only)


def bodies(*masses: float) -> tuple[str, str]:
    """Return coordinates and Lagrangian of point masses in a plane with unit gravitational constant."""
    numbers = range(len(masses))
    kinetic = [f"{masses[i]}*(x{i}_dot**2 + y{i}_dot**2)/2" for i in numbers]
    attraction = [
        f"{masses[i] * masses[j]}/sqrt((x{i} - x{j})**2 + (y{i} - y{j})**2)" for i in numbers for j in range(i)
    ]
    return " ".join(f"x{i} y{i}" for i in numbers), " + ".join(kinetic + attraction)


KEPLER = "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)"
DOUBLE_PENDULUM = "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + 2*cos(a) + cos(b)"
HENON_HEILES = "(x_dot**2 + y_dot**2 - x**2 - y**2)/2 - x**2*y + y**3/3"
ENDS = ["0", *(f"x{i}" for i in range(6)), "0"]
CHAIN = " - ".join(
    [
        " + ".join(f"x{i}_dot**2/2" for i in range(6)),
        *(f"({b} - {a})**2/2 - ({b} - {a})**4/4" for a, b in pairwise(ENDS)),
    ]
)
WELLS = "4*(1 - exp(-r))**2 - 4*(1 - exp(-s))**2 - r*s/8"
ARENSTORF = (
    "((x_dot - y)**2 + (y_dot + x)**2)/2 + 0.984375/sqrt((x + 0.015625)**2 + y**2)"
    " + 0.015625/sqrt((x - 0.984375)**2 + y**2)"
)
PYTHAGOREAN = [1.0, 3.0, -2.0, -1.0, 1.0, -1.0]
EIGHT = [-0.97000436, 0.24308753, 0.0, 0.0, 0.97000436, -0.24308753]
EIGHT_MOMENTA = [0.466203685, 0.43236573, -0.93240737, -0.86473146, 0.466203685, 0.43236573]
MOTIONS = {
    "oscillator": Motion("x", "x_dot**2/2 - 2*x**2", [0.7], [-0.2], (3.0, 103.0)),
    "driven": Motion("x", "x_dot**2 - x**4/4", [0.0], [0.0625], (-1.0, 25.0), forces={"x": "cos(t) - x_dot/8"}),
    "kepler .6": Motion("x y", KEPLER, [1.6, 0.0], [0.0, 0.5], (0.0, 62.0)),
    "kepler .99 from the pericentre": Motion("x y", KEPLER, [0.01, 0.0], [0.0, 14.106735979665885], (0.0, 62.83)),
    "kepler .99": Motion("x y", KEPLER, [1.99, 0.0], [0.0, 0.07088812050083359], (0.0, 62.83)),
    "kepler .999": Motion("x y", KEPLER, [1.999, 0.0], [0.0, 0.022366272], (0.0, 20.0)),
    "kepler backward": Motion("x y", KEPLER.replace("1/", "1.5/"), [0.5, 0.1], [0.0, 1.6], (10.0, -20.0), "svi:4"),
    "double pendulum": Motion("a b", DOUBLE_PENDULUM, [1.0, 0.5], [0.3, 0.1], (0.0, 20.0)),
    "double pendulum, chaotic": Motion("a b", DOUBLE_PENDULUM, [2.0, 2.5], [0.0, 0.0], (0.0, 16.0)),
    "stiff": Motion(
        "x y", "(x_dot**2 + y_dot**2)/2 - 5000*x**2 - y**2/2 - x*y**2", [0.001, 1.0], [0.0, 0.3], (0.0, 5.0)
    ),
    "henon-heiles": Motion("x y", HENON_HEILES, [0.1, 0.2], [0.3, 0.1], (0.0, 60.0), "gauss:5"),
    "henon-heiles, chaotic": Motion("x y", HENON_HEILES, [0.0, -0.125], [0.53, 0.05], (0.0, 120.0)),
    "saddle": Motion("x", "x_dot**2/2 + x**2/2", [1.0], [0.3], (0.0, 12.0), "scvi:5"),
    "charge": Motion(
        "x y", "(x_dot**2 + y_dot**2)/2 + 1.25*(x*y_dot - y*x_dot) - x**4", [0.4, 0.1], [0.3, 0.6], (0.0, 40.0)
    ),
    "pulse": Motion("x", "x_dot**2/2 - cosh(x) + x*exp(-(t - 6)**2*4)", [0.5], [0.0], (1.0, 30.0), "radau-iia:5"),
    "chain": Motion(
        "x0 x1 x2 x3 x4 x5",
        CHAIN,
        [0.5, -0.3, 0.8, 0.1, 0.0, -0.6],
        [0.0, 0.4, 0.0, -0.2, 0.1, 0.0],
        (0.0, 30.0),
        "svi:6",
    ),
    "relativistic": Motion("x", "-sqrt(1 - x_dot**2) - x**4/4", [0.5], [2.0], (0.0, 60.0)),
    "pythagorean": Motion(*bodies(3, 4, 5), PYTHAGOREAN, [0.0] * 6, (0.0, 10.0)),
    "pythagorean, longer": Motion(*bodies(3, 4, 5), PYTHAGOREAN, [0.0] * 6, (0.0, 20.0)),
    "figure eight": Motion(*bodies(1, 1, 1), EIGHT, EIGHT_MOMENTA, (0.0, 40.0)),
    "three bodies": Motion(
        *bodies(1, 1, 1), [-1.0, 0.0, 1.0, 0.0, 0.125, 0.25], [0.35, 0.53, 0.35, 0.53, -0.7, -1.06], (0.0, 6.0)
    ),
    "planets": Motion(
        *bodies(1, 2.0**-10, 2.0**-12),
        [0.0, 0.0, 5.0, 0.0, 0.0, 9.0],
        [0.0, -0.0003, 0.0, 0.0005, -8e-05, 0.0],
        (0.0, 1500.0),
    ),
    "pendulum": Motion("a", "a_dot**2/2 + cos(a)", [2.0], [0.0], (0.0, 100.0)),
    "pendulum, order 8": Motion("a", "a_dot**2/2 + cos(a)", [1.0], [0.5], (0.0, 60.0), "svi:4"),
    "cart-pole": Motion(
        "x a", "3*x_dot**2/2 + x_dot*a_dot*cos(a) + a_dot**2/2 - 4*cos(a) - x**2/2", [0.1, 0.5], [0.0, 0.2], (0.0, 30.0)
    ),
    "duffing": Motion(
        "x", "x_dot**2/2 + x**2/2 - x**4/4", [0.5], [0.1], (0.0, 80.0), "svi:6", {"x": "cos(t)/4 - x_dot/8"}
    ),
    "morse": Motion("r s", f"(r_dot**2 + s_dot**2)/2 - {WELLS}", [0.5, -0.2], [0.3, 0.6], (0.0, 60.0)),
    "atwood": Motion("r a", "2*r_dot**2 + r**2*a_dot**2/2 - 3*r + r*cos(a)", [1.0, 1.0], [0.0, 0.2], (0.0, 15.0)),
    "arenstorf": Motion("x y", ARENSTORF, [0.994, 0.0], [0.0, -1.0], (0.0, 12.0)),
    "elastic pendulum": Motion(
        "x y",
        "(x_dot**2 + y_dot**2)/2 - y - 8*(sqrt(x**2 + y**2) - 1)**2",
        [0.8, -0.9],
        [0.1, 0.3],
        (0.0, 40.0),
        "svi:6",
    ),
    "double well": Motion("x", "x_dot**2/2 + x**2 - x**4/4", [2.0], [0.01], (0.0, 50.0)),
    "spherical pendulum": Motion(
        "a b", "(a_dot**2 + sin(a)**2*b_dot**2)/2 + cos(a)", [1.2, 0.0], [0.3, 0.05], (0.0, 40.0)
    ),
    "anisotropic kepler": Motion("x y", KEPLER.replace("x_dot**2", "2*x_dot**2"), [1.2, 0.4], [0.3, 0.6], (0.0, 25.0)),
    "quartic, order 6": Motion(
        "x y",
        "(x_dot**2 + y_dot**2)/2 - (x**2 + y**2)**2/4 - x**2*y**2/8",
        [0.9, 0.3],
        [0.1, 0.5],
        (0.0, 15.0),
        "svi:3",
    ),
}


def recorded(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (n,) times and (n, 2 m) states (q, p) of a motion, as the sums of doubles and low words."""
    with np.load(RECORDS) as file:
        times, high, low = (file[f"{name}/{part}"] for part in ("t", "high", "low"))
        return times, high, low.astype(float)
