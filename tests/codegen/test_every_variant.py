"""Every variant of C compiles without a warning: methods and solvers x what acts x events x time x precision x form.

A system of one or two coordinates is enough: which headers meet depends on the variant alone. What cannot be combined
is refused by the package, for a reason of ``REFUSED``: others are errors, and so is a source in spite of one. Objects
export nothing but names with the prefix, and hold no data that could be written.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import which
from typing import Any

import pytest
from notation import hamilton, lagrange
from programs import needs
from samples import linkage
from strict_c import STRICT, run

import scvi_codegen as sc
from scvi_codegen.codegen.ir.variants import Acting, Derivatives, Energies, Lanes, NewtonFallback, TangentVectors
from scvi_codegen.codegen.pipeline import Sources
from scvi_codegen.codegen.rendering.source import DOUBLE_DOUBLE, Source
from scvi_codegen.common.errors import ScviCodegenError
from scvi_codegen.methods import sliding
from scvi_codegen.systems.contacts.modes import bound_contacts

STEPS: dict[str, tuple[Any, str]] = {
    "fixed-point": ("svi:2", "auto"),
    "newton": ("svi:2", "newton"),
    "explicit": ("stoermer-verlet", "explicit"),
    "composition": ("composition:4", "auto"),
    "collocation": ("sc:2", "auto"),
    "phase space": (sc.SpectralCollocation(2, form="phase-space"), "auto"),
    "gauss": ("gauss:2", "auto"),
    "radau": (sc.RadauIA(2), "auto"),
    "positions": (sc.ChebyshevLobatto(3, form="position"), "auto"),
    "shooting": ("scvi:2", "auto"),
    "abscissae": (sc.SCVI(2, abscissae="gauss"), "auto"),
    "euler": ("explicit-euler", "auto"),
    "hermite": (sc.SVI(3, "hermite-2:3"), "auto"),
    "splines": (sc.SVI(3, space="splines:2"), "auto"),
    "trigonometric": (sc.SVI(2, space="trigonometric:0.3"), "auto"),
    "iteration alone": ("svi:2", "fixed-point"),
}
EXPLICIT = ("explicit", "composition")
PLANE = "(x_dot**2 + y_dot**2)/2 - 9*y"
SYSTEMS: dict[str, Any] = {
    "nothing": lambda: lagrange("point", "x", "x_dot**2/2 - x**4"),
    "mass": lambda: lagrange("swing", "x y", "(1 + y**2)*x_dot**2/2 + y_dot**2/2 - x**2*y**2", damping="c", c=0.1),
    "input": lambda: lagrange("pushed", "x", "x_dot**2/2 - x**2", forces={"x": "u*cos(t)"}, inputs="u"),
    "bath": lambda: lagrange("well", "x", "x_dot**2/2 - x**4", damping="g", temperature="kT", g=1.0, kT=1.0),
    "constraint": lambda: lagrange("swing", "x y", PLANE, constraints=["x**2 + y**2 = 1"]),
    "linkage": linkage,
    "pin": lambda: lagrange("bead", "r a", "(r_dot**2 + r**2*a_dot**2)/2", constraints=["r + cos(a)"], damping="1/9"),
    "hamiltonian": lambda: hamilton("h", "x y", "sqrt(1 + p_x**2 + k*p_x*p_y + p_y**2) + x*sin(t) + x**2*p_y", k=0.3),
    "singular": lambda: sc.HamiltonianSystem.from_text("h", ["x"], "x*p", momenta=["p"]),
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


def events_of(acts: str) -> list[tuple[sc.Event, ...]]:
    """No events, one that is located, an impact."""
    function = "R_13 - 1/3" if acts == "rotation" else "x - 1/3"
    return [(), (sc.Event(function, terminal=True),), (sc.impact(function, restitution=0.5),)]


def touching(contacts: list[Any], more: str = "") -> Any:
    lagrangian = PLANE + (" + z_dot**2/2" if more else "")
    return sc.LagrangianSystem.from_text("point", ["x", "y", *more.split()], lagrangian, contacts=contacts)


@dataclass(frozen=True)
class Case:
    """A variant: keys of the tables above, whether steps are of transformed time, and its events or further source."""

    steps: str
    acts: str
    form: str
    tau: bool = False
    kind: Any = ()

    def source(self) -> Source | None:
        """Return the source; none where a further one does not exist for this method."""
        (method, solver), system = STEPS[self.steps], SYSTEMS[self.acts]()
        g = f"1/(2 + {system.coordinates[0].name}**2)" if self.tau else None
        if self.form in SEPARATE:
            if system.has_contacts and self.form != "two words":
                system = bound_contacts(sliding(system, method), system.contacts)[0]
            precision = DOUBLE_DOUBLE if self.form == "two words" else "double"
            sources = Sources(system, sc.as_method(method, system), solver, g=g, precision=precision)
            if not self.kind:
                return sources.integrator()[0]
            sources.program()  # a method that is refused has no further source
            return sources.variant(self.kind)
        return sc.generate_source(
            system,
            method,
            solver=solver,
            events=self.kind,
            embedded=EMBEDDED.get(self.form),
            controlled=self.form != "file",
            time_transformation=g,
        )[0]


TOUCHING = ("contact", "contact in space", "dry friction")
HOLDING, HAMILTONIAN = ("constraint", "linkage", "pin", *TOUCHING), ("hamiltonian", "singular")
REGULAR = ("shooting", "positions", "abscissae", "splines", "trigonometric")
"""Steps that take no Hamiltonian whose momenta velocities do not determine, as do those of collocation."""
REFUSED: tuple[tuple[str, Callable[[Case], bool]], ...] = (
    ("contacts of 'point' require compile_stepper", lambda of: of.acts in TOUCHING and of.form == "two words"),
    ("not available with contacts", lambda of: of.tau and of.acts in TOUCHING),
    (
        "events require double precision",
        lambda of: of.form == "embedded single" and (of.acts in TOUCHING or bool(of.kind)),
    ),
    ("which a Hamiltonian does not define", lambda of: of.steps == "hermite" and of.acts in HAMILTONIAN),
    (
        "not supported with the forces",
        lambda of: of.steps == "hermite" and of.acts in ("linkage", "input", "dry friction"),
    ),
    (
        "not explicit|requires a separable system",
        lambda of: (
            of.steps in EXPLICIT
            and (of.acts in ("mass", *HAMILTONIAN) or (of.steps == "composition" and of.acts in ("linkage", "pin")))
        ),
    ),
    (
        "does not support the damping",
        lambda of: of.acts in ("mass", "pin") and of.steps in ("collocation", *REGULAR[:3], "hermite"),
    ),
    ("requires a regular Hamiltonian", lambda of: of.acts == "singular" and of.steps in ("collocation", *REGULAR)),
    (
        "solver='fixed-point' is unavailable with embedded",
        lambda of: of.form in EMBEDDED and of.steps == "iteration alone",
    ),
    ("has no fixed-point iteration", lambda of: of.acts in HOLDING and of.steps == "iteration alone"),
    (
        "does not support the (nonholonomic )?constraints",
        lambda of: of.acts in HOLDING and of.steps not in ("fixed-point", "newton"),
    ),
    (
        "not available with a heat bath",
        lambda of: (
            of.acts == "bath" and (of.tau or of.form in ("embedded single", "two words") or of.kind == Lanes("single"))
        ),
    ),
    (
        "solver='explicit' requires constant diagonal masses and fixed steps",
        lambda of: of.form == "two words" and of.steps == "explicit" and (of.tau or of.acts == "rotation"),
    ),
)
"""Words of a refusal, and which variants it refuses; the first one that applies is raised."""


def refusal(of: Case) -> str | None:
    """Return words of the error by which the package refuses a variant."""
    return next((words for words, applies in REFUSED if applies(of)), None)


def cases(steps: str, acts: str, form: str) -> Iterator[Case]:
    """Return those of one combination: in both kinds of time, with each kind of events, or each further source.

    Events of runs in two words are located by an integrator in double: in two words there is no search.
    """
    kinds: Any = {"two words": [()], "further sources": FURTHER}.get(form) or events_of(acts)
    times = (False,) if form in SEPARATE and acts in TOUCHING else (False, True)
    return (Case(steps, acts, form, tau, kind) for tau in times for kind in kinds)


def flags_of(case: Case) -> list[str]:
    """Sources beside others have kernels and tables that few steps use; lanes in single precision round doubles."""
    idle = ["-Wno-unused-function", "-Wno-unused-const-variable"] if case.form in SEPARATE else []
    return idle + (["-Wno-conversion", "-Wno-float-conversion"] if case.kind == Lanes("single") else [])


def check(sources: Sequence[tuple[Case, Source]], folder: Path) -> None:
    """Compile sources, each with what is beside it, by gcc, and by clang where it is installed."""
    for number, (case, source) in enumerate(sources):
        place = folder / f"source{number}"
        place.mkdir()
        parts = source.amalgamated().sources
        for part in parts:
            (place / f"{part.prefix}.h").write_text(part.header)
            (place / f"{part.prefix}.c").write_text(part.code)
        for compiler in ("clang", "gcc") if which("clang") else ("gcc",):
            files = [f"{part.prefix}.c" for part in parts]
            run([needs(compiler), *STRICT, *flags_of(case), "-fno-pie", "-c", *files], place)
        for part in parts if sys.platform == "linux" else ():
            check_symbols(part.prefix, source.prefix, place)


def check_symbols(name: str, prefix: str, folder: Path) -> None:
    symbols = [line.split() for line in run([needs("nm"), "-P", f"{name}.o"], folder).splitlines()]
    assert [name for name, kind, *_ in symbols if kind.isupper() and kind != "U" and not name.startswith(prefix)] == []
    assert [name for name, kind, *_ in symbols if kind in "DdBbCSsGg"] == []
    _, line = run([needs("size"), f"{name}.o"], folder).splitlines()
    assert line.split()[1:3] == ["0", "0"]  # data, bss


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.MethodWarning")
@pytest.mark.second
@pytest.mark.covering
@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("acts", SYSTEMS)
@pytest.mark.parametrize("form", FORMS)
def test_every_variant_compiles_without_warnings(steps: str, acts: str, form: str, tmp_path: Path) -> None:
    """A source with events is the one without, and a further one beside it."""
    sources = []
    for case in cases(steps, acts, form):
        if words := refusal(case):
            with pytest.raises(ScviCodegenError, match=words):
                case.source()
        elif source := case.source():
            sources.append((case, source))
    if form not in SEPARATE:
        assert len({(source.header, source.code) for _, source in sources}) <= 2  # in both kinds of time
    check(sources, tmp_path)
