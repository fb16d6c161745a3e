"""The programs of the README of a generated folder: each kind of model is compiled as shown, and agrees with Python."""

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from programs import needs

import scvi_codegen as sc

STRICT = "-O0 -std=c99 -Wall -Wextra -Wconversion -Wpedantic -Wshadow -Wno-psabi -Werror"
SYSTEM = sc.LagrangianSystem.from_text
SPAN, H, STEPS = 1.5, 0.03, 50
INPUT = {"u": ([0.0, 0.37, 0.9, 2.0], [0.0, 1.2, -0.7, 0.4])}


def ball(**arguments: object) -> sc.LagrangianSystem:
    return SYSTEM("ball", ["y"], "m*y_dot**2/2 - m*g*y", parameters={"m": 0.7, "g": 9.8}, **arguments)


def spring(**arguments: object) -> sc.LagrangianSystem:
    return SYSTEM("spring", ["x"], "x_dot**2/2 - k*x**4/4", parameters={"k": 2.0}, **arguments)


def model_of(system: sc.LagrangianSystem, method: str, **further: object) -> sc.Model:
    return sc.Model(system=system, method=method, q=(1.0,), velocity=(0.5,), h=H, span=SPAN, **further)


KINDS: dict[str, Callable[[], sc.Model]] = {
    "smooth": lambda: model_of(spring(), "svi:2"),
    "explicit": lambda: model_of(spring(), "stoermer-verlet"),
    "contact": lambda: model_of(ball(contacts=[sc.contact("y - 0.4", restitution=0.5)]), "svi:3"),
    "kink": lambda: model_of(spring(forces={"x": "-3*abs(x)*sign(x)"}), "svi:3"),
    "impact": lambda: model_of(ball(), "svi:2", events=(sc.impact("y - 0.4", 0.8),)),
    "crossing": lambda: model_of(spring(), "svi:2", events=(sc.Event("x"),)),
    "bath": lambda: model_of(spring(temperature="k", damping="0.5"), "svi:2"),
    "inputs": lambda: model_of(spring(forces={"x": "u"}, inputs=["u"]), "svi:3", inputs=INPUT),
    "inputs and impact": lambda: model_of(
        ball(forces={"y": "u"}, inputs=["u"]), "svi:3", inputs=INPUT, events=(sc.impact("y - 0.4", 0.8),)
    ),
}


def programs(readme: str) -> list[str]:
    return re.findall(r"^```c\n(.*?)^```", readme, re.DOTALL | re.MULTILINE)


def main_of(program: str, model: sc.Model, stepper: sc.Stepper, p: np.ndarray) -> str:
    """Return a file with the variables of the README, its program, and a line that prints the end of it."""
    include, _, body = program.partition("\n")
    values = ", ".join(f"{value:.17g}" for value in stepper.defaults) or "0.0"
    end = "t + h, q1[0], p1[0]" if "_step(" in program else "run.t, run.q[0], run.p[0]"
    tables = ""
    if model.inputs and "inputs" in program:
        times, numbers = INPUT["u"]
        slopes = np.diff(numbers) / np.diff(times)
        rows = [(float(x), float(slope), 0.0, 0.0) for x, slope in zip(numbers, slopes, strict=False)]
        coefficients = ", ".join(repr(x) for row in rows for x in row)
        tables = (
            f"static const double breakpoints[] = {{{', '.join(map(repr, times))}}}, rows[] = {{{coefficients}}};\n"
            f"static {stepper.interface.prefix}_input inputs[] = {{{{breakpoints, rows, {len(rows)}, 0}}}};\n"
        )
    return (
        f"{include}\n#include <stdio.h>\n{tables}int main(void)\n{{\n"
        f"const double t = 0.0, h = {H}, q0[] = {{{model.q[0]!r}}}, p0[] = {{{float(p[0])!r}}};\n"
        f"const double t_end = {SPAN};\nconst long long steps = {STEPS};\nstatic double parameters[] = {{{values}}};\n"
        f"(void)t_end, (void)steps, (void)h;\n{body}"
        f'printf("%d %.17g %.17g %.17g\\n", status, {end});\nreturn 0;\n}}\n'
    )


@pytest.mark.rotated
@pytest.mark.sampled(3)
@pytest.mark.parametrize("embedded", [None, "double"])
@pytest.mark.parametrize("kind", KINDS)
def test_programs_of_the_readme_agree_with_python(kind: str, embedded: str | None, tmp_path: Path) -> None:
    model = KINDS[kind]()
    folder = sc.generate_package(model, tmp_path / "own_svi", embedded=embedded)
    stepper = sc.compile_stepper(model.system, model.method, events=model.events, prefix="own_svi")
    p = stepper.momentum(model.q, model.velocity)
    plan = {"inputs": INPUT} if model.inputs else {}
    plan |= {"seed": 1} if kind == "bath" else {}
    shown = programs((folder / "README.md").read_text())
    adaptive = kind not in ("bath", "explicit") and not embedded
    assert len(shown) == (not embedded and kind in ("smooth", "explicit", "crossing", "inputs")) + 1 + adaptive
    for number, program in enumerate(shown):
        (folder / "shown.c").write_text(main_of(program, model, stepper, p))
        sources = ["shown.c", "own_svi.c", *(["own_svi_events.c"] if (folder / "own_svi_events.c").exists() else [])]
        command = [needs("cc"), *STRICT.split(), *sources, "-lm", "-o", f"shown{number}"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), f"{done.stderr}\n{program}"
        printed = subprocess.run([folder / f"shown{number}"], capture_output=True, text=True, check=True).stdout
        status, *end = map(float, printed.split())
        assert status == 0
        if "_step(" in program:
            expected = [H, *np.ravel(stepper.step(model.q, p, H, parameters=np.array(stepper.defaults)))]
            tolerance = 1e-12
        else:
            by_steps = "control" not in program
            run = stepper.integrate(model.q, p, t_end=SPAN, **({"h": H} if by_steps else {"tolerance": 1e-9}), **plan)
            expected, tolerance = [run.t[-1], run.q[-1, 0], run.p[-1, 0]], 1e-11 if by_steps else 1e-8
        np.testing.assert_allclose(end, expected, rtol=0, atol=tolerance, err_msg=program)
