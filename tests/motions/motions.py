"""Motions of the table, in which nothing is a default, and the same motions by independent code.

A system is text. The package compiles it; :class:`Truth` reads the same text with SymPy, forms the equations of motion
in its own way (momenta, mass matrix, multipliers by index reduction) and integrates them with DOP853.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import scvi_codegen as sc

STOP = "stop"
"""The parameter after which a force is the root of a negative number; by default far away."""


class Scheme(NamedTuple):
    """A method with the solver of its equations, and the error of states that is allowed for this motion."""

    method: Any
    solver: str
    error: float
    precision: str = "double"


@dataclass(frozen=True)
class Chart:
    """Another origin and other units: x = x'/length + origin, t = t'/time, and L' = energy L."""

    origin: float
    length: float
    time: float
    energy: float

    def formula(self, text: str, names: list[str]) -> str:
        """Return a formula of x, x_dot and t of the chart for one of those at home."""

        def at_home(match: re.Match[str]) -> str:
            name, part, entry = match[1], match[2] or "", match[3] or ""
            if name in ("t", STOP):
                return f"({name}/{self.time!r})"
            if part:
                return f"({name}{part}{entry}*{self.time / self.length!r})"
            return f"({name}{entry}/{self.length!r} + {self.origin!r})"

        return re.sub(rf"\b({'|'.join(names)}|t|{STOP})(_dot)?\b(\[[^\]]*\])?", at_home, text)

    def scaled(self, text: str, factor: float, names: list[str]) -> str:
        return f"{factor!r}*({self.formula(text, names)})"


@dataclass(frozen=True, eq=False)
class Problem:
    """A system as text, a state, and its schemes.

    Attributes:
        own: parameters of a run that are no defaults.
        x: initial velocities, or momenta where a Hamiltonian is given.
        methods: schemes; nine points are several vectors.
        event: a function that crosses zero.
        maps: momentum maps by formula, in the order of the stepper.
        impulses: momentum maps of L alone, p . xi by the formulas of xi.
        falls_back: whether fixed-point iterations fail at steps of h, so that Newton's iteration takes their place.
        alike_in_lanes: whether trajectories in SIMD lanes have the bits of single runs: two, four or eight points, and
            no function of time alone, which is a number of all trajectories but a vector of all points.
        work: whether forces act whose work is told.
        time: unit of time, by which initial times are multiplied.
    """

    name: str
    q: tuple[float, ...]
    x: tuple[float, ...]
    own: Mapping[str, float]
    methods: tuple[Scheme, ...]
    event: str
    text: Mapping[str, Any]
    maps: tuple[str, ...] = ()
    impulses: tuple[tuple[str, ...], ...] = ()
    work: bool = False
    h: float = 0.04
    time: float = 1.0
    kind: str = "plain"
    time_transformation: str = ""
    inputs: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    falls_back: bool = False
    alike_in_lanes: bool = False
    array: Mapping[str, Any] | None = None
    fields: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def system(self) -> Any:
        """The system as the package reads it."""
        formulation = sc.HamiltonianSystem if "hamiltonian" in (self.array or self.text) else sc.LagrangianSystem
        if self.array is not None:
            return formulation.from_text(name=self.name, **self.array)
        system = formulation.from_text(name=self.name, **self.text)
        return sc.reparametrise(system, self.time_transformation) if self.kind == "slowed" else system

    @property
    def coordinates(self) -> list[str]:
        return list(self.text["coordinates"])

    def charted(self, chart: Chart) -> Problem:
        """Return the same motion with another origin and other units; of L alone, without constants of motion."""

        def text(names: list[str], home: Mapping[str, Any]) -> dict[str, Any]:
            power = chart.energy / chart.length
            parameters = dict(home["parameters"])
            parameters |= {STOP: chart.time * parameters[STOP]} if STOP in parameters else {}
            formulas: dict[str, Any] = {
                "parameters": parameters,
                "lagrangian": chart.scaled(home["lagrangian"], chart.energy, names),
            }
            formulas["constraints"] = [chart.formula(g, names) for g in home.get("constraints", ())]
            formulas["damping"] = home.get("damping") and chart.scaled(home["damping"], 1.0 / chart.time, names)
            formulas["forces"] = {x: chart.scaled(f, power, names) for x, f in home.get("forces", {}).items()}
            return {**home, **{name: formula for name, formula in formulas.items() if formula}}

        return replace(
            self,
            name=f"{self.name} elsewhere",
            q=tuple(chart.length * (x - chart.origin) for x in self.q),
            x=tuple(chart.length / chart.time * v for v in self.x),
            h=chart.time * self.h,
            time=chart.time,
            event=chart.formula(self.event, self.coordinates),
            text=text(self.coordinates, self.text),
            array=self.array and text(["q"], self.array),
            inputs={u: tuple(c / chart.time**k for k, c in enumerate(cubic)) for u, cubic in self.inputs.items()},
        )

    def of_known_size(self) -> Problem:
        """Return an array whose size is a number in its text: its states are rows, as those of named coordinates."""
        size = str(len(self.q))

        def sized(text: Any) -> Any:
            if isinstance(text, Mapping):
                return {sized(name): sized(value) for name, value in text.items()}
            if isinstance(text, list):
                return [sized(value) for value in text]
            if not isinstance(text, str):
                return text
            return re.sub(r"\b([mq])(\d)(_dot)?\b", r"\1_\2\3", re.sub(r"\bN\b", size, text))

        schemes = [scheme._replace(solver="auto") for scheme in self.methods]
        return replace(
            self,
            name=f"{self.name} of known size",
            own=sized(self.own),
            event=sized(self.event),
            text=sized(self.text),
            array=sized(self.array),
            methods=(*schemes, Scheme("svi:4", "auto", HIGH, "double-double")),
            fields={},
            kind="plain",
        )

    def values(self, own: bool) -> dict[str, float]:
        """Parameters by name, of this problem's own or by default."""
        return {**self.text["parameters"], **(self.own if own else {})}

    def data(self, start: float, end: float) -> dict[str, Any]:
        """Inputs as tabulated: cubic polynomials of time, which a spline reproduces."""
        times = np.linspace(min(start, end) - 0.5, max(start, end) + 0.5, 7)
        return {name: CubicSpline(times, np.polynomial.Polynomial(c)(times)) for name, c in self.inputs.items()}


class Truth:
    """The motion of a problem with given parameters from a state at a time, by SymPy's derivatives and DOP853."""

    def __init__(self, problem: Problem) -> None:
        text, self.problem = problem.text, problem
        names = problem.coordinates
        others = list(text.get("momenta", [f"{name}_dot" for name in names]))
        t, inputs, parameters = sympy.Symbol("t"), list(problem.inputs), list(text["parameters"])
        symbols = {name: sympy.Symbol(name) for name in (*names, *others, *inputs, *parameters)} | {"t": t}

        def read(formula: str | float) -> sympy.Expr:
            return sympy.sympify(str(formula), locals=symbols)

        q, x = (sympy.Matrix([symbols[name] for name in group]) for group in (names, others))
        f = sympy.Matrix([read(text.get("forces", {}).get(name, 0)) for name in names])
        damping = read(text.get("damping", 0))
        arguments = [t, list(q), list(x), [symbols[name] for name in parameters], [symbols[name] for name in inputs]]

        def function(expression: Any) -> Callable[..., np.ndarray]:
            compiled = sympy.lambdify(arguments, expression, "numpy", cse=True)
            return lambda *numbers: np.array(compiled(*numbers), dtype=float)

        if "hamiltonian" in text:
            H = read(text["hamiltonian"])
            p, v, energy = x, sympy.Matrix([H.diff(y) for y in x]), H
            rate = (-sympy.Matrix([H.diff(y) for y in q]) + f - damping * x, sympy.zeros(0, 1))
        else:
            L = read(text["lagrangian"])
            p, v = sympy.Matrix([L.diff(y) for y in x]), x
            energy = p.dot(x) - L
            force = sympy.Matrix([L.diff(y) for y in q]) + f - damping * p - p.jacobian(q) * x - p.diff(t)
            g = sympy.Matrix(
                [read("-".join(f"({side})" for side in c.split("="))) for c in text.get("constraints", ())]
            )
            G = g.jacobian(q) if len(g) else sympy.zeros(0, len(q))
            turning = (G * x + g.diff(t)) if len(g) else sympy.zeros(0, 1)
            curvature = turning.jacobian(q) * x + turning.diff(t) if len(g) else sympy.zeros(0, 1)
            block = sympy.Matrix(sympy.BlockMatrix([[p.jacobian(x), -G.T], [G, sympy.zeros(len(g))]]))
            self._block, self._right = function(block), function(sympy.Matrix([*force, *(-curvature)]))
            rate = None
        self._rate = function(rate[0]) if rate else None
        self._p, self._v, self._energy, self._f = map(function, (p, v, energy, f))
        self._maps = [function(read(formula)) for formula in problem.maps]
        self._event = function(read(problem.event))
        self.directions = function(
            sympy.Matrix([[read(component) for component in xi] for xi in problem.impulses] or [[0] * len(names)])
        )
        self.m = len(names)

    def _inputs(self, t: float) -> list[float]:
        return [float(np.polynomial.Polynomial(c)(t)) for c in self.problem.inputs.values()]

    def rates(self, t: float, q: Any, x: Any, values: list[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Velocities, the rates of x, and multipliers."""
        state = (t, q, x, values, self._inputs(t))
        if self._rate is not None:
            return self._v(*state).ravel(), self._rate(*state).ravel(), np.empty(0)
        rates_and_multipliers = np.linalg.solve(self._block(*state), self._right(*state).ravel())
        return np.asarray(x), rates_and_multipliers[: self.m], rates_and_multipliers[self.m :]

    def motion(self, start: float, end: float, q: Any, x: Any, parameters: Mapping[str, float]) -> Motion:
        """Integrate (q, x) from start to end."""
        return Motion(self, start, end, tuple(q), tuple(x), tuple(parameters.values()))


@dataclass(frozen=True)
class Motion:
    """A motion of a :class:`Truth`: functions of time."""

    truth: Truth
    start: float
    end: float
    q0: tuple[float, ...]
    x0: tuple[float, ...]
    values: tuple[float, ...]

    @cached_property
    def _solution(self) -> Callable[[Any], np.ndarray]:
        truth, m, count = self.truth, self.truth.m, len(self.truth.problem.impulses)

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            q, x = y[:m], y[m : 2 * m]
            v, a, _ = truth.rates(t, q, x, list(self.values))
            f = truth._f(t, q, x, list(self.values), truth._inputs(t)).ravel()
            xi = truth.directions(t, q, x, list(self.values), truth._inputs(t))[:count]
            return np.array([*v, *a, f @ v, *(xi @ f)])

        begin = [*self.q0, *self.x0, *np.zeros(1 + count)]
        solution = solve_ivp(
            rates, (self.start, self.end), begin, method="DOP853", rtol=3e-13, atol=1e-13, dense_output=True
        )
        assert solution.success, solution.message
        return solution.sol

    def _along(self, function: Callable[..., np.ndarray], t: Any) -> np.ndarray:
        return np.array([function(s, *self._state(s), list(self.values), self.truth._inputs(s)) for s in np.ravel(t)])

    def _state(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        return tuple(np.split(self._solution(t)[: 2 * self.truth.m], 2))

    def q(self, t: Any) -> np.ndarray:
        return np.array([self._state(s)[0] for s in np.ravel(t)])

    def p(self, t: Any) -> np.ndarray:
        return self._along(self.truth._p, t).reshape(-1, self.truth.m)

    def v(self, t: Any) -> np.ndarray:
        return self._along(self.truth._v, t).reshape(-1, self.truth.m)

    def x(self, t: Any) -> np.ndarray:
        return np.array([self._state(s)[1] for s in np.ravel(t)])

    def energy(self, t: Any) -> np.ndarray:
        return self._along(self.truth._energy, t).ravel()

    def event(self, t: Any) -> np.ndarray:
        return self._along(self.truth._event, t).ravel()

    def maps(self, t: Any) -> np.ndarray:
        values = [self._along(momentum_map, t).ravel() for momentum_map in self.truth._maps]
        return np.array(values).reshape(-1, np.size(t)).T

    def work_and_impulses(self, t: Any) -> np.ndarray:
        """(n, 1 + k) the work of the forces, and their impulses."""
        return np.array([self._solution(s)[2 * self.truth.m :] for s in np.ravel(t)])

    def multipliers(self, t: Any) -> np.ndarray:
        return np.array([self.truth.rates(s, *self._state(s), list(self.values))[2] for s in np.ravel(t)])


@cache
def truth_of(problem: Problem) -> Truth:
    return Truth(problem)


HIGH, LOW = 3e-8, 3e-3
SCHEMES_OF_EACH_SOLVER = (
    Scheme("svi:4", "fixed-point", HIGH),
    Scheme("gauss:4", "newton", HIGH),
    Scheme("svi:8", "auto", HIGH, "double-double"),
)


def chain(
    name: str,
    own: Mapping[str, float],
    masses: tuple[float, ...],
    b: float,
    force: str,
    damping: str | None = None,
    **more: Any,
) -> Problem:
    """Return a chain of unlike masses, as an array and written out, with springs k x^2/2 + b x^4/4 and forces of i."""
    count = len(masses)
    parameters = {**dict.fromkeys(own, 0.1), "k": 1.0, "a": 0.2, "e": 0.01}
    parameters |= {STOP: 100.0} if STOP in force else {}
    kinetic = "+".join(f"m{i}*q{i}_dot**2/2 - (1 + a*cos(t))*q{i}**2/2" for i in range(count))
    springs = "+".join(f"k*(q{i + 1}-q{i})**2/2 + {b}*(q{i + 1}-q{i})**4/4" for i in range(count - 1))
    damped = {} if damping is None else {"damping": damping}
    entry = re.compile(r"\b([mq])(_dot)?\[i\]")
    return Problem(
        name=name,
        q=(0.3, -0.2, 0.5, 0.1)[:count],
        x=(0.1, 0.4, -0.3, 0.2)[:count],
        own={**own, **{f"m{i}": mass for i, mass in enumerate(masses)}},
        event="q0 - q2*k/4",
        text={
            "coordinates": [f"q{i}" for i in range(count)],
            "parameters": {**parameters, **{f"m{i}": 1.0 for i in range(count)}},
            "lagrangian": f"{kinetic} - ({springs})",
            "forces": {f"q{i}": entry.sub(rf"\g<1>{i}\g<2>", force) for i in range(count)},
            **damped,
        },
        array={
            "coordinates": ["q[N]"],
            "parameters": {**parameters, "m[N]": 1.0},
            "lagrangian": f"""sum(i in N, m[i]*q_dot[i]**2/2 - (1 + a*cos(t))*q[i]**2/2)
                - sum(i in 0..N-2, k*(q[i+1] - q[i])**2/2 + {b}*(q[i+1] - q[i])**4/4)""",
            "forces": {"q[i]": force},
            **damped,
        },
        fields={"m": masses},
        kind="array",
        **more,
    )


AT_HOME: tuple[Problem, ...] = (
    Problem(
        name="pair",
        q=(0.3, -0.4),
        x=(0.5, -0.2),
        own={"m": 1.7, "n": 0.6, "k": 2.3, "l": 0.8, "c": 0.4, "e": 0.05, "d": 0.3},
        methods=(
            Scheme("svi:4", "fixed-point", HIGH),
            Scheme("svi:3", "newton", HIGH),
            Scheme("gauss:4", "auto", HIGH),
            Scheme("radau-iia:4", "auto", HIGH),
            Scheme("explicit-euler", "auto", 0.3),
            Scheme("svi:8", "auto", HIGH, "double-double"),
        ),
        event="x - y - l - t/50",
        text={
            "coordinates": ["x", "y"],
            "lagrangian": "m*x_dot**2/2 + n*y_dot**2/2 + d*x_dot*y_dot - k*(x - y - l)**2/2 - (x - y)**4/4",
            "parameters": {"m": 1.0, "n": 1.0, "k": 1.0, "l": 0.5, "c": 0.1, "e": 0.02, "d": 0.1, STOP: 100.0},
            "forces": {"x": f"-c*x_dot + sin(2*t) + e*sqrt({STOP} - t)", "y": "-c*x**2*y_dot + cos(t)/3"},
        },
        impulses=(("1", "1"),),
        work=True,
    ),
    Problem(
        name="cart",
        q=(0.2, 0.9),
        x=(0.4, -0.7),
        own={"M": 2.7, "m": 0.6, "l": 1.1, "a": 0.35, "w": 1.2, "c": 0.3},
        methods=(Scheme("svi:4", "fixed-point", HIGH), Scheme("scvi:5", "newton", HIGH), Scheme("sc:7", "auto", HIGH)),
        event="th - x*m - 0.3",
        text={
            "coordinates": ["x", "th"],
            "lagrangian": """M*x_dot**2/2 - k*x**2/2 + m*g*l*(1 + a*sin(w*t))*cos(th)
                + m*(x_dot + l*a*w*cos(w*t)*sin(th) + l*(1 + a*sin(w*t))*cos(th)*th_dot)**2/2
                + m*(l*(1 + a*sin(w*t))*sin(th)*th_dot - l*a*w*cos(w*t)*cos(th))**2/2""",
            "parameters": {"M": 2.0, "m": 1.0, "l": 0.8, "g": 3.0, "a": 0.2, "w": 1.7, "k": 0.5, "c": 0.1},
            "forces": {"x": "-c*x_dot + sin(3*t)/2", "th": "-c*th_dot*x**2"},
        },
        work=True,
    ),
    Problem(
        name="springs",
        q=(0.7, -0.3),
        x=(0.2, 0.6),
        own={"m": 1.7, "n": 0.6, "k": 2.3, "a": 0.4, "w": 1.2, "e": 0.3},
        methods=(
            Scheme({"method": "composition", "order": 8}, "auto", HIGH),
            Scheme("stoermer-verlet", "explicit", LOW),
            Scheme("stoermer-verlet", "newton", LOW),
            Scheme("svi:4", "auto", HIGH),
            Scheme({"method": "composition", "order": 8}, "auto", HIGH, "double-double"),
        ),
        event="x_dot + k*y/9",
        text={
            "coordinates": ["x", "y"],
            "lagrangian": f"""m*x_dot**2/2 + n*y_dot**2/2 - k*(1 + a*cos(w*t))*x**2/2 - x**2*y**2 - y**4/4 + y*sin(t)
                + e*x*sqrt({STOP} - t)""",
            "parameters": {"m": 1.0, "n": 1.0, "k": 1.0, "a": 0.2, "w": 1.7, "e": 0.02, STOP: 100.0},
        },
        h=0.03,
    ),
    Problem(
        name="double pendulum",
        q=(0.9, -0.4),
        x=(0.3, 1.1),
        own={"m": 1.7, "l": 0.8},
        methods=(Scheme("svi:4", "auto", HIGH),),
        event="a - b - l",
        text={
            "coordinates": ["a", "b"],
            "lagrangian": "m*a_dot**2 + l**2*b_dot**2/2 + l*a_dot*b_dot*cos(a - b) + 2*m*cos(a) + l*cos(b)",
            "parameters": {"m": 1.0, "l": 1.0},
        },
        alike_in_lanes=True,
    ),
    Problem(
        name="vortices",
        q=(0.9, -0.4),
        x=(0.3, 1.1),
        own={"a": 1.7, "b": 0.8},
        methods=(Scheme("svi:4", "auto", HIGH), Scheme("gauss:2", "auto", LOW)),
        event="x - b*y",
        text={
            "coordinates": ["x", "y"],
            "momenta": ["u", "w"],
            "hamiltonian": "-a*log((x - y)**2 + b*(u - w)**2) - x*u/4 + a*y**2*w**2/8",
            "parameters": {"a": 1.0, "b": 1.2},
        },
        alike_in_lanes=True,
    ),
    Problem(
        name="stiff",
        q=(0.7, -0.3),
        x=(0.2, 0.6),
        own={"m": 1.7, "n": 0.6, "k": 1900.0, "a": 0.3, "c": 0.2, "e": 0.1},
        methods=(Scheme("svi:8", "auto", 1e-6), Scheme("gauss:8", "auto", 1e-6)),
        event="y - x/2 - t/90",
        text={
            "coordinates": ["x", "y"],
            "lagrangian": "m*x_dot**2/2 + n*y_dot**2/2 - k*(1 + a*cos(t))*x**2/2 - (x - y)**2 - y**4/4",
            "parameters": {"m": 1.0, "n": 1.0, "k": 1600.0, "a": 0.2, "c": 0.1, "e": 0.02, STOP: 100.0},
            "forces": {"x": "-c*x_dot", "y": f"sin(2*t) - c*y_dot*x**2 + e*sqrt({STOP} - t)"},
        },
        work=True,
        h=0.1,
        falls_back=True,
    ),
    Problem(
        name="falling",
        q=(0.3, 0.8),
        x=(-0.5, 0.4),
        own={"m": 2.3, "g": 3.1},
        methods=(Scheme("svi:5", "auto", HIGH), Scheme("svi:5", "auto", HIGH, "double-double")),
        event="(x - 0.3)**2 - 0.01",
        text={
            "coordinates": ["x", "y"],
            "lagrangian": "m*(x_dot**2 + y_dot**2)/2 - m*g*y",
            "parameters": {"m": 1.0, "g": 9.81},
        },
        maps=(
            "m*x_dot",
            "m*(y_dot + g*t)",
            "m*(x*(y_dot + g*t) - y*x_dot - g*x_dot*t**2/2)",
            "m*(x - x_dot*t)",
            "m*(y - y_dot*t - g*t**2/2)",
        ),
    ),
    Problem(
        name="damped",
        q=(0.6, 0.2),
        x=(-0.3, 0.5),
        own={"m": 1.4, "c": 0.7, "r": 0.9},
        methods=SCHEMES_OF_EACH_SOLVER,
        event="x - z/m",
        text={
            "coordinates": ["x", "z"],
            "lagrangian": "m*x_dot**2/2 + x_dot*z_dot*cos(z) + z_dot**2 - (1 + cos(t)/3)*x**2 + cos(z)",
            "parameters": {"m": 2.0, "c": 0.4, "r": 0.7},
            "damping": "c*r",
        },
    ),
    Problem(
        name="swing",
        q=(0.6, -0.2),
        x=(-0.3, 0.4),
        own={"l": 1.1, "a": 0.35, "w": 1.2, "c": 0.3, "g": 2.3},
        methods=(
            Scheme("gauss:9", "fixed-point", HIGH),
            Scheme("sc:7", "newton", HIGH),
            Scheme("gauss:9", "auto", HIGH, "double-double"),
        ),
        event="q - s*l/5",
        text={
            "coordinates": ["q", "s"],
            "momenta": ["p", "r"],
            "hamiltonian": """p**2/(2*l**2*(1 + a*sin(w*t))**2) - g*l*(1 + a*sin(w*t))*cos(q) + (r - a*q)**2/(2*l)
                + g*s**2*(1 + q**2)""",
            "parameters": {"l": 0.8, "g": 3.0, "a": 0.2, "w": 1.7, "c": 0.1},
            "forces": {"q": "-c*p + cos(t)", "s": "-c*r*l"},
        },
        work=True,
    ),
    Problem(
        name="slowed",
        q=(0.8, 0.1),
        x=(0.1, 1.2),
        own={"m": 1.6, "u": 1.3},
        methods=(
            Scheme("svi:5", "auto", HIGH),
            Scheme("gauss:5", "newton", HIGH),
            Scheme("svi:8", "auto", HIGH, "double-double"),
        ),
        event="x - y*m/3",
        text={
            "coordinates": ["x", "y"],
            "lagrangian": "m*(x_dot**2 + y_dot**2)/2 + m*u/sqrt(x**2 + y**2)",
            "parameters": {"m": 1.0, "u": 1.0},
        },
        maps=("m*(x*y_dot - y*x_dot)",),
        kind="slowed",
        time_transformation="sqrt(x**2 + y**2)",
    ),
    Problem(
        name="reversible",
        q=(0.8, 0.1),
        x=(0.1, 1.1),
        own={"m": 1.6, "u": 1.3, "c": 0.1, "a": 0.2},
        methods=(
            Scheme("svi:5", "auto", HIGH),
            Scheme("gauss:5", "newton", HIGH),
            Scheme("svi:5", "auto", HIGH, "double-double"),
        ),
        event="x - y*m/3",
        text={
            "coordinates": ["x", "y"],
            "lagrangian": "m*(x_dot**2 + y_dot**2)/2 + m*u*(1 + a*sin(t))/sqrt(x**2 + y**2)",
            "parameters": {"m": 1.0, "u": 1.0, "c": 0.02, "a": 0.1},
            "forces": {"x": "-c*x_dot", "y": "-c*m*y_dot"},
        },
        impulses=(("-y", "x"),),
        work=True,
        kind="reversible",
        time_transformation="distance",
    ),
    Problem(
        name="rods",
        q=(0.6, -0.8, 1.4, -1.4),
        x=(0.4, 0.3, 0.7, 0.7),
        own={"m": 1.3, "g": 2.1, "c": 0.3},
        methods=(
            Scheme({"method": "svi", "degree": 1, "quadrature": "gauss-lobatto:2"}, "auto", 2e-2),
            Scheme("svi:5", "auto", 1e-7),
            Scheme("svi:5", "auto", 1e-7, "double-double"),
        ),
        event="x1 - x2/3 - g/30",
        text={
            "coordinates": ["x1", "y1", "x2", "y2"],
            "lagrangian": "m*(x1_dot**2 + y1_dot**2)/2 + (x2_dot**2 + y2_dot**2)/2 - g*(m*y1 + y2) - x1*cos(t)/2",
            "parameters": {"m": 2.0, "g": 3.0, "c": 0.1},
            "constraints": ["x1**2 + y1**2 = 1", "(x2 - x1)**2 + (y2 - y1)**2 = 1"],
            "forces": {"x2": "sin(2*t)*c"},
        },
        h=0.02,
    ),
    Problem(
        name="bead",
        q=(0.6, 0.0, -0.8),
        x=(0.2, 0.7, 0.15),
        own={"m": 1.3, "g": 2.1, "b": 0.4, "c": 0.2},
        methods=(Scheme("svi:4", "auto", 1e-7),),
        event="x - z/3 - g/30",
        text={
            "coordinates": ["x", "y", "z"],
            "lagrangian": "m*(x_dot**2 + y_dot**2 + z_dot**2)/2 + b*(x*y_dot - y*x_dot) - m*g*z",
            "parameters": {"m": 2.0, "g": 3.0, "b": 0.7, "c": 0.1},
            "constraints": ["x**2 + y**2 + z**2 = 1"],
            "forces": {"x": "-c*x_dot", "z": "-c*z_dot"},
        },
        h=0.02,
    ),
    Problem(
        name="weighted bead",
        q=(0.6, -0.8),
        x=(0.4, 0.3),
        own={"m": 1.3, "g": 2.1, "c": 0.2},
        methods=(Scheme("svi:4", "auto", 1e-7),),
        event="x - y/3 - g/30",
        text={
            "coordinates": ["x", "y"],
            "lagrangian": "m*(1 + x**2/3)*(x_dot**2 + y_dot**2)/2 + c*x_dot*y_dot - g*m*y - x*cos(t)/2",
            "parameters": {"m": 2.0, "g": 3.0, "c": 0.1},
            "constraints": ["x**2 + y**2 = 1"],
        },
        h=0.02,
    ),
    Problem(
        name="pushed",
        q=(0.6, -0.1),
        x=(-0.3, 0.2),
        own={"c": 0.5, "m": 1.6},
        methods=SCHEMES_OF_EACH_SOLVER,
        event="q - s*m/4",
        text={
            "coordinates": ["q", "s"],
            "lagrangian": "m*q_dot**2/2 + s_dot**2/2 + (1 + w)*cos(q) - (s - q)**2",
            "parameters": {"c": 0.2, "m": 1.0},
            "forces": {"q": "u - c*q_dot", "s": "-c*w*s_dot"},
            "inputs": ["u", "w"],
        },
        inputs={"u": (0.3, 0.2, -0.1, 0.02), "w": (0.1, -0.3, 0.1, 0.01)},
        work=True,
        kind="driven",
    ),
    chain(
        name="array",
        own={"k": 1.6, "a": 0.5, "c": 0.2, "e": 0.05},
        masses=(1.3, 0.7, 2.1, 0.9),
        b=0.3,
        force=f"-c*q_dot[i]*m[i] + sin(2*t)/3 + e*sqrt({STOP} - t)",
        damping="a*c/8",
        methods=(Scheme("svi:4", "fixed-point", HIGH), Scheme("gauss:9", "fixed-point", HIGH)),
    ),
    chain(
        name="array without friction",
        own={"k": 1.6, "a": 0.5, "e": 0.3},
        masses=(1.3, 0.7, 2.1),
        b=1.0,
        force="e*sin(2*t - q[i])",
        methods=(
            Scheme({"method": "composition", "order": 8}, "fixed-point", HIGH),
            Scheme("stoermer-verlet", "fixed-point", LOW),
            Scheme("svi:4", "newton", HIGH),
        ),
        h=0.03,
    ),
)

ELSEWHERE = Chart(origin=2.0, length=1e3, time=10.0, energy=1e6)
"""Millimetres from an origin two metres away, and tenths of seconds."""


def named(name: str) -> Problem:
    return next(problem for problem in AT_HOME if problem.name == name)


PROBLEMS = (
    *AT_HOME,
    *(named(name).charted(ELSEWHERE) for name in ("pair", "cart", "springs", "damped", "rods", "pushed", "array")),
    named("array").of_known_size(),
    named("array without friction").of_known_size(),
)
