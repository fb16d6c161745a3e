"""Motions with kinks: random cases of ten families, and their motion by DOP853, restarted at each kink.

A kink is the zero of a switching function, the argument of ``positive_part`` or ``unit_step``, or x - 1/2 - n of
``rint(x)``. Between two of them the equations are those of one mode, smooth beyond the zeros too. Zeros are bracketed
on the polynomials of steps and found by Newton's iteration with steps that end there. Motions have units and an origin
of their own; cases have others.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from notation import lagrange
from scipy.integrate import DOP853, solve_ivp
from scipy.interpolate import make_interp_spline

from scvi_codegen import Table

Array = np.ndarray
ACCURACY = {"rtol": 3e-14, "atol": 1e-17}
PERTURBATION = 1e-8
"""Relative change of a state, whose growth is measured."""


class Motion(NamedTuple):
    """Equations of unit masses with kinks, and a state at t = 0.

    Attributes:
        parameters: values by name.
        q, v: (m,) positions and velocities.
        span: duration.
        rate: of the fastest change, in radians per time.
        acceleration: function of (t, q, v, modes); a mode is 1 where its switching function is positive, else 0.
        switching: functions of (t, q, v), also of arrays q, v (m, n) and t (n,).
    """

    parameters: dict[str, float]
    q: Sequence[float]
    v: Sequence[float]
    span: float
    rate: float
    acceleration: Callable[[float, Array, Array, list[int]], Sequence[float]]
    switching: Callable[[Any, Any, Any], Sequence[Any]]

    def states(self, times: Array, change: Array | float = 0.0) -> tuple[Array, list[float]]:
        """Return states (n, 2m), q and v, at ascending times, the first of them 0, and the times of kinks."""
        t, y, kinks = 0.0, np.array([*self.q, *self.v]) + change, list[float]()
        modes, found = self._first_modes(y), [y]
        while len(found) < len(times):
            solver = DOP853(self._rates(modes), t, y, times[-1], max_step=self.span / 40, **ACCURACY)
            zeros: list[tuple[float, int, Array]] = []
            while solver.status == "running" and not zeros:
                begin = solver.t, solver.y
                solver.step()
                zeros = self._zeros(modes, begin, solver)
                end = min(zeros)[0] if zeros else solver.t
                while len(found) < len(times) and times[len(found)] <= end:
                    found.append(self._advanced(modes, begin, times[len(found)]))
            if zeros:
                t, k, y = min(zeros)
                modes[k] = 1 - modes[k]
                kinks.append(t)
        return np.array(found), kinks

    def _rates(self, modes: list[int]) -> Callable[[float, Array], Any]:
        m = len(self.q)
        return lambda t, y: [*y[m:], *self.acceleration(t, y[:m], y[m:], modes)]

    def _values(self, t: Any, y: Array) -> Array:
        m = len(self.q)
        return np.array(np.broadcast_arrays(*self.switching(t, y[:m], y[m:])))

    def _advanced(self, modes: list[int], begin: tuple[float, Array], end: float) -> Array:
        t, y = begin
        return y if end == t else solve_ivp(self._rates(modes), (t, end), y, method="DOP853", **ACCURACY).y[:, -1]

    def _first_modes(self, y: Array) -> list[int]:
        """Return the modes just after t = 0, those of a short step where functions vanish."""
        m, now, dt = len(self.q), self._values(0.0, y), 1e-5 * self.span
        modes = [int(u >= 0.0) for u in now]
        a = np.array(self.acceleration(0.0, y[:m], y[m:], modes))
        ahead = self._values(dt, np.array([*(y[:m] + dt * y[m:] + dt * dt / 2 * a), *(y[m:] + dt * a)]))
        return [int(u > 0.0) if abs(w) < 1e-13 else int(w > 0.0) for w, u in zip(now, ahead, strict=True)]

    def _zeros(self, modes: list[int], begin: tuple[float, Array], solver: Any) -> list[tuple[float, int, Array]]:
        """Return time, number and state of the first zeros within a step, which is sampled at 32 times."""
        curve, grid, zeros = solver.dense_output(), np.linspace(begin[0], solver.t, 33), []
        changed = (self._values(grid[1:], curve(grid[1:])) > 0.0) != np.array(modes, dtype=bool)[:, None]
        first = np.flatnonzero(changed.any(axis=0))[:1]
        for k in np.flatnonzero(changed[:, first[0]]) if len(first) else ():
            low, high = grid[first[0]], grid[first[0] + 1]
            width = 1e-4 * (high - low)
            for _ in range(50):
                middle = (low + high) / 2
                is_before = bool(self._values(middle, curve(middle))[k] > 0.0) == modes[k]
                low, high = (middle, high) if is_before else (low, middle)
            sides = [self._values(t, curve(t))[k] for t in (high - width, high + width)]
            slope, t = (sides[1] - sides[0]) / (2 * width), high
            for _ in range(3):
                y = self._advanced(modes, begin, t)
                t = max(t - self._values(t, y)[k] / slope, begin[0])
            zeros.append((t, int(k), self._advanced(modes, begin, t)))
        return zeros


class Family(NamedTuple):
    """A kind of motion: its equations, with a mass ``m`` and the origin ``o`` of positions, and random motions."""

    coordinates: str
    lagrangian: str
    forces: dict[str, str]
    motion: Callable[[np.random.Generator], Motion]
    functions: dict[str, Table] | None = None

    def system(self, name: str) -> Any:
        parameters = self.motion(np.random.default_rng(0)).parameters
        origin = {"o": 0.0} if "o" in self.lagrangian else {}
        options = {"forces": self.forces, "functions": self.functions}
        return lagrange(name, self.coordinates, self.lagrangian, **options, **parameters, m=1.0, **origin)


def dyadic(number: float) -> float:
    """Return the nearest multiple of 2^-26: sums of these are exact, from any origin."""
    return round(float(number) * 2.0**26) / 2.0**26


def numbers(random: np.random.Generator) -> Callable[[float, float], float]:
    return lambda low, high: dyadic(random.uniform(low, high))


def floor(random):
    """A ball on a floor between two walls: free, or from the surface, at rest or not; pressed into a wall."""
    u = numbers(random)
    k, s, a = 10.0 ** u(0, 5), 10.0 ** u(0, 3), u(0.2, 1.0)
    y, w = random.choice([(u(0.05, 3.0), 0.0), (u(0.05, 3.0), u(-1, 1)), (0.0, 0.0), (0.0, u(0.2, 1.0))])
    x, v = random.choice([(0.0, u(-1, 1)), (a, u(-1, 1)), (-a - 0.25, 0.0)])
    span, rate = dyadic(u(2.0, 6.0) * (abs(w) + math.sqrt(2 * y + 0.1))), 1 + math.sqrt(2 * max(k, s))
    laws = (
        lambda t, q, v, on: (-2 * s * (on[1] * (q[0] - a) + on[2] * (q[0] + a)), -1.0 - 2 * k * on[0] * q[1]),
        lambda t, q, v: (-q[1], q[0] - a, -q[0] - a),
    )
    return Motion({"g": 1.0, "k": k, "s": s, "a": a}, [x, y], [v, w], span, rate, *laws)


def backlash(random):
    """A motor moves a mass on a spring through a gear with play."""
    u = numbers(random)
    k, j, a, f, w = 10.0 ** u(0, 3.5), u(0, 2), u(0.05, 0.5), u(0.2, 2.0), u(0.5, 3.0)
    x, v = random.choice([(0.0, 0.0), (a, 0.0), (-a, u(-1, 1)), (u(-0.5, 0.5), u(-1, 1))])
    pull = lambda q, on: 2 * k * (on[0] * (q[0] - q[1] - a) - on[1] * (q[1] - q[0] - a))  # noqa: E731
    laws = (
        lambda t, q, v, on: (f * math.cos(w * t) - pull(q, on), pull(q, on) - j * q[1]),
        lambda t, q, v: (q[0] - q[1] - a, q[1] - q[0] - a),
    )
    values = {"k": k, "j": j, "a": a, "f": f, "w": w, "t0": 0.0}
    return Motion(values, [x, 0.0], [v, 0.0], u(2, 6), w + math.sqrt(4 * k + j), *laws)


def rope(random):
    """A mass on a rope that goes slack; from rest on the surface, too."""
    u = numbers(random)
    k, r, angle = 10.0 ** u(0, 4), random.choice([u(0.1, 1.0), 1.0, 1.01]), u(-math.pi, math.pi)
    on_circle = dyadic(r * math.cos(angle)), dyadic(r * math.sin(angle))
    q, v = random.choice([(on_circle, (u(-1, 1), u(-1, 1))), ((1.0, 0.0), (0.0, 0.0))])
    laws = (
        lambda t, q, v, on: -2 * k * on[0] * (1.0 - 1.0 / math.hypot(*q)) * q - np.array([0.0, 1.0]),
        lambda t, q, v: (np.hypot(*q) - 1.0,),
    )
    return Motion({"g": 1.0, "k": k, "a": 1.0}, q, v, u(1, 5), 3 + math.sqrt(2 * k), *laws)


PAIRS = ((0, 1), (0, 2), (1, 2))


def cutoff(random):
    """Three particles that repel each other within a distance: apart, touching, or pressed and at rest."""
    u, k = numbers(random), 10.0 ** random.uniform(1.7, 3.5)
    start = random.choice(["apart", "touching", "pressed"], p=[0.6, 0.2, 0.2])
    q = np.array([0.0, 0.0, u(0.8, 1.5), u(-0.5, 0.5), u(-1.5, 0.0), u(1.0, 1.6)])
    if start != "apart":
        q[2:4] = (1.0 if start == "touching" else 0.9), 0.0
    v = [u(-0.3, 0.3), u(-0.3, 0.3), u(-1, 0), u(-0.5, 0.5), u(0, 1.0), u(-1, 0)]

    def acceleration(t, q, v, on):
        forces = np.zeros(6)
        for (i, j), touch in zip(PAIRS, on, strict=True):
            d = q[2 * i : 2 * i + 2] - q[2 * j : 2 * j + 2]
            push = 2 * k * touch * (1.0 / math.hypot(*d) - 1.0) * d
            forces[2 * i : 2 * i + 2] += push
            forces[2 * j : 2 * j + 2] -= push
        return forces

    def switching(t, q, v):
        return [1.0 - np.hypot(q[2 * i] - q[2 * j], q[2 * i + 1] - q[2 * j + 1]) for i, j in PAIRS]

    v = np.zeros(6) if start == "pressed" else v
    return Motion({"k": k, "a": 1.0}, q, v, u(1, 3), 1 + math.sqrt(4 * k), acceleration, switching)


def pulse(random, power=0):
    """A mass, on a damped spring or free, that is pushed for a while, also from the start on."""
    u = numbers(random)
    span, j, d, f = u(3, 10), random.choice([0.0, u(0.5, 3)]), random.choice([0.0, u(0, 0.5)]), 10.0 ** u(-1, 1)
    begin = random.choice([0.0, u(0, 0.9 * span), u(0, 0.9 * span)])
    x, v = random.choice([(0.0, 0.0), (u(-1, 1), 0.0), (u(-1, 1), u(-1, 1))])
    end = begin + dyadic(10.0 ** u(-3, 0.3))
    push = lambda t, on: on[0] * (t - begin) ** power - on[1] * (t - end) ** power  # noqa: E731
    laws = (lambda t, q, v, on: (f * push(t, on) - j * q[0] - d * v[0],), lambda t, q, v: (t - begin, t - end))
    values = {"j": j, "d": d, "fr"[power]: f, "t1": begin, "t2": end}
    return Motion(values, [x], [v], span, 1 + math.sqrt(j), *laws)


def ramp(random):
    return pulse(random, power=1)


def relay(random):
    """A mass that is pushed back with a constant force, to which a smaller one is added."""
    u = numbers(random)
    j, f, c = random.choice([0.0, u(0.1, 3)]), u(0.5, 3), u(-0.4, 0.4)
    x, v = random.choice([(u(0.1, 1.0), 0.0), (0.0, u(0.3, 1.0)), (0.0, u(-1, -0.3)), (u(-1, 1), u(-1, 1))])
    laws = (lambda t, q, v, on: (f * (1 - 2 * on[0]) + c - j * q[0],), lambda t, q, v: (q[0],))
    return Motion({"j": j, "f": f, "c": c}, [x], [v], u(3, 10), 2 + math.sqrt(j), *laws)


def drag(random):
    """A driven mass in a fluid."""
    u = numbers(random)
    j, e, f, w = random.choice([0.0, u(0.1, 3)]), 10.0 ** u(-1, 1), u(0.3, 2), u(0.5, 3)
    x, v = random.choice([(u(-1, 1), u(-1, 1)), (0.0, 0.0), (u(-1, 1), 0.0)])
    laws = (
        lambda t, q, v, on: (f * math.cos(w * t) - e * v[0] ** 2 * (2 * on[0] - 1) - j * q[0],),
        lambda t, q, v: (v[0],),
    )
    values, rate = {"j": j, "e": e, "f": f, "w": w, "t0": 0.0}, w + math.sqrt(j) + 2 * math.sqrt(e * f)
    return Motion(values, [x], [v], u(3, 10), rate, *laws)


def cogs(random):
    """A driven mass that is drawn to the nearest of equidistant places, also from between two of them."""
    u, edges = numbers(random), np.arange(-40, 40) + 0.5
    k, f, w = 10.0 ** u(-1, 1.5), u(0.1, 2.0), u(0.5, 3.0)
    x, v = random.choice([(0.0, u(0.5, 3)), (u(-3, 3), 0.0), (0.5, u(0.2, 2)), (-1.5, u(-2, -0.2))])
    laws = (
        lambda t, q, v, on: (f * math.cos(w * t) - 2 * k * (q[0] - (sum(on) - len(edges) / 2)),),
        lambda t, q, v: [q[0] - edge for edge in edges],
    )
    values = {"k": k, "f": f, "w": w, "a": 1.0, "t0": 0.0}
    return Motion(values, [x], [v], u(2, 8), w + math.sqrt(2 * k), *laws)


TABLES = {
    "F": Table([-1.5, -0.8, -0.3, 0.4, 0.9, 1.6], [1.1, 0.2, -0.4, 0.5, 0.3, 1.4], degree=3, outside="linear"),
    "G": Table(
        ([-1.0, -0.25, 0.5, 1.25], [1.0, 0.375, -0.75]),
        [[0.5, 1.0, 0.0], [0.25, -0.5, 0.5], [1.0, 0.0, 0.0], [-0.5, 0.5, 1.0]],
        outside="linear",
    ),
}


def tables(random):
    """A mass in a potential of tables: a cubic one of one argument, and a bilinear one of two."""
    u, spline = numbers(random), make_interp_spline(TABLES["F"].x, TABLES["F"].y, 3)
    ends, (gx, gy), z = np.unique(spline.t), map(np.array, TABLES["G"].x), np.array(TABLES["G"].y)
    breaks, j, f = (ends, gx[1:-1], gy[1:-1]), u(0.2, 2.0), u(0.3, 2.0)

    def acceleration(t, q, v, on):
        c, i, k = (int(sum(part)) for part in np.split(on, np.cumsum([len(b) for b in breaks[:-1]])))
        middle = ends[[0, -1][c > 0]] if c in (0, len(ends)) else (ends[c - 1] + ends[c]) / 2
        terms = 1 if c in (0, len(ends)) else 3
        slope = sum(float(spline(middle, 1 + n)) * (q[0] - middle) ** n / math.factorial(n) for n in range(terms))
        dx, dy, ((w, x), (y, s)) = gx[i + 1] - gx[i], gy[k + 1] - gy[k], z[i : i + 2, k : k + 2]
        a, b = (q[0] - gx[i]) / dx, (q[1] - gy[k]) / dy
        by_x, by_y = ((1 - b) * (y - w) + b * (s - x)) / dx, ((1 - a) * (x - w) + a * (s - y)) / dy
        return -j * q[0] - f * (slope + by_x), -j * q[1] - f * by_y

    def switching(t, q, v):
        return [*(q[0] - b for b in breaks[0]), *(q[0] - b for b in breaks[1]), *(q[1] - b for b in breaks[2])]

    x, w = random.choice([(0.5, u(-1, 1)), (u(-1.5, 1.5), 0.0), (-1.5, u(-2, 2))])
    return Motion({"j": j, "f": f, "a": 1.0}, [x, u(-1, 1)], [w, u(-1, 1)], u(2, 6), 3.0, acceleration, switching)


PLANE = "m*(x_dot**2 + y_dot**2)/2"
PUSHED = "m*x_dot**2/2 - j*(x - o)**2/2"
FAMILIES = {
    "floor": Family(
        "x y",
        f"{PLANE} - m*g*y - k*positive_part(o - y)**2 - s*(positive_part(x - o - a)**2 + positive_part(o - a - x)**2)",
        {}, floor,
    ),
    "backlash": Family(
        "x y", f"{PLANE} - k*(positive_part(x - y - a)**2 + positive_part(y - x - a)**2) - j*(y - o)**2/2",
        {"x": "f*cos(w*(t - t0))"}, backlash,
    ),
    "rope": Family(
        "x y", f"{PLANE} - m*g*y - k*positive_part(sqrt((x - o)**2 + (y - o)**2) - a)**2", {}, rope,
    ),
    "cutoff": Family(
        "x0 y0 x1 y1 x2 y2",
        "m*(x0_dot**2 + y0_dot**2 + x1_dot**2 + y1_dot**2 + x2_dot**2 + y2_dot**2)/2"
        + "".join(f" - k*positive_part(a - sqrt((x{i} - x{j})**2 + (y{i} - y{j})**2))**2" for i, j in PAIRS),
        {}, cutoff,
    ),
    "pulse": Family("x", PUSHED, {"x": "f*(unit_step(t - t1) - unit_step(t - t2)) - d*x_dot"}, pulse),
    "ramp": Family("x", PUSHED, {"x": "r*(positive_part(t - t1) - positive_part(t - t2)) - d*x_dot"}, ramp),
    "relay": Family("x", PUSHED, {"x": "f*(1 - 2*unit_step(x - o)) + c"}, relay),
    "drag": Family("x", PUSHED, {"x": "f*cos(w*(t - t0)) - e*x_dot*abs(x_dot)"}, drag),
    "cogs": Family("x", "m*x_dot**2/2 - k*wrap(x - o, a)**2", {"x": "f*cos(w*(t - t0))"}, cogs),
    "tables": Family(
        "x y", f"{PLANE} - j*((x - o)**2 + (y - o)**2)/2 - f*a*(F((x - o)/a) + G((x - o)/a, (y - o)/a))",
        {}, tables, TABLES,
    ),
}  # fmt: skip
UNITS = {
    "m": (1, 0, 0), "o": (0, 1, 0), "a": (0, 1, 0), "g": (0, 1, -2), "w": (0, 0, -1), "d": (1, 0, -1), "e": (1, -1, 0),
    **dict.fromkeys("ksj", (1, 0, -2)), **dict.fromkeys("fc", (1, 1, -2)), "r": (1, 1, -3),
    **dict.fromkeys(["t0", "t1", "t2"], (0, 0, 1)),
}  # fmt: skip
"""Powers of the units of mass, length and time in those of parameters."""


class Case(NamedTuple):
    """A motion in units and from an origin of its own.

    Attributes:
        motion: the motion.
        arguments: q, p, t, t_end and parameters of :meth:`Stepper.integrate`.
        units: (2m,) of the state q, p.
        t, q: (n,) times and (n, m) exact positions.
        ranges: (m,) of the positions.
        growth: by which a relative change of the initial state is multiplied at most.
        kinks: their times, from the start in units of the motion.
    """

    motion: Motion
    arguments: dict[str, Any]
    units: Array
    t: Array
    q: Array
    ranges: Array
    growth: float
    kinks: list[float]


def case_of(family: str, number: int, count: int = 21) -> Case:
    """Return a random case; every third one has the units and the origin of its motion."""
    random = np.random.default_rng([number, [*FAMILIES].index(family)])
    motion = FAMILIES[family].motion(random)
    m, times = len(motion.q), np.linspace(0.0, motion.span, count)
    exact, kinks = motion.states(times)
    sizes = np.repeat([np.ptp(exact[:, :m], axis=0).max(), np.abs(exact[:, m:]).max()], m)
    signs = np.resize([1.0, -1.0, 1.0, 1.0, -1.0], 2 * m)
    changed = motion.states(times, PERTURBATION * sizes * signs)[0]
    mass, length, time, shift, start = 1.0, 1.0, 1.0, 0.0, 0.0
    if number % 3:
        mass, length, time = 10.0 ** random.uniform(-3, 3), *(2.0 ** random.integers(-10, 11, 2))
        shift = length * dyadic(random.uniform(-10, 10) * sizes[0])
        start = time * dyadic(random.uniform(-10, 10) * motion.span)
    parameters = {"m": mass} | ({"o": shift} if "o" in FAMILIES[family].lagrangian else {})
    for name, value in motion.parameters.items():
        a, b, c = UNITS[name]
        parameters[name] = float(value * mass**a * length**b * time**c + start * name.startswith("t"))
    arguments = {
        "q": shift + length * np.array(motion.q), "p": mass * length / time * np.array(motion.v),
        "t": float(start), "t_end": float(start + time * motion.span), "parameters": parameters,
    }  # fmt: skip
    return Case(
        motion=motion,
        arguments=arguments,
        units=np.repeat([length, mass * length / time], m),
        t=np.append(start + time * times[:-1], arguments["t_end"]),
        q=shift + length * exact[:, :m],
        ranges=length * np.ptp(exact[:, :m], axis=0),
        growth=float((np.abs(changed - exact) / sizes).max() / PERTURBATION),
        kinks=kinks,
    )
