"""The closed form of a step: every equation written out, with the paper's numbers, as exact SymPy.

    >>> from scvi_codegen.methods import SCVI
    >>> from scvi_codegen.models.problems import planar_pendulum
    >>> print(derive(planar_pendulum(), SCVI(1, "gauss-legendre:2"), radicals=True).equations[0])
    (34a) 0 = g*l*m*sin(Q_1) + l**2*m*(Q_1/h**2 - q_k/h**2 - v_0/h)

Entries of nodes' and quadratures' tables appear as named symbols with their values beside them, or as radicals where
these are short. Nothing is simplified: what stands here is what was derived. The compiled code solves the same
equations with velocities in place of the positions Q^v (:mod:`scvi_codegen.methods.stage_system`); a test compares the
steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import sympy

from scvi_codegen.display.cards import Html, card, listed, plain
from scvi_codegen.display.mathml import mathml_terms
from scvi_codegen.display.mathml.names import latex_name
from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.derivatives import jacobian
from scvi_codegen.mechanics.forms import accelerations, forms_of
from scvi_codegen.mechanics.symmetry.symmetry import Symmetry, symmetries
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.collocation import RungeKutta, SpectralCollocation
from scvi_codegen.methods.exactness import is_exact
from scvi_codegen.methods.method import Method, check_regular
from scvi_codegen.methods.phase_space import with_auxiliaries
from scvi_codegen.methods.stage_system import Block, PointFamily, StageSystem, Table
from scvi_codegen.tables.basis import differentiation_matrix
from scvi_codegen.tables.nodes import exact_points
from scvi_codegen.tables.precision import DIGITS, Number, mp
from scvi_codegen.tables.quadrature import exact_rule
from scvi_codegen.tables.tableau import exact_tableau

__all__ = ["Equation", "MatrixForm", "StepEquations", "TableEntry", "derive", "table_entries"]

LARGEST_BASIS = 8
LARGEST_COEFFICIENT = 10**5
PSLQ_SLACK = 6
MOST_SHOWN, MOST_SHOWN_OPERATIONS = 12, 4800
"""Equations, and operations of all equations, that a notebook shows."""


@dataclass(frozen=True, slots=True)
class TableEntry:
    """A number of a table: its symbol, its value in 60 digits, and a short exact form or ``None``."""

    symbol: sympy.Symbol
    value: Number
    exact: sympy.Expr | None

    def __str__(self) -> str:
        form = f" = {self.exact}" if self.exact is not None else ""
        return f"{self.symbol}{form} = {mp.nstr(self.value, 20)}"


@dataclass(frozen=True, slots=True)
class Equation:
    """0 = residual.

    Attributes:
        number: the paper's number, or the variable with respect to which a generating function is stationary.
        kind: ``"stage"``, ``"IDEL"`` (implicit discrete Euler-Lagrange), ``"multiplier"`` or ``"Legendre"``.
        residual: in the unknowns, (q_k, p_k, t_k, h), parameters and table entries.
    """

    number: str
    kind: str
    residual: sympy.Expr

    def __str__(self) -> str:
        return f"({self.number}) 0 = {self.residual}"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class StepEquations:
    """The equations of one step, for looking at and for calculating with.

    Attributes:
        system, method: what was derived.
        stages: the equations before they were written out.
        unknowns: what the equations are solved for.
        state: (q_k, p_k): two tuples of m symbols.
        time: t_k; ``step`` is h.
        equations: as many as unknowns.
        end_position, end_momentum: m equations each, ``residual`` being the new value itself.
        entries: the table entries that occur.
        initial_guess: of each unknown, on the straight line with velocity ``v_k``.
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
    def stage_equations(self) -> tuple[Equation, ...]:
        """Those of interior stages, multipliers and the Legendre transform."""
        return tuple(equation for equation in self.equations if equation.kind != "IDEL")

    @property
    def idel_equations(self) -> tuple[Equation, ...]:
        """The implicit discrete Euler-Lagrange equations (5): those with p_k, then those for p_{k+1}."""
        return (*(equation for equation in self.equations if equation.kind == "IDEL"), *self.end_momentum)

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Those of the system, with what they conserve."""
        return symmetries(self.system)

    @property
    def jacobian(self) -> sympy.ImmutableSparseMatrix:
        """Derivatives of the residuals with respect to the unknowns, square and sparse."""
        size = len(self.unknowns)
        entries = jacobian([equation.residual for equation in self.equations], self.unknowns)
        return sympy.ImmutableSparseMatrix(size, size, entries)

    def numeric(self, expression: sympy.Expr) -> sympy.Expr:
        """``expression`` with the values of table entries, to 50 digits."""
        return expression.xreplace({entry.symbol: sympy.Float(str(entry.value), 50) for entry in self.entries})

    def matrix_form(self) -> MatrixForm:
        """The Kronecker form (18) or (21); spectral collocation only.

        Raises:
            MethodError: for other methods.
        """
        if not isinstance(self.method, SpectralCollocation):
            raise MethodError(f"the matrix form (18), (21) is one of spectral collocation, not of {self.method.name}")
        return _matrix_form(self)

    def to_text(self) -> str:
        """Plain text: unknowns, equations, end state, guess, tables."""
        return "\n".join(_text_lines(self)) + "\n"

    def to_latex(self) -> str:
        """LaTeX: an ``align*`` environment with the paper's numbers as tags, and the tables."""
        return _latex(self)

    def __repr__(self) -> str:
        count = len(self.equations)
        return f"<{count} equation{'s' * (count > 1)} of {self.system.name} by {self.method.name}>"

    def _repr_latex_(self) -> str | None:
        """LaTeX of all equations, nothing where a notebook could not show them."""
        size = sympy.count_ops(self.equations[0].residual) * len(self.equations)
        return _latex(self) if size <= MOST_SHOWN_OPERATIONS else None

    def _repr_html_(self) -> str:
        shown = [_equation_html(equation) for equation in self.equations[:MOST_SHOWN]]
        left_out = len(self.equations) - len(shown)
        more = [plain(f"and {left_out} more: to_text and to_latex have all")] if left_out else []
        facts = (
            ("unknown", listed([symbol.name for symbol in self.unknowns])),
            ("table entries", listed([entry.symbol.name for entry in self.entries])),
        )
        return card(f"{self.system.name}: {self.method.title}", facts, *shown, *more)


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixForm:
    """Spectral collocation with Kronecker products: left = right, both column vectors.

    Position form (18): left = (A^2 x I) vec(Q) + a0 x v0 + (A a0) x q0 = vec(accelerations); ``residual`` is the
    Euler-Lagrange residual with these accelerations and V = A Q + a0 q0. Phase space (21): left =
    [[A x I, 0], [0, A x I]] (vec Q, vec P) + (a0 x q0, a0 x p0), right = (vec H_p, vec -H_q).

    Attributes:
        A, a0: the differentiation matrix on [t_k, t_k + h] without its first row, (s, s), and its first column, (s, 1).
        operator: the Kronecker product that acts on the unknowns.
        left: operator times unknowns plus the known state.
        residual: a column vector that vanishes on the step.
    """

    A: sympy.ImmutableMatrix
    a0: sympy.ImmutableMatrix
    operator: sympy.ImmutableMatrix
    left: sympy.ImmutableMatrix
    residual: sympy.ImmutableMatrix


def derive(system: MechanicalSystem, method: Method, *, radicals: bool = False) -> StepEquations:
    """The closed form of one step as the paper writes it.

    Args:
        system: the Lagrangian.
        method: SVI: (27); SCVI: (34), with its multipliers unless as printed; SC: (18), (21); Runge-Kutta: (22).
        radicals: replace table entries by radicals where they have a short form.
    """
    check_regular(method, system)
    stages = with_auxiliaries(system, method.paper_form(system))
    writer = _Writer(system, stages)
    equations = writer.equations()
    end_position, end_momentum = writer.end_state()
    entries = _entries(writer.values, _radical_basis(method))
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
        entries=entries,
        initial_guess=writer.guess(),
    )
    return _with_radicals(derived) if radicals else derived


class _Writer:
    """Writes a stage system out: gathers into arguments, arguments into kernels, kernels into rows."""

    def __init__(self, system: MechanicalSystem, stages: StageSystem) -> None:
        self.system, self.stages = system, stages
        names = [q.name for q in system.coordinates]
        self.taken = {
            symbol.name for symbol in (*system.coordinates, *system.velocities, *system.auxiliaries, *system.parameters)
        }
        self.step = self._symbol("h")
        self.q = tuple(self._symbol(f"{name}_k") for name in names)
        self.p = tuple(self._symbol(f"p_{name}_k" if len(names) > 1 else "p_k") for name in names)
        self.v = tuple(self._symbol(f"{name}_dot_k") for name in names)
        self.time = self._symbol(f"{system.time.name}_k")
        self.unknowns = [
            tuple(self._symbol(f"{block.name}_{name}" if len(names) > 1 else block.name) for name in names)
            for block in stages.blocks
        ]
        self.values: dict[sympy.Symbol, Number] = {}

    def _symbol(self, name: str) -> sympy.Symbol:
        """A symbol of the derivation, with underscores before its name if the system has one of that name."""
        while name in self.taken:
            name = f"_{name}"
        return sympy.Symbol(name, real=True)

    def equations(self) -> tuple[Equation, ...]:
        """The rows of the stage system, component by component."""
        rows = self._rows()
        return tuple(
            Equation(row.number, row.kind, sympy.Add(*rows[r][i]))
            for r, row in enumerate(self.stages.rows)
            for i in range(self.system.dimension)
        )

    def end_state(self) -> tuple[tuple[Equation, ...], tuple[Equation, ...]]:
        """q_{k+1} and p_{k+1}."""
        number_q, number_p = self.stages.end_numbers
        position = self._gathered(self.stages.end_position, 0, power=0, scale=sympy.S.One)
        end = self._rows()[-1]
        return (
            tuple(Equation(number_q, "end", value) for value in position),
            tuple(Equation(number_p, "IDEL", sympy.Add(*terms)) for terms in end),
        )

    def guess(self) -> dict[sympy.Symbol, sympy.Expr]:
        """The straight line."""
        guess = {}
        for block, symbols in zip(self.stages.blocks, self.unknowns, strict=True):
            rest, moving = (_rational(x) for x in block.straight)
            for i, symbol in enumerate(symbols):
                moved = moving * self.step ** (1 - block.power) * self.v[i]
                guess[symbol] = rest * self.q[i] + moved + block.momentum * self.p[i]
        return guess

    def _rows(self) -> list[list[list[sympy.Expr]]]:
        m = self.system.dimension
        momenta = [*(row.momentum for row in self.stages.rows), self.stages.end_momentum]
        powers = [*(row.power for row in self.stages.rows), 0]
        rows: list[list[list[sympy.Expr]]] = [[[_rational(c) * self.p[i]] for i in range(m)] for c in momenta]
        for family in self.stages.families:
            for n in range(len(family.abscissae)):
                self._scatter(family, n, powers, rows)
        return rows

    def _scatter(self, family: PointFamily, n: int, powers: Sequence[int], rows: list[list[list[sympy.Expr]]]) -> None:
        arguments = self._arguments(family, n)
        weight = self._named(family.weight_names[n], family.weights[n])
        for scatter in family.scatters:
            values = [result.xreplace(arguments) for result in scatter.results]
            for r, power in enumerate(powers):
                coefficient = self._entry(scatter.table, n, r)
                if coefficient == 0:
                    continue
                factor = weight * coefficient * self.step ** (scatter.power + power) * _fraction(scatter.scale)
                for i, value in enumerate(values):
                    rows[r][i].append(factor * value)

    def _arguments(self, family: PointFamily, n: int) -> dict[sympy.Symbol, sympy.Expr]:
        prefix = "d" if family.name == "quadrature" else "c"
        abscissa = family.abscissae[n]
        name = "" if abscissa in (0, 1) else f"{prefix}_{n + 1}"
        replaced = {}
        if any(self.system.time in result.free_symbols for result in family.results):
            replaced[self.system.time] = self.time + self._named(name, abscissa) * self.step
        for gather in family.gathers:
            values = self._gathered(gather.table, n, power=gather.power, scale=_fraction(gather.scale))
            replaced |= dict(zip(gather.arguments, values, strict=True))
        return replaced

    def _gathered(self, table: Table, n: int, *, power: int, scale: sympy.Rational) -> tuple[sympy.Expr, ...]:
        columns: list[tuple[Block | None, tuple[sympy.Symbol, ...]]] = [(None, self.q)]
        columns += list(zip(self.stages.blocks, self.unknowns, strict=True))
        sums: list[list[sympy.Expr]] = [[] for _ in self.q]
        for b, (block, symbols) in enumerate(columns):
            coefficient = self._entry(table, n, b)
            if coefficient == 0:
                continue
            factor = scale * coefficient * self.step ** (power + (block.power if block else 0))
            for i, symbol in enumerate(symbols):
                sums[i].append(factor * symbol)
        return tuple(sympy.Add(*terms) for terms in sums)

    def _entry(self, table: Table, n: int, b: int) -> sympy.Expr:
        return self._named(table.names[n][b], table.entries[n][b])

    def _named(self, name: str, value: Number) -> sympy.Expr:
        """The symbol of an entry (``name/2``: half a named one), its value recorded; nameless are small integers."""
        if not name:
            return sympy.Integer(int(value))
        base, _, divisor = name.partition("/")
        symbol = self._symbol(base)
        self.values[symbol] = value * int(divisor or 1)
        return symbol / int(divisor or 1)


def _rational(value: Number) -> sympy.Expr:
    """Coefficients of p_k and of the straight line: small dyadic numbers and node positions."""
    exact = sympy.nsimplify(sympy.Float(str(value), 30), rational=True, tolerance=sympy.Float("1e-25"))
    return exact if exact.q < 10**6 else sympy.Float(str(value), 17)


def _fraction(value: object) -> sympy.Rational:
    return sympy.Rational(str(value))


def _entries(values: Mapping[sympy.Symbol, Number], basis: tuple[sympy.Expr, ...]) -> tuple[TableEntry, ...]:
    known = [_high_precision(element) for element in basis]
    return tuple(
        TableEntry(symbol, value, _exact(value, basis, known)) for symbol, value in sorted(values.items(), key=_by_name)
    )


def table_entries(stages: StageSystem, method: Method) -> tuple[TableEntry, ...]:
    """The named numbers of all tables of a method's equations; those that do not occur in the equations, too."""
    tables = [stages.end_position]
    values: dict[sympy.Symbol, Number] = {}
    for family in stages.families:
        tables += [gather.table for gather in family.gathers] + [scatter.table for scatter in family.scatters]
        tables.append(Table(entries=(family.weights,), names=(family.weight_names,)))
    for table in tables:
        for names, numbers in zip(table.names, table.entries, strict=True):
            for name, value in zip(names, numbers, strict=True):
                base, _, divisor = name.partition("/")
                if base:
                    values[sympy.Symbol(base, real=True)] = value * int(divisor or 1)
    return _entries(values, _radical_basis(method))


def _by_name(item: tuple[sympy.Symbol, Number]) -> tuple[object, ...]:
    prefix, *indices = item[0].name.lstrip("_").split("_")
    return (prefix, *(int(index) for index in indices))


def _high_precision(expression: sympy.Expr) -> Number:
    return mp.mpf(str(sympy.N(expression, DIGITS + 5)))


def _exact(value: Number, basis: tuple[sympy.Expr, ...], known: Sequence[Number]) -> sympy.Expr | None:
    """The combination of basis elements with small rational coefficients that equals ``value`` to 54 digits (PSLQ)."""
    if value == 0:
        return sympy.S.Zero
    if not basis:
        return None
    tolerance = mp.mpf(10) ** (PSLQ_SLACK - DIGITS)
    relation = mp.pslq([value, *known], tol=tolerance, maxcoeff=LARGEST_COEFFICIENT, maxsteps=10**5)
    if not relation or relation[0] == 0:
        return None
    terms = [sympy.Rational(-int(c), int(relation[0])) * e for c, e in zip(relation[1:], basis, strict=True)]
    return sympy.Add(*terms)


@lru_cache(maxsize=64)
def _radical_basis(method: Method) -> tuple[sympy.Expr, ...]:
    """1 and the roots in the method's nodes and points with their pairwise products; () where they are not short."""
    roots: set[sympy.Expr] = set()
    for expressions in _closed_forms(method):
        if expressions is None:
            return ()
        for expression in expressions:
            roots |= {atom for atom in expression.atoms(sympy.Pow) if atom.exp in (sympy.S.Half, -sympy.S.Half)}
    roots = {sympy.sqrt(root.base) if root.base.is_Rational else root for root in roots}
    squares = sorted({_square_free(root) for root in roots}, key=str)
    basis = [sympy.S.One, *squares, *(sympy.sqrtdenest(a * b) for a, b in itertools.combinations(squares, 2))]
    return tuple(basis) if len(basis) <= LARGEST_BASIS else ()


def _square_free(root: sympy.Expr) -> sympy.Expr:
    """sqrt(n) without its rational factor."""
    coefficient, rest = sympy.sqrt(root.base).as_coeff_Mul()
    return rest if coefficient.is_Rational else root


def _closed_forms(method: Method) -> Iterator[Sequence[sympy.Expr] | None]:
    """The exact points, weights and coefficients behind the method's tables."""
    if isinstance(method, RungeKutta):
        exact = exact_tableau(method.tableau)
        yield None if exact is None else [x for row in exact[0] for x in row] + list(exact[1]) + list(exact[2])
        return
    nodes = getattr(method, "node_set", None)
    if nodes is not None:
        yield exact_points(nodes)
    rule = getattr(method, "rule", None)
    if rule is not None:
        exact_points_and_weights = exact_rule(rule)
        yield None if exact_points_and_weights is None else [x for part in exact_points_and_weights for x in part]


def _equation_html(equation: Equation) -> Html:
    size = sympy.count_ops(equation.residual)
    if size > MOST_SHOWN_OPERATIONS // MOST_SHOWN:
        return Html(f"<div>{plain(f'({equation.number}) {size} operations')}</div>")
    pieces = [piece for term in mathml_terms(equation.residual, sympy.S.Zero) for piece in term]
    return Html(f"<div>{plain(f'({equation.number})')} {' '.join(pieces)}</div>")


def _with_radicals(derived: StepEquations) -> StepEquations:
    """Table entries replaced by their exact forms, where there is one."""
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


def _matrix_form(derived: StepEquations) -> MatrixForm:
    """(18) or (21) by Kronecker products and row-wise vec (Lemmas 2.1, 2.2), independent of the written-out rows."""
    method, system = derived.method, derived.system
    assert isinstance(method, SpectralCollocation)
    size, m = method.degree, system.dimension
    slopes = differentiation_matrix(method.node_set.points)
    full = sympy.Matrix(size, size + 1, lambda i, j: 2 * _number(slopes[i + 1][j]) / derived.step)
    a0, A = full[:, :1], full[:, 1:]
    q0 = sympy.Matrix(1, m, derived.state[0])
    identity = sympy.eye(m)
    form = _position_matrix_form if method.form == "position" else _phase_space_matrix_form
    return form(derived, A, a0, q0, identity)


def _number(value: Number) -> sympy.Expr:
    return sympy.Float(str(value), 50)


def _position_matrix_form(
    derived: StepEquations, A: sympy.Matrix, a0: sympy.Matrix, q0: sympy.Matrix, identity: sympy.Matrix
) -> MatrixForm:
    system = derived.system
    size, m = A.rows, system.dimension
    Q = sympy.Matrix(size, m, derived.unknowns[: size * m])
    v0 = sympy.Matrix(1, m, derived.unknowns[size * m :])
    operator = sympy.kronecker_product(A * A, identity)
    left = operator * _vec(Q) + sympy.kronecker_product(a0, v0.T) + sympy.kronecker_product(A * a0, q0.T)
    V = A * Q + a0 * q0
    E = forms_of(system).euler_lagrange
    residual = []
    for i in range(size):
        replaced = _at_node(derived, i, Q.row(i), V.row(i))
        replaced |= dict(zip(accelerations(system), left[i * m : (i + 1) * m], strict=True))
        residual += [e.xreplace(replaced) for e in E]
    return _frozen_form(A, a0, operator, left, sympy.Matrix(residual))


def _phase_space_matrix_form(
    derived: StepEquations, A: sympy.Matrix, a0: sympy.Matrix, q0: sympy.Matrix, identity: sympy.Matrix
) -> MatrixForm:
    """(21) with H_p = V, -H_q = L_q and P = L_v(Q, V); the positions Q follow from the unknowns V by (15)."""
    system = derived.system
    size, m = A.rows, system.dimension
    V = sympy.Matrix(size, m, derived.unknowns)
    p0 = sympy.Matrix(1, m, derived.state[1])
    Q = A.inv() * (V - a0 * q0)
    P_rows, G_rows = [], []
    for i in range(size):
        replaced = _at_node(derived, i, Q.row(i), V.row(i))
        P_rows.append([p.xreplace(replaced) for p in forms_of(system).momentum])
        G_rows.append([f.xreplace(replaced) for f in forms_of(system).force])
    P, G = sympy.Matrix(P_rows), sympy.Matrix(G_rows)
    single = sympy.kronecker_product(A, identity)
    operator = sympy.diag(single, single)
    known = sympy.Matrix.vstack(sympy.kronecker_product(a0, q0.T), sympy.kronecker_product(a0, p0.T))
    left = operator * sympy.Matrix.vstack(_vec(Q), _vec(P)) + known
    return _frozen_form(A, a0, operator, left, left - sympy.Matrix.vstack(_vec(V), _vec(G)))


def _frozen_form(
    A: sympy.Matrix, a0: sympy.Matrix, operator: sympy.Matrix, left: sympy.Matrix, residual: sympy.Matrix
) -> MatrixForm:
    return MatrixForm(
        A=A.as_immutable(),
        a0=a0.as_immutable(),
        operator=operator.as_immutable(),
        left=left.as_immutable(),
        residual=residual.as_immutable(),
    )


def _vec(matrix: sympy.Matrix) -> sympy.Matrix:
    """Rows stacked atop one another (Definition 2.2)."""
    return sympy.Matrix(list(matrix))


def _at_node(derived: StepEquations, i: int, q: sympy.Matrix, v: sympy.Matrix) -> dict[sympy.Symbol, sympy.Expr]:
    system, method = derived.system, derived.method
    assert isinstance(method, SpectralCollocation)
    replaced = dict(zip(system.coordinates, q, strict=True)) | dict(zip(system.velocities, v, strict=True))
    replaced[system.time] = derived.time + _number((method.node_set.points[i + 1] + 1) / 2) * derived.step
    return replaced


def _text_lines(derived: StepEquations) -> Iterator[str]:
    q, p = derived.state
    yield f"{derived.system.name}: {derived.method.title}"
    yield f"{'H' if derived.system.auxiliaries else 'L'} = {derived.system.to_text()}"
    yield f"known: {', '.join(s.name for s in (*q, *p, derived.time, derived.step))}"
    yield f"unknown: {', '.join(s.name for s in derived.unknowns)}"
    yield "\nequations"
    yield from (f"  {equation}" for equation in derived.equations)
    yield "\nend of the step"
    for symbol, equation in zip((*q, *p), (*derived.end_position, *derived.end_momentum), strict=True):
        yield f"  ({equation.number}) {symbol.name[:-2]}_(k+1) = {equation.residual}"
    yield "\nfirst guess (q_dot_k: the velocity that belongs to p_k)"
    yield from (f"  {symbol} = {value}" for symbol, value in derived.initial_guess.items())
    if derived.entries:
        yield "\ntable entries"
        yield from (f"  {entry}" for entry in derived.entries)
    if derived.symmetries:
        yield "\nconserved (momentum maps of symmetries)"
        yield from (f"  {symmetry}{_exactness(derived, symmetry)}" for symmetry in derived.symmetries)


def _exactness(derived: StepEquations, symmetry: Symmetry) -> str:
    return "" if is_exact(symmetry, derived.method) else "  (not guaranteed by this method)"


def _latex(derived: StepEquations) -> str:
    names = {symbol: latex_name(symbol.name) for symbol in _all_symbols(derived)}

    def written(expression: sympy.Expr) -> str:
        return str(sympy.latex(expression, symbol_names=names))

    lines = [rf"0 &= {written(e.residual)} \tag{{{_tag(e.number)}}}" for e in derived.equations]
    q, p = derived.state
    for symbol, equation in zip((*q, *p), (*derived.end_position, *derived.end_momentum), strict=True):
        new = latex_name(f"{symbol.name}+1")
        lines.append(rf"{new} &= {written(equation.residual)} \tag{{{_tag(equation.number)}}}")
    tables = [
        rf"{names[entry.symbol]} &= "
        + (written(entry.exact) + " = " if entry.exact is not None else "")
        + mp.nstr(entry.value, 17)
        for entry in derived.entries
    ]
    maps = [
        rf"J &= {sympy.latex(s.momentum_map, symbol_names=_names_of_maps(s))} \tag{{{_tag(s.name)}}}"
        for s in derived.symmetries
    ]
    blocks = [block for block in (lines, tables, maps) if block]
    return "\n".join("\\begin{align*}\n" + " \\\\\n".join(block) + "\n\\end{align*}" for block in blocks)


def _names_of_maps(symmetry: Symmetry) -> dict[sympy.Symbol, str]:
    return {symbol: latex_name(symbol.name) for symbol in symmetry.momentum_map.free_symbols}


def _tag(number: str) -> str:
    if not number.startswith("dG"):
        return number.replace("_", r"\_")
    return "$" + number.replace("dG", r"\partial G").replace("/d", r"/\partial ") + "$"


def _all_symbols(derived: StepEquations) -> set[sympy.Symbol]:
    symbols: set[sympy.Symbol] = {entry.symbol for entry in derived.entries}
    for equation in (*derived.equations, *derived.end_position, *derived.end_momentum):
        symbols |= equation.residual.free_symbols
    return symbols | set(derived.state[0]) | set(derived.state[1])
