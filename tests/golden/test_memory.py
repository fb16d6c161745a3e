"""Memory of generated C: every array has exactly the documented length, and the sanitizers report no error."""

import os
import re
import subprocess
from functools import partial
from pathlib import Path

import pytest
from golden_cells import CELLS, PENDULUM, of_source, program
from programs import needs

SANITIZED = ("gcc", "-std=gnu99", "-O0", "-g", "-w", "-DSCVI_THREADS", "-pthread", "-fsanitize=address,undefined")
QUICK = (
    *("swings", "forms_adaptive", "ring_newton"),
    *("body", "kepler_fallback", "kepler_many", "rods_newton", "vibration_adaptive", "double_tangent", "kepler_second"),
)
"""Arrays: constraints, several sizes, the Fourier preconditioner. Named coordinates: single steps and runs by both
solvers, ensembles, constraints, adaptive steps of a Hamiltonian, first and second derivatives, a body."""

FEW_UNKNOWNS = {"unrolled": partial(PENDULUM, method="svi:1", solver="newton", steps=50)}
"""Newton's iteration with few unknowns, whose equations are written without loops over tables; no golden results."""


def with_exact_arrays(main: str, *, hamiltonian: bool) -> str:
    """Return the program with an allocation of its own for every array of a run that need not follow another one."""
    if named := re.search(r"static double work\[(\w+)\],", main):  # named coordinates
        main = main.replace(named[0], "static double *work,")
        return main.replace("arguments)\n{\n", f"arguments)\n{{\n  work = calloc({named[1]}, 8);\n").replace(
            "main(void)\n{\n", f"main(void)\n{{\n  work = calloc({named[1]}, 8);\n"
        )
    work = re.search(r"run\.q = x \+ (\w+) \* n,", main)
    if work is None:
        return main
    names = ("q", "p", "carry_q", "carry_p")
    states = " ".join(f"run.{name} = calloc(n, 8);" for name in names)
    if hamiltonian:  # the header documents that momenta follow positions in memory
        states = " ".join(
            f"run.{q} = calloc(2 * n, 8); run.{p} = run.{q} + n;" for q, p in zip(names[::2], names[1::2], strict=True)
        )
    for pattern, new in (
        (r"double \*x = .*;", f"double *x;\n  posix_memalign((void **)&x, 64, sizeof(double) * {work[1]} * n);"),
        (r"memset\(x, 0, .*;", f"memset(x, 0, sizeof(double) * {work[1]} * n);"),
        (r"run\.q = x .*;", states),
        (r"run\.inverse_mass = .*;", "run.inverse_mass = calloc(n, 8);"),
    ):
        main, count = re.subn(pattern, new, main)
        assert count == 1, pattern
    return main


@pytest.mark.sampled(5)
@pytest.mark.parametrize(
    "name", [*FEW_UNKNOWNS, *(name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in CELLS)]
)
def test_runs_read_and_write_only_their_own_memory(name: str, tmp_path: Path) -> None:
    needs(SANITIZED[0])
    made = of_source(*FEW_UNKNOWNS[name](name)) if name in FEW_UNKNOWNS else program(name)
    for path, text in (
        made.files | {"main.c": with_exact_arrays(made.main, hamiltonian=name.startswith("rotors"))}
    ).items():
        (tmp_path / path).write_text(text)
    command = [*SANITIZED, "-fno-sanitize-recover=all", f"{made.prefix}.c", "main.c", "-lm", "-o", "main"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    if built.returncode:
        pytest.skip(f"no sanitizers: {built.stderr[-200:]}")
    options = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run([str(tmp_path / "main")], capture_output=True, text=True, check=False, env=options)
    assert done.returncode == 0, done.stderr[:1000]
