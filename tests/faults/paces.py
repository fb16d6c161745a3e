"""Faults of transformed time, and of what chooses the length of steps."""

from dataclasses import replace

from certified_cases import CONTROLLED, REVERSIBLE, case
from faults import function, here, text
from sabotage import changed_result

from scvi_codegen.lowering import derivatives as lowered_derivatives
from scvi_codegen.runtime.core.integrator import Integrator

TO_NINE_DIGITS = replace(CONTROLLED, tolerance=1e-9)

STEP_SIZE_FAULTS = (
    text(
        "a clock that is fast",
        case("slowed/svi-3"),
        r"\? sum\[0\] :",
        "? sum[0] * 1.00000001 :",
        within="step_duration",
    ),
    text("a time that is met to eight digits", case("slowed/svi-3"), r"\(4 \* REAL_EPSILON\)", "1e-8"),
    function(
        "transformed time at another energy",
        case("slowed/svi-3"),
        Integrator,
        "_parameters_at",
        lambda original: lambda self, q, p, parameters=None: original(self, q, 1.01 * p, parameters),
    ),
    text(
        "time held where h changes",
        case("slowed/svi-3"),
        r"propagate\(back, time, weight \* rate, at->v \+ INPUT_H\);",
        "",
        within="end_time",
    ),
    text(
        "the derivatives of the rate of time without the length of the step",
        case("slowed/svi-3"),
        r"step->h \* weight \* derivative\[e\]",
        "weight * derivative[e]",
        within="end_time",
    ),
    text(
        "time that has no derivatives by positions on the way back",
        case("slowed/svi-3"),
        r"\n  if \(back\)\n    arguments_wide",
        "\n  if (0)\n    arguments_wide",
        within="end_time",
    ),
    here(
        "the energy of the start that falls with the momentum",
        case("slowed/svi-3"),
        lowered_derivatives,
        "_energy_derivatives",
        changed_result(
            lambda kernel: replace(kernel, results=(*kernel.results[:2], *kernel.results[:1], *kernel.results[3:]))
        ),
    ),
    text("a step allowed ten thousand times the error", TO_NINE_DIGITS, r"\(tolerance, 1 /", "(1e4 * tolerance, 1 /"),
    text("stages of chosen steps not solved", TO_NINE_DIGITS, r"REAL\(0.00390625\)", "REAL(1e10)"),
    text(
        "time that runs ahead of chosen steps",
        CONTROLLED,
        r"now->at\.t_low, h, 0\);",
        "now->at.t_low, h * (1 + 1e-10), 0);",
    ),
    text(
        "time that runs ahead of the steps of a time transformation",
        REVERSIBLE,
        r"now->at\.t_low, now->step\.h, 0\);",
        "now->at.t_low, now->step.h * (1 + 1e-10), 0);",
    ),
    text("a density that is forgotten", REVERSIBLE, r"run->density = now->density;", "run->density = 0;"),
    text(
        "half of the growth of the density", REVERSIBLE, r"1 - run->part : 1 \+ run->part", "1 - run->part : run->part"
    ),
    text("a turn that is not seen", REVERSIBLE, r"now->turned = \(real\)run->direction.*;", "now->turned = 0;"),
)
