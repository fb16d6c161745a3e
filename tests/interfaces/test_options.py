"""The table of run options agrees with the fields of models, the flags of commands, model files and their page."""

import re
from dataclasses import fields, replace
from inspect import signature
from itertools import combinations
from pathlib import Path

import pytest
import tomli_w
from commands import error_of, output_of

import scvi_codegen as sc
from scvi_codegen import Model, ModelFileError
from scvi_codegen.extras.derivation.command import derive
from scvi_codegen.extras.orbits.command import family
from scvi_codegen.extras.paths.command import path
from scvi_codegen.interfaces.cli.commands.run import run
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.interfaces.models.options import OPTIONS, ROWS, RUN_FIELDS, options_of

PAGE = (Path(sc.__file__).parents[1] / "docs" / "model_files.md").read_text(encoding="utf-8")
RUNS = {
    "step": 0.25,
    "tolerance": 1e-6,
    "absolute_tolerance": 1e-9,
    "max_step": 0.5,
    "first_step": 0.125,
    "error": 1e-5,
    "span": 3.0,
    "steps": 4,
    "save_every": 2,
    "t_eval": [0.5, 1.25],
    "solver_tolerance": 1e-12,
    "max_iterations": 30,
    "threads": 2,
    "action": True,
    "seed": 2**64 - 1,
    "metropolis": True,
    "strict_energy": True,
    "q": [0.5],
    "p": [0.25],
    "velocity": [0.125],
    "time": 1.5,
}
"""A value of each option that is a field, choices aside."""
FIELDS = [option for option in OPTIONS if option.name in RUNS]


def model_file(sections, *, arrays=False):
    """Return a model file of an oscillator, or of an array of them, with these lines in its sections."""
    text = '[system]\nname = "one"\ncoordinates = ["q"]\nlagrangian = "q_dot**2/2 - q**2/2"\n'
    if arrays:
        text = text.replace('"q"', '"q[N]"').replace("q_dot**2/2 - q**2/2", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)")
    return text + tomli_w.dumps(sections)


INVALID = {
    "h": 0.0,
    "tolerance": 1.0,
    "absolute_tolerance": -1e-9,
    "max_step": 0.0,
    "first_step": -0.5,
    "error": 2.0,
    "steps": -1,
    "save_every": 0,
    "solver_tolerance": 0.5,
    "max_iterations": 10**7,
}
"""Values out of the range of options that Python has as well."""
SPAN, STEPS = {"span": 3.0}, {"step": 0.5, "steps": 4}
ADAPTIVE = ("tolerance", "absolute_tolerance", "max_step", "first_step", "error")
STEPPER = sc.compile_stepper(sc.problem("harmonic-oscillator").system, "svi:2")


def beside(option):
    """Return the keys of [run] with which an option is valid."""
    return (SPAN if option.field in ADAPTIVE or option.field == "span" else STEPS) | (
        {"step": 0.5} if option.field == "span" else {}
    )


def called(option, values):
    """Return the error of ``integrate`` with one value of an option, or of the object that has it in Python."""
    if option.solver_option:
        return lambda: sc.SolverOptions(**{option.solver_option: values})
    arguments = {"t_end": 3.0} if option.field in ADAPTIVE else {"h": 0.5, "steps": 4}
    return lambda: STEPPER.integrate([0.5], [0.0], **arguments | {option.field: values})


def test_every_option_of_runs_is_a_field_of_models():
    assert {option.field for option in RUN_FIELDS} <= {each.name for each in fields(Model)}


@pytest.mark.parametrize("option", FIELDS, ids=lambda option: option.name)
def test_key_of_an_option_sets_its_field_and_is_written(option):
    lines = {"initial": {"q": [0.5], "p": [0.0]}, "run": dict(beside(option))}
    if option.field == "velocity":
        lines["initial"].pop("p")
    lines[option.section][option.key] = RUNS[option.name]
    model = parse_model(model_file(lines, arrays=option.name == "threads"))
    found = getattr(model, option.field)
    assert (list(found) if isinstance(found, tuple) else found) == RUNS[option.name]
    assert parse_model(dump_model(model)) == model


@pytest.mark.parametrize("field", INVALID)
def test_a_mistake_has_one_text_in_the_words_of_each_face(field, tmp_path):
    """Python, models, files and flags raise the same message, which names the option as it was given."""
    option, value = ROWS[field], INVALID[field]
    lines = {"initial": {"q": [0.5], "p": [0.0]}, "run": beside(option) | {option.key: value}}
    flags = [word for key, x in lines["run"].items() for word in (f"--{key.replace('_', '-')}", str(x))]
    own = f"SolverOptions.{option.solver_option}" if option.solver_option == "tolerance" else field
    with pytest.raises(sc.ScviCodegenError) as in_python:
        called(option, value)()
    with pytest.raises(ModelFileError) as in_file:
        parse_model(model_file(lines))
    (tmp_path / "one.toml").write_text(model_file(lines | {"run": {}}))
    messages = {
        own: str(in_python.value),
        f"[run] {option.key}": str(in_file.value),
        option.flag: error_of("run", tmp_path / "one.toml", *flags).removeprefix("Error: ").strip(),
    }
    texts = set()
    for name, message in messages.items():
        assert name in message, message
        texts.add(re.sub(r"\(\S+ determines", "(span determines", message.partition(name)[2]))
    assert len(texts) == 1, messages


PAIRS = [
    (first, second)
    for first, second in combinations([row for row in OPTIONS if row.section in ("initial", "run", "")], 2)
    if (first.determines and first.determines == second.determines)
    or (second.requires == "adaptive steps" and first.field == "h")
]


@pytest.mark.parametrize(("one", "other"), PAIRS, ids=lambda option: option.name)
def test_options_exclude_each_other_alike(one, other):
    values = {option: RUNS.get(option.name, 1e-6) for option in (one, other)}
    flags = [word for option, x in values.items() for word in (option.flag, str(x).strip("[]"))]
    said = error_of("run", "harmonic-oscillator", *flags)
    assert ("exclude each other" if one.determines == other.determines else "requires adaptive steps") in said
    assert other.flag in said
    if "" in (one.section, other.section):
        return
    lines = {"initial": {"q": [0.5], "p": [0.0]}, "run": {} if one.name == "span" else {"span": 3.0}}
    for option, value in values.items():
        lines[option.section][option.key] = value
    with pytest.raises(ModelFileError) as in_file:
        parse_model(model_file(lines))
    words = {f"[{option.section}] {option.key}": option.flag for option in (one, other)}
    for name, flag in words.items():
        said = said.replace(f"{flag} ", f"{name} ")
    assert str(in_file.value).partition(":")[0] in said
    with pytest.raises(ModelFileError):
        Model(
            system=STEPPER.interface and sc.problem("harmonic-oscillator").system,
            method="svi:2",
            **{"q": [0.5], "span": 3.0} | {option.field: value for option, value in values.items()},
        )


OF_PYTHON = {
    "parameters": "--parameter",
    "options": "--solver-tolerance and --max-iterations",
    "events": "--event",
    "tables": "the section [tables]",
    "sizes": "--size",
    "check_growth": "the summary, whose digits are those that the growth of errors leaves",
    "progress": "a bar, which --quiet omits",
    "system": "MODEL",
    "symmetries": "those of the system",
    "flags": "the environment variable of the compiler's flags",
    "prefix": "generate --prefix",
    "saved": "--resume",
    "self": "the stepper",
}
"""What keywords of Python without a key and a flag are called there, or what takes their place."""
OF_COMMANDS = {
    "advise": "advise()",
    "limits": "from_file(limits=)",
    "friction": "from_file(friction=)",
    "actuators": "from_file(actuators=)",
    "keyframe": "the state of a robot's file",
    **dict.fromkeys(("degree", "stages", "order", "quadrature", "nodes", "space", "form"), "arguments of methods"),
    **dict.fromkeys(("variational", "abscissae", "parameter"), "arguments of methods and of systems"),
    "event": "events=",
    "size": "sizes=",
    **dict.fromkeys(("solver_tolerance", "max_iterations"), "options=SolverOptions(..)"),
}
"""What flags and keys without a keyword of a stepper are in Python."""


def test_python_files_and_flags_have_the_same_options():
    methods = ("integrate", "start", "integrate_ensemble", "from_checkpoint")
    functions = [getattr(sc.Stepper, name) for name in methods] + [sc.compile_stepper]
    keywords = {name for function in functions for name in signature(function).parameters} | {"span"}
    keywords -= {"t_end"}  # the time at which a span ends
    rows = {option.field: option for option in OPTIONS if option.section not in ("path", "family")}
    assert keywords - rows.keys() == OF_PYTHON.keys()
    assert rows.keys() - keywords == OF_COMMANDS.keys()
    for option in rows.values():
        assert option.flag
        assert option.section or option.field == "advise"


def test_flags_of_commands_are_those_of_the_table():
    common = {option.name for option in OPTIONS if option.common}
    assert common <= {each.name for each in derive.params}
    of_paths = {option.name for option in OPTIONS if option.section == "path"}
    of_families = {option.name for option in OPTIONS if option.section == "family"}
    assert {option.name for option in OPTIONS} - of_paths - of_families <= {each.name for each in run.params}
    assert common | of_paths <= {each.name for each in path.params}
    assert common | of_families <= {each.name for each in family.params}
    assert not {option.name for option in OPTIONS if not option.common} & {each.name for each in derive.params}


@pytest.mark.second
def test_paths_and_families_ask_for_what_they_use_alone(tmp_path):
    """A path has no initial velocity, a family no duration; the run of the same file lacks both."""
    file = tmp_path / "pendulum.toml"
    lines = {"system": {"name": "pendulum", "coordinates": ["q"], "lagrangian": "q_dot**2/2 + cos(q)"}}
    file.write_text(tomli_w.dumps(lines | {"initial": {"q": [0.0]}, "method": {"method": "svi:2"}}))
    assert "p or q_dot in [initial], no span or steps in [run]" in error_of("run", file)
    assert "there is no span or steps in [run]" in error_of("path", file, "--to", 0.3, "--step", 0.1)
    assert "there is no p or q_dot in [initial]" in error_of("family", file, "--period", 6.5)
    output_of("path", file, "--from", 0.1, "--to", 0.3, "--span", 1, "--step", 0.25)
    assert "2 periodic orbits" in output_of("family", file, "--amplitude", 0.1, "--count", 2)


def test_page_of_model_files_has_the_table_of_options():
    rows = [f"| `{each.key}` | `{each.flag}` | {each.help} |" for each in options_of("run")]
    table = "\n".join(["| key of `[run]` | flag | meaning |", "| --- | --- | --- |", *rows])
    assert f"\n\n{table}\n\n" in PAGE


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("key", ["solver_tolerance", "max_iterations"])
def test_generated_programs_warn_of_options_that_they_do_not_use(key, tmp_path):
    from scvi_codegen import MethodWarning, generate_package

    lines = {"initial": {"q": [0.5], "p": [0.0]}, "run": {"step": 0.1, "steps": 2, key: RUNS[key]}}
    with pytest.warns(MethodWarning, match=f"default convergence criterion, not {key} of"):
        generate_package(parse_model(model_file(lines)), tmp_path / "one")


@pytest.mark.second
@pytest.mark.parametrize("generate", ["generate_package", "generate_fmu"])
def test_generated_programs_refuse_a_controller_with_a_step_size(generate, tmp_path):
    import scvi_codegen as sc
    from scvi_codegen.interfaces.models.packages.fmu import generate_fmu

    lines = {"initial": {"q": [0.5], "p": [0.0]}, "run": {"step": 0.1, "steps": 2}}
    model = replace(parse_model(model_file(lines)), controller="predictive")
    write = generate_fmu if generate == "generate_fmu" else sc.generate_package
    with pytest.raises(ModelFileError, match="the controller predictive determines adaptive steps"):
        write(model, tmp_path / "one.fmu" if generate == "generate_fmu" else tmp_path / "one")


@pytest.mark.rotated
def test_iterations_of_a_model_are_limited():
    from scvi_codegen import StepFailedError

    lines = {"initial": {"q": [0.5], "p": [0.0]}, "run": {"step": 1.5, "steps": 2, "max_iterations": 1}}
    text = model_file(lines).replace("q**2/2", "q**4/4")
    with pytest.raises(StepFailedError, match="did not converge"):
        parse_model(text).integrate()
    assert parse_model(text.replace("max_iterations = 1", "max_iterations = 200")).integrate().steps == 2
