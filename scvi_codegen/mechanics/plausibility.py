"""Warnings for definitions that are probably mistakes: parameters without effect and masses of the wrong sign."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping, Set
from functools import reduce

from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionWarning, warn
from scvi_codegen.formulas.derivatives import hessian
from scvi_codegen.formulas.inputs import PARTS
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.formulas.tape import Tape
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.precision import Number, mp

__all__ = ["warn_of_mistakes", "warn_of_negative", "warn_of_unused"]

SAMPLES = 16
"""Number of random positive values of the parameters at which a negative coefficient is evaluated again."""


def warn_of_mistakes(system: MechanicalSystem, others: Iterable[Expr] = ()) -> None:
    """Warn of parameters and inputs that occur in no formula of a system, and of negative masses.

    A mass is a diagonal entry of d2L/dv2, or of d2H/dp2. Entries that depend on coordinates or time are not examined.
    ``others`` are formulas that use parameters of the system, too.
    """
    if not system.parameters:
        return
    formulas = (*others, system.formula, *system.forces, *system.constraints, system.damping, *system.integrands)
    energy = [system.clock.energy] if system.clock else []
    function, variables = (
        ("Hamiltonian", system.auxiliaries) if system.auxiliaries else ("Lagrangian", system.velocities)
    )
    used = set[Symbol](energy).union(*(formula.free_symbols for formula in formulas))
    warn_of_unused(system.name, function, system.parameters, system.inputs, used)
    plain = system.clock.plain.formula if system.clock and system.clock.plain else system.formula
    entries = hessian(plain, variables)
    masses = {f"d2{function[0]}/d{v}2": entries[i, i] for i, v in enumerate(variables) if (i, i) in entries}
    warn_of_negative(system.name, masses, system.constants)


def warn_of_unused(
    name: str, function: str, parameters: Iterable[Symbol], inputs: Iterable[str], used: Set[Symbol]
) -> None:
    """Warn of parameters and inputs of the system ``name`` that are not among the symbols ``used``."""
    parts = {each: {symbol(f"{each}_{part}") for part in PARTS} for each in inputs}
    kinds = [f"input '{each}'" for each, symbols in parts.items() if not symbols & used]
    occurring = reduce(set.union, parts.values(), set[Symbol]())
    kinds += [f"parameter '{each}'" for each in parameters if each not in used and each not in occurring]
    for kind in kinds:
        where = f"the {function}, the forces or the constraints of '{name}'"
        warn(f"{kind} is not used in {where}; remove it or use it.", SystemDefinitionWarning)


def warn_of_negative(name: str, coefficients: Mapping[str, Expr], constants: Mapping[Symbol, float]) -> None:
    """Warn of coefficients of the kinetic energy that are negative because of the default values of parameters.

    No warning is given where a coefficient was negative for all positive values tried: the sign is then in the formula.
    """
    for what, formula in coefficients.items():
        occurring = sorted(formula.free_symbols & constants.keys(), key=str)
        if not occurring or len(occurring) < len(formula.free_symbols):
            continue
        tape = Tape([formula], occurring)
        value = _value(tape, [constants[each] for each in occurring])
        if value is not None and value < 0 and any(sample >= 0 for sample in _positive_samples(tape, len(occurring))):
            defaults = ", ".join(f"{each} = {constants[each]:g}" for each in occurring)
            text = str(formula)
            shown = f"{what} = {text}" if len(text) <= 60 else what
            warn(
                f"{shown} of '{name}' is {float(value):g} with the default parameters ({defaults}): a negative mass. "
                "Check the signs of these parameters.",
                SystemDefinitionWarning,
            )


def _positive_samples(tape: Tape, count: int) -> Iterator[Number]:
    """Yield the values of a formula at random positive values of its ``count`` symbols, always the same ones."""
    generator = random.Random(20250101)
    for _ in range(SAMPLES):
        value = _value(tape, [10.0 ** generator.uniform(-2, 2) for _ in range(count)])
        if value is not None:
            yield value


def _value(tape: Tape, numbers: Iterable[float]) -> Number | None:
    try:
        return tape([mp.mpf(number) for number in numbers])[0]
    except ArithmeticError:
        return None
