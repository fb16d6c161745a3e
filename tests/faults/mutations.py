"""Faults for the generator: a certificate that does not catch each of them is worth nothing.

Each is named for what is wrong and has a case in which it makes a difference.
"""

from dataclasses import replace

import sympy
from beside import PARTS
from certified_cases import case
from faults import (
    Mutation,
    as_printed,
    doubled,
    eight_digits,
    eight_digits_text,
    function,
    here,
    last_column_negated,
    of_another_system,
    partials,
    power_rule_halved,
    reversed_rows,
    scaled_first,
    text,
    transposed,
    without_negation,
    without_rates_of,
    wrong_rule,
    wrong_tableau,
)
from iterations import ITERATIONS
from paces import STEP_SIZE_FAULTS
from sabotage import changed_property, changed_result, of_entries

from scvi_codegen import HamiltonianSystem, Splines, Trigonometric
from scvi_codegen.formulas import expressions
from scvi_codegen.ir import arithmetic, kernel
from scvi_codegen.lowering import stage_groups
from scvi_codegen.lowering.solvers import curves, points
from scvi_codegen.mechanics import derived_expressions as mechanics
from scvi_codegen.methods import acceleration_stages, composition, leapfrog_stages, stage_system
from scvi_codegen.rendering.kernels import printer as c_printer
from scvi_codegen.tables import quadrature, tableau
from scvi_codegen.tables.precision import mp

ROUNDOFF = (
    ("carry lost", "kepler/svi-3", "add_compensated", r"\*low = rest - .*;", "*low = 0;"),
    ("carry lost", "double/scvi", "add_compensated", r"\*low = rest - .*;", "*low = 0;"),
    ("carry lost", "kepler/composition", "add_compensated", r"\*low = rest - .*;", "*low = 0;"),
    ("carry lost in lanes", "double/svi", "add_compensated", r"\{rest - \(\(sum", "{0.0 * ((sum"),
    ("carry of the wrong sign", "driven/svi", "add_compensated", r"\(\*low \+", "(-*low +"),
    ("low increments lost", "kepler/svi-3", "add_compensated", r" \+ increment_low\)", ")"),
    ("carries exchanged", "cart/svi", "place", r"step->carry_q\[i\]", "step->carry_p[i]"),
    ("carry left out of momenta", "double/svi", "fixed_point", r"carry_p\[i\] (?=.* - value)", "carry_p[i] * 0.0 "),
    (
        "carry subtracted from momenta",
        "kepler/composition",
        "drift",
        r"\(step->carry_p\[i\] \+",
        "(-step->carry_p[i] +",
    ),
    (
        "carry left out of positions",
        "kepler/composition",
        "leap",
        r"\(step->carry_q\[i\] \+",
        "(0 * step->carry_q[i] +",
    ),
    ("weights of 53 bits", "round/svi-8", "increments_of", r"data->kick_low, F", "(const weight[GROUPS]){0}, F"),
    ("h^2 of 53 bits", "kepler/svi-3", "prepare_step_size", r"data->square_low = .*;", "data->square_low = 0.0;"),
    ("drifts of 53 bits", "oscillator/svi-8", "low_words", r" \+ DRIFT_LOW\[g\] \* of\.high", ""),
)

MUTATIONS = (
    # The printer and the lowering.
    function(
        "numbers printed with 8 digits", case("pendulum/svi"), c_printer, "print_number", lambda _: eight_digits_text
    ),
    function("minus signs lost", case("double/svi"), c_printer, "print_expression", without_negation),
    function("tables rounded to 8 digits", case("double/svi"), kernel, "lower_matrix", of_entries(eight_digits)),
    function(
        "weights rounded to 8 digits",
        case("cart/svi"),
        kernel,
        "lower_vector",
        changed_result(lambda found: tuple(map(eight_digits, found))),
    ),
    function(
        "parameters exchanged",
        case("double/svi"),
        arithmetic,
        "lower_kernel",
        lambda original: lambda name, *, parameters, **named: original(name, parameters=parameters[::-1], **named),
    ),
    function(
        "powers from the third on one too low",
        case("driven/svi"),
        arithmetic._Graph,
        "_whole",
        lambda original: lambda self, x, n: original(self, x, n - 1 if n > 2 else n),
    ),
    function(
        "r^-5 for r^-3", case("kepler/svi-3"), arithmetic, "INVERSE_ROOTS", lambda own: {**own, 3: "inverse_root_5"}
    ),
    function(
        "a power of h too much in a gather",
        case("double/svi"),
        stage_groups,
        "_gather_loop",
        changed_result(lambda loop: replace(loop, power=loop.power + 1) if loop.name.endswith("_1") else loop),
    ),
    function(
        "a power of h missing in a scatter",
        case("double/svi"),
        stage_groups,
        "_scatter_loop",
        changed_result(lambda loop: replace(loop, power=loop.power - 1) if loop.name.endswith("_0") else loop),
    ),
    function(
        "a derivative five per cent off",
        case("double/svi"),
        stage_groups,
        "_derivative_blocks",
        partials(lambda k, derivative: derivative * sympy.Rational(21, 20) if k == 0 else derivative),
    ),
    function(
        "a derivative lost",
        case("double/sc"),
        stage_groups,
        "_derivative_blocks",
        partials(lambda k, derivative: sympy.S.Zero if k == 1 else derivative),
    ),
    function(
        "the derivative of H_p off",
        case("vortices/svi"),
        stage_groups,
        "_derivative_blocks",
        partials(lambda k, derivative: derivative * sympy.Rational(11, 10) if k == 1 else derivative),
    ),
    # The C text.
    text("the force of the sweeps negated", case("driven/svi"), r"value\[0\] = ", "value[0] = -", within="force_lanes"),
    text("a term of the force dropped", case("driven/svi"), r" - parameters\[0\] \* u\[0\]", "", within="force_lanes"),
    text(
        "a term of Newton's residual dropped",
        case("driven/svi"),
        r" - parameters\[0\] \* u\[0\]",
        "",
        within="quadrature_derivatives",
    ),
    text("a factor in a derivative", case("driven/svi"), r"3\.0 \*", "2.0 *", within="quadrature_derivatives"),
    text("h for h^2", case("driven/svi"), r"data->square = h \* h;", "data->square = h;"),
    text("a run one step ahead in time", case("driven/svi"), r"step\.t = now\.t;", "step.t = now.t + run->h;"),
    text("L added in the energy", case("driven/svi"), r"sum = -value\[0\];", "sum = value[0];"),
    text(
        "Newton's iteration accepts too early",
        case("double/svi"),
        r"moved->relative <= options->tolerance",
        "moved->relative <= 1e-5",
    ),
    text(
        "sweeps accept too early",
        case("kepler/svi-3"),
        r"tolerance = options->tolerance \* options->tolerance",
        "tolerance = 1e-12",
    ),
    text(
        "Newton's residual wrong with kept factors",
        case("pendulum/svi"),
        r"value\[0\] = ",
        "value[0] = 1.001*",
        within="quadrature_value",
    ),
    text(
        "half of the discrete action",
        case("pendulum/svi"),
        r"own\[k\] \+= ",
        "own[k] += 0.5 * ",
        within="add_quadrature_sums",
    ),
    text(
        "momenta of a run advanced by dq",
        case("kepler/svi-3"),
        r"add_increments\(now\.p, now\.carry_p, dp\)",
        "add_increments(now.p, now.carry_p, dq)",
    ),
    text(
        "a kick of the wrong size", case("kepler/composition"), r"dp\[i\] \+= step->h", "dp[i] += 1.0000001 * step->h"
    ),
    # Solvers.
    here(
        "the product of two tables for another",
        case("kepler/gauss"),
        points,
        "matrix_product",
        lambda original: lambda a, b: original(transposed(a), b) if len(a) > 1 else original(a, b),
    ),
    function(
        "the mass of the sweeps doubled", case("double/svi"), mechanics.Forms, "lower_mass", changed_property(doubled)
    ),
    function(
        "the mass at the nodes doubled",
        case("double/gauss-position"),
        mechanics.Forms,
        "lower_mass",
        changed_property(doubled),
    ),
    function(
        "L_q and L_v exchanged at both ends",
        case("kepler/printed"),
        curves,
        "_printed_ends",
        changed_result(
            lambda ends: (
                replace(ends[0], numbers=ends[2].numbers),
                ends[1],
                replace(ends[2], numbers=ends[0].numbers),
                ends[3],
            )
        ),
    ),
    # Round-off: what compensated sums and low parts of coefficients promise.
    *(
        text(f"{what}, {where}", case(where), pattern, replacement, within=within)
        for what, where, within, pattern, replacement in ROUNDOFF
    ),
    # Tables of the methods.
    function(
        "p1 changed by the other sign",
        case("double/svi"),
        stage_system,
        "stationary_increments",
        changed_result(last_column_negated),
    ),
    function(
        "tables rounded to 2^-24, together",
        case("double/svi"),
        stage_system,
        "dyadic",
        of_entries(lambda x: mp.nint(x * 2**24) / 2**24),
    ),
    function(
        "two weights exchanged",
        case("double/lobatto-svi"),
        stage_system,
        "unit_sum",
        changed_result(lambda w: (w[1], w[0], *w[2:])),
    ),
    wrong_rule(
        "Gauss weights with 9 digits",
        case("pendulum/svi-3"),
        lambda rule: replace(
            rule,
            weights=(
                rule.weights[0] + mp.mpf("1e-9"),
                rule.weights[1] - mp.mpf("2e-9"),
                *scaled_first(1 + mp.mpf("1e-9") / rule.weights[2])(rule.weights[2:]),
            ),
        ),
    ),
    wrong_tableau(
        "Gauss tableau with 8 digits",
        case("double/gauss"),
        A=lambda A: tuple(tuple(map(eight_digits, row)) for row in A),
    ),
    wrong_tableau(
        "another symplectic tableau",
        case("double/gauss"),
        A=lambda A: ((mp.mpf(1) / 4, mp.zero), (mp.mpf(1) / 2, mp.mpf(1) / 4)),
        c=lambda c: (mp.mpf(1) / 4, mp.mpf(3) / 4),
    ),
    wrong_tableau("rows of a tableau exchanged", case("kepler/radau-iia"), A=reversed_rows),
    wrong_tableau("weights of a tableau exchanged", case("kepler/radau-iia"), b=reversed_rows),
    wrong_tableau("a tableau transposed", case("double/radau-ia"), A=transposed),
    wrong_tableau("Lobatto IIIB for IIIA", case("kepler/lobatto"), A=lambda _: tableau.lobatto_iiib(3).A),
    wrong_tableau("an abscissa off by 1e-7", case("driven/chebyshev"), c=lambda c: (c[0] + mp.mpf("1e-7"), *c[1:])),
    wrong_tableau("the abscissa of Euler at the end", case("driven/euler"), c=lambda _: (mp.one,)),
    wrong_tableau(
        "explicit Euler made implicit", case("driven/euler"), A=lambda _: ((mp.one,),), c=lambda _: (mp.one,)
    ),
    here(
        "momentum by A for A^T",
        case("kepler/sc-phase-space"),
        stage_system.Table,
        "transposed",
        lambda original: property(lambda table: original.fget(table) if len(table.entries[0]) == 1 else table),
    ),
    here(
        "A for A^2",
        case("double/gauss-position"),
        acceleration_stages,
        "matrix_product",
        lambda original: lambda a, b: original(a, b) if len(a) == 1 else a,
    ),
    here(
        "the curve of the points 1e-8 off",
        case("double/scvi"),
        acceleration_stages,
        "matrix_product",
        of_entries(lambda x: x * (1 + mp.mpf("1e-8"))),
    ),
    function(
        "a digit of a composition wrong",
        case("kepler/composition"),
        composition,
        "FIRST_HALVES",
        lambda own: {**own, 8: (own[8][0].replace("248", "249"), *own[8][1:])},
    ),
    function(
        "one kick in place of two halves",
        case("pendulum/verlet"),
        leapfrog_stages,
        "kicks_and_drifts",
        changed_result(lambda parts: ((mp.one, mp.zero), parts[1])),
    ),
    function(
        "one point in place of two",
        case("double/verlet"),
        tableau,
        "lobatto_iiia",
        changed_result(lambda own: replace(own, b=(mp.mpf("0.6"), mp.mpf("0.4")))),
    ),
    function(
        "derivative weights negated",
        case("pendulum/hermite"),
        quadrature.Quadrature,
        "unit_derivative_weights",
        lambda own: property(lambda self: tuple(tuple(-x for x in line) for line in own.fget(self))),
    ),
    function(
        "positions of splines off by 1e-9",
        case("pendulum/splines"),
        Splines,
        "positions",
        of_entries(lambda x: x * (1 + mp.mpf("1e-9"))),
    ),
    function(
        "positions of trigonometric curves off",
        case("pendulum/trigonometric"),
        Trigonometric,
        "positions",
        of_entries(lambda x: x * (1 + mp.mpf("1e-9"))),
    ),
    # The derivation, which compiled code and digits share.
    function(
        "a force 1e-6 off",
        case("double/gauss-position"),
        mechanics.Forms,
        "force",
        changed_property(scaled_first(1 + sympy.Rational(1, 10**6))),
    ),
    function(
        "another potential, consistently",
        case("double/svi"),
        stage_system.ScalarStageGroup,
        "derivatives",
        of_another_system,
    ),
    function("L_vq v lost", case("double/sc"), mechanics, "_along", without_rates_of("theta1", "theta2")),
    function("L_vt lost", case("cart/sc"), mechanics, "_along", without_rates_of("t")),
    function(
        "L_vq v lost, as printed", case("double/printed"), mechanics, "_along", without_rates_of("theta1", "theta2")
    ),
    function(
        "L_vq v lost, on Gauss points",
        case("double/scvi-gauss"),
        mechanics,
        "_along",
        without_rates_of("theta1", "theta2"),
    ),
    function("the power rule halved", case("kepler/svi-3"), expressions, "_partial", power_rule_halved),
    function(
        "the derivative of the cosine positive",
        case("pendulum/verlet"),
        sympy.cos,
        "fdiff",
        lambda _: lambda self, position=1: sympy.sin(self.args[0]),
    ),
    function(
        "H with the other sign",
        case("vortices/svi"),
        HamiltonianSystem,
        "lagrangian",
        lambda _: property(
            lambda self: self.hamiltonian + sum(p * v for p, v in zip(self.momenta, self.velocities, strict=True))
        ),
    ),
    Mutation("the chain rule of L_d lost", case("kepler/scvi"), as_printed),
    *PARTS,
    *STEP_SIZE_FAULTS,
    *ITERATIONS,
)
