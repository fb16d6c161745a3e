"""Parameter estimation: orbit of Ceres and mass of Jupiter from orbital elements published over sixteen years.

Eleven sets of osculating elements of (1) Ceres (ceres.csv), published by the Minor Planet Center and JPL from 2006 to
2022, determine its positions. Its initial state and the mass of Jupiter are estimated by least squares; the orbits of
Jupiter and Saturn are tabulated inputs. The residuals, a few thousand kilometres, are due to their approximate elements
and to what is omitted: inner planets and relativity.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import CubicSpline

import scvi_codegen as sc

HERE = Path(__file__).parent
SUN = 0.01720209895**2 * (1 + 1 / 408523.7 + 1 / 328900.6)  # au^3/day^2, by Gauss's constant; with Venus and Earth
JUPITER, SATURN = 1 / 1047.348644, 1 / 3497.9018  # of the mass of the Sun, by the IAU
J2000 = 2451545.0
PLANETS = {  # a (au), e, inclination, mean longitude, longitude of perihelion, node (degrees), and how fast they change
    "j": (5.20288700, 0.04838624, 1.30439695, 34.39644051, 14.72847983, 100.47390909),
    "j_rates": (-0.00011607, -0.00013253, -0.00183714, 3034.74612775, 0.21252668, 0.20469106),
    "s": (9.53667594, 0.05386179, 2.48599187, 49.95424423, 92.59887831, 113.66242448),
    "s_rates": (-0.00125060, -0.00050991, 0.00193609, 1222.49362201, -0.41897216, -0.28867794),
}
"""E. M. Standish, Keplerian elements for approximate positions of the major planets, 1800 to 2050; rates per
century."""


def places(a, e, inclination, node, perihelion, anomaly):
    """Return (n, 3) heliocentric positions from elements, angles in degrees."""
    inclination, node, perihelion, mean = np.radians([inclination, node, perihelion, anomaly])
    eccentric = mean + e * np.sin(mean)
    for _ in range(8):
        eccentric -= (eccentric - e * np.sin(eccentric) - mean) / (1 - e * np.cos(eccentric))
    x, y = a * (np.cos(eccentric) - e), a * np.sqrt(1 - e**2) * np.sin(eccentric)
    along, across = x * np.cos(perihelion) - y * np.sin(perihelion), x * np.sin(perihelion) + y * np.cos(perihelion)
    flat = across * np.cos(inclination)
    return np.stack(
        [
            along * np.cos(node) - flat * np.sin(node),
            along * np.sin(node) + flat * np.cos(node),
            across * np.sin(inclination),
        ],
        axis=-1,
    )


def planet(name, days):
    """Return (n, 3) positions of a planet."""
    a, e, i, longitude, perihelion, node = (
        value + rate * days / 36525 for value, rate in zip(PLANETS[name], PLANETS[f"{name}_rates"], strict=True)
    )
    return places(a, e, i, node, perihelion - node, longitude - perihelion)


table = np.loadtxt(HERE / "ceres.csv", delimiter=",", comments="#", usecols=range(7))
days = table[:, 0] - J2000
measured = places(*table[:, 1:].T)
knots = np.arange(days[0] - 1, days[-1] + 81, 80.0)
orbits = {name: planet(name, knots) for name in "js"}
inputs = {f"{axis}{name}": CubicSpline(knots, orbits[name][:, k]) for name in "js" for k, axis in enumerate("xyz")}

PULL = (  # of a planet on Ceres, and, as the Sun is at rest, on the Sun
    "sun*{mass}*(1/sqrt((x - x{n})**2 + (y - y{n})**2 + (z - z{n})**2)"
    " - (x*x{n} + y*y{n} + z*z{n})/(x{n}**2 + y{n}**2 + z{n}**2)**(3/2))"
)
ceres = sc.LagrangianSystem.from_text(
    name="Ceres",
    coordinates=["x", "y", "z"],
    lagrangian="(x_dot**2 + y_dot**2 + z_dot**2)/2 + sun/sqrt(x**2 + y**2 + z**2)"
    + " + "
    + PULL.format(mass="jupiter", n="j")
    + " + "
    + PULL.format(mass="saturn", n="s"),
    parameters={"sun": SUN, "jupiter": JUPITER, "saturn": SATURN},
    inputs=list(inputs),
)
stepper = sc.compile_stepper(ceres, "svi:6")
further = places(*table[:1, 1:6].T, table[:1, 6] + 0.01)  # by a hundredth of a degree of the mean anomaly
velocity = (further - measured[:1])[0] / np.radians(0.01) * np.sqrt(SUN / table[0, 1] ** 3)
known = {"q": measured[0], "velocity": velocity, "h": 40.0, "inputs": inputs}
alone = sc.fit(stepper, days, measured, unknown=[], parameters={"jupiter": 0.0, "saturn": 0.0}, **known)
found = sc.fit(stepper, days, measured, unknown=["jupiter"], parameters={"jupiter": 0.0}, **known)
print(found)
print(f"Jupiter is 1/{1 / found.parameters['jupiter']:.1f} of the Sun; 1/{1 / JUPITER:.1f} by other measurements")
for name, each in {"the Sun alone": alone, "Jupiter and Saturn, too": found}.items():
    print(f"{name}: within {np.linalg.norm(each.residuals, axis=1).max():.6f} au of where Ceres was")

motion = stepper.integrate(
    found.q,
    found.p,
    parameters={"jupiter": found.parameters["jupiter"]},
    h=20.0,
    t=days[0],
    t_end=days[-1],
    inputs=inputs,
)
years = 2000 + days / 365.25
figure, (orbit, left) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
orbit.plot(*motion.q[:, :2].T, lw=0.4, color="tab:blue")
orbit.plot(*measured[:, :2].T, "o", color="tab:red", label="published")
orbit.plot(*orbits["j"][:, :2].T, lw=0.8, color="tab:brown", label="Jupiter")
orbit.plot(0, 0, "o", color="gold")
orbit.set(xlabel="x (au)", ylabel="y (au)", aspect="equal", title="Ceres, 2006 to 2022")
orbit.legend(loc="upper right")
for name, each, marker in (("by the Sun alone", alone, "s--"), ("with Jupiter and Saturn", found, "o-")):
    left.semilogy(years, np.linalg.norm(each.residuals, axis=1), marker, label=name)
left.set(xlabel="year", ylabel="distance from where it was (au)", title="What a fitted orbit leaves")
left.legend()
figure.savefig("ceres_orbit.png", dpi=100)
