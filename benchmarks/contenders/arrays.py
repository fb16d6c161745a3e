"""Peers for array systems: leapfrog and a composition in hand-written C, and OpenMM."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cases.unforced import Array, Case
from benchmarks.report import Contender
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.methods.composition import Composition

DECLARATIONS = (
    "void leapfrog(int is_field, double *q, double *v, double *work, long n, double strength, double h, long steps, "
    "const double *kicks, const double *drifts, int leaps);"
)
LATTICES = Path(__file__).parents[1] / "lattices.c"
PLATFORMS = {"OpenMM CPU": ("CPU", {"Threads": "1"}), "OpenMM Reference": ("Reference", {})}
"""OpenMM's platforms: single precision with vectors in one thread; double precision with loops."""

Integrate = Callable[[], Array]


def _contender(case: Case, method: str, setting: str, prepare: Callable[[], Integrate]) -> Contender:
    return Contender(method, setting, "", 0.0, lambda _: prepare(), starts=1)


def step_counts(case: Case, halvings: range) -> list[int]:
    """Return numbers of steps in the span of a case: its own step size, halved repeatedly."""
    return [max(1, round(case.span / case.step * 2**k)) for k in halvings]


def by_hand_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield leapfrog and the composition of order 8 in C, written for one lattice."""
    for method, order, halvings in (("leapfrog by hand", 2, range(1, 13)), ("composition 8 by hand", 8, range(6))):
        for steps in step_counts(case, halvings[: 2 if quick else None]):
            yield by_hand(case, method, order, steps)


def by_hand(case: Case, method: str, order: int, steps: int) -> Contender:
    """Return one setting of the hand-written C."""
    assert case.arrays is not None
    assert case.arrays.by_hand is not None
    code = LATTICES.read_text(encoding="utf-8")
    source = Source(prefix="lattices", header=f"{DECLARATIONS}\n", code=code, declarations=DECLARATIONS)
    library = building.load(source, flags=(*building.TUNED_FLAGS, "-ffast-math"))
    kicks, drifts = (np.array([float(x) for x in row]) for row in Composition(order).kicks_and_drifts)
    is_field, count, strength = case.arrays.by_hand

    def prepare() -> Integrate:
        q, v, work = map(_aligned, (case.q[0], case.velocity[0], np.zeros(case.dimension)))
        arrays = [library.ffi.from_buffer("double[]", array) for array in (q, v, work, kicks, drifts)]
        state, tables = arrays[:3], arrays[3:]

        def integrate() -> Array:
            library.lib.leapfrog(is_field, *state, count, strength, case.span / steps, steps, *tables, len(kicks))
            end: Array = q
            return end

        return integrate

    return _contender(case, method, f"{steps} steps", prepare)


def _aligned(values: Array) -> Array:
    """Return a copy at a multiple of 64 bytes, as arrays of runs are: elsewhere loops take up to 1.5 times the time."""
    memory = np.empty(values.size + 7)
    first = -memory.ctypes.data // memory.itemsize % 8
    memory[first : first + values.size] = values
    copy: Array = memory[first : first + values.size]
    return copy


def openmm_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield OpenMM's Verlet integrator for the crystal."""
    for name in PLATFORMS:
        for steps in step_counts(case, range(1, 3 if quick else 10)):
            yield openmm_contender(case, name, steps)


def openmm_contender(case: Case, name: str, steps: int) -> Contender:
    """Return ``steps`` steps of OpenMM on a platform.

    Atoms have unit mass, depth and diameter. OpenMM's velocities are those half a step before the positions, so that
    the start is shifted by half a kick; the method is then Stoermer-Verlet. Units are consistent: dalton, nm, ps,
    kJ/mol.
    """
    import openmm

    arrays = case.arrays
    assert arrays is not None
    q, v = (part[0].reshape(arrays.shape) for part in case.states)
    platform, properties = PLATFORMS[name]
    system, force = openmm.System(), openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.NoCutoff)
    for _ in q:
        system.addParticle(1.0)
        force.addParticle(0.0, 1.0, 1.0)
    system.addForce(force)
    h = case.span / steps
    integrator = openmm.VerletIntegrator(h)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)

    def prepare() -> Integrate:
        context.setPositions(q)
        forces: Any = context.getState(forces=True).getForces(asNumpy=True)._value
        context.setVelocities(v - h / 2 * forces)
        return integrate

    def integrate() -> Array:
        integrator.step(steps)
        end: Any = context.getState(positions=True).getPositions(asNumpy=True)._value
        return np.ravel(end)

    return _contender(case, name, f"{steps} steps", prepare)
