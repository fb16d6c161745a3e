"""What a fault may be: a changed function, an edit of the C text, a wrong table; and changes to make."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import sympy
from certified_cases import CASES, CONTROLLED, case
from sabotage import Case, Make, Sabotage, changed_result

from scvi_codegen.ir.kernel import Operation
from scvi_codegen.methods import SVI, RungeKutta, acceleration_stages
from scvi_codegen.methods.stage_system import Table
from scvi_codegen.tables.nodes import chebyshev_lobatto
from scvi_codegen.tables.precision import mp

TO_NINE_DIGITS = replace(CONTROLLED, tolerance=1e-9)


@dataclass(frozen=True)
class Mutation:
    """A fault, what it is tried on, and how it is made."""

    name: str
    case: Case
    apply: Callable[[Sabotage], None]
    edits_text: bool = False


def function(name: str, where: str, home: Any, attribute: str, make: Make) -> Mutation:
    return Mutation(name, case(where), lambda sabotage: sabotage.replace(home, attribute, make))


def here(name: str, where: str, home: Any, attribute: str, make: Make) -> Mutation:
    return Mutation(name, case(where), lambda sabotage: sabotage.replace_here(home, attribute, make))


def inside(function: str, pattern: str) -> str:
    """The first place with a pattern after the head of a function; what stands before it is a group."""
    return rf"(\b{function}\([^;{{]*\)\n\{{\n(?:.*\n)*?.*?){pattern}"


def text(name: str, where: str, within: str, pattern: str, replacement: str) -> Mutation:
    """An edit of the C text, the first place after the head of the function ``within`` if one is named."""
    if within:
        pattern, replacement = inside(within, pattern), rf"\g<1>{replacement}"
    return Mutation(
        f"{name} {where}" if name.endswith(",") else name,
        TO_NINE_DIGITS if where == "to nine digits" else CASES.get(where) or case(where),
        lambda sabotage: sabotage.edit(pattern, replacement),
        edits_text=True,
    )


def wrong_tableau(name: str, where: str, **changes: Make) -> Mutation:
    """A tableau that is wrong from the beginning: both sides use it."""
    made = case(where).method()
    assert isinstance(made, RungeKutta)
    other = replace(made.tableau, **{key: change(getattr(made.tableau, key)) for key, change in changes.items()})
    return Mutation(name, replace(case(where), method=lambda: RungeKutta(other, made.form)), lambda sabotage: None)


def wrong_rule(name: str, where: str, change: Make) -> Mutation:
    """A quadrature that is wrong from the beginning."""
    made = case(where).method()
    assert isinstance(made, SVI)
    other = change(made.quadrature)
    return Mutation(name, replace(case(where), method=lambda: SVI(made.degree, other)), lambda sabotage: None)


def eight_digits(x: Any) -> Any:
    return type(x)(mp.nstr(mp.mpf(x), 8))


def eight_digits_text(x: Any, target: object = None) -> str:
    return f"{float(x):.7e}"


def scaled_first(factor: Any) -> Make:
    return lambda values: (values[0] * factor, *values[1:])


def doubled(entries: Any) -> Any:
    return {place: 2 * entry for place, entry in entries.items()}


def reversed_rows(rows: Any) -> Any:
    return tuple(rows[::-1])


def transposed(rows: Any) -> Any:
    return tuple(zip(*rows, strict=True))


def without_negation(original: Any) -> Any:
    def printed(expression: Any, *others: Any) -> Any:
        negated = isinstance(expression, Operation) and expression.operator == "neg"
        return original(expression.operands[0] if negated else expression, *others)

    return printed


def without_rates_of(*names: str) -> Make:
    """The chain rule without the terms of some variables."""

    def make(original: Any) -> Any:
        def rate(expressions: Any, variables: Any, rates: Any) -> Any:
            remaining = [pair for pair in zip(variables, rates, strict=False) if pair[0].name not in names]
            return original(expressions, *(tuple(part) for part in zip(*remaining, strict=True)))

        return rate

    return make


def partials(change: Callable[[int, sympy.Expr], sympy.Expr]) -> Make:
    """Derivatives of the kernel in Newton's matrix, not its values."""
    return changed_result(
        lambda found: (tuple(change(k, derivative) for k, derivative in enumerate(found[0])), found[1])
    )


def last_column_negated(stages: Any) -> Any:
    """The scatter tables of the last gather, with p1 changed by the other sign."""
    group = stages.stage_groups[-1]
    own = group.scatters[0]
    entries = tuple((*line[:-1], -line[-1]) for line in own.table.entries)
    scatter = replace(own, table=replace(own.table, entries=entries))
    return replace(
        stages, stage_groups=(*stages.stage_groups[:-1], replace(group, scatters=(scatter, *group.scatters[1:])))
    )


def of_another_system(original: Any) -> Any:
    """L + 1e-6 q in place of L: consistent, symplectic, symmetric."""
    return lambda self: original(replace(self, scalar=self.scalar + self.gathers[0].arguments[0] / 10**6))


def as_printed(sabotage: Sabotage) -> None:
    """The chain-rule term of the discrete Lagrangian lost everywhere, as in the paper."""
    sabotage.replace(acceleration_stages, "shooting_nodal", lambda _: acceleration_stages.printed_nodal)

    def printed(system: Any, tableau: Any, rule: Any, **_: Any) -> Any:
        return acceleration_stages.printed_increments(system, tableau, rule, chebyshev_lobatto(len(tableau.b)))

    sabotage.replace(acceleration_stages, "shooting_increments", lambda _: printed)


def power_rule_halved(original: Any) -> Any:
    """Of squares: d(x^2) = x dx."""

    def partial(node: Any, position: int) -> Any:
        found = original(node, position)
        return found / 2 if node.is_Pow and node.exp == 2 and position == 0 else found

    return partial


def without_last_of(table: Table, row: int) -> Table:
    """The scatter into a row without what the last point gives."""
    *lines, last = table.entries
    return replace(table, entries=(*lines, (*last[:row], 0 * last[row], *last[row + 1 :])))


def constraints_off(original: Any) -> Any:
    """The values of constraints with 1e-9 beside them."""

    def changed(system: Any, name: str, values: Any, **named: Any) -> Any:
        off = sympy.Rational(1, 10**9)
        bound = getattr(system, "constraints", ())
        return original(system, name, tuple(v + off if v in bound else v for v in values), **named)

    return changed


def moving_part(momentum: sympy.Expr) -> sympy.Expr:
    """The terms with velocities."""
    terms = sympy.Add.make_args(momentum)
    return sympy.Add(*(term for term in terms if any(x.name.endswith("_dot") for x in term.free_symbols)))
