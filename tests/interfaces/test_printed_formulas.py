"""Every formula of a derivation is read back from what is printed, evaluated in 60 digits, and compared.

The stage equations of a page are solved as they stand there, and lead where the compiled C does; so do those that are
written out, in HTML and text. Formulas of the system and its motion are compared with derivatives taken here of
a text that stands here; those of kernels with the C beside them. An entry without a check fails; those that explain
fixed-point iterations by the formulas of the stages are read without being evaluated.
"""

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
import pytest
import sympy
from derivation_page import Entry, PrintedPage, PrintedTable, read_page
from oracle import points
from printed_formulas import FUNCTIONS, mp, names, trees_of_mathml, value

import scvi_codegen as sc
from scvi_codegen.common.display.mathml import Typeset
from scvi_codegen.extras.derivation.equations import derive
from scvi_codegen.extras.derivation.page.document import derivation_html
from scvi_codegen.methods.discretise import discretise, paper_equations
from scvi_codegen.methods.stage_system import EntryName
from scvi_codegen.methods.tables.number_tables import Part
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import Tableau

T, H, TIME = mp.mpf("1e-40"), 0.125, 0.375
Q, P = (0.625, -0.4375), (0.3125, 0.875)
PARAMETERS = {"m": 1.3125, "k": 0.6875, "b": 0.40625, "c": 0.28125}
"""Dyadic, so that the C has the same numbers."""


@dataclass(frozen=True, eq=False)
class Case:
    """A system as text, from which this file takes all derivatives."""

    formula: str
    coordinates: tuple[str, ...] = ("x", "y")
    momenta: tuple[str, ...] = ()
    forces: Mapping[str, str] = field(default_factory=dict)
    damping: str = "0"
    constraints: tuple[str, ...] = ()

    @cached_property
    def system(self) -> Any:
        common = {"name": "printed", "coordinates": list(self.coordinates), "parameters": PARAMETERS}
        if self.momenta:
            return sc.HamiltonianSystem.from_text(hamiltonian=self.formula, momenta=list(self.momenta), **common)
        acting: dict[str, Any] = {"forces": dict(self.forces)} if self.forces else {}
        acting |= {"damping": self.damping} if self.damping != "0" else {}
        acting |= {"constraints": list(self.constraints)} if self.constraints else {}
        return sc.LagrangianSystem.from_text(lagrangian=self.formula, **acting, **common)

    def parsed(self, text: str) -> sympy.Expr:
        letters = (*self.coordinates, *self.momenta, *PARAMETERS, "t", *(f"{x}_dot" for x in self.coordinates))
        return sympy.sympify(text, {letter: sympy.Symbol(letter) for letter in letters})

    def symbols(self, suffix: str) -> list[sympy.Symbol]:
        return [sympy.Symbol(f"{x}{suffix}") for x in self.coordinates]

    @cached_property
    def letters(self) -> dict[str, list[sympy.Symbol]]:
        """Arguments of kernels by what they are called."""
        lam = [f"lam_{i}" for i in range(len(self.constraints) or len(self.coordinates))]
        found = {"q": self.symbols(""), "q'": self.symbols("_dot"), "q''": self.symbols("_ddot"), "λ": lam, "p": []}
        found["λ"], found["p"] = [sympy.Symbol(x) for x in lam], [sympy.Symbol(x) for x in self.momenta]
        return found

    @cached_property
    def results(self) -> dict[str, Callable[..., Any]]:
        """Return kernel results: forces with additional terms of the page, E, S = lambda E, and derivatives."""
        q, v, a, lam, p = (self.letters[letter] for letter in ("q", "q'", "q''", "λ", "p"))
        t, formula = sympy.Symbol("t"), self.parsed(self.formula)
        L = sum(x * y for x, y in zip(p, v, strict=True)) - formula if p else formula
        f = [self.parsed(self.forces.get(x, "0")) for x in self.coordinates]
        g = [self.parsed(each) for each in self.constraints]
        reaction = [sum((m * sympy.diff(each, x) for m, each in zip(lam, g, strict=False)), sympy.S.Zero) for x in q]
        Lq, Lv = [sympy.diff(L, x) for x in q], [sympy.diff(L, x) for x in v]

        def along(expression: sympy.Expr) -> sympy.Expr:
            rates = [*zip(q, v, strict=True), *zip(v, a, strict=True)]
            return sum((sympy.diff(expression, x) * rate for x, rate in rates), sympy.diff(expression, t))

        E = [along(momentum) - force - extra for momentum, force, extra in zip(Lv, Lq, f, strict=True)]
        S = sum((m * (each + extra) for m, each, extra in zip(lam, E, f, strict=False)), sympy.S.Zero)
        found = {
            "L_q": [x + y + z for x, y, z in zip(Lq, f, reaction, strict=True)],
            "L_v": Lv,
            "L_p": [sympy.diff(L, x) for x in p],
            "E": E,
            "g": g,
            "g'": [along(each) for each in g],
            "L": [L],
        }
        for letter, scalar in (("S", S), ("L'", along(L))):
            for name, xs in (("q", q), ("v", v), ("a", a)):
                found[f"{letter}_{name}"] = [sympy.diff(scalar, x) for x in xs]
        if self.forces:  # the adjoint of their linearisation, as on the page
            pushed = [
                [sum((sympy.diff(each, x) * m for x, m in zip(xs, lam, strict=True))) for each in f] for xs in (q, v)
            ]
            found["S_v"] = [x + y for x, y in zip(found["S_v"], pushed[1], strict=True)]
            found["S_q"] = [x + along(y) - z for x, y, z in zip(found["S_q"], pushed[1], pushed[0], strict=True)]
        arguments = [*q, *v, *a, *lam, *p, t, *map(sympy.Symbol, PARAMETERS)]
        functions = {name: getattr(mp, name) for name in ("sin", "cos", "exp", "sqrt")}
        return {
            name: sympy.lambdify(arguments, each, modules=[functions, {"mpf": mp.mpf}, "mpmath"])
            for name, each in found.items()
        }

    def result(self, name: str, t: Any, **given: Any) -> np.ndarray[Any, Any]:
        assert all(len(given[letter]) == len(self.letters[letter]) for letter in given), given
        values = [x for letter in self.letters for x in given.get(letter, [mp.zero] * len(self.letters[letter]))]
        numbers = self.results[name](*values, t, *map(mp.mpf, PARAMETERS.values()))
        return np.array([mp.mpf(x) for x in numbers], dtype=object)


PLAIN = Case("(m*(1 + x**2/3)*x_dot**2 + y_dot**2)/2 - k*x**2*y*cos(t) + y_dot*x*b")
FORCED = Case(PLAIN.formula, forces={"x": "-c*x_dot**3", "y": "k*cos(t)*x"})
DAMPED = Case(PLAIN.formula, damping="c")
CONSTRAINED = Case(PLAIN.formula.replace("*cos(t)", ""), constraints=("x**2 + (y - 1)**2 - 89/36",))
SEPARABLE = Case("(m*x_dot**2 + 3*y_dot**2)/2 - k*x**4*y**2 - c*cos(t)*x")
HAMILTONIAN = Case(
    "r**2*(1 + x**2)/2 + s**2/m/2 + x**4*cos(t)/2 + r*x/3 + k*x*y", momenta=("r", "s"), coordinates=("x", "y")
)
ONE = Case("m*(1 + x**2/3)*x_dot**2/2 - k*x**4*cos(t)/4 + x_dot*x**2*b", coordinates=("x",))
CASES = {
    "forced svi": (FORCED, sc.SVI(2)),
    "forced scvi": (FORCED, sc.SCVI(2)),
    "plain scvi as printed": (PLAIN, sc.SCVI(2, variational=False)),
    "forced scvi on gauss": (FORCED, sc.SCVI(2, abscissae="gauss")),
    "forced sc": (FORCED, sc.SpectralCollocation(2)),
    "forced sc in phase space": (FORCED, sc.SpectralCollocation(2, form="phase-space")),
    "plain svi hermite": (PLAIN, sc.SVI(2, "hermite:2")),
    "plain svi splines": (PLAIN, sc.SVI(2, space="splines:2")),
    "forced gauss": (FORCED, sc.Gauss(2)),
    "forced radau": (FORCED, sc.RadauIIA(2, form="position")),
    "forced lobatto": (FORCED, sc.LobattoIIIA(3)),
    "forced euler": (FORCED, sc.ExplicitEuler()),
    "damped svi": (DAMPED, sc.SVI(2)),
    "damped gauss": (DAMPED, sc.Gauss(2)),
    "rattle": (CONSTRAINED, sc.SVI(1, "gauss-lobatto:2")),
    "constrained svi": (CONSTRAINED, sc.SVI(2, "gauss-lobatto:3")),
    "hamiltonian svi": (HAMILTONIAN, sc.SVI(2)),
    "hamiltonian gauss": (HAMILTONIAN, sc.Gauss(2)),
    "separable svi": (SEPARABLE, sc.SVI(3)),
    "stoermer-verlet": (SEPARABLE, sc.StoermerVerlet()),
    "composition": (SEPARABLE, sc.Composition(8)),
    "one coordinate": (ONE, sc.SVI(2)),
    "one coordinate scvi": (ONE, sc.SCVI(1)),
}
ALIKE = (
    "forced scvi on gauss", "forced sc in phase space", "plain svi splines", "forced radau", "forced lobatto",
    "damped gauss", "rattle", "hamiltonian gauss", "composition", "one coordinate scvi",
)  # fmt: skip
"""Cases whose formulas are printed by the code that others of the default tier reach; left to the full tier."""
WITHOUT_STAGES = ("stoermer-verlet", "composition")
"""Explicit methods, which have no compiled form of stage equations."""
NAMES = [pytest.param(name, marks=[pytest.mark.full] if name in ALIKE else []) for name in CASES]
LINES = ("b", "bA", "beta", "gamma")
"""Tables of one line, whose entries have one index."""
GREEK = {"beta": "β", "gamma": "γ", "lambda": "λ", "tau": "τ", "nu": "ν"}
MEETING = {"quadrature": "At the quadrature points", "node": "At the nodes", "stage": "At the stages"}
MEETING |= {"start": "At the start", "end": "At its end", "kick": "At the kicks", "drift": "In the drifts"}
MEETING |= {"derivative_1": "At the points of 'derivative_1'"}


def printed(name: str) -> str:
    """A name of a table's entry as a page has it."""
    prefix, *indices = name.split("_")
    if prefix in ("l", "dl"):
        return f"l{chr(39) * (prefix == 'dl')}_{indices[1]}(τ_{indices[0]})"
    letters = {"DD": "D^D~", "aa": "A2"}.get(prefix, prefix)
    split = re.fullmatch(r"([a-z])(\d+)", letters)
    below = [split[2], *indices] if split else indices
    letter = split[1] if split else GREEK.get(letters, letters)
    return f"{letter}_{','.join(below)}"


def numbers(values: Any) -> np.ndarray[Any, Any]:
    return np.array([mp.mpf(x) for x in values], dtype=object)


def of_package(number: Any) -> Any:
    return mp.mpf(str(number)) if not hasattr(number, "_mpf_") else mp.make_mpf(number._mpf_)


def table_values(stages: Any) -> dict[str, Any]:
    """Numbers of all tables by their printed names; those that are 0 and 1, and have no name, by that of their row."""
    found: dict[str, Any] = {}
    tables = [part.table for group in stages.stage_groups for part in (*group.gathers, *group.scatters)]
    for table in (*tables, stages.end_position):
        for c in range(len(table.names[0])):
            column = [(r, line[c]) for r, line in enumerate(table.names, 1)]
            named = [(r, *_taken_apart(name)) for r, name in column if name]
            if not named:
                continue
            _, base, factor = named[0]
            prefix, *indices = base.split("_")
            transposed = len(indices) == 2 and any(int(b.split("_")[1]) != row for row, b, _ in named)
            for row, _ in column:
                own = [indices[0], str(row)] if transposed else [str(row), *indices[1:]]
                line = len(column) == 1
                name = "_".join([prefix, *(indices[-1 if prefix in LINES else 0 :] if line else own[: len(indices)])])
                found[printed(name)] = of_package(table.entries[row - 1][c]) * factor
                if line:  # as it is written out
                    found[printed("_".join([prefix, *indices]))] = found[printed(name)]
    for group in stages.stage_groups:
        for name, weight in zip(group.weight_names, group.weights, strict=True):
            if name:
                found[printed(name.number)] = of_package(weight)
    return found


def _taken_apart(name: EntryName) -> tuple[str, int]:
    return name.number, int(1 / name.factor)


class PrintedStep:
    """The equations of a step as a page prints them with sums, ready to be solved.

    ``stages`` says only what is unknown, where on the step the points are, and the numbers of the tables.
    """

    def __init__(self, case: Case, stages: Any, entries: list[Entry]) -> None:
        self.case, self.stages, self.tables = case, stages, table_values(stages)
        self.rows, self.ends, self.gathers = [], {}, {}
        for entry in entries:
            _, left, right = entry.tree
            if left == ("number", "0"):
                self.rows += [(entry.number, right, running) for running in _running(entry.number)]
            elif left[2] == "k+1" and left[1] in "qp" and entry.number:
                self.ends[left[1]] = right
            else:
                (group,) = [f for f in stages.stage_groups if entry.heading.startswith(MEETING[f.name])]
                self.gathers[group.name, f"{left[1]}_{left[2]}"] = right
        assert set(self.ends) == {"q", "p"}
        self.sizes = [len(case.coordinates) if b.size is None else b.size for b in stages.blocks]

    def unknowns(self, x: np.ndarray[Any, Any]) -> dict[str, Any]:
        """Arrays by printed names."""
        found, begin = {}, 0
        for block, size in zip(self.stages.blocks, self.sizes, strict=True):
            letter, _, index = block.name.rpartition("_")
            sign = "^" if letter in "QVP" else "_"
            found[f"{GREEK.get(letter, letter)}{sign}{index}"] = x[begin : begin + size]
            begin += size
        return found

    def known(self, x: np.ndarray[Any, Any], q: Any, p: Any, h: Any, t: Any) -> dict[str, Any]:
        """Everything that rows mention: at each point the results of the kernel there."""
        known = self.unknowns(x) | self.tables | {"q_k": numbers(q), "p_k": numbers(p), "h": mp.mpf(h)}
        known["Q^0"] = known["q_k"]
        gamma = self.case.parsed(self.case.damping).subs(PARAMETERS)
        for group in self.stages.stage_groups:
            first = group.weight_names[0].point if group.weight_names[0] else 1
            for n, abscissa in enumerate(group.abscissae):
                time = mp.mpf(t) + of_package(abscissa) * mp.mpf(h)
                place = {"start": "k", "end": "k+1"}.get(group.name, str(n + first))
                given = self.arguments(group, n + 1, place, known)
                growth = mp.exp(mp.mpf(str(gamma)) * of_package(abscissa) * mp.mpf(h))
                for letter in self.case.results:
                    name, _, index = letter.partition("_")
                    own = f"{name}_{index + ',' if index else ''}{place}"
                    if own in known and not _offers(group, letter):
                        continue
                    known[own] = self.case.result(letter, time, **given) * growth
        known["growth"] = mp.exp(mp.mpf(str(gamma)) * mp.mpf(h))
        return known

    def arguments(self, group: Any, row: int, place: str, known: Mapping[str, Any]) -> dict[str, Any]:
        """Return the arguments of a kernel at a point; symbols without a formula are unknowns."""
        found = {}
        for letter in filter(self.case.letters.get, self.case.letters):
            formulas = [self.gathers.get((group.name, f"{letter}_{at}")) for at in ("n", "k", "k+1", "1")]
            formula = next((each for each in formulas if each is not None), None)
            if formula is not None:
                others = self.nameless(group, letter, row)
                found[letter] = value(formula, lambda name: others.get(name, known.get(name)), {"n": row})  # noqa: B023
            elif f"{letter}_{place}" in known:
                found[letter] = known[f"{letter}_{place}"]
        return found

    def nameless(self, group: Any, letter: str, row: int) -> dict[str, Any]:
        """G_n,j of tables without names: the entries of the argument's own gather."""
        own = [g for g in group.gathers if _letter(g, self.case) == letter]
        found = {}
        for gather in own:
            line = gather.table.entries[row - 1]
            for block, entry in zip(("_0", *(b.name for b in self.stages.blocks)), line, strict=True):
                if entry != 0 or block == "_0":
                    found[f"G_{row},{block.rpartition('_')[2]}"] = of_package(entry)
            for block in self.stages.blocks:
                found.setdefault(f"G_{row},{block.name.rpartition('_')[2]}", mp.zero)
        return found

    def residuals(self, x: np.ndarray[Any, Any], *state: Any) -> np.ndarray[Any, Any]:
        known = self.known(x, *state)
        return np.concatenate([np.atleast_1d(value(right, known.__getitem__, n)) for _, right, n in self.rows])

    def end(self, x: np.ndarray[Any, Any], *state: Any) -> tuple[Any, Any]:
        known = self.known(x, *state)
        return (value(self.ends["q"], known.__getitem__), value(self.ends["p"], known.__getitem__) / known["growth"])

    def solved(self, *state: Any) -> np.ndarray[Any, Any]:
        """Newton's iteration with differences for derivatives, to 40 digits."""
        q, p = state[:2]
        velocity = velocity_of(self.case, q, p, state[3])
        x = []
        for block, size in zip(self.stages.blocks, self.sizes, strict=True):
            letter = block.name.rpartition("_")[0]
            x += list({"Q": numbers(q), "V": velocity, "P": numbers(p), "v": velocity}.get(letter, [mp.zero] * size))
        found = np.array(x, dtype=object)
        return newton(lambda y: self.residuals(y, *state), found)


def newton(residual: Callable[[Any], Any], x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    width, inverse = mp.mpf("1e-20"), None
    for k in range(40):
        r = residual(x)
        if k % 6 == 0:
            columns = []
            for i in range(len(x)):
                moved = x.copy()
                moved[i] += width
                columns.append((residual(moved) - r) / width)
            inverse = np.linalg.inv(np.array(columns, dtype=float).T).astype(object)
        update = inverse @ r
        x = x - update
        if max(abs(u) for u in update) < T:
            return x
    raise AssertionError("the printed equations have no solution nearby")


def velocity_of(case: Case, q: Any, p: Any, t: Any) -> np.ndarray[Any, Any]:
    """The v with p = L_v, or H_p."""
    if case.momenta:
        return -case.result("L_p", t, q=numbers(q), p=numbers(p))
    start = np.array([mp.zero] * len(q), dtype=object)
    return newton(lambda v: case.result("L_v", t, q=numbers(q), **{"q'": v}) - numbers(p), start)


def _offers(group: Any, letter: str) -> bool:
    """Return whether the results of that name at a point belong to this group."""
    scalar = {"S": "node", "L'": "derivative_1", "E": "node"}.get(letter.partition("_")[0])
    names = group.name if group.name != "kick" else "kick"
    if scalar is not None:
        return names == scalar
    return names in (("drift",) if letter == "L_v" else ("quadrature", "stage", "kick"))


def _letter(gather: Any, case: Case) -> str:
    first = gather.arguments[0]
    if first in case.system.coordinates:
        return "q"
    return "q'" if first in case.system.velocities else "λ"


def _running(number: str) -> Iterator[dict[str, int]]:
    bounds = re.search(r"i = (\d+),.* (\d+)$", number)
    yield from ({"i": i} for i in range(int(bounds[1]), int(bounds[2]) + 1)) if bounds else [{}]


@cache
def made(name: str) -> tuple[Case, Any, PrintedPage]:
    case, method = CASES[name]
    with warnings.catch_warnings(action="ignore"):
        return case, method, read_page(derivation_html(case.system, method))


@cache
def start_of(case: Case) -> tuple[Any, Any, float, float]:
    """q, p, h and t; of constraints the momenta of a velocity along them."""
    m = len(case.coordinates)
    if not case.constraints:
        return list(Q[:m]), list(P[:m]), H, TIME
    q = numbers([mp.mpf(5) / 6, mp.mpf(1) - mp.mpf(4) / 3])
    return q, case.result("L_v", TIME, q=q, **{"q'": numbers(["0.5", mp.mpf("0.5") * 5 / 8])}), H, TIME


@cache
def solution(name: str, section: str) -> tuple[PrintedStep, Any]:
    case, method, page = made(name)
    with warnings.catch_warnings(action="ignore"):
        stages = paper_equations(case.system, method) if section == "stages" else discretise(case.system, method)
    own = [
        e for e in page.entries if (e.pair == "evaluate" if section == "evaluate" else e.section in ("stages", "idel"))
    ]
    step = PrintedStep(case, stages, own)
    return step, step.solved(*start_of(case))


@cache
def compiled_step(name: str) -> tuple[Any, Any]:
    case, method, _ = made(name)
    q, p, h, t = start_of(case)
    with warnings.catch_warnings(action="ignore"):
        stepper = sc.compile_stepper(case.system, method)
        return stepper.step([float(x) for x in q], [float(x) for x in p], h, t, PARAMETERS)


@pytest.mark.rotated
@pytest.mark.sampled(6)
@pytest.mark.parametrize("name", NAMES)
def test_the_printed_stage_equations_are_those_of_the_step(name):
    assert (name in WITHOUT_STAGES) == (not any(entry.pair == "evaluate" for entry in made(name)[2].entries))
    step, x = solution(name, "stages")
    assert max(abs(r) for r in step.residuals(x, *start_of(step.case))) < T
    for found, expected in zip(step.end(x, *start_of(step.case)), compiled_step(name), strict=True):
        np.testing.assert_allclose(found.astype(float), expected, rtol=2e-14, atol=1e-15)


@pytest.mark.rotated
@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", [name for name in NAMES if name.values[0] not in WITHOUT_STAGES])
def test_printed_compiled_equations_are_those_of_the_step(name):
    step, x = solution(name, "evaluate")
    for found, expected in zip(step.end(x, *start_of(step.case)), compiled_step(name), strict=True):
        np.testing.assert_allclose(found.astype(float), expected, rtol=2e-14, atol=1e-15)


def at_random(case: Case, seed: int = 7) -> dict[str, Any]:
    """Numbers for every letter of formulas of the system, by its printed name."""
    draw = np.random.default_rng(seed).uniform(0.3, 0.9, 40)
    letters = [*case.coordinates, *case.momenta, *(f"{x}'" for x in case.coordinates)]
    letters += [f"{x}''" for x in case.coordinates]
    letters += [f"{sign}_{x}" for sign in "λν" for x in case.coordinates]
    found = {letter: mp.mpf(float(x)) for letter, x in zip([*letters, "t"], draw, strict=False)}
    return (
        found
        | {f"λ_{k}": found.get(f"λ_{k}", mp.mpf(float(draw[-k]))) for k in (1, 2)}
        | {parameter: mp.mpf(x) for parameter, x in PARAMETERS.items()}
    )


def kernel_arguments(case: Case, at: Mapping[str, Any]) -> dict[str, Any]:
    """Return the kernel arguments of :meth:`Case.result`."""
    lam = [at["λ_1"]] if case.constraints else [at[f"λ_{x}"] for x in case.coordinates]
    found = {"q": [at[x] for x in case.coordinates], "p": [at[x] for x in case.momenta], "λ": lam}
    return found | {f"q{dot}": [at[f"{x}{dot}"] for x in case.coordinates] for dot in ("'", "''")}


def formula_value(case: Case, text: str, at: Mapping[str, Any]) -> Any:
    dots = {f"{x}_dot": at[f"{x}'"] for x in case.coordinates}
    numbers = {sympy.Symbol(letter): sympy.Float(str(x), 60) for letter, x in (at | dots).items()}
    return mp.mpf(str(case.parsed(text).xreplace(numbers).evalf(50)))


def close(found: Any, expected: Any) -> bool:
    return bool(np.all(np.abs(np.asarray(found - expected)) < mp.mpf("1e-40") * (1 + np.abs(np.asarray(expected)))))


def of_system(name: str, entry: Entry, index: int) -> bool:
    """The functions that define the system."""
    case, at = CASES[name][0], at_random(CASES[name][0])
    _, left, right = entry.tree
    texts = {"L": case.formula, "H": case.formula, "γ": case.damping}
    texts |= {f"f_{x}": case.forces.get(x, "0") for x in case.coordinates}
    texts |= {f"g_{k}": text for k, text in enumerate(case.constraints, 1)}
    return close(value(right, at.__getitem__), formula_value(case, texts["_".join(filter(None, left[1:3]))], at))


def of_motion(name: str, entry: Entry, index: int) -> bool:
    """Momenta, then an Euler-Lagrange equation a coordinate; of a Hamiltonian rates of q and p."""
    case, at = CASES[name][0], at_random(CASES[name][0])
    given, m = kernel_arguments(case, at), len(case.coordinates)
    _, left, right = entry.tree
    found = value(right, at.__getitem__)
    if case.momenta:
        rates = given["q'"] - case.result("L_p", at["t"], **given)
        kicks = case.result("L_q", at["t"], **given)
        expected = {f"{x}'": r for x, r in zip((*case.coordinates, *case.momenta), (*rates, *kicks), strict=True)}
        return close(found, expected[left[1]])
    if entry.number == "2":
        reactions = case.result("L_q", at["t"], **given) - case.result(
            "L_q", at["t"], **(given | {"λ": numbers([0] * len(given["λ"]))})
        )
        gamma = formula_value(case, case.damping, at)
        damped = case.result("E", at["t"], **given) + gamma * case.result("L_v", at["t"], **given)
        return close(found, (damped - (reactions if case.constraints else 0))[index - m])
    return left[1:3] == ("p", case.coordinates[index]) and close(found, case.result("L_v", at["t"], **given)[index])


def nodes_of(method: Any) -> Any:
    return points({"chebyshev-lobatto": "chebyshev-lobatto"}[method.specification()["nodes"]], method.degree + 1)


def of_curve(name: str, entry: Entry, index: int) -> bool:
    """The trial curve, its action and its matrices, of numbers that are computed here."""
    method = CASES[name][1]
    left = entry.tree[1] if entry.number not in ("18", "21") else None
    right = entry.tree[2]
    if left is None:
        return kronecker(method, entry, index)
    if left[0] == "apply":  # q(tau) through the values of t^2 at the nodes, between them
        nodes = numbers(2 * nodes_of(method) - 1)
        known = {f"Q^{j}": x**2 for j, x in enumerate(nodes)} | {"s": mp.mpf(method.degree)}
        at = mp.mpf("0.3")
        known |= {f"l_{j}(τ)": cardinal(nodes, j, at) for j in range(len(nodes))}
        expected = at**2 if method.degree > 1 else nodes[0] ** 2
        return close(value(right, known.__getitem__), expected)
    if left[1:3] == ("L", "d"):
        known = {"h": mp.mpf(3), "g": mp.mpf(2), "w_1": mp.mpf("0.75"), "w_2": mp.mpf("1.25")}
        known |= {f"L(q(τ_{n}), q'(τ_{n}), t_{n})": mp.mpf(4 + n) for n in (1, 2)}
        return close(value(right, known.__getitem__), mp.mpf(3) / 2 * (mp.mpf("0.75") * 5 + mp.mpf("1.25") * 6))
    known = {"L_d": mp.mpf(5), "s": mp.mpf(2), "λ_1": mp.mpf(2), "λ_2": mp.mpf(3), "E_1": mp.mpf(7), "E_2": mp.mpf(11)}
    return left[1] == "G" and close(value(right, known.__getitem__), mp.mpf(5 + 14 + 33))


def cardinal(nodes: Any, j: int, x: Any) -> Any:
    found = mp.one
    for k, other in enumerate(nodes):
        found *= (x - other) / (nodes[j] - other) if k != j else 1
    return found


def kronecker(method: Any, entry: Entry, index: int) -> bool:
    """(18), (21) of curves that are polynomials: their derivatives are exact."""
    c, h, m = numbers(nodes_of(method) * H), mp.mpf(H), 2
    partials = np.array([[mp.diff(lambda x, j=j: cardinal(c, j, x), t) for j in range(len(c))] for t in c[1:]])
    curve = [np.array([[1 + 2 * t - t**2], [3 - t + 4 * t**2]]) for t in c]
    rates = [np.array([[2 - 2 * t], [-1 + 8 * t]]) for t in c]
    known = {"A": partials[:, 1:], "a_0": partials[:, :1], "q_k": curve[0], "p_k": curve[0], "v_k": rates[0]}
    known |= {
        "Q": np.vstack(curve[1:]),
        "P": np.vstack(curve[1:]),
        "V": np.vstack(rates[1:]),
        "G": np.vstack(rates[1:]),
    }
    known |= {"Q''": np.vstack([np.array([[mp.mpf(-2)], [mp.mpf(8)]])] * method.degree), "h": h}
    known |= {letter: np.array(np.eye(m, dtype=int), dtype=object) for letter in ("𝕀", "I")}
    one, other = (value(side, known.__getitem__) for side in entry.tree[1:])
    return bool(np.max(np.abs(one - other)) < mp.mpf("1e-12"))


def of_components(name: str, entry: Entry, index: int) -> bool:
    """What is written out is what :func:`derive` returns, whose text is evaluated below."""
    equations = derived(name)
    values = [e.residual for e in (*equations.equations, *equations.end_position, *equations.end_momentum)]
    right = [*values, *equations.initial_guess.values()][index]
    return entry.tree[2] == trees_of_mathml(Typeset.terms(right))


def of_jacobian(name: str, entry: Entry, index: int) -> bool:
    """Entries are the derivatives of the equations."""
    row, column = (int(k) - 1 for k in entry.tree[1][2].split(","))
    return entry.tree[2] == trees_of_mathml(Typeset.terms(derived(name).jacobian[row, column]))


STATEMENT = re.compile(r"(?:const (?:double|lanes|real) )?(\w+(?:\[\d+\])?) = ([^;]*);")


def numbers_of_c(text: str, case: Case, u: list[Any], t: Any) -> dict[str, Any]:
    """Return the values of straight-line C of a kernel, evaluated by Python."""
    functions = dict(FUNCTIONS) | {"pow": lambda x, y: x**y, "fabs": abs}
    functions |= {f"lanes_{name}": function for name, function in FUNCTIONS.items()} | {"lanes_of": lambda x: x}
    given = {"u": u, "t": t, "parameters": [mp.mpf(x) for x in PARAMETERS.values()], "value": {}, "derivative": {}}
    scope = functions | given
    for left, right in STATEMENT.findall(text.partition("{")[2].replace("\n", " ")):
        exec(f"{left} = {right}", scope)
    return {f"{name}_{k}": x for name in ("value", "derivative") for k, x in scope[name].items()}


def of_kernels(name: str, entry: Entry, index: int) -> bool:
    """A kernel's formulas are what its C computes."""
    case, _, page = made(name)
    at, (_, left, right) = at_random(case), entry.tree
    if left[1] in ("u", "parameters"):
        return left[1] == "u" or [x[1] for x in right[1:]] == list(PARAMETERS)
    arguments = next((e.tree[2] for e in page.entries if e.pair == entry.pair and e.tree[1][1] == "u"), ("tuple",))
    symbols = arguments[1:] if arguments[0] == "tuple" else [arguments]
    u = [value(symbol, at.__getitem__) for symbol in symbols]
    found = numbers_of_c(page.code[entry.pair], case, u, at["t"])["_".join(filter(None, left[1:3]))]
    expected = value(right, at.__getitem__)
    return bool(abs(found - expected) < mp.mpf("1e-14") * (1 + abs(expected)))


def of_functions(name: str, entry: Entry, index: int) -> bool:
    """Check Newton's iteration and the gather."""
    if entry.pair == "newton":
        known = {"J": mp.mpf(3), "z": mp.mpf(5), "R": mp.mpf(3) * 5 - 7, "δ": (mp.mpf(3) * 5 - 7) / 3}
        known |= {"z_new": mp.mpf(7) / 3}
        return close(*(value(side, known.__getitem__) for side in entry.tree[1:]))
    if entry.pair == "gather":
        known = {"B": mp.mpf(2), "table_1,n": mp.mpf(3), "table_2,n": mp.mpf(5), "z_1": mp.mpf(7), "z_2": mp.mpf(11)}
        return close(value(entry.tree[2], known.__getitem__), mp.mpf(21 + 55))
    return entry.pair in ("evaluate", "fixed_point", "iterate")  # the stages are solved as they stand, above


CHECKS: dict[str, Callable[[str, Entry, int], bool]] = {
    "system": of_system,
    "motion": of_motion,
    "curve": of_curve,
    "stages": lambda name, entry, index: True,  # solved as they stand, above
    "idel": lambda name, entry, index: True,
    "written-out": of_components,
    "jacobian": of_jacobian,
    "kernels": of_kernels,
    "functions": of_functions,
}
"""By section of the page; what is not here fails."""


@pytest.mark.rotated
@pytest.mark.parametrize("name", NAMES)
def test_every_entry_of_the_page_is_right(name):
    page, counts = made(name)[2], dict.fromkeys(CHECKS, 0)
    for entry in page.entries:
        assert CHECKS[entry.section](name, entry, counts[entry.section]), (entry, sorted(set(names(entry.tree))))
        counts[entry.section] += 1
    assert counts["system"] > 0 < counts["motion"]
    assert counts["kernels"] > 3


CAPTIONS = {
    "lj(τn)": "l", "Slopes of": "dl", "Dn,j": "D", "Products of": "DD", "an,j": "a", "(A2)n,j": "aa", "cn": "c",
    "rn,j": "r", "un,j": "u", "(bA)j": "bA", "βj": "beta", "γj": "gamma", "s1n,j": "s1", "s2n,j": "s2", "s3n,j": "s3",
    "s4n,j": "s4", "s5n,j": "s5",
}  # fmt: skip
"""First words of the text above tables of entries, and prefixes of the entries' names."""


def cell_number(cell: Any) -> Any:
    return value(cell, lambda name: None) if isinstance(cell, tuple) else mp.mpf(cell)


def check_part(table: PrintedTable, part: Part) -> None:
    """Cells are in 17 digits the numbers of nodes, of a quadrature or of a tableau, or exact."""
    if isinstance(part, Tableau):
        rows = [*((c, *line) for c, line in zip(part.c, part.A, strict=True)), part.b]
    else:
        columns = {"node": part.points, "point": part.points}
        if isinstance(part, Quadrature):
            columns["weight"] = part.weights
            columns |= {f"weight of derivative {k}": x for k, x in enumerate(part.derivative_weights, 1)}
        rows = list(zip(*(columns[heading] for heading in table.columns[1:]), strict=True))
    for row, numbers_of_row in zip(table.rows, rows, strict=True):
        cells = [cell_number(cell) for cell in row[1:] if cell != ""]
        assert all(abs(x - of_package(y)) < mp.mpf("1e-16") for x, y in zip(cells, numbers_of_row, strict=True))


def check_entries(name: str, table: PrintedTable) -> None:
    """Cells are in 17 digits the numbers of the equations, or exact."""
    prefix = next(prefix for begin, prefix in CAPTIONS.items() if table.caption.startswith(begin))
    known = dict(solution(name, "stages")[0].tables)
    for row in table.rows:
        for column, cell in zip(table.columns[1:], row[1:], strict=True):
            index = column.partition("= ")[2] if "=" in column else ""
            if cell != "":
                own = printed("_".join(filter(None, [prefix, row[0], index])))
                assert abs(cell_number(cell) - known[own]) < mp.mpf("2e-17") * max(1, abs(known[own])) * 10, own


@pytest.mark.rotated
@pytest.mark.parametrize("name", NAMES)
def test_tables_have_the_numbers_of_the_equations(name):
    (parameters, *tables, operations), parts = made(name)[2].tables, CASES[name][1].parts
    assert {row[0][1]: float(row[1]) for row in parameters.rows} == PARAMETERS
    assert operations.caption == "Operations of the kernels"  # counted in test_derivation_page.py
    assert tables
    for table, part in zip(tables, parts, strict=False):
        check_part(table, part)
    for table in tables[len(parts) :]:
        check_entries(name, table)


@cache
def derived(name: str) -> Any:
    case, method = CASES[name]
    with warnings.catch_warnings(action="ignore"):
        return derive(case.system, method)


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("name", NAMES)
def test_text_is_the_same_equations(name):
    """Read by Python itself: residuals that vanish, ends, first guesses, numbers of tables."""
    case = CASES[name][0]
    step, x = solution(name, "stages")
    ends = iter(np.concatenate(step.end(x, *start_of(case))))
    numbers_of, parts, text = plain_numbers(name), {}, derived(name).to_text()
    for line in text.splitlines():
        heading = re.match(r"\w[\w ]*", line)
        if heading and not line.startswith(" "):
            part = heading[0].strip()
            parts[part] = 0
        elif line.startswith("  "):
            parts[part] += 1
            label, _, right = re.sub(r"^  \(.*?\) ", "", line).strip().partition(" = ")
            if part in ("conserved", "statements of the C"):
                continue  # compared with momenta of runs in test_symmetries.py, and with steps in test_equations.py
            if part == "table entries":
                for each in right.split(" = "):
                    assert abs(of_python(each, {}) - numbers_of[label]) < mp.mpf("1e-18"), line
                continue
            found = of_python(right, numbers_of)
            if part == "equations":
                assert abs(found) < mp.mpf("1e-38"), line
            elif part == "end of the step":
                assert abs(found - next(ends)) < mp.mpf("1e-38"), line
            else:
                assert part == "first guess", line
                assert close(found, on_the_straight_line(name, label)), line
    assert next(ends, None) is None
    assert parts["equations"] == len(x)


def on_the_straight_line(name: str, label: str) -> Any:
    """Return an unknown for uniform motion."""
    case, method = CASES[name]
    letter, *indices = label.split("_")
    place = case.coordinates.index(indices[-1]) if indices[-1] in case.coordinates else 0
    q, p, h, t = start_of(case)
    speed = velocity_of(case, q, p, t)[place]
    if letter == "Q":
        return q[place] + h * of_package(method.node_set.abscissae[int(indices[0])]) * speed
    return {"V": speed, "v": speed, "P": mp.mpf(p[place])}.get(letter, mp.zero)


def of_python(text: str, scope: Mapping[str, Any]) -> Any:
    whole = re.sub(r"(?<![\w.])(\d+(?:\.\d+)?(?:e[+-]?\d+)?)", r"mpf('\1')", text)
    return eval(whole, {"mpf": mp.mpf, "pi": mp.pi, **FUNCTIONS}, dict(scope))


def plain_numbers(name: str) -> dict[str, Any]:
    """Return numbers by the names of SymPy symbols."""
    case = CASES[name][0]
    step, x = solution(name, "stages")
    q, p, h, t = start_of(case)
    found: dict[str, Any] = {"h": mp.mpf(h), "t_k": mp.mpf(t)} | {k: mp.mpf(x) for k, x in PARAMETERS.items()}
    begin = 0
    for block, size in zip(step.stages.blocks, step.sizes, strict=True):
        parts = case.coordinates if block.size is None else [str(k + 1) for k in range(size)]
        for k, part in enumerate(parts):
            found[f"{block.name}_{part}" if len(parts) > 1 else block.name] = x[begin + k]
        begin += size
    for coordinate, position, momentum, speed in zip(case.coordinates, q, p, velocity_of(case, q, p, t), strict=True):
        found |= {f"{coordinate}_k": mp.mpf(position), f"{coordinate}_dot_k": speed}
        found[f"p_{coordinate}_k" if len(case.coordinates) > 1 else "p_k"] = mp.mpf(momentum)
    for group in step.stages.stage_groups:  # times of points, by the names of their abscissae
        letter = "d" if group.name == "quadrature" else "c"
        found |= {f"{letter}_{n}": of_package(c) for n, c in enumerate(group.abscissae, 1) if c not in (0, 1)}
    return found | {
        entry.symbol.name: step.tables[printed(entry.symbol.name)]
        for entry in derived(name).entries
        if entry.symbol.name not in found
    }
