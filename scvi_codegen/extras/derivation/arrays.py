"""Derivation of array systems: L or H, the derivatives of every term with respect to its entries, and a step."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from textwrap import shorten
from typing import Any

from scvi_codegen.api.formulas import Number
from scvi_codegen.api.methods import Method
from scvi_codegen.api.program import Derivation
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.systems.symmetry.symmetry import symmetries

DIGITS = 17


@dataclass(frozen=True, slots=True)
class ArrayStepEquations:
    """Compiled kernels of a system of arrays, with the loops around them, and the equations of a step."""

    system: ArraySystem
    method: Method

    def __repr__(self) -> str:
        return shorten(f"<equations of {self.system.name} by {self.method.name}>", 100, placeholder="..")

    @property
    def program(self) -> Any:
        """Lowered program; MethodError without fixed-point iteration, and for a system that requires known sizes."""
        return Derivation(self.system, self.method).program

    def to_text(self) -> str:
        """Return plain text."""
        return "\n".join([*_text(self.system), "", *_step(self.program, self.method)])

    def to_latex(self) -> str:
        """Return L or H and the derivatives of its terms, one line each."""
        return "\n".join(_latex(self.system))


def _text(system: ArraySystem) -> Iterator[str]:
    yield str(system)
    yield ""
    yield "Terms of -H, and their derivatives:" if system.momenta else "Terms of -V, and what each adds to the forces:"
    for term in system.potentials:
        yield f"  {term}"
        yield from (f"    by {access}: {derivative}" for access, derivative in system.derivatives(term, system.state))
    if not system.momenta:
        yield "Masses:"
        for mass in system.masses:
            where = f"for {', '.join(map(str, mass.loops))}: " if mass.loops else ""
            yield from (f"  {where}{formula} at {access}" for access, formula in mass.targets)
    if system.applied_forces:
        yield "Forces beside:"
        yield from (f"  {force}" for force in system.applied_forces)
    if system.constraints:
        yield "Constraints, each with what it adds to the forces:"
    for term in system.constraints:
        yield f"  {system.constraint_text(term)}"
        pushed = system.derivatives(term, system.coordinates)
        yield from (f"    on {access}: lambda*({derivative})" for access, derivative in pushed)
    conserved = [*["energy"] * (not system.changes_energy), *(symmetry.name for symmetry in symmetries(system))]
    yield f"Conserved: {', '.join(conserved) or 'nothing that is known'}"


def _latex(system: ArraySystem) -> Iterator[str]:
    yield rf"\[ {system.latex} \]"
    for term in system.potentials:
        yield from (rf"\[ {line} \]" for line in system.latex_derivatives(term))


def _step(program: Any, method: Method) -> Iterator[str]:
    yield f"A step of h by {method.title}, from q, p to q', p', the same for every coordinate"
    if program.loops.constrained:
        yield "(m its mass, F the force on it, G the Jacobian of the constraints g, q, p going on from part to part):"
        for part in program.loops.constrained.parts:
            yield f"  p = p + {_number(part)}*h/2 (F + G^T lambda),  q = q + {_number(part)}*h p/m  with  g(q) = 0"
            yield f"  p = p + {_number(part)}*h/2 (F + G^T mu)  with  G p/m + g_t = 0"
    elif program.splitting:
        yield from _splitting(program.splitting)
    elif program.fixed_point:
        yield from (_separable if program.fixed_point.name == "separable" else _hamiltonian)(program.fixed_point)


def _splitting(splitting: Any) -> Iterator[str]:
    yield "(m its mass, F the force on it):"
    numbers = [splitting.numbers[name] for name in ("KICK", "DRIFT", "KICK_ABSCISSA")]
    for kick, drift, abscissa in zip(*numbers, strict=True):
        if kick != 0:
            yield f"  p += h*({_number(kick)})*F at t + h*({_number(abscissa)})"
        if drift != 0:
            yield f"  q += h*({_number(drift)})*p/m"


def _separable(scheme: Any) -> Iterator[str]:
    yield "(m its mass, F_n the force on it at the points X_n of all):"
    (drift,), (abscissae,), product = map(scheme.numbers, ("DRIFT", "ABSCISSA", "PRODUCT"))
    for n in range(scheme.points):
        terms = _combination(product[n], "F", scheme.points)
        yield f"  X_{n} = q + h*({_number(drift[n])})*p/m + h**2/m*({terms}) at t + h*({_number(abscissae[n])})"
    q1, p1 = (
        _combination(scheme.numbers(f"POINT_END_{name}")[0], "F", scheme.points) for name in ("POSITION", "MOMENTUM")
    )
    yield f"  q' = q + h*p/m + h**2/m*({q1})"
    yield f"  p' = p + h*({p1})"


def _hamiltonian(scheme: Any) -> Iterator[str]:
    yield "(V_n = H_p and F_n = -H_q at the points Q_n, P_n of all):"
    kinds = (("Q", "q", "POSITION", "V"), ("P", "p", "MOMENTUM", "F"))
    weights = {name: scheme.numbers(f"{name}_WEIGHT")[0] for _, _, name, _ in kinds}
    for n in range(scheme.points):
        for letter, start, name, rate in kinds:
            row = _weighted(scheme.numbers(name)[n], weights[name])
            yield f"  {letter}_{n} = {start} + h*({_combination(row, rate, scheme.points)})"
    for _, start, name, rate in kinds:
        end = _weighted(scheme.numbers(f"POINT_END_{name}")[0], weights[name])
        yield f"  {start}' = {start} + h*({_combination(end, rate, scheme.points)})"


def _weighted(row: Sequence[Number], weights: Sequence[Number]) -> list[Number]:
    return [x * w for x, w in zip(row, weights, strict=True)]


def _combination(row: Sequence[Number], letter: str, points: int) -> str:
    terms = [f"{_number(x)}*{letter}_{n}" for n, x in enumerate(row[:points]) if x != 0]
    return " + ".join(terms).replace("+ -", "- ") or "0"


def _number(x: Number) -> str:
    return f"{float(x):.{DIGITS}g}"
