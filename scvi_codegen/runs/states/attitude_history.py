"""Rotations, directions and spins of the states of a trajectory."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.runs.states.attitudes import (
    angular_velocity,
    body_momentum,
    euler_angles,
    in_space,
    matrices,
    unit_vectors,
)
from scvi_codegen.runs.states.frames import Frame, frame_at
from scvi_codegen.runs.states.rotation_quantities import spins, values_by_name
from scvi_codegen.runs.states.rotations import Member, members_of
from scvi_codegen.runs.states.validation import Array, coordinate_shapes, shapes_of
from scvi_codegen.runs.states.words import unnamed
from scvi_codegen.systems.formulas.symbols import DOT


class AttitudeHistory:
    """Rotations, directions and spins at the states (q, p) of a trajectory or run; the name may be omitted for one.

    Of a run in progress values are those of its state, without the axis of n states.
    ``t``, a time or times within a single trajectory, selects dense output as of :meth:`Trajectory.at` instead.
    """

    __slots__ = ()
    _has_dense_output: ClassVar[bool] = False  # whether there is a method ``at``

    if TYPE_CHECKING:
        q: Any
        p: Any
        stepper: Any
        parameters: Any
        each: Any
        at: Any
        pieces: Any
        t: Any
        energy: Any
        velocity: Any

    @property
    def variables(self) -> Array:
        """(n, d) values of all variables of a first-order system (:class:`~scvi_codegen.FirstOrderSystem`), in order.

        Raises:
            StateError: for other systems, whose states are q and p.
        """
        interface = self.stepper.interface
        if not interface.variables:
            raise StateError(f"'{interface.system}' is not a first-order system: its states are q and p")
        names = (*interface.coordinates, *interface.momenta)
        states = np.concatenate([self.q[:], self.p[:]], axis=-1)
        return unnamed(states[..., [names.index(name) for name in interface.variables]])

    def rotation(self, name: str | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return (n, 3, 3) rotation matrices, from components in the body frame to components in space."""
        return matrices(self._states(t)[0][..., self._member("rotation", name).columns])

    def scipy_rotation(self, name: str | None = None, *, t: ArrayLike | None = None) -> Any:
        """Return n rotations as a ``scipy.spatial.transform.Rotation``, from the body frame to space."""
        from scipy.spatial.transform import Rotation  # imported on use: the core does without SciPy

        return Rotation.from_quat(np.roll(self.quaternion(name, t=t), -1, axis=-1))

    def quaternion(self, name: str | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return (n, 4) unit quaternions (w, x, y, z), continuous in time: q and -q are the same rotation."""
        return unit_vectors(self._states(t)[0][..., self._member("rotation", name).columns])

    def euler(self, axes: str, name: str | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return (n, 3) Euler angles in radians, with axes as of ``scipy.spatial.transform.Rotation``: ``"zxz"``."""
        return euler_angles(self._states(t)[0][..., self._member("rotation", name).columns], axes)

    def angular_velocity(self, name: str | None = None, *, space: bool = False, t: ArrayLike | None = None) -> Array:
        """Return (n, 3) angular velocities in the body frame, or in the space frame."""
        member, (q, p) = self._member("rotation", name), self._states(t)
        body = angular_velocity(q[..., member.columns], self._velocities(q, p, t)[..., member.columns])
        return in_space(q[..., member.columns], body) if space else body

    def body_momentum(self, name: str | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return (n, 3) angular momenta of a rotation in the body frame, dl/domega."""
        columns, (q, p) = self._member("rotation", name).columns, self._states(t)
        return body_momentum(q[..., columns], p[..., columns])

    def angular_momentum(self, name: str | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return (n, 3) angular momenta of a rotation in the space frame, without that of the motion of its centre."""
        columns, (q, p) = self._member("rotation", name).columns, self._states(t)
        return in_space(q[..., columns], body_momentum(q[..., columns], p[..., columns]))

    def direction(self, name: str | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return (n, 3) unit vectors."""
        return unit_vectors(self._states(t)[0][..., self._member("direction", name).columns])

    def spin(self, name: str | None = None, *, t: ArrayLike | None = None) -> Array:
        """Return (n, 3) spins."""
        columns, (q, p) = self._member("spin", name).columns, self._states(t)
        return spins(q[..., columns], p[..., columns])

    def frame(self, name: str) -> Frame:
        """Return position, rotation, velocities and Jacobians of a link, body or site of a robot in the world."""
        return frame_at(self.stepper.interface, name, (state := self._states(None))[0], self._velocities(*state, None))

    def _quantity(self, name: str) -> Array:
        """Return the values of one name at the states, (n, ..), or (n, k, ..) of an ensemble.

        Names are those of coordinates, momenta ``p_x``, velocities ``x_dot``, arrays, fields on a mesh, rotations and
        their angular velocities, directions and spins; ``t``, ``energy``; and ``q``, ``p``, ``velocity``, all columns,
        unless a coordinate has this name.

        Raises:
            StateError: for another name.
        """
        interface, (q, p) = self.stepper.interface, self._states(None)
        if name in ("t", "energy"):
            return unnamed(self.t if name == "t" else self.energy())
        if (values := _fields(interface.layout.mesh, q, p).get(name)) is not None:
            return values
        if (columns := _columns(interface, name)) is not None:
            return unnamed(q[..., columns])
        if (columns := _momentum_columns(interface, name)) is not None:
            return unnamed(p[..., columns])
        if name.endswith(DOT) and (columns := _columns(interface, name.removesuffix(DOT))) is not None:
            return unnamed(self._velocities(q, p, None)[..., columns])
        if interface.rotations:
            derived = values_by_name(interface, q, p, self._velocities(q, p, None))
            if name in derived:
                return derived[name]
        if name in ("q", "p", "velocity"):  # no coordinate has this name: whole state vectors
            return {"q": q, "p": p}[name] if name != "velocity" else self._velocities(q, p, None)
        shown = [name for name, _ in coordinate_shapes(interface)]
        shown += [name for _, name, *_ in map(str.split, interface.rotations)]
        conjugates = [*(f"p_{name}" for name in shown), *(f"{name}{DOT}" for name in shown)]
        names = list(dict.fromkeys([*shown, *conjugates, "t", "energy", "q", "p", "velocity"]))
        raise StateError(f"there is no quantity '{name}' of the states{closest(name, names)} Known: {', '.join(names)}")

    def _states(self, t: ArrayLike | None) -> tuple[Array, Array]:
        if t is None:
            return unnamed(self.q[:]), unnamed(self.p[:])  # of recordings, which are read on access
        if not self._has_dense_output:
            raise StateError("recordings, ensembles and runs in progress have no dense output: omit t")
        q, p = self.at(t)
        return q, p

    def _velocities(self, q: Array, p: Array, t: ArrayLike | None) -> Array:
        """Return velocities of the shape of q; NaN after the end of a trajectory of an ensemble."""
        if self.q.ndim < 3 and t is None:
            return unnamed(self.velocity)
        if t is not None:
            if self.pieces:
                raise StateError("angular velocities between the states of a run with inputs are not available: omit t")
            return unnamed(self.stepper.velocity(q, p, t, self.parameters))
        velocities: Array = self.stepper._states.missing(q.shape)
        for k, (times, own, momenta, *_) in enumerate(self.each()):
            velocities[: len(times), k] = self.stepper.velocity(own, momenta, times, self.parameters[k])
        return velocities

    def _member(self, kind: str, name: str | None) -> Member:
        interface = self.stepper.interface
        members: Sequence[Member] = [
            member for member in members_of(interface.dimension, interface.rotations) if member.kind == kind
        ]
        names = [member.name for member in members]
        arrays = _columns_of_arrays(interface, names)
        if name in arrays or (name is None and len(arrays) == 1):
            array = name or next(iter(arrays))
            return replace(members[0], name=array, columns=arrays[array])
        if name is None and len(members) == 1:
            return members[0]
        if name not in names:
            reason = f"there is no {kind}" if name is None else f"there is no {kind} '{name}'"
            reason = f"there are {len(names)} of them: name one" if names and name is None else reason
            hint = closest(str(name), names) if name is not None else "."
            raise StateError(f"{reason}{hint} The system has: {', '.join(names) or f'no {kind}'}")
        return members[names.index(name)]


def _columns(interface: Interface, name: str) -> NDArray[np.intp] | int | None:
    """Return the indices of an array in its shape, or the index of a coordinate; ``None`` for another name."""
    first = 0
    for array, shape in shapes_of(interface) or ():
        if array == name:
            return np.arange(first, first + math.prod(shape)).reshape(shape)
        first += math.prod(shape)
    return interface.coordinates.index(name) if name in interface.coordinates else None


def _momentum_columns(interface: Interface, name: str) -> NDArray[np.intp] | int | None:
    if name in interface.momenta:
        return interface.momenta.index(name)
    names = [momentum.name for momentum in interface.layout.momenta]
    arrays = dict(zip(names, shapes_of(interface) or (), strict=False))
    conjugate = arrays[name][0] if name in arrays else name.removeprefix("p_")
    return None if conjugate == name else _columns(interface, conjugate)


def _fields(mesh: Any, q: Array, p: Array) -> dict[str, Array]:
    """Return fields at the points of a mesh, (.., shape of the fields), of (.., m) states; none without a mesh."""
    if mesh is None:
        return {}
    fields = mesh.fields_of(*(vectors.reshape(-1, vectors.shape[-1]) for vectors in (q, p)))
    return {name: values.reshape(*q.shape[:-1], *values.shape[1:]) for name, values in fields.items()}


def _columns_of_arrays(interface: Interface, names: Sequence[str]) -> dict[str, NDArray[np.intp]]:
    """Return the columns (.., k) of the coordinates of every array of members of these names."""
    columns, first = {}, 0
    for array, shape in shapes_of(interface) or ():
        end = first + int(np.prod(shape))
        if len(shape) > 1 and f"{array}{'_0' * (len(shape) - 1)}" in names:
            columns[array] = np.arange(first, end).reshape(shape)
        first = end
    return columns
