"""Peers for SymPy's description of mechanisms: ``lambdify`` and PyDy with SciPy's DOP853.

The mechanism is SymPy's own pendulum of n links on a cart; this package reads the same ``KanesMethod``.

lambdify    mass matrix and forcing by ``lambdify(..., cse=True)``, NumPy's solve
pydy        the same equations by its Cython generator
"""

import time
from collections.abc import Callable, Iterator

import numpy as np
import sympy
from sympy.physics.mechanics import KanesMethod
from sympy.physics.mechanics.models import n_link_pendulum_on_cart

from benchmarks.cases.unforced import Array, Case
from benchmarks.contenders.dop853 import LOOSE, dop853, start_of
from benchmarks.report import Contender
from scvi_codegen.systems.lagrangian import LagrangianSystem

LINKS = (2, 5, 10, 20)
ANGLE = 0.3
"""Initial angle of every link, at rest; no force acts on the cart."""

Rates = Callable[[float, Array], Array]


def _pendulum(n: int) -> tuple[KanesMethod, dict[sympy.Symbol, float]]:
    method = n_link_pendulum_on_cart(n, cart_force=False)
    values = {f"m{i}": 1.0 / (n + 1) for i in range(n + 1)} | {f"l{i}": 1.0 / n for i in range(n)} | {"g": 9.81}
    return method, {sympy.Symbol(name): value for name, value in values.items()}


def links(n: int) -> Case:
    """Return the case of n links."""
    method, values = _pendulum(n)
    parameters = {str(symbol): value for symbol, value in values.items()}
    q = np.array([[0.0, *[ANGLE] * n]])
    return Case(
        name=f"mechanisms:{n}",
        system=LagrangianSystem.from_kanes_method(method, name=f"{n} links", parameters=parameters),
        q=q,
        velocity=0.0 * q,
        span=1.0,
        step=0.0625,
    )


def by_lambdify(method: KanesMethod, values: dict[sympy.Symbol, float]) -> Rates:
    """Return the right-hand side by ``lambdify``."""
    state = {function: sympy.Dummy() for function in (*method.q, *method.u)}
    both = [part.xreplace(values).xreplace(state) for part in (method.mass_matrix, method.forcing)]
    equations = sympy.lambdify([list(state.values())], both, cse=True)
    m = len(method.q)

    def rates(t: float, x: Array) -> Array:
        mass, forcing = equations(x)
        return np.concatenate([x[m:], np.linalg.solve(mass, forcing[:, 0])])

    return rates


def by_pydy(method: KanesMethod, values: dict[sympy.Symbol, float]) -> Rates:
    """Return the right-hand side by PyDy's Cython function."""
    from pydy.codegen.ode_function_generators import generate_ode_function

    used = method.mass_matrix.free_symbols | method.forcing.free_symbols
    constants = sorted((symbol for symbol in values if symbol in used), key=str)
    generated = generate_ode_function(
        method.forcing,
        list(method.q),
        list(method.u),
        constants,
        mass_matrix=method.mass_matrix,
        coordinate_derivatives=sympy.Matrix(list(method.u)),
        generator="cython",
    )
    numbers = np.array([values[symbol] for symbol in constants])
    return lambda t, x: np.array(generated(x, t, numbers))  # the function reuses its array


def kane_contenders(name: str, make: Callable[..., Rates], case: Case, quick: bool) -> Iterator[Contender]:
    """Yield DOP853 with SymPy's equations."""
    began = time.perf_counter()
    rates = make(*_pendulum(case.dimension - 1))
    rates(0.0, start_of(case, 0))
    return dop853("", time.perf_counter() - began, case, quick, rates, LOOSE, name)
