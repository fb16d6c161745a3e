"""IRKGL16 (Antonana, Makazaga & Murua, arXiv:2511.03655), ported to C from the published algorithm: ``irkgl16.c``.

The authors' program is the Julia package IRKGaussLegendre.jl. The port has its coefficients, its iteration with its
stopping rule and its compensated sums, at fixed step size; systems x'' = g(x, t) are integrated in its second-order
form, all others as first-order systems.
"""

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import sympy
from mpmath import mp

from benchmarks.cases.unforced import Array, Case, Formulation
from benchmarks.contenders.tracing import assignments
from benchmarks.report import Contender
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.methods.tables.tableau import gauss

PORT = Path(__file__).parents[1] / "irkgl16.c"
DECLARATIONS = (
    "long long irkgl16(double *state, double *stages, double *time, double h, long long steps, const double *tables);"
)
FLAGS = (*building.TUNED_FLAGS, "-fopenmp-simd")
STAGES = 8
FACTORS = tuple(2.0 ** (k / 4) for k in range(-4, 17))
"""Fixed steps, as multiples of the number of steps of the case's own step size."""


@cache
def tables() -> Array:
    """Return c, b and the columns of mu, eta and nu, as rows of 8 doubles.

    mu_ij = a_ij / b_j and eta_ij = sum_k a_ik a_kj / b_j are rounded for i >= j; the others follow in doubles from
    mu_ij + mu_ji = 1 and eta_ij - eta_ji = c_i - c_j, the conditions of symplecticity. mu equals the table of the
    Julia package; eta, which that computes in doubles, differs from its table in the last bit of 8 entries.
    """
    tableau, s = gauss(STAGES), STAGES
    exact = mp.matrix(tableau.A)
    square = exact * exact
    c, b = (np.array([float(x) for x in row]) for row in (tableau.c, tableau.b))
    mu, eta = (np.array([[float(a[i, j] / tableau.b[j]) for j in range(s)] for i in range(s)]) for a in (exact, square))
    np.fill_diagonal(mu, 0.5)
    for i in range(s):
        for j in range(i + 1, s):
            mu[i, j] = 1.0 - mu[j, i]
            eta[i, j] = eta[j, i] + c[i] - c[j]
    nodes = [*(x - 1 for x in tableau.c), mp.zero]  # stages of the last step, and its end

    def basis(k: int, x: Any) -> Any:
        return mp.fprod((x - y) / (nodes[k] - y) for n, y in enumerate(nodes) if n != k)

    rows = [[sum(-exact[j, k] / tableau.b[k] * basis(k, x) for k in range(s)) for j in range(s)] for x in tableau.c]
    nu = np.array([[float(x) for x in row] for row in rows])
    return np.concatenate([[c, b], mu.T, eta.T, nu.T])


def is_second_order(formulation: Formulation, case: Case) -> bool:
    """Return whether the accelerations do not depend on velocities."""
    x = sympy.symbols(f"x:{case.size}")
    functions = SimpleNamespace(sin=sympy.sin, cos=sympy.cos, sqrt=sympy.sqrt, time=sympy.Symbol("t"))
    rates = formulation.rates(list(x), case.parameters, functions)
    m = case.dimension
    return list(rates[:m]) == list(x[m:]) and not set(x[m:]) & set().union(
        *(sympy.sympify(rate).free_symbols for rate in rates[m:])
    )


class Port:
    """The port, compiled for a formulation of a case.

    Args:
        case: case to integrate.
        formulation: formulation of the case.
        second_order: use the second-order form; by default where it applies.
    """

    def __init__(self, case: Case, formulation: Formulation, second_order: bool | None = None) -> None:
        second = is_second_order(formulation, case) if second_order is None else second_order
        first = case.dimension if second else 0
        lines = assignments(formulation.rates, case.parameters, case.size)
        body = "".join(
            f"  const lanes {name} = {value} - zero;\n"
            if not name.startswith("out")
            else f"  f[{int(name[4:-1]) - first}] = {value} - zero;\n" * (int(name[4:-1]) >= first)
            for name, value in lines
        )
        field = (
            "#define sin lanes_sin\n#define cos lanes_cos\n#define sqrt lanes_sqrt\n"
            "static inline void field(const lanes *x, lanes t, lanes *f)\n"
            f"{{\n  const lanes zero = {{0.0}};\n  (void)t;\n{body}}}\n"
        )
        port = PORT.read_text(encoding="utf-8")
        before, mark, after = port.partition("/* sum_j table_j x_j + start. */")
        code = f"#define D {case.size}\n#define SECOND_ORDER {int(second)}\n{before}{field}{mark}{after}"
        source = Source(prefix="irkgl16", header=f"{DECLARATIONS}\n", code=code, declarations=DECLARATIONS)
        self.size, self.library = case.size, building.load(source, flags=FLAGS)
        self.title = f"port to C, {'second' if second else 'first'}-order form, {' '.join(FLAGS)}"

    def start(self, x: Array) -> Callable[[float, int], tuple[Array, int]]:
        """Return a function of h and steps that continues a run from x; it returns the state and the iterations."""
        arrays = (np.concatenate([x, 0.0 * x]), np.zeros(STAGES * self.size), np.zeros(2), tables().ravel())
        buffers = [self.library.ffi.from_buffer("double[]", array) for array in arrays]

        def advance(h: float, steps: int) -> tuple[Array, int]:
            iterations = self.library.lib.irkgl16(*buffers[:3], h, steps, buffers[3])
            if iterations < 0:
                raise ArithmeticError(f"IRKGL16 did not converge with h = {h:g}")
            return arrays[0][: self.size], int(iterations)

        return advance


def irkgl16_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield the port at fixed step sizes, from Hamilton's equations if the case has them."""
    formulation = next((each for each in case.formulations if each.momenta), case.formulations[0])
    began = perf_counter()
    port = Port(case, formulation)
    seconds = perf_counter() - began

    def prepare(steps: int, index: int) -> Callable[[], Array]:
        state = np.concatenate([case.q[index], second[index]])
        advance = port.start(state)
        return lambda: advance(case.span / steps, steps)[0][: case.dimension]

    second = case.velocity
    if formulation.momenta:
        second = np.zeros_like(case.q) if case.momenta is None else case.momenta
    for factor in FACTORS[:: 8 if quick else 1]:
        steps = max(1, round(case.span / case.step * factor))
        yield Contender(
            method="IRKGL16 (port)",
            setting=f"h={case.span / steps:.4g}",
            options=port.title,
            compile_seconds=seconds,
            prepare=partial(prepare, steps),
            momenta=case.momenta if formulation.momenta else None,
            starts=len(case.q),
        )
