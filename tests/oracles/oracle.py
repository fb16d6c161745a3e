"""A slow integrator that shares nothing with the package: formulas written out, 50 digits, finite differences.

Every method is one short function from (t, q0, p0), h to (q1, p1). A system enters through its Lagrangian alone: SymPy
differentiates it, mpmath evaluates it. Points are on [0, 1]; arrays hold mpmath numbers, one row a point, one column a
coordinate. Numbers in parentheses are the paper's equations.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import mpmath
import numpy as np
import sympy

mp = mpmath.MPContext()
mp.dps = 50
half = mp.mpf(1) / 2


def numbers(values: Any) -> np.ndarray:
    """Mpmath numbers, exactly the floats given."""
    array = np.array(values, dtype=object)
    return np.array([mp.convert(x) for x in array.ravel()], dtype=object).reshape(array.shape)


# Polynomials: coefficients, lowest first.


def derivative(polynomial: np.ndarray) -> np.ndarray:
    return polynomial[1:] * np.arange(1, len(polynomial))


def integral(polynomial: np.ndarray) -> np.ndarray:
    return np.concatenate([numbers([0]), polynomial / numbers(range(1, len(polynomial) + 1))])


def value(polynomial: np.ndarray, x: Any) -> Any:
    return sum((coefficient * x**k for k, coefficient in enumerate(polynomial)), mp.zero)


def cardinals(points: np.ndarray) -> list[np.ndarray]:
    """The polynomials that are 1 at one point and 0 at the others."""
    found = []
    for j, own in enumerate(points):
        polynomial = numbers([1])
        for other in np.delete(points, j):
            polynomial = np.convolve(polynomial, numbers([-other, 1])) / (own - other)
        found.append(polynomial)
    return found


def table(points: np.ndarray, at: np.ndarray, operation: Callable[[np.ndarray], np.ndarray] = np.array) -> np.ndarray:
    """Return values (derivatives, integrals from 0) of the cardinal polynomials on ``points``, a row per ``at``."""
    return _table(tuple(points), tuple(at), operation)


@cache
def _table(points: tuple[Any, ...], at: tuple[Any, ...], operation: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    polynomials = [operation(polynomial) for polynomial in cardinals(np.array(points, dtype=object))]
    return np.array([[value(polynomial, x) for polynomial in polynomials] for x in at], dtype=object)


# Points and weights on [0, 1].


def legendre(n: int) -> np.ndarray:
    previous, current = numbers([0]), numbers([1])
    for k in range(n):
        raised = (2 * k + 1) * np.concatenate([numbers([0]), current])
        raised[: len(previous)] -= k * previous
        previous, current = current, raised / (k + 1)
    return current


def roots(polynomial: np.ndarray) -> list[Any]:
    if len(polynomial) == 1:
        return []
    return sorted(mp.re(x) for x in mp.polyroots(list(polynomial[::-1]), maxsteps=500, extraprec=400))


def padded(polynomial: np.ndarray) -> np.ndarray:
    return np.concatenate([polynomial, numbers([0])])


@cache
def points(family: str, n: int) -> np.ndarray:
    """The n points of a family, ascending in [0, 1]."""
    cosine = {
        "chebyshev-lobatto": lambda k: mp.cospi(mp.mpf(k) / (n - 1)) if n > 1 else mp.zero,
        "chebyshev-gauss": lambda k: mp.cospi(mp.mpf(2 * k + 1) / (2 * n)),
        "equispaced": lambda k: 1 - mp.mpf(2 * k) / (n - 1),
    }
    zeros = {
        "gauss": lambda: roots(legendre(n)),
        "lobatto": lambda: [-1, *roots(derivative(legendre(n - 1))), 1],
        "radau-left": lambda: roots(legendre(n) + padded(legendre(n - 1))),
        "radau-right": lambda: roots(legendre(n) - padded(legendre(n - 1))),
    }
    found = zeros[family]() if family in zeros else [cosine[family](k) for k in reversed(range(n))]
    return (numbers(found) + 1) / 2


FAMILY_OF_NAME = {
    "gauss-legendre": "gauss",
    "gauss-lobatto": "lobatto",
    "legendre-lobatto": "lobatto",
    "gauss-radau-left": "radau-left",
    "gauss-radau-right": "radau-right",
    "clenshaw-curtis": "chebyshev-lobatto",
    "fejer": "chebyshev-gauss",
    "chebyshev-lobatto": "chebyshev-lobatto",
    "equispaced": "equispaced",
}


def rule(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of an interpolatory quadrature such as ``gauss-legendre:3``."""
    family, _, count = name.partition(":")
    c = points(FAMILY_OF_NAME[family], int(count))
    return c, weights(c)


def weights(c: np.ndarray) -> np.ndarray:
    return table(c, numbers([1]), integral)[0]


# Newton's method.


def differences(residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray, width: str) -> np.ndarray:
    """The Jacobian of ``residual`` at ``x`` by forward differences, good to about ``width``, in float64."""
    start, columns = residual(x).ravel(), []
    for index in np.ndindex(x.shape):
        moved = x.copy()
        moved[index] += mp.mpf(width)
        columns.append((residual(moved).ravel() - start) / mp.mpf(width))
    return np.array(columns, dtype=float).T


def newton(
    residual: Callable[[np.ndarray], np.ndarray], guess: np.ndarray, *, digits: int = 40, width: str = "1e-15"
) -> np.ndarray:
    """Return the zero near ``guess``; the Jacobian is reused once the updates are small."""
    x, size = guess.copy(), mp.inf
    for _ in range(60):
        if size > mp.mpf("1e-5"):
            inverse = np.linalg.inv(differences(residual, x, width)).astype(object)
        update = (inverse @ residual(x).ravel()).reshape(x.shape)
        x = x - update
        size = max(abs(d) for d in update.ravel())
        if size < mp.mpf(10) ** -digits * (1 + max(abs(d) for d in x.ravel())):
            return x
    raise ArithmeticError("the oracle found no solution")


# The Lagrangian and what follows from it.


class Mechanics:
    """L, its derivatives and the Euler-Lagrange residual E of a system with given parameters, point by point."""

    def __init__(self, system: Any, parameters: Mapping[str, float] | None = None) -> None:
        given = dict(parameters or {})
        constants = {
            symbol: given.get(symbol.name, default)
            for symbol, default in zip(system.parameters, system.defaults, strict=True)
        }
        q, v, t, L = system.coordinates, system.velocities, system.time, system.lagrangian
        a = sympy.symbols(f"acceleration:{len(q)}", real=True)
        Lq, Lv = [sympy.diff(L, x) for x in q], [sympy.diff(L, x) for x in v]
        rates = [*zip(q, v, strict=True), *zip(v, a, strict=True), (t, sympy.S.One)]
        E = [sum(sympy.diff(P, x) * rate for x, rate in rates) - F for P, F in zip(Lv, Lq, strict=True)]
        self.constants = [mp.mpf(x) for x in constants.values()]
        names = {name: getattr(mp, name) for name in dir(mp) if not name.startswith("_")}
        arguments = [*q, *v, *a, t, *constants]
        self._functions = {
            name: sympy.lambdify(arguments, list(results), modules=[names, "mpmath"], cse=True)
            for name, results in {"L": [L], "Lq": Lq, "Lv": Lv, "E": E}.items()
        }
        self.dimension = len(q)

    def _each(self, name: str, t: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray | None = None) -> np.ndarray:
        function, a = self._functions[name], numbers(np.zeros(q.shape)) if a is None else a
        results = [function(*q[n], *v[n], *a[n], t[n], *self.constants) for n in range(len(q))]
        return mp.one * np.array(results, dtype=object)

    def lagrangian(self, t: Any, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return self._each("L", t, q, v)[:, 0]

    def force(self, t: Any, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return self._each("Lq", t, q, v)

    def momentum(self, t: Any, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return self._each("Lv", t, q, v)

    def residual(self, t: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return self._each("E", t, q, v, a)

    def velocity(self, t: Any, q: np.ndarray, p: np.ndarray) -> np.ndarray:
        """The v with p = L_v(q, v, t) at one point."""
        return newton(lambda v: self.momentum([t], q[None], v[None])[0] - p, numbers(np.zeros(self.dimension)))


State = tuple[np.ndarray, np.ndarray]


# Galerkin: the paper's nodal unknowns.


def svi(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, nodes: Any, c: Any, w: Any) -> State:
    """(26)-(27): L_d = h sum w L(q(c), qdot(c)) stationary in the inner node values, p0 = -D_0 L_d, p1 = D_s L_d."""
    values, partials = table(nodes, c), table(nodes, c, derivative) / h

    def gradient(unknown: np.ndarray) -> np.ndarray:
        Q = np.vstack([q0[None], unknown])
        at = (t + c * h, values @ Q, partials @ Q)
        return h * (values.T @ (w[:, None] * system.force(*at)) + partials.T @ (w[:, None] * system.momentum(*at)))

    def rows(unknown: np.ndarray) -> np.ndarray:
        G = gradient(unknown)
        return np.vstack([G[:1] + p0, G[1:-1]])

    Q = newton(rows, q0 + np.outer(nodes[1:] * h, system.velocity(t, q0, p0)))
    return Q[-1], gradient(Q)[-1]


# Spectral collocation, and the variational integrator that shoots with it.


def collocation(system: Mechanics, t: Any, q0: Any, Q: np.ndarray, v0: Any, h: Any, nodes: Any) -> tuple[Any, Any]:
    """(15)-(18): E at the nodes 1 .. s for node values Q, and the velocities there."""
    D = table(nodes, nodes, derivative)[1:] / h
    V = D @ np.vstack([q0[None], Q])
    acceleration = D @ np.vstack([v0[None], V])
    return system.residual(t + nodes[1:] * h, Q, V, acceleration), V


def action(system: Mechanics, t: Any, Q: np.ndarray, h: Any, nodes: Any, c: Any, w: Any) -> Any:
    """(25), (33): the quadrature of L along the polynomial through all node values."""
    return h * (w @ system.lagrangian(t + c * h, table(nodes, c) @ Q, table(nodes, c, derivative) @ Q / h))


def central(function: Callable[[np.ndarray], Any], x: np.ndarray, width: str) -> np.ndarray:
    """The gradient by central differences, good to about width**2."""
    steps = np.diag(numbers([mp.mpf(width)] * len(x)))
    return numbers([(function(x + step) - function(x - step)) / (2 * mp.mpf(width)) for step in steps])


def scvi(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, nodes: Any, c: Any, w: Any) -> State:
    """(33), differentiated as a function of (q0, q1): each value of L_d solves its boundary-value problem anew."""
    v_start = system.velocity(t, q0, p0)
    warm = np.vstack([v_start[None], q0 + np.outer(nodes[1:-1] * h, v_start)])
    state = {"unknown": warm}

    def discrete_lagrangian(start: np.ndarray, end: np.ndarray) -> Any:
        def boundary_value_problem(unknown: np.ndarray) -> np.ndarray:
            Q = np.vstack([unknown[1:], end[None]])
            return collocation(system, t, start, Q, unknown[0], h, nodes)[0]

        state["unknown"] = unknown = newton(boundary_value_problem, state["unknown"])
        return action(system, t, np.vstack([start[None], unknown[1:], end[None]]), h, nodes, c, w)

    return generated_map(discrete_lagrangian, q0, p0, q0 + h * v_start)


def scvi_abscissae(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, stages: Any, c: Any, w: Any) -> State:
    """Compute the collocation step at any abscissae: V = v0 + h A a, Q = q0 + h A V, q1 = q0 + h b V."""
    A, b = table(stages, stages, integral), weights(stages)
    values, integrals = table(stages, c), table(stages, c, integral)
    v_start = system.velocity(t, q0, p0)
    state = {"unknown": np.vstack([v_start[None], numbers(np.zeros((len(stages), len(q0))))])}

    def discrete_lagrangian(start: np.ndarray, end: np.ndarray) -> Any:
        def boundary_value_problem(unknown: np.ndarray) -> np.ndarray:
            V = unknown[0] + h * (A @ unknown[1:])
            E = system.residual(t + stages * h, start + h * (A @ V), V, unknown[1:])
            return np.vstack([(start + h * (b @ V) - end)[None], E])

        state["unknown"] = unknown = newton(boundary_value_problem, state["unknown"])
        V = unknown[0] + h * (A @ unknown[1:])
        return h * (w @ system.lagrangian(t + c * h, start + h * (integrals @ V), values @ V))

    return generated_map(discrete_lagrangian, q0, p0, q0 + h * v_start)


def generated_map(discrete_lagrangian: Callable[[Any, Any], Any], q0: Any, p0: Any, guess: Any) -> State:
    """(5): q1 from p0 = -D1 L_d(q0, q1), then p1 = D2 L_d(q0, q1), to two thirds of the digits of mpmath."""
    width = mp.nstr(mp.mpf(10) ** -(mp.dps // 3))

    def mismatch(end: np.ndarray) -> np.ndarray:
        return p0 + central(lambda start: discrete_lagrangian(start, end), q0, width)

    q1 = newton(mismatch, guess, digits=max(20, mp.dps // 2), width="1e-9")
    return q1, central(lambda end: discrete_lagrangian(q0, end), q1, width)


def scvi_printed(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, nodes: Any, c: Any, w: Any) -> State:
    """(34a)-(34e): the same with partial derivatives by the end node values, as printed."""
    values, partials = table(nodes, c), table(nodes, c, derivative) / h

    def end_derivatives(Q: np.ndarray) -> np.ndarray:
        at = (t + c * h, values @ Q, partials @ Q)
        G = h * (values.T @ (w[:, None] * system.force(*at)) + partials.T @ (w[:, None] * system.momentum(*at)))
        return G[[0, -1]]

    def rows(unknown: np.ndarray) -> np.ndarray:
        Q = np.vstack([q0[None], unknown[1:]])
        E = collocation(system, t, q0, unknown[1:], unknown[0], h, nodes)[0]
        return np.vstack([end_derivatives(Q)[:1] + p0, E])

    v0 = system.velocity(t, q0, p0)
    unknown = newton(rows, np.vstack([v0[None], q0 + np.outer(nodes[1:] * h, v0)]))
    return unknown[-1], end_derivatives(np.vstack([q0[None], unknown[1:]]))[1]


def sc_position(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, nodes: Any) -> State:
    """(18): the Euler-Lagrange equations at nodes 1 .. s, node values as unknowns."""
    v0 = system.velocity(t, q0, p0)
    Q = newton(lambda Q: collocation(system, t, q0, Q, v0, h, nodes)[0], q0 + np.outer(nodes[1:] * h, v0))
    V = collocation(system, t, q0, Q, v0, h, nodes)[1]
    return Q[-1], system.momentum([t + h], Q[-1:], V[-1:])[0]


def sc_phase_space(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, nodes: Any) -> State:
    """(21): Hamilton's equations q' = v, p' = L_q at nodes 1 .. s, p = L_v(q, v), unknowns Q^i and V_i."""
    D, times, s = table(nodes, nodes, derivative)[1:] / h, t + nodes[1:] * h, len(nodes) - 1

    def rows(unknown: np.ndarray) -> np.ndarray:
        Q, V = unknown[:s], unknown[s:]
        P = np.vstack([p0[None], system.momentum(times, Q, V)])
        return np.vstack([D @ np.vstack([q0[None], Q]) - V, D @ P - system.force(times, Q, V)])

    v0 = system.velocity(t, q0, p0)
    unknown = newton(rows, np.vstack([q0 + np.outer(nodes[1:] * h, v0), np.outer(np.ones(s, dtype=int), v0)]))
    Q, V = unknown[:s], unknown[s:]
    return Q[-1], system.momentum(times, Q, V)[-1]


# Runge-Kutta.


def partitioned(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, A: Any, A_hat: Any, b: Any, c: Any) -> State:
    """(22) on Hamilton's equations, A for q and A_hat for p."""
    times = t + c * h

    def rows(V: np.ndarray) -> np.ndarray:
        q = q0 + h * (A @ V)
        return system.momentum(times, q, V) - p0 - h * (A_hat @ system.force(times, q, V))

    V = newton(rows, np.outer(np.ones(len(b), dtype=int), system.velocity(t, q0, p0)))
    return q0 + h * (b @ V), p0 + h * (b @ system.force(times, q0 + h * (A @ V), V))


def runge_kutta(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, A: Any, b: Any, c: Any) -> State:
    """(22) on Hamilton's equations."""
    return partitioned(system, t, q0, p0, h, A=A, A_hat=A, b=b, c=c)


def runge_kutta_position(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any, *, A: Any, b: Any, c: Any) -> State:
    """(22) on (q, v), the stage accelerations from E = 0."""
    v0, times = system.velocity(t, q0, p0), t + c * h

    def stages(K: np.ndarray) -> State:
        V = v0 + h * (A @ K)
        return q0 + h * (A @ V), V

    K = newton(lambda K: system.residual(times, *stages(K), K), numbers(np.zeros((len(b), len(q0)))))
    q1, v1 = q0 + h * (b @ stages(K)[1]), v0 + h * (b @ K)
    return q1, system.momentum([t + h], q1[None], v1[None])[0]


def collocation_tableau(c: np.ndarray) -> dict[str, np.ndarray]:
    """(23)."""
    return {"A": table(c, c, integral), "b": weights(c), "c": c}


def lobatto_pair(s: int) -> dict[str, np.ndarray]:
    """Lobatto IIIA for q and IIIB, b_i Ahat_ij + b_j A_ji = b_i b_j, for p."""
    tableau = collocation_tableau(points("lobatto", s))
    A, b = tableau["A"], tableau["b"]
    return tableau | {"A_hat": np.outer(np.ones(s, dtype=int), b) - (A.T * b[None, :]) / b[:, None]}


def radau_ia(s: int) -> dict[str, np.ndarray]:
    """Radau IA as published: Hairer and Wanner, Solving Ordinary Differential Equations II, Table IV.5.5."""
    one, r = mp.one, mp.sqrt(6)
    coefficients = {
        1: ([[1]], [1], [0]),
        2: ([[one / 4, -one / 4], [one / 4, 5 * one / 12]], [one / 4, 3 * one / 4], [0, 2 * one / 3]),
        3: (
            [
                [one / 9, (-1 - r) / 18, (-1 + r) / 18],
                [one / 9, (88 + 7 * r) / 360, (88 - 43 * r) / 360],
                [one / 9, (88 + 43 * r) / 360, (88 - 7 * r) / 360],
            ],
            [one / 9, (16 + r) / 36, (16 - r) / 36],
            [0, (6 - r) / 10, (6 + r) / 10],
        ),
    }
    return dict(zip("Abc", map(numbers, coefficients[s]), strict=True))


def leapfrog(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any) -> State:
    """Half a kick, a drift, half a kick: for L = v.Mv/2 - V(q, t) only."""
    rest = numbers(np.zeros((1, len(q0))))
    p_half = p0 + h / 2 * system.force([t], q0[None], rest)[0]
    q1 = q0 + h * system.velocity(t, q0, p_half)
    return q1, p_half + h / 2 * system.force([t + h], q1[None], rest)[0]


def explicit_euler(system: Mechanics, t: Any, q0: Any, p0: Any, h: Any) -> State:
    v0 = system.velocity(t, q0, p0)
    return q0 + h * v0, p0 + h * system.force([t], q0[None], v0[None])[0]


# The package's methods, by their plain description.


STAGES: Mapping[str, Callable[[int], dict[str, np.ndarray]]] = {
    "gauss": lambda s: collocation_tableau(points("gauss", s)),
    "radau-iia": lambda s: collocation_tableau(points("radau-right", s)),
    "radau-ia": radau_ia,
    "lobatto-iiia": lambda s: collocation_tableau(points("lobatto", s)),
    "chebyshev-gauss": lambda s: collocation_tableau(points("chebyshev-gauss", s)),
    "chebyshev-lobatto": lambda s: collocation_tableau(points("chebyshev-lobatto", s)),
}


def stepper_of(what: Mapping[str, Any]) -> tuple[Callable[..., State], dict[str, Any]]:
    """The function above, and its keyword arguments, for a specification such as ``{"method": "svi", "degree": 3}``."""
    kind = what["method"]
    position = what.get("form") == "position"
    if kind in ("svi", "scvi"):
        c, w = rule(what["quadrature"])
        if "abscissae" in what:
            given = what["abscissae"]
            named = STAGES[given](what["degree"])["c"] if isinstance(given, str) else numbers(given)
            return scvi_abscissae, {"stages": named, "c": c, "w": w}
        curve = {"nodes": points(FAMILY_OF_NAME[what["nodes"]], what["degree"] + 1), "c": c, "w": w}
        return (svi if kind == "svi" else scvi if what["variational"] else scvi_printed), curve
    if kind == "sc":
        nodes = points(FAMILY_OF_NAME[what["nodes"]], what["degree"] + 1)
        return (sc_position if position else sc_phase_space), {"nodes": nodes}
    if kind == "stoermer-verlet":
        return partitioned, lobatto_pair(2)
    if kind == "explicit-euler" and not position:
        return explicit_euler, {}
    if kind == "explicit-euler":
        tableau = dict(zip("Abc", map(numbers, ([[0]], [1], [0])), strict=True))
    elif kind == "collocation":
        tableau = collocation_tableau(numbers(what["abscissae"]))
    else:
        tableau = STAGES[kind](what["stages"])
    return (runge_kutta_position if position else runge_kutta), tableau


def oracle_step(
    mechanics: Mechanics, what: Mapping[str, Any], q: Sequence[float], p: Sequence[float], h: float, t: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """One step of the method described by ``what``, computed in 50 digits and rounded once."""
    step, arguments = stepper_of(what)
    q1, p1 = step(mechanics, mp.mpf(t), numbers(q), numbers(p), mp.mpf(h), **arguments)
    return q1.astype(float), p1.astype(float)
