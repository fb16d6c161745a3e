"""The pendulum with three points: equations derived by the compiler, and by hand for comparison; their page.

By hand means: the generating function is formed in SymPy from the interpolant and the nodes, without any table of the
compiler.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import sympy

from scvi_codegen.derivation.equations import StepEquations, derive
from scvi_codegen.derivation.notation import Equation
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods import SCVI, SVI
from scvi_codegen.reproduce.laboratory.experiment import Block, Formula, Listing, Paragraph

QUADRATURE = "gauss-legendre:2"
h, q_k, p_k, Q_1, Q_2, v_0, lambda_1, lambda_2 = sympy.symbols("h q_k p_k Q_1 Q_2 v_0 lambda_1 lambda_2", real=True)
tau = sympy.Symbol("tau", real=True)


PENDULUM = LagrangianSystem.from_text(
    name="planar pendulum", coordinates=["q"], lagrangian="q_dot**2/2 + cos(q)", parameters={}
)


@lru_cache(maxsize=2)
def compiled(variational: bool) -> StepEquations:
    """Return the compiler's equations of one step, SCVI(2) with two Gauss points, for L = q_dot^2/2 + cos(q)."""
    return derive(PENDULUM, SCVI(2, QUADRATURE, variational=variational), radicals=True)


def two_points_agree() -> bool:
    """Return True if the printed (34d), (34e) with two points equal (27a), (27c) of SVI, derivatives of L_d."""
    shooting = derive(PENDULUM, SCVI(1, QUADRATURE, variational=False))
    galerkin = derive(PENDULUM, SVI(1, QUADRATURE))
    return all(
        sympy.expand(one.residual - other.residual) == 0
        for one, other in zip(shooting.idel_equations, galerkin.idel_equations, strict=True)
    )


@dataclass(frozen=True, slots=True)
class ByHand:
    """Quantities of one step derived by hand.

    Attributes:
        curve: q(tau).
        velocities, accelerations: V_i and Acc_i at the nodes 1 and 2.
        residuals: E_i.
        action: L_d(q_k, Q_1, Q_2).
    """

    curve: sympy.Expr
    velocities: tuple[sympy.Expr, sympy.Expr]
    accelerations: tuple[sympy.Expr, sympy.Expr]
    residuals: tuple[sympy.Expr, sympy.Expr]
    action: sympy.Expr

    @property
    def generator(self) -> sympy.Expr:
        """Generating function G = L_d + lambda . E."""
        return self.action + lambda_1 * self.residuals[0] + lambda_2 * self.residuals[1]


@lru_cache(maxsize=1)
def by_hand() -> ByHand:
    """Return one step on the nodes -1, 0, 1: derivatives of the parabola through three values, applied twice."""
    curve = tau * (tau - 1) / 2 * q_k + (1 - tau**2) * Q_1 + tau * (tau + 1) / 2 * Q_2
    velocities = _partials(q_k, Q_1, Q_2)
    accelerations = _partials(v_0, *velocities)
    action = sum(
        h / 2 * ((2 / h * curve.diff(tau)) ** 2 / 2 + sympy.cos(curve)).subs(tau, point)
        for point in (-1 / sympy.sqrt(3), 1 / sympy.sqrt(3))
    )
    residuals = tuple(a + sympy.sin(Q) for a, Q in zip(accelerations, (Q_1, Q_2), strict=True))
    return ByHand(curve, velocities, accelerations, residuals, action)


def _partials(start: sympy.Expr, middle: sympy.Expr, end: sympy.Expr) -> tuple[sympy.Expr, sympy.Expr]:
    return (end - start) / h, (start - 4 * middle + 3 * end) / h


def largest_difference() -> float:
    """Return the largest difference of the compiler's variational equations and the derivatives of G by hand."""
    generator, derived = by_hand().generator, compiled(variational=True)
    expected = {
        "34d": p_k + generator.diff(q_k),
        "dG/dQ": generator.diff(Q_1),
        "dG/dv0": generator.diff(v_0),
        "34e": generator.diff(Q_2),
    }
    rows = [(e.number, e.residual) for e in (*derived.equations, *derived.end_momentum) if e.number in expected]
    return max(abs(float((row - expected[number]).xreplace(state))) for number, row in rows for state in _states())


def _states() -> list[dict[sympy.Symbol, sympy.Expr]]:
    symbols = (h, q_k, p_k, Q_1, Q_2, v_0, lambda_1, lambda_2)
    return [{s: sympy.Float((i * k + 3) % 7 - 2.5) / 2 for i, s in enumerate(symbols)} for k in (2, 3, 5)]


def eliminated() -> dict[sympy.Symbol, sympy.Expr]:
    """Return the multipliers from the compiler's rows dG/dQ and dG/dv0, with X for dL_d/dQ_1."""
    derived = compiled(variational=True)
    rows = {e.number: e.residual for e in derived.equations if e.kind == "multiplier"}
    free = dict.fromkeys((lambda_1, lambda_2), 0)
    inner = rows["dG/dQ"].subs(free)
    equations = [rows["dG/dQ"] - inner + sympy.Symbol("X", real=True), rows["dG/dv0"]]
    result: dict[sympy.Symbol, sympy.Expr] = sympy.solve(equations, [lambda_1, lambda_2], dict=True)[0]
    return {symbol: _positive(value) for symbol, value in result.items()}


def _positive(fraction: sympy.Expr) -> sympy.Expr:
    """Return a fraction with a denominator whose constant term is positive."""
    numerator, denominator = sympy.fraction(sympy.together(fraction))
    sign = 1 if denominator.subs(h, 0) > 0 else -1
    return sympy.expand(sign * numerator) / sympy.expand(sign * denominator)


def missing_terms() -> tuple[sympy.Expr, sympy.Expr]:
    """Return the terms of the compiler's variational (34d) and (34e) that the printed ones lack."""
    full, printed = compiled(variational=True), compiled(variational=False)

    def row(derived: StepEquations) -> sympy.Expr:
        return next(e.residual for e in derived.equations if e.number == "34d")

    start = sympy.expand(row(full) - row(printed))
    end = sympy.expand(full.end_momentum[0].residual - printed.end_momentum[0].residual)
    return start, end


@dataclass(frozen=True, slots=True)
class MiddleValue:
    """Inner value Q_1 as a function of both ends, which requires no multipliers here.

    Attributes:
        condition: h^2 times the sum of the two collocation equations, in which v_0 cancels; it is 0.
        derivatives: dQ_1/dq_k and dQ_1/dQ_2, by implicit differentiation of the condition.
        inner: X = dL_d/dQ_1 from the compiler, simplified with the condition.
        leading: its leading term for small h, with position q and velocity v.
    """

    condition: sympy.Expr
    derivatives: tuple[sympy.Expr, sympy.Expr]
    inner: sympy.Expr
    leading: sympy.Expr


@lru_cache(maxsize=1)
def middle_value() -> MiddleValue:
    """Return the inner value from the compiler's rows (34a) and dG/dQ."""
    derived = compiled(variational=True)
    condition = sympy.expand(h**2 * sum(e.residual for e in derived.equations if e.number == "34a"))
    after_middle = condition.diff(Q_1)
    derivatives = tuple(condition.diff(end) / sympy.expand(-after_middle) for end in (q_k, Q_2))
    row = next(e.residual for e in derived.equations if e.number == "dG/dQ")
    inner = sympy.expand(row.subs(dict.fromkeys((lambda_1, lambda_2), 0)) + condition / (3 * h))
    q, v = sympy.symbols("q v", real=True)
    moving = inner.subs({Q_1: q + h * v / 2, Q_2: q + h * v, q_k: q})
    leading = sympy.simplify(sympy.series(moving, h, 0, 3).removeO())
    return MiddleValue(condition, derivatives, inner, leading)


def multipliers_agree() -> bool:
    """Return True if the multipliers' terms are X dQ_1/dq_k and X dQ_1/dQ_2, the chain rule."""
    X, multipliers = sympy.Symbol("X", real=True), eliminated()
    return all(
        sympy.simplify(lost.subs(multipliers) - X * derivative) == 0
        for lost, derivative in zip(missing_terms(), middle_value().derivatives, strict=True)
    )


X = sympy.Symbol("X", real=True)


def body() -> tuple[Block, ...]:
    """Return all blocks of the page."""
    return (
        Paragraph(
            "The documentation (theory, shooting-based variational integrators) derives the term that (34d) and (34e) "
            "lack, what its absence costs, and the multipliers that supply it. Here is the smallest example."
        ),
        *_example(),
        *_example_corrected(),
        *_example_compiled(),
    )


def _after(expression: sympy.Expr, symbol: sympy.Symbol) -> sympy.Derivative:
    return sympy.Derivative(expression, symbol, evaluate=False)


def _equation(equation: Equation, left: sympy.Expr | None = None) -> Formula:
    return Formula(equation.residual, sympy.Integer(0) if left is None else left, equation.number)


def _example() -> tuple[Block, ...]:
    printed, hand = compiled(variational=False), by_hand()
    end_q, end_p = sympy.symbols("q_k+1 p_k+1", real=True)
    return (
        Paragraph(
            "1. The pendulum, L = q_dot^2/2 + cos(q), with three Chebyshev points (degree 2; the "
            "nodes are the beginning q_k, the middle Q_1 and the end Q_2 of the step) and two Gauss points. The curve "
            "is a parabola,"
        ),
        Formula(hand.curve, sympy.Function("q")(tau)),
        Paragraph("its derivatives at the middle and at the end are V = A Q + a0 q_k, and these give Acc:"),
        *(Formula(v, sympy.Symbol(f"V_{i}")) for i, v in enumerate(hand.velocities, 1)),
        *(Formula(sympy.expand(a), sympy.Symbol(f"Acc_{i}")) for i, a in enumerate(hand.accelerations, 1)),
        Paragraph("From the Lagrangian alone the compiler derives, as printed in the paper:"),
        *(_equation(equation) for equation in printed.equations),
        _equation(printed.end_position[0], end_q),
        _equation(printed.end_momentum[0], end_p),
        Paragraph(
            "Here v_0 can be eliminated by hand: the sum of both collocation equations does not contain it. It is the "
            "equation that makes Q_1 a function of the ends,"
        ),
        Formula(middle_value().condition, sympy.Integer(0)),
        *(
            Formula(derivative, _after(sympy.Function("Q_1")(*_ends()), end))
            for derivative, end in zip(middle_value().derivatives, _ends(), strict=True)
        ),
        Paragraph(
            "For small h both are 1/2: move an end of the step, and the middle moves half as far. The printed "
            "equations hold it fixed. What is lost is X = dL_d/dQ_1 times this; with the condition above X is"
        ),
        Formula(middle_value().inner, X),
        Paragraph(
            "which compares the force at the collocation nodes with the force at the Gauss points. They sit at "
            "different times, a quarter of a step apart on average, so that along a motion with position q and "
            "velocity v, for small h,"
        ),
        Formula(middle_value().leading, X),
        Paragraph("h^s with s = 2: each step misses half of it at either end, and the order is 1."),
    )


def _ends() -> tuple[sympy.Symbol, sympy.Symbol]:
    return sympy.Symbol("q_k", real=True), sympy.Symbol("Q_2", real=True)


def _example_corrected() -> tuple[Block, ...]:
    derived = compiled(variational=True)
    rows = {equation.number: equation for equation in derived.equations}
    start, end = missing_terms()
    return (
        Paragraph(
            "2. The same in variational form. The compiler adds the unknowns lambda_1, lambda_2 and two equations, "
            "which say that G is stationary in Q_1 and v_0:"
        ),
        _equation(rows["dG/dQ"]),
        _equation(rows["dG/dv0"]),
        Paragraph(
            "The collocation equations (34a) and (34c) stay. To (34d) and (34e) it adds, compared with the above,"
        ),
        Formula(start, sympy.Symbol("added_34d")),
        Formula(end, sympy.Symbol("added_34e")),
        Paragraph("Solved for the multipliers, the two equations say"),
        *(Formula(value, symbol) for symbol, value in eliminated().items()),
        Paragraph(
            "and with these the added terms are X dQ_1/dq_k and X dQ_1/dQ_2 of the previous section, to the letter: "
            "the multipliers have done the chain rule without solving for Q_1."
        ),
    )


def _example_compiled() -> tuple[Block, ...]:
    return (
        Paragraph("3. All of the compiler's output, as `scvi-codegen derive` prints it. As printed in the paper:"),
        Listing(compiled(variational=False).to_text()),
        Paragraph("In variational form:"),
        Listing(compiled(variational=True).to_text()),
    )
