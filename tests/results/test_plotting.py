"""Pictures: every kind of system gets one, equal trajectories give equal bytes."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import PlotError, StateError
from scvi_codegen.mechanics.symmetry.bodies import bodies
from scvi_codegen.methods import SVI, StoermerVerlet
from scvi_codegen.models.model import Model
from scvi_codegen.models.problems import problem
from scvi_codegen.results.plotting import check_plot_path, draw_section, draw_trajectory, plot_section, plot_trajectory
from scvi_codegen.runtime.events import Event
from scvi_codegen.runtime.trajectory import Trajectory


def trajectory_of(name: str, steps: int = 300, h: float | None = None) -> Trajectory:
    model = replace(Model.from_problem(problem(name)), method=StoermerVerlet())
    model = replace(model, h=(model.h if h is None else h) / 4)
    return model.start(compile_stepper(model.system, model.method)).record(steps)


@pytest.fixture(scope="module")
def kepler() -> Trajectory:
    return trajectory_of("kepler")


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_equal_trajectories_give_equal_bytes(kepler, tmp_path, suffix):
    one, two = tmp_path / f"one{suffix}", tmp_path / f"two{suffix}"
    plot_trajectory(kepler, one)
    plot_trajectory(kepler, two)
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes().startswith(b"\x89PNG" if suffix == ".png" else b"<?xml")


@pytest.mark.parametrize(
    ("name", "titles"),
    [
        ("planar-pendulum", ["phase plane", "relative energy error"]),
        ("kepler", ["configuration", "relative energy error"]),
        ("charged-particle", ["orbit", "orbit", "relative energy error"]),
        ("outer-solar-system", ["orbits", "orbits", "relative energy error"]),
        ("fput-chain:12", ["q over time", "relative energy error"]),
    ],
)
def test_each_kind_of_system_gets_its_panels(name, titles):
    figure = draw_trajectory(trajectory_of(name))
    assert [axes.get_title() for axes in figure.axes if axes.get_title()] == titles
    assert figure.axes[len(titles) - 1].get_yscale() == "log"


def test_bodies_are_named_in_the_legend():
    figure = draw_trajectory(trajectory_of("outer-solar-system"))
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["sun", "jupiter", "saturn", "uranus", "neptune", "pluto"]


@pytest.mark.parametrize("name", ["kepler", "planar-pendulum", "fput-chain:12"])
@pytest.mark.parametrize("steps", [0, 1])
def test_a_single_state_can_be_drawn(name, steps, tmp_path):
    plot_trajectory(trajectory_of(name, steps), tmp_path / "short.png")


def test_a_run_backward_can_be_drawn(tmp_path):
    plot_trajectory(trajectory_of("fput-chain:12", h=-0.1), tmp_path / "back.svg")


def test_an_exactly_conserved_energy_can_be_drawn(tmp_path):
    plot_trajectory(trajectory_of("charged-particle", 2), tmp_path / "exact.png")


def test_energy_error_is_the_largest_of_each_bin():
    from scvi_codegen.results.plotting import _largest_in_bins

    error = np.zeros(60_000)
    error[777] = 3.0
    t, largest = _largest_in_bins(np.arange(60_000.0), error)
    assert len(t) == 600
    assert np.nanmax(largest) == 3.0
    assert np.isnan(largest).sum() == 599


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["x", "y"], [("", (0, 1))]),
        (["z", "y", "x"], [("", (2, 1, 0))]),
        (["a_x", "b_x", "a_y", "b_y"], [("a", (0, 2)), ("b", (1, 3))]),
        (["a_x", "a_y", "b_x", "b_y", "b_z"], []),
        (["a_x", "a_z"], []),
        (["q1", "q2"], []),
        (["x"], []),
        (["theta", "x", "y"], []),
    ],
)
def test_coordinates_are_grouped_into_bodies(names, expected):
    assert [(body.name, body.columns) for body in bodies(names)] == expected


def test_other_suffixes_and_missing_matplotlib_are_errors_before_the_run(monkeypatch):
    with pytest.raises(StateError, match=r"\.png or \.svg"):
        check_plot_path("orbit.gif")
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name))
    with pytest.raises(PlotError, match=r"pip install 'scvi-codegen\[plot\]'"):
        check_plot_path("orbit.png")


def test_a_picture_that_fails_leaves_nothing_behind(kepler, tmp_path, monkeypatch):
    def fail(trajectory: Trajectory) -> None:
        raise RuntimeError("no picture")

    monkeypatch.setattr("scvi_codegen.results.plotting.draw_trajectory", fail)
    with pytest.raises(RuntimeError, match="no picture"):
        plot_trajectory(kepler, tmp_path / "orbit.png")
    assert list(tmp_path.iterdir()) == []


def test_dollar_signs_in_names_are_no_formulas(tmp_path):
    model = Model.from_problem(problem("planar-pendulum"))
    system = replace(model.system, name="a $ b $ {")
    stepper = compile_stepper(system, SVI(1))
    plot_trajectory(stepper.integrate([0.5], [0.0], h=0.1, steps=10), tmp_path / "dollar.png")


@pytest.fixture(scope="module")
def orbits() -> list[Trajectory]:
    system = problem("henon-heiles").system
    stepper = compile_stepper(system, StoermerVerlet(), flags=("-O0",), events=["y", Event("x", 1)])
    return [stepper.integrate([0.0, y], [0.3, 0.0], h=0.1, steps=3000) for y in (-0.1, 0.2)]


def test_a_section_has_the_states_at_the_crossings(orbits, tmp_path):
    figure = draw_section(orbits, ("y", "p_y"), event=1)
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("y", "p_y")
    assert axes.get_title() == "Henon-Heiles system: x = 0, rising"
    for line, orbit in zip(axes.get_lines(), orbits, strict=True):
        assert len(line.get_xdata()) > 40
        assert np.array_equal(line.get_xydata(), np.stack([orbit.events[1].q[:, 1], orbit.events[1].p[:, 1]], axis=1))
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    plot_section(orbits, one, axes=("y", "p_y"), event=1)
    plot_section(orbits, two, axes=("y", "p_y"), event=1)
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [({"axes": ("y", "z")}, "'z' is neither"), ({"axes": ("y", "p_y"), "event": 2}, "no event 2")],
)
def test_a_section_says_what_it_lacks(orbits, arguments, words, tmp_path):
    with pytest.raises(StateError, match=words):
        plot_section(orbits[0], tmp_path / "section.png", **arguments)
