"""Closed form of a step: all equations as exact SymPy expressions, with the paper's numbers.

    >>> from scvi_codegen.methods import SCVI
    >>> from scvi_codegen.interfaces.models.problems import problem
    >>> equation = derive(problem("planar-pendulum").system, SCVI(1, "gauss-legendre:2"), radicals=True).equations[0]
    >>> names = {symbol.name: symbol for symbol in equation.residual.free_symbols}
    >>> expected = sympy.sympify("m*l**2*((Q_1 - q_k)/h**2 - v_0/h) + m*g*l*sin(Q_1)", names)
    >>> equation.number, sympy.simplify(equation.residual - expected)
    ('34a', 0)

Entries of nodes' and quadratures' tables appear as named symbols with their values beside them, or as radicals where
these are short. Nothing is simplified after the derivation. The compiled code solves the same
equations with velocities in place of the positions Q^v (:mod:`scvi_codegen.methods.stage_system`); a test compares the
steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import shorten
from typing import TYPE_CHECKING, Any, cast, overload

import sympy

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.formulas import Number, jacobian
from scvi_codegen.api.methods import Discretisation, Method, StageSystem
from scvi_codegen.api.program import Derivation
from scvi_codegen.api.systems import ArraySystem, MechanicalSystem
from scvi_codegen.api.text import Html, counted
from scvi_codegen.extras.derivation.notation import (
    LARGEST_DENOMINATOR,
    LARGEST_SHOWN,
    Equation,
    TableEntry,
    contact_lines,
    entries,
    formula_text,
    html,
    latex,
    text_lines,
)
from scvi_codegen.methods import as_method
from scvi_codegen.methods.stage_system import Table
from scvi_codegen.systems.first_order import FirstOrderSystem
from scvi_codegen.systems.symmetry.symmetry import Symmetry, symmetries

if TYPE_CHECKING:
    from scvi_codegen.extras.derivation.arrays import ArrayStepEquations

MOVING_FRAME = "moving frame: V(Phi_tau(Q, P)) in place of H_0, tau = (c_n - 1/2) h, between two steps of h/2 of Phi_t:"
FREE_ROTATION = "Phi_t: q, p <- q, p exp(t Pi/(2 A)), flow of the kinetic energy of H_0 = H - kappa Pi_k^2/2"
MOST_SHOWN = 12
"""Largest number of equations that a notebook shows."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class StepEquations:
    """Equations of one step, to display and to compute with.

    Attributes:
        system, method: the system and the method.
        stages: the stage system.
        unknowns: of the equations.
        state: (q_k, p_k): two tuples of m symbols.
        time: t_k; ``step`` is h.
        equations: as many as unknowns.
        end_position, end_momentum: m equations each, ``residual`` being the new value itself.
        entries: the table entries that occur.
        initial_guess: of each unknown, for uniform motion with velocity ``v_k``.
    """

    system: MechanicalSystem
    method: Method
    stages: StageSystem
    unknowns: tuple[sympy.Symbol, ...]
    state: tuple[tuple[sympy.Symbol, ...], tuple[sympy.Symbol, ...]]
    time: sympy.Symbol
    step: sympy.Symbol
    equations: tuple[Equation, ...]
    end_position: tuple[Equation, ...]
    end_momentum: tuple[Equation, ...]
    entries: tuple[TableEntry, ...]
    initial_guess: Mapping[sympy.Symbol, sympy.Expr]

    @property
    def idel_equations(self) -> tuple[Equation, ...]:
        """The implicit discrete Euler-Lagrange equations (5): those with p_k, then those for p_{k+1}."""
        return (*(equation for equation in self.equations if equation.kind == "IDEL"), *self.end_momentum)

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Symmetries of the system, with their first integrals."""
        return symmetries(self.system)

    @property
    def statements(self) -> Mapping[str, str]:
        """Statements that the C of a step is generated from, by their titles; none of other steps."""
        return Derivation(self.system, self.method).statements

    @property
    def jacobian(self) -> sympy.ImmutableSparseMatrix:
        """Derivatives of the residuals with respect to the unknowns, square and sparse."""
        size = len(self.unknowns)
        entries = jacobian([equation.residual for equation in self.equations], self.unknowns)
        return sympy.ImmutableSparseMatrix(size, size, entries)

    def numeric(self, expression: sympy.Expr) -> sympy.Expr:
        """Return ``expression`` with the values of table entries, to 50 digits."""
        return expression.xreplace({entry.symbol: sympy.Float(str(entry.value), 50) for entry in self.entries})

    def to_text(self) -> str:
        """Return plain text: unknowns, equations, end state, guess, tables."""
        written = text_lines(self.equations, self._end, self.initial_guess, self.entries)
        return "".join(f"{line}\n" for line in (*self._heading(), *written, *self._statements(), *self._conserved()))

    def to_latex(self) -> str:
        """Return LaTeX: ``align*`` with the paper's numbers as tags, the tables, and statements as ``verbatim``."""
        listed = (f"\n\\begin{{verbatim}}\n{text}\\end{{verbatim}}" for text in self.statements.values())
        return latex(self.equations, self._end, self.entries, self.symmetries) + "".join(listed)

    @property
    def _end(self) -> dict[sympy.Symbol, Equation]:
        return dict(zip((*self.state[0], *self.state[1]), (*self.end_position, *self.end_momentum), strict=True))

    def _heading(self) -> Iterator[str]:
        q, p = self.state
        yield f"{self.system.name}: {self.method.title}"
        yield from (
            rotation.description
            for rotation in (*self.system.rotations, *Discretisation(self.system, self.method).turns)
        )
        if Discretisation(self.system, self.method).in_moving_frame:
            yield from (MOVING_FRAME, FREE_ROTATION)
        yield f"{'H' if self.system.auxiliaries else 'L'} = {formula_text(self.system.formula)}"
        for g in self.system.constraints:
            yield f"0 = {formula_text(g)}"
        yield from contact_lines(self.system)
        if isinstance(self.system, FirstOrderSystem):
            yield f"subtracted from L: d/dt of {self.system.text_of(self.system.integrated)}"
            for momentum, theta in zip(p, self.system.one_form, strict=True):
                yield f"{momentum.name.removesuffix('_k')} = {self.system.text_of(theta)}"
        yield f"known: {', '.join(s.name for s in (*q, *p, self.time, self.step))}"
        yield f"unknown: {', '.join(s.name for s in self.unknowns)}"

    def _statements(self) -> Iterator[str]:
        for title, text in self.statements.items():
            yield f"\nstatements of the C: {title}"
            yield from (f"  {line}" for line in text.splitlines())

    def _conserved(self) -> Iterator[str]:
        if self.symmetries:
            variables = "positions and momenta" if self.system.auxiliaries else "the coordinates"
            yield f"\nconserved (momentum maps of symmetries affine in {variables}, which are what is searched)"
        for symmetry in self.symmetries:
            guaranteed = self.method.exactness.conserves(symmetry)
            yield f"  {symmetry}{'' if guaranteed else '  (not guaranteed by this method)'}"

    def __repr__(self) -> str:
        count = counted(len(self.equations), "equation")
        return shorten(f"<{count} of {self.system.name} by {self.method.name}>", 100, placeholder="..")

    def _repr_latex_(self) -> str | None:
        """Return the LaTeX of all equations, nothing if a notebook could not show them."""
        size = sympy.count_ops(self.equations[0].residual) * len(self.equations)
        if size > MOST_SHOWN * LARGEST_SHOWN:
            return None
        return latex(self.equations, self._end, self.entries, self.symmetries)

    def _repr_html_(self) -> str:
        shown = [html(equation) for equation in self.equations[:MOST_SHOWN]]
        left_out = len(self.equations) - len(shown)
        more = [Html.plain(f"and {left_out} more: to_text and to_latex have all")] if left_out else []
        facts = (
            ("unknown", Html.listed([symbol.name for symbol in self.unknowns])),
            ("table entries", Html.listed([entry.symbol.name for entry in self.entries])),
        )
        return Html.card(f"{self.system.name}: {self.method.title}", facts, *shown, *more)


@overload
def derive(  # type: ignore[overload-overlap]
    system: ArraySystem, method: Method | str, *, radicals: bool = False
) -> ArrayStepEquations: ...
@overload
def derive(system: MechanicalSystem, method: Method | str, *, radicals: bool = False) -> StepEquations: ...
@checks_arguments(system=MechanicalSystem.OR_ARRAYS)
def derive(
    system: MechanicalSystem, method: Method | str, *, radicals: bool = False
) -> StepEquations | ArrayStepEquations:
    """Return the closed form of one step in the notation of the paper; of run-time sizes its kernels and loops.

    Args:
        system: the Lagrangian.
        method: or its name. SVI: (27); SCVI: (34), with its multipliers unless as printed; SC: (18), (21); Runge-Kutta:
            (22).
        radicals: replace table entries by radicals if they have a short form.
    """
    if isinstance(system, ArraySystem):
        from scvi_codegen.extras.derivation.arrays import ArrayStepEquations

        method = as_method(method, system)
        return ArrayStepEquations(cast(ArraySystem, Derivation(system, method).form), method)
    method = as_method(method, system)
    system = Derivation(system, method).written_form
    stages = Discretisation(system, method).paper
    writer = _Writer(system, stages)
    equations = writer.equations()
    end_position, end_momentum = writer.end_state()
    derived = StepEquations(
        system=system,
        method=method,
        stages=stages,
        unknowns=tuple(itertools.chain.from_iterable(writer.unknowns)),
        state=(writer.q, writer.p),
        time=writer.time,
        step=writer.step,
        equations=equations,
        end_position=end_position,
        end_momentum=end_momentum,
        entries=entries(writer.values, method),
        initial_guess=writer.guess(),
    )
    return _with_radicals(derived) if radicals else derived


class _Writer:
    """Writer of a stage system: gathers into arguments, arguments into kernels, kernels into rows."""

    def __init__(self, system: MechanicalSystem, stages: StageSystem) -> None:
        self.system, self.stages = system, stages
        names = [q.name for q in system.coordinates]
        self.reserved = {
            symbol.name for symbol in (*system.coordinates, *system.velocities, *system.auxiliaries, *system.parameters)
        }
        self.step = self._symbol("h")
        self.q = tuple(self._symbol(f"{name}_k") for name in names)
        self.p = tuple(self._symbol(f"p_{name}_k" if len(names) > 1 else "p_k") for name in names)
        self.v = tuple(self._symbol(f"{name}_dot_k") for name in names)
        self.time = self._symbol(f"{system.time.name}_k")
        self.unknowns = [
            tuple(self._symbol(f"{block.name}_{part}" if len(parts) > 1 else block.name) for part in parts)
            for block in stages.blocks
            for parts in [names if block.size is None else range(1, block.size + 1)]
        ]
        self.values: dict[sympy.Symbol, tuple[Any, Number]] = {}

    def _symbol(self, name: str) -> sympy.Symbol:
        """Return a symbol of the derivation, with underscores before its name if the system has one of that name."""
        while name in self.reserved:
            name = f"_{name}"
        return sympy.Symbol(name, real=True)

    def equations(self) -> tuple[Equation, ...]:
        rows = self._rows()
        return tuple(
            Equation(row.number, row.kind, sympy.Add(*rows[r][i]))
            for r, row in enumerate(self.stages.rows)
            for i in range(len(rows[r]))
        )

    def end_state(self) -> tuple[tuple[Equation, ...], tuple[Equation, ...]]:
        number_q, number_p = self.stages.end_numbers
        position = self._gathered(self.stages.end_position, 0, power=0, scale=sympy.S.One)
        shrunk = sympy.exp(-self.stages.damping * self.step)
        end = [[shrunk * sympy.Add(*terms)] for terms in self._rows()[-1]] if shrunk != 1 else self._rows()[-1]
        return (
            tuple(Equation(number_q, "end", value) for value in position),
            tuple(Equation(number_p, "IDEL", sympy.Add(*terms)) for terms in end),
        )

    def guess(self) -> dict[sympy.Symbol, sympy.Expr]:
        """Return the initial guess: uniform motion."""
        guess = {}
        for block, symbols in zip(self.stages.blocks, self.unknowns, strict=True):
            rest, moving = (_rational(x) for x in block.straight)
            for i, symbol in enumerate(symbols):
                is_multiplier = block.size is not None
                moved = 0 if is_multiplier else moving * self.step ** (1 - block.power) * self.v[i]
                guess[symbol] = sympy.S.Zero if is_multiplier else rest * self.q[i] + moved + block.momentum * self.p[i]
        return guess

    def _rows(self) -> list[list[list[sympy.Expr]]]:
        sizes = self.stages.row_sizes(self.system.dimension)
        momenta = [*map(self._momentum, itertools.count(1), self.stages.rows), _rational(self.stages.end_momentum)]
        powers = [*(row.power for row in self.stages.rows), 0]
        rows: list[list[list[sympy.Expr]]] = [
            [[c * self.p[i]] if c != 0 else [] for i in range(size)] for c, size in zip(momenta, sizes, strict=True)
        ]
        for group in self.stages.stage_groups:
            for n in range(len(group.abscissae)):
                self._scatter(group, n, powers, rows)
        return rows

    def _momentum(self, column: int, row: Any) -> sympy.Expr:
        """Return the coefficient of p_k: the named entry of q_(k+1) in that column if it is one, else a number."""
        table = self.stages.end_position
        name = table.names[0][column] if column < len(table.names[0]) else None
        if name and name.of == "beta" and row.momentum == table.entries[0][column]:
            return self._named(name, row.momentum)
        return _rational(row.momentum)

    def _scatter(self, group: Any, n: int, powers: Sequence[int], rows: list[list[list[sympy.Expr]]]) -> None:
        arguments = self._arguments(group, n)
        weight = self._named(group.weight_names[n], group.weights[n]) * self._growth(group, n)
        for scatter in group.scatters:
            values = [result.xreplace(arguments) for result in scatter.results]
            scale = sympy.Rational(str(scatter.scale))
            for r, power in enumerate(powers):
                coefficient = self._entry(scatter.table, n, r)
                if coefficient == 0:
                    continue
                factor = weight * coefficient * self.step ** (scatter.power + power) * scale
                for i, value in enumerate(values):
                    rows[r][i].append(factor * value)

    def _growth(self, group: Any, n: int) -> sympy.Expr:
        """Return the factor of a weight due to damping."""
        if self.stages.damping == 0:
            return sympy.S.One
        return sympy.exp(self.stages.damping * self._abscissa(group, n) * self.step)

    def _abscissa(self, group: Any, n: int) -> sympy.Expr:
        """Return the abscissa of point n on the step, by its name."""
        return self._named(group.abscissa_name(n), group.abscissae[n])

    def _arguments(self, group: Any, n: int) -> dict[sympy.Symbol, sympy.Expr]:
        replaced = {}
        if any(self.system.time in result.free_symbols for result in group.results):
            replaced[self.system.time] = self.time + self._abscissa(group, n) * self.step
        for gather in group.gathers:
            values = self._gathered(gather.table, n, power=gather.power, scale=sympy.Rational(str(gather.scale)))
            replaced |= dict(zip(gather.arguments, values, strict=True))
        return replaced

    def _gathered(self, table: Table, n: int, *, power: int, scale: sympy.Rational) -> tuple[sympy.Expr, ...]:
        columns: list[tuple[Any, tuple[sympy.Symbol, ...]]] = [(None, self.q)]
        columns += list(zip(self.stages.blocks, self.unknowns, strict=True))
        sums: list[list[sympy.Expr]] = []
        for b, (block, symbols) in enumerate(columns):
            coefficient = self._entry(table, n, b)
            if coefficient == 0:
                continue
            factor = scale * coefficient * self.step ** (power + (block.power if block else 0))
            sums = sums or [[] for _ in symbols]
            for i, symbol in enumerate(symbols):
                sums[i].append(factor * symbol)
        return tuple(sympy.Add(*terms) for terms in sums)

    def _entry(self, table: Table, n: int, b: int) -> sympy.Expr:
        name, value = table.names[n][b], table.entries[n][b]
        if name is None:
            return self._named(None, value)
        factor = sympy.Rational(name.factor.numerator, name.factor.denominator)
        return factor * self._named(name, value / name.factor.numerator * name.factor.denominator)

    def _named(self, name: Any, value: Number) -> sympy.Expr:
        """Return the symbol of a number and record its value; without a name, the number."""
        if name is None:
            return sympy.Integer(int(value))
        symbol = self._symbol(name.number)
        self.values[symbol] = name, value
        return symbol


def _rational(value: Number) -> sympy.Expr:
    """Return a coefficient of p_k or of the straight line: small dyadic numbers and node positions."""
    exact = sympy.nsimplify(sympy.Float(str(value), 30), rational=True, tolerance=sympy.Float("1e-25"))
    return exact if exact.q <= LARGEST_DENOMINATOR else sympy.Float(str(value), 17)


def _with_radicals(derived: StepEquations) -> StepEquations:
    """Return the equations with table entries replaced by their exact forms, if there are any."""
    exact = {entry.symbol: entry.exact for entry in derived.entries if entry.exact is not None}

    def written(equations: tuple[Equation, ...]) -> tuple[Equation, ...]:
        return tuple(Equation(e.number, e.kind, e.residual.xreplace(exact)) for e in equations)

    return replace(
        derived,
        equations=written(derived.equations),
        end_position=written(derived.end_position),
        end_momentum=written(derived.end_momentum),
        entries=tuple(entry for entry in derived.entries if entry.exact is None),
    )
