"""Rotations of a ``System`` of ``sympy.physics.mechanics``: its spherical joints and its free bodies.

The frames of a spherical joint, which SymPy orients by three angles, are oriented by the matrix R of a rotation with
the angular velocity omega in the frame of the child. A rigid body that nothing connects to the inertial frame is free:
it gets the position (x, y, z) of its mass center and a rotation.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from sympy import Expr, Matrix, sympify
from sympy.physics.mechanics import RigidBody, SphericalJoint, Vector, dynamicsymbols

from scvi_codegen.api.formulas import Rotation
from scvi_codegen.extras.robots.kinetics import are_zero
from scvi_codegen.extras.robots.trees.tree import identifier
from scvi_codegen.extras.robots.variables import Variables

if TYPE_CHECKING:
    from sympy.physics.mechanics import ReferenceFrame, System


def with_rotations(system: System) -> tuple[System, tuple[Rotation, ...]]:
    """Return a copy of the system with rotations in place of spherical joints and for free bodies.

    A spherical joint keeps its angles if other formulas contain them or their speeds: loads, constraints, kinematic
    equations, potential energies, other frames, and velocities that are not the rates of positions.
    """
    names = {joint.name for joint in system.joints if isinstance(joint, SphericalJoint) and joint._amounts is None}
    while True:
        turned: Any = copy.deepcopy(system, {id(system.eom_method): system.eom_method})
        joints = [joint for joint in turned.joints if joint.name in names]
        owners = {f: joint.name for joint in joints for f in (*joint.coordinates, *joint.speeds)}
        in_angles = {owners[f] for f in _built_in(turned, owners)}
        rotations = [_turn(joint.child_interframe, joint.parent_interframe, joint.name) for joint in joints]
        kinematics = {equation for joint in joints for equation in joint.kdes}
        for key in ("q_ind", "q_dep", "u_ind", "u_dep", "kdes"):
            setattr(turned, key, [entry for entry in getattr(turned, key) if entry not in {*owners, *kinematics}])
        rotations += _freed(turned)
        for frame in _connected([turned.frame], "_dcm_dict"):
            frame._dcm_cache = dict(frame._dcm_dict)  # private: products of matrices, which contain the angles
        _forget(turned, owners)
        in_angles |= {name for f, name in owners.items() if any(formula.has(f) for formula in _formulas(turned))}
        if not in_angles:
            return turned, tuple(rotations)
        names -= in_angles


def _turn(frame: ReferenceFrame, base: ReferenceFrame, name: str) -> Rotation:
    """Orient a frame in another by a rotation, without changing how others are oriented in them."""
    rotation = Rotation(f"R_{identifier(name)}", f"omega_{identifier(name)}")
    matrix = Matrix(3, 3, rotation.entries)
    base._dcm_dict[frame], frame._dcm_dict[base] = matrix, matrix.T
    frame.set_ang_vel(base, Vector([(Matrix(rotation.rates), frame)]))
    return rotation


def _freed(system: Any) -> Iterator[Rotation]:
    """Give positions and rotations to the rigid bodies that are not connected, of a joint the parent first."""
    children = [joint.child for joint in system.joints]
    for body in sorted(system.bodies, key=children.__contains__):
        located = body.masscenter in _connected([system.fixed_point], "_pos_dict")
        moving = located or system.frame in body.masscenter._vel_dict
        if moving or not isinstance(body, RigidBody) or body.frame in _connected([system.frame], "_ang_vel_dict"):
            continue
        place = dynamicsymbols(" ".join(f"{axis}_{identifier(body.name)}" for axis in "xyz"))
        system.add_coordinates(*place)
        position = Vector([(Matrix(place), system.frame)])
        body.masscenter.set_pos(system.fixed_point, position)
        body.masscenter.set_vel(system.frame, position.dt(system.frame))
        yield _turn(body.frame, system.frame, body.name)


def _connected(first: Iterable[Any], relation: str) -> list[Any]:
    """Return frames or points and all that are oriented or located relative to them."""
    connected = list(first)
    for reference in connected:
        connected += [other for other in getattr(reference, relation) if other not in connected]
    return connected


def _points(system: Any) -> list[Any]:
    return _connected([system.fixed_point, *(body.masscenter for body in system.bodies)], "_pos_dict")


def _forget(system: Any, functions: Collection[Expr]) -> list[tuple[Any, Any, Any]]:
    """Remove the velocities of points that contain functions; return points, frames and these velocities."""
    removed = [
        (point, frame, velocity)
        for point in _points(system)
        for frame, velocity in point._vel_dict.items()
        if any(component.has(*functions) for component in _components(velocity))
    ]
    for point, frame, _ in removed:
        del point._vel_dict[frame]
    return removed


def _built_in(system: Any, functions: Mapping[Expr, str]) -> set[Expr]:
    """Return the functions that occur in velocities of points that are not the rates of their positions."""
    if not functions:
        return set()
    time, occurring = dynamicsymbols._t, set()
    speeds = {q.diff(time): u for joint in system.joints for q, u in zip(joint.coordinates, joint.speeds, strict=True)}
    variables = Variables(tuple(system.q), time, tuple(system.u))
    for point, frame, velocity in _forget(system, functions):
        try:
            excess = (point.vel(frame) - velocity).to_matrix(frame).xreplace(speeds)
        except ValueError:
            excess = Matrix([1])
        if not are_zero(map(variables.read, excess)):
            occurring |= {f for f in functions if any(component.has(f) for component in _components(velocity))}
    return occurring


def _components(vector: Any) -> Iterator[Expr]:
    """Yield the components of a vector in the frames in which it is written."""
    for components, _ in vector.args:
        yield from components


def _formulas(system: Any) -> Iterator[Expr]:
    """Yield the formulas of a system: kinematics, constraints, energies, loads, orientations and positions."""
    energies = (sympify(body.potential_energy) for body in system.bodies)
    yield from (*system.kdes, *system.holonomic_constraints, *system.velocity_constraints, *energies)
    loads = [*system.loads, *(load for actuator in system.actuators for load in actuator.to_loads())]
    for _, vector in loads:
        yield from _components(vector)
    for frame in _connected([system.frame], "_dcm_dict"):
        for matrix in frame._dcm_dict.values():
            yield from matrix
        for vector in frame._ang_vel_dict.values():
            yield from _components(vector)
    for point in _points(system):
        for vector in point._pos_dict.values():
            yield from _components(vector)
