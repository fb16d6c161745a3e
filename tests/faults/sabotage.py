"""How a fault is put into the generator, and taken out again.

It is in force while the integrator is built *and* while it is verified, as a real fault would be: what the verification
shares with the generator is faulty, too.
"""

import contextlib
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import pytest
from samples import QUICK_FLAGS

from scvi_codegen import (
    compiler,
    pipeline,  # imported before any fault: a later import would keep a faulty function
)
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods import Method
from scvi_codegen.rendering import program_source
from scvi_codegen.verification import Certificate, verify

Make = Callable[[Any], Any]

_numbers = count(1)
"""Numbers of faults, one library each: a fixed-point iteration that a fault leaves unchanged would keep the fallback
library of the faulty Newton iteration for what is certified later in the process."""


@dataclass(frozen=True)
class Case:
    """A system at a state, and how to make a method; what chooses the length of the steps of its runs, if anything."""

    system: MechanicalSystem
    method: Callable[[], Method]
    q: tuple[float, ...]
    p: tuple[float, ...]
    h: float
    tolerance: float | None = None
    time_transformation: str | None = None


class Sabotage:
    """What a fault may do."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.patch, self.edits = patch, 0

    def replace(self, home: Any, name: str, make: Make) -> None:
        """Put ``make(original)`` in the place of a function, a table or a method, wherever it has been imported."""
        original = getattr(home, name)
        mutated = make(original)
        self.patch.setattr(home, name, mutated)
        for module in [module for key, module in sys.modules.items() if key.startswith("scvi_codegen")]:
            for key, value in list(vars(module).items()):
                if value is original:
                    self.patch.setattr(module, key, mutated)

    def replace_here(self, home: Any, name: str, make: Make) -> None:
        """The same in one module only."""
        self.patch.setattr(home, name, make(getattr(home, name)))

    def edit(self, pattern: str, replacement: str) -> None:
        """Edit the first place with the pattern of each C text: artefact, Newton's solver, lanes, derivatives."""

        def make(render: Callable[..., Any]) -> Callable[..., Any]:
            def rendered(program: Any, *control: Any, **where: Any) -> Any:
                source = render(program, *control, **where)
                if source is None:
                    return None
                source = source.amalgamated()
                code, edits = re.subn(pattern, replacement, source.code, count=1)
                self.edits += edits
                return replace(source, code=code)

            return rendered

        for render in ("render", "render_ensemble", "render_derivatives"):
            assert getattr(pipeline, render) is getattr(program_source, render), "an earlier fault is still in force"
            self.replace(program_source, render, make)


def changed_result(change: Make) -> Make:
    """Of a function one whose result is changed."""

    def make(original: Any) -> Any:
        return lambda *arguments, **named: change(original(*arguments, **named))

    return make


def changed_property(change: Make) -> Make:
    """Of a property that is kept one whose value is changed."""
    return lambda own: property(lambda self: change(own.func(self)))


def of_entries(change: Make) -> Make:
    """The same for each entry of a matrix."""
    return changed_result(lambda rows: tuple(tuple(map(change, row)) for row in rows))


def certified(case: Case, apply: Callable[[Sabotage], None] | None = None, *, edits_text: bool = False) -> Certificate:
    """The certificate of a case with a fault in force, or without one."""
    assert case.system.formula is not None  # read before the fault is in force
    flags = QUICK_FLAGS if apply is None else (*QUICK_FLAGS, f"-DFAULT_{next(_numbers)}")
    with sabotaged(apply) as sabotage:
        stepper = compiler.compile_stepper(
            case.system, case.method(), flags=flags, time_transformation=case.time_transformation
        )
        certificate = verify(
            case.system, case.method(), case.q, case.p, h=case.h, stepper=stepper, tolerance=case.tolerance
        )
        assert not edits_text or sabotage.edits, "the text to be edited was not found"
    return certificate


@contextlib.contextmanager
def sabotaged(apply: Callable[[Sabotage], None] | None) -> Iterator[Sabotage]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "cached_source", lambda *arguments: arguments[-1]())
        sabotage = Sabotage(patch)
        try:
            if apply is not None:
                apply(sabotage)
                _empty_caches()
            yield sabotage
        finally:
            patch.undo()
            if apply is not None:
                _empty_caches()


def _empty_caches() -> None:
    """Of all functions of the package: nothing computed with a fault survives it, nor the other way round."""
    for module in [module for key, module in sys.modules.items() if key.startswith("scvi_codegen")]:
        for value in list(vars(module).values()):
            if hasattr(value, "cache_clear"):
                value.cache_clear()
