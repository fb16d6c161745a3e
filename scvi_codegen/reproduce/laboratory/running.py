"""Meanings of "N" in the captions of section 3: number of points, as they say, or degree, as in other figures.

In both readings SVI has N Gauss points here, which the paper does not state: one more than the degree if N counts
points.

Compiled steppers and trajectories with the settings of the paper's captions.

The paper ends the nonlinear iteration when max(|Q^{i+1} - Q^i|, |P^{i+1} - P^i|) < TOL with TOL = 1e-14 in section 3
and 1e-12 in section 4, after at most 1000 iterations: :data:`SECTION_3` and :data:`SECTION_4`. Code is compiled with
flags that give the same bits on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods import SVI, SpectralCollocation
from scvi_codegen.methods.method import Method
from scvi_codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

SCHEMES = ("SVI", "SC")


@dataclass(frozen=True, slots=True)
class Reading:
    """Meaning of N.

    Attributes:
        name: ``"by points"``.
        meaning: description in a few words.
        beyond_degree: N less the degree.
    """

    name: str
    meaning: str
    beyond_degree: int

    def degree(self, n: int) -> int:
        """Return the degree of the curves for N."""
        return n - self.beyond_degree

    def method(self, scheme: str, n: int, *, more: int = 0) -> Method:
        """Return ``"SC"``, or ``"SVI"`` with N + ``more`` Gauss points."""
        degree = self.degree(n)
        return SVI(degree, f"gauss-legendre:{n + more}") if scheme == "SVI" else SpectralCollocation(degree)


BY_POINTS = Reading("by points", "N Chebyshev points, degree N - 1", 1)
"""Meaning in captions and on axes, on which verdicts are based."""
BY_DEGREE = Reading("by degree", "N the degree, N + 1 Chebyshev points", 0)
READINGS = (BY_POINTS, BY_DEGREE)

SECTION_3 = SolverOptions(tolerance=1e-14, max_iterations=1000, absolute=True)
SECTION_4 = SolverOptions(tolerance=1e-12, max_iterations=1000, absolute=True)
ROUNDOFF = SolverOptions()
"""Default convergence criterion of this package, to round-off, where the paper states none."""


@lru_cache(maxsize=256)
def stepper_of(system: MechanicalSystem, method: Method, solver: str = "auto") -> Stepper:
    """Return the compiled integrator, cached in the process."""
    return compile_stepper(system, method, solver=solver, flags=PORTABLE_FLAGS)


def steps_in(span: float, h: float) -> int:
    """Return the number of steps nearest to span / h, at least 1."""
    return max(1, round(span / abs(h)))


def trajectory(
    system: MechanicalSystem,
    method: Method,
    q: Sequence[float],
    velocity: Sequence[float],
    *,
    h: float,
    span: float,
    save_every: int = 1,
    options: SolverOptions = SECTION_3,
    solver: str = "auto",
) -> Trajectory:
    """Integrate with a method from (q, velocity) at t = 0 over ``span``."""
    stepper = stepper_of(system, method, solver)
    p = stepper.momentum(q, velocity)
    return stepper.integrate(q, p, h=h, steps=steps_in(span, h), save_every=save_every, options=options)
