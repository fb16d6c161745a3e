"""Animations: what moves is found, frames are states at equal times, files are whole."""

from pathlib import Path

import numpy as np
import pytest
from notation import lagrange
from samples import compile_quickly

import scvi_codegen as sc
from scvi_codegen.common.errors import PlotError, StateError
from scvi_codegen.interfaces.pictures.animation import drawn_shape, positions_of
from scvi_codegen.interfaces.pictures.recognition import shape_of
from scvi_codegen.interfaces.pictures.shape import DrawnSystem
from scvi_codegen.systems.multibody.trees.tree import identifier

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


ROBOTS = Path(__file__).parent.parent / "systems" / "robots"


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["figure.xml", "ball.xml"])
def test_links_are_where_mujoco_has_them(name):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(ROBOTS / name))
    data = mujoco.MjData(model)
    system = sc.LagrangianSystem.from_mjcf(ROBOTS / name)
    rng = np.random.default_rng(3)
    data.qpos[:] = model.qpos0 + 0.3 * rng.standard_normal(model.nq)
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_kinematics(model, data)
    values, joints = {}, []
    free, ball = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
    for k in range(model.njnt):
        joint = identifier(model.joint(k).name or model.body(model.jnt_bodyid[k]).name)
        joints.append(joint)
        first, kind = model.jnt_qposadr[k], int(model.jnt_type[k])
        at = data.qpos[first:]
        if kind == free:
            values |= dict(zip((f"{axis}_{joint}" for axis in "xyz"), at, strict=False))
        if kind in (free, ball):
            turn = at[3:7] if kind == free else at[:4]
            values |= dict(zip((f"R_{joint}_{axis}" for axis in "wxyz"), turn, strict=True))
        else:
            values[joint] = at[0]
    names, turning = [q.name for q in system.coordinates], [each.declaration for each in system.rotations]
    momenta = [f"p_{name}" for name in names]
    shape = shape_of(
        DrawnSystem(coordinates=names, momenta=momenta, parameters=(), rotations=turning, shapes={}, links=system.links)
    )
    q = np.array([[values[name] for name in names]])
    points = shape.positions(np.zeros(1), q, q, ())[0]
    for k, link in enumerate(system.links):
        j = joints.index(link.name)
        anchor = data.xanchor[j].copy()  # before the displacement of a slide
        if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE):
            anchor += data.xaxis[j] * (data.qpos[model.jnt_qposadr[j]] - model.qpos0[model.jnt_qposadr[j]])
        assert np.abs(points - anchor).max(axis=1).min() < 1e-9, (k, link.name)


class TestShapes:
    def test_a_double_pendulum_hangs_from_the_origin_by_its_rods(self):
        run = run_of("double-pendulum", l1=2.0, l2=0.5)
        (places,) = positions(run, [[np.pi / 2, 0.0]])
        assert np.allclose(places, [[0.0, 0.0], [2.0, 0.0], [2.0, -0.5]])
        assert is_pendulum(run)
        assert np.allclose(np.linalg.norm(np.diff(positions(run, run.q), axis=1), axis=2), [2.0, 0.5])

    def test_angle_from_the_upright_position_is_drawn_upright_at_zero(self):
        run = run_with("m*l**2*q_dot**2/2 - m*g*l*cos(q)", ["q"], m=1.0, l=3.0, g=9.81)
        (places,) = positions(run, [[0.0]])
        assert np.allclose(places, [[0.0, 0.0], [0.0, 3.0]])

    @pytest.mark.tiers(1, 2)
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

    def test_chains_are_drawn_next_to_each_other(self):
        (places,) = positions(run_of("fput-chain:3", 2), [np.arange(3.0)])
        assert np.array_equal(places, np.stack([np.arange(1.0, 4.0), np.arange(3.0)], axis=1))

    def test_one_coordinate_uses_its_phase_plane_and_two_their_plane(self):
        oscillator, kepler = run_of("harmonic-oscillator"), run_of("kepler")
        drawn = positions_of(drawn_shape(oscillator), oscillator)
        assert np.array_equal(drawn[:, 0], np.hstack([oscillator.q, oscillator.p]))
        assert np.array_equal(positions_of(drawn_shape(kepler), kepler)[:, 0], kepler.q)

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

    @pytest.mark.tiers(0, 1)
    @pytest.mark.sampled(2)
    @pytest.mark.parametrize("name", ["charged-particle", "fput-chain", "planar-pendulum", "outer-solar-system"])
    def test_animation_has_a_notebook_display(self, name):
        shown = run_of(name, 3).animate(seconds=0.2)._repr_html_()
        assert shown.count("data:image/png") == 4

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

    def test_animation_of_a_backward_run_is_backward(self):
        run = run_of("kepler", 10)
        back = run.stepper.integrate(run.q[-1], run.p[-1], h=-run.h, steps=10)
        assert list(back.animate(seconds=1.0).frames) == list(range(11))

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

    @pytest.mark.second
    def test_positions_may_be_supplied(self):
        run = run_of("spherical-pendulum", 3)

        def bob(q: np.ndarray) -> np.ndarray:
            theta, phi = q.T
            rod = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)
            return np.stack(rod, axis=1)[:, np.newaxis]

        film = run.animate(positions=bob, seconds=0.2)
        film.animation._init_draw()
        assert film.animation._fig.axes[0].name == "3d"

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
