"""C for microcontrollers: builds for ARM Cortex-M without a warning, runs under QEMU to the numbers of the host."""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from commands import output_of
from notation import lagrange
from programs import needs
from samples import sample_named, stepper_for
from strict_c import STRICT, run

import scvi_codegen as sc
from scvi_codegen.codegen.ir.arithmetic import FUNCTIONS
from scvi_codegen.codegen.rendering.kernels.printer import SINGLE
from scvi_codegen.codegen.rendering.program_source import EMBEDDED, Embedded
from scvi_codegen.codegen.rendering.source import Interface, Source
from scvi_codegen.methods.method import Method

HERE = Path(__file__).parent / "embedded"
CROSS, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
EXACT = (*STRICT, "-ffp-contract=off")
PURE_SINGLE = ("-Wdouble-promotion", "-Wfloat-conversion", "-Wunsuffixed-float-constants")
KINDS = {"double": np.float64, "single": np.float32}
H, STEPS = 0.0625, 50


@dataclass(frozen=True)
class Board:
    """A board that QEMU has, the flags for its processor, and the precision of its registers."""

    machine: str
    flags: tuple[str, ...]
    precision: Embedded


BOARDS = {
    "cortex-m3": Board("mps2-an385", ("-mcpu=cortex-m3",), "double"),
    "cortex-m4": Board("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"), "single"),
    "cortex-m7": Board("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard"), "double"),
}
"""Double precision in software, single precision in hardware, double precision in hardware."""

CASES: dict[str, tuple[str, Method]] = {
    "kepler": ("kepler", sc.SVI(4)),
    "verlet": ("kepler", sc.StoermerVerlet()),
    "pendulum": ("double-pendulum", sc.SVI(3)),
    "shooting": ("planar-pendulum", sc.SCVI(3)),
    "driven": ("driven-duffing", sc.SVI(2)),
}
ON_HOST: dict[str, tuple[str, Method]] = CASES | {
    "relativity": ("relativistic-particle", sc.Gauss(3)),
    "cart": ("cart-pole", sc.SVI(2)),
    "friction": ("damped-pair", sc.SVI(3)),
    "bodies": ("three-bodies", sc.SVI(4)),
}


@cache
def embedded(case: str, precision: Embedded) -> tuple[Source, Interface]:
    name, method = ON_HOST[case]
    return sc.generate_source(sample_named(name).system, method, prefix="integrator", embedded=precision)


@cache
def start(case: str) -> tuple[np.ndarray, np.ndarray]:
    """(q, p) of a case, in numbers that single precision holds."""
    q, p = sample_named(ON_HOST[case][0]).state
    return np.float32(q).astype(float), np.float32(p).astype(float)


def write_case(case: str, precision: Embedded, folder: Path) -> list[str]:
    """The integrator, its start and a program that prints its states; the C files."""
    source, interface = embedded(case, precision)
    q, p = start(case)
    arrays = {"q0": q, "p0": p, "parameters": interface.defaults or (0.0,)}
    kind, suffix = ("float", "f") if precision == "single" else ("double", "")
    lines = [f"#define REAL {kind}", f"#define H {H!r}{suffix}", f"#define STEPS {STEPS}"]
    for name, values in arrays.items():
        lines.append(f"static const {kind} {name}[] = {{{', '.join(f'{float(x)!r}{suffix}' for x in values)}}};")
    (folder / "start.h").write_text("\n".join(lines) + "\n")
    (folder / "integrator.h").write_text(source.header)
    (folder / "integrator.c").write_text(source.code)
    return ["integrator.c", str(HERE / "states.c"), str(HERE / "board.c")]


def states(output: str, precision: Embedded) -> tuple[np.ndarray, np.ndarray]:
    """(steps,) iterations and (steps, 2m) states from the bits printed."""
    rows = [line.split() for line in output.splitlines()]
    assert len(rows) == STEPS
    assert {int(row[0], 16) for row in rows} == {0}
    numbers = [[int(word, 16) for word in row[2:]] for row in rows]
    whole = np.uint32 if precision == "single" else np.uint64
    return np.array([int(row[1], 16) for row in rows]), np.array(numbers, whole).view(KINDS[precision])


def on_host(case: str, precision: Embedded, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    needs("gcc")
    files = write_case(case, precision, folder)
    run(["gcc", "-O2", *EXACT, f"-I{HERE}", "-I.", *files, "-lm", "-o", "host"], folder)
    return states(run(["./host"], folder), precision)


def on_board(case: str, board: Board, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    needs(CROSS, QEMU, "arm-none-eabi-nm", "arm-none-eabi-size")
    files = write_case(case, board.precision, folder)
    pure = PURE_SINGLE if board.precision == "single" else ()
    common = [CROSS, "-mthumb", *board.flags, "-O2", *EXACT, "-ffreestanding", f"-I{HERE}", "-I."]
    run([*common, *pure, "-Wvla", "-Wstack-usage=512", "-c", "integrator.c"], folder)
    check_needs(folder)
    linked = ["-nostartfiles", "--specs=nosys.specs", f"-T{HERE / 'mps2.ld'}", "-Wl,--gc-sections"]
    run([*common, "-Wno-pedantic", *linked, "integrator.o", *files[1:], "-lm", "-o", "board.elf"], folder)
    machine = ["-M", board.machine, "-display", "none", "-monitor", "none", "-serial", "none"]
    hosted = ["-chardev", "stdio,id=text", "-semihosting-config", "enable=on,target=native,chardev=text"]
    return states(run([QEMU, *machine, *hosted, "-kernel", "board.elf"], folder), board.precision)


def check_needs(folder: Path) -> None:
    """The object needs the arithmetic of the compiler, libm and two functions that every compiler asks for, no more."""
    needs = set(run(["arm-none-eabi-nm", "-u", "integrator.o"], folder).split()) - {"U"}
    needs = {name.removesuffix("f") for name in needs if not name.startswith("__aeabi_")}
    assert needs <= {*FUNCTIONS.values(), "memcpy", "memset", "fabs", "sqrt"}
    text, data, bss, *_ = run(["arm-none-eabi-size", "integrator.o"], folder).splitlines()[1].split()
    assert (int(data), int(bss)) == (0, 0)
    assert int(text) < 32 * 1024


@pytest.mark.parametrize("name", BOARDS)
@pytest.mark.parametrize("case", CASES)
def test_board_and_host_give_equal_numbers(case, name, tmp_path):
    """Bit for bit where only arithmetic and square roots are used, else to the rounding of two libms."""
    board = BOARDS[name]
    iterations, found = on_board(case, board, tmp_path)
    host_iterations, expected = on_host(case, board.precision, tmp_path)
    if CASES[case][0] == "kepler":
        assert np.array_equal(found, expected)
        assert np.array_equal(iterations, host_iterations)
    unit = np.finfo(KINDS[board.precision]).eps
    np.testing.assert_allclose(found, expected, rtol=0, atol=300 * unit * np.abs(expected).max())


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", ON_HOST)
def test_double_precision_equals_the_compiled_stepper_and_single_is_close(case, tmp_path):
    """Every step in single precision is that in double from the same state to two of its rounding units."""
    name, method = ON_HOST[case]
    stepper = stepper_for(name, method)
    trajectory = stepper.integrate(*start(case), h=H, steps=STEPS)
    expected = np.hstack([trajectory.q, trajectory.p])[1:]
    size = np.abs(expected).max()
    _, double = on_host(case, "double", tmp_path)
    assert np.abs(double - expected).max() < 1e-12 * size
    _, single = on_host(case, "single", tmp_path)
    before = np.vstack([np.hstack(start(case)), single[:-1]]).astype(float)
    steps = [stepper.integrate(*np.split(y, 2), t=k * H, h=H, steps=1) for k, y in enumerate(before)]
    steps_in_double = np.array([np.hstack([step.q[-1], step.p[-1]]) for step in steps])
    assert np.abs(single - steps_in_double).max() < 2 * np.finfo(np.float32).eps * size
    assert np.abs(single - expected).max() < 1e-4 * size


def test_powers_in_single_precision_do_not_underflow_before_their_result(tmp_path):
    """x^(-3/2) of squared distances in metres: (1/x)^2 is 0 from 1e23 on, and bodies in SI units moved straight on."""
    source, _ = sc.generate_source(sc.problem("kepler").system, sc.SVI(1), prefix="body", embedded="single")
    body = source.code[source.code.index("inverse_root_3(") :].partition("{")[2].partition("}")[0]
    (tmp_path / "root.c").write_text(
        "#include <math.h>\n#include <stdio.h>\n#define BODY_MATH(f) sqrtf\ntypedef float body_real;\n"
        f"static float power(float x) {{{body}}}\n"
        'int main(void) { for (float x = 1e-20f; x < 1e24f; x *= 10.f) printf("%.9g %.9g\\n", x, power(x)); }\n'
    )
    run(["cc", "root.c", "-lm", "-o", "root"], tmp_path)
    x, found = np.array([line.split() for line in run(["./root"], tmp_path).splitlines()], float).T
    np.testing.assert_allclose(found, x**-1.5, rtol=3e-7)


# A bound for the time of a step.


COUNTING = """
#include <stdio.h>
#include "integrator.h"
int main(void)
{
  static double workspace[INTEGRATOR_WORKSPACE];
  const integrator_options patient = {1e-300, 1000000, 1};
  const double mu = 1.0, q0[2] = {1.0, 0.0}, p0[2] = {0.0, 1.0};
  double q[2], p[2];
  integrator_report report;
  const int status = integrator_step(0.0, 0.5, q0, p0, &mu, &patient, q, p, &report, workspace);
  printf("%d %lld", status, report.iterations);
  return 0;
}
"""


@pytest.mark.parametrize("bound", [1, 3, 8])
def test_iteration_limit_is_fixed_at_compile_time(bound, tmp_path):
    needs("gcc")
    write_case("kepler", "double", tmp_path)
    (tmp_path / "count.c").write_text(COUNTING)
    define = f"-DINTEGRATOR_MAX_ITERATIONS={bound}"
    run(["gcc", *EXACT, define, "integrator.c", "count.c", "-lm", "-o", "count"], tmp_path)
    assert run(["./count"], tmp_path).split() == ["1", str(bound)]


# Single precision.


@pytest.mark.parametrize(
    "value", [*np.float32([0.1, 1 / 3, np.pi, 2.0**-126, 3.4028234e38, 1 + 2.0**-23]).tolist(), 0.0]
)
def test_literals_read_back_as_the_nearest_double(value):
    text = SINGLE.number(value)
    assert text.endswith("f")
    assert np.float32(text[:-1]) == np.float32(value)


def test_residual_zeros_in_tables_become_zero_and_model_numbers_are_rejected():
    assert SINGLE.number(1.7e-63) == "0.0f"
    for value, remedy in ((1e-39, "units, write 0 for it"), (1e39, "units, or 'double'"), (-1e300, "")):
        with pytest.raises(sc.MethodError, match=f"the initial q = .*outside the range of single precision.*{remedy}"):
            SINGLE.check([1.0, value], ["t =", "the initial q ="])


@pytest.mark.parametrize("number", ["1e-45", "1e40"])
def test_models_with_numbers_beyond_single_precision_are_rejected(number):
    """Numbers are constants of the Lagrangian or values of parameters."""
    text = "q_dot**2/2 - {}*q**2/2"
    for system in (lagrange("s", "q", text.format(number)), lagrange("s", "q", text.format("k"), k=float(number))):
        sc.generate_source(system, sc.SVI(1), embedded="double")
        with pytest.raises(sc.MethodError, match="other units"):
            sc.generate_source(system, sc.SVI(1), embedded="single")


@pytest.mark.rotated
def test_a_top_falls_from_rest_in_single_precision(tmp_path):
    """The Jacobian of its turn has abs(v)^-3 of v = 0, half of the angle."""
    system = '[system]\nname = "top"\ncoordinates = []\nlagrangian = "(omega_1**2+omega_2**2+omega_3**2/2)/2-R_33"'
    start = 'rotations = {R = "omega"}\n[initial.q]\nR = { euler = "xyz", angles = [0.5, 0.2, 0] }\n[initial.q_dot]'
    (tmp_path / "top.toml").write_text(f"{system}\n{start}\nomega = [0.0, 0.0, 0.0]\n[run]\nstep = 0.01\nspan = 1.0\n")
    for precision in EMBEDDED:
        output_of("generate", tmp_path / "top.toml", "--embedded", precision, "-o", tmp_path / precision)
    last = [run(["make", "-s", "-C", x, "run"], tmp_path).splitlines()[-1].split()[1:9] for x in EMBEDDED]
    assert np.abs(np.subtract(*np.array(last, dtype=float))).max() < 1e-6


# What the user meets.


FOLDER = ("main.c", "Makefile", "README.md", "interface.json", "model.toml")


@pytest.mark.rotated
def test_the_command_line_writes_a_folder_without_python(tmp_path):
    needs("gcc")
    outputs = {}
    for precision in EMBEDDED:
        folder = tmp_path / f"kepler_{precision}"
        assert "import" not in output_of("generate", "kepler", "--embedded", precision, "-o", folder)
        names = {f"{folder.name}.c", f"{folder.name}.h", *FOLDER}
        assert {path.name for path in folder.iterdir()} == names
        kind = "float" if precision == "single" else "double"
        assert f"static {kind} workspace" in (folder / "README.md").read_text()
        lines = run(["make", "-s", "-C", str(folder), "run"], tmp_path).splitlines()[1:]
        outputs[precision] = np.array([line.split() for line in lines], dtype=float)
        with pytest.raises(sc.PackageError, match="without --embedded"):
            sc.load_package(folder)
    assert 0.0 < np.abs(outputs["single"] - outputs["double"]).max() < 1e-2


EVENTS_MAIN = """
#include "hit_events.h"
#include <stdio.h>
int main(void)
{
  static double t[64], q[64], p[64], length[64], workspace[HIT_WORKSPACE];
  static int iterations[64];
  static long long number[64];
  static hit_crossing found[32];
  const double parameters[] = {1.0}, q0[] = {1.0}, p0[] = {0.0};
  long long filled;
  hit_watch watch = {.direction = {-1}, .acts = {1}};
  hit_report report;
  hit_run run;
  hit_start(&run, 0.0, 0.1, q0, p0);
  while (run.t < 8.0) {
    if (hit_advance_with_changes(&run, &watch, 8.0, NULL, 16, parameters, NULL, 64, t, q, p, length, iterations, number,
            32, found, &filled, &report, workspace))
      return 1;
    for (int k = 0; k < filled; k++)
      printf("%.17g %.17g\\n", found[k].t, found[k].p[0]);
  }
  return 0;
}
"""


@pytest.mark.rotated
def test_impacts_without_allocation(tmp_path):
    """The bounces of a ball by C alone, which allocates no memory, equal those of Python."""
    needs("gcc")
    ball = lagrange("ball", "y", "y_dot**2/2 - g*y", g=1.0)
    source, _ = sc.generate_source(ball, sc.SVI(2), prefix="hit", events=sc.impact("y", 0.8), embedded="double")
    assert set(source.files) == {"hit.h", "hit.c", "hit_events.h", "hit_events.c"}
    source.write(tmp_path)
    (tmp_path / "main.c").write_text(EVENTS_MAIN)
    run(["gcc", *EXACT, "-O1", "hit.c", "hit_events.c", "main.c", "-o", "hit", "-lm"], tmp_path)
    code = "".join(text for name, text in source.files.items() if name.endswith(".c"))
    assert not re.search(r"\b[mc]alloc\b|\balloca\b", code)
    printed = run(["./hit"], tmp_path)
    found = np.array([line.split() for line in printed.splitlines()], dtype=float)
    trajectory = sc.compile_stepper(ball, sc.SVI(2)).integrate(
        [1.0], [0.0], h=0.1, t_end=8.0, events=sc.impact("y", 0.8)
    )
    assert len(found) == len(trajectory.events[0]) == 4
    assert np.abs(found[:, 0] - trajectory.events[0].t).max() < 1e-13
    assert np.abs(found[:, 1] - trajectory.events[0].p[:, 0]).max() < 1e-13
    with pytest.raises(sc.MethodError, match="events require double precision"):
        sc.generate_source(ball, sc.SVI(2), events=sc.impact("y"), embedded="single")
