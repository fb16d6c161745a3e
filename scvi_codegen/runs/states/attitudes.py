"""Attitudes as quaternions: conversion of initial values, and matrices, Euler angles and angular velocities.

A quaternion is (w, x, y, z), scalar part first, of any non-zero length; R(q) v = q v q^-1 takes components in the body
frame to components in the space frame. Formulas: :mod:`scvi_codegen.systems.rotations`. Euler angles are those of
``scipy.spatial.transform.Rotation`` (lower case: rotations about axes of space; upper case: about axes of the body).
"""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array

ACCEPTED = (
    "a quaternion (w, x, y, z), a rotation matrix (3, 3), {'euler': 'zxz', 'angles': [..]}, {'axis': [..], 'angle': "
    "..}, {'rotation_vector': [..]}, {'quaternion': [..], 'order': 'xyzw'}, or a scipy Rotation"
)
ORDERS = {"wxyz": 0, "xyzw": 1}
"""Shift of the components of a quaternion to (w, x, y, z), by their order."""
RATE_SIGNS = np.array([[-1, -1, -1], [1, -1, 1], [1, 1, -1], [-1, 1, 1]], dtype=float)
"""Signs of the components of a quaternion in E(q), see :func:`rates_matrices`."""
ORTHOGONAL = 1e-8
"""Largest deviation of R^T R from the identity of an initial matrix, which is then projected."""


def quaternions(value: Any, name: str) -> Array:
    """Return (.., 4) unit quaternions of an initial attitude.

    Args:
        value: (.., 4) quaternions; (.., 3, 3) matrices; a mapping with ``euler`` (axes) and ``angles`` in radians, or
            with ``axis`` and ``angle``; with ``rotation_vector`` (angle times unit axis); with ``quaternion`` and
            ``order``, ``"wxyz"`` or ``"xyzw"`` (scalar part first or last, as in ROS, SciPy and most files); or a
            ``scipy.spatial.transform.Rotation``.
        name: of the rotation, for messages.
    """
    array = _components(value, name)
    if not array.ndim or array.shape[-1] != 4:
        raise StateError(f"the rotation '{name}' must be {ACCEPTED}, not an array of the shape {array.shape}")
    largest = np.abs(array).max(axis=-1, keepdims=True)
    if not (np.isfinite(largest) & (largest > 0)).all():
        raise StateError(f"the quaternion of '{name}' must be finite and not zero, not {array.tolist()}")
    array = np.ldexp(array, -np.frexp(largest)[1])  # so that squares neither overflow nor underflow
    return np.asarray(array / np.linalg.norm(array, axis=-1, keepdims=True))


def _components(value: Any, name: str) -> Array:
    """Return (.., 4) quaternions of any length, or an array of another shape as it is."""
    if hasattr(value, "as_quat"):
        return np.roll(np.asarray(value.as_quat(), dtype=float), 1, axis=-1)
    if isinstance(value, Mapping):
        return _of_angles(value, name)
    array = real_array(value, name)
    return _of_matrices(array, name) if array.ndim >= 2 and array.shape[-2:] == (3, 3) else array


def _of_angles(value: Mapping[str, Any], name: str) -> Array:
    if set(value) == {"quaternion", "order"}:
        if value["order"] not in (*ORDERS,):
            raise StateError(
                f"the order of the quaternion of '{name}' must be 'wxyz' or 'xyzw', not {value['order']!r}"
            )
        return np.roll(real_array(value["quaternion"], name), ORDERS[value["order"]], axis=-1)
    from scipy.spatial.transform import Rotation  # imported on use: the core does without SciPy

    if set(value) == {"euler", "angles"}:
        try:
            rotation = Rotation.from_euler(value["euler"], real_array(value["angles"], name))
        except (ValueError, TypeError) as error:
            raise StateError(f"the Euler angles of '{name}' are invalid: {error}") from error
    elif set(value) == {"axis", "angle"}:
        axis, length, _ = scaled_vectors(value["axis"], f"the axis of '{name}'")
        angle = real_array(value["angle"], name)
        if axis.ndim != 1 or angle.ndim or not np.isfinite(angle):
            raise StateError(f"the axis of '{name}' must be one vector, and the angle a finite number")
        rotation = Rotation.from_rotvec(axis / length * angle)
    elif set(value) == {"rotation_vector"}:
        vector = real_array(value["rotation_vector"], name)
        if not vector.ndim or vector.shape[-1] != 3:
            raise StateError(
                f"the rotation vector of '{name}' must have three components, not the shape {vector.shape}"
            )
        rotation = Rotation.from_rotvec(vector)
    else:
        raise StateError(f"the rotation '{name}' must be {ACCEPTED}; the mapping has the keys {', '.join(value)}")
    return np.roll(np.asarray(rotation.as_quat(), dtype=float), 1, axis=-1)


def scaled_vectors(value: Any, name: str) -> tuple[Array, Array, Array]:
    """Return (.., 3) vectors divided by powers of two near their largest components, their lengths, and the exponents.

    Squares then neither overflow nor underflow.
    """
    vector = real_array(value, name)
    if not vector.ndim or vector.shape[-1] != 3:
        raise StateError(f"{name} must have three components, not {value!r}")
    if not np.isfinite(vector).all():
        raise StateError(f"{name} must be finite, not {value!r}")
    largest = np.abs(vector).max(axis=-1, keepdims=True)
    if not (largest > 0).all():
        raise StateError(f"{name} must not be zero, but is {value!r}: give three components, not all zero")
    exponent = np.frexp(largest)[1]
    scaled = np.ldexp(vector, -exponent)
    return scaled, np.linalg.norm(scaled, axis=-1, keepdims=True), exponent


def _of_matrices(matrix: Array, name: str) -> Array:
    """Return the quaternions of rotation matrices, whose largest components are positive.

    The unit quaternion q maximises sum_ij R_ij R(q)_ij = q^T K q (I. Y. Bar-Itzhack, J. Guidance 23 (2000), 1085-1087).
    """
    defect = np.abs(np.swapaxes(matrix, -1, -2) @ matrix - np.eye(3)).max()
    if not defect <= ORTHOGONAL or not (np.linalg.det(matrix) > 0).all():
        wrong = "its determinant is -1" if defect <= ORTHOGONAL else f"R^T R differs from the identity by {defect:.1e}"
        raise StateError(
            f"the matrix of '{name}' is not a rotation: {wrong}. Give an orthogonal matrix with determinant 1"
        )
    q = np.linalg.eigh(np.einsum("...ij,abij->...ab", matrix, _forms()))[1][..., -1]
    return np.asarray(q * np.sign(np.take_along_axis(q, np.abs(q).argmax(axis=-1, keepdims=True), axis=-1)))


@cache
def _forms() -> Array:
    """Return (4, 4, 3, 3) F of |q|^2 R(q) = sum_ab q_a q_b F_ab."""
    unit = np.eye(4)
    pairs = unit[:, np.newaxis] + unit
    of_pairs = matrices(pairs) * (pairs**2).sum(axis=-1)[..., np.newaxis, np.newaxis]
    return np.asarray((of_pairs - matrices(unit)[:, np.newaxis] - matrices(unit)) / 2)


def unit_vectors(q: Array) -> Array:
    """Return vectors or quaternions of length 1 along a run, whose sign is continuous as that of q is."""
    return np.asarray(q / np.sqrt((q * q).sum(axis=-1, keepdims=True)))


def matrices(q: Array) -> Array:
    """Return (.., 3, 3) rotation matrices of quaternions of any length."""
    w, x, y, z = np.moveaxis(unit_vectors(q), -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def in_space(q: Array, vectors: Array) -> Array:
    """Return (.., 3) components in space of vectors in the body frame."""
    return np.asarray(np.einsum("...ij,...j->...i", matrices(q), vectors))


def euler_angles(q: Array, axes: str) -> Array:
    """Return (.., 3) Euler angles in radians."""
    from scipy.spatial.transform import Rotation  # imported on use: the core does without SciPy

    flat = np.roll(unit_vectors(q).reshape(-1, 4), -1, axis=-1)
    try:
        angles = Rotation.from_quat(flat).as_euler(axes)
    except ValueError as error:
        raise StateError(f"the Euler axes {axes!r} are invalid: {error}") from error
    return np.asarray(angles).reshape(*q.shape[:-1], 3)


def angular_velocity(q: Array, v: Array) -> Array:
    """Return (.., 3) angular velocities in the body frame, 2 E(q)^T v/|q|^2."""
    return np.asarray(2 * _transposed(q, v) / (q * q).sum(axis=-1, keepdims=True))


def body_momentum(q: Array, p: Array) -> Array:
    """Return (.., 3) angular momenta in the body frame, E(q)^T p/2."""
    return np.asarray(_transposed(q, p) / 2)


def velocities_of_body(q: Array, rate: Array) -> Array:
    """Return (.., 4) velocities E(q) omega/2 of an angular velocity in the body frame."""
    return np.asarray(_rotated(q, rate) / 2)


def momenta_of_body(q: Array, momentum: Array) -> Array:
    """Return (.., 4) momenta 2 E(q) Pi/|q|^2 of an angular momentum in the body frame."""
    return np.asarray(2 * _rotated(q, momentum) / (q * q).sum(axis=-1, keepdims=True))


def rates_matrices(q: Array) -> Array:
    """Return the (.., 4, 3) matrices E(q) with q_dot = E(q) omega/2; E^T E = |q|^2, E^T q = 0."""
    return np.asarray(np.take(q, [[1, 2, 3], [0, 3, 2], [3, 0, 1], [2, 1, 0]], axis=-1) * RATE_SIGNS)


def _transposed(q: Array, p: Array) -> Array:
    return np.asarray(np.einsum("...ij,...i->...j", rates_matrices(q), p))


def _rotated(q: Array, r: Array) -> Array:
    return np.asarray(np.einsum("...ij,...j->...i", rates_matrices(q), r))
