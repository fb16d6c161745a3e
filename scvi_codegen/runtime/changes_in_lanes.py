"""Small changes of many motions, carried along in vector lanes: each lane has a motion and the changes beside it.

Changes are coordinates of an ensemble of their own (:mod:`scvi_codegen.mechanics.changes`), whose steps are as those of
any. After so many steps their QR factorisation is taken, in all lanes, and Q goes on; a piece of steps in which changes
of one motion part too far is taken again, shorter.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.growth import Growth, apart, triangles
from scvi_codegen.runtime.inputs import Array

__all__ = ["MOTIONS", "in_lanes"]

MOTIONS = 256
"""That go along together: what is kept of their steps stays near the processor."""
FIRST, MOST = 8, 32
"""Steps of a piece."""


def in_lanes(
    binding: Binding,
    changes: Array,
    q: Array,
    p: Array,
    parameters: Array,
    *,
    t: Array,
    h: float,
    save_every: int,
    options: SolverOptions | None,
    heed: Callable[[int], None],
) -> tuple[Array, NDArray[np.bool_]]:
    """Of K motions from (q, p) by steps of h at (n + 1,) times t, at every so-many-th state.

    Args:
        binding: of the text with k changes.
        changes: (2m, k) of length 1, the same for all.
        q, p: (K, m); parameters: (K, number of them).
        heed: called before each piece, may raise.

    Returns:
        (5, n, K, k) what :class:`Growth` found, and (K,) whether all steps of a motion were taken.
    """
    motions = _Motions(binding, q, p, parameters, changes.shape[1], t=float(t[0]), h=h, options=options)
    frame, triangle = (np.broadcast_to(part, (len(q), *part.shape)) for part in np.linalg.qr(changes))
    with np.errstate(divide="ignore"):  # directions that depend on each other span nothing
        growth = Growth(t[::save_every], np.log(np.abs(np.diagonal(triangle, axis1=1, axis2=2))))
    done, steps, size, most = 0, len(t) - 1, FIRST, MOST
    motions.take(frame)
    while done < steps:
        heed(done)
        size = min(size, most, save_every - done % save_every, steps - done)
        before = motions.save()
        images = motions.advance(size)
        running = motions.running
        frame, last = _factors(np.where(running[:, np.newaxis, np.newaxis], images[-1], frame))
        if size > 1 and apart(last).any():
            motions.restore(before)
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
        motions.take(frame)
        size *= 2
    return growth.found, motions.running


def _lengths(images: Array, triangle: Array) -> Array:
    """(steps, K, k) of what (steps, K, 2m, k) images of the frame make of changes."""
    whole = images if images.shape[-1] == 1 else images @ triangle
    lengths: Array = np.sqrt(np.einsum("skij,skij->skj", whole, whole))
    return lengths


def _factors(images: Array) -> tuple[Array, Array]:
    """(K, 2m, k) and (K, k, k) Q and R."""
    if images.shape[-1] > 1:
        orthonormal, upper = np.linalg.qr(images)
        return np.asarray(orthonormal), np.asarray(upper)
    lengths = triangles(images)
    return images / lengths, lengths


class _Motions:
    """K motions with k changes each, lanes of blocks; lanes too many repeat the last one and rest."""

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
        self.places = np.minimum(save_every, self.size - 1)
        self.lanes["q"][:, : self.dimension], self.lanes["p"][:, : self.dimension] = map(self._across, (q, p))
        self.lanes["parameters"][:, : parameters.shape[1]] = self._across(parameters)
        self.lanes["active"] = (save_every < self.size).reshape(blocks, self.width)

    def _across(self, rows: Array) -> Array:
        """(blocks, n, lanes) from (K, n)."""
        across: Array = rows[self.places].reshape(len(self.lanes), self.width, rows.shape[1]).transpose(0, 2, 1)
        return across

    @property
    def running(self) -> NDArray[np.bool_]:
        """(K,) of those whose steps did not fail."""
        running: NDArray[np.bool_] = self.lanes["active"].ravel()[: self.size] > 0.0
        return running

    def save(self) -> bytes:
        """All of it."""
        return bytes(self.binding.buffer(self.memory))

    def restore(self, saved: bytes) -> None:
        """As it was."""
        self.binding.buffer(self.memory)[:] = saved

    def take(self, frame: Array) -> None:
        """(K, 2m, k) changes to go on with; of former ones nothing is left, nor is there a guess from them."""
        m = self.dimension
        for name, part in (("q", frame[:, :m]), ("p", frame[:, m:])):
            self.lanes[name][:, m:] = self._across(part.transpose(0, 2, 1).reshape(self.size, -1))
            self.lanes[f"carry_{name}"][:, m:] = 0.0
        self.lanes["guess"] = 0

    def advance(self, steps: int) -> Array:
        """(steps, K, 2m, k) what becomes of the changes."""
        advance, own = self.binding.function("advance"), self.dimension * (self.count + 1)
        q, p = np.empty((2, steps, len(self.places), own))
        row, (at_q, at_p) = len(self.places) * own, map(self.binding.pointer, (q, p))
        for k in range(len(self.lanes)):
            place = k * self.width * own
            advance(self.memory + k, self.width, steps, 1, self.options, at_q + place, at_p + place, row)
        shape = steps, self.size, self.count, self.dimension
        parts = [x[:, : self.size, self.dimension :].reshape(shape).transpose(0, 1, 3, 2) for x in (q, p)]
        return np.concatenate(parts, axis=2)
