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


def with_exact_arrays(main: str) -> str:
    """Return the program with an allocation of its own for every array of a run that need not follow another one."""
    if named := re.search(r"static double work\[(\w+)\],", main):  # named coordinates
        main = main.replace(named[0], "static double *work,")
        return main.replace("arguments)\n{\n", f"arguments)\n{{\n  work = calloc({named[1]}, 8);\n").replace(
            "main(void)\n{\n", f"main(void)\n{{\n  work = calloc({named[1]}, 8);\n"
        )
    return main.replace("    n = run->p - run->q;\n", f"    n = run->p - run->q;\n{EXACT}")


EXACT = """
    run->q = calloc(2 * n, 8), run->carry_q = calloc(2 * n, 8);
    run->p = run->q + n, run->carry_p = run->carry_q + n;
    long long last = run->inverse_mass - run->work;
    run->inverse_mass = calloc(n, 8);
    posix_memalign((void **)&run->work, 64, sizeof(double) * last);
"""
"""Arrays of a run in allocations of their own, so that each access outside of one is detected."""


def sanitizers_exist(folder: Path) -> bool:
    (folder / "empty.c").write_text("int main(void)\n{\n  return 0;\n}\n")
    return not subprocess.run([*SANITIZED, "empty.c", "-o", "empty"], cwd=folder, capture_output=True).returncode


@pytest.mark.rotated
@pytest.mark.sampled(5)
@pytest.mark.parametrize(
    "name", [*FEW_UNKNOWNS, *(name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in CELLS)]
)
def test_runs_read_and_write_only_their_own_memory(name: str, tmp_path: Path) -> None:
    needs(SANITIZED[0])
    made = of_source(*FEW_UNKNOWNS[name](name)) if name in FEW_UNKNOWNS else program(name)
    for path, text in (made.files | {"main.c": with_exact_arrays(made.main)}).items():
        (tmp_path / path).write_text(text)
    command = [*SANITIZED, "-fno-sanitize-recover=all", f"{made.prefix}.c", "main.c", "-lm", "-o", "main"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    if built.returncode and not sanitizers_exist(tmp_path):
        pytest.skip(f"no sanitizers: {built.stderr[-200:]}")
    assert built.returncode == 0, built.stderr[-1000:]
    options = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run([str(tmp_path / "main")], capture_output=True, text=True, check=False, env=options)
    assert done.returncode == 0, done.stderr[:1000]
