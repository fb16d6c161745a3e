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


def splitting_step(split: Splitting, layout: Layout, *, action: bool) -> list[str]:
    """Return the lines of C that compute the increments of a step of a splitting method."""
    features = {"masses": split.by_masses, "bodies": bool(split.bodies), "action": action}
    words, alike = layout.words, not layout.lanes
    pairs, time = ("_pairs", "") if words == 2 else ("", "step->")
    arrays = {name: Quantity(name, words=words, uniform=alike) for name in ("F", "inverse_mass")}
    increments = {x: Quantity(x if words == 2 else f"d{x}", words=words, uniform=alike) for x in "qp"}
    states = {f"{x}0": Quantity(f"step->{x}0", Place.STATE, low=f"step->carry_{x}", uniform=alike) for x in "qp"}
    numbers = {x: Quantity(f"{time}{x}", Place.NUMBER, words, uniform=True) for x in "th"}
    of_run = {"L": Quantity("acted[0]", Place.NUMBER), "S": Quantity("acted[1]", Place.NUMBER)}
    if words == 1:
        arrays["inverse_mass"] = Quantity("data->inverse_mass", uniform=alike)
    operations = {
        "force": f"force{pairs}(ARGUMENT, TIME, step->parameters, TARGET);",
        "velocity": "drift_velocity(ARGUMENT, TIME, step->parameters, TARGET);",
        "at_rest": "at_rest(ARGUMENT, TIME, step->parameters, &TARGET);",
        "turn": TURN.replace("AXES", "PRINCIPAL_AXES[k]" if split.principal else "NULL"),
    }
    printer = Printer({**arrays, **increments, **states, **numbers, **of_run}, layout, operations)
    statements = read(split.statements, [name for name, holds in features.items() if holds])
    return printer.function_body([*velocities_by_masses(statements)] if split.by_masses else statements)


def splitting_texts(split: Splitting) -> dict[str, str]:
    """Return the statements of an explicit step and its tables, by titles."""
    features = [name for name, holds in (("masses", split.by_masses), ("bodies", split.bodies)) if holds]
    rows = (f"{name} = {', '.join(f'{float(x):.17g}' for x in numbers)}\n" for name, numbers in split.numbers.items())
    return {
        "increments q and p of the state q0, p0": f"{selected(split.statements, features)}\n",
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
    lines = splitting_step(split, layout, action=action)
    purpose = "Computes the increments of one step{}. F is the last force; it is that of the first kick if `known`"
    first = [] if split.leaps else ["(void)known, (void)F;"]
    if split.driven and layout.words == 2:
        first += ["known = 0; /* inputs, which may jump between steps, have changed the last force */"]
    if layout.words == 1:
        acted = ", and if the action is summed\n * acted[1], its part over h, and acted[0], the last L at v = 0"
        arguments = "const solver_data *data, int known, number *F, number *dq, number *dp,\n    number *acted"
        starts = ["memset(dq, 0, sizeof(number) * M);", "memset(dp, 0, sizeof(number) * M);"]
        starts += ["acted[1] = 0;"] if action else ["(void)acted;"]
        starts += [] if split.by_masses or split.bodies else ["(void)data;"]
        head = f"SPLITTING void leap(const step_data *step, {arguments})"
        return _function(purpose.format(acted), head, *starts, *first, *lines)
    kind, zero = layout.number, f"{layout.number}_word({'lanes_of(0.0)' if layout.lanes else '0.0'})"
    arguments = f"dd t, dd h, const {kind} *inverse_mass, int known, {kind} *F,\n    number *dq, number *dp"
    starts = [f"{kind} q[M], p[M];", "for (int i = 0; i < M; i++)", f"  q[i] = p[i] = {zero};"]
    words = [f"  d{x}[i] = {x}[i].high, d{x}[M + i] = {x}[i].low;" for x in "qp"]
    head = f"static inline void leap_in_pairs(const step_data *step, {arguments})"
    ends = ["for (int i = 0; i < M; i++) {", *words, "}"]
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
    own = {name: Quantity(f"bath->{name}") for name in ("decay", "strength")}
    own |= {"mean": Quantity("(bath->terms + 1)"), "sigma": Quantity("(bath->terms + BATH_TERMS - STRENGTHS)")}
    own |= {"xi": Quantity("normals"), "eta": Quantity("(normals + M)"), "carry": Quantity("carry")}
    own |= {"heat": Quantity("heat", Place.NUMBER), "root": Quantity("bath->root", Place.NUMBER)}
    own |= {"p": Quantity("p", Place.STATE, low="carry")}
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


RATTLE = """
G[e] = former(derivative[e])
factorise(G)
if velocity_forces:
    f[i] = force[i]
else:
    f[i] = former(force[i])
f[col(e)] += G[e] * lam[row(e)]
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
a[i] = mass(f[i])
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
f[i] = force[i]
f[col(e)] += (GROWN * G[e]) * lam[row(e)]
invert(masses)
factorise(G)
mean[i] = (RATTLE_MEAN @ p[i]) + RATTLE_MEAN_OF_LAST * last_p[i]
r[i] = (base_p[i] + (h * (RATTLE_IMPULSE @ f[i]) - mean[i])) / GROWN
y[i] = mass(r[i])
moved[i] = h * (RATTLE_DISPLACEMENT @ y[i])
c[k] = g[k]
c[row(e)] += derivative[e] * moved[col(e)]
x[pos(k)] = (RATTLE_INVERSE @ c[k]) * scale
x[k] = solve(x[k])
lam[k] -= x[pos(k)]
H[e] = former(derivative[e])
s[i] = zero
s[col(e)] -= (GROWN * H[e]) * x[pos(row(e))]
w[i] = h * (RATTLE_IMPULSE @ s[i]) / GROWN
d[i] = mass(w[i])
v[i] = v[i] + (y[i] + d[i])
m[i] = base[i] + h * (RATTLE_DISPLACEMENT @ v[i])
change[i] = m[i] - u[i]
u[i] = m[i]
"""
"""The same for masses that depend on positions: y = M^-1 r with the residual r of the momenta,
P x = (D I)^-1 (g + h G D y) / h^2, v += y - h M^-1 I G^T x."""

FORCES = """
if velocity_forces:
    f[i] = force[i]
else:
    f[i] = former(force[i])
f[col(e)] += former(derivative[e]) * lam[row(e)]
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
    low[i] = RATTLE_DRIFT_LOW * (h * v0[i]) + hh * (RATTLE_RESPONSE_LOW @ a[i]) - h * (RATTLE_SHIFT_LOW @ w[i])
else:
    a[i] = rate * (RATTLE_INVERSE @ forced[i])
    low[i] = RATTLE_DRIFT_LOW * (h * v0[i]) + hh * (RATTLE_RESPONSE_LOW @ a[i])
if velocity_forces:
    base_v[i] = v0[i] + (RATTLE_VELOCITY_START * v0[i] + h * (RATTLE_VELOCITY_LOW @ a[i]))
base[i] = q0[i] + (carry_q[i] + (low[i] + RATTLE_DRIFT * (h * v0[i])))
"""
END = """
a[i] = mass(f[i])
all[i] = f[i]
push[i] = RATTLE_START * v0[i] + h * ((RATTLE_MOMENTUM @ a[i]) + (RATTLE_MOMENTUM_LOW @ a[i]))
if momentum_terms:
    z[i] = v0[i] + (push[i] - (RATTLE_PROJECTION @ w[i]))
else:
    z[i] = v0[i] + push[i]
"""
"""Forces with reactions; their arguments; w of momenta; accelerations of the guess, and positions without forces;
velocities z of the curve."""

COUPLED_FORCES = """
f[i] = force[i]
f[col(e)] += GROWN * former(derivative[e]) * lam[row(e)]
"""
COUPLED_POSITIONS = """
base[i] = q0[i] + (carry_q[i] + h * (RATTLE_DISPLACEMENT_LOW @ v[i]))
u[i] = base[i] + h * (RATTLE_DISPLACEMENT @ v[i])
"""
COUPLED_MOMENTA = """
mean[i] = (RATTLE_MEAN_LOW @ p[i]) + RATTLE_MEAN_OF_LAST_LOW * last_p[i]
base_p[i] = p0[i] + (h * (RATTLE_IMPULSE_LOW @ f[i]) - mean[i])
"""
COUPLED_END = "z[i] = RATTLE_UNKNOWNS @ v[i]"
"""The same for masses that depend on positions; the guess has the low words of the tables."""

PAIR_RESIDUALS = """
f[i] = former(force[i])
f[col(e)] += former(derivative[e]) * lam[row(e)]
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
d[i] = mass(s[i])
curved[i] = hh * (RATTLE_RESPONSE @ d[i])
moved[i] += curved[i]
r[i] = r[i] + curved[i]
u[i] += r[i]
"""
"""Residuals in two words of the solution in one, and its correction by the same iteration in one word."""


def _number(text: str, words: int = 1) -> Quantity:
    return Quantity(text, Place.NUMBER, words, uniform=True)


OF_POINTS = {
    "mass": "find_accelerations(now->inverse_mass, ARGUMENT, TARGET);",
    "solve": "solve_points(l[g], ARGUMENT);",
    "factorise": "refactorise_points(factorised, ARGUMENT, now->inverse_mass, l[g]);",
    "invert": "invert_masses(factorised, now, g);",
}
VARYING_MASS = {name: text.replace("inverse_mass", "inverse_mass[g]") for name, text in OF_POINTS.items()}
VECTOR_MASS = {"mass": "vector_accelerations(solved->inverse_mass, ARGUMENT, TARGET, g);"}


TABLES_OF_POINTS = "DRIFT", "DRIFT_LOW", "START", "VELOCITY_START", "MEAN_OF_LAST", "MEAN_OF_LAST_LOW"
"""Tables with a number for each point."""


def _of_constraints() -> dict[str, Quantity]:
    """Return the quantities of a constrained step, which the headers declare."""
    memory = {name: Quantity(f"now->{name}", Place.MEMORY) for name in "auwvyp"}
    memory |= {name: Quantity(name, Place.MEMORY) for name in ("forced", "all", "z")}
    memory |= {"at": Quantity("now->at", Place.MEMORY), "velocity": Quantity("now->v", Place.MEMORY)}
    memory |= {"shift": Quantity("now->A", Place.MEMORY), "u": Quantity("now->u", Place.MEMORY, first="step->q0")}
    groups = {name: Quantity(f"now->{name}", Place.GROUPS) for name in ("base", "base_v", "base_p")}
    start = {name: Quantity(f"step->{name}", uniform=True) for name in ("q0", "p0", "carry_q")}
    start |= {name: Quantity(f"now->{name}", uniform=True) for name in ("v0", "last_p")}
    tables = {f"RATTLE_{name}": Quantity(f"RATTLE_{name}", Place.TABLE) for name in TABLES_OF_POINTS}
    return {**memory, **groups, **start, **tables} | {
        "derivative": Quantity("now->derivative", Place.MEMORY, first="now->first_derivative", index="e"),
        "force": Quantity("now->force", Place.MEMORY, first="now->first_force"),
        "turned": Quantity("now->change", Place.MEMORY),
        "g": Quantity("now->g", Place.MEMORY, index="k"),
        "lam": Quantity("now->lambda", Place.GROUPS, index="k"),
        "change": Quantity("change", Place.FLAT),
        "zero": Quantity("lanes_of(0)", Place.NUMBER),
        "h": _number("step->h"),
        "hh": _number("(step->h * step->h)"),
        "rate": _number("(1 / step->h)"),
        "scale": _number("scale"),
    }


ITERATE = "iterate", ", factors *l, condition factorised, lanes *change"
UNKNOWNS = ", number (*z)[GROUP_LANES]"
CONSTRAINED = {
    "rattle": (
        ("An iteration for the positions u and multipliers lam at the points", *ITERATE, RATTLE),
        ("Positions and velocities at all points but the last", "move_points", "", MOVE),
        ("Shifts w of the velocities by momentum terms, and their changes", "find_shifts", "", SHIFTS),
        (
            "Accelerations of the guess, positions without them",
            "begin_points",
            ", number (*forced)[GROUP_LANES]",
            BEGIN,
        ),
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
    own = _of_constraints()
    if part == "rattle":
        printer = Printer({name: own[name] for name in own if name not in "vyp"}, PointsAsLanes(), OF_POINTS)
    else:
        own["f"] = own["s"] = Quantity("now->f", Place.MEMORY)
        own["c"] = Quantity("now->c", Place.MEMORY, index="k")
        own["masses"] = Quantity("now->mass", Place.MEMORY, index="e")
        own["GROWN"] = Quantity("GROWN(now, g)", Place.NUMBER)
        printer = Printer({name: own[name] for name in own if name != "w"}, PointsAsLanes(), VARYING_MASS)
    functions = []
    for title, name, arguments, text in CONSTRAINED[part]:
        if not selected(text, features):
            continue
        lines = replace(printer, locals={}).function_of_points(read(text, features))
        first = "const real scale = 1 / (step->h * step->h);" if "scale" in text else "(void)step;"
        head = f"static inline void {name}(const step_data *step, rattle_step *now{arguments})"
        functions.append(_function(title, head, first, *lines))
    return "\n".join(functions)


def pair_rattle_functions() -> str:
    """Return the functions of the correction in two words of the solution of a constrained step."""
    pairs = {
        "derivative": Quantity("at->derivative", Place.MEMORY, 2, first="at->first_derivative", index="e"),
        "force": Quantity("at->force", Place.MEMORY, 2, first="at->first_force"),
        "lam": Quantity("at->lambda", Place.GROUPS, 2, index="k"),
        "drift": Quantity("at->drift", words=2, uniform=True),
        "square": _number("square", 2),
        "q0": Quantity("at->q0", words=2, uniform=True),
        "u": Quantity("at->u", Place.GROUPS, 2),
        "g": Quantity("at->g", Place.GROUPS, 2, index="k"),
        "moved": Quantity("at->moved", Place.GROUPS, 2),
        "RATTLE_DRIFT": Quantity("RATTLE_DRIFT", Place.TABLE, 2),
        "r": Quantity("r", Place.MEMORY),
        "gh": Quantity("g_high", Place.MEMORY, index="k"),
    }
    forces = Printer(pairs | {"f": Quantity("at->f", Place.GROUPS, 2)}, PointsAsLanes(2), VECTOR_MASS)
    residuals = Printer(pairs, PointsAsLanes(2), VECTOR_MASS).function_of_points(read(PAIR_RESIDUALS))
    words = _of_constraints()
    own = {name: words[name] for name in ("derivative", "scale", "hh", "zero")}
    own |= {name: pairs[name] for name in ("r", "gh", "lam", "moved", "u")}
    corrections = Printer(own, PointsAsLanes(2), OF_POINTS).function_of_points(read(PAIR_CORRECTIONS))
    corrections = [line.replace("(step->h * step->h)", "hh") for line in corrections]
    scales = "const real hh = at->h.high * at->h.high, scale = 1 / hh;"
    head, memory = "static inline void", "real (*r)[GROUP_LANES], real (*g_high)[GROUP_LANES]"
    functions = (
        _function(
            "F + G^T lambda at all points but the last",
            f"{head} all_pair_forces(rattle_pairs *at)",
            *forces.function_of_points(read(FORCES)),
        ),
        _function(
            "Residuals r of the positions and g of the constraints, and h^2 R a + h c v0",
            f"{head} find_pair_residuals(const solved_step *solved, rattle_pairs *at, {memory})",
            *("const dd square = dd_multiply(at->h, at->h);", *residuals, "IN_MEMORY(*r);", "IN_MEMORY(*g_high);"),
        ),
        _function(
            "Corrects the multipliers, and replaces r by the correction of the positions",
            f"{head} correct_points(const rattle_step *now, rattle_pairs *at, factors *l, {memory})",
            *("const int factorised = 1;", scales, "(void)factorised;", *corrections),
        ),
    )
    return "\n".join(functions)


def _function(purpose: str, head: str, *lines: str) -> str:
    """Return a function from its lines."""
    return f"/* {purpose}. */\n{head}\n{{\n{_indented(lines)}}}\n"


def _indented(lines: Iterable[str]) -> str:
    """Return the lines of a function; directives are not indented."""
    return "".join(f"{line.lstrip()}\n" if line.lstrip().startswith("#") else f"  {line}\n" for line in lines)
