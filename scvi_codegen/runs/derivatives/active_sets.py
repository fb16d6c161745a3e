"""Derivatives of steps with contacts by steps: both contact problems differentiated at their active sets.

A step solves for q1, f1 and for v1, f2 (``contact_steps.h``)

    p0 + G0^T f1 = -D1 Ld(q0, q1),                     p1 = L_v(q1, v1) = D2 Ld(q0, q1) + G1^T f2,

with the rates u of each problem: of open contacts f = 0, of closed ones u_n = 0 (a rebound: u_n = -e u_n(before)), of
those that stick u_t = 0, of those that slip f_t = -mu f_n u_t / |u_t|. Where no contact changes its mode these
equations define (q1, p1) as a smooth function of q0, p0, the parameters, t and h; derivatives follow by elimination:
with A dq1 = r + G0^T df and du = y + S df, S = U A^-1 G0^T, rows of either f or u vanish. Redundant rows have dependent
equations, which the solution of least norm satisfies; q1 does not depend on the choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import step_failure
from scvi_codegen.common.errors import StateError

if TYPE_CHECKING:
    from scvi_codegen.runs.stepping.step_derivatives import LinearisedMethod, Starts

Array = NDArray[Any]
DEPENDENT = 1e-12
"""Singular values of scaled rows below which these depend on others, relative to the largest: rounding of sums."""
PARTS = 256
"""Largest number of parts of a step (contact_steps.h)."""
NUMBERS = 2**22
"""Derivatives of terms that are kept at a time."""
OF_IMPULSES = 1e-12
"""Deviations of steps that are taken again, relative to impulses, which count as rounding."""
OPEN, STICKS, SLIPS = 0, 1, 2


def step_of_event(states: Any, number: int) -> float | None:
    """Return the size of the step within which an event ended a run at its saved state ``number``, else ``None``."""
    ended = any(of.event.terminal and len(of.t) for of in states.events)
    return states.h if ended and number == len(states) - 1 else None


def propagate_by_steps(
    method: LinearisedMethod, starts: Starts, vectors: Array, parameters: Array, *, transpose: bool, whole: float | None
) -> tuple[Array, Array]:
    """Propagate tangent vectors or cotangents along steps; see :meth:`LinearisedMethod._propagate`.

    Where an event ended the run the last state is that on the line between the ends of a step of size ``whole``.
    """
    count, varied, part = len(starts.h), _varied(method), 1.0
    if whole is not None:
        part, starts = starts.h[-1] / whole, replace(starts, h=np.append(starts.h[:-1], whole))
    maps = np.empty((count, len(varied), len(varied)))
    q, p = (np.array(x) for x in (starts.q, starts.p))
    ends, impulses = np.empty((2, count, method.dimension)), np.empty(count)
    for first, last, traces in _traces(method, starts, q, p, parameters):
        of_parts = np.array([*_maps_of(method, traces, starts.h[first:last][traces.number], parameters)])
        bounds = np.searchsorted(traces.number, np.arange(last - first + 1))
        for k, (begin, end) in enumerate(pairwise(bounds)):
            maps[first + k] = reduce(np.matmul, of_parts[begin:end][::-1])
            impulses[first + k] = abs(traces.positions.force[begin:end]).max()
        ends[:, first:last] = traces.q1[bounds[1:] - 1], traces.p1[bounds[1:] - 1]
    maps[-1] += (1.0 - part) * (np.eye(len(varied)) - maps[-1])
    ends[:, -1] += (1.0 - part) * (np.array([q[-2], p[-2]]) - ends[:, -1])
    if starts.chained:
        starts.q[1:], starts.p[1:] = ends
    else:  # at rest states are the rounding errors of impulses that cancel others
        saved = np.array([starts.q[1:], starts.p[1:]])
        ends = np.where(abs(ends - saved) <= OF_IMPULSES * impulses[:, np.newaxis], saved, ends)
    modes = slice(varied[-3] + 1, varied[-2])
    for k in range(count)[:: -1 if transpose else 1]:
        after, before = (k, k + 1) if transpose else (k + 1, k)
        vectors[after, :, modes] += vectors[before, :, modes]
        vectors[after][:, varied] += vectors[before][:, varied] @ (maps[k] if transpose else maps[k].T)
    return ends[0], ends[1]


def _varied(method: LinearisedMethod) -> list[int]:
    """Return the indices of the inputs of a step but modes, which the steps choose."""
    size, states_and_parameters = method._input_size, 2 * method.dimension + len(method.parameters)
    return [*range(states_and_parameters), size - 2, size - 1]


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Solutions of n contact problems: (n, rows) forces and (n, contacts) modes."""

    force: Array
    mode: Array


class _Traces:
    """Solved parts of steps: structures step_trace of traced_steps.h, of arrays (n, numbers)."""

    def __init__(self, method: LinearisedMethod, numbers: Array) -> None:
        m, interface = method.dimension, method.interface
        sizes = [1, 1, 1, m, m, m, m, 1, 1, *(len(interface.constraints), len(interface.contacts)) * 2]
        columns = np.split(numbers, np.cumsum(sizes)[:-1], axis=1)
        self.number = columns[0][:, 0].astype(int)
        self.t, self.h, self.part, self.factor = (columns[k][:, 0] for k in (1, 2, 7, 8))
        self.q, self.p, self.q1, self.p1 = columns[3:7]
        self.positions, self.velocities = (_Solution(*columns[k : k + 2]) for k in (9, 11))


def _traces(method: LinearisedMethod, starts: Starts, q: Array, p: Array, parameters: Array) -> Any:
    """Yield the first step, the last one and the traces of blocks of steps, taken again from states of a run."""
    m, interface, binding = method.dimension, method.interface, method.binding
    numbers = 5 + 4 * m + 2 * (len(interface.constraints) + len(interface.contacts))
    rows = 3 * (m + len(interface.contacts)) + 2 * len(interface.constraints)
    room = PARTS + max(1, NUMBERS // (rows * len(_varied(method))))
    traces, filled, report = np.zeros((room, numbers)), binding.numbers("long long *"), binding.new("report *")
    values = np.array(parameters)  # with modes
    first = 0
    while first < len(starts.h):
        rest = tuple(np.ascontiguousarray(x[first:]) for x in (starts.t, starts.h, q, p))
        pointers = [*map(binding.pointer, rest)]
        status = binding.function("trace_by_steps")(
            len(starts.h) - first,
            *pointers,
            int(starts.chained),
            binding.pointer(values),
            int(method.strict_energy),
            room,
            binding.pointer(traces),
            filled,
            report,
            binding.workspace(),
        )
        if status:
            failed = first + int(report.steps)
            raise step_failure(status, report, step=failed, h=float(starts.h[failed]))
        last = first + int(report.steps)
        yield first, last, _Traces(method, traces[: int(filled[0])].copy())
        first = last


class _Terms:
    """Terms of steps at n states (q, v) with forces of rows, and their derivatives by (q, v, parameters, t)."""

    def __init__(self, method: LinearisedMethod, q: Array, v: Array, force: Array, t: Array, parameters: Array) -> None:
        n, m, c, k = len(t), method.dimension, len(method.interface.constraints), len(method.interface.contacts)
        binding, rows = method.tangent, 3 * (m + k) + 2 * c
        values, self.by = np.empty((n, rows)), np.empty((n, rows, len(_varied(method)) - 1))
        u, at = (np.ascontiguousarray(x) for x in (np.concatenate([q, v, force], axis=1), t))
        if not binding.function("terms")(n, *map(binding.pointer, (u, at, parameters, values, self.by))):
            raise StateError(f"derivatives of the steps after t = {t[0]:g} are not finite")
        self.m, self.columns = m, {"q": slice(0, m), "v": slice(m, 2 * m)}
        ends = np.cumsum([0, m, m, m, c, c, 3 * k])
        names = "momentum", "force", "reaction", "gap", "rate", "law"
        self.rows = {name: slice(*ends[j : j + 2]) for j, name in enumerate(names)}
        self.values = {name: values[:, rows] for name, rows in self.rows.items()}

    def part(self, name: str, columns: str) -> Array:
        """Return (n, rows, m) derivatives by q or v."""
        return self.by[:, self.rows[name], self.columns[columns]]

    def along(self, name: str, change: Array) -> Array:
        """Return (n, rows, inputs) changes by those (n, 2m + parameters + 1, inputs) of (q, v, parameters, t)."""
        return self.by[:, self.rows[name]] @ change


def _inverse(K: Array) -> Array:
    """Return the inverses of (n, k, k) matrices, of least norm where rows depend on each other."""
    try:
        inverse = np.linalg.inv(K)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(K, rcond=DEPENDENT)
    largest = abs(inverse).max(axis=(1, 2), initial=0.0) * abs(K).max(axis=(1, 2), initial=0.0)
    dependent = ~(
        largest * DEPENDENT * K.shape[1] < 1.0
    )  # the inverse of the least singular value is at most k times it
    if dependent.any():  # seldom: singular values take 30 times as long
        inverse[dependent] = np.linalg.pinv(K[dependent], rcond=DEPENDENT)
    return inverse


def _maps_of(method: LinearisedMethod, of: _Traces, whole: Array, parameters: Array) -> Array:
    """Return (n, inputs, inputs) derivatives of parts of steps of sizes ``whole`` by (q, p, parameters, t, h)."""
    if (of.factor < 1.0).any():
        raise StateError(f"the step at t = {of.t[of.factor < 1.0][0]:g} was shrunk by strict_energy: omit it")
    blended = (of.part > 0.0) & (of.part < 1.0)
    if blended.any():
        raise StateError(
            f"the rebound at t = {of.t[blended][0]:g} has less than its restitution, by which it would create energy: "
            "its derivatives are not available"
        )
    return _Linearised(method, of, whole, parameters).maps


class _Linearised:
    """Parts of steps with the changes of their variables by those of (q, p, parameters, t, h)."""

    def __init__(self, method: LinearisedMethod, of: _Traces, whole: Array, parameters: Array) -> None:
        n, m, size = len(of.t), method.dimension, len(_varied(method))
        self.method, self.of, self.m, self.h = method, of, m, of.h[:, np.newaxis, np.newaxis]
        self.inputs = np.broadcast_to(np.eye(size), (n, size, size))
        self.by_h = self.inputs[:, -1:]
        self.whole, speed = whole, (of.q1 - of.q) / of.h[:, np.newaxis]
        self.start = _Terms(method, of.q, speed, of.positions.force, of.t, parameters)
        self.end = _Terms(method, of.q1, speed, of.velocities.force, of.t + of.h, parameters)
        before, after = (
            speed + np.linalg.solve(at.part("momentum", "v"), (p - at.values["momentum"])[..., np.newaxis])[..., 0]
            for at, p in ((self.start, of.p), (self.end, of.p1))
        )
        nothing = np.zeros_like(of.positions.force)
        self.before = _Terms(method, of.q, before, nothing, of.t, parameters)
        self.after = _Terms(method, of.q1, after, nothing, of.t + of.h, parameters)
        self.speed = speed[..., np.newaxis]
        self.fixed = len(method.interface.constraints) - method.interface.masked
        self.normals = [at.normal + self.fixed for at in method.interface.contacts if at.normal is not None]
        self.is_gap = np.zeros((len(method.interface.constraints), 1), dtype=bool)
        self.is_gap[[*range(self.fixed), *self.normals]] = True

    def changed(self, q: Array | float, v: Array | float, *, ends: bool) -> Array:
        """Return changes of (q, v, parameters, t) at an end of the step."""
        m, change = self.m, np.zeros_like(self.inputs[:, :-1])
        change[:, :m], change[:, m : 2 * m] = q, v
        change[:, 2 * m :] = self.inputs[:, 2 * m : -1]
        if ends:
            change[:, -1:] += self.by_h
        return change

    @cached_property
    def maps(self) -> Array:
        """(n, inputs, inputs) derivatives."""
        m, h, start, end, result = self.m, self.h, self.start, self.end, self.inputs.copy()
        q0 = self.inputs[:, :m]
        by_start = -(q0 + self.speed * self.by_h) / h  # change of the speed at constant q1
        at_start, at_end = self.changed(q0, by_start, ends=False), self.changed(0.0, by_start, ends=True)
        # p0 + G0^T f1 + h F(q0, v)/2 - L_v(q0, v)/2 - L_v(q1, v)/2 = 0
        forces = start.values["force"][..., np.newaxis] * self.by_h / 2 + h / 2 * start.along("force", at_start)
        momenta = (start.along("momentum", at_start) + end.along("momentum", at_end)) / 2
        rest = self.inputs[:, m : 2 * m] + start.along("reaction", at_start) + forces - momenta
        A = (start.part("momentum", "v") + end.part("momentum", "v")) / (2 * h)
        A += end.part("momentum", "q") / 2 - start.part("force", "v") / 2
        directions = start.part("rate", "v")
        slips = (start.along("rate", at_start) + end.along("rate", at_end)) / 2
        slips_by_q1 = (directions + end.part("rate", "v")) / (2 * h) + end.part("rate", "q") / 2
        rates = np.where(self.is_gap, end.along("gap", at_end), slips)
        by_q1 = np.where(self.is_gap, end.part("gap", "q"), slips_by_q1)
        speeds = (start.values["rate"] + end.values["rate"]) / 2
        q1 = self.solved(A, rest, directions, by_q1, rates, speeds, self.of.positions, self.laws_before)[0]
        # p1 = h F(q1, v)/2 + L_v(q0, v)/2 + L_v(q1, v)/2 + G1^T f2
        at_start[:, m : 2 * m] += q1 / h
        at_end[:, :m], at_end[:, m : 2 * m] = q1, at_start[:, m : 2 * m]
        p1 = (start.along("momentum", at_start) + end.along("momentum", at_end)) / 2 + end.along("reaction", at_end)
        p1 += end.values["force"][..., np.newaxis] * self.by_h / 2 + h / 2 * end.along("force", at_end)
        after, still = self.after, self.changed(q1, 0.0, ends=True)
        directions = after.part("rate", "v")
        rest, rates = p1 - after.along("momentum", still), after.along("rate", still) + self.rebounds()
        laws = end.values["law"], end.along("law", at_end)
        mass, speeds = after.part("momentum", "v"), after.values["rate"]
        _, impulse = self.solved(mass, rest, directions, directions, rates, speeds, self.of.velocities, laws)
        result[:, :m], result[:, m : 2 * m] = q1, p1 + impulse
        result[:, -2:-1] += self.by_h
        part = (self.of.h / self.whole)[:, np.newaxis]
        result[..., -1] *= part
        result[:, -1, -1] = 1.0
        return result

    @cached_property
    def at_before(self) -> Array:
        """Changes of (q, v, parameters, t) at the start with the velocities of p0."""
        q0 = self.inputs[:, : self.m]
        still = self.changed(q0, 0.0, ends=False)
        p = self.inputs[:, self.m : 2 * self.m] - self.before.along("momentum", still)
        return self.changed(q0, np.linalg.solve(self.before.part("momentum", "v"), p), ends=False)

    @property
    def laws_before(self) -> tuple[Array, Array]:
        """Coefficients of contacts at the start, and their changes."""
        return self.before.values["law"], self.before.along("law", self.at_before)

    def rebounds(self) -> Array:
        """Return (n, rows, inputs) changes of e u_n(before) in the rates of gaps that rebound."""
        values, changes = self.laws_before
        before = self.before.along("rate", self.at_before)
        result = np.zeros_like(before)
        for k, contact in enumerate(self.method.interface.contacts):
            if contact.normal is None:
                continue
            row = contact.normal + self.fixed
            fall, e = self.before.values["rate"][:, row], values[:, 3 * k + 2]
            left = self.after.values["rate"][:, row]
            jumps = (self.of.part > 0.0) & (fall < 0.0) & (abs(left + e * fall) < abs(left))
            change = changes[:, 3 * k + 2] * fall[:, np.newaxis] + e[:, np.newaxis] * before[:, row]
            result[:, row] = np.where(jumps[:, np.newaxis], change, 0.0)
        return result

    def solved(
        self,
        A: Array,
        rest: Array,
        directions: Array,
        by_x: Array,
        rates: Array,
        speeds: Array,
        of: _Solution,
        laws: Any,
    ) -> tuple[Array, Array]:
        """Return changes of x and of impulses G^T f: A dx = rest + G^T df, and du = rates + U dx in the active set.

        Args:
            A, rest: (n, m, m) and (n, m, inputs).
            directions, by_x: (n, rows, m) G and U.
            rates, speeds: (n, rows, inputs) changes of rates at constant x, and (n, rows) rates.
            of: forces and modes.
            laws: (n, 3 contacts) coefficients and their changes.
        """
        size = rest.shape[2]
        both = np.linalg.solve(A, np.concatenate([rest, directions.transpose(0, 2, 1)], axis=2))
        x, responses = both[..., :size], both[..., size:]
        matrix, right = self.active(by_x @ responses, rates + by_x @ x, speeds, of, *laws)
        force = matrix @ right
        return x + responses @ force, directions.transpose(0, 2, 1) @ force

    def active(
        self, S: Array, y: Array, speeds: Array, of: _Solution, law: Array, by_law: Array
    ) -> tuple[Array, Array]:
        """Return the inverse of the equations of df in the active set, of least norm if rows depend, and their right.

        With du = y + S df: df = 0, or du = 0, or df_t + d (d(limit) f_n + limit df_n) + limit f_n du_t'/|u_t| = 0,
        du_t' the part across the direction d of slip.
        """
        n, rows, fixed = len(S), S.shape[1], self.fixed
        scale = np.sqrt(abs(np.einsum("nii->ni", S)))
        scale[scale == 0.0] = 1.0
        K, b, weight = np.broadcast_to(np.eye(rows), S.shape).copy(), np.zeros_like(y), scale.copy()

        def impose(where: NDArray[np.bool_], row: int) -> None:
            K[where, row], b[where, row], weight[where, row] = S[where, row], -y[where, row], 1.0 / scale[where, row]

        for row in range(fixed):
            impose(np.ones(n, dtype=bool), row)
        for k, contact in enumerate(self.method.interface.contacts):
            mode = of.mode[:, k]
            if contact.normal is not None:
                impose(mode > OPEN, fixed + contact.normal)
            slips = [fixed + (contact.tangential or 0) + i for i in range(contact.slips)]
            for row in slips:
                impose(mode == STICKS, row)
            here = np.flatnonzero(mode == SLIPS)
            if slips and len(here):
                self._slide(K, b, S, y, here, k, slips, speeds, of, law, by_law)
        K *= weight[:, :, np.newaxis] / scale[:, np.newaxis]
        inverse = np.broadcast_to(np.eye(rows), S.shape).copy()
        meet = (inverse != K).any(axis=0)
        used = np.flatnonzero(meet.any(axis=0) | meet.any(axis=1))
        part = np.ix_(np.arange(n), used, used)
        inverse[part] = _inverse(K[part])
        return inverse * weight[:, np.newaxis] / scale[:, :, np.newaxis], b

    def _slide(
        self, K: Array, b: Array, S: Array, y: Array, here: NDArray[np.intp], k: int, slips: list[int],
        speeds: Array, of: _Solution, law: Array, by_law: Array,
    ) -> None:  # fmt: skip
        """Set the equations of a slip of contact k in the problems ``here``."""
        contact = self.method.interface.contacts[k]
        normal = None if contact.normal is None else self.fixed + contact.normal
        friction = of.force[here][:, slips]
        length = np.linalg.norm(friction, axis=1)
        d = -friction / np.where(length > 0.0, length, 1.0)[:, np.newaxis]
        load = of.force[here, normal] if normal is not None else self.duration[here]
        limits = law[here, 3 * k : 3 * k + 2]
        own = np.abs(limits * load[:, np.newaxis] - length[:, np.newaxis]).argmin(axis=1)
        limit, by_limit = limits[np.arange(len(here)), own], by_law[here, 3 * k + own]
        by_limit = by_limit * load[:, np.newaxis]
        if normal is None:
            by_limit = by_limit + limit[:, np.newaxis] * self.by_duration[here]
        speed = np.linalg.norm(speeds[here][:, slips], axis=1)
        turns = np.where((speed > 0.0) & (len(slips) > 1), length / np.where(speed > 0.0, speed, 1.0), 0.0)
        for i, row in enumerate(slips):
            b[here, row] = -d[:, i, np.newaxis] * by_limit
            if normal is not None:
                K[here, row, normal] += limit * d[:, i]
            for j, other in enumerate(slips):
                across = turns * ((i == j) - d[:, i] * d[:, j])
                K[here, row] += across[:, np.newaxis] * S[here, other]
                b[here, row] -= across[:, np.newaxis] * y[here, other]

    @property
    def duration(self) -> Array:
        """Return (n,) times of friction without a gap: half a step in each problem."""
        return self.of.h / 2

    @property
    def by_duration(self) -> Array:
        """Return (n, inputs) changes of them."""
        return np.broadcast_to(self.by_h[:, 0] / 2, (len(self.of.h), self.by_h.shape[2]))
