"""The table of run options agrees with the fields of models, the flags of commands, model files and their page."""

from dataclasses import fields, replace
from pathlib import Path

import pytest

import scvi_codegen
from scvi_codegen import Model, ModelFileError
from scvi_codegen.extras.derivation.command import derive
from scvi_codegen.extras.orbits.command import family
from scvi_codegen.extras.paths.command import path
from scvi_codegen.interfaces.cli.commands.run import run
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.interfaces.models.options import FIELDS, OPTIONS, alternatives, options_of

PAGE = (Path(scvi_codegen.__file__).parents[1] / "docs" / "model_files.md").read_text(encoding="utf-8")
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
    "solver_tolerance": 1e-12,
    "max_iterations": 30,
    "threads": 2,
    "action": True,
    "seed": 2**64 - 1,
    "metropolis": True,
    "q": [0.5],
    "p": [0.25],
    "velocity": [0.125],
    "time": 1.5,
}
"""A value of each option that is a field."""


def model_file(sections, *, arrays=False):
    """Return a model file of an oscillator, or of an array of them, with these lines in its sections."""
    text = '[system]\nname = "one"\ncoordinates = ["q"]\nlagrangian = "q_dot**2/2 - q**2/2"\n'
    if arrays:
        text = text.replace('"q"', '"q[N]"').replace("q_dot**2/2 - q**2/2", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)")
    return text + "".join("\n".join([f"[{name}]", *lines, ""]) for name, lines in sections.items())


def test_every_field_option_is_a_field_of_models():
    assert {option.field for option in FIELDS} <= {each.name for each in fields(Model)}
    assert {option.name for option in FIELDS} == RUNS.keys()


@pytest.mark.parametrize("option", FIELDS, ids=lambda option: option.name)
def test_key_of_an_option_sets_its_field_and_is_written(option):
    values = {"step": 0.5, "span": 2.0, "q": [0.5], "velocity": [0.0]}
    for one, other in alternatives("initial", "run"):
        if option in (one, other):
            values.pop((other if option is one else one).name, None)
    values[option.name] = RUNS[option.name]
    if option.name in ("tolerance", "absolute_tolerance", "max_step", "first_step", "error"):
        values.pop("step", None)
    sections = {"initial": [], "run": []}
    for each in FIELDS:
        if each.name in values:
            sections[each.section].append(f"{each.key} = {str(values[each.name]).lower()}")
    model = parse_model(model_file(sections, arrays=option.name == "threads"))
    found = getattr(model, option.field)
    assert (list(found) if isinstance(found, tuple) else found) == RUNS[option.name]
    assert parse_model(dump_model(model)) == model


@pytest.mark.parametrize(("one", "other"), list(alternatives("initial", "run")), ids=lambda option: option.name)
def test_alternatives_exclude_each_other_in_files(one, other):
    sections = {"initial": ["q = [0.5]"], "run": []}
    for option in (one, other):
        sections[option.section].append(f"{option.key} = {RUNS[option.name]!r}")
    if one.section == "run":
        sections["initial"].append("p = [0.0]")
    if one.name != "span":
        sections["run"].append("span = 3.0")
    with pytest.raises(ModelFileError, match=f"has both {one.key} and {other.key}: give one of them"):
        parse_model(model_file(sections))


def test_flags_of_commands_are_those_of_the_table():
    common = {option.name for option in OPTIONS if option.common}
    assert common <= {each.name for each in derive.params}
    of_paths = {option.name for option in OPTIONS if option.section == "path"}
    of_families = {option.name for option in OPTIONS if option.section == "family"}
    assert {option.name for option in OPTIONS} - of_paths - of_families <= {each.name for each in run.params}
    assert common | of_paths <= {each.name for each in path.params}
    assert common | of_families <= {each.name for each in family.params}
    assert not {option.name for option in OPTIONS if not option.common} & {each.name for each in derive.params}


def test_page_of_model_files_has_the_table_of_options():
    rows = [f"| `{each.key}` | `{each.flag}` | {each.help} |" for each in options_of("run")]
    table = "\n".join(["| key of `[run]` | flag | meaning |", "| --- | --- | --- |", *rows])
    assert f"\n\n{table}\n\n" in PAGE


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("key", ["solver_tolerance", "max_iterations"])
def test_generated_programs_warn_of_options_that_they_do_not_use(key, tmp_path):
    from scvi_codegen import MethodWarning, generate_package

    lines = {"initial": ["q = [0.5]", "p = [0.0]"], "run": ["step = 0.1", "steps = 2", f"{key} = {RUNS[key]!r}"]}
    with pytest.warns(MethodWarning, match=f"default convergence criterion, not {key} of"):
        generate_package(parse_model(model_file(lines)), tmp_path / "one")


@pytest.mark.second
@pytest.mark.parametrize("generate", ["generate_package", "generate_fmu"])
def test_generated_programs_refuse_a_controller_with_a_step_size(generate, tmp_path):
    import scvi_codegen as sc
    from scvi_codegen.interfaces.models.packages.fmu import generate_fmu

    lines = {"initial": ["q = [0.5]", "p = [0.0]"], "run": ["step = 0.1", "steps = 2"]}
    model = replace(parse_model(model_file(lines)), controller="predictive")
    write = generate_fmu if generate == "generate_fmu" else sc.generate_package
    with pytest.raises(ModelFileError, match="the controller predictive determines adaptive steps"):
        write(model, tmp_path / "one.fmu" if generate == "generate_fmu" else tmp_path / "one")


@pytest.mark.rotated
def test_iterations_of_a_model_are_limited():
    from scvi_codegen import StepFailedError

    lines = {"initial": ["q = [0.5]", "p = [0.0]"], "run": ["step = 1.5", "steps = 2", "max_iterations = 1"]}
    text = model_file(lines).replace("q**2/2", "q**4/4")
    with pytest.raises(StepFailedError, match="did not converge"):
        parse_model(text).integrate()
    assert parse_model(text.replace("max_iterations = 1", "max_iterations = 200")).integrate().steps == 2
