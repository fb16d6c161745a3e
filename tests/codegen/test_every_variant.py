"""Every variant of C compiles without a warning: methods and solvers x what acts x events x time x precision x form.

A system of one or two coordinates is enough: which headers meet depends on the variant alone. What cannot be combined
is refused by an error of the package.
"""

import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from notation import lagrange
from programs import needs

import scvi_codegen as sc
from scvi_codegen.codegen.pipeline import Sources
from scvi_codegen.codegen.rendering.events import with_events
from scvi_codegen.codegen.rendering.source import DOUBLE_DOUBLE, Interface, Source
from scvi_codegen.codegen.variants import Acting, Derivatives, Energies, Lanes, NewtonFallback, TangentVectors, Variant
from scvi_codegen.common.errors import ScviCodegenError

STEPS = {
    "fixed-point": ("svi:2", "auto"),
    "newton": ("svi:2", "newton"),
    "explicit": ("stoermer-verlet", "explicit"),
    "composition": ("composition:4", "auto"),
    "collocation": ("sc:2", "auto"),
    "gauss": ("gauss:2", "auto"),
    "shooting": ("scvi:2", "auto"),
}
PLANE = "(x_dot**2 + y_dot**2)/2 - 9*y"
SYSTEMS: dict[str, Any] = {
    "nothing": lambda: lagrange("point", "x", "x_dot**2/2 - x**4"),
    "mass": lambda: lagrange("swing", "x y", "(1 + y**2)*x_dot**2/2 + y_dot**2/2 - x**2*y**2", damping="c", c=0.1),
    "input": lambda: lagrange("pushed", "x", "x_dot**2/2 - x**2", forces={"x": "u*cos(t)"}, inputs="u"),
    "bath": lambda: lagrange("well", "x", "x_dot**2/2 - x**4", damping="g", temperature="kT", g=1.0, kT=1.0),
    "constraint": lambda: lagrange("swing", "x y", PLANE, constraints=["x**2 + y**2 = 1"]),
    "rotation": lambda: lagrange("body", (), "(w_1**2 + w_2**2 + 2*w_3**2)/2 - R_33", rotations={"R": "w"}),
    "kink": lambda: lagrange("spring", "x", "x_dot**2/2 - positive_part(x)**2"),
    "contact": lambda: touching([sc.contact("y", slip="x_dot", friction=0.3, restitution=0.5)]),
    "contact in space": lambda: touching([sc.contact("y", slip=["x_dot", "z_dot"], friction="1/3 + x**2")], " z"),
    "dry friction": lambda: touching([sc.friction("x_dot", limit=0.1)]),
}
EMBEDDED = {"embedded": "double", "embedded single": "single"}
SEPARATE = ("two words", "further sources")
FORMS = ("file", "controlled", *EMBEDDED, *SEPARATE)
FURTHER = (
    *(Lanes(), Lanes("single"), NewtonFallback(), Derivatives(1), Derivatives(2), Acting(), Acting(in_lanes=True)),
    *(TangentVectors(2), Energies()),
)
FLAGS = "-std=c99 -Wall -Wextra -Werror -fsyntax-only".split()  # noqa: SIM905  (as one types it)


def events_of(acts: str) -> list[tuple[sc.Event, ...]]:
    """No events, one that is located, an impact."""
    function = "R_13 - 1/3" if acts == "rotation" else "x - 1/3"
    return [(), (sc.Event(function, terminal=True),), (sc.impact(function, restitution=0.5),)]


UNFINISHED = {
    ("constraint", "embedded"): "events of constraints: names of the single file are not found",
    ("constraint", "two words"): "find_accelerations takes other vectors",
}
"""What does not compile yet."""


def touching(contacts: list[Any], more: str = "") -> Any:
    lagrangian = PLANE + (" + z_dot**2/2" if more else "")
    return sc.LagrangianSystem.from_text("point", ["x", "y", *more.split()], lagrangian, contacts=contacts)


def made(steps: str, acts: str, form: str, *, tau: bool) -> list[Source]:
    """Sources of a variant with each kind of events; none where the package refuses it."""
    (method, solver), system = STEPS[steps], SYSTEMS[acts]()
    g = f"1/(2 + {system.coordinates[0].name}**2)" if tau else None
    with suppress(ScviCodegenError):
        if form in SEPARATE:
            precision = DOUBLE_DOUBLE if form == "two words" else "double"
            sources = Sources(system, sc.as_method(method, system), solver, g=g, precision=precision)
            if form == "further sources":
                return [*filter(None, (variant(sources, kind) for kind in FURTHER))]
            return [sources.integrator()[0]]
        embedded = EMBEDDED.get(form)
        kinks = "located" if not (tau or embedded or system.bath) else "as formulas"
        rest = {"solver": solver, "controlled": form != "file", "time_transformation": g, "kinks": kinks}
        if not embedded:
            return with_each_event(*sc.generate_source(system, method, **rest), acts)
        return [*filter(None, (embedded_source(system, method, embedded, events, rest) for events in events_of(acts)))]
    return []


def with_each_event(source: Source, interface: Interface, acts: str) -> list[Source]:
    found = []
    for events in events_of(acts):
        with suppress(ScviCodegenError):
            searched = interface.searched(events)
            found.append(with_events(source, interface, searched) if searched else source)
    return found


def embedded_source(system: Any, method: str, precision: Any, events: Any, rest: Any) -> Source | None:
    with suppress(ScviCodegenError):
        return sc.generate_source(system, method, embedded=precision, events=events, **rest)[0]
    return None


def variant(sources: Sources, kind: Variant) -> Source | None:
    with suppress(ScviCodegenError):
        if sources.system.bath is None or kind != Lanes("single"):  # which runs refuse
            return sources.variant(kind)
    return None


def check(sources: Sequence[Source], folder: Path, name: str, *more: str) -> None:
    """Compile sources, each with what is beside it, as one call of the compiler for all."""
    files = []
    for number, source in enumerate(sources):
        place = folder / f"{name}{number}"
        place.mkdir()
        for part in source.amalgamated().sources:
            (place / f"{part.prefix}.h").write_text(part.header)
            (place / f"{part.prefix}.c").write_text(part.code)
            files.append(f"{place.name}/{part.prefix}.c")
    done = subprocess.run(
        [needs("gcc"), *FLAGS, *more, *files], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[:3000]


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.MethodWarning")
@pytest.mark.second
@pytest.mark.covering
@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("acts", SYSTEMS)
@pytest.mark.parametrize("form", FORMS)
def test_every_variant_compiles_without_warnings(steps: str, acts: str, form: str, tmp_path: Path) -> None:
    if reason := UNFINISHED.get((acts, form)):
        pytest.xfail(reason)
    for tau in (False, True):
        if sources := made(steps, acts, form, tau=tau):
            unused = ("-Wno-unused-parameter",) if form in EMBEDDED else ()  # functions without what they do not need
            check(sources, tmp_path, "tau" if tau else "t", *unused)
