"""A catalogue of mechanical systems, each with an initial state, a step and a span to try it with.

``PROBLEMS`` maps the names of the command line to entries; the functions give the systems themselves, in which every
physical constant is a parameter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from types import MappingProxyType

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.grammar import closest
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = [
    "PROBLEMS",
    "Problem",
    "cart_pole",
    "charged_particle",
    "double_pendulum",
    "duffing",
    "fput_chain",
    "harmonic_oscillator",
    "henon_heiles",
    "kepler",
    "outer_solar_system",
    "planar_pendulum",
    "point_vortices",
    "problem",
    "relativistic_particle",
    "spherical_pendulum",
]

MAX_CHAIN = 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """A system with everything needed to integrate it once.

    Attributes:
        name: the name on the command line.
        title: one line that says what it is.
        system: the Lagrangian.
        q: initial coordinates, m numbers.
        velocity: initial velocities, m numbers, or ``None`` where ``p`` is given.
        p: initial momenta, m numbers, or ``None``.
        step: a step size that suits a method of eight points.
        span: a length of time that shows what the system does.
        reference: where it is described.
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

    def __post_init__(self) -> None:
        given = [part for part in (self.velocity, self.p) if part is not None]
        if len(given) != 1 or not len(self.q) == len(given[0]) == self.system.dimension:
            raise SystemDefinitionError(
                f"problem '{self.name}' has {self.system.dimension} coordinates, but an initial state of "
                f"{len(self.q)} coordinates and {' and '.join(str(len(part)) for part in given)} velocities or momenta"
            )


def harmonic_oscillator() -> LagrangianSystem:
    """Mass m on a spring of stiffness k: m x'' = -k x."""
    return LagrangianSystem.from_text(
        name="harmonic oscillator",
        coordinates=["q"],
        lagrangian="m*q_dot**2/2 - k*q**2/2",
        parameters={"m": 1.0, "k": 1.0},
    )


def planar_pendulum() -> LagrangianSystem:
    """Mass m on a rod of length l; q is the angle from the downward vertical: l q'' = -g sin q."""
    return LagrangianSystem.from_text(
        name="planar pendulum",
        coordinates=["q"],
        lagrangian="m*l**2*q_dot**2/2 + m*g*l*cos(q)",
        parameters={"m": 1.0, "l": 1.0, "g": 1.0},
    )


def duffing() -> LagrangianSystem:
    """Oscillator in a double well, driven if gamma is not 0: q'' = -alpha q - beta q^3 + gamma cos(omega t)."""
    return LagrangianSystem.from_text(
        name="Duffing oscillator",
        coordinates=["q"],
        lagrangian="q_dot**2/2 - alpha*q**2/2 - beta*q**4/4 + gamma*q*cos(omega*t)",
        parameters={"alpha": -1.0, "beta": 8 / 3, "gamma": 0.0, "omega": 1.0},
    )


def kepler() -> LagrangianSystem:
    """Planar motion about a fixed centre of attraction mu: q'' = -mu q / |q|^3."""
    return LagrangianSystem.from_text(
        name="Kepler problem",
        coordinates=["q1", "q2"],
        lagrangian="(q1_dot**2 + q2_dot**2)/2 + mu/sqrt(q1**2 + q2**2)",
        parameters={"mu": 1.0},
    )


def double_pendulum() -> LagrangianSystem:
    """Two masses on two rods, one below the other; angles from the downward vertical."""
    return LagrangianSystem.from_text(
        name="double pendulum",
        coordinates=["theta1", "theta2"],
        lagrangian="""
            (m1 + m2)*l1**2*theta1_dot**2/2 + m2*l2**2*theta2_dot**2/2
            + m2*l1*l2*theta1_dot*theta2_dot*cos(theta1 - theta2)
            + (m1 + m2)*g*l1*cos(theta1) + m2*g*l2*cos(theta2)
        """,
        parameters={"m1": 1.0, "m2": 1.0, "l1": 1.0, "l2": 1.0, "g": 9.81},
    )


def spherical_pendulum() -> LagrangianSystem:
    """Mass m on a rod free to turn about a point; theta from the downward vertical, azimuth phi."""
    return LagrangianSystem.from_text(
        name="spherical pendulum",
        coordinates=["theta", "phi"],
        lagrangian="m*l**2*(theta_dot**2 + sin(theta)**2*phi_dot**2)/2 + m*g*l*cos(theta)",
        parameters={"m": 1.0, "l": 1.0, "g": 9.81},
    )


def cart_pole() -> LagrangianSystem:
    """Cart of mass M on a track carrying a pendulum of mass m and length l; theta from the downward vertical."""
    return LagrangianSystem.from_text(
        name="cart and pole",
        coordinates=["x", "theta"],
        lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*theta_dot*cos(theta) + m*l**2*theta_dot**2/2 + m*g*l*cos(theta)",
        parameters={"M": 2.0, "m": 1.0, "l": 1.0, "g": 9.81},
    )


def henon_heiles() -> LagrangianSystem:
    """Two oscillators with a cubic coupling: x'' = -x - 2 coupling x y, y'' = -y - coupling (x^2 - y^2)."""
    return LagrangianSystem.from_text(
        name="Henon-Heiles system",
        coordinates=["x", "y"],
        lagrangian="(x_dot**2 + y_dot**2)/2 - (x**2 + y**2)/2 - coupling*(x**2*y - y**3/3)",
        parameters={"coupling": 1.0},
    )


def charged_particle() -> LagrangianSystem:
    """Charge e in the magnetic field B (1 + gradient x) along z and the electric field E along x.

    The vector potential is A = (0, B (x + gradient x^2/2), 0), the scalar potential phi = -E x, and
    L = m v^2/2 + e A.v - e phi: the kinetic momentum is not the canonical one.
    """
    return LagrangianSystem.from_text(
        name="charged particle",
        coordinates=["x", "y", "z"],
        lagrangian="m*(x_dot**2 + y_dot**2 + z_dot**2)/2 + e*B*(x + gradient*x**2/2)*y_dot + e*E*x",
        parameters={"m": 1.0, "e": 1.0, "B": 1.0, "gradient": 0.1, "E": 0.0},
    )


def relativistic_particle() -> LagrangianSystem:
    """Relativistic oscillator, whose kinetic energy is not quadratic: d/dt (m v / sqrt(1 - v^2/c^2)) = -k q."""
    return LagrangianSystem.from_text(
        name="relativistic particle",
        coordinates=["q"],
        lagrangian="-m*c**2*sqrt(1 - q_dot**2/c**2) - k*q**2/2",
        parameters={"m": 1.0, "c": 1.0, "k": 1.0},
    )


def fput_chain(n: int = 8, *, alpha: float = 0.0, beta: float = 1.0) -> LagrangianSystem:
    """Fermi-Pasta-Ulam-Tsingou chain: n unit masses between fixed ends, V(d) = d^2/2 + alpha d^3/3 + beta d^4/4.

    Args:
        n: the number of moving masses, 1 to ``MAX_CHAIN``.
        alpha: default value of the cubic coefficient.
        beta: default value of the quartic coefficient.
    """
    if isinstance(n, bool) or not isinstance(n, int) or not 1 <= n <= MAX_CHAIN:
        raise SystemDefinitionError(f"a chain has 1 to {MAX_CHAIN} masses, not {n!r}")
    names = [f"q{index}" for index in range(1, n + 1)]
    stretches = [f"({right} - {left})" for left, right in pairwise(["0", *names, "0"])]
    kinetic = " + ".join(f"{name}_dot**2/2" for name in names)
    springs = "".join(f" - {d}**2/2 - alpha*{d}**3/3 - beta*{d}**4/4" for d in stretches)
    return LagrangianSystem.from_text(
        name=f"FPUT chain of {n}",
        coordinates=names,
        lagrangian=kinetic + springs,
        parameters={"alpha": alpha, "beta": beta},
    )


_MASSES = {
    "sun": 1.00000597682,
    "jupiter": 0.000954786104043,
    "saturn": 0.000285583733151,
    "uranus": 0.0000437273164546,
    "neptune": 0.0000517759138449,
    "pluto": 1 / 1.3e8,
}
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


def outer_solar_system() -> LagrangianSystem:
    """Sun (with the inner planets), Jupiter, Saturn, Uranus, Neptune and Pluto in 18 Cartesian coordinates.

    Lengths in astronomical units, time in days, masses in solar masses: Hairer, Lubich and Wanner, Geometric Numerical
    Integration, section I.2.4.
    """
    kinetic = " + ".join(f"m_{body}*({' + '.join(f'{body}_{axis}_dot**2' for axis in 'xyz')})/2" for body in _MASSES)
    attraction = "".join(
        f" + G*m_{one}*m_{two}/sqrt({' + '.join(f'({one}_{axis} - {two}_{axis})**2' for axis in 'xyz')})"
        for one, two in combinations(_MASSES, 2)
    )
    return LagrangianSystem.from_text(
        name="outer solar system",
        coordinates=[f"{body}_{axis}" for body in _MASSES for axis in "xyz"],
        lagrangian=kinetic + attraction,
        parameters={"G": 2.95912208286e-4} | {f"m_{body}": mass for body, mass in _MASSES.items()},
    )


def point_vortices(n: int = 4) -> HamiltonianSystem:
    """Motion of n point vortices in the plane; x_k is the abscissa of vortex k, y_k its ordinate times its strength.

    H = -1/(4 pi) sum over pairs of strength_i strength_j log(distance_ij^2). There is no Lagrangian: a shift of all
    ordinates does not change H.
    """
    pairs = [(i, j) for i in range(1, n + 1) for j in range(1, i)]
    terms = [
        f"strength_{i}*strength_{j}*log((x_{i} - x_{j})**2 + (y_{i}/strength_{i} - y_{j}/strength_{j})**2)"
        for i, j in pairs
    ]
    return HamiltonianSystem.from_text(
        name=f"{n} point vortices",
        coordinates=[f"x_{k}" for k in range(1, n + 1)],
        momenta=[f"y_{k}" for k in range(1, n + 1)],
        hamiltonian=f"-({' + '.join(terms)})/(4*pi)",
        parameters={f"strength_{k}": 1.0 if k % 2 else -1.0 for k in range(1, n + 1)},
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
    """The chain with its energy in the first mode, of amplitude 1."""
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
"""The catalogue: name on the command line -> function that builds the entry."""


def problem(name: str) -> Problem:
    """Build an entry of the catalogue; a chain takes a size, as in ``fput-chain:64``.

    Raises:
        SystemDefinitionError: if there is no such entry, or its size is unfit.
    """
    base, colon, size = name.partition(":")
    if base not in PROBLEMS:
        raise SystemDefinitionError(
            f"no problem is called '{base}'{closest(base, PROBLEMS)} Known: {', '.join(PROBLEMS)}"
        )
    if not colon:
        return PROBLEMS[base]()
    if base != "fput-chain":
        raise SystemDefinitionError(f"'{base}' has no size: only fput-chain takes one, as in fput-chain:64")
    if not (size.isascii() and size.isdigit() and len(size) < 10):
        raise SystemDefinitionError(f"the size of a chain is a whole number, as in fput-chain:64, not '{size}'")
    return _fput_problem(int(size))
