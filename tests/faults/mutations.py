"""Faults for the generator: a certificate that does not catch each of them is worth nothing.

Each is named for what is wrong and has a case in which it makes a difference.
"""

from dataclasses import replace
from itertools import starmap

import sympy
from beside import PARTS
from c_edits import KERNEL_EDITS, TEMPLATE_EDITS
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

MUTATIONS = (
    # The printer and the lowering.
    function("numbers printed with 8 digits", "pendulum/svi", c_printer, "print_number", lambda _: eight_digits_text),
    function("minus signs lost", "double/svi", c_printer, "print_expression", without_negation),
    function("tables rounded to 8 digits", "double/svi", kernel, "lower_matrix", of_entries(eight_digits)),
    function(
        "weights rounded to 8 digits",
        "cart/svi",
        kernel,
        "lower_vector",
        changed_result(lambda found: tuple(map(eight_digits, found))),
    ),
    function(
        "parameters exchanged",
        "double/svi",
        arithmetic,
        "lower_kernel",
        lambda original: lambda name, *, parameters, **named: original(name, parameters=parameters[::-1], **named),
    ),
    function(
        "powers from the third on one too low",
        "driven/svi",
        arithmetic._Graph,
        "_whole",
        lambda original: lambda self, x, n: original(self, x, n - 1 if n > 2 else n),
    ),
    function("r^-5 for r^-3", "kepler/svi-3", arithmetic, "INVERSE_ROOTS", lambda own: {**own, 3: "inverse_root_5"}),
    function(
        "a power of h too much in a gather",
        "double/svi",
        stage_groups,
        "_gather_loop",
        changed_result(lambda loop: replace(loop, power=loop.power + 1) if loop.name.endswith("_1") else loop),
    ),
    function(
        "a power of h missing in a scatter",
        "double/svi",
        stage_groups,
        "_scatter_loop",
        changed_result(lambda loop: replace(loop, power=loop.power - 1) if loop.name.endswith("_0") else loop),
    ),
    function(
        "a derivative five per cent off",
        "double/svi",
        stage_groups,
        "_derivative_blocks",
        partials(lambda k, derivative: derivative * sympy.Rational(21, 20) if k == 0 else derivative),
    ),
    function(
        "a derivative lost",
        "double/sc",
        stage_groups,
        "_derivative_blocks",
        partials(lambda k, derivative: sympy.S.Zero if k == 1 else derivative),
    ),
    function(
        "the derivative of H_p off",
        "vortices/svi",
        stage_groups,
        "_derivative_blocks",
        partials(lambda k, derivative: derivative * sympy.Rational(11, 10) if k == 1 else derivative),
    ),
    # Solvers.
    here(
        "the product of two tables for another",
        "kepler/gauss",
        points,
        "matrix_product",
        lambda original: lambda a, b: original(transposed(a), b) if len(a) > 1 else original(a, b),
    ),
    function(
        "the mass of the fixed-point iteration doubled",
        "double/svi",
        mechanics.Forms,
        "lower_mass",
        changed_property(doubled),
    ),
    function(
        "the mass at the nodes doubled",
        "double/gauss-position",
        mechanics.Forms,
        "lower_mass",
        changed_property(doubled),
    ),
    function(
        "L_q and L_v exchanged at both ends",
        "kepler/printed",
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
    # Tables of the methods.
    function(
        "p1 changed by the other sign",
        "double/svi",
        stage_system,
        "stationary_increments",
        changed_result(last_column_negated),
    ),
    function(
        "tables rounded to 2^-24, together",
        "double/svi",
        stage_system,
        "dyadic",
        of_entries(lambda x: mp.nint(x * 2**24) / 2**24),
    ),
    function(
        "two weights exchanged",
        "double/lobatto-svi",
        stage_system,
        "unit_sum",
        changed_result(lambda w: (w[1], w[0], *w[2:])),
    ),
    wrong_rule(
        "Gauss weights with 9 digits",
        "pendulum/svi-3",
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
        "Gauss tableau with 8 digits", "double/gauss", A=lambda A: tuple(tuple(map(eight_digits, row)) for row in A)
    ),
    wrong_tableau(
        "another symplectic tableau",
        "double/gauss",
        A=lambda A: ((mp.mpf(1) / 4, mp.zero), (mp.mpf(1) / 2, mp.mpf(1) / 4)),
        c=lambda c: (mp.mpf(1) / 4, mp.mpf(3) / 4),
    ),
    wrong_tableau("rows of a tableau exchanged", "kepler/radau-iia", A=reversed_rows),
    wrong_tableau("weights of a tableau exchanged", "kepler/radau-iia", b=reversed_rows),
    wrong_tableau("a tableau transposed", "double/radau-ia", A=transposed),
    wrong_tableau("Lobatto IIIB for IIIA", "kepler/lobatto", A=lambda _: tableau.lobatto_iiib(3).A),
    wrong_tableau("an abscissa off by 1e-7", "driven/chebyshev", c=lambda c: (c[0] + mp.mpf("1e-7"), *c[1:])),
    wrong_tableau("the abscissa of Euler at the end", "driven/euler", c=lambda _: (mp.one,)),
    wrong_tableau("explicit Euler made implicit", "driven/euler", A=lambda _: ((mp.one,),), c=lambda _: (mp.one,)),
    here(
        "momentum by A for A^T",
        "kepler/sc-phase-space",
        stage_system.Table,
        "transposed",
        lambda original: property(lambda table: original.fget(table) if len(table.entries[0]) == 1 else table),
    ),
    here(
        "A for A^2",
        "double/gauss-position",
        acceleration_stages,
        "matrix_product",
        lambda original: lambda a, b: original(a, b) if len(a) == 1 else a,
    ),
    here(
        "the curve of the points 1e-8 off",
        "double/scvi",
        acceleration_stages,
        "matrix_product",
        of_entries(lambda x: x * (1 + mp.mpf("1e-8"))),
    ),
    function(
        "a digit of a composition wrong",
        "kepler/composition",
        composition,
        "FIRST_HALVES",
        lambda own: {**own, 8: (own[8][0].replace("248", "249"), *own[8][1:])},
    ),
    function(
        "one kick in place of two halves",
        "pendulum/verlet",
        leapfrog_stages,
        "kicks_and_drifts",
        changed_result(lambda parts: ((mp.one, mp.zero), parts[1])),
    ),
    function(
        "one point in place of two",
        "double/verlet",
        tableau,
        "lobatto_iiia",
        changed_result(lambda own: replace(own, b=(mp.mpf("0.6"), mp.mpf("0.4")))),
    ),
    function(
        "derivative weights negated",
        "pendulum/hermite",
        quadrature.Quadrature,
        "unit_derivative_weights",
        lambda own: property(lambda self: tuple(tuple(-x for x in line) for line in own.fget(self))),
    ),
    function(
        "positions of splines off by 1e-9",
        "pendulum/splines",
        Splines,
        "positions",
        of_entries(lambda x: x * (1 + mp.mpf("1e-9"))),
    ),
    function(
        "positions of trigonometric curves off",
        "pendulum/trigonometric",
        Trigonometric,
        "positions",
        of_entries(lambda x: x * (1 + mp.mpf("1e-9"))),
    ),
    # The derivation, which compiled code and digits share.
    function(
        "a force 1e-6 off",
        "double/gauss-position",
        mechanics.Forms,
        "force",
        changed_property(scaled_first(1 + sympy.Rational(1, 10**6))),
    ),
    function(
        "another potential, consistently", "double/svi", stage_system.ScalarStageGroup, "derivatives", of_another_system
    ),
    function("L_vq v lost", "double/sc", mechanics, "_along", without_rates_of("theta1", "theta2")),
    function("L_vt lost", "cart/sc", mechanics, "_along", without_rates_of("t")),
    function("L_vq v lost, as printed", "double/printed", mechanics, "_along", without_rates_of("theta1", "theta2")),
    function(
        "L_vq v lost, on Gauss points", "double/scvi-gauss", mechanics, "_along", without_rates_of("theta1", "theta2")
    ),
    function("the power rule halved", "kepler/svi-3", expressions, "_partial", power_rule_halved),
    function(
        "the derivative of the cosine positive",
        "pendulum/verlet",
        sympy.cos,
        "fdiff",
        lambda _: lambda self, position=1: sympy.sin(self.args[0]),
    ),
    function(
        "H with the other sign",
        "vortices/svi",
        HamiltonianSystem,
        "lagrangian",
        lambda _: property(
            lambda self: self.hamiltonian + sum(p * v for p, v in zip(self.momenta, self.velocities, strict=True))
        ),
    ),
    Mutation("the chain rule of L_d lost", case("kepler/scvi"), as_printed),
    *PARTS,
    *starmap(text, TEMPLATE_EDITS + KERNEL_EDITS),
)
