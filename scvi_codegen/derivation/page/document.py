"""Sections of the page, in order, and the page."""

from collections.abc import Iterator, Sequence

from scvi_codegen.derivation.events import events_text
from scvi_codegen.derivation.notation import table_entries
from scvi_codegen.derivation.page.curve import curve_section, tables_section
from scvi_codegen.derivation.page.jacobian import jacobian_section
from scvi_codegen.derivation.page.kernels import functions_section, kernels_section, operations_section
from scvi_codegen.derivation.page.stage_equations import (
    component_equations,
    component_equations_section,
    idel_section,
    motion_section,
    stage_section,
    system_section,
)
from scvi_codegen.display.page.blocks import Listing, Section
from scvi_codegen.display.page.environment import page_template, style_sheet
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.discretise import check_regular, paper_equations
from scvi_codegen.methods.method import Method
from scvi_codegen.pipeline import c_identifier, program_of
from scvi_codegen.rendering.outline import functions_of
from scvi_codegen.rendering.program_source import render
from scvi_codegen.runtime.events.event import Event
from scvi_codegen.version import __version__


def derivation_html(system: MechanicalSystem, method: Method, *, events: Sequence[Event] = ()) -> str:
    """Return the derivation of ``method`` for ``system`` as a self-contained page of HTML.

    Args:
        system: the mechanical system.
        method: its discretisation.
        events: of runs, which may change the state.

    Raises:
        MethodError: for a system that the method does not support.
    """
    check_regular(method, system)
    more = [Section(name="events", title="Events", contents=(Listing(events_text(events, system)),))] if events else []
    return page_template("derivation.html.jinja").render(
        title=f"{system.name}: {method.title}",
        body_class="derivation",
        system=system,
        method=method,
        sections=[*_sections(system, method), *more],
        css=style_sheet("page.css", "derivation.css"),
        version=__version__,
    )


def _sections(system: MechanicalSystem, method: Method) -> Iterator[Section]:
    program = program_of(system, method, prefix=c_identifier(system.name))
    functions = functions_of(render(program).amalgamated().code)
    stages = paper_equations(system, method)
    derived = component_equations(system, method, stages)
    yield system_section(system)
    yield motion_section(system)
    yield curve_section(method)
    yield tables_section(method, table_entries(stages, method))
    yield stage_section(system, stages)
    yield idel_section(system, stages)
    yield component_equations_section(derived)
    yield jacobian_section(system, stages, derived, program)
    yield operations_section(program)
    yield kernels_section(system, program, functions)
    yield functions_section(system, method, program, functions)
