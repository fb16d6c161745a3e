"""Rotations declared by frames of ``sympy.physics.vector`` that are oriented by a quaternion."""

from collections.abc import Mapping
from typing import Any

import sympy
from sympy import Expr, Matrix, S
from sympy.core.function import AppliedUndef

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.rotations.members import Rotation, matrix_of, rates_matrix
from scvi_codegen.formulas.symbols import symbol


def rotations_of_frames(rotations: Mapping[Any, Any] | None) -> tuple[dict[str, str], dict[Expr, Expr]]:
    """Return rotations with their rates by name, and the rules that replace the functions of frames in formulas.

    Args:
        rotations: rate by name, or for a frame with ``B.orient_quaternion(N, ..)`` the frame N by the frame B. The
            rotation is then called as the frame, and its rate ``omega``, or ``omega_B`` if there are several frames.

    Raises:
        SystemDefinitionError: if a frame is not oriented by a quaternion of four functions of time.
    """
    names: dict[str, str] = {}
    rules: dict[Expr, Expr] = {}
    several = sum(not isinstance(each, str) for each in rotations or {}) > 1
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
    if len(functions) != 4 or len(q) != 4 or any(each != 0 for each in (matrix - matrix_of(q)).expand()):
        raise SystemDefinitionError(
            f"the frame '{frame}' is not oriented in '{base}' by a quaternion: write {frame}.orient_quaternion({base}, "
            "dynamicsymbols('q0:4')), or name a rotation, rotations={'R': 'omega'}"
        )
    return tuple(S(each) for each in q)
