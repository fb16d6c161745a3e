"""Halo orbits of the Earth-Moon system about L2: the family towards the Moon, its stability and its bifurcations.

The restricted three-body problem in its rotating frame. `sc.family` continues an orbit by pseudo-arclength, so that
turning points are passed. Four orbits are compared with the catalogue of the Jet Propulsion Laboratory.
"""

import matplotlib

matplotlib.use("Agg")
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


def closed(height: float, x: float, speed: float, period: float) -> sc.PeriodicOrbit:
    return sc.periodic_orbit(
        stepper, [x, 0.0, height], velocity=[0.0, speed, 0.0], period=period, steps=160, fixed=["y", "z"]
    )


for z, x, speed, period in PUBLISHED:
    orbit = closed(z, x * (1 + 1e-5), speed, period * (1 + 1e-5))
    away = np.abs([orbit.q[0] - x, orbit.p[1] - (speed + x), orbit.period - period]).max()
    print(f"z = {z:.4f}: period {orbit.period:.10f}, {away:.0e} from the published orbit")

family = sc.family(stepper, closed(*PUBLISHED[0]), step=0.05, fixed=["y"], until="period < 1.7")
worst = max(orbit.reciprocal_error for orbit in family)
largest = abs(family.stability_indices).max(axis=1)
stable = [orbit.period for orbit in family if orbit.stable]
print(f"{len(family)} orbits, periods {family.periods[0]:.2f} to {family.periods[-1]:.2f}, pairs within {worst:.0e}")
print(f"stability index {largest[0]:.0f} to {largest[-1]:.2f}; stable between {min(stable):.2f} and {max(stable):.2f}")
for found in family.bifurcations:
    print(f"{found.kind} at the period {found.orbit.period:.6f}, C = {-2 * found.orbit.energy:.6f}")
family.plot("halo_orbits.png")
