"""Every public quantity of runs and ensembles, with parameters, start, direction and stride that are no defaults.

Beside each stands its value from the formula of L alone, by SymPy's derivatives; states stand beside SciPy's.
"""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from samples import QUICK_FLAGS, pumped_cart_pole
from scipy.integrate import solve_ivp

import scvi_codegen as sc

CART = pumped_cart_pole()
FALLING = sc.LagrangianSystem.from_text(
    name="falling with a start of its own",
    coordinates=["x", "y"],
    lagrangian="m*(x_dot**2 + y_dot**2)/2 - m*g*y",
    parameters={"m": 1.0, "g": 9.81},
)
OTHER = {CART.name: {"M": 2.7, "m": 0.6, "l": 1.1, "a": 0.35, "w": 1.2}, FALLING.name: {"m": 2.3, "g": 3.1}}
Q, V = np.array([0.3, 0.8]), np.array([-0.5, 0.4])
SETTINGS = [
    SimpleNamespace(system=system, own=own, t=t, h=h, save_every=save_every)
    for system, own, (t, h, save_every) in product(
        (CART, FALLING), (False, True), ((0.0, 0.04, 1), (0.7, 0.04, 3), (-1.3, -0.05, 4))
    )
]
STEPS = 24


@dataclass(frozen=True)
class Formula:
    """Functions of (q, v, t, parameters) derived from L, for one state at a time."""

    momentum: Callable
    energy: Callable
    acceleration: Callable
    mass: Callable
    rest: Callable

    def velocity(self, q, p, t, values):
        """L_v is affine in v for these systems."""
        return np.linalg.solve(self.mass(q, t, values), p - self.rest(q, t, values))


@cache
def formula(system) -> Formula:
    q, v, t = list(system.coordinates), list(system.velocities), system.time
    L = system.formula
    p = sympy.Matrix([L.diff(x) for x in v])
    mass, rest = p.jacobian(v), p.subs(dict.fromkeys(v, 0))
    force = sympy.Matrix([L.diff(x) for x in q]) - p.jacobian(q) * sympy.Matrix(v) - p.diff(t)

    def function(expression, *arguments):
        made = sympy.lambdify([*arguments, list(system.parameters)], expression, "numpy")
        return lambda *values: np.array(made(*values), dtype=float).squeeze()

    return Formula(
        momentum=function(p, q, v, t),
        energy=function(p.dot(sympy.Matrix(v)) - L, q, v, t),
        acceleration=function(mass.LUsolve(force), q, v, t),
        mass=function(mass, q, t),
        rest=function(rest, q, t),
    )


def values_of(given, own=None) -> list[float]:
    chosen = OTHER[given.system.name] if given.own else {}
    return [(chosen | (own or {})).get(x.name, value) for x, value in given.system.constants.items()]


@cache
def stepper(name: str):
    system = {CART.name: CART, FALLING.name: FALLING}[name]
    return sc.compile_stepper(system, sc.SVI(5), flags=QUICK_FLAGS)


def arguments(given) -> dict:
    return {
        "h": given.h,
        "t": given.t,
        "save_every": given.save_every,
        "steps": STEPS + 1,
        "parameters": OTHER[given.system.name] if given.own else None,
    }


@cache
def solution(number: int):
    given = SETTINGS[number]
    own, values = formula(given.system), values_of(given)

    def rates(t, y):
        return [*y[2:], *own.acceleration(y[:2], y[2:], t, values)]

    end = given.t + (STEPS + 1) * given.h
    return solve_ivp(rates, (given.t, end), [*Q, *V], method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True).sol


@cache
def trajectory(number: int):
    given = SETTINGS[number]
    return stepper(given.system.name).integrate(Q, velocity=V, **arguments(given))


def expected(number: int, t):
    """Return q, p, v, energy and momentum maps at one time."""
    given = SETTINGS[number]
    own, values = formula(given.system), values_of(given)
    q, v = np.split(solution(number)(t), 2)
    p = own.momentum(q, v, t, values)
    return SimpleNamespace(
        q=q, p=p, velocity=v, energy=own.energy(q, v, t, values), momentum_map=maps(given, q, p, t, values)
    )


def maps(given, q, p, t, values):
    if given.system is CART:
        return np.empty(0)
    (x, y), (m, g), (p_x, p_y) = q, values, p
    turned = x * (p_y + g * m * t) - y * p_x - g * p_x * t**2 / 2
    return np.array([p_x, p_y + g * m * t, turned, m * x - p_x * t, m * y - p_y * t - g * m * t**2 / 2])


QUANTITIES: dict[str, Callable] = {
    "q": lambda run: run.q,
    "p": lambda run: run.p,
    "velocity": lambda run: run.velocity,
    "energy": lambda run: run.energy(),
    "momentum_map": lambda run: run.momentum_maps(),
}
"""Of a trajectory, by their names in a Dataset."""


def close(found, wanted) -> bool:
    return np.shape(found) == np.shape(wanted) and np.allclose(found, wanted, rtol=1e-9, atol=1e-9)


def named(number: int) -> str:
    given = SETTINGS[number]
    own = "own parameters" if given.own else "defaults"
    return f"{given.system.name}, {own}, t={given.t}, h={given.h}, save_every={given.save_every}"


every_setting = pytest.mark.parametrize("number", range(len(SETTINGS)), ids=named)


@every_setting
def test_quantities_of_trajectories(number, tmp_path):
    given, run = SETTINGS[number], trajectory(number)
    times = given.t + given.h * given.save_every * np.arange((STEPS + 1) // given.save_every + 1)
    assert np.allclose(run.t, times, rtol=0, atol=1e-14)
    states = [expected(number, t) for t in run.t]
    data = run.to_xarray()
    for name, quantity in QUANTITIES.items():
        wanted = np.array([getattr(state, name) for state in states])
        assert close(quantity(run), wanted), name
        assert name not in data or close(data[name].values, wanted), name
    assert abs(run.momentum_errors()).max(initial=0.0) < 1e-13
    table = run.to_dataframe()
    assert np.array_equal(table.index, run.t)
    assert np.array_equal(table.iloc[:, :4], np.hstack([run.q, run.p]))
    names = run.stepper.coordinates
    assert [*table.columns][4:] == ["iterations", *(f"{name}_dot" for name in names), "energy"]
    assert close(table.iloc[:, 5:7].to_numpy(), np.array([state.velocity for state in states]))
    assert close(table["energy"].to_numpy(), np.array([state.energy for state in states]))
    run.save(tmp_path / "run.csv")
    header, lines = (tmp_path / "run.csv").read_text().split("\n", 1)
    assert header.split(",") == ["t", *table.columns]
    assert np.array_equal(np.loadtxt(lines.splitlines(), delimiter=","), table.reset_index().to_numpy())


@every_setting
def test_quantities_of_slices(number):
    run = trajectory(number)
    for rows in (slice(2, None), slice(None, 5), slice(1, -1, 2), slice(3, 4)):
        part = run[rows]
        assert [*part.t] == [*run.t[rows]]
        assert np.array_equal(part.q, run.q[rows])
        assert np.array_equal(part.p, run.p[rows])
        assert np.array_equal(part.energy(), run.energy()[rows])
        between = (part.t[0] + part.t[-1]) / 2
        assert close(part.at(between)[0], expected(number, between).q)
        assert part.tau is None or np.array_equal(part.tau, run.tau[rows])
    for k in (0, 3, -1):
        t, q, p = run[k]
        assert (t, *q, *p) == (run.t[k], *run.q[k], *run.p[k])
    assert len(list(run)) == len(run)
    for rows in (len(run), slice(4, 4), slice(None, None, -1)):
        with pytest.raises(IndexError, match=r"out of range|must be ascending"):
            run[rows]
    with pytest.raises(TypeError, match=r"whole number or a slice.*not 'q'"):
        run["q"]


@every_setting
def test_quantities_of_dense_output(number):
    run = trajectory(number)
    times = run.t[0] + (run.t[-1] - run.t[0]) * np.array([0.0, 0.11, 0.345, 0.5, 0.87, 0.999, 1.0])
    for t, q, p in zip(times, *run.at(times), strict=True):
        state = expected(number, t)
        assert close(q, state.q)
        assert close(p, state.p)


@every_setting
def test_quantities_of_functions_of_states(number):
    given, run = SETTINGS[number], trajectory(number)
    compiled, own = stepper(given.system.name), arguments(given)["parameters"]
    for k in (0, -1):
        state, t = expected(number, run.t[k]), run.t[k]
        assert close(compiled.momentum(state.q, state.velocity, t, own), state.p)
        assert close(compiled.velocity(state.q, state.p, t, own), state.velocity)
        assert close(compiled.energy(state.q, state.p, t, own), state.energy)
        assert close(compiled.momentum_maps(state.q, state.p, t, own), state.momentum_map)
        q, p = compiled.step(state.q, state.p, given.h, t, own)
        if k == 0:
            later = expected(number, t + given.h)
            assert close(q, later.q)
            assert close(p, later.p)


@every_setting
def test_quantities_of_events(number):
    given, run = SETTINGS[number], trajectory(number)
    later = stepper(given.system.name).integrate(Q, velocity=V, events="(x - 0.3)**2 - 0.01", **arguments(given))
    assert np.array_equal(later.q, run.q)
    (crossings,) = later.events
    assert len(crossings) >= 1
    for t, q, p in zip(crossings.t, crossings.q, crossings.p, strict=True):
        state = expected(number, t)
        assert abs(abs(state.q[0] - 0.3) - 0.1) < 1e-9
        assert close(q, state.q)
        assert close(p, state.p)


@every_setting
def test_quantities_of_ensembles(number):
    """Each lane with parameters of its own, also where only some are given; the first like the single run."""
    given, run = SETTINGS[number], trajectory(number)
    name = next(iter(given.system.constants)).name
    masses = [values_of(given)[0], 1.9, 3.3]
    own = {**(OTHER[given.system.name] if given.own else {}), name: masses}
    p = [formula(given.system).momentum(Q, V, given.t, values_of(given, {name: mass})) for mass in masses]
    several = stepper(given.system.name).integrate_ensemble([Q] * 3, p, **{**arguments(given), "parameters": own})
    assert np.array_equal(several.t, run.t)
    assert np.allclose(several.q[:, 0], run.q, rtol=0, atol=1e-13)
    data = several.to_xarray()
    for lane, mass in enumerate(masses):
        values = values_of(given, {name: mass})
        assert np.array_equal(several.parameters[lane], values)
        for k, t in enumerate(several.t):
            q, momentum = several.q[k, lane], several.p[k, lane]
            v = formula(given.system).velocity(q, momentum, t, values)
            energy = formula(given.system).energy(q, v, t, values)
            assert close(several.energy()[k, lane], energy)
            assert close(data["energy"].values[k, lane], energy)
            assert close(data["velocity"].values[k, lane], v)
            assert close(several.momentum_maps()[k, lane], maps(given, q, momentum, t, values))
    assert abs(several.momentum_errors()).max(initial=0.0) < 1e-13


@every_setting
def test_quantities_of_saved_pickled_and_continued_runs(number):
    given, run = SETTINGS[number], trajectory(number)
    compiled, own = stepper(given.system.name), arguments(given)["parameters"]
    options = sc.SolverOptions(tolerance=3e-15, max_iterations=47)
    begun = compiled.start(Q, velocity=V, h=given.h, t=given.t, parameters=own, options=options)
    begun.advance(2 * given.save_every)
    copies = (
        pickle.loads(pickle.dumps(begun)),
        compiled.from_checkpoint(begun.checkpoint(), parameters=own, options=options),
    )
    rest = begun.record(STEPS + 1 - 2 * given.save_every, save_every=given.save_every)
    assert np.allclose(rest.q, run.q[2:], rtol=0, atol=1e-13)
    for copy in copies:
        assert copy.options == options
        assert np.array_equal(copy.parameters, values_of(given))
        again = copy.record(STEPS + 1 - 2 * given.save_every, save_every=given.save_every)
        assert all(np.array_equal(getattr(again, name), getattr(rest, name)) for name in ("t", "q", "p", "iterations"))
        assert again.options == options
