"""Rotations, directions and spins of the states of a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError, closest
from scvi_codegen.runtime.rotations.attitudes import (
    angular_velocity,
    body_momentum,
    euler_angles,
    matrices,
    unit_quaternions,
)
from scvi_codegen.runtime.rotations.states import Member, members_of

Array = NDArray[np.float64]


class AttitudeHistory:
    """Rotations, directions and spins at the states (q, p) of a trajectory; names may be omitted if there is one."""

    __slots__ = ()

    if TYPE_CHECKING:
        q: Array
        p: Array
        t: Array
        stepper: Any
        parameters: Array
        each: Any

    def rotation(self, name: str | None = None) -> Array:
        """Return (n, 3, 3) rotation matrices, from components in the body frame to components in space."""
        return matrices(self.q[..., self._member("rotation", name).columns])

    def quaternion(self, name: str | None = None) -> Array:
        """Return (n, 4) unit quaternions (w, x, y, z), continuous in time: q and -q are the same rotation."""
        return unit_quaternions(self.q[..., self._member("rotation", name).columns])

    def euler(self, axes: str, name: str | None = None) -> Array:
        """Return (n, 3) Euler angles in radians, with axes as of ``scipy.spatial.transform.Rotation``: ``"zxz"``."""
        return euler_angles(self.q[..., self._member("rotation", name).columns], axes)

    def angular_velocity(self, name: str | None = None, *, space: bool = False) -> Array:
        """Return (n, 3) angular velocities in the body frame, or in the space frame."""
        member = self._member("rotation", name)
        body = angular_velocity(self.q[..., member.columns], self._velocities()[..., member.columns])
        return self._in_space(member, body) if space else body

    def body_momentum(self, name: str | None = None) -> Array:
        """Return (n, 3) angular momenta of a rotation in the body frame, dl/domega."""
        columns = self._member("rotation", name).columns
        return body_momentum(self.q[..., columns], self.p[..., columns])

    def angular_momentum(self, name: str | None = None) -> Array:
        """Return (n, 3) angular momenta of a rotation in the space frame, without that of the motion of its centre."""
        return self._in_space(self._member("rotation", name), self.body_momentum(name))

    def direction(self, name: str | None = None) -> Array:
        """Return (n, 3) unit vectors."""
        return unit_quaternions(self.q[..., self._member("direction", name).columns])

    def spin(self, name: str | None = None) -> Array:
        """Return (n, 3) spins."""
        columns = self._member("spin", name).columns
        a, b = np.moveaxis(self.q[..., columns] + 1j * self.p[..., columns], -1, 0)
        transverse = np.conj(a) * b / 2
        return np.stack([transverse.real, transverse.imag, (np.abs(a) ** 2 - np.abs(b) ** 2) / 4], axis=-1)

    def _velocities(self) -> Array:
        """Return velocities of the shape of q; NaN after the end of a trajectory of an ensemble."""
        if self.q.ndim == 2:
            return np.asarray(self.stepper.velocity(self.q, self.p, self.t, self.parameters))
        velocities = np.full_like(self.q, np.nan)
        for k, (t, q, p, *_) in enumerate(self.each()):
            velocities[: len(t), k] = self.stepper.velocity(q, p, t, self.parameters[k])
        return velocities

    def _in_space(self, member: Member, vectors: Array) -> Array:
        return np.asarray(np.einsum("...ij,...j->...i", matrices(self.q[..., member.columns]), vectors))

    def _member(self, kind: str, name: str | None) -> Member:
        interface = self.stepper.interface
        members: Sequence[Member] = [
            each for each in members_of(interface.dimension, interface.rotations) if each.kind == kind
        ]
        names = [each.name for each in members]
        if name is None and len(members) == 1:
            return members[0]
        if name not in names:
            reason = f"there are {len(names)} of them: name one" if name is None else f"there is no {kind} '{name}'"
            hint = closest(str(name), names) if name is not None else "."
            raise StateError(f"{reason}{hint} The system has: {', '.join(names) or f'no {kind}'}")
        return members[names.index(name)]
