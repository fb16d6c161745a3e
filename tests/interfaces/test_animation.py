"""Animations: what moves is found, frames are states at equal times, files are whole."""

import numpy as np
import pytest
from notation import lagrange
from samples import compile_quickly

import scvi_codegen as sc
from scvi_codegen.common.errors import PlotError, StateError
from scvi_codegen.extras.pictures.animation import drawn_shape, positions_of

pytest.importorskip("matplotlib")


def run_of(name: str, steps: int = 40, **parameters: float) -> sc.Trajectory:
    given = sc.problem(name)
    stepper = compile_quickly(given.system.with_parameters(**parameters), sc.SVI(2))
    p = given.p if given.velocity is None else stepper.momentum(given.q, given.velocity)
    return stepper.integrate(given.q, p, h=given.step / 4, steps=steps)


def positions(run, q, p=None):
    """Return the points of the shape of a run in states."""
    q = np.array(q)
    shape = drawn_shape(run)
    return shape.positions(np.zeros(len(q)), q, np.zeros_like(q) if p is None else p, run.parameters)


def is_pendulum(run):
    """Return whether a run is drawn with rods."""
    return any(mark["kind"] == "rod" for mark in drawn_shape(run).marks)


def run_with(lagrangian: str, coordinates: list[str], **parameters: float) -> sc.Trajectory:
    system = lagrange("mine", coordinates, lagrangian, parameters=parameters)
    m = len(coordinates)
    return compile_quickly(system, sc.SVI(2)).integrate([0.5] * m, [0.2] * m, h=0.01, steps=5)


class TestShapes:
    @pytest.mark.second
    def test_a_double_pendulum_hangs_from_the_origin_by_its_rods(self):
        run = run_of("double-pendulum", l1=2.0, l2=0.5)
        (places,) = positions(run, [[np.pi / 2, 0.0]])
        assert np.allclose(places, [[0.0, 0.0], [2.0, 0.0], [2.0, -0.5]])
        assert is_pendulum(run)
        assert np.allclose(np.linalg.norm(np.diff(positions(run, run.q), axis=1), axis=2), [2.0, 0.5])

    @pytest.mark.second
    def test_angle_from_the_upright_position_is_drawn_upright_at_zero(self):
        run = run_with("m*l**2*q_dot**2/2 - m*g*l*cos(q)", ["q"], m=1.0, l=3.0, g=9.81)
        (places,) = positions(run, [[0.0]])
        assert np.allclose(places, [[0.0, 0.0], [0.0, 3.0]])

    @pytest.mark.tiers(0, 2)
    @pytest.mark.sampled(2)
    @pytest.mark.parametrize(
        ("lagrangian", "coordinates"),
        [
            ("q_dot**2/2 - q**2/2", ["q"]),
            ("q_dot**2/2 + cos(2*q)", ["q"]),
            ("q_dot**2/2", ["q"]),
            ("(a_1_dot**2 + a_2_dot**2)/2 + cos(a_1) + cos(a_2)", ["a_1", "a_2"]),
            ("(a_1_dot**2 + a_2_dot**2 + a_1_dot*a_2_dot)/2 + cos(a_1) + cos(a_1 + a_2)", ["a_1", "a_2"]),
            ("(a_1_dot**2 + a_2_dot**2 + a_1_dot*a_2_dot)/2 + cos(a_1) - cos(a_2)", ["a_1", "a_2"]),
            ("(a_dot**2 + b_dot**2 + a_dot*b_dot)/2 + cos(a) + cos(b)", ["a", "b"]),
        ],
        ids=["spring", "two wells", "free", "apart", "angles between", "up and down", "no numbers"],
    )
    def test_systems_that_resemble_pendulums_are_not_drawn_as_such(self, lagrangian, coordinates):
        assert not is_pendulum(run_with(lagrangian, coordinates))

    @pytest.mark.second
    def test_chains_are_drawn_next_to_each_other(self):
        (places,) = positions(run_of("fput-chain:3", 2), [np.arange(3.0)])
        assert np.array_equal(places, np.stack([np.arange(1.0, 4.0), np.arange(3.0)], axis=1))

    @pytest.mark.second
    def test_one_coordinate_uses_its_phase_plane_and_two_their_plane(self):
        oscillator, kepler = run_of("harmonic-oscillator"), run_of("kepler")
        drawn = positions_of(drawn_shape(oscillator), oscillator)
        assert np.array_equal(drawn[:, 0], np.hstack([oscillator.q, oscillator.p]))
        assert np.array_equal(positions_of(drawn_shape(kepler), kepler)[:, 0], kepler.q)

    @pytest.mark.second
    @pytest.mark.sampled(1)
    @pytest.mark.parametrize(
        ("lagrangian", "coordinates", "place"),
        [
            ("(r_dot**2 + r**2*phi_dot**2)/2 + 1/r", ["r", "phi"], lambda r, u: [r * np.cos(u), r * np.sin(u)]),
            ("(s_dot**2 + s**2*a_dot**2)/2 + 3*s*cos(a)", ["s", "a"], lambda r, u: [r * np.sin(u), -r * np.cos(u)]),
            ("(s_dot**2 + s**2*a_dot**2)/2 - 3*s*sin(a)", ["s", "a"], lambda r, u: [r * np.cos(u), r * np.sin(u)]),
            (
                "(r_dot**2 + r**2*u_dot**2 + z_dot**2)/2",
                ["r", "u", "z"],
                lambda r, u, z: [r * np.cos(u), r * np.sin(u), z],
            ),
            (
                "(r_dot**2 + r**2*u_dot**2 + r**2*sin(u)**2*v_dot**2)/2",
                ["r", "u", "v"],
                lambda r, u, v: [r * np.sin(u) * np.cos(v), r * np.sin(u) * np.sin(v), r * np.cos(u)],
            ),
            (
                "2*(u_dot**2 + sin(u)**2*v_dot**2) + 4*cos(u)",
                ["u", "v"],
                lambda u, v: [np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), -np.cos(u)],
            ),
            ("(r_dot**2 + (1 + r**2)*phi_dot**2)/2", ["r", "phi"], lambda r, u: [r, u]),
        ],
        ids=["polar", "elastic pendulum", "gravity", "cylindrical", "spherical", "on a sphere", "no polar coordinates"],
    )
    def test_curvilinear_coordinates_are_drawn_as_positions(self, lagrangian, coordinates, place):
        q = np.array([0.8, 0.7, 0.3])[: len(coordinates)]
        assert np.allclose(positions(run_with(lagrangian, coordinates), [q])[0, -1], place(*q))


class TestFilm:
    def test_frames_are_the_states_at_equal_times(self):
        run = run_of("kepler", 1000)
        frames = run.animate(seconds=2.0).frames
        assert (len(frames), frames[0], frames[-1]) == (50, 0, 1000)
        assert np.ptp(np.diff(run.t[frames])) <= 1.001 * run.h

    @pytest.mark.rotated
    def test_each_frame_shows_its_state(self):
        run = run_of("double-pendulum")
        film = run.animate()
        film.animation._init_draw()
        for frame in (3, 40):
            film.animation._func(frame)
            (axes,) = film.animation._fig.axes
            x = np.cumsum(np.sin(run.q[frame]))
            rods = np.stack([[0, *x], [0, *-np.cumsum(np.cos(run.q[frame]))]], axis=1)
            assert any(np.allclose(line.get_xydata(), rods) for line in axes.lines if len(line.get_xdata()) == 3)
            assert axes.get_title() == f"double pendulum, t = {run.t[frame]:.6g}"

    @pytest.mark.rotated
    def test_frames_of_adaptive_steps_are_dense_output_at_equal_times(self, capsys):
        run = run_of("kepler", 1).stepper.integrate([0.5, 0.0], [0.0, 3**0.5], t_end=6.0, tolerance=1e-5)
        drawn = []
        film = run.animate(seconds=1.0, progress=lambda *numbers: drawn.append(numbers))
        (shown,) = film.shown
        assert np.ptp(np.diff(shown.t[film.frames])) < 1e-12
        assert shown.q[film.frames] == pytest.approx(run.at(shown.t[film.frames])[0])
        film._repr_html_()
        assert drawn[-1] == (25, 25)
        assert capsys.readouterr().err == ""  # no terminal

    @pytest.mark.rotated
    def test_files_are_complete_animations(self, tmp_path):
        run = run_of("kepler", 4)
        run.animate(tmp_path / "film.gif", seconds=0.2)
        run.animate(tmp_path / "film.html", seconds=0.2)
        from PIL import Image

        with Image.open(tmp_path / "film.gif") as film:
            assert film.n_frames == 5
        assert "<script" in (tmp_path / "film.html").read_text(encoding="utf-8")
        assert sorted(file.name for file in tmp_path.iterdir()) == ["film.gif", "film.html"]

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            ({"path": "film.png"}, r"\.gif, \.html or \.mp4"),
            ({"seconds": 0.0}, "seconds must be a positive number"),
            ({"positions": lambda q: q}, r"shape \(n, k, 2\) or \(n, k, 3\)"),
        ],
    )
    def test_invalid_arguments_are_reported(self, arguments, words):
        with pytest.raises(StateError, match=words):
            run_of("kepler").animate(**arguments)

    def test_missing_ffmpeg_is_rejected_where_needed(self, monkeypatch, tmp_path):
        from matplotlib.animation import writers

        monkeypatch.setattr(writers, "is_available", lambda name: False)
        with pytest.raises(PlotError, match="ffmpeg"):
            run_of("kepler").animate(tmp_path / "film.mp4")
        assert list(tmp_path.iterdir()) == []
