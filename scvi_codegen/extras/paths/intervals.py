"""Intervals of a path: momenta at the ends of steps between given positions, and their derivatives.

Unknowns are positions on a manifold, in coordinates y of its tangent spaces: q = R(q_k + Z_k y). Without constraints
and rotations Z is the identity. The residual of the discrete Euler-Lagrange equations at a node is Z^T (p1 - p0), p1
of the step before it and p0 of the step after it; without forces it is the gradient of the action.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.api.states import Array, Starts
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import PathError, StateError
from scvi_codegen.extras.paths.size import INCREMENT, size_for_updates

CONVERGED, MOST_ITERATIONS = 1e-13, 20
"""Largest miss, relative to the range of the path, of a step that is solved by shooting, and most Newton iterations."""
PROBED = 1e-5
"""Derivatives below this part of the largest are not computed for many coordinates; they change the rate of Newton's
iteration, not its result."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Steps between N + 1 positions, d coordinates each, and their derivatives.

    Attributes:
        p0, p1: (N, m) momenta at the ends of each step.
        actions: (N,) of the steps.
        residual: (N - 1, d) of the inner nodes.
        blocks: (4, N, d, d) derivatives of p0, then p1, with respect to q0 and q1; sparse matrices in lists for many
            coordinates; ``None`` if not requested.
        by_h: (2, N, d) derivatives of p0 and p1 with respect to h.
    """

    p0: Array
    p1: Array
    actions: Array
    residual: Array
    blocks: Any = None
    by_h: Any = None


class Intervals:
    """Steps between positions of an unconstrained system, all solved in one call of C."""

    sparse = False
    symmetry: Array | None = None  # of a closed path
    range_of_start = 0.0  # largest range of the positions from which the search starts

    def __init__(self, stepper: Any, t: Array, h: Array, parameters: Array, options: SolverOptions | None) -> None:
        self.stepper, self.t, self.h, self.parameters, self.options = stepper, t, h, parameters, options
        self.binding = stepper.tangent
        self.dimension = stepper.dimension

    @property
    def parameters_at_start(self) -> Array:
        """(k,) parameters of the first step."""
        return np.ascontiguousarray(self.parameters[0] if self.parameters.ndim == 2 else self.parameters)

    def lasting(self, duration: float) -> Intervals:
        """Return the intervals of a path of another duration."""
        result = copy(self)
        result.h = np.full(len(self.h), duration / len(self.h))
        result.t = self.t[0] + np.arange(len(self.h)) * result.h
        return result

    def moved(self, q: Array, y: Array) -> Array:
        """Return positions moved by y, whose rows are those of the last nodes before the end, or of all."""
        result = q.copy()
        result[len(q) - 1 - len(y) : len(q) - 1] += y
        return result

    def tangent(self, k: int, vector: Array) -> Array:
        """Return the components of a covector at node k in its tangent space."""
        return vector

    def outward(self, k: int, y: Array) -> Array:
        """Return the change of the positions at node k by one in its tangent space."""
        return y

    def on_manifold_all(self, q: Array) -> Array:
        """Return the nearest admissible positions of nodes, with rotations of the lengths of the first."""
        return q

    def basis_map(self, M: Array) -> Array:
        """Return the symmetry of a closed path between the tangent spaces of its ends."""
        return M

    def evaluated(self, q: Array) -> Linearised:
        """Return momenta and residuals; raise StepFailedError if a step is not solved."""
        return self._called(q, np.empty((0, 2 * self.dimension + 1)))[0]

    def linearised(self, q: Array) -> Linearised:
        """Return momenta, residuals and all their derivatives."""
        m, count = self.dimension, len(self.h)
        values, derivatives = self._called(q, np.eye(2 * m + 1))
        by = (
            derivatives[:, : 2 * m].reshape(count, 2, m, 2, m).transpose(3, 1, 0, 4, 2)
        )  # p, q0 or q1, k, rows, columns
        by_h = derivatives[:, 2 * m].reshape(count, 2, m).transpose(1, 0, 2)
        return Linearised(values.p0, values.p1, values.actions, values.residual, by.reshape(4, count, m, m), by_h)

    def _called(self, q: Array, variations: Array) -> tuple[Linearised, Array]:
        """Return momenta, actions and residuals, and their (N, variations, 2m) derivatives along variations."""
        m, count, pointer = self.dimension, len(self.h), self.binding.pointer
        q = np.ascontiguousarray(q)
        p0, p1 = np.empty((2, count, m))
        actions, derivatives = np.empty(count), np.empty((count, len(variations), 2 * m))
        results = map(pointer, (variations, p0, p1, actions, derivatives))
        ends = (q[:-1], np.ascontiguousarray(q[1:]))
        self._solve("steps_between", self.t, self.h, ends, (len(variations), *results))
        return Linearised(p0, p1, actions, p1[:-1] - p0[1:]), derivatives

    def _solve(self, function: str, t: Array, h: Array, ends: tuple[Array, Array], results: tuple[Any, ...]) -> None:
        """Call a function of the C code for all steps; raise StepFailedError if one of them fails."""
        binding, report = self.binding, self.binding.new("report *")
        stride = self.parameters.shape[1] if self.parameters.ndim == 2 else 0
        arguments = map(binding.pointer, (t, h, *ends, self.parameters))
        options = binding.options(self.options)
        status = binding.function(function)(len(h), *arguments, stride, options, *results, report, binding.workspace())
        if status:
            raise binding.failure(status, report, step=int(report.steps), h=float(h[report.steps]))

    def finer_ends(self, q: Array, p0: Array) -> tuple[Array, Array]:
        """Return the (N, m) positions and momenta at the ends of all intervals by the finer method of ``run.error``.

        Raises:
            StepFailedError: if one of these steps fails.
            MethodError: if the stepper has no finer method (it was loaded without its system).
        """
        finer = copy(self)
        finer.stepper = self.stepper.products.finer
        finer.binding = finer.stepper.tangent
        return finer._stepped(self.t, self.h, np.ascontiguousarray(q[:-1]), np.ascontiguousarray(p0))

    def _stepped(self, t: Array, h: Array, q: Array, p: Array) -> tuple[Array, Array]:
        """Return the ends of one step of each interval."""
        q1, p1 = np.empty((2, *q.shape))
        actions = np.empty(len(h))
        self._solve("actions", t, h, (q, p), tuple(map(self.binding.pointer, (q1, p1, actions))))
        return q1, p1

    def products(self, blocks: Any, vectors: Array) -> Array:
        """Return the products of the N matrices of :class:`Linearised` and (N, d) vectors."""
        return np.asarray(np.einsum("kij,kj->ki", blocks, vectors))


class ManyCoordinates(Intervals):
    """Intervals whose derivatives are sparse: lattices.

    The pattern of the entries above ``PROBED`` is measured on one step. Columns without common rows are then computed
    together (Curtis, Powell & Reid, J. Inst. Maths Applics 13 (1974) 117).
    """

    sparse = True
    colours: Array | None = None  # groups of columns without common rows

    def _pattern(self, q: Array) -> Array:
        """Set the pattern of the entries at the first positions, and return the groups of its columns."""
        if self.colours is not None:
            return self.colours
        from scipy.sparse import csc_matrix

        m, k = self.dimension, len(self.h) // 2
        parameters = np.atleast_2d(self.parameters)[-1]
        middle_step = Intervals(self.stepper, self.t[k : k + 1], self.h[k : k + 1], parameters, self.options)
        size = float(np.ptp(q)) or 1.0
        noise = 1e-2 * size * np.random.default_rng(0).standard_normal(m)
        blocks = np.abs(middle_step.linearised(q[k : k + 2] + noise).blocks[:, 0])
        pattern = np.logical_or.reduce(blocks > PROBED * blocks.max(axis=(1, 2), keepdims=True))
        pattern |= pattern.T
        conflicts = csc_matrix(pattern, dtype=np.int32)
        conflicts = (conflicts.T @ conflicts).tocsc()
        colours = np.full(m, -1)
        for j in range(m):
            taken = set(colours[conflicts.indices[conflicts.indptr[j] : conflicts.indptr[j + 1]]].tolist())
            colours[j] = next(c for c in range(m) if c not in taken)
        self.rows, self.columns = np.nonzero(pattern)
        self.colours = colours
        return colours

    def linearised(self, q: Array) -> Linearised:
        """See :meth:`Intervals.linearised`."""
        colours = self._pattern(q)
        m, groups = self.dimension, int(colours.max()) + 1
        variations = np.zeros((2 * groups + 1, 2 * m + 1))
        variations[colours, np.arange(m)] = variations[groups + colours, m + np.arange(m)] = 1.0
        variations[-1, -1] = 1.0
        values, derivatives = self._called(q, variations)
        of_columns = colours[self.columns]
        entries = [derivatives[:, side * groups + of_columns, p * m + self.rows] for p in (0, 1) for side in (0, 1)]
        by_h = derivatives[:, -1].reshape(-1, 2, m).transpose(1, 0, 2)
        return Linearised(values.p0, values.p1, values.actions, values.residual, np.array(entries), by_h)

    def products(self, blocks: Any, vectors: Array) -> Array:
        """See :meth:`Intervals.products`."""
        result = np.zeros_like(vectors)
        for row, terms in zip(result, blocks * vectors[:, self.columns], strict=True):
            np.add.at(row, self.rows, terms)
        return result


class ReducedIntervals(Intervals):
    """Steps between positions on a manifold: of holonomic constraints, and of rotations of constant length.

    Z_k spans the tangent space at node k. The initial momenta p0 = W u are those of velocities Z u (with rotations,
    covectors Z u, without a component along the length); Newton's iteration solves Z_1^T (q1(q0, p0) - q1) = 0. The
    step does not depend on the components of p0 normal to the manifold.
    """

    def __init__(self, stepper: Any, t: Array, h: Array, parameters: Array, options: SolverOptions | None) -> None:
        super().__init__(stepper, t, h, parameters, options)
        self.members = stepper.products.members
        self._bases: list[Array] = []

    def _parameters_of(self, k: int) -> Array:
        return np.ascontiguousarray(self.parameters[k] if self.parameters.ndim == 2 else self.parameters)

    def _normals(self, q: Array, t: float, parameters: Array) -> Array:
        stepper, m = self.stepper, self.stepper.dimension
        rows = []
        if stepper.interface.constraints:
            momenta = np.array([stepper.momentum(q, v, t, parameters) for v in np.vstack([np.zeros(m), np.eye(m)])])
            _, rates = stepper.constraint_values(np.tile(q, (m + 1, 1)), momenta, np.full(m + 1, t), parameters)
            rows.extend((rates[1:] - rates[0]).T)
        for member in self.members:
            row = np.zeros(m)
            row[member.columns] = q[member.columns]
            rows.append(row)
        return np.array(rows)

    def _basis(self, q: Array, t: float, parameters: Array, like: Array | None) -> Array:
        """Return an orthonormal basis of the tangent space, the nearest one to that at another position."""
        normals = self._normals(q, t, parameters)
        _, sizes, rows = np.linalg.svd(normals)
        basis = rows[int((sizes > 1e-9 * sizes[0]).sum()) :].T
        if like is None:
            return np.asarray(basis)
        left, _, right = np.linalg.svd(basis.T @ like)
        return np.asarray(basis @ left @ right)

    def _from_velocities(self, q: Array, basis: Array, t: float, parameters: Array) -> Array:
        if self.members:
            return basis
        zero = self.stepper.momentum(q, np.zeros(len(q)), t, parameters)
        return np.array([self.stepper.momentum(q, v, t, parameters) - zero for v in basis.T]).T

    def moved(self, q: Array, y: Array) -> Array:
        """See :meth:`Intervals.moved`; the positions are projected onto the manifold."""
        result = q.copy()
        first = len(q) - 1 - len(y)
        for k, components in enumerate(y, first):
            moved = q[k] + self._bases[k] @ components if np.any(components) else q[k]
            result[k] = self.on_manifold(moved, k, q[0])
        return result

    def on_manifold(self, q: Array, k: int, like: Array) -> Array:
        """Return the nearest position on the manifold, with rotations of the lengths of ``like``."""
        result = q.copy()
        for member in self.members:
            size, columns = np.linalg.norm(like[member.columns]), member.columns
            result[columns] *= size / np.linalg.norm(result[columns])
        if self.stepper.interface.constraints:
            t = float(self.t[min(k, len(self.t) - 1)] + (self.h[-1] if k == len(self.t) else 0.0))
            result = self.stepper.project(result, t=t, parameters=self._parameters_of(min(k, len(self.t) - 1)))[0]
        return np.asarray(result)

    def _stepped(self, t: Array, h: Array, q: Array, p: Array) -> tuple[Array, Array]:
        """See :meth:`Intervals._stepped`."""
        ends = [
            self.stepper.step(
                q[k], p[k], h=float(h[k]), t=float(t[k]), parameters=self._parameters_of(k), options=self.options
            )
            for k in range(len(h))
        ]
        return np.array([end[0] for end in ends]), np.array([end[1] for end in ends])

    def on_manifold_all(self, q: Array) -> Array:
        """See :meth:`Intervals.on_manifold_all`."""
        return np.array([self.on_manifold(position, k, q[0]) for k, position in enumerate(q)])

    def basis_map(self, M: Array) -> Array:
        """See :meth:`Intervals.basis_map`; the last basis is M times the first one."""
        return np.eye(self._bases[0].shape[1])

    def tangent(self, k: int, vector: Array) -> Array:
        """See :meth:`Intervals.tangent`."""
        return np.asarray(self._bases[k].T @ vector)

    def outward(self, k: int, y: Array) -> Array:
        """See :meth:`Intervals.outward`."""
        return np.asarray(self._bases[k] @ y)

    def evaluated(self, q: Array) -> Linearised:
        """See :meth:`Intervals.evaluated`."""
        bases = self._bases
        result = self.linearised(q)
        self._bases = bases
        return result

    def linearised(self, q: Array) -> Linearised:
        """See :meth:`Intervals.linearised`."""
        count = len(self.h)
        times = [*self.t.tolist(), float(self.t[-1] + self.h[-1])]
        parameters = [self._parameters_of(min(k, count - 1)) for k in range(count + 1)]
        before: Sequence[Array | None] = self._bases or [None] * (count + 1)
        self._bases = bases = [self._basis(q[k], times[k], parameters[k], before[k]) for k in range(count + 1)]
        if self.symmetry is not None:
            bases[count] = self.symmetry @ bases[0]
        allowed = CONVERGED * size_for_updates(q, CONVERGED)
        steps = [self._interval(k, q[k], q[k + 1], times[k], parameters[k], allowed) for k in range(count)]
        p0, p1, actions, blocks, by_h = map(np.array, zip(*steps, strict=True))
        residual = np.array([bases[k].T @ (p1[k - 1] - p0[k]) for k in range(1, count)])
        residual = residual.reshape(count - 1, bases[0].shape[1])
        return Linearised(p0, p1, actions, residual, blocks.swapaxes(0, 1), by_h.swapaxes(0, 1))

    def _interval(
        self, k: int, q0: Array, q1: Array, t: float, parameters: Array, allowed: float
    ) -> tuple[Array, Array, float, list[Array], tuple[Array, Array]]:
        """Return p0, p1, the action, and the derivatives of both by q0 and q1, and by h, of the step from q0 to q1.

        With B = Z_1^T (dq1/dp0) W, dq1 = A dy0 + B du and dp1 = C dy0 + D du in the bases of the tangent spaces:
        du = B^-1 (dy1 - A dy0) of a step between fixed ends.
        """
        m, h = self.dimension, float(self.h[k])
        Z0, Z1 = self._bases[k], self._bases[k + 1]
        W = self._from_velocities(q0, Z0, t, parameters)
        step = {"h": h, "t": t, "parameters": parameters}
        if self.members:
            at_rest, u = np.zeros(m), self._covector(q0, Z0, (q1 - q0) / h, t, parameters)
        else:
            at_rest, u = self.stepper.momentum(q0, np.zeros(m), t, parameters), Z0.T @ (q1 - q0) / h
        for _ in range(MOST_ITERATIONS):
            p0 = at_rest + W @ u
            end, p1 = self.stepper.step(q0, p0, options=self.options, **step)
            J = self.stepper.jacobian(q0, p0, **step)
            miss = Z1.T @ (end - q1)
            B = Z1.T @ J[:m, m:] @ W
            try:
                u = u - np.linalg.solve(B, miss)
            except np.linalg.LinAlgError as error:
                raise PathError(f"no step leads from node {k} to the next") from error
            if np.abs(miss).max() <= allowed:
                break
        else:
            raise PathError(f"no step from node {k} to the next was found")
        A, C, D = Z1.T @ J[:m, :m] @ Z0, Z1.T @ J[m:, :m] @ Z0, Z1.T @ J[m:, m:] @ W
        inverse = np.linalg.inv(B)
        blocks = [-Z0.T @ W @ inverse @ A, Z0.T @ W @ inverse, C - D @ inverse @ A, D @ inverse]
        action = self._action(q0, p0, step) if self.stepper.interface.sums_action else 0.0
        return p0, p1, action, blocks, self._by_h(q0, p0, step, (Z0, Z1, W), D, inverse)

    def _by_h(
        self, q: Array, p: Array, step: dict[str, Any], bases: tuple[Array, Array, Array], D: Array, inverse: Array
    ) -> tuple[Array, Array]:
        """Return the derivatives of p0 and p1 with respect to h at fixed ends, by central differences of the step."""
        Z0, Z1, W = bases
        h = step["h"]
        (q_less, p_less), (q_more, p_more) = (
            self.stepper.step(q, p, options=self.options, **step | {"h": h * (1.0 + x)})
            for x in (-INCREMENT, INCREMENT)
        )
        along, kicked = (
            Z1.T @ (more - less) / (2.0 * INCREMENT * h) for less, more in ((q_less, q_more), (p_less, p_more))
        )
        return -Z0.T @ W @ inverse @ along, kicked - D @ inverse @ along

    def _covector(self, q: Array, basis: Array, v: Array, t: float, parameters: Array) -> Array:
        try:
            return np.asarray(basis.T @ self.stepper.momentum(q, basis @ (basis.T @ v), t, parameters))
        except StateError:
            return np.zeros(basis.shape[1])

    def _action(self, q: Array, p: Array, step: dict[str, Any]) -> float:
        rows = Starts(np.array([step["t"]]), np.array([step["h"]]), q[np.newaxis].copy(), p[np.newaxis].copy())
        return float(self.stepper.products.actions(rows, step["parameters"], self.options)[0])
