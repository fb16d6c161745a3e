"""Support headers have guards and include what they need: each compiles alone after the generated part of a source.

The generated part consists of macros, sizes, tables and kernels, and requires the types of ``core`` and a few others.
Where a source chooses one header among several, as the kind of iteration, users of the choice cannot include it.
"""

import re
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import golden_cells
import pytest
from programs import needs

from scvi_codegen import SVI, LagrangianSystem, SpectralCollocation, StoermerVerlet, generate_source, impact, problem
from scvi_codegen.codegen.pipeline import ArraySources, Sources
from scvi_codegen.codegen.rendering.environment import support_text
from scvi_codegen.codegen.rendering.preprocessor import specialised
from scvi_codegen.codegen.rendering.program_source import with_casadi_flow, with_flow_of_rows
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.codegen.variants import Derivatives
from scvi_codegen.common.cache import template_folder
from scvi_codegen.systems.arrays.system import ArraySystem

FOLDER = template_folder()
HEADERS = sorted(str(path.relative_to(FOLDER)) for path in FOLDER.glob("support/*/*.h"))
ELSEWHERE = {
    "support/double_double/functions.h": "tests/runs/test_double_double.py",
    "support/double_double/pairs.h": "tests/runs/test_double_double.py",
    "support/frameworks/fmu.h": "tests/interfaces/test_fmu.py",
    "support/frameworks/fmu_unsupported.h": "tests/interfaces/test_fmu.py",
    "support/frameworks/xla_flow.h": "tests/codegen/test_flow_text.py",
    "support/run/event_times.h": "tests/runs/test_events_of_time.py",
    "support/run/inputs.h": "tests/interfaces/test_package_inputs.py",
    "support/run/observation.h": "tests/runs/test_device.py",
    "support/run/tangent_growth.h": "tests/analysis/test_chaos_indicators.py",
    "support/run/thread_run.h": "tests/runs/test_device.py",
}
"""Headers that require libraries, a model, another header or a compiler for GPUs, and the tests that compile them."""
CELLS = (
    "kepler_monitor", "double_adaptive", "kepler_many", "double_tangent", "kepler_shooting", "kepler_composition",
    "vibration", "damped", "rods", "ring_adaptive", "ring_newton", "ring_composition", "rotors", "swings",
)  # fmt: skip
GENERATED = (
    r"core/|newton/stages|newton/band|arrays/(?:arrays|lattice_transform|circulant|convolutions)|derivatives/linear"
    r"|mechanics/damping|constraints/(?:rattle|point)|double_double/(?!mixed_|pair_)"
)
"""Headers with types that the generated part uses."""
CHOSEN = (
    r"iteration/\w*(?:_iteration|trajectory|trajectories|_solver|splitting)|newton/newton_solver"
    r"|newton/library_fallback|constraints/(?:coupled_)?rattle\.|arrays/array_hamiltonian_iteration|arrays/(?:newton_gmres|second_order_points)"
    r"|derivatives/(?:separable|coupled)_derivatives|step_size/(?:trials|density)"
)
"""Headers of which a source chooses one of several with the same functions."""
NEEDED = re.compile(rf'#include "support/(?:{GENERATED}|{CHOSEN}|\w+_predictor)')


def integrator(system, method) -> Source:
    kind = ArraySources if isinstance(system, ArraySystem) else Sources
    return kind(system, method).integrator()[0]


@cache
def sources() -> tuple[Source, ...]:
    """Sources that use every header but those tested elsewhere."""
    made = [source for source, _ in (golden_cells.CELLS[name](name) for name in CELLS) if source]
    kepler = Sources(problem("kepler").system, SVI(2))
    walls = [impact("q", where="t > 0")]
    oscillator = generate_source(problem("harmonic-oscillator").system, SVI(1), events=walls)[0]
    body = LagrangianSystem.from_text("body", rotations={"R": "w"}, lagrangian="w_1**2 + w_2**2 + 2*w_3**2")
    pair = "sum(i in N, q_dot[i]**2/2) - sum(i < j in near, (q[i] - q[j])**2)"
    ring = "sum(i in N, q_dot[i]**2/2) - sum(i < j in N, c[j-i]*(q[i] - q[j])**2)"
    sums = "sum(i in N, q_dot[i]**2/2) - sum(i in N, sum(j in N, c[j-i]*q[j])**2)"
    near = {"near": {"of": "q", "cutoff": 1.0}}
    robot = Path(__file__).parents[1] / "systems" / "robots" / "figure.xml"
    pairs = [
        (problem("double-pendulum").system, SpectralCollocation(3)),
        (body, SVI(3)),
        (body, StoermerVerlet()),
        (LagrangianSystem.from_text("ring", ["q[N]"], ring, parameters={"c[N]": 1.0}), SVI(1)),
        (LagrangianSystem.from_text("sums", ["q[N]"], sums, parameters={"c[N]": 1.0}), SVI(1)),
        (LagrangianSystem.from_text("pair", ["q[N]"], pair, neighbours=near), SVI(1)),
        (LagrangianSystem.from_mjcf(robot), SVI(2)),
        (problem("fput-chain:8").system, SVI(8)),
    ]
    made += [kepler.integrator()[0], *(integrator(system, method) for system, method in pairs)]
    drift = LagrangianSystem.from_text("drift", ["x", "y"], "x**3*y_dot - x**2 - y**2")
    made.append(Sources(drift, SVI(1)).variant(Derivatives()))
    made.append(with_casadi_flow(kepler.variant(Derivatives(order=2)), 10, 5, second=True))
    made.append(with_flow_of_rows(kepler.variant(Derivatives())))
    pendulum = problem("planar-pendulum").system
    for method in (SVI(2), StoermerVerlet()):
        made.append(Sources(pendulum, method, precision="double-double").integrator()[0])
    made.append(Sources(problem("double-pendulum").system, SVI(2), precision="double-double").integrator()[0])
    rod = LagrangianSystem.from_text("rod", ["x", "y"], "x_dot**2 + y_dot**2", constraints=["x**2 + y**2 - 1"])
    made.append(Sources(rod, SVI(2, "gauss-lobatto:3"), precision="double-double").integrator()[0])
    bead = LagrangianSystem.from_text(
        "bead", ["x", "y"], "x_dot**2 + (1 + x**2)*y_dot**2", constraints=["x**2 + y**2 - 1"]
    )
    made.append(Sources(bead, SVI(2, "gauss-lobatto:3")).integrator()[0])
    return (*made, *oscillator.sources)


@cache
def first_uses(source: Source) -> dict[str, int]:
    """The line of a source that includes a header first, by the header's name."""
    lines, found = source.code.split("\n"), dict[str, int]()
    for i, line in enumerate(lines):
        if line.startswith('#include "support/'):
            text = "\n".join(lines[: i + 1])
            for name, _ in specialised(text, dict(source.support).__getitem__):
                found.setdefault(name, i)
    return found


def alone(source: Source, header: str) -> str:
    """The generated part of a source before its first use of a header, and this header."""
    lines = source.code.split("\n")[: first_uses(source)[header]]
    needed = [line for line in lines if not line.startswith('#include "support/') or NEEDED.match(line)]
    open_conditions = sum(line.startswith("#if") - line.startswith("#endif") for line in needed)
    return "\n".join([*needed, f'#include "{header}"', *["#endif"] * open_conditions, ""])


def uncompiled(folder: Path, source: Source, headers: list[str]) -> dict[str, str]:
    """Return the errors of the headers that do not compile alone behind a source, by one call of the compiler."""
    folder.mkdir()
    for other in sources():
        (folder / f"{other.prefix}.h").write_text(other.header)
    source.write(folder)
    names = {f"alone_{Path(header).stem}.c": header for header in headers}
    for name, header in names.items():
        (folder / name).write_text(alone(source, header))
    command = [needs("cc"), "-std=c99", "-w", "-Werror=implicit-function-declaration", "-fsyntax-only", *names]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return {header: done.stderr for name, header in names.items() if done.returncode and name in done.stderr}


@pytest.mark.rotated
def test_every_header_compiles_alone(tmp_path):
    """Behind one of the first three sources that use it."""
    left = {header: "no source uses it" for header in HEADERS if header not in ELSEWHERE}
    for attempt in range(3):
        for number, source in enumerate(sources()):
            mine = [
                header
                for header in left
                if [other for other in sources() if header in first_uses(other)][attempt : attempt + 1] == [source]
            ]
            failed = uncompiled(tmp_path / f"{attempt}_{number}", source, mine) if mine else {}
            left = {header: error for header, error in left.items() if header not in mine} | failed
    assert left == {}


def test_headers_have_guards_of_their_own():
    guards = [re.match(r"#ifndef (SUPPORT_\w+_H)\n#define \1\n", support_text(name)) for name in HEADERS]
    assert len({guard and guard[1] for guard in guards} - {None}) == len(HEADERS)
    assert all(support_text(name).endswith("\n#endif\n") for name in HEADERS)


def test_header_without_an_integrator_names_what_is_missing(tmp_path):
    (tmp_path / "alone.c").write_text(f'#include "{FOLDER}/support/newton/newton.h"\n')
    command = [needs("cc"), "-std=c99", "-fsyntax-only", "alone.c"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "NAME is not defined" in done.stderr


@pytest.mark.rotated
@pytest.mark.parametrize("k", range(len(CELLS)), ids=CELLS)
def test_headers_of_one_integrator_lack_its_unused_alternatives(k):
    source = sources()[k]
    used = dict(specialised(source.code, dict(source.support).__getitem__))
    assert replace(source, support=tuple(used.items())).amalgamated().code == source.amalgamated().code
    assert used.keys() <= dict(source.support).keys()
    names = re.findall(r"\bdefined\((\w+)\)|^#ifn?def (\w+)", "".join(used.values()), re.MULTILINE)
    assert {a or b for a, b in names} & {"ARRAYS", "HAMILTONIAN_SYSTEM", "SINGLE_PRECISION", "DAMPED"} == set()
