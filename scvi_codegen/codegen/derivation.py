"""How a step is derived, as far as that is inspected: from L or H to equations, statements, the program and its C."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from scvi_codegen.codegen.lowering.program import lower_arrays, step_texts
from scvi_codegen.codegen.lowering.stage_groups import argument_name
from scvi_codegen.codegen.pipeline import c_identifier, program_of
from scvi_codegen.codegen.rendering.program_source import render
from scvi_codegen.methods import Method, sliding
from scvi_codegen.methods.discretise import Discretisation
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.contacts.modes import in_all_modes
from scvi_codegen.systems.formulas.intermediates import inner_of, written_out
from scvi_codegen.systems.kinks import located_kinks
from scvi_codegen.systems.legendre.of_arrays import site_hamiltonian
from scvi_codegen.systems.system import MechanicalSystem


@dataclass(frozen=True)
class Derivation:
    """Derivation of the step of a method for a system.

    Raises:
        MethodError: where the method does not apply to the system, when something is derived.
    """

    system: MechanicalSystem
    method: Method

    @cached_property
    def with_friction(self) -> Derivation:
        """The same with contacts in place of dry friction in forces, where compiled steps have them."""
        return Derivation(sliding(self.system, self.method), self.method)

    @cached_property
    def in_all_modes(self) -> MechanicalSystem:
        """System with the constraints and forces of its contacts in all their modes."""
        system: MechanicalSystem = in_all_modes(self.system)
        return system

    @cached_property
    def form(self) -> MechanicalSystem:
        """System whose equations are discretised; of arrays whose masses couple them, as Hamiltonian of sites."""
        if isinstance(self.system, ArraySystem):
            sites = site_hamiltonian(self.system) if self.system.coupled_terms else None
            return sites.system if sites else self.system
        return Discretisation(self.in_all_modes, self.method).form

    @cached_property
    def written_form(self) -> MechanicalSystem:
        """:attr:`form` without intermediate quantities in L or H. SystemDefinitionError if that is too long."""
        if not inner_of(self.form.formula):
            return self.form
        kind: dict[str, Any] = {
            "hamiltonian" if self.form.auxiliaries else "lagrangian": written_out(self.form.formula)
        }
        return replace(self.form, **kind)

    @cached_property
    def located(self) -> MechanicalSystem:
        """:attr:`form` with a mode for each of its kinks, as runs locate them."""
        return located_kinks(self.form)[0]

    @cached_property
    def statements(self) -> Mapping[str, str]:
        """Statements that the C of a step is generated from, by their titles; none of other steps."""
        return step_texts(self.system, self.method)

    @cached_property
    def program(self) -> Any:
        """Lowered program: kernels, tables of numbers and loops, of which ``codegen/ir/program.py`` has the classes."""
        if isinstance(self.form, ArraySystem):
            self.form.check_run_time_sizes()
            return lower_arrays(self.form, self.method, prefix="derived")
        return program_of(self.in_all_modes, self.method, prefix=c_identifier(self.system.name))

    @cached_property
    def functions(self) -> Mapping[str, Any]:
        """Functions of the C of a step by name, with all that it includes."""
        return render(self.program).functions

    @staticmethod
    def argument_name(system: MechanicalSystem, gather: Any) -> str:
        """Return the name of the arguments that a gather of ``StageGroup`` collects, as used in formulas."""
        return argument_name(system, gather)
