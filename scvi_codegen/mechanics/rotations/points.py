"""Forces at points of bodies: generalised forces and torques by virtual work.

A force f in space at the point r(x, R, n) does the virtual work f . delta r. With delta R = R hat(delta theta), theta
in the body frame, the generalised force on a coordinate is f . dr/dx, the torque on a rotation

    tau_k = f . sum_ij dr/dR_ij (R hat(e_k))_ij,

and the force on a direction f . dr/dn. For r = x + R s this is f on x and s x R^T f on R.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from sympy import Expr, Matrix, zeros

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.rotations.members import AXES, Direction, Homogeneous, Rotation
from scvi_codegen.formulas.symbols import symbol

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

    Raises:
        SystemDefinitionError: for other keys, bodies or frames, other numbers of formulas, and moving points.
    """
    rotations = {each.name: each for each in members if isinstance(each, Rotation)}
    for k, entry in enumerate(entries):
        point, force = _vectors(entry, rotations, f"point_forces[{k}]", read)
        moving = {symbol(f"{name}_dot") for name in coordinates}.union(*(each.rates for each in members))
        if found := sorted(each.name for each in point.free_symbols & moving):
            raise SystemDefinitionError(f"the point of point_forces[{k}] depends on the velocity '{found[0]}'")
        for name in coordinates:
            yield name, Matrix([force.dot(point.diff(symbol(name)))])
        for each in members:
            if isinstance(each, Direction):
                yield each.name, Matrix([force.dot(point.diff(entry)) for entry in each.entries])
            elif isinstance(each, Rotation):
                derivatives = Matrix(3, 3, [force.dot(point.diff(entry)) for entry in each.entries])
                yield each.name, torque_of(Matrix(3, 3, each.entries), derivatives)


def _vectors(
    entry: Mapping[str, Any], rotations: Mapping[str, Rotation], what: str, read: Callable[[Any], Expr]
) -> tuple[Matrix, Matrix]:
    """Return the point and the force in space."""
    unknown = sorted(set(entry) - set(KEYS))
    if unknown or not {"point", "force"} <= set(entry):
        named = f"the unknown key '{unknown[0]}'" if unknown else "no point or no force"
        raise SystemDefinitionError(f"{what} has {named}. Required: point, force; optional: body, origin, frame")
    body, frame = entry.get("body"), entry.get("frame", "space")
    if frame not in FRAMES or (body is None and (frame != "space" or "origin" in entry)):
        raise SystemDefinitionError(
            f"{what} has the frame {frame!r}{' and an origin' * ('origin' in entry)} of the body {body!r}: frames are "
            "'space' and 'body'; origin and the frame 'body' require a body"
        )
    if body is not None and body not in rotations:
        raise SystemDefinitionError(f"{what} has the body '{body}'. Rotations: {', '.join(rotations) or 'none'}")
    point, origin, force = (
        _three(entry.get(key), f"the {key} of {what}", read) for key in ("point", "origin", "force")
    )
    if body is None:
        return point, force
    matrix = Matrix(3, 3, rotations[body].entries)
    return origin + matrix * point, matrix * force if frame == "body" else force


def _three(formulas: Any, what: str, read: Callable[[Any], Expr]) -> Matrix:
    if formulas is None:
        return zeros(3, 1)
    if isinstance(formulas, str) or len(formulas) != len(AXES):
        raise SystemDefinitionError(f"{what} must have three components, not {formulas!r}")
    return Matrix([read(str(each)) for each in formulas])


def torque_of(matrix: Matrix, derivatives: Matrix) -> Matrix:
    """Return tau_k = sum_ij D_ij (R hat(e_k))_ij, with column j of R hat(e_k) = R (e_k x e_j)."""
    weights: Matrix = matrix.T * derivatives
    pairs: tuple[tuple[int, int], ...] = ((2, 1), (0, 2), (1, 0))
    return Matrix([weights[i, j] - weights[j, i] for i, j in pairs])
