"""Mechanical systems of the literature; every physical constant is a parameter."""

from itertools import chain, combinations, pairwise

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem

MAX_CHAIN = 1024


def fput_chain(n: int = 8, *, alpha: float = 0.0, beta: float = 1.0) -> LagrangianSystem:
    """Fermi-Pasta-Ulam-Tsingou chain: n unit masses between fixed ends, V(d) = d^2/2 + alpha d^3/3 + beta d^4/4."""
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
    place = {body: [f"{body}_{axis}" for axis in "xyz"] for body in _MASSES}
    kinetic = " + ".join(f"m_{body}*({' + '.join(f'{x}_dot**2' for x in place[body])})/2" for body in _MASSES)
    attraction = ""
    for body, other in combinations(_MASSES, 2):
        square = " + ".join(f"({x} - {y})**2" for x, y in zip(place[body], place[other], strict=True))
        attraction += f" + G*m_{body}*m_{other}/sqrt({square})"
    return LagrangianSystem.from_text(
        name="outer solar system",
        coordinates=list(chain.from_iterable(place.values())),
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
