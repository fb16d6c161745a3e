"""Tables 5 and 10: the paper's algorithms and the outline of the C generated for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.shooting import SCVI
from scvi_codegen.models.systems import planar_pendulum
from scvi_codegen.pipeline import generate_source
from scvi_codegen.rendering.outline import Function, functions_of, outline
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Listing,
    Paragraph,
    Result,
    TableBlock,
    experiment,
    holds,
)

DEGREE = 4
PREFIX = "pendulum"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Step of an algorithm and its counterpart in the C source.

    Attributes:
        number: number of the step.
        text: text of the paper.
        counterpart: description of its implementation, in a sentence.
        evidence: fragments of source that must occur, by the function that contains them; ``""`` for the whole source.
    """

    number: int
    text: str
    counterpart: str
    evidence: Mapping[str, tuple[str, ...]]


POINTS = Step(
    number=1,
    text="choose the number of collocation points s + 1 and quadrature formula (w_i, tau_i)",
    counterpart="An argument of the generator; the C text has the weights as a table.",
    evidence={"": (f"QUADRATURE_WEIGHT[{DEGREE}]", f"/* Quadrature: {DEGREE} points.")},
)
ROOT = Step(
    number=5,
    text="update by performing a nonlinear rootfinding iteration, until max(|dQ|, |dP|) < TOL",
    counterpart="newton solves with pivoted LU factors and stops when neither stages nor end momentum move by more "
    "than the tolerance.",
    evidence={
        "newton": (
            "linearise(",
            "apply_update(",
            "measure(&moved, change, size_p)",
            "has_converged(",
            "max_iterations",
        ),
        "has_converged": ("moved->absolute < options->tolerance",),
    },
)
END = Step(
    number=6,
    text="compute (q_(k+1), p_(k+1))",
    counterpart="q_(k+1) - q_k is the sum END_POSITION of the stages, p_(k+1) - p_k the last row of the equations.",
    evidence={"solve": ("gather(END_POSITION", "dp"), "newton": ("increment[i] = data->rows[i * (B + 1) + B]",)},
)
REPEAT = Step(
    number=7,
    text="k <- k + 1, repeat STEP3 to STEP6",
    counterpart="The loop of advance, which adds the increments with compensated sums.",
    evidence={
        f"{PREFIX}_advance": ("for (long long k = 0; k < steps; k++)", "solve(", "add_compensated(", "run->step++")
    },
)
LINE = "newton_from_line"
GUESSES = {
    "solve": ("guess_from(", LINE),
    "guess_from": ("gather(EXTRAPOLATION",),
    LINE: ("line_from(",),
    "line_from": (f"{PREFIX}_velocity(", "start_on_line("),
}

SVI_STEPS = (
    POINTS,
    Step(
        number=2,
        text="compute matrix A_k, k = 0, .., N - 1",
        counterpart="It does not depend on k: tables of cardinal functions at the quadrature points, computed in 60 "
        "digits when the text is generated.",
        evidence={"": ("QUADRATURE_GATHER_0", "QUADRATURE_GATHER_1", "QUADRATURE_SCATTER_0", "QUADRATURE_SCATTER_1")},
    ),
    Step(
        number=3,
        text="choose an initial guess for the solution at the collocation points Q_k",
        counterpart="The curve of the step before, continued; the straight line where there is none or it fails.",
        evidence=GUESSES,
    ),
    Step(
        number=4,
        text="compute G_k(Q) and its Jacobian",
        counterpart="evaluate sums L_q and L_v, and their symbolic derivatives, over the quadrature points.",
        evidence={
            "evaluate": ("add_quadrature(",),
            "add_quadrature": ("quadrature_value(", "quadrature_slope(", "scatter(", "scatter_derivatives("),
        },
    ),
    ROOT,
    END,
    REPEAT,
)

SCVI_STEPS = (
    POINTS,
    Step(
        number=2,
        text="compute matrix A",
        counterpart="Tables that integrate accelerations at the nodes to velocities and positions, which is what A^-1 "
        "and A^-2 do, computed in 60 digits when the text is generated.",
        evidence={"": ("NODE_GATHER_0", "NODE_GATHER_1", "NODE_GATHER_2")},
    ),
    Step(
        number=3,
        text="choose initial guess of the collocation points Q and v0; a good guess for v0 can be obtained by "
        "inverting the continuous Legendre transformation",
        counterpart="The curve of the step before, continued; the straight line with the velocity that belongs to p_k "
        "where there is none or it fails.",
        evidence=GUESSES,
    ),
    Step(
        number=4,
        text="compute the right hand side of (34a), (34d) and their Jacobians",
        counterpart="evaluate: add_node has the Euler-Lagrange residuals (34a) with their multipliers, add_quadrature "
        "the sums of (34d) and (34e).",
        evidence={
            "evaluate": ("add_quadrature(", "add_node("),
            "add_node": ("node_value(", "node_slope("),
            "add_quadrature": ("quadrature_value(", "quadrature_slope("),
        },
    ),
    ROOT,
    END,
    REPEAT,
)


def _result(method: Method, steps: tuple[Step, ...], remark: tuple[str, ...], _: Mapping[str, Result]) -> Result:
    code = generate_source(planar_pendulum(), method, solver="newton", prefix=PREFIX)[0].amalgamated().code
    functions = functions_of(code)
    missing = {step.number: _missing(step, code, functions) for step in steps}
    result = [number for number, fragments in missing.items() if not fragments]
    lost = "; ".join(f"STEP{number} lacks {', '.join(fragments)}" for number, fragments in missing.items() if fragments)
    return Result(
        setting=(
            f"C generated for the planar pendulum by {method.name}, Newton's method: {len(functions)} functions, "
            f"{len(code.splitlines())} lines.",
            "Unknowns are stage velocities (SVI) or accelerations (SCVI) in place of positions at nodes, which lose "
            "digits in differences when h is small.",
            *remark,
        ),
        checks=(
            Comparison(
                claim=f"The algorithm has the steps STEP1 to STEP{len(steps)}.",
                measured=f"{len(result)} of {len(steps)} steps have their counterpart in the C text"
                + (f"; {lost}." if lost else ", each found by name in the function that has it."),
                verdict=holds(not lost),
            ),
        ),
        tables=(
            TableBlock(
                columns=("step", "paper", "here", "functions", "found"),
                rows=tuple(
                    (
                        step.number,
                        step.text,
                        step.counterpart,
                        ", ".join(filter(None, step.evidence)) or "tables",
                        "no" if missing[step.number] else "yes",
                    )
                    for step in steps
                ),
                formats={"step": "d"},
            ),
        ),
        body=(
            Paragraph("Calls from the loop over the steps down, with the comments of the functions:"),
            Listing(outline(functions, f"{PREFIX}_advance")),
        ),
    )


def _missing(step: Step, code: str, functions: Mapping[str, Function]) -> list[str]:
    """Return the fragments that are not in the function where they should be."""
    return [
        fragment
        for name, fragments in step.evidence.items()
        for fragment in fragments
        if fragment not in (code if not name else functions[name].body if name in functions else "")
    ]


MULTIPLIERS = (
    "The multipliers, unknowns that the paper's algorithm does not have, make the derivative of L_d total: "
    "with them the step is symplectic.",
)
experiment("table-5", "The iterative algorithm of SVI")(partial(_result, SVI(DEGREE), SVI_STEPS, ()))
experiment("table-10", "The iterative algorithm of SCVI")(partial(_result, SCVI(DEGREE), SCVI_STEPS, MULTIPLIERS))
