"""The table of run options agrees with the fields of models, the flags of commands, model files and their page."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

import scvi_codegen
from scvi_codegen import Model, ModelFileError, derive
from scvi_codegen.cli.commands.run import run
from scvi_codegen.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.models.options import FIELDS, OPTIONS, alternatives

PAGE = (Path(scvi_codegen.__file__).parents[1] / "docs" / "model_files.md").read_text(encoding="utf-8")
RUNS = {
    "step": 0.25,
    "tolerance": 1e-6,
    "error": 1e-5,
    "span": 3.0,
    "steps": 4,
    "save_every": 2,
    "q": [0.5],
    "p": [0.25],
    "velocity": [0.125],
    "time": 1.5,
}
"""A value of each option that is a field."""


def model_file(sections):
    """Return a model file of an oscillator with these lines in its sections."""
    text = '[system]\nname = "one"\ncoordinates = ["q"]\nlagrangian = "q_dot**2/2 - q**2/2"\n'
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
    if option.name in ("tolerance", "error"):
        values.pop("step", None)
    sections = {"initial": [], "run": []}
    for each in FIELDS:
        if each.name in values:
            sections[each.section].append(f"{each.key} = {values[each.name]!r}")
    model = parse_model(model_file(sections))
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
    assert {option.name for option in OPTIONS} <= {each.name for each in run.params}
    assert not {option.name for option in OPTIONS if not option.common} & {each.name for each in derive.params}


def test_page_of_model_files_names_every_key_of_runs():
    written = [option.key for option in FIELDS if re.search(rf"\b{option.key} = ", PAGE)]
    assert written == [option.key for option in FIELDS]
