"""Problems of the benchmark with eight initial states each, and their accelerations derived by hand.

The accelerations are written once, for numbers of any kind: NumPy's extended precision (for the references), heyoka's
and SymEngine's expressions, traced text. They are independent of the derivation that this package performs.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.interfaces.models.problems import problem
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.system import MechanicalSystem

Array = NDArray[np.float64]
Vector = Sequence[Any]
Rates = Callable[[Vector, Mapping[str, Any], Any], list[Any]]
"""Derivative of a first-order state x, from (x, parameters, module with sin, cos, sqrt and, for driven systems,
time)."""

STATES = 8
"""Number of initial states of a case; its error is the root mean square over them."""

SYSTEMS = tomllib.loads(Path(__file__).with_name("systems.toml").read_text(encoding="utf-8"))
"""Definitions of lattices, rotations and fields."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Formulation:
    """First-order system x' = rates(x) for (q, v), or for (q, p).

    Attributes:
        name: how it was derived.
        rates: derivative of x.
        momenta: True if the second half of x are momenta.
    """

    name: str
    rates: Rates
    momenta: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """Problem of the benchmark.

    Attributes:
        name: name on the command line.
        system: Lagrangian system, with the parameters of this case.
        formulations: hand-derived first-order systems; the first one is in (q, v).
        q, velocity: (8, m) initial states, possibly repeated; of rotations quaternions (w, x, y, z) after the other
            coordinates, and angular velocities in the body frame.
        span: duration.
        step: step size that gives about ten digits; the catalogue's own for its problems.
        fine: step size with which a Gauss method of 16 stages reaches 1e-17, for the reference; ``None`` with close
            encounters, where the steps are the adaptive ones of this package.
        bodies: masses and constant of gravity if coordinates are Cartesian positions of gravitating bodies.
        loops: source of ``rates(out, t, x, unused)`` in Python with loops, for Numba, if faster than unrolled code.
        velocity_of: function from (k, m) momenta in extended precision to velocities if a rounding of momenta matters;
            ``None`` if p = dL/dv is exact at the initial states (unit masses, or rest).
        momenta: initial momenta of formulations in momenta; ``None``: zero.
        mjcf: the same system as a model of MuJoCo, if there is one.
        arrays: of an array system of one array, which has one initial state, what peers of arrays need.
        field: of a partial differential equation, its density and exact solution.
    """

    name: str
    system: MechanicalSystem
    formulations: tuple[Formulation, ...] = ()
    q: Array
    velocity: Array
    span: float
    step: float
    fine: float | None = None
    bodies: Bodies | None = None
    loops: str | None = None
    velocity_of: Callable[[Any], Any] | None = None
    momenta: Array | None = None
    mjcf: str | None = None
    arrays: Arrays | None = None
    field: Any = None

    @property
    def parameters(self) -> dict[str, float]:
        """Parameter values by name."""
        return dict(zip((str(symbol) for symbol in self.system.parameters), self.system.defaults, strict=True))

    @property
    def dimension(self) -> int:
        """Number of coordinates m."""
        return int(self.q.shape[1])

    @property
    def states(self) -> tuple[Array, Array]:
        """Initial positions and velocities."""
        return self.q, self.velocity

    @property
    def size(self) -> int:
        """Number of coordinates and velocities."""
        return self.dimension + int(self.velocity.shape[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrays:
    """Array system for peers.

    Attributes:
        shape: shape of its array.
        by_hand: (is a field, length of an axis, strength) for the hand-written C.
    """

    shape: tuple[int, ...]
    by_hand: tuple[int, int, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Bodies:
    """Point masses that attract each other.

    Attributes:
        masses: masses of the bodies; 0 for a test particle.
        gravity: constant of gravity in the units of the case.
        fixed_centre: True if a unit mass at rest in the origin precedes the bodies of the coordinates.
        axes: coordinates of each body, 2 or 3.
        softening: distance that is added in quadrature to all others.
    """

    masses: tuple[float, ...]
    gravity: float
    fixed_centre: bool
    axes: int
    softening: float = 0.0


def divided(masses: Sequence[float], momenta: Any) -> Any:
    """Return velocities of bodies in space from their momenta in extended precision."""
    return momenta / np.repeat(np.array(masses, dtype=np.longdouble), 3)


def second_order(accelerations: Callable[[Vector, Vector, Mapping[str, Any], Any], list[Any]]) -> Rates:
    """Return first-order rates of (q, v) from accelerations."""

    def rates(x: Vector, parameters: Mapping[str, Any], functions: Any) -> list[Any]:
        m = len(x) // 2
        return [*x[m:], *accelerations(x[:m], x[m:], parameters, functions)]

    return rates


def pendulum(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return q'' = -(g / l) sin q."""
    return [-(of["g"] / of["l"]) * functions.sin(q[0])]


def duffing(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return q'' = -alpha q - beta q^3, without driving force."""
    return [-(of["alpha"] + of["beta"] * (q[0] * q[0])) * q[0]]


def kepler(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return q'' = -mu q / |q|^3."""
    pull = -of["mu"] * (q[0] * q[0] + q[1] * q[1]) ** -1.5
    return [pull * q[0], pull * q[1]]


def gravitation(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations of bodies in space by Newton's law, each pair once."""
    masses = [value for name, value in of.items() if name.startswith("m_")]
    result: list[Any] = [0.0] * len(q)
    for one in range(len(masses)):
        for two in range(one):
            d = [q[3 * one + axis] - q[3 * two + axis] for axis in range(3)]
            pull = of["G"] * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) ** -1.5
            for axis in range(3):
                result[3 * one + axis] = result[3 * one + axis] - masses[two] * (pull * d[axis])
                result[3 * two + axis] = result[3 * two + axis] + masses[one] * (pull * d[axis])
    return result


def double_pendulum(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations, with the 2 x 2 mass matrix inverted by hand."""
    m1, m2, l1, l2, g = (of[name] for name in ("m1", "m2", "l1", "l2", "g"))
    sine, cosine = functions.sin(q[0] - q[1]), functions.cos(q[0] - q[1])
    first = -m2 * l2 * (v[1] * v[1]) * sine - (m1 + m2) * g * functions.sin(q[0])
    second = l1 * (v[0] * v[0]) * sine - g * functions.sin(q[1])
    denominator = m1 + m2 * (sine * sine)
    return [
        (first - m2 * cosine * second) / (l1 * denominator),
        ((m1 + m2) * second - cosine * first) / (l2 * denominator),
    ]


def relativistic(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return q'' = -(k / m) q (1 - v^2/c^2)^(3/2)."""
    return [-(of["k"] / of["m"]) * q[0] * (1.0 - v[0] * v[0] / (of["c"] * of["c"])) ** 1.5]


def relativistic_in_momenta(x: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return q' = p / sqrt(m^2 + p^2/c^2), p' = -k q."""
    return [x[1] * (of["m"] * of["m"] + x[1] * x[1] / (of["c"] * of["c"])) ** -0.5, -of["k"] * x[0]]


def chain(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations of unit masses between fixed ends, on springs of force d + beta d^3 (alpha = 0)."""
    elongations = [q[0], *(right - left for left, right in pairwise(q)), -q[-1]]
    forces = [(1.0 + of["beta"] * (d * d)) * d for d in elongations]
    return [right - left for left, right in pairwise(forces)]


CHAIN_LOOPS = """
def rates(out, t, x, unused):
    before = x[0] + {beta} * (x[0] * x[0]) * x[0]
    for i in range({n}):
        stretch = x[i + 1] - x[i] if i < {n} - 1 else -x[i]
        force = stretch + {beta} * (stretch * stretch) * stretch
        out[i] = x[{n} + i]
        out[{n} + i] = force - before
        before = force
"""


def henon_heiles(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return x'' = -x - 2 coupling x y, y'' = -y - coupling (x^2 - y^2)."""
    x, y = q
    return [-x - 2.0 * of["coupling"] * (x * y), -y - of["coupling"] * (x * x - y * y)]


def scaled(state: Sequence[float], spread: float) -> Array:
    """Return (8, m) states proportional to one, with factors 1 +- spread from the golden-ratio sequence."""
    golden = (math.sqrt(5.0) - 1.0) / 2.0
    factors = 1.0 + spread * (2.0 * np.modf(golden * np.arange(1, STATES + 1))[0] - 1.0)
    return np.outer(factors, np.asarray(state, dtype=float))


def rotated(vector: Sequence[float], axes: int) -> Array:
    """Return (8, m) states: each body's vector under eight random orthogonal matrices, reproducible."""
    random = np.random.default_rng(1)
    parts = np.asarray(vector, dtype=float).reshape(-1, axes)
    matrices = [np.linalg.qr(random.standard_normal((axes, axes)))[0] for _ in range(STATES)]
    return np.array([(parts @ matrix.T).ravel() for matrix in matrices])


def _small_case(name: str, accelerations: Callable[..., list[Any]], *others: Formulation, **changes: Any) -> Case:
    """Return a problem of the catalogue with its own state (or another one), spread by 5 %."""
    entry = problem(name)
    fields = {field: changes.pop(field) for field in ("span", "fine", "loops") if field in changes}
    system = changes.pop("system", entry.system)
    q, velocity = changes.pop("q", entry.q), changes.pop("velocity", entry.velocity)
    step = changes.pop("step", entry.step)
    return Case(
        name=name,
        system=system.with_parameters(**changes),
        formulations=(*hand_solved(accelerations), *others),
        q=scaled(q, 0.05),
        velocity=scaled(velocity, 0.05),
        step=step,
        **fields,
    )


def duffing_case() -> Case:
    """Return the Duffing oscillator of the catalogue without its driving force 0, which no peer integrates."""
    defaults = problem("duffing").system
    values = dict(zip(map(str, defaults.parameters), defaults.defaults, strict=True))
    undriven = LagrangianSystem.from_text(
        name="Duffing oscillator",
        coordinates=["q"],
        lagrangian="q_dot**2/2 - alpha*q**2/2 - beta*q**4/4",
        parameters={name: values[name] for name in ("alpha", "beta")},
    )
    return _small_case("duffing", duffing, span=2000.0, fine=0.25, system=undriven)


def hand_solved(accelerations: Callable[..., list[Any]]) -> tuple[Formulation, ...]:
    """Return the formulation in (q, v) with these accelerations."""
    return (Formulation(name="hand-solved accelerations", rates=second_order(accelerations)),)


def kepler_case(eccentricity: float, *, step: float, fine: float) -> Case:
    """Return the Kepler problem started at the perihelion, in eight orientations."""
    entry = problem("kepler")
    speed = math.sqrt((1.0 + eccentricity) / (1.0 - eccentricity))
    return Case(
        name=f"kepler:{eccentricity}",
        system=entry.system,
        formulations=hand_solved(kepler),
        q=rotated((1.0 - eccentricity, 0.0), 2),
        velocity=rotated((0.0, speed), 2),
        span=2000.0,
        step=step,
        fine=fine,
        bodies=Bodies(masses=(0.0,), gravity=1.0, fixed_centre=True, axes=2),
    )


def gravitating(masses: Sequence[float], q: Sequence[float], velocity: Sequence[float], **others: Any) -> Case:
    """Return a case of bodies in space that attract each other."""
    gravity = others.pop("gravity", 1.0)
    names = [[f"{axis}{n}" for axis in "xyz"] for n in range(len(masses))]
    kinetic = [f"m_{n}*({' + '.join(f'{x}_dot**2' for x in body)})/2" for n, body in enumerate(names)]
    potential = [
        f"G*m_{i}*m_{j}/sqrt({' + '.join(f'({a} - {b})**2' for a, b in zip(names[i], names[j], strict=True))})"
        for i, j in combinations(range(len(masses)), 2)
    ]
    system = LagrangianSystem.from_text(
        name=others["name"],
        coordinates=[x for body in names for x in body],
        lagrangian=" + ".join([*kinetic, *potential]),
        parameters={f"m_{n}": mass for n, mass in enumerate(masses)} | {"G": gravity},
    )
    return Case(
        system=system,
        formulations=hand_solved(gravitation),
        q=rotated(q, 3),
        velocity=rotated(velocity, 3),
        bodies=Bodies(masses=tuple(masses), gravity=gravity, fixed_centre=False, axes=3),
        velocity_of=partial(divided, masses),
        **{"step": 0.1} | others,
    )


def outer_planets() -> tuple[list[float], Sequence[float], Sequence[float], float]:
    """Return masses, positions and velocities of the Sun and the outer planets, and the constant of gravity."""
    entry = problem("outer-solar-system")
    assert entry.velocity is not None
    values = dict(zip(map(str, entry.system.parameters), entry.system.defaults, strict=True))
    return [values[name] for name in values if name.startswith("m_")], entry.q, entry.velocity, values["G"]


def _outer_solar_system() -> Case:
    *state, gravity = outer_planets()
    span = problem("outer-solar-system").span
    return gravitating(*state, name="outer-solar-system", gravity=gravity, span=span, step=500.0, fine=256.0)


def chain_case(n: int, *, step: float, fine: float) -> Case:
    """Return an FPUT chain of n masses."""
    loops = CHAIN_LOOPS.format(n=n, beta=1.0)
    return _small_case(f"fput-chain:{n}", chain, span=1000.0, fine=fine, step=step, loops=loops)


MOMENTA = Formulation(name="Hamilton's equations", rates=relativistic_in_momenta, momenta=True)

CASES: Mapping[str, Callable[[], Case]] = {
    "planar-pendulum": partial(_small_case, "planar-pendulum", pendulum, span=1000.0, fine=0.5, q=(0.5,), step=0.8),
    "duffing": duffing_case,
    "kepler:0.2": partial(kepler_case, 0.2, step=0.5, fine=0.375),
    "kepler:0.5": partial(kepler_case, 0.5, step=0.25, fine=0.1875),
    "henon-heiles": partial(  # at energy 0.055, where motion is regular
        _small_case, "henon-heiles", henon_heiles, span=1000.0, fine=0.375, q=(0.0, 0.1), velocity=(0.3, 0.1)
    ),
    "outer-solar-system": _outer_solar_system,
    "double-pendulum": partial(
        _small_case, "double-pendulum", double_pendulum, span=1000.0, fine=0.25, q=(0.5, 0.5), step=0.4, g=1.0
    ),
    "relativistic-particle": partial(
        _small_case, "relativistic-particle", relativistic, MOMENTA, span=1000.0, fine=0.25
    ),
    "fput-chain:8": partial(chain_case, 8, step=1.0, fine=1.0),
    "fput-chain:64": partial(chain_case, 64, step=2.0, fine=3.0),
    "fput-chain:256": partial(chain_case, 256, step=2.0, fine=2.0),
}
"""Cases of the table: name on the command line -> function that builds one."""


def case(name: str) -> Case:
    """Build a case.

    Raises:
        SystemDefinitionError: for an unknown name.
    """
    if name not in CASES:
        raise SystemDefinitionError(f"no case is called '{name}'{closest(name, CASES)} Known: {', '.join(CASES)}")
    return CASES[name]()
