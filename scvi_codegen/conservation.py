"""What a run should have conserved, and how well it did: energy, cyclic momenta, linear and angular momentum.

Momenta of cyclic coordinates are read off the Lagrangian. Shifts and rotations are tried where the names of the
coordinates, or their number, suggest them, and believed if L is invariant at random points to 40 digits.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import sympy
from numpy.typing import NDArray

from scvi_codegen.expression_text import evaluate
from scvi_codegen.mechanical_system import MechanicalSystem
from scvi_codegen.mechanics import constitutive, force, momentum
from scvi_codegen.plotting import AXES, Body, bodies
from scvi_codegen.precision import Number, mp
from scvi_codegen.trajectory import Trajectory

__all__ = ["MomentumMap", "energy_report", "momentum_maps"]

Array = NDArray[np.float64]

NEGLIGIBLE = mp.mpf(10) ** -40
POINTS = 3
MOST_CYCLIC = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class MomentumMap:
    """A quantity that a symmetry of the Lagrangian conserves: p . xi(q), with xi the direction of the symmetry.

    Attributes:
        name: for people.
        shifted: coordinates i with xi_i = 1.
        turned: pairs (i, j) with xi_i = -q_j, xi_j = q_i.
    """

    name: str
    shifted: tuple[int, ...] = ()
    turned: tuple[tuple[int, int], ...] = ()

    def error(self, trajectory: Trajectory) -> float:
        """Largest change along the trajectory relative to the largest size of the terms of the sum."""
        q, p = trajectory.q, trajectory.p
        terms = [p[:, i] for i in self.shifted]
        for i, j in self.turned:
            terms += [q[:, i] * p[:, j], -q[:, j] * p[:, i]]
        value, size = np.sum(terms, axis=0), np.sum(np.abs(terms), axis=0)
        return float(np.abs(value - value[0]).max() / (size.max() or 1.0))

    def change(self, system: MechanicalSystem, slopes: _Slopes) -> Number:
        """DL . xi at a point, 0 if L is invariant."""
        total = mp.fsum(slopes.force[i] for i in self.shifted)
        for i, j in self.turned:
            total += slopes.q[i] * slopes.force[j] - slopes.q[j] * slopes.force[i]
            total += slopes.v[i] * slopes.momentum[j] - slopes.v[j] * slopes.momentum[i]
            if slopes.p:
                total += slopes.p[i] * slopes.constitutive[j] - slopes.p[j] * slopes.constitutive[i]
        return total


@dataclass(frozen=True, slots=True, kw_only=True)
class _Slopes:
    """A point and the derivatives of L there, 60 digits, m numbers each; p and L_p where a Hamiltonian is given."""

    q: tuple[Number, ...]
    v: tuple[Number, ...]
    force: tuple[Number, ...]
    momentum: tuple[Number, ...]
    p: tuple[Number, ...]
    constitutive: tuple[Number, ...]


def momentum_maps(system: MechanicalSystem) -> tuple[MomentumMap, ...]:
    """The momentum maps found for a system; there may be others."""
    free = system.formula.free_symbols
    cyclic = [i for i, coordinate in enumerate(system.coordinates) if coordinate not in free]
    found = [MomentumMap(name=f"momentum of {system.coordinates[i]}", shifted=(i,)) for i in cyclic[:MOST_CYCLIC]]
    candidates = list(_candidates([coordinate.name for coordinate in system.coordinates]))
    if candidates:
        points = list(_random_slopes(system))
        found += [
            candidate
            for candidate in candidates
            if points and all(abs(candidate.change(system, point)) < NEGLIGIBLE for point in points)
        ]
    return tuple(found)


def energy_report(system: MechanicalSystem, trajectory: Trajectory) -> str:
    """One line: the largest relative energy error and its drift, the part that grows linearly."""
    energy = trajectory.energy()
    scale = abs(float(energy[0]))
    error = (energy - energy[0]) / (scale or 1.0)
    what = "relative energy error" if scale else "energy error"
    if system.depends_on_time:
        return f"energy: L depends on time, it changed by {np.abs(energy - energy[0]).max():.3g} at most"
    return f"{what}: {np.abs(error).max():.2e} at most, drift {_drift(trajectory.t, error):+.1e} over the run"


def _drift(t: Array, error: Array) -> float:
    """Change over the run of the straight line fitted to the error."""
    if len(t) < 3:
        return float(error[-1])
    centred = (t - t.mean()) / (t[-1] - t[0])
    return float(centred @ error / (centred @ centred))


def _candidates(names: Sequence[str]) -> Iterator[MomentumMap]:
    found = bodies(names)
    if not found and 2 <= len(names) <= 3:
        found = (Body(name="", columns=tuple(range(len(names)))),)
    if not found:
        return
    size = len(found[0].columns)
    if len(found) > 1:
        for k in range(size):
            yield MomentumMap(name=f"linear momentum {AXES[k]}", shifted=tuple(body.columns[k] for body in found))
    for i, j in sorted(combinations(range(size), 2), reverse=True):
        i, j = (j, i) if (i, j) == (0, 2) else (i, j)
        axis = f" {AXES[3 - i - j]}" if size == 3 else ""
        yield MomentumMap(
            name=f"angular momentum{axis}", turned=tuple((body.columns[i], body.columns[j]) for body in found)
        )


def _random_slopes(system: MechanicalSystem) -> Iterator[_Slopes]:
    """A few random points, always the same, at which L can be differentiated."""
    generator = random.Random(20250101)
    slopes = (force(system), momentum(system), constitutive(system))
    parameters = dict(zip(system.parameters, map(mp.mpf, system.defaults), strict=True))
    for _ in range(POINTS):
        q, v = (tuple(mp.mpf(generator.uniform(-1, 1)) for _ in system.coordinates) for _ in range(2))
        point: dict[sympy.Symbol, Number] = {**parameters, system.time: mp.mpf(generator.uniform(0, 1))}
        p = tuple(mp.mpf(generator.uniform(-1, 1)) for _ in system.auxiliaries)
        point |= dict(zip((*system.coordinates, *system.velocities, *system.auxiliaries), (*q, *v, *p), strict=True))
        known: dict[sympy.Expr, Number] = {}
        try:
            values = [tuple(evaluate(entry, point, known) for entry in entries) for entries in slopes]
        except ArithmeticError:
            continue
        yield _Slopes(q=q, v=v, force=values[0], momentum=values[1], p=p, constitutive=values[2])
