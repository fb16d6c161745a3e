"""OpenMM's Verlet integrator for atoms that all attract and repel each other by the potential of Lennard-Jones."""

from __future__ import annotations

from collections.abc import Callable

from scvi_codegen.benchmark.cases import Array

__all__ = ["PLATFORMS", "openmm_run"]

PLATFORMS = {"OpenMM_CPU": ("CPU", {"Threads": "1"}), "OpenMM_double": ("Reference", {})}
"""Of OpenMM, by the name in the table: vectors of single precision in one thread; plain loops in double precision."""


def openmm_run(
    name: str, q: Array, v: Array, accelerations: Callable[[Array], Array], span: float, steps: int
) -> Callable[[], Array]:
    """Runs so many steps from (q, v), (N, 3) each, and gives the positions; atoms of mass, depth and diameter 1.

    Its velocities are those half a step before positions, so that it begins half a kick back and is Stoermer-Verlet.
    Units of mass, length, time and energy belong together: dalton, nm, ps, kJ/mol.
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
