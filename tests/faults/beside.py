"""Faults of what stands beside a Lagrangian, forces, inputs, constraints; of Hamiltonians, derivatives and lanes."""

import sympy
from certified_cases import case
from faults import constraints_off, function, here, moving_part, text, without_last_of, without_rates_of
from sabotage import changed_property, changed_result

from scvi_codegen.lowering import constraints as lowered_constraints
from scvi_codegen.lowering import derivatives as lowered_derivatives
from scvi_codegen.lowering import stage_groups
from scvi_codegen.mechanics import derived_expressions as mechanics
from scvi_codegen.methods import constraints as constrained_stages
from scvi_codegen.tables.quadrature import gauss_lobatto

FORCES_AND_INPUTS = (
    text(
        "an input from t = 0",
        case("pushed/svi"),
        r"w0 = parameters\[5\] - t",
        "w0 = 0.0 * parameters[5] - t",
        within="force_lanes",
    ),
    text(
        "the quadratic coefficient of an input for the cubic one",
        case("pushed/svi"),
        r"parameters\[4\] \* w0",
        "parameters[3] * w0",
        within="force_lanes",
    ),
    text("the input of the ground for that of the motor", case("pushed/svi"), r"parameters\[6\]", "parameters[1]"),
    text("friction that drives", case("pushed/svi"), r"- parameters\[0\] \*\n?\s*u\[1\]", "+ parameters[0] * u[1]"),
    text("forces at the start of the step", case("pushed/svi"), r"step->h \* ABSCISSA\[n\]", "0 * ABSCISSA[n]"),
    function(
        "the adjoint of forces with the other sign",
        case("pushed/scvi"),
        mechanics.Forms,
        "multiplied_forces",
        changed_property(lambda found: (found[0], tuple(-x for x in found[1]), *found[2:])),
    ),
    function(
        "forces left out of the equations of the curve",
        case("pushed/scvi"),
        mechanics.Forms,
        "multiplied_forces",
        changed_property(lambda found: (*found[:3], tuple(0 * x for x in found[3]))),
    ),
)

DAMPING = (
    text("weights that do not grow", case("damped/svi"), r"lanes_of_number\(growth\) \* ABSCISSA", "0.0 * ABSCISSA"),
    text("weights of the middle", case("damped/svi"), r"\)\(growth \* abscissa\[n\]\)", ")(growth / 2)"),
    text("a momentum that is not damped", case("damped/svi"), r"data->damping\.shrunk \* dp\[i\] \+ .*;", "dp[i];"),
    text("damping by 1 - gamma h", case("damped/svi"), r"exponential_less_1\(-growth\)", "-growth"),
    text(
        "derivatives by the rate lost",
        case("damped/svi"),
        r"propagate\(back, growth, step->h \* derivative\[e\].*;",
        ";",
    ),
    text(
        "derivatives of what grows by h alone", case("damped/svi"), r"propagate\(0, p, -at->p1\[i\], at->grown\);", ";"
    ),
)

RATTLES = tuple(
    text(f"{what}, rods/rattle", case("rods/rattle"), *edit)
    for what, *edit in (
        ("a hidden constraint without g_t", r"-value\[M \+ k\]", "-value[M + CONSTRAINTS + k]"),
        ("half of the force at the end", r"now->force\[i\]\[DEGREE - 1\];", "now->force[i][DEGREE - 1] / 2;"),
        ("constraints of the start of a step", r"step->t \+ RATTLE_ABSCISSA\[n \+ 1\] \* step->h;", "step->t;"),
        ("masses that are not inverted", r"now->inverse_mass\[i\] = 1 / mass", "now->inverse_mass[i] = mass"),
    )
) + tuple(
    text(f"{what}, rods/lobatto-svi", case("rods/lobatto-svi"), *edit)
    for what, *edit in (
        (
            "derivatives of the next point",
            r"FORMER\(load\(now->derivative\[e\]\), lanes_of\(now->first_derivative\[e\]\)\)",
            "load(now->derivative[e])",
        ),
        ("positions off by 1e-12 of a step", r"moved = step->h \* v;", "moved = step->h * (1 + 1e-12) * v;"),
    )
)

HAMILTONIANS = (
    function("H_pt lost", case("swing/sc"), mechanics, "_along", without_rates_of("t")),
    function(
        "forces on momenta halved",
        case("swing/gauss"),
        mechanics.Forms,
        "force",
        changed_property(lambda found: tuple(f / 2 for f in found)),
    ),
    function(
        "momenta without the vector potential",
        case("field/verlet"),
        mechanics.Forms,
        "momentum",
        changed_property(lambda found: tuple(map(moving_part, found))),
    ),
)

CONSTRAINTS = (
    here(
        "a multiplier's force off its gradient",
        case("linkage/lobatto-svi"),
        constrained_stages,
        "with_constraint_forces",
        changed_result(lambda found: (found[0] * (1 + sympy.Rational(1, 10**6)), *found[1:])),
    ),
    here(
        "hidden constraints without g_t",
        case("wire/lobatto-svi"),
        constrained_stages,
        "constraint_rates",
        lambda original: (
            lambda system: tuple(
                rate - g.diff(system.time) for rate, g in zip(original(system), system.constraints, strict=True)
            )
        ),
    ),
    here(
        "multipliers without what velocities add",
        case("linkage/lobatto-svi"),
        lowered_constraints,
        "time_derivatives",
        lambda _: lambda system, functions: (sympy.S.Zero,) * len(functions),
    ),
    here(
        "the end's momentum without the last force",
        case("linkage/lobatto-svi"),
        constrained_stages,
        "_with_end",
        lambda original: lambda table, rows, points: without_last_of(original(table, rows, points), rows),
    ),
    here("constraints 1e-9 off", case("linkage/lobatto-svi"), stage_groups, "system_kernel", constraints_off),
    text(
        "multipliers of the other sign",
        case("linkage/lobatto-svi"),
        r"y\[j\] = -y\[j\]",
        "y[j] = +y[j]",
        within=r"NAME\(multipliers\)",
    ),
    here(
        "reactions off what the blade pushes along",
        case("sleigh/lobatto-svi"),
        constrained_stages,
        "with_constraint_forces",
        changed_result(lambda found: (found[0] * (1 + sympy.Rational(1, 10**6)), *found[1:])),
    ),
    here(
        "rolling asked for at Lobatto's points",
        case("sleigh/lobatto-svi"),
        constrained_stages,
        "gauss_legendre",
        lambda _: gauss_lobatto,
    ),
    here(
        "the blade at the end 1e-9 off",
        case("sleigh/lobatto-svi"),
        constrained_stages,
        "constraint_rates",
        changed_result(lambda found: tuple(rate + sympy.Rational(1, 10**9) for rate in found)),
    ),
    here(
        "multipliers without what turning adds",
        case("sleigh/lobatto-svi"),
        lowered_constraints,
        "time_derivatives",
        lambda _: lambda system, functions: (sympy.S.Zero,) * len(functions),
    ),
    text("multipliers of the other sign on a blade", case("sleigh/lobatto-svi"), r"y\[j\] = -y\[j\]", "y[j] = +y[j]"),
    text(
        "steps of positions 1e-7 too long",
        case("sleigh/lobatto-svi"),
        r"1, step->h, data->z",
        "1, 1.0000001 * step->h, data->z",
    ),
)

C_TEXT = (
    ("points at the time of the start", "driven/svi", "inputs_wide", r"f->abscissa\[n\], v", "0, v"),
    ("arguments stretched by h too much", "cart/svi", "derivatives_of_group", r"\(real\)loop->power \* ", ""),
    (
        "results not stretched by h",
        "wire/lobatto-svi",
        "derivatives_of_group",
        r"\*= \(real\)f->scatter\[s\]\.power / h",
        "*= 0",
    ),
    ("q1 by h at its start alone", "vortices/svi", "end_position", r"END_POSITION\[b\] \* z\[i \* B \+ b\]", "0"),
    ("momenta held", "double/scvi", "jvp_step", r"momentum_rows\(at, 0\);", ""),
    ("rows exchanged no more on the way back", "linkage/lobatto-svi", "lower_wide", r"if \(back\)", "if (0)"),
    (
        "derivatives by momenta missing in the adjoint",
        "double/gauss",
        "vjp_with_unknowns",
        r"momentum_rows\(at, 1\);",
        "",
    ),
    (
        "time that does not pass on the way back",
        "driven/svi",
        "end_time",
        r"propagate\(back, at->v \+ INPUT_H - 1",
        "propagate(0, at->v + INPUT_H - 1",
    ),
    (
        "time that goes on without the step",
        "driven/svi",
        "end_time",
        r"propagate\(back, at->v \+ INPUT_H - 1, 1,",
        "propagate(back, at->v + INPUT_H - 1, back,",
    ),
    (
        "tangents by iteration scaled by h once too little",
        "kepler/svi-3",
        "jvp_by_iteration",
        r"2\.0 \* dh",
        "1.0 * dh",
    ),
    (
        "adjoint by iteration without the drift of momenta",
        "kepler/svi-3",
        "vjp_by_iteration",
        r"v\[M \+ i\] \+= drift;",
        "",
    ),
    (
        "tangents by iteration of momenta without h",
        "double/svi",
        "jvp_by_iteration",
        r"dh \* at->E\[n\]\[i\]",
        "0 * dh",
    ),
    (
        "adjoint by iteration with masses of the other sign",
        "double/svi",
        "linearise_points",
        r": -at->given",
        ": at->given",
    ),
    (
        "sweeps of changes that end early",
        "kepler/svi-3",
        "vectors_status",
        r"MOVED_BY_ROUNDING : LEFT_TO_COME",
        "MOVED_BY_ROUNDING : 1e-6",
    ),
    ("a matrix not transposed", "double/svi", "solve_back", r"pivot, 1, at->x", "pivot, 0, at->x"),
    (
        "half of the last row",
        "double/svi",
        "end_momentum",
        r"propagate\(0, p, 1, at->rows",
        "propagate(0, p, 0.5, at->rows",
    ),
    (
        "positions that unknowns move by 1, not by h",
        "driven/svi",
        "end_position",
        r"at->v \+ i, h \*",
        "at->v + i, 1 *",
    ),
    (
        "the last parameter of lanes lost",
        "double/svi",
        r"NAME\(advance\)",
        r"sizeof\(lanes\) \* P\)",
        "sizeof(lanes) * (P - 1))",
    ),
    (
        "lanes whose time goes half as fast",
        "driven/svi",
        r"NAME\(advance\)",
        r"&block->t_low, block->h, 0\.0\)",
        "&block->t_low, block->h / 2, 0.0)",
    ),
    (
        "states of the first lane stored for all",
        "driven/svi",
        "store_states",
        r"position\.lane\[j\]",
        "position.lane[0]",
    ),
)
SECOND = (
    text("the end position does not bend", case("kepler/svi-3"), r"add_end_hessian\(to\);", "(void)add_end_hessian;"),
    text(
        "second derivatives at the start of the step",
        case("driven/svi"),
        r"f->curvature\(u, time_of\(f, step, n\),",
        "f->curvature(u, step->t,",
    ),
    text(
        "arguments that h moves bend once too often",
        case("kepler/svi-3"),
        r"add_product\(by, -by_h\[k\] / h, to->adjoints \+ k, dh\);",
        "add_product(by, by_h[k] / h, to->adjoints + k, dh);",
    ),
    text(
        "multipliers that do not change with unknowns",
        case("pendulum/hermite"),
        r"memcpy\(at->dz, to->by_dz, sizeof\(wide\) \* N\);",
        "memset(at->dz, 0, sizeof(wide) * N);",
    ),
    here(
        "a second derivative off by 1e-6",
        case("double/svi"),
        lowered_derivatives,
        "jacobian",
        changed_result(lambda found: found | {k: found[k] * sympy.Rational(1000001, 10**6) for k in list(found)[:1]}),
    ),
)
PARTS = (
    *FORCES_AND_INPUTS,
    *DAMPING,
    *RATTLES,
    *HAMILTONIANS,
    *CONSTRAINTS,
    here(
        "a derivative by a parameter off by 1e-6",
        case("double/svi"),
        lowered_derivatives,
        "jacobian",
        changed_result(lambda found: found | {k: found[k] * sympy.Rational(1000001, 10**6) for k in list(found)[:1]}),
    ),
    *SECOND,
    *(text(f"{what}, {where}", case(where), *edit, within=within) for what, where, within, *edit in C_TEXT),
)
