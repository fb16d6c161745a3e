"""Conversion of gravitating bodies from and to REBOUND."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import sympy
from numpy.typing import ArrayLike

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.common.errors import StateError, SystemDefinitionError, imported
from scvi_codegen.common.validation import checks_arguments, of
from scvi_codegen.interfaces.models.systems import gravitating_bodies
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.systems.lagrangian import LagrangianSystem

AXES = "xyz"
UNITS = ("length", "time", "mass")
"""Kinds of units, in an order that REBOUND accepts."""
NEWTON = ("basic", "compensated")
"""REBOUND's names of pairwise gravity by direct summation."""
RELATIVE_TOLERANCE = 1e-11
"""Relative tolerance of the comparison of a Lagrangian with Newton's at random states."""


class GravitatingBodies(NamedTuple):
    """Result of :func:`from_rebound`.

    Attributes:
        system: n bodies in 3n Cartesian coordinates x0, y0, z0, x1, ..; parameters G, m0, m1, ..
        q, velocity: (3n,) in the frame and the units of the simulation.
        t: time of the simulation.
        units: names of the units of length, mass and time, empty if the simulation names none.
    """

    system: LagrangianSystem
    q: Array
    velocity: Array
    t: float
    units: dict[str, str]


def from_rebound(simulation: Any) -> GravitatingBodies:
    """Return the bodies of a ``rebound.Simulation`` as a system of Newtonian gravity, with their state.

    G is the simulation's; numbers are unchanged, in its inertial frame and units. Names, radii and the choice of an
    integrator are dropped.

    Raises:
        SystemDefinitionError: for anything but gravity between masses: massless bodies, test particles (``N_active``),
            softening, additional forces, changes before or after steps, boundaries, collisions, variational particles.
    """
    imported("rebound", "rebound")
    _check_plain(simulation)
    particles = simulation.particles[: simulation.N]
    masses = [particle.m for particle in particles]
    positions = {f"m{i}": [f"{axis}{i}" for axis in AXES] for i in range(len(masses))}
    parameters = {"G": simulation.G, **dict(zip(positions, masses, strict=True))}
    system = gravitating_bodies(f"{len(masses)} bodies", positions, parameters)
    q = np.array([[particle.x, particle.y, particle.z] for particle in particles]).ravel()
    velocity = np.array([[particle.vx, particle.vy, particle.vz] for particle in particles]).ravel()
    units = {kind: name for kind, name in simulation.units.items() if name}
    return GravitatingBodies(system, q, velocity, float(simulation.t), units)


BODIES = of("a LagrangianSystem, or bodies of from_rebound", LagrangianSystem, GravitatingBodies)


@checks_arguments(SystemDefinitionError, system=BODIES)
def to_rebound(
    system: LagrangianSystem | GravitatingBodies,
    q: ArrayLike | None = None,
    *,
    velocity: ArrayLike | None = None,
    t: float = 0.0,
    units: Mapping[str, str] | None = None,
) -> Any:
    """Return a ``rebound.Simulation`` of bodies that attract each other by Newton's law.

    G and the masses are determined from the Lagrangian numerically, to round-off, for the values of its parameters
    (``system.with_parameters``), whatever their names. The simulation uses IAS15, REBOUND's default.

    Args:
        system: system in Cartesian coordinates, body after body, of three axes, or two; or the result of
            :func:`from_rebound`, with its state, time and units.
        q, velocity: (3n,) or (2n,) state of the bodies.
        t: time.
        units: names of the system's units of ``length``, ``mass`` and ``time``; G remains the system's.

    Raises:
        SystemDefinitionError: for any other system.
        StateError: for states that do not fit it.
    """
    rebound = imported("rebound", "rebound")
    if isinstance(system, GravitatingBodies):
        if q is not None or velocity is not None or t != 0.0 or units is not None:
            raise StateError("bodies of from_rebound have a state, a time and units: omit q, velocity, t and units")
        system, q, velocity, t, units = system
    if q is None or velocity is None:
        raise StateError("to_rebound requires the state of the bodies: give q and velocity")
    axes, G, masses = _attraction(system)
    states = [_padded(value, name, len(masses), axes) for name, value in (("q", q), ("velocity", velocity))]
    simulation = rebound.Simulation()
    if units:
        if set(units) != set(UNITS):
            raise StateError(f"units must name {', '.join(UNITS)}, not {', '.join(map(str, units))}")
        simulation.units = tuple(units[kind] for kind in UNITS)
    simulation.G, simulation.t = G, checked_number(t, "t")
    for mass, position, motion in zip(masses, *states, strict=True):
        simulation.add(
            m=mass, **dict(zip(AXES, position, strict=True)), **dict(zip(("vx", "vy", "vz"), motion, strict=True))
        )
    return simulation


def _check_plain(simulation: Any) -> None:
    """Raise SystemDefinitionError for features other than gravity between masses."""
    particles, active = simulation.particles[: simulation.N], simulation.N_active
    hooks = [name for name in ("pre_timestep_modifications", "post_timestep_modifications") if _has(simulation, name)]
    massless = [i for i, particle in enumerate(particles) if not particle.m > 0.0]
    oddities = {
        "fewer than two bodies": len(particles) < 2,
        f"body {massless[:1]} without mass: remove it, or set its mass": bool(massless),
        f"softening = {simulation.softening}": simulation.softening != 0.0,
        f"gravity = {simulation.gravity!r}": simulation.gravity not in NEWTON,
        f"boundary = {simulation.boundary!r}": simulation.boundary != "none",
        f"collision = {simulation.collision!r}": simulation.collision != "none",
        f"N_active = {active}, bodies that attract no others (testparticle_type = {simulation.testparticle_type}): "
        "set N_active to -1 to let all attract each other, or remove them": 0 <= active < len(particles),
        f"{''.join(hooks[:1])}: write them as forces": bool(hooks),
        "variational particles": bool(simulation.N_var),
        "additional forces: write them as terms of L, or forces=": bool(simulation._additional_forces),
    }
    result = [what for what, there in oddities.items() if there]
    if result:
        raise SystemDefinitionError(f"only gravity between masses is supported; this simulation has {result[0]}")


def _has(simulation: Any, function: str) -> bool:
    """Return whether a function of C or Python is called by the simulation, NULL of C if not."""
    return bool(getattr(simulation, f"_{function}", None))


def _padded(value: ArrayLike, name: str, bodies: int, axes: int) -> Array:
    """Return (n, 3) of a flat state; the third component of two-dimensional bodies is 0."""
    array = real_array(value, name)
    if array.shape != (bodies * axes,):
        raise StateError(f"{name} must have {bodies * axes} entries, {axes} a body, not the shape {array.shape}")
    return np.pad(array.reshape(bodies, axes), ((0, 0), (0, 3 - axes)))


def _attraction(system: LagrangianSystem) -> tuple[int, float, list[float]]:
    """Return the number of axes of a body, G and the masses; raise SystemDefinitionError for other Lagrangians."""
    symbols = {*system.coordinates, *system.velocities, *system.constants}
    forced = system.forces or system.inputs or system.constraints
    if not forced and system.lagrangian.free_symbols <= symbols:
        at = [system.coordinates, system.velocities]
        formula = sympy.lambdify(at, system.lagrangian.subs(system.constants), "numpy")
        for axes in (3, 2):
            several = system.dimension % axes == 0 and system.dimension > axes
            if several and (gravity := _fitted(formula, system.dimension, axes)) is not None:
                G, masses = gravity
                return axes, G, masses.tolist()
    raise SystemDefinitionError(
        f"'{system.name}' is not a system of bodies with Newtonian gravity in Cartesian coordinates, one body after "
        "the other"
    )


def _fitted(formula: Callable[[Array, Array], float], m: int, axes: int) -> tuple[float, Array] | None:
    """Return G and the masses, fitted to L at random states and tested at others; ``None`` if L has another form."""
    # L = sum m_i v_i^2/2 + G sum m_i m_j/r_ij: masses from L at unit velocities, G from L at rest
    positions, motions = np.random.default_rng(1).normal(size=(2, 4, m))
    rest = np.zeros(m)
    masses = np.array([2.0 * (formula(positions[0], v) - formula(positions[0], rest)) for v in np.eye(m)[::axes]])
    if not np.all(masses > 0.0):
        return None
    shapes = np.array([_inverse_distances(q.reshape(-1, axes), masses) for q in positions])
    G = formula(positions[0], rest) / shapes[0]
    kinetic = 0.5 * motions**2 @ np.repeat(masses, axes)
    values = [[formula(q, rest), formula(q, v)] for q, v in zip(positions, motions, strict=True)]
    agrees = np.allclose(values, np.transpose([G * shapes, kinetic + G * shapes]), rtol=RELATIVE_TOLERANCE, atol=0.0)
    return (float(G), masses) if agrees and G > 0.0 else None


def _inverse_distances(positions: Array, masses: Array) -> float:
    """Return the sum over pairs of m m' / r."""
    pairs = combinations(range(len(masses)), 2)
    return sum(float(masses[i] * masses[j] / np.linalg.norm(positions[i] - positions[j])) for i, j in pairs)
