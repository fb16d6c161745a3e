"""Text of the experiment ``correction``: why (34d) needs the chain-rule term, in general and for the pendulum."""

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

q_0, q_1, Q, p_0, p_1, J_0, J_1, X, tau = sympy.symbols("q_0 q_1 Q p_0 p_1 J_0 J_1 X tau", real=True)
G, L_d, xi, inner = sympy.Function("G"), sympy.Function("L_d"), sympy.Function("xi"), sympy.Function("Q")
BIG_O = sympy.Function("O")
"""Unevaluated O(.); SymPy's own would simplify."""
ENDS = G(q_0, q_1)
ACTION = L_d(q_0, Q, q_1)
INNER = inner(q_0, q_1)


def body() -> tuple[Block, ...]:
    """Return all blocks of the page."""
    return (
        *_generating_function(),
        *_chain_rule(),
        *_multipliers(),
        *_consequences(),
        *_example(),
        *_example_corrected(),
        *_example_compiled(),
    )


def _after(expression: sympy.Expr, symbol: sympy.Symbol) -> sympy.Derivative:
    return sympy.Derivative(expression, symbol, evaluate=False)


def _generating_function() -> tuple[Block, ...]:
    return (
        Paragraph(
            "1. What makes an integrator variational. Take any function G(q_0, q_1) of the two ends of a step and "
            "define the momenta by its derivatives, the implicit discrete Euler-Lagrange equations:"
        ),
        Formula(-_after(ENDS, q_0), p_0, "5"),
        Formula(_after(ENDS, q_1), p_1, "5"),
        Paragraph(
            "Then dG = p_1 dq_1 - p_0 dq_0, and because the derivative of a derivative vanishes, d(dG) = 0, the area "
            "dq_1 ^ dp_1 equals dq_0 ^ dp_0: the map (q_0, p_0) -> (q_1, p_1) is symplectic, whatever G is. If G does "
            "not change when a symmetry moves both ends, the momentum of that symmetry is the same at both ends. Both "
            "statements are about the derivatives of the number G(q_0, q_1), that is, about total derivatives: all "
            "that depends on the ends takes part."
        ),
    )


def _chain_rule() -> tuple[Block, ...]:
    i, g = sympy.symbols("i g", integer=True, positive=True)
    w, times, h = sympy.IndexedBase("w"), sympy.IndexedBase("tau"), sympy.Symbol("h")
    L, q, speed = sympy.Function("L"), sympy.Function("q"), sympy.Function("v")
    quadrature = h / 2 * sympy.Sum(w[i] * L(q(times[i]), speed(times[i])), (i, 1, g))
    total = _after(ACTION, q_0) + _after(ACTION, Q) * _after(INNER, q_0)
    return (
        Paragraph(
            "2. What the paper differentiates. The discrete Lagrangian (33) is a quadrature along the polynomial "
            "through the node values q_0, Q, q_1, where Q stands for the inner ones, Q^1 to Q^(s-1). Written out it is "
            "a function of all of them (v is the velocity of the polynomial):"
        ),
        Formula(quadrature, ACTION, "33"),
        Paragraph(
            "But it is a discrete Lagrangian, a function of the ends, only because the inner values follow from the "
            "ends. That function is"
        ),
        Formula(L_d(q_0, INNER, q_1), ENDS),
        Paragraph("and its derivative has two terms:"),
        Formula(total, _after(ENDS, q_0)),
        Paragraph(
            "The paper's (34d) is minus the first term, its (34e) the like at the other end. In a Galerkin method "
            "(SVI) this is right: (26a) chooses the inner values so that the derivative of L_d with respect to Q is "
            "zero, and the second term is gone. In the shooting method (SCVI) the inner values solve other equations, "
            "the collocation equations E = 0 of (34a). There that derivative is small but not zero, and with it the "
            "second term."
        ),
        Paragraph(
            "With two points, degree 1, there is no inner value. Collocation then determines the initial velocity v_0 "
            "only, which does not occur in L_d; the second term is empty and (34d), (34e) are complete. This is the "
            "one case that section 4.3 works out and that Figs. 21 to 26 show, and there the method is what the paper "
            "says."
        ),
    )


def _multipliers() -> tuple[Block, ...]:
    k, m = sympy.symbols("k m", integer=True, positive=True)
    E_y, E_0 = sympy.MatrixSymbol("E_y", k, k), sympy.MatrixSymbol("E_q0", k, m)
    lam, y_0 = sympy.MatrixSymbol("lambda", k, 1), sympy.MatrixSymbol("y_q0", k, m)
    L_y, L_0, G_0 = (sympy.MatrixSymbol(name, size, 1) for name, size in (("L_y", k), ("L_q0", m), ("G_q0", m)))
    E = sympy.MatrixSymbol("E", k, 1)
    return (
        Paragraph(
            "3. How to have the second term without solving for Q. Let y be all that is determined inside the step, "
            "the velocity v_0 and the inner values Q: with m degrees of freedom and degree s these are k = s m "
            "numbers, as many as collocation equations. Subscripts denote derivatives: E_y is the square matrix of "
            "those of E with respect to y, E_q0 that with respect to q_0, and y_q0 belongs to y as a function of q_0. "
            "Differentiating E(q_0, y(q_0, q_1), q_1) = 0 gives"
        ),
        Formula(-E_0, E_y * y_0),
        Paragraph("Introduce one multiplier for each collocation equation and extend the function:"),
        Formula(sympy.MatAdd(sympy.MatrixSymbol("L_d", 1, 1), lam.T * E), sympy.MatrixSymbol("G", 1, 1)),
        Paragraph(
            "Its derivative with respect to lambda returns the collocation equations. Let its derivative with respect "
            "to y vanish too; these are the multiplier equations, linear in lambda:"
        ),
        Formula(-L_y, E_y.T * lam),
        Paragraph(
            "Then the derivative of G with respect to q_0, y and lambda held fixed, is already the total one. For the "
            "term that (34d) lacks is the transpose of y_q0 times L_y, which is minus the transpose of E_y y_q0 times "
            "lambda, which is the transpose of E_q0 times lambda:"
        ),
        Formula(L_0 + y_0.T * L_y, G_0),
        Formula(L_0 + E_0.T * lam, G_0),
        Paragraph(
            "So the corrected method has the unknowns (v_0, Q^1 .. Q^s, lambda_1 .. lambda_s) and says that G is "
            "stationary. Its Newton matrix is the matrix of second derivatives of G, from one symbolic source. This is "
            "what SCVI(degree) compiles; SCVI(degree, variational=False) compiles what is printed."
        ),
    )


def _consequences() -> tuple[Block, ...]:
    lost = -_after(ACTION, Q)
    powers = sympy.symbols("h s")
    invariance = _after(ACTION, q_0) * xi(q_0) + _after(ACTION, Q) * xi(Q) + _after(ACTION, q_1) * xi(q_1)
    return (
        Paragraph(
            "4. What the missing term costs. Symplecticity: with the printed momenta p_1 dq_1 - p_0 dq_0 is dG less "
            "the inner derivative dL_d/dQ times dQ. The first part has no curl, the second has: dq_1 ^ dp_1 and dq_0 ^ "
            "dp_0 differ by the exterior product of d(dL_d/dQ) and dQ, which is of the size of the missing term."
        ),
        Paragraph(
            "Momentum: let xi be the field by which a symmetry moves the points. L_d, seen as a function of all node "
            "values, is invariant when all of them move:"
        ),
        Formula(invariance, sympy.Integer(0)),
        Paragraph(
            "With the printed momenta the first term is -J_0 and the last J_1, where J_0 = p_0 xi(q_0) and J_1 = p_1 "
            "xi(q_1), so each step changes the momentum by"
        ),
        Formula(lost * xi(Q), J_1 - J_0),
        Paragraph(
            "In the corrected form the multiplier terms cancel just this, because the collocation equations move along "
            "with the symmetry."
        ),
        Paragraph(
            "Order: the derivative of L_d with respect to an inner value is, integrated by parts, the Euler-Lagrange "
            "residual of the polynomial, weighted and integrated over the step. The polynomial has velocities correct "
            "to order h^s at best and accelerations to order h^(s-1), one less for each derivative; its residual is of "
            "that size, and the integral over a step of length h adds one power. The missing momentum of each step, "
            "and after a fixed time the error e, are therefore"
        ),
        Formula(BIG_O(powers[0] ** powers[1]), _after(ACTION, Q)),
        Formula(BIG_O(powers[0] ** (powers[1] - 1)), sympy.Symbol("e_printed")),
        Paragraph(
            "This is even below the order of the collocation method itself. In full, nothing of this counts: the exact "
            "curve makes the action stationary, so the error of L_d is quadratic in that of the curve, h times "
            "(h^s)^2, and the order of the method is one less than that of L_d, that is 2s, if the quadrature (of "
            "order 2g with g Gauss points) is as good. Theorem 4.1 states the lower min(s, 2g); the corrected method "
            "does better than promised, the printed one worse:"
        ),
        Formula(
            BIG_O(powers[0] ** sympy.Min(2 * powers[1], 2 * sympy.Symbol("g"))),
            sympy.Symbol("e_full"),
        ),
    )


def _equation(equation: Equation, left: sympy.Expr | None = None) -> Formula:
    return Formula(equation.residual, sympy.Integer(0) if left is None else left, equation.number)


def _example() -> tuple[Block, ...]:
    printed, hand = compiled(variational=False), by_hand()
    end_q, end_p = sympy.symbols("q_k+1 p_k+1", real=True)
    return (
        Paragraph(
            "5. The smallest example: the pendulum, L = q_dot^2/2 + cos(q), with three Chebyshev points (degree 2; the "
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
        Paragraph("h^s with s = 2, as said: each step misses half of it at either end, and the order is 1."),
    )


def _ends() -> tuple[sympy.Symbol, sympy.Symbol]:
    return sympy.Symbol("q_k", real=True), sympy.Symbol("Q_2", real=True)


def _example_corrected() -> tuple[Block, ...]:
    derived = compiled(variational=True)
    rows = {equation.number: equation for equation in derived.equations}
    start, end = missing_terms()
    return (
        Paragraph(
            "6. The same in variational form. The compiler adds the unknowns lambda_1, lambda_2 and two equations, "
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
        Paragraph("7. All of the compiler's output, as `scvi-codegen derive` prints it. As printed in the paper:"),
        Listing(compiled(variational=False).to_text()),
        Paragraph("In variational form:"),
        Listing(compiled(variational=True).to_text()),
    )
