"""Recorded runs with adaptive steps: continued bit for bit, extended, read, and on the command line."""

from pathlib import Path

import numpy as np
import pytest
from commands import error_of, output_of
from recorded_runs import STATE, recorded

import scvi_codegen as sc
from scvi_codegen.codegen.native import capacity
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model

pytestmark = pytest.mark.usefixtures("here")

END, TOLERANCE = 60.0, 1e-10
MODEL = f"""
[system]
catalogue = "kepler"
[method]
method = "svi"
degree = 4
[run]
tolerance = {TOLERANCE}
span = {END}
"""


def controlled(stepper: sc.Stepper, folder: str, t_end: float = END, **settings: object):
    run = stepper.start(**STATE, t_end=t_end, tolerance=TOLERANCE)
    return sc.record_run(run, folder, **{"rows": 64} | settings)


def test_slice_is_a_trajectory_with_dense_output(kepler):
    run = kepler.integrate(**STATE, t_end=END, tolerance=TOLERANCE)
    found = controlled(kepler, "a.run")
    piece, times = found[100:200], np.linspace(run.t[120], run.t[180], 9)
    assert np.array_equal(piece.at(times)[0], run.at(times)[0])
    assert np.abs(found[::5].at(times)[0] - run.at(times)[0]).max() < 1e-8
    assert (piece.steps, piece.rejected_steps, piece.step_error) == (run.steps, run.rejected_steps, run.step_error)
    assert found[:].h == found.h == run.h
    assert len(found[:0]) == 0


@pytest.mark.parametrize("t_end", [END, -END])
def test_run_may_be_extended_or_shortened_but_not_reversed(kepler, t_end):
    controlled(kepler, "a.run", t_end, save_every=3)
    longer = sc.resume_run("a.run", t_end=1.5 * t_end)
    assert longer.finished
    assert t_end in longer.t
    assert longer.t[-1] == 1.5 * t_end
    assert np.abs(longer.q[-1] - kepler.integrate(**STATE, t_end=1.5 * t_end).q[-1]).max() < 1e-6
    with pytest.raises(sc.StateError, match="beyond"):
        sc.resume_run("a.run", t_end=t_end)
    with pytest.raises(sc.StateError, match="omit steps"):
        sc.resume_run("a.run", steps=1000)
    assert sc.load_run("a.run").manifest == longer.manifest


def test_other_kind_of_steps_is_rejected(kepler):
    recorded(kepler, 10, folder="fixed.run")
    with pytest.raises(sc.StateError, match="steps instead of t_end"):
        sc.resume_run("fixed.run", t_end=3.0)
    with pytest.raises(sc.StateError, match="omit steps"):
        controlled(kepler, "b.run", steps=10)
    with pytest.raises(sc.StateError, match="steps"):
        sc.record_run(kepler.start(**STATE, h=0.1), "c.run")
    with pytest.raises(sc.RecordingError, match="another folder"):
        controlled(kepler, "fixed.run")


def test_model_file_contains_a_tolerance():
    model = parse_model(MODEL)
    assert (model.h, model.tolerance, model.covered) == (None, TOLERANCE, END)
    assert parse_model(dump_model(model)) == model
    assert parse_model(MODEL, {"run": {"step": 0.1}}).step_count == 600
    exact = sc.Model(system=model.system, method=sc.SVI(4), q=(1.0, 0.0), p=(0.0, 1.0), span=-2.0)
    assert parse_model(dump_model(exact)) == exact
    assert parse_model(dump_model(sc.Model.from_problem(sc.problem("kepler"))), {"run": {"tolerance": 0.5}}).h is None


def test_the_command_line_runs_records_and_resumes_it(kepler):
    Path("k.toml").write_text(MODEL)
    plain = output_of("run", "k.toml", "-o", "k.npz")
    assert "of adaptive size" in plain
    assert "largest local error" in plain
    output_of("run", "k.toml", "-o", "k.run", "--span", "30")
    assert f"to t = {END:g}" in output_of("run", "--resume", "k.run", "--span", "60")
    with np.load("k.npz") as file:
        run = kepler.integrate(file["q"][0], file["p"][0], t_end=END, tolerance=TOLERANCE)
        assert np.abs(file["q"][-1] - run.q[-1]).max() < 1e-9
        assert float(file["h"]) == file["t"][1]
    assert np.abs(sc.load_run("k.run").q[-1] - run.q[-1]).max() < 1e-7
    assert "give span, not steps" in error_of("run", "k.toml", "--steps", "10")


def test_run_beyond_the_memory_ends_with_advice(monkeypatch):
    Path("k.toml").write_text(MODEL)
    monkeypatch.setattr(capacity, "usable_memory", lambda: 8000.0)
    error = error_of("run", "k.toml", status=1)
    assert "fill the memory. Save fewer of them (t_eval, save_every)" in error
    assert "-o NAME.run" in error
