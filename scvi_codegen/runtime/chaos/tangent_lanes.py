"""Tangent vectors of many trajectories in SIMD lanes: each lane integrates a trajectory and its variational equations.

The variations are additional coordinates (:mod:`scvi_codegen.mechanics.derived_systems`) of an ensemble. After each
block of steps the tangent frame of every lane is replaced by Q of its QR factorisation. A block is repeated with half
as many steps if its R shows that the tangent vectors became nearly parallel.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.chaos.growth import Growth, ill_conditioned, r_factors
from scvi_codegen.runtime.core.validation import Array

TRAJECTORIES_TOGETHER = 256
"""Number of trajectories integrated together, so that the output of a block of steps fits into the cache."""
FIRST, MOST = 8, 32
"""Number of steps of the first and of the largest block."""


def propagate_in_lanes(
    binding: Binding,
    tangents: Array,
    q: Array,
    p: Array,
    parameters: Array,
    *,
    t: Array,
    h: float,
    save_every: int,
    options: SolverOptions | None,
    check_stop: Callable[[int], None],
) -> tuple[Array, NDArray[np.bool_]]:
    """Integrate K trajectories with tangent vectors from (q, p) over (steps + 1,) times t, saving some of them.

    Args:
        binding: library with k tangent vectors per trajectory.
        tangents: (2m, k) initial tangent vectors of length 1, common to all trajectories.
        q, p: (K, m) initial states.
        parameters: (K, number of parameters).
        check_stop: called with the completed steps before each block; may raise to stop.

    Returns:
        (5, n, K, k) series of :class:`Growth`, and (K,) flags of the trajectories that completed all steps.
    """
    lanes_of_trajectories = _TangentLanes(
        binding, q, p, parameters, tangents.shape[1], t=float(t[0]), h=h, options=options
    )
    frame, triangle = (np.broadcast_to(part, (len(q), *part.shape)) for part in np.linalg.qr(tangents))
    with np.errstate(divide="ignore"):  # linearly dependent directions span zero volume: log 0 = -inf
        growth = Growth(t[::save_every], np.log(np.abs(np.diagonal(triangle, axis1=1, axis2=2))))
    done, steps, size, most = 0, len(t) - 1, FIRST, MOST
    lanes_of_trajectories.take(frame)
    while done < steps:
        check_stop(done)
        size = min(size, most, save_every - done % save_every, steps - done)
        before = lanes_of_trajectories.save()
        images = lanes_of_trajectories.advance(size)
        running = lanes_of_trajectories.running
        frame, last = _factors(np.where(running[:, np.newaxis, np.newaxis], images[-1], frame))
        if size > 1 and ill_conditioned(last).any():
            lanes_of_trajectories.restore(before)
            most = size // 2
            continue
        done += size
        sizes = _lengths(images, triangle)
        numbers = np.full(size, -1)
        numbers[-1] = done // save_every if done % save_every == 0 else -1
        with np.errstate(divide="ignore"):
            diagonals = np.log(np.abs(np.diagonal(last, axis1=1, axis2=2)))
            stretched = np.broadcast_to(diagonals, (size, *diagonals.shape))
            growth.add(t[done - size : done + 1], numbers, np.log(sizes), stretched)
        triangle = last @ triangle / sizes[-1][:, np.newaxis]
        lanes_of_trajectories.take(frame)
        size *= 2
    return growth.values, lanes_of_trajectories.running


def _lengths(images: Array, triangle: Array) -> Array:
    """Return (steps, K, k) norms of the tangent vectors, whose images in the frame are (steps, K, 2m, k)."""
    whole = images if images.shape[-1] == 1 else images @ triangle
    lengths: Array = np.sqrt(np.einsum("skij,skij->skj", whole, whole))
    return lengths


def _factors(images: Array) -> tuple[Array, Array]:
    """Return the QR factors, (K, 2m, k) and (K, k, k)."""
    if images.shape[-1] > 1:
        orthonormal, upper = np.linalg.qr(images)
        return np.asarray(orthonormal), np.asarray(upper)
    lengths = r_factors(images)
    return images / lengths, lengths


class _TangentLanes:
    """SIMD blocks of K trajectories with k tangent vectors each; surplus lanes hold inactive copies of the last one."""

    def __init__(
        self,
        binding: Binding,
        q: Array,
        p: Array,
        parameters: Array,
        count: int,
        *,
        t: float,
        h: float,
        options: SolverOptions | None,
    ) -> None:
        (self.size, self.dimension), self.count = q.shape, count
        self.width = len(binding.new("block *").active)
        blocks = -(-self.size // self.width)
        self.binding, self.options = binding, binding.options(options)
        self.memory = binding.new(f"block[{blocks}]")
        for k in range(blocks):
            binding.function("start")(self.memory + k, t, h)
        self.lanes = binding.records(self.memory)
        save_every = np.arange(blocks * self.width)
        self.lane_indices = np.minimum(save_every, self.size - 1)
        self.lanes["q"][:, : self.dimension], self.lanes["p"][:, : self.dimension] = map(self._across, (q, p))
        self.lanes["parameters"][:, : parameters.shape[1]] = self._across(parameters)
        self.lanes["active"] = (save_every < self.size).reshape(blocks, self.width)

    def _across(self, rows: Array) -> Array:
        """Transpose (K, n) rows to (blocks, n, lanes)."""
        across: Array = rows[self.lane_indices].reshape(len(self.lanes), self.width, rows.shape[1]).transpose(0, 2, 1)
        return across

    @property
    def running(self) -> NDArray[np.bool_]:
        """(K,) flags of the trajectories without a failed step."""
        running: NDArray[np.bool_] = self.lanes["active"].ravel()[: self.size] > 0.0
        return running

    def save(self) -> bytes:
        """Return a copy of the memory of all blocks."""
        return bytes(self.binding.buffer(self.memory))

    def restore(self, saved: bytes) -> None:
        """Restore a copy returned by :meth:`save`."""
        self.binding.buffer(self.memory)[:] = saved

    def take(self, frame: Array) -> None:
        """Set (K, 2m, k) tangent vectors, clear their compensation terms and discard the predictor."""
        m = self.dimension
        for name, part in (("q", frame[:, :m]), ("p", frame[:, m:])):
            self.lanes[name][:, m:] = self._across(part.transpose(0, 2, 1).reshape(self.size, -1))
            self.lanes[f"carry_{name}"][:, m:] = 0.0
        self.lanes["guess"] = 0

    def advance(self, steps: int) -> Array:
        """Advance all trajectories and return the (steps, K, 2m, k) tangent vectors after each step."""
        advance, size = self.binding.function("advance"), self.dimension * (self.count + 1)
        q, p = np.empty((2, steps, len(self.lane_indices), size))
        row, (at_q, at_p) = len(self.lane_indices) * size, map(self.binding.pointer, (q, p))
        for k in range(len(self.lanes)):
            offset = k * self.width * size
            advance(self.memory + k, self.width, steps, 1, self.options, at_q + offset, at_p + offset, row)
        shape = steps, self.size, self.count, self.dimension
        parts = [x[:, : self.size, self.dimension :].reshape(shape).transpose(0, 1, 3, 2) for x in (q, p)]
        return np.concatenate(parts, axis=2)
