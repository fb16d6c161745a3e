"""Steppers whose C has a fault, to show that it is noticed."""

from dataclasses import replace

from scvi_codegen import Stepper
from scvi_codegen.codegen.ir.variants import WithEvents
from scvi_codegen.runs.stepping.compiled_method import Variants


def planted(own: Stepper, right: str, wrong: str) -> Stepper:
    """Return a stepper whose runs have a wrong text in place of the right one in their support headers."""
    texts = tuple((name, text.replace(right, wrong)) for name, text in own.source.beside.support)
    assert texts != own.source.beside.support
    faulty = replace(own.source, beside=replace(own.source.beside, support=texts))
    return Stepper(own.source, own.interface, flags=("-O0",), variants=Variants({WithEvents(own.searched): faulty}))
