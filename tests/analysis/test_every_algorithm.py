"""Certified integrators: one for every stepping algorithm, found by listing the support headers, and of fields."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import golden_cells
import numpy as np
import pytest
from certified_cases import CASES
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.codegen.ir.variants import Derivatives, Lanes
from scvi_codegen.codegen.lowering.arrays import one_coordinate
from scvi_codegen.codegen.pipeline import ArraySources, Sources
from scvi_codegen.codegen.rendering.preprocessor import preprocessed
from scvi_codegen.common.cache import template_folder
from scvi_codegen.extras.verification import Outcome
from scvi_codegen.systems.arrays.system import ArraySystem

FOLDER = template_folder() / "support"
HEADERS = {str(path.relative_to(FOLDER)) for path in FOLDER.glob("**/*.h")}
OTHERS = {
    **{header: "compared with 60 digits in test_double_double.py" for header in HEADERS if "double_double/" in header},
    "run/tangent_growth.h": "compared with derivatives of single steps in test_chaos_indicators.py",
    "iteration/linear_part.h": "compared with Pade's approximation of linear chains in test_linear_part.py",
    "run/event_times.h": "compared with exact times in test_events_of_time.py",
    **{
        f"run/contact{x}.h": "compared with closed forms in test_contacts.py"
        for x in ("s", "_rows", "_forces", "_modes")
    },
    **{f"run/contact_{x}.h": "compared with closed forms in test_contacts.py" for x in ("impacts", "slips")},
    **{f"run/{x}.h": "compared with exact covariances in test_bath.py" for x in ("bath", "bath_lanes", "bath_run")},
    "arrays/array_bath.h": "compared with exact covariances in test_arrays_in_bath.py",
    "run/normals.h": "compared with published words of Philox and with NumPy in test_normals.py",
    "core/directions.h": "compared with a mechanism without loops in test_equalities.py",
    "run/observation.h": "compared with the states of runs in test_observers.py",
    "frameworks/casadi_flow.h": "interface of CasADi to a compiled step",
    "frameworks/flow.h": "interface of JAX and PyTorch to a compiled step",
    "frameworks/fmu.h": "interface of co-simulation",
    "frameworks/fmu_unsupported.h": "interface of co-simulation",
    "frameworks/xla_flow.h": "interface of XLA to a compiled step",
}
"""Headers that are not stepping algorithms, with the reason."""
ROBOTS = Path(__file__).parents[1] / "systems" / "robots"
AXIAL = "(A*(omega_1**2 + omega_2**2) + C*omega_3**2)/2"
GENERAL = "(A*omega_1**2 + B*omega_2**2 + C*omega_3**2)/2"
WAVE = 0.4 * np.cos(0.3 + np.arange(8.0))
ARRAYS = {"q": WAVE, "velocity": 0.2 * WAVE[::-1], "h": 0.02}
System = tuple[Callable[[], Any], Any, dict[str, Any], dict[str, Any]]
"""System, method, arguments of verify, options of the compiler."""
PAIR = "sum(i < j in near, (q[i] - q[j])**2)"


def body(lagrangian: str, *coordinates: str) -> Any:
    """A rigid body, beside other coordinates."""
    moments = {"A": 1.0, "B": 1.5, "C": 0.5}
    return sc.LagrangianSystem.from_text(
        "body",
        coordinates,
        lagrangian,
        rotations={"R": "omega"},
        parameters={x: moments[x] for x in moments if x in lagrangian},
    )


def lattice(potential: str, **arguments: Any) -> Any:
    """Unit masses with a potential."""
    return sc.LagrangianSystem.from_text("lattice", ["q[N]"], f"sum(i in N, q_dot[i]**2/2) - {potential}", **arguments)


SCHROEDINGER = "(a_x**2 + b_x**2)/4 - (a**2 + b**2)**2/4"


def mesh(method: str, options: dict[str, Any], **arguments: Any) -> Any:
    """A field on a mesh, periodic by default; state and step size are those that verify chooses."""
    given = {"boundary": {"x": "periodic"}} | arguments
    return sc.FieldSystem.from_text("field", ["a"], {"x": (0, 6)}, **given).discretise(method, **options).system


def of_case(name: str) -> System:
    """One of the integrators that ``test_certificate.py`` damages."""
    case = CASES[name]
    options = {"time_transformation": case.time_transformation} if case.time_transformation else {}
    return (
        lambda: case.system,
        case.method(),
        {"q": case.q, "p": case.p, "h": case.h, "tolerance": case.tolerance},
        options,
    )


SYSTEMS: dict[str, System] = {
    "moving frame": (lambda: body(f"{AXIAL} - R_33*(1 + sin(t)/3)"), "svi:2", {}, {}),
    "axis of symmetry": (lambda: body(f"{AXIAL} - R_33 + x_dot**2/2 - x**2/2 + x*R_33/5", "x"), "svi:2", {}, {}),
    "three moments": (lambda: body(f"{GENERAL} - R_33"), "svi:2", {}, {}),
    "free rotation": (lambda: body(f"{GENERAL} - R_33"), "composition:4", {}, {}),
    "free rotation, axis": (lambda: body(f"{AXIAL} - R_33"), "stoermer-verlet", {}, {}),
    "first order": (
        lambda: sc.LagrangianSystem.from_text("drift", ["x", "y"], "x**3*y_dot - x**2 - y**2 - x**4"),
        "svi:2",
        {"q": [0.3], "p": [0.8], "h": 0.02},
        {},
    ),
    "robot": (lambda: sc.LagrangianSystem.from_urdf(ROBOTS / "arm.urdf"), "svi:2", {}, {}),
    "impacts": (
        lambda: sc.LagrangianSystem.from_text("ball", ["x"], "x_dot**2/2 - x"),
        "svi:2",
        {"q": [1.0], "p": [0.1], "h": 0.05},
        {"events": [sc.impact("x - sin(t)/9", restitution=0.95)]},
    ),
    "damped bead": (
        lambda: sc.LagrangianSystem.from_text(
            "bead",
            ["r", "a"],
            "(r_dot**2 + r**2*a_dot**2)/2 - r*sin(a)",
            constraints=["r*(1 + 0.3*cos(a)) = 1"],
            damping="0.1",
        ),
        "svi:3",
        {"q": [1.0, np.pi / 2], "p": [0.15, 0.5], "h": 0.05},
        {},
    ),
    "lattice": (lambda: lattice("sum(i in N periodic, (q[i+1] - q[i])**4)"), "svi:2", ARRAYS, {}),
    "lattice, Newton": (golden_cells.ring, "svi:2", ARRAYS, {"solver": "newton"}),
    "lattice, explicit": (lambda: lattice("sum(i in N, q[i]**4)"), "composition:4", ARRAYS, {}),
    "lattice, Hamiltonian": (golden_cells.rotors, "svi:2", {"q": WAVE, "p": 0.2 * WAVE, "h": 0.02}, {}),
    "lattice, constraints": (
        golden_cells.swings,
        "stoermer-verlet",
        {"q": np.tile([0.6, 1.2], (3, 1)), "velocity": np.zeros((3, 2)), "h": 0.02},
        {},
    ),
    "convolution": (
        lambda: lattice("sum(i < j in N, c[j-i]*(q[i] - q[j])**2)", parameters={"c[N]": 1.0}),
        "svi:1",
        {**ARRAYS, "parameters": {"c": np.arange(8.0) / 9}},
        {},
    ),
    "convolution of coordinates": (
        lambda: lattice("sum(i in N, sum(j in N, c[j-i]*q[j])**2)", parameters={"c[N]": 1.0}),
        "svi:2",
        {**ARRAYS, "parameters": {"c": np.sin(np.arange(8.0)) / 3}},
        {},
    ),
    "neighbours": (lambda: lattice(PAIR, neighbours={"near": {"of": "q", "cutoff": 0.5}}), "svi:1", ARRAYS, {}),
    **{
        name: of_case(name)
        for name in (
            *("kepler/svi-3", "kepler/svi-3, controlled", "kepler/svi-3, reversible", "slowed/svi-3", "double/svi"),
            *("double/scvi", "double/sc", "linkage/lobatto-svi", "rods/rattle", "damped/svi", "pushed/svi"),
            *("swing/gauss", "field/gauss"),
        )
    },
}
"""Systems whose code contains every stepping algorithm."""
MESHES: dict[str, System] = {
    "field of pairs": (
        lambda: mesh("finite-differences", {"order": 2, "points": 6}, momenta=["b"], hamiltonian=SCHROEDINGER),
        "svi:1",
        {},
        {},
    ),
    "field by transforms": (
        lambda: mesh("fourier", {"points": 6, "derivative": "fft"}, density="a_t**2/2 - a_x**2/2 + cos(a)"),
        "svi:1",
        {},
        {},
    ),
    "field with a driven end": (
        lambda: mesh(
            "spectral-elements",
            {"degree": 2, "elements": 4},
            density="a_t**2/2 - a_x**2/2",
            boundary={"x": ("sin(t)", "natural")},
        ),
        "svi:1",
        {},
        {},
    ),
}
CERTIFIED = SYSTEMS | {name: of_case(name) for name in CASES} | MESHES


def headers_of(name: str) -> Iterator[str]:
    """Support headers of the sources that the certificate of a system tests."""
    make, method, _, options = SYSTEMS[name]
    system = make()
    sources = []
    if "events" in options:
        sources += sc.compile_stepper(system, method, flags=QUICK_FLAGS, **options).source.sources
    else:
        of_arrays = isinstance(system, ArraySystem)
        chosen = sc.as_method(method, one_coordinate(system) if of_arrays else system)
        kind_of_sources = ArraySources if of_arrays else Sources
        made = kind_of_sources(system, chosen, options.get("solver", "auto"), g=options.get("time_transformation"))
        sources.append(made.integrator()[0])
        for kind in (Lanes(), Derivatives(), *([Derivatives(order=2)] if name == "kepler/svi-3" else [])):
            with suppress(sc.MethodError):
                sources.append(made.variant(kind))
    for source in filter(None, sources):
        texts, used = dict(source.support), list[str]()
        preprocessed(source.code, lambda name, texts=texts, used=used: used.append(name) or texts[name])
        yield from (header.removeprefix("support/") for header in used)


@pytest.mark.rotated
def test_every_stepping_algorithm_is_verified() -> None:
    """Those that one of the systems of this file includes; the list of others cannot grow unnoticed."""
    covered = {header for name in SYSTEMS for header in headers_of(name)}
    assert HEADERS - covered == set(OTHERS)


@pytest.mark.rotated
@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", CERTIFIED)
def test_certificates_are_satisfied(name: str) -> None:
    make, method, start, options = CERTIFIED[name]
    system = make()
    stepper = sc.compile_stepper(system, method, flags=QUICK_FLAGS, **options)
    certificate = sc.verify(system, method, stepper=stepper, **start)
    assert certificate.passed, certificate.to_text()
    satisfied = {check.name for check in certificate.checks if check.outcome is Outcome.SATISFIED}
    assert satisfied & {"stage equations", "unrolled system"}
