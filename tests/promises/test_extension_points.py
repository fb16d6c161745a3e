"""The seams: what the developers' page adds in a file and a line works, and blocks may be of any size."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from notation import lagrange

import scvi_codegen
from scvi_codegen import SVI, MethodError
from scvi_codegen.codegen.lowering.stage_groups import layout_of
from scvi_codegen.methods.discretise import discretise

pytestmark = pytest.mark.rotated

ROOT = Path(scvi_codegen.__file__).parents[1]
TEXT = "".join((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in ("extending", "extending_runs"))


# What the page adds.


def additions() -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return the code of the page by the file named above it: new files, and changes of files."""
    new, changes = (
        re.findall(rf"^`([\w/.]+)`\n\n```{kind}\n(.*?)^```$", TEXT, re.M | re.S) for kind in ("python", "diff")
    )
    return new, [(path, hunk) for path, change in changes for hunk in change.split("@@\n")]


def changed(text: str, change: str) -> str:
    """The text with the one place that a diff names changed."""
    lines = [(line[:1], line[1:]) for line in change.splitlines()]
    old, new = ("".join(f"{line}\n" for sign, line in lines if sign in saved) for saved in (" -", " +"))
    assert text.count(old) == 1, f"the page changes what is not there, or not once:\n{change}"
    return text.replace(old, new)


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with all that the page adds."""
    folder = tmp_path_factory.mktemp("extended")
    for name in ("scvi_codegen", "templates"):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    new, changes = additions()
    for path, text in new:
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text(text)
    for path, change in changes:
        (folder / path).write_text(changed((folder / path).read_text(), change))
    return folder


def run(folder: Path, script: str) -> str:
    """Return the output of a script that uses the modified copy."""
    own = f"import sys\nsys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in repr(f).lower()]\n{script}"
    own = own.replace("import sys\n", f"import sys\nsys.path.insert(0, {str(folder)!r})\n", 1)
    found = subprocess.run([sys.executable, "-c", own], capture_output=True, text=True, check=False, cwd=folder)
    assert found.returncode == 0, found.stderr
    return found.stdout


@pytest.mark.quick
def test_documented_additions_need_one_file_and_one_line() -> None:
    new, changes = additions()
    lines = [line for _, change in changes for line in change.splitlines() if line[:1] in "+-"]
    of_package = [path for path, _ in new if path.startswith("scvi_codegen/")]
    assert len(of_package) == len(new) == 10
    assert not any((ROOT / path).exists() for path, _ in new)
    assert all(line.startswith("+") for line in lines)
    assert sum("import" not in line for line in lines) == len(of_package) + 1, "an option is one entry"


def test_documented_method_is_the_midpoint_rule(extended: Path) -> None:
    script = """
import scvi_codegen, numpy as np
from scvi_codegen.methods import Gauss, method_from_specification
from scvi_codegen.interfaces.models.problems import problem
from scvi_codegen.codegen.pipeline import program_of
assert scvi_codegen.__file__.startswith(sys.path[0])
system, method = problem("kepler").system, method_from_specification({"method": "midpoint"})
own, gauss = (program_of(system, each, prefix="p") for each in (method, Gauss(1)))
same = own.equations.stage_groups == gauss.equations.stage_groups, own.fixed_point == gauss.fixed_point
print(*same, *(each.exact for each in own.quantities.momentum_maps))
"""
    assert run(extended, script).split() == ["True", "True", "True"]


def test_documented_statements_are_a_method_in_each_layout(extended: Path) -> None:
    """One text: a step in one and in two words, lanes equal to single runs, order and claims by the certificate."""
    script = """
import numpy as np
from scvi_codegen import LagrangianSystem, compile_stepper, verify
from scvi_codegen.methods import as_method
L = "3*x_dot**2/2 + y_dot**2 - (x - y)**2 - y**4/4 + x*sin(t)"
given, method = LagrangianSystem.from_text("springs", ["x", "y"], L), as_method("blanes-moan")
q, p, span = np.array([1.0, 0.3]), np.array([0.1, -0.4]), {"h": 0.125, "steps": 16, "t": 0.5}
exact = compile_stepper(given, "gauss:8").integrate(q, p, **span)
for precision in ("double", "double-double"):
    stepper = compile_stepper(given, method, precision=precision)
    one, many = stepper.integrate(q, p, **span), stepper.integrate_ensemble([q, 2*q], [p, -p], **span)
    other = stepper.integrate(2*q, -p, **span)
    print(np.array_equal(many.q[:, 0], one.q), np.array_equal(many.q[:, 1], other.q), len(stepper.step(q, p, 0.1)))
    print(abs(one.q[-1] - exact.q[-1]).max() < 2e-6)
halved = stepper.integrate(q, p, h=0.0625, steps=32, t=0.5)
print(12 < abs(one.q[-1] - exact.q[-1]).max() / abs(halved.q[-1] - exact.q[-1]).max() < 20)
small = LagrangianSystem.from_text("pendulum", ["x"], "x_dot**2/2 + cos(x)")
certificate = verify(small, method)
print(certificate.passed, sorted({check.name for check in certificate.checks} & {"order", "symplecticity", "reversal"}))
"""
    lines = run(extended, script).splitlines()
    assert lines == ["True True 2", "True"] * 2 + ["True", "True ['order', 'reversal', 'symplecticity']"]


def test_documented_solver_agrees_with_newton(extended: Path) -> None:
    script = """
import numpy as np
from scvi_codegen import SCVI, compile_stepper
from scvi_codegen.codegen.pipeline import program_of
from scvi_codegen.interfaces.models.problems import problem
given = problem("kepler")
method = SCVI(4, abscissae="gauss")
print(*(program_of(given.system, each).fixed_point.name for each in (method, SCVI(4))))
ends = []
for solver in ("fixed-point", "newton"):
    run = compile_stepper(given.system, method, solver=solver).integrate([1.0, 0.0], [0.0, 1.1], h=0.1, steps=50)
    ends.append(np.array([*run.q[-1], *run.p[-1]]))
print(abs(ends[0] - ends[1]).max() < 1e-13)
"""
    assert run(extended, script).split() == ["separable", "shooting", "True"]


def test_documented_quadrature_has_its_order_in_a_method(extended: Path) -> None:
    script = """
from scvi_codegen import SVI, compile_stepper
from scvi_codegen.interfaces.models.problems import problem
given = problem("planar-pendulum")
rule = SVI(4, "newton-cotes:7").quadrature
print([round(float(w) * 140 / 2 * 6) for w in rule.weights])
exact = compile_stepper(given.system, "gauss:8").step([0.5], [0.1], 0.8)[0]
stepper = compile_stepper(given.system, SVI(4, "newton-cotes:7"))
errors = []
for n in (1, 2):
    run = stepper.integrate([0.5], [0.1], h=0.8 / n, steps=n)
    errors.append(abs(run.q[-1] - exact).max())
print(6.5 < __import__("math").log2(errors[0] / errors[1]) < 9.5)
"""
    weights, order = run(extended, script).splitlines()
    assert weights == "[41, 216, 27, 272, 27, 216, 41]"  # Abramowitz & Stegun 25.4.17, 6 h / 840
    assert order == "True"


def test_documented_option_is_in_models_files_commands_and_json(extended: Path) -> None:
    script = """
import json
from click.testing import CliRunner
from scvi_codegen import ModelFileError
from scvi_codegen.interfaces.cli import main
from scvi_codegen.interfaces.models.model_files.model_file import catalogue_model, dump_model, parse_model
model = parse_model(dump_model(catalogue_model("kepler", {"run": {"absolute": True, "step": 0.1, "steps": 5}})))
print(model.absolute, model.solver_options.absolute, "absolute = true" in dump_model(model))
words = ["run", "kepler", "--step", "0.1", "--steps", "5", "--json"]
for flags in ([], ["--absolute"]):
    print(json.loads(CliRunner().invoke(main, [*words, *flags]).stdout)["run"].get("absolute"))
try:
    catalogue_model("kepler", {"run": {"absolute": 1}})
except ModelFileError as error:
    print(error)
"""
    first, *others = run(extended, script).splitlines()
    assert first.split() == ["True"] * 3
    assert others == ["None", "True", "[run] absolute must be true or false, not 1"]


def test_documented_controller_determines_adaptive_steps(extended: Path) -> None:
    """It is as accurate as the default one, in steps of its own; arrays, models and checkpoints have it as well."""
    script = """
import numpy as np
from click.testing import CliRunner
from scvi_codegen import LagrangianSystem, compile_stepper
from scvi_codegen.interfaces.cli import main
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.interfaces.models.problems import problem
given, own = problem("kepler"), "elementary"
q, p, T = [0.1, 0.0], [0.0, np.sqrt(19.0)], 2 * np.pi
by = {name: compile_stepper(given.system, "svi:6", controller=name) for name in (None, "predictive", own)}
runs = {name: stepper.integrate(q, p, t_end=T, tolerance=1e-12) for name, stepper in by.items()}
print(np.array_equal(runs[None].t, runs["predictive"].t), not np.array_equal(runs[own].t, runs[None].t))
print(abs(runs[own].q[-1] - q).max() < 1e-8, runs[own].rejected_steps > runs[None].rejected_steps)
run = by[own].start(q, p, t_end=T, tolerance=1e-12)
run.advance(runs[own].steps // 2)
run = by[own].from_checkpoint(run.checkpoint(), t_end=T, tolerance=1e-12)
run.advance(10**6)
print(np.array_equal(run.q, runs[own].q[-1]))
sums = "sum(i in N, q_dot[i]**2/2) - sum(i in 0..N-2, exp(9*(q[i+1] - q[i])))"
chain = LagrangianSystem.from_text("chain", ["q[N]"], sums)
ends = []
for sizes in (None, {"N": 4}):
    for name in (None, own):
        stepper = compile_stepper(chain, "svi:6", controller=name, sizes=sizes)
        start = {"q": {"q": [0.3, 0.1, -0.2, 0.5]}, "velocity": {"q": [0.0] * 4}}
        ends.append(stepper.integrate(**start, t_end=3.0, tolerance=1e-9))
print(len(ends[0].t) != len(ends[1].t), np.abs(ends[1].q[-1] - ends[3].q[-1]).max() < 1e-6)
model = parse_model(f"[system]\\ncatalogue = 'kepler'\\n[run]\\ncontroller = '{own}'\\nspan = 2.0\\ntolerance = 1e-9")
again = parse_model(dump_model(model))
print(again.controller, model.integrate().steps == again.integrate().steps)
shown = CliRunner().invoke(main, ["run", "kepler", "--controller", own, "--tolerance", "1e-9", "--span", "2"])
print(shown.exit_code, f"{model.integrate().steps} steps of adaptive size" in shown.output)
"""
    lines = run(extended, script).splitlines()
    assert lines == ["True True", "True True", "True", "True True", "elementary True", "0 True"]


def test_documented_constraint_prescribes_rates(extended: Path) -> None:
    """A winch agrees with the pendulum of known length, read in each way, as do rods of their initial lengths."""
    script = """
import numpy as np, sympy
from scvi_codegen import LagrangianSystem, SystemDefinitionError, compile_stepper
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
L, coordinates, rope = "(x_dot**2 + y_dot**2)/2 - 9.81*y", ["x", "y"], "sqrt(x**2 + y**2)"
def error(system, **winch):
    run = compile_stepper(system, "svi:6").integrate([1.0, 0.0], velocity=[0.2, 0.0], h=0.01, steps=100, **winch)
    return np.abs(run.q[-1] - expected).max()
polar = LagrangianSystem.from_text("polar", ["a"], "(1 + t/5)**2*a_dot**2/2 + 9.81*(1 + t/5)*cos(a)")
a = compile_stepper(polar, "svi:8").integrate([np.pi/2], velocity=[0.0], h=0.01, steps=100).q[-1, 0]
expected = 1.2*np.array([np.sin(a), -np.cos(a)])
text = LagrangianSystem.from_text("winch", coordinates, L, constraints=[f"rate({rope}) = u"], inputs=["u"])
x, y, v, w = sympy.symbols("x y x_dot y_dot")
equation = sympy.Eq(sympy.Function("rate")(sympy.sqrt(x**2 + y**2)), sympy.Rational(1, 5))
symbols = LagrangianSystem.from_sympy(
    name="winch", coordinates=[x, y], lagrangian=(v**2 + w**2)/2 - 9.81*y, constraints=[equation])
document = f"[system]\\nname = 'winch'\\ncoordinates = ['x', 'y']\\nlagrangian = '{L}'"
document += f"\\nconstraints = ['rate({rope}) = 0.2']"
document += "\\n[initial]\\nq = [1.0, 0.0]\\nq_dot = [0.2, 0.0]\\n[run]\\nstep = 0.01\\nsteps = 10"
read = parse_model(document)
again = parse_model(dump_model(read)).system
print(*(each < 1e-9 for each in (error(text, inputs={"u": 0.2}), error(symbols), error(read.system), error(again))))
rod = LagrangianSystem.from_text("rod", coordinates, L, constraints=["rate(x**2 + y**2)"])
print(text.changes_energy, "|", rod.changes_energy)
chain, rods = "sum(i in N, q_dot[i]**2/2 + s_dot[i]**2/2 - 9.81*s[i])", "(q[i+1] - q[i])**2 + (s[i+1] - s[i])**2"
arrays = [
    LagrangianSystem.from_text("chain", ["q[N]", "s[N]"], chain, constraints=[c + " for i in 0..N-2"])
    for c in (f"rate({rods})", f"{rods} = 1")]
start = {"q": {"q": [0.0, 1.0, 2.0], "s": [0.0] * 3}, "velocity": {"q": [0.0] * 3, "s": [0.0, 1.0, 0.0]}}
ends = [
    compile_stepper(each, "svi:6", sizes=sizes).integrate(**start, h=0.01, steps=50).q[-1]
    for each, sizes in ((arrays[0], None), (arrays[0], {"N": 3}), (arrays[1], {"N": 3}))]
print(np.array_equal(ends[0], ends[1]), np.abs(ends[1] - ends[2]).max() < 1e-9)
try:
    LagrangianSystem.from_text("accelerations", coordinates, L, constraints=["rate(x_dot) = 1"])
except SystemDefinitionError as refusal:
    print("the acceleration of x_dot: constraints are" in str(refusal), "rate(f(q, t)) = b(q, t)" in str(refusal))
"""
    lines = run(extended, script).splitlines()
    assert lines == ["True True True True", "constraints do work | None", "True True", "True True"]


def test_documented_format_writes_trajectories_and_ensembles(extended: Path) -> None:
    script = """
import json
import numpy as np
from scvi_codegen import compile_stepper
from scvi_codegen.interfaces.models.problems import problem
stepper = compile_stepper(problem("kepler").system, "svi:2")
q, p = [1.0, 0.0], [0.0, 1.1]
one = stepper.integrate(q, p, h=0.1, steps=3)
many = stepper.integrate_ensemble([q, q], [p, p], h=0.1, steps=3)
for result, name in ((one, "one.json"), (many, "many.json")):
    result.save(name, units={"t": "s"})
    read = json.loads(open(name).read())["variables"]
    print(read["t"]["units"], *read["q"]["dimensions"], np.array_equal(read["q"]["values"], result.q))
from scvi_codegen.interfaces.cli.commands.run import run as command
print(".json" in next(each.help for each in command.params if each.name == "output"))
"""
    lines = run(extended, script).splitlines()
    assert lines == ["s t coordinate True", "s t trajectory coordinate True", "True"]


def test_documented_discretisation_solves_a_wave(extended: Path) -> None:
    """Errors after one period of a string fall with the degree; points and weights are those of Clenshaw-Curtis."""
    script = """
import numpy as np
from scvi_codegen import FieldSystem, compile_stepper
waves = FieldSystem.from_text("waves", ["u"], {"x": (0, 1)}, "u_t**2/2 - u_x**2/2", boundary={"x": (0, 0)})
for degree, least, most in ((4, 1e-3, 4e-3), (12, 1e-6, 2e-5)):
    mesh = waves.discretise("chebyshev", degree=degree, elements=2)
    x = mesh.points["x"]
    run = compile_stepper(mesh.system, "svi:4").integrate({"u": np.sin(np.pi * x)}, h=0.01, steps=200)
    near = (1 - np.cos(np.pi * np.arange(1, degree + 1) / degree)) / 4
    ends = 1 / (degree**2 - 1) / 2
    print(np.allclose(x[:degree], near), np.isclose(mesh.integral(0 * x + 1), 1 - ends))
    print(least < abs(run.q[-1] - run.q[0]).max() < most)
"""
    assert run(extended, script).split() == ["True"] * 6


def test_documented_observer_measures_the_variance(extended: Path) -> None:
    script = """
import numpy as np
from scvi_codegen import compile_stepper
from scvi_codegen.runs.driver.variance import Variance
from scvi_codegen.interfaces.models.problems import problem
stepper = compile_stepper(problem("kepler").system, "svi:2")
arguments = {"q": [1.0, 0.0], "p": [0.0, 1.1], "h": 0.1, "steps": 500}
saved = stepper.integrate(**arguments).q
for observe in ("variance", Variance()):
    run = stepper.integrate(**arguments, observe=observe)
    print(np.allclose(run.observed, saved.var(axis=0), rtol=1e-12), len(run.q), np.array_equal(run.q[-1], saved[-1]))
"""
    assert run(extended, script).split() == ["True", "2", "True"] * 2


def test_documented_extra_is_a_method_of_runs(extended: Path) -> None:
    """The registry imports it when it is called; of a harmonic oscillator q p = -cos(t) sin(t)."""
    script = """
import numpy as np, inspect
from scvi_codegen import LagrangianSystem, StateError, compile_stepper
stepper = compile_stepper(LagrangianSystem.from_text("spring", ["x"], "x_dot**2/2 - x**2/2"), "svi:8")
run = stepper.integrate([1.0], [0.0], h=0.1, steps=40)
print("scvi_codegen.extras.virial.methods" in sys.modules, np.allclose(run.virial(), -np.sin(2*run.t)/2, atol=1e-12))
try:
    stepper.integrate([1.0], [0.0], h=0.1, steps=0).virial()
except StateError as refusal:
    print("at least one step" in str(refusal), "units of action" in inspect.getdoc(type(run).virial))
"""
    assert run(extended, script).split() == ["False", "True", "True", "True"]


@pytest.mark.quick
def test_two_block_sizes_need_blocks_and_rows_of_each() -> None:
    """Multipliers are blocks of as many components as there are constraints."""
    rod = lagrange("mass on a rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"])
    stages = discretise(rod, SVI(2, "gauss-lobatto:3"))
    assert layout_of(stages, 2) is not None
    with pytest.raises(MethodError, match="3 blocks and 2 rows of 1"):
        layout_of(replace(stages, rows=stages.rows[:-1]), 2)
