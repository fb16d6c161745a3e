"""Bodies of REBOUND as a Lagrangian, and of a Lagrangian as a simulation of REBOUND: two functions to copy.

Requires REBOUND (``pip install rebound``). Numbers are unchanged: the frame (barycentric after ``move_to_com()``), the
units and G are those of the simulation.
"""

from itertools import combinations

import numpy as np
import rebound

import scvi_codegen as sc


def from_rebound(simulation):
    """Return the system of the bodies with parameters G, m0, m1, .., and their positions and velocities."""
    particles = simulation.particles[: simulation.N]
    if 0 <= simulation.N_active < simulation.N or simulation.N_var or not all(body.m > 0 for body in particles):
        raise ValueError("only bodies with masses, all of which attract each other, have this Lagrangian")
    if simulation.softening or (simulation.boundary, simulation.collision) != ("none", "none"):
        raise ValueError("only gravity has this Lagrangian: no softening, boundaries and collisions")
    names, axes = range(len(particles)), "xyz"
    kinetic = " + ".join(f"m{i}*(" + " + ".join(f"{x}{i}_dot**2" for x in axes) + ")/2" for i in names)
    gravity = " + ".join(
        f"G*m{i}*m{j}/sqrt(" + " + ".join(f"({x}{i} - {x}{j})**2" for x in axes) + ")"
        for i, j in combinations(names, 2)
    )
    system = sc.LagrangianSystem.from_text(
        f"{len(particles)} bodies",
        [f"{x}{i}" for i in names for x in axes],
        f"{kinetic} + {gravity}",
        parameters={"G": simulation.G} | {f"m{i}": body.m for i, body in enumerate(particles)},
    )
    return system, np.ravel([body.xyz for body in particles]), np.ravel([body.vxyz for body in particles])


def to_rebound(G, masses, q, velocity):
    """Return a simulation of bodies with these masses, positions and velocities, three numbers a body."""
    simulation = rebound.Simulation()
    simulation.G = G
    for mass, at, v in zip(masses, np.reshape(q, (-1, 3)), np.reshape(velocity, (-1, 3)), strict=True):
        simulation.add(m=mass, x=at[0], y=at[1], z=at[2], vx=v[0], vy=v[1], vz=v[2])
    return simulation


if __name__ == "__main__":
    simulation = rebound.Simulation()
    simulation.units = ("AU", "yr", "Msun")
    simulation.add(m=1.0)
    simulation.add(m=9.5e-4, a=5.2, e=0.05)
    simulation.add(m=2.9e-4, a=9.6, e=0.05, inc=0.02, omega=1.0)
    simulation.move_to_com()
    system, q, velocity = from_rebound(simulation)
    run = sc.compile_stepper(system, "svi:8").integrate(q, velocity=velocity, h=0.5, steps=2000)
    simulation.integrate(1000.0)  # by IAS15
    apart = np.abs(run.q[-1] - np.ravel([body.xyz for body in simulation.particles])).max()
    print(f"{system.name}: {apart:.0e} AU apart after 1000 years")

    outer = sc.problem("outer-solar-system")
    G, *masses = outer.system.defaults
    planets = to_rebound(G, masses, outer.q, outer.velocity)
    jupiter = planets.particles[1].orbit(primary=planets.particles[0])
    print(f"Jupiter: a = {jupiter.a:.4f} AU, e = {jupiter.e:.4f}")
    run = sc.compile_stepper(outer.system, "svi:8").integrate(outer.q, velocity=outer.velocity, h=100.0, steps=200)
    planets.integrate(20_000.0)
    apart = np.abs(run.q[-1] - np.ravel([body.xyz for body in planets.particles])).max()
    print(f"{outer.system.name}: {apart:.0e} AU apart after 20000 days")
