"""OpenMM's Verlet integrator for Lennard-Jones atoms."""

from __future__ import annotations

from collections.abc import Callable

from scvi_codegen.benchmark.cases import Array

__all__ = ["PLATFORMS", "openmm_run"]

PLATFORMS = {"OpenMM_CPU": ("CPU", {"Threads": "1"}), "OpenMM_double": ("Reference", {})}
"""OpenMM's platforms by the name in the table: single precision with vectors in one thread; double precision with
loops."""


def openmm_run(
    name: str, q: Array, v: Array, accelerations: Callable[[Array], Array], span: float, steps: int
) -> Callable[[], Array]:
    """Return a function that performs ``steps`` steps from (q, v), (N, 3) each, and returns the positions.

    Atoms have unit mass, depth and diameter. OpenMM's velocities are those half a step before the positions, so that
    the start is shifted by half a kick; the method is then Stoermer-Verlet. Units are consistent: dalton, nm, ps,
    kJ/mol.
    """
    import openmm

    platform, properties = PLATFORMS[name]
    system, force = openmm.System(), openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.NoCutoff)
    for _ in q:
        system.addParticle(1.0)
        force.addParticle(0.0, 1.0, 1.0)
    system.addForce(force)
    h = span / steps
    integrator = openmm.VerletIntegrator(h)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)
    half_before = v - h / 2 * accelerations(q)

    def run() -> Array:
        context.setPositions(q)
        context.setVelocities(half_before)
        integrator.step(steps)
        end: Array = context.getState(positions=True).getPositions(asNumpy=True)._value
        return end

    return run
