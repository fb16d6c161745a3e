"""Mechanical systems of the literature; every physical constant is a parameter."""

from __future__ import annotations

from itertools import combinations, pairwise

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

MAX_CHAIN = 1024


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
        raise SystemDefinitionError(f"a chain must have 1 to {MAX_CHAIN} masses, not {n!r}")
    names = [f"q{index}" for index in range(1, n + 1)]
    elongations = [f"({right} - {left})" for left, right in pairwise(["0", *names, "0"])]
    kinetic = " + ".join(f"{name}_dot**2/2" for name in names)
    springs = "".join(f" - {d}**2/2 - alpha*{d}**3/3 - beta*{d}**4/4" for d in elongations)
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
    """Return the motion of n point vortices; x_k is the abscissa of vortex k, y_k its ordinate times its strength.

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
