"""Catalogue of example problems: a system, an initial state, a step size and a time span, by command-line name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from scvi_codegen.display.cards import Html, card, listed, plain
from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.models.systems import (
    cart_pole,
    charged_particle,
    double_pendulum,
    duffing,
    fput_chain,
    harmonic_oscillator,
    henon_heiles,
    kepler,
    outer_solar_system,
    planar_pendulum,
    point_vortices,
    relativistic_particle,
    spherical_pendulum,
)
from scvi_codegen.representation import summary
from scvi_codegen.validation import TEXT, checks_arguments


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """System with everything needed to integrate it once.

    Attributes:
        name: the name on the command line.
        title: one-line description.
        system: the Lagrangian or Hamiltonian.
        q: initial coordinates, m numbers.
        velocity: initial velocities, m numbers, or ``None`` if ``p`` is given.
        p: initial momenta, m numbers, or ``None``.
        step: a suitable step size for a method with eight points.
        span: a time span that shows the behaviour of the system.
        reference: bibliographic reference.
    """

    name: str
    title: str
    system: MechanicalSystem
    q: tuple[float, ...]
    velocity: tuple[float, ...] | None = None
    p: tuple[float, ...] | None = None
    step: float
    span: float
    reference: str

    __repr__ = summary("name", "system", "step")

    def _repr_html_(self) -> str:
        state = [("q", self.q), ("velocity", self.velocity), ("p", self.p)]
        facts = (
            ("name", plain(self.name)),
            *((name, listed([f"{x:g}" for x in numbers])) for name, numbers in state if numbers is not None),
            ("step, span", plain(f"{self.step:g}, {self.span:g}")),
            ("described in", plain(self.reference)),
        )
        return card(self.title, facts, Html(self.system._repr_html_()))

    def __post_init__(self) -> None:
        initial = [part for part in (self.velocity, self.p) if part is not None]
        if len(initial) != 1 or not len(self.q) == len(initial[0]) == self.system.dimension:
            raise SystemDefinitionError(
                f"problem '{self.name}' has {self.system.dimension} coordinates, but an initial state of "
                f"{len(self.q)} coordinates and {' and '.join(str(len(part)) for part in initial)} velocities or "
                "momenta"
            )


_POSITIONS = (
    *(0.0, 0.0, 0.0),
    *(-3.5023653, -3.8169847, -1.5507963),
    *(9.0755314, -3.0458353, -1.6483708),
    *(8.3101420, -16.2901086, -7.2521278),
    *(11.4707666, -25.7294829, -10.8169456),
    *(-15.5387357, -25.2225594, -3.1902382),
)

_VELOCITIES = (
    *(0.0, 0.0, 0.0),
    *(0.00565429, -0.00412490, -0.00190589),
    *(0.00168318, 0.00483525, 0.00192462),
    *(0.00354178, 0.00137102, 0.00055029),
    *(0.00288930, 0.00114527, 0.00039677),
    *(0.00276725, -0.00170702, -0.00136504),
)


def _entry(
    name: str,
    title: str,
    system: Callable[[], MechanicalSystem],
    *,
    start: tuple[Sequence[float], Sequence[float]],
    step: float,
    span: float,
    reference: str,
    momenta: bool = False,
) -> tuple[str, Callable[[], Problem]]:
    def build() -> Problem:
        q, second = map(tuple, start)
        return Problem(
            name=name,
            title=title,
            system=system(),
            q=q,
            velocity=None if momenta else second,
            p=second if momenta else None,
            step=step,
            span=span,
            reference=reference,
        )

    return name, build


def _fput_problem(n: int = 8) -> Problem:
    """Return the chain with its energy in the first mode, of amplitude 1."""
    system = fput_chain(n)
    amplitude = math.sqrt(2 / (n + 1))
    return Problem(
        name="fput-chain" if n == 8 else f"fput-chain:{n}",
        title=f"Fermi-Pasta-Ulam-Tsingou chain of {n} masses, quartic springs, started in the first mode",
        system=system,
        q=tuple(amplitude * math.sin(math.pi * (index + 1) / (n + 1)) for index in range(n)),
        velocity=(0.0,) * n,
        step=0.5,
        span=1000.0,
        reference="E. Fermi, J. Pasta, S. Ulam, M. Tsingou, Studies of nonlinear problems, Los Alamos LA-1940 (1955)",
    )


_HLW = "E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., Springer (2006)"

_GOLDSTEIN = "H. Goldstein, C. Poole, J. Safko, Classical Mechanics, 3rd ed., Addison-Wesley (2002)"

_LANDAU = "L. D. Landau, E. M. Lifshitz, Mechanics, 3rd ed., Butterworth-Heinemann (1976)"

PROBLEMS: Mapping[str, Callable[[], Problem]] = MappingProxyType(
    dict(
        [
            _entry(
                "harmonic-oscillator",
                "mass on a linear spring",
                harmonic_oscillator,
                start=((1.0,), (0.0,)),
                step=0.5,
                span=100.0,
                reference=f"{_LANDAU}, section 21",
            ),
            _entry(
                "planar-pendulum",
                "pendulum swinging beyond the horizontal",
                planar_pendulum,
                start=((2.0,), (0.0,)),
                step=0.5,
                span=100.0,
                reference=f"{_HLW}, section I.1.3",
            ),
            _entry(
                "duffing",
                "undriven oscillator in a double well",
                duffing,
                start=((0.75,), (0.75,)),
                step=0.25,
                span=100.0,
                reference="G. Duffing, Erzwungene Schwingungen, Vieweg (1918)",
            ),
            _entry(
                "kepler",
                "Kepler ellipse of eccentricity 0.5 and period 2 pi",
                kepler,
                start=((0.5, 0.0), (0.0, math.sqrt(3.0))),
                step=0.25,
                span=200.0,
                reference=f"{_HLW}, section I.2.3",
            ),
            _entry(
                "double-pendulum",
                "double pendulum, chaotic",
                double_pendulum,
                start=((2.0, 2.5), (0.0, 0.0)),
                step=0.05,
                span=20.0,
                reference=f"{_LANDAU}, section 5, problem 1",
            ),
            _entry(
                "spherical-pendulum",
                "spherical pendulum, precessing",
                spherical_pendulum,
                start=((1.0, 0.0), (0.0, 2.0)),
                step=0.1,
                span=50.0,
                reference=f"{_LANDAU}, section 14, problem 1",
            ),
            _entry(
                "cart-pole",
                "pendulum hung from a cart that rolls freely",
                cart_pole,
                start=((0.0, 2.0), (0.0, 0.0)),
                step=0.1,
                span=20.0,
                reference=f"{_LANDAU}, section 5, problem 2",
            ),
            _entry(
                "henon-heiles",
                "Henon-Heiles system at energy 1/8, partly chaotic",
                henon_heiles,
                start=((0.0, 0.0), (math.sqrt(0.24), 0.1)),
                step=0.5,
                span=500.0,
                reference="M. Henon, C. Heiles, Astron. J. 69 (1964) 73",
            ),
            _entry(
                "charged-particle",
                "drift of a charge in a magnetic field with a gradient",
                charged_particle,
                start=((0.0, 0.0, 0.0), (1.0, 0.0, 0.1)),
                step=0.5,
                span=100.0,
                reference="J. D. Jackson, Classical Electrodynamics, 3rd ed., Wiley (1998), section 12.4",
            ),
            _entry(
                "relativistic-particle",
                "relativistic oscillator reaching 0.87 c",
                relativistic_particle,
                start=((1.4142135623730951,), (0.0,)),
                step=0.25,
                span=100.0,
                reference=f"{_GOLDSTEIN}, section 7.9",
            ),
            _entry(
                "outer-solar-system",
                "Sun and the five outer planets",
                outer_solar_system,
                start=(_POSITIONS, _VELOCITIES),
                step=200.0,
                span=200_000.0,
                reference=f"{_HLW}, section I.2.4",
            ),
            _entry(
                "point-vortices",
                "two pairs of vortices that leapfrog; given by a Hamiltonian, without a Lagrangian",
                point_vortices,
                start=((-0.5, 0.5, -0.25, 0.25), (0.0, 0.0, 0.0, 0.0)),
                step=0.2,
                span=20.0,
                reference="H. Aref, J. Math. Phys. 48 (2007) 065401",
                momenta=True,
            ),
            ("fput-chain", _fput_problem),
        ]
    )
)
"""Catalogue: functions that build the entries, by command-line name."""


@checks_arguments(name=TEXT)
def problem(name: str) -> Problem:
    """Return an entry of the catalogue; a chain takes a size, as in ``fput-chain:64``.

    Raises:
        SystemDefinitionError: if there is no such entry, or its size is invalid.
    """
    base, colon, size = name.partition(":")
    if base not in PROBLEMS:
        raise SystemDefinitionError(
            f"there is no problem '{base}'{closest(base, PROBLEMS)} Known: {', '.join(PROBLEMS)}"
        )
    if not colon:
        return PROBLEMS[base]()
    if base != "fput-chain":
        raise SystemDefinitionError(f"'{base}' has no size: only fput-chain takes one, as in fput-chain:64")
    if not (size.isascii() and size.isdigit() and len(size) < 10):
        raise SystemDefinitionError(f"the size of a chain must be a whole number, as in fput-chain:64, not '{size}'")
    return _fput_problem(int(size))
