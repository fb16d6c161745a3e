"""Lagrangian systems of ``LagrangesMethod``, ``KanesMethod`` and ``System`` of ``sympy.physics.mechanics``."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import sympy
from sympy import Expr, Symbol
from sympy.physics.mechanics import KanesMethod, LinearSpring, dynamicsymbols

from scvi_codegen.api.formulas import Rotation
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.extras.robots.kinetics import gyroscopic_forces, kinetic_energy, load_forces, motions_of, potential_of
from scvi_codegen.extras.robots.turning import with_rotations
from scvi_codegen.extras.robots.variables import Variables, independent_of, solved_for_speeds

if TYPE_CHECKING:
    from sympy.physics.mechanics import LagrangesMethod, ReferenceFrame, System


@dataclass(frozen=True, slots=True, kw_only=True)
class Multibody:
    """Multibody system in SymPy's terms: bodies, loads and constraints.

    Attributes:
        frame: the inertial frame.
        time: its symbol.
        coordinates, speeds: q(t), and generalised speeds u(t) or dq/dt.
        kinematics: linear expressions in dq/dt and u that are 0.
        auxiliary: auxiliary speeds, which are 0.
        bodies: particles and rigid bodies.
        loads: in groups that act together, each of pairs of a point and a force or of a frame and a torque.
        potential: total potential energy of the bodies.
        configuration: expressions in q and t that are 0.
        velocity: expressions in q, dq/dt, u and t that are 0, with or without the rates of ``configuration``.
        rotations: rotations of frames; their entries and rates are symbols in the formulas of frames.
        origin: point at rest in the inertial frame, required with rotations.
    """

    frame: ReferenceFrame
    time: Symbol
    coordinates: tuple[Expr, ...]
    speeds: tuple[Expr, ...]
    kinematics: tuple[Expr, ...]
    auxiliary: tuple[Expr, ...]
    bodies: tuple[Any, ...]
    loads: tuple[tuple[Any, ...], ...]
    potential: Expr = sympy.S.Zero
    configuration: tuple[Expr, ...]
    velocity: tuple[Expr, ...]
    rotations: tuple[Rotation, ...] = ()
    origin: Any = None

    def formulas(self) -> Mapping[str, Any]:
        """Return arguments of :meth:`LagrangianSystem.from_sympy`: lagrangian, coordinates, forces and constraints.

        Raises:
            SystemDefinitionError: if SymPy does not know a velocity, speeds are not a combination of the rates of the
                coordinates, or masses depend on coordinates.
        """
        variables = Variables(self.coordinates, self.time, self.speeds, self.auxiliary, self.rotations)
        equations = (
            [row for row in map(variables.read, self.kinematics) if row.has(*variables.u)] if variables.u else []
        )
        idle = [u for u in variables.u if not any(row.has(u) for row in equations)]
        if idle and len(equations) + len(idle) == len(variables.u):
            return self._with_ignored(list(map(variables.write, idle))).formulas()
        if len(equations) != len(variables.u):
            raise SystemDefinitionError(
                f"there are {len(variables.u)} generalised speeds, but {len(equations)} kinematic "
                "equations for them: give as many, so that speeds are an invertible combination of "
                "the rates of the coordinates"
            )
        rolling = list(map(variables.write, self._beyond_configuration(variables)))
        variables.substitute_speeds(solved_for_speeds(equations, variables))
        energy, forces = self._dynamics(variables)
        write = variables.write
        torques = {
            rotation.name: list(map(write, forces[len(variables.x) + 3 * k :][:3]))
            for k, rotation in enumerate(self.rotations)
        }
        return {
            "lagrangian": write(energy) - self.potential,
            "coordinates": list(self.coordinates),
            "rotations": {rotation.name: rotation.rate for rotation in self.rotations},
            "torques": {name: torque for name, torque in torques.items() if any(torque)},
            "forces": {q: write(f) for q, f in zip(self.coordinates, forces, strict=False) if f != 0},
            "constraints": [*self.configuration, *(write(variables.read(condition)) for condition in rolling)],
        }

    def _beyond_configuration(self, variables: Variables) -> list[Expr]:
        """Return the velocity constraints, in plain symbols, that kinematics and configuration do not imply."""
        velocity = list(map(variables.read, self.velocity))
        implied = [*map(variables.read, self.kinematics)]
        implied += [variables.rate(variables.read(g)) for g in self.configuration]
        independent = independent_of(implied, velocity, (*variables.v, *variables.u)) if velocity else ()
        return [velocity[k] for k in independent]

    def _with_ignored(self, speeds: Sequence[Expr]) -> Multibody:
        """Return the system with a coordinate, its time integral, added for each speed that nothing depends on."""
        new = tuple(sympy.Function(f"integral_{u.func}")(self.time) for u in speeds)
        equations = tuple(q.diff(self.time) - u for q, u in zip(new, speeds, strict=True))
        return replace(self, coordinates=(*self.coordinates, *new), kinematics=(*self.kinematics, *equations))

    def _dynamics(self, variables: Variables) -> tuple[Expr, tuple[Expr, ...]]:
        """Return T - V, with the potential of conservative loads, and all other forces."""
        try:
            motions = motions_of(self.bodies, self.frame, variables)
            groups = [load_forces(group, self.frame, variables, self.origin) for group in self.loads]
        except (ValueError, TypeError) as error:
            reason = " ".join(str(error).split())
            raise SystemDefinitionError(
                f"SymPy cannot determine the velocities of bodies and loads: {reason}"
            ) from error
        if any(entry.has(*variables.x) for motion in motions for entry in motion.inertia):
            raise SystemDefinitionError(
                "a mass or an inertia depends on a coordinate, which is not supported: make it a parameter"
            )
        potential, forces = _split(groups, variables)
        beyond = gyroscopic_forces(motions, variables)
        return kinetic_energy(motions) - potential, tuple(map(sympy.Add, variables.projected(forces), beyond))


def _split(groups: Sequence[Sequence[Expr]], variables: Variables) -> tuple[Expr, tuple[Expr, ...]]:
    """Return the potential of the conservative loads, all together or by group, and the other forces."""
    changing = (*variables.v, variables.time, *variables.other_functions)
    parts = [[sympy.expand_mul(f).as_independent(*changing, as_Add=True) for f in group] for group in groups]
    static = [[part[0] for part in group] for group in parts]
    varying = [[part[1] for part in group] for group in parts]
    size = len(variables.rates) + len(variables.entries)
    whole = _potential_of(_sum(static, size), variables)
    if whole is not None:
        return whole, _sum(varying, size)
    potentials = [_potential_of(group, variables) for group in static]
    rest = [group for group, potential in zip(static, potentials, strict=True) if potential is None]
    return sympy.Add(*(potential for potential in potentials if potential is not None)), _sum([*rest, *varying], size)


def _potential_of(forces: Sequence[Expr], variables: Variables) -> Expr | None:
    """Return the potential of forces on coordinates and on entries of rotations; ``None`` if others act, or without."""
    places = [*range(len(variables.x)), *range(len(variables.rates), len(forces))]
    if any(forces[len(variables.x) : len(variables.rates)]):
        return None
    return potential_of([forces[i] for i in places], (*variables.x, *variables.entries))


def _sum(rows: Iterable[Sequence[Expr]], size: int) -> tuple[Expr, ...]:
    rows = list(rows)
    return tuple(sympy.Add(*(row[i] for row in rows)) for i in range(size))


def of_lagranges_method(method: LagrangesMethod) -> dict[Expr, Expr]:
    """Return the generalised forces of its ``forcelist`` by coordinate; its bodies are part of its Lagrangian.

    Raises:
        SystemDefinitionError: if there are loads, but no inertial frame.
    """
    loads = tuple(method.forcelist or ())
    if loads and method.inertial is None:
        raise SystemDefinitionError(
            "this LagrangesMethod has a forcelist, but no inertial frame: create it with frame=..."
        )
    variables = Variables(tuple(method.q), dynamicsymbols._t)
    forces = load_forces(loads, method.inertial, variables)
    return {q: variables.write(f) for q, f in zip(method.q, forces, strict=True) if f != 0}


def of_kanes_method(method: KanesMethod) -> Multibody:
    """Return the bodies and loads of a ``KanesMethod``, whether or not its equations were formed.

    Raises:
        SystemDefinitionError: if it has no bodies or no kinematic equations.
    """
    if not method.bodies:
        raise SystemDefinitionError(
            "this KanesMethod has no bodies, so no kinetic energy: create it with KanesMethod(..., "
            "bodies=..., forcelist=...), or call kanes_equations(bodies, loads) first"
        )
    implicit = copy.copy(method)
    implicit.explicit_kinematics = False  # kinematic equations in implicit form, not solved for the rates
    if not implicit.mass_matrix_kin:
        raise SystemDefinitionError(
            "this KanesMethod has no kinematic equations between speeds and rates: create it with kd_eqs=..."
        )
    rates = method.q.diff(dynamicsymbols._t)
    constraints = method._k_nh * method.u + method._f_nh if method._k_nh else ()  # private; so below
    return Multibody(
        frame=method._inertial,
        time=dynamicsymbols._t,
        coordinates=tuple(method.q),
        speeds=tuple(method.u),
        kinematics=tuple(implicit.mass_matrix_kin * rates - implicit.forcing_kin),
        auxiliary=tuple(method._uaux),
        bodies=tuple(method.bodies),
        loads=tuple((load,) for load in method.loads or ()),
        configuration=tuple(method._f_h),
        velocity=tuple(constraints),
    )


def of_system(system: System) -> Multibody:
    """Return the bodies, joints, loads and actuators of a ``System``, whether or not its equations were formed.

    Spherical joints and free bodies become rotations (:mod:`scvi_codegen.extras.robots.turning`). Potential
    energies of bodies are included unless its equations were formed by Kane's method, which omits them.
    """
    by_kane = isinstance(system.eom_method, KanesMethod)
    system, rotations = with_rotations(system)
    springs = [actuator for actuator in system.actuators if rotations and isinstance(actuator, LinearSpring)]
    groups = [tuple(actuator.to_loads()) for actuator in system.actuators if actuator not in springs]
    stored = (spring.stiffness * (spring.pathway.length - spring.equilibrium_length) ** 2 / 2 for spring in springs)
    energies = () if by_kane else (body.potential_energy for body in system.bodies)
    return Multibody(
        frame=system.frame,
        time=dynamicsymbols._t,
        coordinates=tuple(system.q),
        speeds=tuple(system.u),
        kinematics=tuple(system.kdes),
        auxiliary=tuple(system.u_aux),
        bodies=tuple(system.bodies),
        loads=(*groups, *((load,) for load in system.loads)),
        potential=sympy.Add(*energies, *stored),
        configuration=tuple(system.holonomic_constraints),
        velocity=tuple(system.velocity_constraints),
        rotations=rotations,
        origin=system.fixed_point,
    )
