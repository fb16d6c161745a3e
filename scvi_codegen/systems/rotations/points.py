"""Forces at points of bodies: generalised forces and torques by virtual work.

A force f in space at the point r(x, R, n) does the virtual work f . delta r. With delta R = R hat(delta theta), theta
in the body frame, the generalised force on a coordinate is f . dr/dx, the torque on a rotation

    tau_k = f . sum_ij dr/dR_ij (R hat(e_k))_ij,

and the force on a direction f . dr/dn. For r = x + R s this is f on x and s x R^T f on R.

Rotations declared by frames of ``sympy.physics.vector`` that are oriented by a quaternion.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import sympy
from sympy import Expr, Matrix, S, zeros
from sympy.core.function import AppliedUndef

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.formulas.rotations import AXES, Direction, Homogeneous, Rotation, matrix_of, rates_matrix
from scvi_codegen.systems.formulas.symbols import symbol

KEYS = ("body", "point", "origin", "force", "frame")
FRAMES = ("space", "body")


def forces_at_points(
    entries: Sequence[Mapping[str, Any]],
    coordinates: Sequence[str],
    members: Sequence[Homogeneous],
    read: Callable[[Any], Expr],
) -> Iterator[tuple[str, Matrix]]:
    """Yield the generalised forces, by name of a coordinate, rotation or direction, of forces at points.

    Args:
        entries: mappings with ``point`` and ``force``, three formulas each; with the name of a rotation as ``body``,
            the point is in its frame, beside ``origin``, three formulas of the position of the body, by default 0, and
            with ``frame="body"`` the force, too.
        coordinates: names of the ordinary coordinates.
        members: rotations, directions and spins.
        read: converts a formula to an expression.
    """
    rotations = {member.name: member for member in members if isinstance(member, Rotation)}
    for k, entry in enumerate(entries):
        point, force = _vectors(entry, rotations, f"point_forces[{k}]", read)
        moving = {symbol(f"{name}_dot") for name in coordinates}.union(*(member.rates for member in members))
        if velocities := sorted(variable.name for variable in point.free_symbols & moving):
            raise SystemDefinitionError(f"the point of point_forces[{k}] depends on the velocity '{velocities[0]}'")
        for name in coordinates:
            yield name, Matrix([force.dot(point.diff(symbol(name)))])
        for member in members:
            if isinstance(member, Direction):
                yield member.name, Matrix([force.dot(point.diff(entry)) for entry in member.entries])
            elif isinstance(member, Rotation):
                yield member.name, member.torque([force.dot(point.diff(entry)) for entry in member.entries])


def _vectors(
    entry: Mapping[str, Any], rotations: Mapping[str, Rotation], where: str, read: Callable[[Any], Expr]
) -> tuple[Matrix, Matrix]:
    """Return a point and the force on it in the space frame, from an entry of ``point_forces``."""
    unknown = sorted(set(entry) - set(KEYS))
    if unknown or not {"point", "force"} <= set(entry):
        named = f"the unknown key '{unknown[0]}'" if unknown else "no point or no force"
        raise SystemDefinitionError(f"{where} has {named}. Required: point, force; optional: body, origin, frame")
    body, frame = entry.get("body"), entry.get("frame", "space")
    if frame not in FRAMES or (body is None and (frame != "space" or "origin" in entry)):
        origin = " and an origin" if "origin" in entry else ""
        raise SystemDefinitionError(
            f"{where} has the frame {frame!r}{origin} of the body {body!r}: frames are "
            "'space' and 'body'; origin and the frame 'body' require a body"
        )
    if body is not None and body not in rotations:
        raise SystemDefinitionError(f"{where} has the body '{body}'. Rotations: {', '.join(rotations) or 'none'}")
    point, origin, force = (
        _three(entry.get(key), f"the {key} of {where}", read) for key in ("point", "origin", "force")
    )
    if body is None:
        return point, force
    matrix = Matrix(3, 3, rotations[body].entries)
    return origin + matrix * point, matrix * force if frame == "body" else force


def _three(formulas: Any, role: str, read: Callable[[Any], Expr]) -> Matrix:
    if formulas is None:
        return zeros(3, 1)
    if not isinstance(formulas, Sequence) or isinstance(formulas, str) or len(formulas) != len(AXES):
        raise SystemDefinitionError(f"{role} must have three components, not {formulas!r}")
    return Matrix([read(formula if isinstance(formula, Expr) else str(formula)) for formula in formulas])


def rotations_of_frames(rotations: Mapping[Any, Any] | None) -> tuple[dict[str, str], dict[Expr, Expr]]:
    """Return rotations with their rates by name, and the rules that replace the functions of frames in formulas.

    Args:
        rotations: rate by name, or for a frame with ``B.orient_quaternion(N, ..)`` the frame N by the frame B. The
            rotation is then called as the frame, and its rate ``omega``, or ``omega_B`` if there are several frames.
    """
    names: dict[str, str] = {}
    rules: dict[Expr, Expr] = {}
    several = sum(not isinstance(frame, str) for frame in rotations or {}) > 1
    for frame, base in (rotations or {}).items():
        if isinstance(frame, str):
            names[frame] = base
            continue
        q = _quaternion(frame, base)
        member = Rotation(frame.name, f"omega_{frame.name}" if several else "omega")
        names[member.name] = member.rate
        coordinates = Matrix([symbol(name) for name in member.coordinates])
        unit = coordinates / sympy.sqrt(coordinates.dot(coordinates))
        velocity = rates_matrix(unit) * Matrix(member.rates) / 2
        time = q[0].args[0]
        rules |= dict(zip(q, unit, strict=True)) | {f.diff(time): v for f, v in zip(q, velocity, strict=True)}
        components = frame.ang_vel_in(base).to_matrix(frame)
        rules |= {f: rate for f, rate in zip(components, member.rates, strict=True) if isinstance(f, AppliedUndef)}
    return names, rules


def _quaternion(frame: Any, base: Any) -> tuple[Expr, ...]:
    """Return the functions (w, x, y, z) of a frame oriented by them: the trace of the matrix is 3 w^2 - x^2 - .."""
    matrix = base.dcm(frame).expand()
    functions = sorted(matrix.atoms(AppliedUndef), key=str)
    weights = [sympy.expand(matrix.trace()), *(matrix[k, k] for k in range(3))]
    q: list[Expr] = []
    for k, entry in enumerate(weights):
        q += [f for f in functions if f not in q and entry.coeff(f, 2) == (3 if k == 0 else 1)][:1]
    if len(functions) != 4 or len(q) != 4 or any(entry != 0 for entry in (matrix - matrix_of(q)).expand()):
        raise SystemDefinitionError(
            f"the frame '{frame}' is not oriented in '{base}' by a quaternion: write {frame}.orient_quaternion({base}, "
            "dynamicsymbols('q0:4')), or name a rotation, rotations={'R': 'omega'}"
        )
    return tuple(S(function) for function in q)
