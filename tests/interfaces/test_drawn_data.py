"""Data, labels and titles of drawings are those of the arrays of a trajectory. Nothing is compiled."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot

import scvi_codegen as sc
from scvi_codegen.extras.pictures.arrays import plot_arrays
from scvi_codegen.extras.pictures.conserved import ResidualPlot, plot_momentum_maps
from scvi_codegen.runs.states.words import named
from scvi_codegen.runs.stepping.step_plan import Fixed

T = np.linspace(0.0, 2.0, 41)


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    pyplot.close("all")


class Sines(sc.Trajectory):
    """Trajectory without a compiled integrator, with an energy 2 - 1e-9 t and two momentum maps."""

    def energy(self) -> Any:
        return 2.0 - 1e-9 * T

    def momentum_errors(self) -> Any:
        return 1e-9 * np.stack([-T, T**2], 1)


def motion(names: str, links: tuple[Any, ...] = ()) -> Any:
    """Return a trajectory whose coordinates are sines of t, and whose momenta are sines of 2 t."""
    interface = SimpleNamespace(
        system="S", title="S by M", map_names=("a", "b"), changes_energy=None, rotations=(), contacts=()
    )
    interface.coordinates, interface.momenta = (tuple(f"{p}{each}" for each in names.split()) for p in ("", "p_"))
    interface.arrays = interface.lengths = interface.parameters = interface.constraints = interface.contacts = ()
    interface.layout = SimpleNamespace(links=links, mesh=None, coordinates=())
    q, p = (np.sin(T[:, np.newaxis] * rate + 1.7 * np.arange(len(names.split()))) for rate in (1.0, 2.0))
    sizes: Any = {"step_sizes": np.full(41, 0.05), "h": 0.05, "plan": Fixed(0.05), "iterations": np.zeros(41, np.int32)}
    return Sines(
        t=T,
        q=q,
        p=p,
        stepper=SimpleNamespace(interface=interface, changes_states=False),
        parameters=np.zeros(0),
        **sizes,
    )


PANELS: dict[str, tuple[str, list[str]]] = {
    "a b": ("configuration", ["a b"]),
    "a b c": ("configuration", ["a b", "a c"]),
    "y x": ("orbit", ["x y"]),
    "x y z": ("orbit", ["x y", "x z"]),
    "x1 y1 x2 y2": ("orbits", ["x1 y1 x2 y2"]),
}


@pytest.mark.parametrize("names", PANELS)
def test_overviews_draw_the_columns_that_their_labels_name(names: str) -> None:
    run, (title, curves) = motion(names), PANELS[names]
    axes = sc.plot_trajectory(run)
    columns = dict(zip((*names.split(), *run.stepper.interface.momenta), [*run.q.T, *run.p.T], strict=True))
    assert [each.get_title() for each in axes] == [title] * len(curves) + ["relative energy error"]
    for drawn, curve in zip(axes, curves, strict=False):
        labels = curve.split() if title != "orbits" else ["x", "y"]
        assert [drawn.get_xlabel(), drawn.get_ylabel()] == labels
        points = np.stack([columns[each] for each in curve.split()], axis=1).reshape(len(T), -1, 2)
        expected = [part for k in range(points.shape[1]) for part in (points[:, k], points[:1, k], points[-1:, k])]
        assert len(drawn.lines) == len(expected)
        assert all(np.array_equal(line.get_xydata(), part) for line, part in zip(drawn.lines, expected, strict=True))
    (error,) = axes[-1].lines
    assert (axes[-1].get_xlabel(), axes[-1].get_yscale(), error.get_xdata().tolist()) == ("t", "log", T.tolist())
    assert error.get_ydata() == pytest.approx(np.where(T > 0.0, T, T[1] / 2) * 1e-9 / 2, rel=1e-5)
    assert axes[0].figure.get_suptitle() == "S by M"
    legends = [text.get_text() for legend in axes[0].figure.legends for text in legend.get_texts()]
    assert legends == (["1", "2"] if title == "orbits" else [])


@pytest.mark.parametrize(
    ("names", "changes_energy", "drawn"),
    [("a", None, ["a"]), ("a b c", "L depends on time", ["a", "b", "c"]), ("x y", "forces", None)],
)
def test_one_coordinate_and_driven_systems_are_drawn_in_time(names, changes_energy, drawn) -> None:
    """Bodies with forces are drawn by their paths."""
    run = motion(names)
    run.stepper.interface.changes_energy = changes_energy
    axes = sc.plot_motion(run)
    assert axes.get_title() == ("motion in time" if drawn else "orbit")
    if drawn:
        assert [line.get_label() for line in axes.lines] == drawn
        assert all(np.array_equal(line.get_xydata(), np.stack([T, run[line.get_label()]], 1)) for line in axes.lines)
        assert axes.get_ylabel() == (names if len(drawn) == 1 else "")


def test_quantities_are_drawn_in_time_by_their_names(tmp_path) -> None:
    run = motion("a b")
    axes = run.plot.time("p_b", path=tmp_path / "momentum.svg")
    assert np.array_equal(axes.lines[0].get_xydata(), np.stack([T, run.p[:, 1]], 1))
    assert (axes.get_xlabel(), axes.get_ylabel(), (tmp_path / "momentum.svg").exists()) == ("t", "p_b", True)
    assert len(run.plot.time().lines) == 2


def test_other_drawings_have_the_values_of_their_arrays() -> None:
    run = motion("q")
    maps = plot_momentum_maps(run)
    assert [line.get_label() for line in maps.lines] == ["a", "b"]
    assert maps.lines[1].get_ydata()[1:] == pytest.approx(1e-9 * T[1:] ** 2)
    (image,) = (panel := sc.plot_motion(motion("a b c d e f g"))).collections
    assert np.array_equal(image.get_array(), motion("a b c d e f g").q.T)
    assert (panel.get_xlabel(), panel.get_ylabel(), panel.get_title()) == ("t", "coordinate", "q over time")
    for shape, labels in (((5,), ("index", "t", "")), ((3, 4), ("first index", "second index", "t = 2"))):
        values = np.arange(41.0 * np.prod(shape)).reshape(41, *shape)
        run.q, run.stepper.arrays = named(run.q, ()), lambda _, values=values: {"u": values}
        drawn = plot_arrays(run)
        assert (drawn.get_xlabel(), drawn.get_ylabel(), drawn.get_title()) == labels
        assert np.array_equal(drawn.collections[0].get_array(), values if len(shape) == 1 else values[-1].T)
    run.stepper.arrays = lambda _: {"x": T**2, "u": values[:, 0], "v": values}
    assert np.array_equal(plot_arrays(run).collections[0].get_array(), values[:, 0])
    carriage = plot_arrays(run, array="x")
    assert np.array_equal(carriage.lines[0].get_xydata(), np.stack([T, T**2], 1))
    assert (carriage.get_xlabel(), carriage.get_ylabel()) == ("t", "x")
    residuals = ResidualPlot(T, np.stack([T, -T], 1), np.array([0.1, 0.3]), ("u", "v"))()
    assert [(line.get_label(), line.get_ydata()[-1]) for line in residuals.lines[:2]] == [("u", 2.0), ("v", -2.0)]
    bands = [patch.get_extents().transformed(residuals.transData.inverted()) for patch in residuals.patches]
    assert [(band.y0, band.y1) for band in bands] == [pytest.approx((-0.2, 0.2)), pytest.approx((-0.6, 0.6))]


def test_links_of_robots_are_drawn_in_space_with_the_path_of_the_tip() -> None:
    """Two links of lengths 1 and 3 turn about z on a base; the second length is twice the distance of its center."""
    common = {"kind": "hinge", "follows": None, "zero": 0.0, "rotation": np.eye(3)}
    first = SimpleNamespace(name="a", parent=-1, position=(0.0, 0.0, 0.5), center=(0.5, 0.0, 0.0), **common)
    second = SimpleNamespace(name="b", parent=0, position=(1.0, 0.0, 0.0), center=(1.5, 0.0, 0.0), **common)
    run = motion("a b", links=(first, second))
    drawn, _ = sc.plot_trajectory(run)
    assert [drawn.get_xlabel(), drawn.get_ylabel(), drawn.get_zlabel(), drawn.get_title()] == [*"xyz", "links"]
    angle, both = run.q[:, 0], run.q.sum(axis=1)
    tip = [np.cos(angle) + 3 * np.cos(both), np.sin(angle) + 3 * np.sin(both), 0.5 + 0 * both]
    *poses, path = drawn.lines
    assert np.allclose(path.get_data_3d(), tip, rtol=0, atol=1e-14)
    assert len(poses) == 6 * 4  # base, two links and their joints
    assert np.allclose(np.array(poses[-2].get_data_3d())[:, 1], np.array(tip)[:, -1], rtol=0, atol=1e-14)
    assert [line.get_alpha() for line in poses[::4]] == [0.25] * 5 + [1.0]
