"""Text of the experiment ``correction``: why (34d) needs the chain-rule term, for the pendulum with three points."""

from __future__ import annotations

import sympy

from scvi_codegen.derivation.notation import Equation
from scvi_codegen.reproduce.correction.example import (
    by_hand,
    compiled,
    eliminated,
    middle_value,
    missing_terms,
)
from scvi_codegen.reproduce.laboratory.experiment import Block, Formula, Listing, Paragraph

X, tau = sympy.symbols("X tau", real=True)


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
        Paragraph("its slopes at the middle and at the end are the velocities V = A Q + a0 q_k, and these give Acc:"),
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
