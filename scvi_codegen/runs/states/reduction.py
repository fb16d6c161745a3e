"""Reduced tangent spaces of states with rotations, directions and spins: tangent vectors without gauge directions.

A rotation has two gauge directions at (q, p) with q . p = 0: the scaling (q, -p) and its conjugate (0, q). The
symplectic complement of both, modulo the first, is the tangent space of T*SO(3). With q^ = q/|q|, p^ = |q| p, an
orthonormal basis B of the vectors orthogonal to q^ (E(q^) for a quaternion) and canonical coordinates (a, b) it is

    dq^ = B a,           dp^ = B b - q^ (p^ . B a)
    a = B^T dq^,         b = B^T dp^ + (q^ . dq^) B^T p^

and likewise for a direction, with dq = |q| dq^ and dp = dp^/|q|. Of a spin z = q + i p in C^2 the gauge directions are
z and i z; a + i b is the component of dz along the unit vector orthogonal to z. A step maps gauge directions to gauge
directions, so the second pair of formulas undoes the first whatever the lengths and signs of quaternions are.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.runs.states.attitudes import rates_matrices
from scvi_codegen.runs.states.rotations import Member, members_of
from scvi_codegen.runs.states.validation import Array

FREEDOM = {"rotation": 3, "direction": 2, "spin": 1}
"""Degrees of freedom without gauge."""
POLE = 0.87
"""Third component of a direction above which its tangent plane is spanned with the first axis, not the third."""
SMALL = 0.13
"""Relative size of the first component of a spin below which the second one defines its phase."""


class Reduction:
    """Maps between tangent vectors of (q, p) and those of the reduced space, in canonical coordinates (a, b)."""

    def __init__(self, interface: Interface) -> None:
        self.dimension, self.members = interface.dimension, members_of(interface.dimension, interface.rotations)
        self.ordinary = self.members[0].columns.start if self.members else interface.dimension
        self.size = 2 * (self.ordinary + sum(FREEDOM[member.kind] for member in self.members))

    def inward(self, q: Array, p: Array) -> Array:
        """Return (.., 2m, size) matrices from (a, b) to changes of (q, p), from (.., m) positions and momenta."""
        m, n, half = self.dimension, self.ordinary, self.size // 2
        result = np.zeros((*q.shape[:-1], 2 * m, self.size))
        result[..., :n, :n] = np.eye(n)
        result[..., m : m + n, half : half + n] = np.eye(n)
        for member, dq, a in self._parts():
            dp = slice(m + dq.start, m + dq.stop)
            b = slice(half + a.start, half + a.stop)
            position, momentum = q[..., dq], p[..., dq]
            if member.kind == "spin":  # dq + i dp = (a + i b) other
                other = _orthogonal_spin(position, momentum)[..., np.newaxis]
                result[..., dq, a], result[..., dq, b] = other.real, -other.imag
                result[..., dp, a], result[..., dp, b] = other.imag, other.real
                continue
            # dq = |q| B a, dp = B b / |q| - q^ (p . B a)
            basis, unit, length = _basis(member, position)
            result[..., dq, a], result[..., dp, b] = length * basis, basis / length
            result[..., dp, a] = -unit[..., np.newaxis] * (momentum[..., np.newaxis, :] @ basis)
        return result

    def outward(self, q: Array, p: Array) -> Array:
        """Return (.., size, 2m) matrices from changes of (q, p) to (a, b), the symplectic transposes of ``inward``.

        With S = (Q_a Q_b; P_a P_b) of ``inward`` and J = (0 1; -1 0) it is J^-1 S^T J, hence

            a = P_b^T dq - Q_b^T dp,   b = -P_a^T dq + Q_a^T dp.
        """
        m, half = self.dimension, self.size // 2
        columns = np.swapaxes(self.inward(q, p), -1, -2)
        by_q, by_p = columns[..., :m], columns[..., m:]
        of_a = np.concatenate([by_p[..., half:, :], -by_q[..., half:, :]], axis=-1)
        of_b = np.concatenate([-by_p[..., :half, :], by_q[..., :half, :]], axis=-1)
        return np.concatenate([of_a, of_b], axis=-2)

    def at(self, t: float, parameters: Array) -> "Reduction":
        """Return the maps at a time: these, which do not depend on it."""
        return self

    def outward_beside(self, state: Array, other: Array) -> Array:
        """Return ``outward`` at a state near another one, whose coordinates they share."""
        return self.outward(*np.split(state, 2))

    def shift(self, state: Array, parameter: int, period: float) -> Array:
        """Return the change (2m,) of a state by a parameter, which is none."""
        return np.zeros(2 * self.dimension)

    def aligned(self, state: Array, like: Array) -> Array:
        """Return a state (2m,) with the lengths, signs and phases nearest to those of another."""
        m, state = self.dimension, state.copy()
        q, p = state[:m], state[m:]
        for member, rows, _ in self._parts():
            reference = like[:m][rows]
            if member.kind == "spin":
                z, leading = q[rows] + 1j * p[rows], reference + 1j * like[m:][rows]
                z *= np.exp(1j * np.angle(np.vdot(z, leading)))
                q[rows], p[rows] = z.real, z.imag
                continue
            factor = np.linalg.norm(reference) / np.linalg.norm(q[rows])
            factor *= -1.0 if member.kind == "rotation" and q[rows] @ reference < 0.0 else 1.0
            q[rows], p[rows] = q[rows] * factor, p[rows] / factor
        return state

    def gauge(self, state: Array, like: Array) -> tuple[Array, Array]:
        """Return values that depend only on the gauge of a state (2m,), 0 for a normalised one, and their derivatives.

        They are (|q|^2 - 1)/2 and q . p of rotations and directions, and the phase of spins relative to ``like``.
        """
        m, values, rows = self.dimension, [], []

        def add(value: Array, by_position: Array, by_momentum: Array, columns: slice) -> None:
            row = np.zeros(2 * m)
            row[:m][columns], row[m:][columns] = by_position, by_momentum
            values.append(value)
            rows.append(row)

        for member, columns, _ in self._parts():
            q, p = state[:m][columns], state[m:][columns]
            if member.kind == "spin":
                other, momentum = like[:m][columns], like[m:][columns]
                add(other @ p - momentum @ q, -momentum, other, columns)
            else:
                add((q @ q - 1) / 2, q, np.zeros_like(q), columns)
                add(q @ p, p, q, columns)
        return np.array(values), np.array(rows).reshape(-1, 2 * m)

    def normalised(self, q: Array, p: Array) -> tuple[Array, Array]:
        """Return the state with unit quaternions and directions, and q . p = 0."""
        q, p = q.copy(), p.copy()
        for member, rows, _ in self._parts():
            if member.kind != "spin":
                length = np.linalg.norm(q[rows])
                q[rows] /= length
                p[rows] = length * p[rows]
                p[rows] -= q[rows] * (q[rows] @ p[rows])
        return q, p

    def _parts(self) -> Iterator[tuple[Member, slice, slice]]:
        """Yield the members with their columns among all coordinates, and among those of the reduced space."""
        first = self.ordinary
        for member in self.members:
            yield member, member.columns, slice(first, first + FREEDOM[member.kind])
            first += FREEDOM[member.kind]


def _basis(member: Member, q: Array) -> tuple[Array, Array, Array]:
    """Return (.., n, n - 1) orthonormal columns orthogonal to q, q/|q|, and (.., 1, 1) the length of q."""
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    unit = q / length
    if member.kind == "rotation":
        return rates_matrices(unit), unit, length[..., np.newaxis]
    beside = np.where(np.abs(unit[..., 2:]) < POLE, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(beside, unit)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(unit, first)], axis=-1), unit, length[..., np.newaxis]


def _orthogonal_spin(q: Array, p: Array) -> NDArray[np.complex128]:
    """Return (.., 2) unit vectors orthogonal to z = q + i p in C^2, whose phase follows that of z."""
    z = q + 1j * p
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    leading = np.where(np.abs(z[..., 0]) > SMALL, z[..., 0], z[..., 1])[..., np.newaxis]
    unit: NDArray[np.complex128] = np.stack([-np.conj(z[..., 1]), np.conj(z[..., 0])], axis=-1)
    return unit * (leading / np.abs(leading)) ** 2
