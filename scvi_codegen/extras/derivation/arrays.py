"""Derivation of array systems: L or H, the derivatives of every term with respect to its entries, and a step."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sympy import latex

from scvi_codegen.api.methods import Method
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.api.text import clipped
from scvi_codegen.codegen.ir.equations import FixedPointIteration, Splitting
from scvi_codegen.codegen.ir.kernel import Number
from scvi_codegen.codegen.ir.program import ArrayProgram
from scvi_codegen.codegen.lowering.program import lower_arrays
from scvi_codegen.systems.arrays.symmetry import momentum_maps
from scvi_codegen.systems.arrays.system import constraint_text, force_of
from scvi_codegen.systems.formulas.array_statements import latex_entry, latex_sums

DIGITS = 17


@dataclass(frozen=True, slots=True)
class ArrayStepEquations:
    """Compiled kernels of a system of arrays, with the loops around them, and the equations of a step."""

    system: ArraySystem
    method: Method

    def __repr__(self) -> str:
        return clipped(f"<equations of {self.system.name} by {self.method.name}>")

    @property
    def program(self) -> ArrayProgram:
        """Lowered program; MethodError without fixed-point iteration, and for a system that requires known sizes."""
        self.system.check_run_time_sizes()
        return lower_arrays(self.system, self.method, prefix="derived")

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
        yield from (f"    by {access}: {derivative}" for access, derivative in force_of(term, system.state).targets)
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
        yield f"  {constraint_text(term)}"
        pushed = force_of(term, system.coordinates).targets
        yield from (f"    on {access}: lambda*({derivative})" for access, derivative in pushed)
    energy = () if system.changes_energy else ("energy",)
    conserved = (*energy, *(symmetry.name for symmetry in momentum_maps(system)))
    yield f"Conserved: {', '.join(conserved) or 'nothing that is known'}"


def _latex(system: ArraySystem) -> Iterator[str]:
    yield rf"\[ {system.latex} \]"
    for term in system.potentials:
        entries = {slot: latex_entry(access) for slot, access in term.slots}
        for access, derivative in force_of(term, system.state).targets:
            by = rf"\frac{{\partial}}{{\partial {latex_entry(access)}}}"
            yield rf"\[ {latex_sums(term)} \; {by}: \quad {latex(derivative, symbol_names=entries)} \]"


def _step(program: ArrayProgram, method: Method) -> Iterator[str]:
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


def _splitting(splitting: Splitting) -> Iterator[str]:
    yield "(m its mass, F the force on it):"
    numbers = [splitting.numbers[name] for name in ("KICK", "DRIFT", "KICK_ABSCISSA")]
    for kick, drift, abscissa in zip(*numbers, strict=True):
        if kick != 0:
            yield f"  p += h*({_number(kick)})*F at t + h*({_number(abscissa)})"
        if drift != 0:
            yield f"  q += h*({_number(drift)})*p/m"


def _separable(scheme: FixedPointIteration) -> Iterator[str]:
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


def _hamiltonian(scheme: FixedPointIteration) -> Iterator[str]:
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
