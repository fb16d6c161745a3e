"""Halo orbits of the Earth-Moon system about L2: a family continued towards the Moon by pseudo-arclength.

The restricted three-body problem in its rotating frame. Each orbit is predicted by extrapolation from two previous ones
and corrected by `periodic_orbit` at right angles to the family, so that turning points are passed; the step along the
family grows while the correction is small. Four orbits are compared with the catalogue of the Jet Propulsion
Laboratory.
"""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import scvi_codegen as sc

problem = sc.LagrangianSystem.from_text(
    name="restricted three-body problem",
    coordinates=["x", "y", "z"],
    lagrangian="((x_dot - y)**2 + (y_dot + x)**2 + z_dot**2)/2"
    " + (1 - mu)/sqrt((x + mu)**2 + y**2 + z**2) + mu/sqrt((x - 1 + mu)**2 + y**2 + z**2)",
    parameters={"mu": 1.215058560962404e-2},
)
stepper = sc.compile_stepper(problem, sc.SVI(8))

# z, x, dy/dt, period: northern halo orbits about L2, https://ssd.jpl.nasa.gov/tools/periodic_orbits.html
PUBLISHED = (
    (0.09442299937998082, 1.1699952083306175, -0.1926143541813389, 3.3378824002096996),
    (0.15915200933380999, 1.1427323976670050, -0.2223390282851090, 3.1327035113287223),
    (0.19219343403238076, 1.1131543850560104, -0.2227347437348388, 2.8132733875316878),
    (0.20231055618100155, 1.0831337559276397, -0.2012116805518456, 2.3861839336103214),
)


def closed(z: np.ndarray, fixed: list[str]) -> sc.PeriodicOrbit:
    return sc.periodic_orbit(stepper, z[:3], z[3:6], period=z[6], steps=160, fixed=fixed)


def place(orbit: sc.PeriodicOrbit) -> np.ndarray:
    return np.concatenate([orbit.q, orbit.p, [orbit.period]])


def published(height: float, x: float, speed: float, period: float) -> np.ndarray:
    return np.array([x, 0.0, height, 0.0, speed + x, 0.0, period])


family = [closed(published(*PUBLISHED[0]) - [0, 0, lower, 0, 0, 0, 0], ["y", "z"]) for lower in (0.001, 0.0)]
way = 0.005
while family[-1].period > 1.7:
    before, last = map(place, family[-2:])
    try:
        family.append(closed(last + way * (last - before) / np.linalg.norm(last - before), ["y"]))
        way = min(way * 4 / max(family[-1].iterations, 2), 0.03)
    except sc.OrbitError:
        way /= 2

for row in PUBLISHED:
    orbit = closed(published(*row) * (1 + 1e-5 * np.array([1, 0, 0, 0, 1, 0, 1])), ["y", "z"])
    away = np.abs(place(orbit) - published(*row)).max()
    print(f"z = {row[0]:.4f}: period {orbit.period:.10f}, {away:.0e} from the published orbit")
worst = max(orbit.reciprocal_error for orbit in family)
largest = [max(abs(orbit.stability_indices)) for orbit in family]
stable = [orbit.period for orbit in family if orbit.stable]
print(f"{len(family)} orbits, periods {family[0].period:.2f} to {family[-1].period:.2f}, pairs within {worst:.0e}")
print(f"stability index {largest[0]:.0f} to {largest[-1]:.2f}; stable between {min(stable):.2f} and {max(stable):.2f}")

figure, (path, index) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for orbit in family[::3]:
    run = orbit.run()
    path.plot(run.q[:, 0], run.q[:, 2], color="C0" if orbit.stable else "C7", lw=0.8)
path.plot(1 - stepper.defaults[0], 0, "ko")
path.set(xlabel="x", ylabel="z", title="halo orbits about L2 (blue: stable)", aspect="equal")
index.semilogy([orbit.period for orbit in family], largest, ".-")
index.axhline(1.0, color="C7", lw=0.8)
index.set(xlabel="period", ylabel="largest stability index")
figure.savefig("halo_orbits.png", dpi=110)
