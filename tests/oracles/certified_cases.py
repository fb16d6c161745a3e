"""Integrators that are certified: systems at states without symmetry, and methods of every kind."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from samples import (
    damped_pendulum,
    driven_duffing,
    linkage,
    oscillator,
    pumped_cart_pole,
    pumped_chain,
    pumped_swing,
    pushed_pendulum,
    sleigh,
    tangle,
    turning_wire,
    two_rods,
)

import scvi_codegen as sc
from scvi_codegen.interfaces.models.systems import point_vortices
from scvi_codegen.methods import Method
from scvi_codegen.systems.system import MechanicalSystem


@dataclass(frozen=True)
class Case:
    """A system at a state with a method, and the tolerance and the time transformation of its runs, if any."""

    system: MechanicalSystem
    method: Callable[[], Method]
    q: tuple[float, ...]
    p: tuple[float, ...]
    h: float
    tolerance: float | None = None
    time_transformation: str | None = None


STATES: dict[str, tuple[MechanicalSystem, tuple[float, ...], tuple[float, ...], float]] = {
    "pendulum": (sc.problem("planar-pendulum").system, (0.7,), (0.9,), 0.2),
    "driven": (driven_duffing(), (0.6,), (-0.3,), 0.2),
    "kepler": (sc.problem("kepler").system, (0.3, 0.8), (-1.1, 0.4), 0.1),
    "slowed": (sc.reparametrise(sc.problem("kepler").system, "distance"), (0.3, 0.8), (-1.1, 0.4), 0.2),
    "round": (sc.problem("kepler").system, (0.8, 0.1), (0.1, 1.2), 0.35),
    "oscillator": (oscillator(), (0.7,), (0.2,), 1.5),
    "double": (sc.problem("double-pendulum").system, (0.9, -0.6), (1.0, 0.5), 0.05),
    "cart": (pumped_cart_pole(), (0.2, 0.9), (0.4, -0.7), 0.1),
    "tangle": (tangle(), (0.4, 0.5, 0.1, -0.4), (-0.2, -0.4, 0.2, 0.6), 0.1),
    "chain": (
        pumped_chain(),
        tuple(math.sin(i) / 2 for i in range(8)),
        tuple(math.cos(2 * i) / 2 for i in range(8)),
        0.1,
    ),
    "linkage": (linkage(), (0.0, 1.0, 1.94, 1.5), (0.1, 0.2, 0.0, 0.3), 0.02),
    "sleigh": (sleigh(), (0.3, -0.4, 0.5), (1.155222551473559, 0.8681156930772079, 0.56), 0.1),
    "wire": (turning_wire(), (0.5, 0.4), (0.4, -0.3), 0.1),
    "pushed": (pushed_pendulum(), (0.6,), (-0.3,), 0.1),
    "damped": (damped_pendulum(), (0.6, 0.2), (-0.3, 0.5), 0.1),
    "rods": (two_rods(), (0.6, -0.8, 1.4, -1.4), (0.8, 0.6, 0.7, 0.0), 0.05),
    "swing": (pumped_swing(), (0.6,), (-0.3,), 0.1),
    "field": (sc.problem("charged-particle").system, (0.6, 0.3, -0.2), (-0.3, 0.4, 0.5), 0.1),
    "vortices": (point_vortices(2), (0.5, -0.4), (0.1, 0.3), 0.1),
}
METHODS: dict[str, Callable[[], Method]] = {
    "svi": lambda: sc.SVI(2),
    "rattle": lambda: sc.SVI(1, "gauss-lobatto:2"),
    "svi-3": lambda: sc.SVI(3),
    "svi-4": lambda: sc.SVI(4),
    "svi-8": lambda: sc.SVI(8),
    "lobatto-svi": lambda: sc.SVI(2, "gauss-lobatto:3"),
    "hermite": lambda: sc.SVI(3, "hermite:2"),
    "splines": lambda: sc.SVI(2, space="splines:2"),
    "trigonometric": lambda: sc.SVI(3, space="trigonometric:0.5"),
    "scvi": lambda: sc.SCVI(2),
    "scvi-gauss": lambda: sc.SCVI(2, abscissae="gauss"),
    "printed": lambda: sc.SCVI(3, variational=False),
    "sc": lambda: sc.SpectralCollocation(2),
    "sc-phase-space": lambda: sc.SpectralCollocation(2, form="phase-space"),
    "gauss": lambda: sc.Gauss(2),
    "gauss-position": lambda: sc.Gauss(2, form="position"),
    "radau-iia": lambda: sc.RadauIIA(2),
    "radau-ia": lambda: sc.RadauIA(2),
    "lobatto": lambda: sc.LobattoIIIA(3),
    "chebyshev": lambda: sc.ChebyshevGauss(3),
    "verlet": sc.StoermerVerlet,
    "composition": lambda: sc.Composition(8),
    "euler": sc.ExplicitEuler,
}


def case(name: str) -> Case:
    """``kepler/svi``."""
    system, _, own = name.partition("/")
    given, q, p, h = STATES[system]
    return Case(given, METHODS[own], q, p, h)


WHOLE = """
    pendulum/svi driven/svi kepler/svi-3 round/svi-8 oscillator/svi-8 double/svi double/lobatto-svi cart/svi
    pendulum/hermite pendulum/splines pendulum/trigonometric vortices/svi kepler/scvi double/scvi double/scvi-gauss
    kepler/printed double/printed double/sc cart/sc kepler/sc-phase-space double/gauss kepler/gauss
    linkage/lobatto-svi wire/lobatto-svi sleigh/lobatto-svi double/gauss-position kepler/radau-iia
    double/radau-ia kepler/lobatto
    driven/chebyshev pendulum/verlet double/verlet kepler/composition driven/euler
    tangle/svi tangle/scvi tangle/sc chain/svi-4 field/gauss rods/rattle rods/lobatto-svi
    slowed/svi-3 pushed/svi damped/svi pushed/scvi swing/sc swing/gauss swing/verlet field/verlet
"""
CONTROLLED = replace(case("kepler/svi-3"), tolerance=0.0)
REVERSIBLE = replace(case("kepler/svi-3"), time_transformation="frequency")
CASES = {
    **{name: case(name) for name in WHOLE.split()},
    "kepler/svi-3, controlled": CONTROLLED,
    "kepler/svi-3, reversible": REVERSIBLE,
}
