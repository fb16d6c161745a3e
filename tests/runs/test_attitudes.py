"""Quaternions, matrices, Euler angles and angular velocities, against SciPy's rotations and finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import scvi_codegen as sc
from scvi_codegen.runs.states.attitudes import (
    angular_velocity,
    body_momentum,
    euler_angles,
    matrices,
    momenta_of_body,
    quaternions,
    velocities_of_body,
)

MANY = Rotation.random(40, random_state=1)


def test_matrices_are_those_of_scipy():
    q = quaternions(MANY, "R")
    np.testing.assert_allclose(matrices(q), MANY.as_matrix(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(matrices(-3.0 * q), MANY.as_matrix(), rtol=0, atol=1e-14)


def test_quaternions_of_matrices_are_those_of_scipy_near_every_half_turn():
    turns = [Rotation.from_rotvec(axis * np.pi * (1 - 1e-9)) for axis in np.eye(3)]
    rotations = Rotation.concatenate([MANY, *turns, Rotation.identity()])
    found = quaternions(rotations.as_matrix(), "R")
    np.testing.assert_allclose(np.abs((found * quaternions(rotations, "R")).sum(axis=1)), 1.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize("axes", ["zxz", "ZYX", "xyz", "YXY"])
def test_euler_angles_are_those_of_scipy(axes):
    angles = [0.4, 0.9, -0.3]
    q = quaternions({"euler": axes, "angles": angles}, "R")
    np.testing.assert_allclose(matrices(q), Rotation.from_euler(axes, angles).as_matrix(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(euler_angles(q, axes), angles, rtol=0, atol=1e-14)


def test_axis_and_angle_turn_about_the_axis():
    turned = matrices(quaternions({"axis": [0, 0, 2], "angle": np.pi / 2}, "R"))
    np.testing.assert_allclose(turned @ [1, 0, 0], [0, 1, 0], rtol=0, atol=1e-15)


def test_angular_velocity_in_the_body_frame_moves_the_matrix():
    rng = np.random.default_rng(2)
    q, omega, h = 1.7 * quaternions(MANY, "R"), rng.normal(size=(40, 3)), 1e-6
    v = velocities_of_body(q, omega)
    rate = (matrices(q + h * v) - matrices(q - h * v)) / (2 * h)
    cross = np.cross(np.eye(3)[None], omega[:, None, :]) * -1.0  # columns e_k: omega x e_k
    np.testing.assert_allclose(rate, matrices(q) @ np.swapaxes(cross, 1, 2), rtol=0, atol=1e-8)
    np.testing.assert_allclose(angular_velocity(q, v), omega, rtol=0, atol=1e-14)
    np.testing.assert_allclose(body_momentum(q, momenta_of_body(q, omega)), omega, rtol=0, atol=1e-14)


@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_the_length_of_an_initial_quaternion_neither_overflows_nor_underflows(size):
    np.testing.assert_allclose(quaternions(size * np.ones(4), "R"), 0.5 * np.ones(4), rtol=1e-15)


def test_orders_of_quaternions_and_rotation_vectors_are_named():
    turned = Rotation.from_rotvec([[0.3, -0.5, 0.8], [1.2, 0.1, 0.0]])
    last, wanted = turned.as_quat(), quaternions(turned, "R")
    for given in (
        {"quaternion": last, "order": "xyzw"},
        {"quaternion": 3 * np.roll(last, 1, axis=-1), "order": "wxyz"},
        {"rotation_vector": turned.as_rotvec()},
    ):
        found = quaternions(given, "R")
        np.testing.assert_allclose(found * np.sign((found * wanted).sum(axis=1))[:, None], wanted, rtol=0, atol=1e-15)
    with pytest.raises(sc.StateError, match="must be 'wxyz' or 'xyzw', not 'xwyz'"):
        quaternions({"quaternion": last, "order": "xwyz"}, "R")
    with pytest.raises(sc.StateError, match="the rotation vector of 'R' must have three components"):
        quaternions({"rotation_vector": [1.0, 2.0]}, "R")
