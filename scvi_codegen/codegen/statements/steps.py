"""Steps as statements, and their C."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from scvi_codegen.codegen.ir.equations import Rattle, Splitting
from scvi_codegen.codegen.ir.program import HeatBath
from scvi_codegen.codegen.statements.printing import Layout, Place, PointsAsLanes, Printer, Quantity
from scvi_codegen.methods.statements import Apply, Assign, Operation, Read, Repeat, Statement, When, read, selected

TURN = """\
for (int k = 0; k < BODIES; k++) {
  const int first = BODY[k][0];
  turn_body(step, first, BODY[k][2], data->bodies + k, AXES, step->h * DRIFT[n], ARGUMENT + first, dq + first,
      dp + first);
}
"""


def _of(
    text: str, names: str, place: Place = Place.ARRAY, words: int = 1, *, uniform: bool = False
) -> dict[str, Quantity]:
    """Return quantities, in whose text in C the name is put, or the other name behind a colon."""
    pairs = (name.partition(":") for name in names.split())
    return {name: Quantity(text.format(other or name), place, words, uniform=uniform) for name, _, other in pairs}


def _features(split: Splitting, action: bool = False) -> list[str]:
    features = {"masses": split.by_masses, "bodies": bool(split.bodies), "action": action}
    return [name for name, holds in features.items() if holds]


def splitting_texts(split: Splitting) -> dict[str, str]:
    """Return the statements of an explicit step and its tables, by titles."""
    rows = (f"{name} = {', '.join(f'{float(x):.17g}' for x in numbers)}\n" for name, numbers in split.numbers.items())
    return {
        "increments q and p of the state q0, p0": f"{selected(split.statements, _features(split))}\n",
        "tables of the statements": "".join(rows),
    }


def rattle_texts(rattle: Rattle) -> dict[str, str]:
    """Return the statements of a constrained step, by titles."""
    features = [name.lower() for name in rattle.macros]
    texts = {title: selected(text, features) for title, _, _, text in CONSTRAINED[rattle.part]}
    return {title: f"{text}\n" for title, text in texts.items() if text}


def bath_texts(noise: bool) -> dict[str, str]:
    """Return the statements of half a step of a heat bath, with further noise or without, by their title."""
    title = "half a step of the heat bath, before and after the step, with p - A = W y"
    return {title: f"{selected(HALF_STEP, ['noise'] * noise)}\n"}


def velocities_by_masses(statements: Iterable[Statement]) -> Iterator[Statement]:
    """Yield statements in which velocities are momenta times the inverse masses."""
    for statement in statements:
        match statement:
            case Apply(name="velocity", argument=momentum, target=Read() as target):
                product = Operation("*", (Read("inverse_mass", target.at), Read(momentum, target.at)))
                yield Assign(target, product)
            case Repeat(body=body) | When(body=body):
                yield replace(statement, body=tuple(velocities_by_masses(body)))
            case _:
                yield statement


def splitting_header(split: Splitting, layout: Layout, *, action: bool) -> str:
    """Return the header with the function that computes the increments of a step of a splitting method."""
    words, alike = layout.words, not layout.lanes
    pairs, time = ("_pairs", "") if words == 2 else ("", "step->")
    quantities = {
        **_of("{}", "F", words=words, uniform=alike),
        **_of("{}" if words == 2 else "data->{}", "inverse_mass", words=words, uniform=alike),
        **_of("{}" if words == 2 else "d{}", "q p", words=words, uniform=alike),
        **_of(f"{time}{{}}", "t h", Place.NUMBER, words, uniform=True),
        "q0": Quantity("step->q0", Place.STATE, low="step->carry_q", uniform=alike),
        "p0": Quantity("step->p0", Place.STATE, low="step->carry_p", uniform=alike),
        **_of("acted[{}]", "L:0 S:1", Place.NUMBER),
    }
    operations = {
        "force": f"force{pairs}(ARGUMENT, TIME, step->parameters, TARGET);",
        "velocity": "drift_velocity(ARGUMENT, TIME, step->parameters, TARGET);",
        "at_rest": "at_rest(ARGUMENT, TIME, step->parameters, &TARGET);",
        "turn": TURN.replace("AXES", "PRINCIPAL_AXES[k]" if split.principal else "NULL"),
    }
    statements: Sequence[Statement] = read(split.statements, _features(split, action))
    statements = [*velocities_by_masses(statements)] if split.by_masses else statements
    lines = Printer(quantities, layout, operations).function_body(statements)
    purpose = "Computes the increments of one step{}. F is the last force; it is that of the first kick if `known`"
    first = []
    if split.driven and words == 2:
        first = ["known = 0; /* inputs, which may jump between steps, have changed the last force */"]
    if words == 1:
        acted = ", with acted[1], their action over h, and acted[0], the last L at v = 0" if action else ""
        arguments = "const solver_data *data, int known, number *F, number *dq, number *dp,\n    number *acted"
        starts = ["memset(dq, 0, sizeof(number) * M);", "memset(dp, 0, sizeof(number) * M);"]
        starts += ["acted[1] = 0;"] if action else []
        head = f"SPLITTING void leap(const step_data *step, {arguments})"
        return _function(purpose.format(acted), head, *starts, *first, *lines)
    kind, zero = ("ddl", "ddl_word(lanes_of(0.0))") if layout.lanes else ("dd", "dd_word(0.0)")
    arguments = f"dd t, dd h, const {kind} *inverse_mass, int known, {kind} *F,\n    number *dq, number *dp"
    starts = [f"{kind} q[M], p[M];", "for (int i = 0; i < M; i++)", f"  q[i] = p[i] = {zero};"]
    stores = [f"  d{x}[i] = {x}[i].high, d{x}[M + i] = {x}[i].low;" for x in "qp"]
    head = f"static inline void leap_in_pairs(const step_data *step, {arguments})"
    ends = ["for (int i = 0; i < M; i++) {", *stores, "}"]
    return _function(purpose.format(" in pairs"), head, *starts, *first, *lines, *ends)


HALF_STEP = """
x[i] = p[i] - mean[i] + carry[i]
y[i] = modes(x)
r[i] = rotated(xi)
c[i] = decay[i] * y[i] + strength[i] * r[i]
if noise:
    s[i] = root * sigma[i] * eta[i]
    d[i] = modes(s)
    c[i] += d[i]
heat += c[i] * (y[i] + c[i] / 2)
z[i] = momenta(c)
p[i] += z[i]
"""
"""Half a step of a heat bath: p - A = W y, y <- e^(-k tau) y + (kT (1 - e^(-2 k tau)))^(1/2) U^T xi + tau^(1/2) V sigma
eta with V = W^-1 (bath.h); decay is e^(-k tau) - 1, and the kinetic energy y^2 / 2."""


def half_step(bath: HeatBath) -> str:
    """Return the function of half a step of a heat bath."""
    own = {
        **_of("bath->{}", "decay strength"),
        "mean": Quantity("(bath->terms + 1)"),
        "sigma": Quantity("(bath->terms + BATH_TERMS - STRENGTHS)"),
        "xi": Quantity("normals"),
        "eta": Quantity("(normals + M)"),
        "carry": Quantity("carry"),
        "p": Quantity("p", Place.STATE, low="carry"),
        "heat": Quantity("heat", Place.NUMBER),
        "root": Quantity("bath->root", Place.NUMBER),
    }
    sizes, product = [len(block) for block in bath.blocks], ""
    for b, n in enumerate(sizes):
        first, factors = sum(sizes[:b]), sum(size**2 for size in sizes[:b])
        product += f"multiply_block({n}, BLOCK_COORDINATE + {first}, A + {factors}, ARGUMENT, TARGET);\n"
    matrices = {"modes": "v", "rotated": "turn", "momenta": "w"}.items()
    operations = {name: product.replace("A +", f"bath->{matrix} +") for name, matrix in matrices}
    statements = read(HALF_STEP, ["noise"] * bool(bath.sizes["STRENGTHS"]))
    lines = Printer(own, Layout(word="bath_number"), operations).function_body(statements)
    head = "const present_factors *bath, const bath_number *normals, bath_number *p, bath_number *carry"
    return _function(
        "Adds half a step to p + carry, by M + STRENGTHS normals; returns the change of the kinetic energy",
        f"static inline bath_number exchange_heat({head})",
        *("bath_number heat = {0};", *lines, "return heat;"),
    )


FORCE = """
if velocity_forces:
    f[i] = force[i]
else:
    f[i] = former(force[i])
"""
RATTLE = f"""
G[e] = former(derivative[e])
factorise(G)
{FORCE}f[col(e)] += G[e] * lam[row(e)]
d[i] = mass(f[i])
if momentum_terms:
    d[i] = d[i] - a[i] - rate * (RATTLE_SHIFT_RESPONSE @ turned[i])
else:
    d[i] = d[i] - a[i]
x[pos(k)] = (RATTLE_INVERSE @ g[k]) * scale
x[pos(row(e))] += G[e] * d[col(e)]
x[k] = solve(x[k])
lam[k] -= x[pos(k)]
f[col(e)] -= G[e] * x[pos(row(e))]
b[i] = mass(f[i])
a[i] = b[i]
moved[i] = hh * (RATTLE_RESPONSE @ a[i])
if momentum_terms:
    v[i] = base[i] + (moved[i] - h * (RATTLE_SHIFT @ w[i]))
else:
    v[i] = base[i] + moved[i]
change[i] = v[i] - u[i]
u[i] = v[i]
"""
"""Iteration for the multipliers of a constrained step with constant masses (RATTLE for two points; L. Jay, SIAM J.
Numer. Anal. 33, 1996): P x = G (a_new - a) + R^-1 g / h^2, lambda -= x, with P = G M^-1 G^T; then
u = q0 + h c v0 + h^2 R a."""

COUPLED_RATTLE = """
G[e] = former(derivative[e])
t[i] = force[i]
t[col(e)] += (GROWN * G[e]) * lam[row(e)]
invert(masses)
factorise(G)
f[i] = t[i]
mean[i] = (RATTLE_MEAN @ p[i]) + RATTLE_MEAN_OF_LAST * last_p[i]
r[i] = (base_p[i] + (h * (RATTLE_IMPULSE @ f[i]) - mean[i])) / GROWN
b[i] = mass(r[i])
y[i] = b[i]
moved[i] = h * (RATTLE_DISPLACEMENT @ y[i])
d[k] = g[k]
d[row(e)] += derivative[e] * moved[col(e)]
c[k] = d[k]
x[pos(k)] = (RATTLE_INVERSE @ c[k]) * scale
x[k] = solve(x[k])
lam[k] -= x[pos(k)]
H[e] = former(derivative[e])
s[i] = zero
s[col(e)] -= (GROWN * H[e]) * x[pos(row(e))]
f[i] = s[i]
w[i] = h * (RATTLE_IMPULSE @ f[i]) / GROWN
n[i] = mass(w[i])
v[i] = v[i] + (y[i] + n[i])
m[i] = base[i] + h * (RATTLE_DISPLACEMENT @ v[i])
change[i] = m[i] - u[i]
u[i] = m[i]
"""
"""The same for masses that depend on positions: y = M^-1 r with the residual r of the momenta,
P x = (D I)^-1 (g + h G D y) / h^2, v += y - h M^-1 I G^T x."""

FORCES = f"""{FORCE}f[col(e)] += former(derivative[e]) * lam[row(e)]
"""
MOVE = """
if velocity_forces:
    at[i] = former(u[i])
    if momentum_terms:
        velocity[i] = base_v[i] + h * (RATTLE_VELOCITY @ a[i]) - RATTLE_VELOCITY_SHIFT @ w[i]
    else:
        velocity[i] = base_v[i] + h * (RATTLE_VELOCITY @ a[i])
"""
SHIFTS = """
if momentum_terms:
    s[i] = shift[i]
    m[i] = mass(s)
    turned[i] = m[i] - w[i]
    w[i] = m[i]
"""
BEGIN = """
if momentum_terms:
    shifted[i] = forced[i] + (RATTLE_SHIFT @ w[i])
    a[i] = rate * (RATTLE_INVERSE @ shifted[i])
else:
    a[i] = rate * (RATTLE_INVERSE @ forced[i])
moved[i] = hh * (RATTLE_RESPONSE_LOW @ a[i])
low[i] = RATTLE_DRIFT_LOW * (h * v0[i]) + moved[i]
if momentum_terms:
    low[i] -= h * (RATTLE_SHIFT_LOW @ w[i])
if velocity_forces:
    gained[i] = h * (RATTLE_VELOCITY_LOW @ a[i])
    base_v[i] = v0[i] + (RATTLE_VELOCITY_START * v0[i] + gained[i])
base[i] = q0[i] + (carry_q[i] + (low[i] + RATTLE_DRIFT * (h * v0[i])))
"""
END = """
b[i] = mass(f[i])
all[i] = f[i]
a[i] = b[i]
mean[i] = RATTLE_MOMENTUM @ a[i]
mean[i] += RATTLE_MOMENTUM_LOW @ a[i]
push[i] = RATTLE_START * v0[i] + h * mean[i]
if momentum_terms:
    z[i] = v0[i] + (push[i] - (RATTLE_PROJECTION @ w[i]))
else:
    z[i] = v0[i] + push[i]
"""
"""Forces with reactions; their arguments; w of momenta; accelerations of the guess, and positions without forces;
velocities z of the curve."""

COUPLED_FORCES = """
t[i] = force[i]
t[col(e)] += GROWN * former(derivative[e]) * lam[row(e)]
f[i] = t[i]
"""
COUPLED_POSITIONS = """
low[i] = h * (RATTLE_DISPLACEMENT_LOW @ v[i])
base[i] = q0[i] + (carry_q[i] + low[i])
u[i] = base[i] + h * (RATTLE_DISPLACEMENT @ v[i])
"""
COUPLED_MOMENTA = """
mean[i] = (RATTLE_MEAN_LOW @ p[i]) + RATTLE_MEAN_OF_LAST_LOW * last_p[i]
base_p[i] = p0[i] + (h * (RATTLE_IMPULSE_LOW @ f[i]) - mean[i])
"""
COUPLED_END = "z[i] = RATTLE_UNKNOWNS @ v[i]"
"""The same for masses that depend on positions; the guess has the low words of the tables."""

PAIR_RESIDUALS = f"""{FORCES}
a[i] = mass(f[i])
moved[i] = RATTLE_DRIFT * drift[i] + square * (RATTLE_RESPONSE @ a[i])
r[i] = word((q0[i] + moved[i]) - u[i])
gh[k] = word(g[k])
"""
PAIR_CORRECTIONS = """
G[e] = former(derivative[e])
y[i] = scale * (RATTLE_INVERSE @ r[i])
x[pos(k)] = scale * (RATTLE_INVERSE @ gh[k])
x[pos(row(e))] += G[e] * y[col(e)]
x[k] = solve(x[k])
lam[k] += -x[pos(k)]
s[i] = zero
s[col(e)] -= G[e] * x[pos(row(e))]
b[i] = mass(s[i])
d[i] = b[i]
curved[i] = hh * (RATTLE_RESPONSE @ d[i])
moved[i] += curved[i]
r[i] = r[i] + curved[i]
u[i] += r[i]
"""
"""Residuals in two words of the solution in one, and its correction by the same iteration in one word."""


OF_POINTS = {
    "mass": "find_accelerations(now->inverse_mass, ARGUMENT, TARGET);",
    "solve": "solve_points(l[g], ARGUMENT);",
    "factorise": "refactorise_points(factorised, ARGUMENT, now->inverse_mass, l[g]);",
    "invert": "invert_masses(factorised, now, g);",
}
VARYING_MASS = {name: text.replace("inverse_mass", "inverse_mass[g]") for name, text in OF_POINTS.items()}
VECTOR_MASS = {"mass": "vector_accelerations(solved->inverse_mass, ARGUMENT, TARGET, g);"}
OF_PARTS = {"rattle": ("a w", OF_POINTS), "coupled_rattle": ("a v y p f c masses", VARYING_MASS)}
"""Values at all points that only one of the headers has in memory, and its operations."""
OF_EACH_POINT = "RATTLE_{0} RATTLE_{0}_LOW RATTLE_{1} RATTLE_{1}_LOW RATTLE_START RATTLE_VELOCITY_START"
"""Tables with a number for each point."""


def _of_constraints(names: str) -> dict[str, Quantity]:
    """Return the quantities of a constrained step, which the headers declare; ``names``: of values in memory."""
    return {
        **_of("now->{}", f"{names} at g force derivative velocity:v shift:A turned:change", Place.MEMORY),
        **_of("{}", "forced all z", Place.MEMORY),
        **_of("now->{}", "base base_v base_p lam:lambda", Place.GROUPS),
        **_of("{}", "change", Place.GROUPS),
        **_of("step->{}", "q0 p0 carry_q", uniform=True),
        **_of("now->{}", "v0 last_p", uniform=True),
        **_of("{}", OF_EACH_POINT.format("DRIFT", "MEAN_OF_LAST"), Place.TABLE),
        "u": Quantity("now->u", Place.MEMORY, first="step->q0"),
        "zero": Quantity("lanes_of(0)", Place.NUMBER),
        "GROWN": Quantity("GROWN(now, g)", Place.NUMBER),
        "h": Quantity("step->h", Place.NUMBER, uniform=True),
        "hh": Quantity("(step->h * step->h)", Place.NUMBER, uniform=True),
        "rate": Quantity("(1 / step->h)", Place.NUMBER, uniform=True),
        "scale": Quantity("scale", Place.NUMBER, uniform=True),
    }


ITERATE = "iterate", ", factors *l, condition factorised, lanes (*change)[GROUPS]"
UNKNOWNS, FORCED = ", number (*z)[GROUP_LANES]", "number (*forced)[GROUP_LANES]"
CONSTRAINED = {
    "rattle": (
        ("An iteration for the positions u and multipliers lam at the points", *ITERATE, RATTLE),
        ("Positions and velocities at all points but the last", "move_points", "", MOVE),
        ("Shifts w of the velocities by momentum terms, and their changes", "find_shifts", "", SHIFTS),
        ("Accelerations of the guess, positions without them", "begin_points", f", {FORCED}", BEGIN),
        ("All forces, and velocities z", "finish_points", f", number (*all)[GROUP_LANES]{UNKNOWNS}", FORCES + END),
    ),
    "coupled_rattle": (
        ("An iteration for the velocities v and multipliers lam at the points", *ITERATE, COUPLED_RATTLE),
        ("Positions of the guess", "begin_positions", "", COUPLED_POSITIONS),
        ("Momenta without forces", "begin_momenta", "", COUPLED_FORCES + COUPLED_MOMENTA),
        ("All forces, and unknowns z", "finish_points", UNKNOWNS, COUPLED_FORCES + COUPLED_END),
    ),
}
"""Functions of the headers of constrained steps: title, name, arguments after those of the step, statements."""


def rattle_functions(part: str, features: Sequence[str]) -> str:
    """Return the functions of a constrained step; ``part`` is the header that they belong to."""
    names, operations = OF_PARTS[part]
    functions = []
    for title, name, arguments, text in CONSTRAINED[part]:
        if not selected(text, features):
            continue
        printer = Printer(_of_constraints(names), PointsAsLanes(), operations)
        first = ["const real scale = 1 / (step->h * step->h);"] if "scale" in text else []
        head = f"static inline void {name}(const step_data *step, rattle_step *now{arguments})"
        functions.append(_function(title, head, *first, *printer.function_of_points(read(text, features))))
    return "\n".join(functions)


def pair_rattle_functions() -> str:
    """Return the functions of the correction in two words of the solution of a constrained step."""
    corrected = _of("at->{}", "u moved lam:lambda", Place.GROUPS, 2) | _of("{}", "r gh:g_high", Place.MEMORY)
    pairs = {
        **corrected,
        **_of("at->{}", "g derivative force", Place.GROUPS, 2),
        **_of("at->{}", "drift q0", words=2, uniform=True),
        **_of("{}", "square", Place.NUMBER, 2, uniform=True),
        **_of("{}", "RATTLE_DRIFT", Place.TABLE, 2),
    }
    words = _of_constraints("") | {"hh": Quantity("hh", Place.NUMBER, uniform=True)}
    numbers = {name: words[name] for name in ("derivative", "scale", "hh", "zero")}
    forces, residuals, corrections = (
        Printer(quantities, PointsAsLanes(2), operations).function_of_points(read(text))
        for quantities, operations, text in (
            (pairs | _of("at->{}", "f", Place.GROUPS, 2), VECTOR_MASS, FORCES),
            (pairs, VECTOR_MASS, PAIR_RESIDUALS),
            (numbers | corrected, OF_POINTS, PAIR_CORRECTIONS),
        )
    )
    square = "const dd square = dd_multiply(at->h, at->h);"
    scales = (
        "const int factorised = 1;",
        "const real hh = at->h.high * at->h.high, scale = 1 / hh;",
        "(void)factorised;",
    )
    head, memory = "static inline void", "real (*r)[GROUP_LANES], real (*g_high)[GROUP_LANES]"
    functions = (
        ("F + G^T lambda at all points but the last", "all_pair_forces(rattle_pairs *at)", forces),
        (
            "Residuals r of the positions and g of the constraints, and h^2 R a + h c v0",
            f"find_pair_residuals(const solved_step *solved, rattle_pairs *at, {memory})",
            (square, *residuals, "IN_MEMORY(*r);", "IN_MEMORY(*g_high);"),
        ),
        (
            "Corrects the multipliers, and replaces r by the correction of the positions",
            f"correct_points(const rattle_step *now, rattle_pairs *at, factors *l, {memory})",
            (*scales, *corrections),
        ),
    )
    return "\n".join(_function(purpose, f"{head} {function}", *lines) for purpose, function, lines in functions)


def _function(purpose: str, head: str, *lines: str) -> str:
    """Return a function from its lines; directives are not indented."""
    body = (line.lstrip() if line.lstrip().startswith("#") else f"  {line}" for line in lines)
    return "\n".join((f"/* {purpose}. */", head, "{", *body, "}", ""))
