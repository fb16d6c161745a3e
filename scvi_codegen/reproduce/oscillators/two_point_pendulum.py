"""Section 4.3.1: the two-point SCVI of the planar pendulum, derived and compared with the paper's (36) and (37)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import sympy
from sympy import Symbol, cos, sin, sqrt

from scvi_codegen.derivation.equations import StepEquations, derive
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.shooting import SCVI
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Listing,
    Paragraph,
    Result,
    TableBlock,
    experiment,
    holds,
)
from scvi_codegen.reproduce.laboratory.running import ROUNDOFF, stepper_of
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.tables.closed_forms import exact_points, exact_rule
from scvi_codegen.tables.nodes import chebyshev_lobatto
from scvi_codegen.tables.quadrature import gauss_legendre

QUADRATURE = "gauss-legendre:2"
METHOD = SCVI(1, QUADRATURE)
STATES = ((0.5, 0.0, 0.005), (0.5, 0.0, 0.1), (1.2, -0.7, 0.3), (-2.0, 0.9, 0.5), (3.0, 0.1, 1.0))
"""States and step sizes (q_k, p_k, h) of the numerical check; the first is the paper's."""

SMALL = 1e-14

q, p, h, v, new = (Symbol(name, real=True) for name in ("q_k", "p_k", "h", "v_k", "q_k+1"))
rate, acceleration, angle = Symbol("q\u0307"), Symbol("q\u0308"), Symbol("q")
tau = Symbol("tau")


@lru_cache(maxsize=1)
def pendulum() -> LagrangianSystem:
    """Return the pendulum with m = l = g = 1."""
    return LagrangianSystem.from_text(
        name="planar pendulum of unit mass and length",
        coordinates=["q"],
        lagrangian="q_dot**2/2 + cos(q)",
        parameters={},
    )


@dataclass(frozen=True, slots=True)
class Scheme:
    """Two-point scheme as derived: residuals of (36) and (37), and of the new momentum."""

    stage: sympy.Expr
    momentum: sympy.Expr
    end: sympy.Expr


@lru_cache(maxsize=1)
def _derived() -> StepEquations:
    return derive(pendulum(), METHOD, radicals=True)


@lru_cache(maxsize=1)
def derived_scheme() -> Scheme:
    """Return the scheme from the general derivation, with the paper's names."""
    derived = _derived()
    names = dict(
        zip((*derived.unknowns, *derived.state[0], *derived.state[1], derived.step), (new, v, q, p, h), strict=True)
    )
    stage, momentum = (equation.residual.xreplace(names) for equation in derived.equations)
    end = derived.end_momentum[0].residual.xreplace(names)
    return Scheme(stage, momentum, end)


def printed_36() -> sympy.Expr:
    """Return left minus right side of (36)."""
    return new / h**2 - (-sin(new) + v / h + q / h**2)


def printed_g() -> sympy.Expr:
    """Return G_k of section 4.3.1."""
    first, second = (3 + sqrt(3)) / 6, (3 - sqrt(3)) / 6
    return -(3 + sqrt(3)) * h / 12 * sin(first * q + second * new) - (3 - sqrt(3)) * h / 12 * sin(
        second * q + first * new
    )


def printed_37() -> sympy.Expr:
    """Return (37), with the matrix entries A_k = -1/h and A1_k = 1/h of the paper."""
    return -new / h + q / h + printed_g() + p


def action() -> sympy.Expr:
    """Return L_d(q_k, q_{k+1}) of (33), formed here from the nodes and the quadrature rule."""
    points, weights = exact_rule(gauss_legendre(2)) or ((), ())
    curve = cardinals()[0] * q + cardinals()[1] * new
    lagrangian = (2 / h * sympy.diff(curve, tau)) ** 2 / 2 + cos(curve)
    return h / 2 * sum(weight * lagrangian.subs(tau, point) for point, weight in zip(points, weights, strict=True))


def cardinals() -> tuple[sympy.Expr, ...]:
    """Return l_0, l_1 on the nodes -1, 1."""
    left, right = exact_points(chebyshev_lobatto(1)) or ()
    return (tau - right) / (left - right), (tau - left) / (right - left)


@experiment("section-4.3", "The two-point SCVI of the planar pendulum")
def section_4_3(results: Mapping[str, Result]) -> Result:
    """Return derivation, comparison, and a numerical check."""
    scheme = derived_scheme()
    rows = [_row(stepper_of(pendulum(), METHOD), *state) for state in STATES]
    return Result(
        setting=(
            "m = l = g = 1, nodes -1 and 1, two Gauss points: the general derivation of SCVI, written with the names "
            "of section 4.3.1.",
            "Formulas are compared by exact algebra; then steps of the compiled integrator are put into them.",
        ),
        checks=(*_symbolic_checks(scheme), *_correction_checks(), _numerical_check(rows)),
        tables=(
            TableBlock(
                columns=(
                    "q_k",
                    "p_k",
                    "h",
                    "q_(k+1)",
                    "p_(k+1)",
                    "v_k",
                    "residual of (37)",
                    "error of p_(k+1)",
                    "SVI - SCVI",
                ),
                rows=tuple(rows),
                formats={"q_(k+1)": ".15f", "p_(k+1)": ".15f", "v_k": ".15f", "residual of (37)": ".1e"}
                | {"error of p_(k+1)": ".1e", "SVI - SCVI": ".1e"},
            ),
        ),
        body=(Paragraph("The derivation by the compiler:"), Listing(_derived().to_text())),
    )


def _row(stepper: Stepper, *state: float) -> tuple[float, ...]:
    """Return a compiled step substituted into the printed formulas; v_k from (36)."""
    at_q, at_p, step = state
    q1, p1 = (float(x[0]) for x in stepper.step([at_q], [at_p], step, options=ROUNDOFF))
    other = stepper_of(pendulum(), SVI(1, QUADRATURE)).step([at_q], [at_p], step, options=ROUNDOFF)
    values = {q: at_q, p: at_p, h: step, new: q1}
    speed = sympy.solve(printed_36(), v)[0].evalf(20, subs=values)
    residual = step * printed_37().evalf(20, subs=values)
    end = sympy.diff(action(), new).evalf(20, subs=values) - p1
    difference = max(abs(float(other[0][0]) - q1), abs(float(other[1][0]) - p1))
    return (*state, q1, p1, float(speed), float(residual), float(end), difference)


def _vanishes(expression: sympy.Expr) -> bool:
    """Return True if an expression is 0 by expansion, also inside sines and cosines (coefficients in Q(sqrt(3)))."""
    return bool(sympy.expand(expression) == 0)


def _symbolic_checks(scheme: Scheme) -> Iterator[Comparison]:
    for number, result, printed, claim in (
        ("36", scheme.stage, printed_36(), "(34a) has the form (36)"),
        ("37", scheme.momentum, printed_37(), "(34d) can be rewritten as (37)"),
    ):
        same = _vanishes(result - printed)
        yield Comparison(
            claim=f"For two points {claim}.",
            measured=f"The difference of the derived and the printed ({number}) "
            + ("simplifies to 0." if same else f"is {sympy.simplify(result - printed)}."),
            verdict=holds(same),
        )
    start, end = (
        _vanishes(e) for e in (p + sympy.diff(action(), q) - scheme.momentum, sympy.diff(action(), new) - scheme.end)
    )
    yield Comparison(
        claim="The scheme is symplectic.",
        measured=f"With L_d of (33), p_k = -dL_d/dq_k {'is' if start else 'is not'} (37) and p_(k+1) = dL_d/dq_(k+1) "
        f"{'is' if end else 'is not'} (34e): "
        + ("L_d generates the step, which is symplectic." if start and end else "L_d does not generate the step."),
        verdict=holds(start and end),
        bears_on=("scvi-structure",),
    )


def _correction_checks() -> Iterator[Comparison]:
    points, weights = exact_rule(gauss_legendre(2)) or ((), ())
    listed = ", ".join(map(str, weights))
    yield Comparison(
        claim="The two-point Gauss formula has w = +-1 and tau = +-1/sqrt(3).",
        measured=f"The points are {', '.join(map(str, points))}; the weights are {listed}, and so they are in the "
        "paper's A_k, G_k and (37).",
        verdict=holds(sorted(weights) == [-1, 1]),
    )
    left = q / h - new / h - printed_g()
    rest = sympy.expand(left - printed_37() + 2 * printed_g())
    corrected = _vanishes(left + 2 * printed_g() + p - printed_37())
    yield Comparison(
        claim="(27a) in matrix form is A~Q~ = G, (28).",
        measured=f"With the printed entries A~Q~ - G differs from (37) by {rest} - 2 G; "
        f"A~Q~ = -G - (p_k, 0, .., 0)^T {'is' if corrected else 'is not'} (37).",
        verdict=holds(_vanishes(left - printed_37())),
    )


def _numerical_check(rows: Sequence[Sequence[float]]) -> Comparison:
    residual, end, difference = (max(abs(row[i]) for row in rows) for i in (-3, -2, -1))
    return Comparison(
        claim="q_(k+1) and v_k follow from (36), (37), then p_(k+1) from (34e).",
        measured=f"{len(rows)} steps of the compiled integrator, h from {rows[0][2]} to {rows[-1][2]}: h times the "
        f"residual of (37) at most {residual:.1e}, error of p_(k+1) at most {end:.1e}; SVI of degree 1 gives the same "
        f"step to {difference:.1e}.",
        verdict=holds(max(residual, end, difference) < SMALL),
    )
