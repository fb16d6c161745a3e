"""Faults put into the generator on purpose: a certificate that does not catch each of them is worth nothing.

A mutation changes a function of the generator, in every module that has imported it, or edits the C text that it
writes. It is in force while the integrator is built *and* while it is verified, as a real fault would be: what the
verification shares with the generator is faulty, too.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pytest
import sympy
from conftest import QUICK_FLAGS, driven_duffing, pumped_cart_pole

from scvi_codegen import c_printer, compiler, derivatives, lowering, mechanics, quadrature, stage_system, tableau
from scvi_codegen.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanical_system import MechanicalSystem
from scvi_codegen.methods import (
    SCVI,
    SVI,
    ChebyshevGauss,
    Composition,
    ExplicitEuler,
    Gauss,
    LobattoIIIA,
    Method,
    RadauIA,
    RadauIIA,
    SpectralCollocation,
    StoermerVerlet,
)
from scvi_codegen.methods import collocation, composition, galerkin, method, shooting
from scvi_codegen.precision import mp
from scvi_codegen.problems import problem
from scvi_codegen.program import Constant, Operation
from scvi_codegen.solvers import coupled, separable, velocity_tables
from scvi_codegen.spaces import Splines, Trigonometric
from scvi_codegen.verification import Certificate, verify

__all__ = ["CASES", "MUTATIONS", "Case", "Mutation", "Sabotage", "certified"]


@dataclass(frozen=True)
class Case:
    """A system at a state, and a method."""

    system: MechanicalSystem
    method: Method
    q: tuple[float, ...]
    p: tuple[float, ...]
    h: float


def _pendulum(own: Method, h: float = 0.2) -> Case:
    return Case(problem("planar-pendulum").system, own, (0.7,), (0.9,), h)


def _driven(own: Method) -> Case:
    return Case(driven_duffing(), own, (0.6,), (-0.3,), 0.2)


def _kepler(own: Method, h: float = 0.1) -> Case:
    return Case(problem("kepler").system, own, (0.3, 0.8), (-1.1, 0.4), h)


def _double(own: Method) -> Case:
    return Case(problem("double-pendulum").system, own, (0.9, -0.6), (1.0, 0.5), 0.05)


def _cart(own: Method) -> Case:
    return Case(pumped_cart_pole(), own, (0.2, 0.9), (0.4, -0.7), 0.1)


def _vortices(own: Method) -> Case:
    entry = problem("point-vortices:3")
    assert entry.p is not None
    return Case(entry.system, own, entry.q, entry.p, 0.1)


CASES: dict[str, Case] = {
    "pendulum-svi": _pendulum(SVI(2)),
    "driven-svi": _driven(SVI(2)),
    "kepler-svi": _kepler(SVI(3)),
    "double-svi": _double(SVI(2)),
    "double-svi-more-points": _double(SVI(2, "gauss-lobatto:3")),
    "cart-svi": _cart(SVI(2)),
    "pendulum-hermite": _pendulum(SVI(3, "hermite:2")),
    "pendulum-splines": _pendulum(SVI(2, space="splines:2")),
    "pendulum-trigonometric": _pendulum(SVI(3, space="trigonometric:0.5")),
    "vortices-svi": _vortices(SVI(2)),
    "kepler-scvi": _kepler(SCVI(2)),
    "double-scvi": _double(SCVI(2)),
    "kepler-printed": _kepler(SCVI(3, variational=False)),
    "double-sc": _double(SpectralCollocation(2)),
    "kepler-sc-phase-space": _kepler(SpectralCollocation(2, form="phase-space")),
    "double-gauss": _double(Gauss(2)),
    "double-gauss-position": _double(Gauss(2, form="position")),
    "kepler-radau-iia": _kepler(RadauIIA(2)),
    "double-radau-ia": _double(RadauIA(2)),
    "kepler-lobatto": _kepler(LobattoIIIA(3)),
    "pendulum-chebyshev": _pendulum(ChebyshevGauss(3)),
    "pendulum-verlet": _pendulum(StoermerVerlet()),
    "double-verlet": _double(StoermerVerlet()),
    "kepler-composition": _kepler(Composition(8)),
    "driven-euler": _driven(ExplicitEuler()),
}


class Sabotage:
    """What a mutation may do; undone at the end, with every cache of the package emptied."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.patch, self.edits = patch, 0

    def replace(self, home: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Put ``make(original)`` in the place of a function, wherever it has been imported; or of a method."""
        original = getattr(home, name)
        mutated = make(original)
        self.patch.setattr(home, name, mutated)
        for module in [module for key, module in sys.modules.items() if key.startswith("scvi_codegen")]:
            for key, value in list(vars(module).items()):
                if value is original:
                    self.patch.setattr(module, key, mutated)

    def edit(self, pattern: str, replacement: str, count: int = 0) -> None:
        """Edit the C text; at least one of the texts must have the pattern."""

        def make(render: Callable[..., Any]) -> Callable[..., Any]:
            def rendered(program: Any) -> Any:
                source = render(program)
                code, edits = re.subn(pattern, replacement, source.code, count=count)
                self.edits += edits
                return replace(source, code=code)

            return rendered

        self.edits = -1 if self.edits == 0 else self.edits
        self.edits = 0
        self.replace(compiler, "render", make)


@dataclass(frozen=True)
class Mutation:
    """A fault, and the case it is tried on."""

    name: str
    case: str
    apply: Callable[[Sabotage], None]
    edits_text: bool = False


@contextlib.contextmanager
def sabotaged(apply: Callable[[Sabotage], None] | None) -> Iterator[Sabotage]:
    with pytest.MonkeyPatch.context() as patch:
        _empty_caches()
        patch.setattr(compiler, "remembered_texts", lambda *arguments: arguments[-1]())
        sabotage = Sabotage(patch)
        if apply is not None:
            apply(sabotage)
            _empty_caches()
        try:
            yield sabotage
        finally:
            patch.undo()
            _empty_caches()


def _empty_caches() -> None:
    for key, module in list(sys.modules.items()):
        if key.startswith("scvi_codegen"):
            for value in list(vars(module).values()):
                if hasattr(value, "cache_clear"):
                    value.cache_clear()


def certified(case: Case, apply: Callable[[Sabotage], None] | None = None, *, edits_text: bool = False) -> Certificate:
    """The certificate of a case with a fault in force, or without one."""
    with sabotaged(apply) as sabotage:
        certificate = verify(case.system, case.method, case.q, case.p, h=case.h, flags=QUICK_FLAGS)
        assert not edits_text or sabotage.edits, "the text to be edited was not found"
    return certificate


# Faults.


def _body(function: str, inner: str, replacement: str, count: int = 1) -> tuple[str, str]:
    """A pattern inside the body of a C function."""
    return rf"(\b{function}\([^;{{]*\)\n\{{\n(?:[^}}]*?\n)??[^}}]*?){inner}", rf"\g<1>{replacement}"


def _text(name: str, case: str, pattern: str, replacement: str, count: int = 0) -> Mutation:
    return Mutation(name, case, lambda sabotage: sabotage.edit(pattern, replacement, count), edits_text=True)


def _in(name: str, case: str, function: str, inner: str, replacement: str) -> Mutation:
    pattern, new = _body(function, inner, replacement)
    return _text(name, case, pattern, new, 1)


def _function(name: str, case: str, home: Any, attribute: str, make: Callable[[Any], Any]) -> Mutation:
    return Mutation(name, case, lambda sabotage: sabotage.replace(home, attribute, make))


def _result(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A function whose result is changed."""

    def make(original: Any) -> Any:
        def mutated(*arguments: Any, **named: Any) -> Any:
            return change(original(*arguments, **named))

        return mutated

    return make


def _first(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The same for the first entry of a sequence."""
    return _result(lambda values: (change(values[0]), *values[1:]))


def _eight_digits(x: Any) -> Any:
    return type(x)(mp.nstr(mp.mpf(x), 8)) if x else x


def _of_matrix(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return _result(lambda rows: tuple(tuple(map(change, row)) for row in rows))


def _lost_rate(which: Callable[[sympy.Symbol], bool]) -> Callable[[Any], Any]:
    """The chain rule without the terms of some variables."""

    def make(original: Any) -> Any:
        def mutated(expressions: Any, variables: Any, rates: Any) -> Any:
            kept = [(x, rate) for x, rate in zip(variables, rates, strict=True) if not which(x)]
            return original(expressions, tuple(x for x, _ in kept), tuple(rate for _, rate in kept))

        return mutated

    return make


def _tableau_with(**changes: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def change(own: Any) -> Any:
        return replace(own, **{key: make(getattr(own, key)) for key, make in changes.items()})

    return _result(change)


def _other_potential(original: Any) -> Any:
    """A Galerkin family of L + 1e-6 q: consistent, symplectic, symmetric, and of another system."""

    def mutated(self: Any, *arguments: Any) -> Any:
        own = self.gathers[0].arguments[0]
        return original(replace(self, scalar=self.scalar + own / 10**6), *arguments)

    return mutated


def _scaled(values: Sequence[Any], index: int, factor: Any) -> tuple[Any, ...]:
    return tuple(x * factor if k == index else x for k, x in enumerate(values))


def _without_negation(original: Any) -> Any:
    def mutated(expression: Any, context: int) -> str:
        if isinstance(expression, Operation) and expression.operator == "neg":
            return str(original(expression.operands[0], context))
        return str(original(expression, context))

    return mutated


def _swapped_parameters(original: Any) -> Any:
    def mutated(name: str, *, parameters: Any, **named: Any) -> Any:
        return original(name, parameters=tuple(reversed(parameters)), **named)

    return mutated


def _slopes_changed(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def make(original: Any) -> Any:
        def mutated(family: Any) -> Any:
            slopes, blocks = original(family)
            return tuple(change(k, slope) for k, slope in enumerate(slopes)), blocks

        return mutated

    return make


def _not_variational(sabotage: Sabotage) -> None:
    """The chain-rule term of the paper's correction lost everywhere: (34a)-(34e) as printed."""
    sabotage.replace(shooting, "_shooting_nodal", lambda _: shooting._printed_nodal)
    sabotage.replace(shooting, "_shooting_increments", lambda _: shooting._printed_increments)
    sabotage.patch.setattr("scvi_codegen.solvers.choice.shooting_sweep", lambda *_: None)


def _multipliers_halved(sabotage: Sabotage) -> None:
    sabotage.replace(shooting, "multiplied_residual", _result(lambda scalar: scalar * 2))


MUTATIONS: tuple[Mutation, ...] = (
    # The printer and the lowering.
    _function("numbers printed with 8 digits", "pendulum-svi", c_printer, "print_number", lambda _: lambda x: f"{x:.8e}"),
    _function("minus signs lost", "double-svi", c_printer, "_print", _without_negation),
    _function("parameters swapped", "double-svi", lowering, "lower_kernel", _swapped_parameters),
    _function("tables rounded to 8 digits", "double-svi", lowering, "lower_matrix", _of_matrix(_eight_digits)),
    _function(
        "constants rounded to single precision", "kepler-svi", lowering, "_double",
        _result(lambda x: x if x == round(8 * x) / 8 else x * (1 + 1e-7)),
    ),
    _function(
        "a whole power one too low", "kepler-svi", lowering._Graph, "_whole",
        lambda original: lambda self, x, n: original(self, x, n - 1 if n > 2 else n),
    ),
    _function(
        "an inverse root one power off", "kepler-svi", lowering, "INVERSE_ROOTS",
        lambda _: {-1: "inverse_root_1", -3: "inverse_root_5", -5: "inverse_root_5", -7: "inverse_root_7"},
    ),
    _function(
        "a power of h too much in a gather", "double-svi", lowering, "_gather_loop",
        _result(lambda loop: replace(loop, power=loop.power + 1) if loop.name.endswith("_1") else loop),
    ),
    _function(
        "a power of h missing in a scatter", "double-svi", lowering, "_scatter_loop",
        _result(lambda loop: replace(loop, power=loop.power - 1) if loop.name.endswith("_0") else loop),
    ),
    _function(
        "slopes of the kernel five per cent wrong", "double-svi", lowering, "_slope_blocks",
        _slopes_changed(lambda k, slope: slope * sympy.Rational(21, 20) if k == 0 else slope),
    ),
    _function(
        "a slope lost", "double-sc", lowering, "_slope_blocks",
        _slopes_changed(lambda k, slope: sympy.S.Zero if k == 1 else slope),
    ),
    # C text.
    _in("force with the other sign", "driven-svi", "force_lanes", r"value\[0\] = ", "value[0] = -"),
    _in("a term of the force dropped", "driven-svi", "force_lanes", r" - parameters\[0\]\*u\[0\]", ""),
    _in("Newton's residual with a wrong factor", "driven-svi", "quadrature_slope", r"3\.0\*", "2.0*"),
    _in("Newton's force with the other sign", "driven-svi", "quadrature_slope", r"value\[0\] = ", "value[0] = -"),
    _text("h in place of h^2", "driven-svi", r"data->square = h \* h;", "data->square = h;"),
    _text("time of the run one step late", "driven-svi", r"step\.t = run->t0 \+ \(double\)run->step", "step.t = run->t0 + (double)(run->step + 1)"),
    _text("energy with the kinetic sign for all", "driven-svi", r"sum = -value\[0\];", "sum = value[0];"),
    _text("Newton's iteration accepts too early", "double-svi", r"moved->overall <= 1e-11", "moved->overall <= 1e-4"),
    _text("what a sweep remembers is used as it is", "kepler-svi", r"step->q0\[i\] \+ \(dq\[i\]", "step->q0[i] + 1.0000001 * (dq[i]"),
    _in("the discrete action of half the weights", "pendulum-svi", "quadrature_sum", r"sum \+= ", "sum += 0.5 * "),
    _text("mass of the sweep doubled", "double-svi", r"const lanes w0 = parameters", "const lanes w0 = 2.0 * parameters"),
    # Tables of the methods.
    _function("rows of the adjoint with a wrong sign", "double-svi", stage_system, "stationary_increments", lambda original: lambda **named: _last_column_negated(original(**named))),
    _function("tables rounded to 2^-24, together", "double-svi", stage_system, "dyadic", _of_matrix(lambda x: mp.nint(x * 2**24) / 2**24)),
    _function("two weights exchanged", "double-svi-more-points", method, "unit_sum", _result(lambda w: (w[1], w[0], *w[2:]))),
    _function("a Gauss weight 1e-9 too large", "pendulum-svi", quadrature, "gauss_legendre", _result(lambda rule: _weight_changed(rule, mp.mpf("1e-9")))),
    _function("product of tables transposed", "kepler-svi", separable, "matrix_product", lambda original: lambda a, b: original(b, a) if len(a) == len(b) == len(a[0]) else original(a, b)),
    _function("position and momentum weights exchanged", "double-gauss", coupled, "_weighted_tables", _result(lambda t: (t[2], t[1], t[0], t[3]))),
    _function("Gauss tableau with 8 digits", "double-gauss", tableau, "gauss", _tableau_with(A=lambda A: tuple(tuple(map(_eight_digits, row)) for row in A))),
    _function("another symplectic tableau", "double-gauss", tableau, "gauss", lambda original: lambda s: _diagonally_implicit(original(s))),
    _function("rows of Radau IIA exchanged", "kepler-radau-iia", tableau, "radau_iia", _tableau_with(A=lambda A: A[::-1])),
    _function("Radau IIA with Radau IA's weights of order 1", "kepler-radau-iia", tableau, "radau_iia", _tableau_with(b=lambda b: b[::-1])),
    _function("Radau IA with a wrong index", "double-radau-ia", tableau, "radau_ia", _tableau_with(A=lambda A: tuple(zip(*A, strict=True)))),
    _function("Lobatto IIIB for IIIA", "kepler-lobatto", tableau, "lobatto_iiia", lambda _: tableau.lobatto_iiib),
    _function("a Chebyshev abscissa off by 1e-7", "driven-chebyshev", tableau, "chebyshev_gauss", _tableau_with(c=lambda c: (c[0] + mp.mpf("1e-7"), *c[1:]))),
    _function("tableau not transposed", "kepler-sc-phase-space", collocation, "_transposed", _result(lambda table: replace(table, entries=tuple(zip(*table.entries, strict=True)), names=tuple(zip(*table.names, strict=True))))),
    _function("position table without the square", "double-gauss-position", collocation, "matrix_product", lambda original: lambda a, b: original(a, b) if len(a) == 1 else a),
    _function("composition with a digit wrong", "kepler-composition", composition, "FIRST_HALVES", lambda own: {**own, 8: _scaled(own[8], 0, 1) if False else ("0.13020248308889108087881763", *own[8][1:])}),
    _function("kicks not shared between neighbours", "pendulum-verlet", composition, "kicks_and_drifts", _result(lambda parts: ((parts[0][0] * 2, *(mp.zero for _ in parts[0][1:])), parts[1]) if len(parts[1]) == 1 else parts)),
    _function("Verlet with one point of weight 1", "double-verlet", tableau, "lobatto_iiia", _tableau_with(b=lambda b: (b[0] + b[1], mp.zero))),
    _function("abscissa of Euler at the end", "driven-euler", tableau, "explicit_euler", _tableau_with(c=lambda c: (mp.one,))),
    _function("explicit Euler made implicit", "driven-euler", tableau, "explicit_euler", _tableau_with(A=lambda A: ((mp.one,),), c=lambda c: (mp.one,))),
    _function("derivative weights with the other sign", "pendulum-hermite", quadrature.Quadrature, "unit_derivative_weights", lambda own: property(lambda self: tuple(tuple(-x for x in line) for line in own.fget(self)))),
    _function("positions of splines 1e-9 off", "pendulum-splines", Splines, "positions", _of_matrix(lambda x: x * (1 + mp.mpf("1e-9")))),
    _function("positions of trigonometric curves 1e-9 off", "pendulum-trigonometric", Trigonometric, "positions", _of_matrix(lambda x: x * (1 + mp.mpf("1e-9")))),
    # The derivation, shared by both sides.
    _function("force three per cent wrong", "double-gauss-position", mechanics, "force", _first(lambda f: f * sympy.Rational(103, 100))),
    _function("another potential, consistently", "double-svi", stage_system.ScalarFamily, "slopes", _other_potential),
    _function("L_vq v lost", "double-sc", mechanics, "_rate", _lost_rate(lambda x: x.name in ("theta1", "theta2"))),
    _function("L_vt lost", "cart-sc", mechanics, "_rate", _lost_rate(lambda x: x.name == "t")),
    _function("L_vq v lost in the printed form", "double-printed", mechanics, "_rate", _lost_rate(lambda x: x.name in ("theta1", "theta2"))),
    _function("the power rule without its factor", "kepler-svi", derivatives, "_partial", lambda original: lambda node, k: original(node, k) / 2 if node.is_Pow and node.exp == 2 and k == 0 and node.base.is_Add else original(node, k)),
    _function("derivative of the cosine positive", "pendulum-verlet", sympy.cos, "fdiff", lambda _: lambda self, k=1: sympy.sin(self.args[0])),
    _function("H with the wrong sign", "vortices-svi", HamiltonianSystem, "lagrangian", lambda _: property(lambda self: sympy.Add(*(p * v for p, v in zip(self.momenta, self.velocities, strict=True)), self.hamiltonian))),
    Mutation("the chain-rule term of SCVI lost", "kepler-scvi", _not_variational),
    _function("multipliers without their terms in v0", "double-scvi", shooting, "_multiplier_family", _result(lambda family: replace(family, gathers=(family.gathers[0], _without_velocity(family.gathers[1]), *family.gathers[2:])))),
    _function("columns of the printed form exchanged", "kepler-printed", shooting, "cardinal_slopes", _result(lambda rows: tuple(tuple(reversed(row)) for row in rows))),
)
