"""Pictures: every kind of system gets one, equal trajectories give equal bytes."""

import importlib.util
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot

import scvi_codegen as sc
from scvi_codegen.extras.pictures.canvas import check_plot_path
from scvi_codegen.extras.pictures.conserved import largest_in_bins, plot_energy, plot_momentum_maps


def trajectory_of(name: str, steps: int = 300, h: float | None = None) -> sc.Trajectory:
    model = replace(sc.Model.from_problem(sc.problem(name)), method=sc.StoermerVerlet())
    model = replace(model, h=(model.h if h is None else h) / 4)
    return model.start(sc.compile_stepper(model.system, model.method)).record(steps)


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def kepler() -> sc.Trajectory:
    return trajectory_of("kepler")


@pytest.mark.rotated
@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_equal_trajectories_give_equal_bytes(kepler, tmp_path, suffix):
    one, two = tmp_path / f"one{suffix}", tmp_path / f"two{suffix}"
    sc.plot_trajectory(kepler, one)
    sc.plot_trajectory(kepler, two)
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes().startswith({".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix])


def test_energy_error_is_the_largest_of_each_bin():
    error = np.zeros(60_000)
    error[777] = 3.0
    t, largest = largest_in_bins(np.arange(60_000.0), error)
    assert len(t) == 600
    assert largest.max() == 3.0
    assert (largest == 1.5).sum() == 599  # curves on a logarithmic axis do not break where the error is 0
    assert (largest_in_bins(np.arange(9.0), np.zeros(9))[1] > 0.0).all()


def test_unknown_suffix_and_missing_matplotlib_fail_before_the_run(monkeypatch):
    with pytest.raises(sc.StateError, match=r"\.png, \.svg or \.pdf"):
        check_plot_path("orbit.gif")
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name))
    with pytest.raises(sc.PlotError, match=r"pip install 'scvi-codegen\[plot\]'"):
        check_plot_path("orbit.png")


def test_failed_picture_leaves_no_file(kepler, tmp_path, monkeypatch):
    def fail(trajectory: sc.Trajectory, ax: object) -> None:
        raise RuntimeError("no picture")

    monkeypatch.setattr("scvi_codegen.extras.pictures.overview.plot_energy", fail)
    with pytest.raises(RuntimeError, match="no picture"):
        sc.plot_trajectory(kepler, tmp_path / "orbit.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.second
def test_robots_are_drawn_to_scale_in_all_axes():
    robot = sc.LagrangianSystem.from_mjcf(Path(__file__).parents[1] / "systems/robots/ball.xml")
    run = sc.compile_stepper(robot, "svi:1").integrate([0.4, 2.0, 0.0, 0.0, 0.0], velocity=[0.0] * 5, h=0.01, steps=50)
    space = run.plot()[0]
    edges = [np.ptp(limits) for limits in (space.get_xlim3d(), space.get_ylim3d(), space.get_zlim3d())]
    assert edges == pytest.approx([edges[2] * size for size in space._box_aspect / space._box_aspect[2]])


@pytest.mark.rotated
def test_dollar_signs_in_names_are_escaped(tmp_path):
    model = sc.Model.from_problem(sc.problem("planar-pendulum"))
    system = replace(model.system, name="a $ b $ {")
    stepper = sc.compile_stepper(system, sc.SVI(1))
    sc.plot_trajectory(stepper.integrate([0.5], [0.0], h=0.1, steps=10), tmp_path / "dollar.png")


@pytest.fixture(scope="module")
def orbits() -> list[sc.Trajectory]:
    system = sc.problem("henon-heiles").system
    stepper = sc.compile_stepper(system, sc.StoermerVerlet(), flags=("-O0",), events=["y", sc.Event("x", 1)])
    return [stepper.integrate([0.0, y], [0.3, 0.0], h=0.1, steps=3000) for y in (-0.1, 0.2)]


@pytest.mark.second
def test_section_contains_the_states_at_the_crossings(orbits, tmp_path):
    axes = sc.plot_section(orbits, axes=("y", "p_y"), event=1)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("y", "p_y")
    assert axes.get_title() == "Henon-Heiles system: x = 0, rising"
    for line, orbit in zip(axes.get_lines(), orbits, strict=True):
        assert len(line.get_xdata()) > 40
        assert np.array_equal(line.get_xydata(), np.stack([orbit.events[1].q[:, 1], orbit.events[1].p[:, 1]], axis=1))
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    sc.plot_section(orbits, one, axes=("y", "p_y"), event=1)
    sc.plot_section(orbits, two, axes=("y", "p_y"), event=1)
    assert one.read_bytes() == two.read_bytes()


@pytest.fixture(scope="module")
def ellipse() -> sc.Trajectory:
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(4), flags=("-O0",))
    run = stepper.integrate([0.5, 0.0], [0.0, 3**0.5], t_end=6.0, tolerance=1e-4)
    assert len(run) < 200
    return run


class TestAdaptiveSteps:
    @pytest.mark.second
    def test_curves_are_dense_output(self, ellipse):
        for axes in (ellipse.plot.motion(), ellipse.plot.phase(axes=("q1", "q2"))):
            x, y = axes.lines[0].get_xydata().T
            assert len(x) > 500
            middle = np.hypot((x[1:] + x[:-1]) / 2 + 0.5, (y[1:] + y[:-1]) / 2 / 0.75**0.5)
            assert abs(middle - 1.0).max() < 2e-2  # the ellipse a = 1, e = 1/2, within the tolerance

    @pytest.mark.second
    def test_images_have_cells_of_the_lengths_of_the_steps(self):
        chain = trajectory_of("fput-chain:12", 3)
        run = replace(chain, t=chain.t**2)
        (image,) = sc.plot_motion(run).collections
        edges = np.asarray(image.get_coordinates())[0, :, 0]
        assert edges[1:-1] == pytest.approx((run.t[1:] + run.t[:-1]) / 2)

    @pytest.mark.rotated
    def test_ensembles_are_drawn_together(self, ellipse, tmp_path):
        q, p = np.array([[0.5, 0.0], [0.4, 0.1]]), np.array([[0.0, 1.7]] * 2)
        runs = ellipse.stepper.integrate_ensemble(q, p, t_end=[3.0, 2.0], tolerance=1e-4)
        motion = runs.plot.motion()
        drawn = [line for line in motion.lines if len(line.get_xdata()) > 2]
        assert [line.get_xydata()[-1].tolist() for line in drawn] == runs.ends[1].tolist()
        assert len(runs.plot.energy().lines) == 2
        assert len(runs.plot.momentum_maps().lines) == 2 * len(ellipse.stepper.momentum_map_names)
        runs.plot(tmp_path / "runs.pdf")
        assert (runs["q1"][: len(runs[1]), 1] == runs[1]["q1"]).all()
        film = runs.animate(tmp_path / "runs.gif", seconds=0.2)
        assert [each.t[film.frames[-1]] for each in film.shown] == [3.0, 3.0]
        assert film.shown[1].q[-1].tolist() == runs.ends[1][1].tolist()  # the shorter one stays at its end
        with pytest.raises(TypeError, match="whole number"):
            runs[1.5]


class TestOnePicture:
    def test_picture_is_drawn_on_the_supplied_axes(self, kepler, orbits):
        _, given = pyplot.subplots(2, 2)
        assert sc.plot_motion(kepler, ax=given[0, 0]) is given[0, 0]
        assert plot_energy(kepler, ax=given[0, 1]) is given[0, 1]
        assert sc.plot_phase(kepler, axes=("q2", "p_q1"), ax=given[1, 0]) is given[1, 0]
        assert sc.plot_section(orbits, axes=("y", "p_y"), ax=given[1, 1]) is given[1, 1]
        assert all(axes.lines for axes in given.flat)

    def test_phase_portrait_has_one_curve_per_orbit(self, orbits):
        axes = sc.plot_phase(orbits, axes=("y", "p_y"))
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("y", "p_y")
        drawn = [line for line in axes.lines if len(line.get_xdata()) > 2]
        for line, orbit in zip(drawn, orbits, strict=True):
            assert np.array_equal(line.get_xydata(), np.stack([orbit.q[:, 1], orbit.p[:, 1]], axis=1))

    def test_energies_of_several_runs_share_axes_that_contain_them(self, orbits):
        axes = plot_energy(orbits)
        low, high = axes.get_ylim()
        values = np.concatenate([line.get_ydata() for line in axes.lines])
        assert len(axes.lines) == 2
        assert low <= np.nanmin(values) <= np.nanmax(values) <= high

    def test_unsupported_pictures_are_reported(self, kepler, orbits):
        with pytest.raises(sc.StateError, match="'Henon-Heiles system' has no known symmetry"):
            plot_momentum_maps(orbits[0])
        with pytest.raises(sc.StateError, match="'z' is neither a coordinate nor a momentum"):
            sc.plot_phase(kepler, axes=("q1", "z"))
        with pytest.raises(sc.StateError, match="no trajectory"):
            sc.plot_phase([])
