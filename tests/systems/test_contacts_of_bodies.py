"""Contacts of rigid bodies whose attitude is a rotation, against Newton-Euler equations in Euler parameters."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import root

import scvi_codegen as sc

pytestmark = pytest.mark.rotated
Vector = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Body:
    """Body with a sphere of radius r, 0 for a corner, at the point c of its frame, above z = 0: (x, v, q, omega)."""

    inertia: Vector
    c: Vector
    r: float = 0.0
    mu: float = 0.0
    m: float = 1.0
    e: float = 0.0

    def frame(self, s: Vector) -> tuple[Vector, Vector]:
        w, x, y, z = s[6:10] / np.linalg.norm(s[6:10])
        hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + 2 * w * hat + 2 * hat @ hat
        return turn, turn @ self.c - self.r * UP

    def push(self, s: Vector, force: Vector, free: float = 0) -> Vector:
        (turn, arm), omega = self.frame(s), s[10:]
        torque = turn.T @ np.cross(arm, force) - free * np.cross(omega, self.inertia * omega)
        return np.concatenate([force / self.m - 9.81 * free * UP, torque / self.inertia])

    def there(self, s: Vector, rates: Vector) -> Vector:
        return np.asarray(rates[:3] + np.cross(self.frame(s)[0] @ rates[3:], self.frame(s)[1]))

    def mobility(self, s: Vector) -> Vector:
        return np.array([self.there(s, self.push(s, column)) for column in np.eye(3)]).T

    def force(self, s: Vector) -> Vector:
        turn, _ = self.frame(s)
        spin, w = turn @ s[10:], self.there(s, s[[3, 4, 5, 10, 11, 12]])
        rate = self.there(s, self.push(s, 0 * UP, 1)) + np.cross(spin, np.cross(spin, turn @ self.c))
        direction = UP - self.mu * np.array([*w[:2], 0]) / np.linalg.norm(w[:2])
        return direction * (-rate[2] / (self.mobility(s)[2] @ direction))

    def rates(self, _: float, s: Vector, closed: bool) -> Vector:
        turning = np.array([-s[7:10] @ s[10:], *(s[6] * s[10:] + np.cross(s[7:10], s[10:]))]) / 2
        changes = self.push(s, self.force(s) if closed else 0 * UP, 1)
        return np.concatenate([s[3:6], changes[:3], turning, changes[3:]])

    def hit(self, s: Vector) -> Vector:
        matrix, w = self.mobility(s), self.there(s, s[[3, 4, 5, 10, 11, 12]])

        def residual(impulse: Vector) -> Vector:
            after = w + matrix @ impulse
            along = self.mu * impulse[2] * after[:2] / np.linalg.norm(after[:2])
            return np.array([*(impulse[:2] + along), after[2] + self.e * w[2]])

        impulse = root(residual, -(1 + self.e) * w[2] / matrix[2, 2] * UP, tol=1e-14).x
        assert np.abs(residual(impulse)).max() < 1e-12
        change = self.push(s, impulse)
        return s + np.concatenate([np.zeros(3), change[:3], np.zeros(4), change[3:]])

    def end(self, _: float, s: Vector, closed: bool) -> float:
        return float(self.force(s)[2] if closed else s[2] + self.frame(s)[1][2])

    def motion(self, s: Vector, t_end: float) -> Vector:
        """Return the state at t_end of a body that starts in the air, by DOP853 restarted at transitions."""
        t, closed, ends = 0.0, False, self.end
        vars(Body.end).update(terminal=True, direction=-1)
        while True:
            part = solve_ivp(self.rates, (t, t_end), s, "DOP853", rtol=1e-12, atol=1e-14, args=(closed,), events=ends)
            t, s = part.t[-1], part.y[:, -1]
            if part.status == 0:
                return s
            s, closed = (s, False) if closed else (self.hit(s), self.e == 0 and self.force(self.hit(s))[2] > 0)


W = [f"rotate_{k}(R, omega_1, omega_2, omega_3)" for k in (1, 2, 3)]
ARM = [f"rotate_{k}(R, c1, c2, c3){' - r' * (k == 3)}" for k in (1, 2, 3)]
SLIP = [f"x_dot + {W[1]}*({ARM[2]}) - {W[2]}*({ARM[1]})", f"y_dot + {W[2]}*({ARM[0]}) - {W[0]}*({ARM[2]})"]
ENERGIES = "m*(x_dot**2 + y_dot**2 + z_dot**2)/2 + (A*omega_1**2 + B*omega_2**2 + C*omega_3**2)/2 - 9.81*m*z"
NAMES = ("A", "B", "C", "c1", "c2", "c3", "m", "r", "e")
BOX = Body(np.array([0.04, 0.05, 0.07]), np.array([0.3, 0.2, -0.4]))
THROWN = np.array([0, 0, 1, 0.5, -0.2, 0, 1, 0, 0, 0, 1.0, -2, 3.0])
TOP = Body(np.array([0.97, 0.97, 1.0]) * 0.4 * 0.015 * 0.025**2, np.array([0, 0, 0.005]), 0.025, mu=0.3, m=0.015)
TILT = [np.cos(0.05), np.sin(0.05), 0, 0]
SPUN = np.array([0, 0, 0.025 - 0.005 * np.cos(0.1), 0, 0, 0, *TILT, 0, 150 * np.sin(0.1), 150 * np.cos(0.1)])
STOP, ATTITUDE = 1.3331453422221, np.array([0.05972116784503, 0.9266117354475, -0.35371510560174, -0.11273729600862])
"""When the top stops sliding, and its attitude at t = 1.4, by DOP853 of such equations to a slip of 1e-11."""


def system_of(rough: bool = True) -> sc.LagrangianSystem:
    slides: Any = {"slip": SLIP, "friction": "mu*(1 + k/(1 + 1e3*(x_dot**2 + omega_1**2)))"} if rough else {}
    contacts = [sc.contact(f"z + {ARM[2]}", restitution="e", **slides)]
    values = dict.fromkeys((*NAMES, "mu", "k") if rough else NAMES, 0.1)
    options: Any = {"rotations": {"R": "omega"}, "parameters": values, "contacts": contacts}
    return sc.LagrangianSystem.from_text("body", ["x", "y", "z"], ENERGIES, **options)


@cache
def stepper_of(method: str, rough: bool = True) -> Any:
    return sc.compile_stepper(system_of(rough), method)


def start_of(body: Body, s: Vector, suffix: str = "", **others: float) -> dict[str, Any]:
    names = {f"{x}{suffix}": value for x, value in zip(("x", "y", "z", "omega"), [*s[3:6], s[10:]], strict=True)}
    values = dict(zip(NAMES, [*body.inertia, *body.c, body.m, body.r, body.e], strict=True))
    values |= ({"mu": body.mu, "k": 0.0} if body.mu else {}) | others
    return {"q": s[[0, 1, 2, 6, 7, 8, 9]], "velocity": names} | ({} if suffix else {"parameters": values})


def difference(run: Any, body: Body, s: Vector) -> float:
    ends = [run.q[-1, :3] - s[:3], (run.rotation()[-1] - body.frame(s)[0]).ravel(), run.velocity[-1, :3] - s[3:6]]
    return float(np.abs(np.concatenate([*ends, run.angular_velocity()[-1] - s[10:]])).max())


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("degree", "stop", "end"), [(1, 1e-15, 2e-3), (2, 1e-7, 2e-7), (3, 1e-12, 1e-11)])
def test_a_sphere_slides_along_a_parabola_and_rolls(degree: int, stop: float, end: float) -> None:
    """The velocity in the end follows from momenta alone, to round-off; without side spin it is 5/7 of the first."""
    sphere = Body(np.full(3, 0.2), np.zeros(3), 0.5, mu=0.3, m=2.0)
    for spin, stopped in ((np.array([-2.0, 4.0, 5.0]), stop), (np.zeros(3), 1e-14)):
        s = np.array([0, 0, 0.5, 3, 1, 0, 2, -1, 1, 3, 0, 0, 0])
        s[10:] = sphere.frame(s)[0].T @ spin
        run = stepper_of(f"svi:{degree}").integrate(**start_of(sphere, s), h=0.02, t_end=1.5)
        slip = s[3:5] + 0.5 * np.array([-spin[1], spin[0]])
        direction, rolls = slip / np.linalg.norm(slip), np.linalg.norm(slip) * 2 / (7 * 0.3 * 9.81)
        after = (5 * s[3:5] + np.array([spin[1], -spin[0]])) / 7
        assert run.contact_modes == [(0.0, ("slip",)), (pytest.approx(rolls, abs=stopped), ("stick",))]
        assert np.allclose(run.velocity[-1, :2], after, atol=1e-13)
        assert np.allclose(run.q[-1, :2], (s[3:5] + after) / 2 * rolls + after * (1.5 - rolls), atol=end)
        assert np.allclose(run.contact_forces()[0, 0], [19.62, *(-5.886 * direction)], atol=1e-11)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("mu", "e", "t", "n"), [(0, 1, 1, 1), (0.3, 0.5, 0.7, 1), (0, 0, 1.5, 4), (0.3, 0, 1, 2)])
def test_a_tumbling_box_hits_the_floor_with_its_corner(mu: float, e: float, t: float, n: int) -> None:
    box = Body(BOX.inertia, BOX.c, mu=mu, e=e)
    true = box.motion(THROWN, t)
    for steps, error in (({"h": 0.005}, 1e-6), ({"tolerance": 1e-12}, 5e-10)):
        run = stepper_of("svi:3", mu > 0).integrate(**start_of(box, THROWN), t_end=t, **steps)
        assert len(run.contact_modes) == n
        assert difference(run, box, true) < error
        assert e < 1 or np.ptp(run.energy()) < 1e-8


def jellett(run: Any) -> Vector:
    return np.asarray((run.angular_momentum() * (TOP.r * UP - TOP.c[2] * run.rotation()[:, :, 2])).sum(axis=1))


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("degree", "h", "error"), [(1, 0.002, 2e-2), (2, 0.002, 2e-6), (3, 0.001, 2e-10)])
def test_a_sliding_top_keeps_the_order(degree: int, h: float, error: float) -> None:
    true = solve_ivp(TOP.rates, (0, 0.08), SPUN, "DOP853", rtol=1e-13, atol=1e-16, args=(True,)).y[:, -1]
    runs = [stepper_of(f"svi:{degree}").integrate(**start_of(TOP, SPUN), h=x, t_end=0.08) for x in (h, h / 2)]
    coarse, fine = (np.abs(run.rotation()[-1] - TOP.frame(true)[0]).max() for run in runs)
    assert fine < error
    assert np.log2(coarse / fine) == pytest.approx(2 * degree, abs=0.2)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("k", [0.0, 0.5])
def test_a_tippe_top_inverts_and_conserves_jellett_s_integral(k: float) -> None:
    run = stepper_of("svi:3").integrate(**start_of(TOP, SPUN, k=k), t_end=1.4, tolerance=1e-10)
    energy, upright = run.energy(), run.rotation()[:, 2, 2]
    assert np.ptp(jellett(run)) < 1e-14 * jellett(run)[0]
    assert (np.diff(energy) < 1e-12 * energy[0]).all()
    assert upright[-1] < -0.96
    assert np.abs(run.q[:, 2] + TOP.c[2] * upright - TOP.r).max() < 1e-16
    if k == 0:
        assert run.contact_modes[1:] == [(pytest.approx(STOP, abs=3e-11), ("stick",))]
        assert np.allclose(run.rotation()[-1], TOP.frame(np.array([*[0] * 6, *ATTITUDE, *[0] * 3]))[0], atol=1e-10)
        slides = run[: np.searchsorted(run.t, 0.25)]  # by runs that begin where the gap is its rounding, no velocity
        assert slides.error.relative.max() < 1e-9
        stops = run[np.searchsorted(run.t, 0.99 * STOP) :]  # where no neighbouring state may have a step
        assert stops.error.relative.max() < 1e-7


@pytest.mark.tiers(0, 1)
def test_all_kinds_of_runs_have_the_modes_of_single_ones(tmp_path: Path) -> None:
    start = start_of(TOP, SPUN, mu=0.9)
    system, first = system_of().with_parameters(**start["parameters"]), stepper_of("svi:2").start(**start, h=0.01)
    again = {"q": first.q, "p": first.p, "h": 0.01}
    model = sc.Model(system=system, method=sc.SVI(2, "gauss-lobatto:3"), **again, span=1.5)
    sc.save_model(model, tmp_path / "top.toml")
    assert sc.load_model(tmp_path / "top.toml").system == system
    run, stepper = model.integrate(), sc.compile_stepper(system, "svi:2")
    assert [modes for _, modes in run.contact_modes] == [("slip",), ("stick",)]
    recorded = sc.record_run(stepper.start(**again), tmp_path / "run", steps=150)
    members = stepper.integrate_ensemble([run.q[0]] * 2, [run.p[0]] * 2, h=0.01, steps=150)
    (half := stepper.start(**again)).advance(75)
    (later := stepper.from_checkpoint(half.checkpoint())).advance(75)
    for end in (recorded.q[-1], members[1].q[-1], later.q):
        assert np.array_equal(end, run.q[-1])
    assert members[0].contact_modes == run.contact_modes


def test_packages_have_the_modes_of_runs(tmp_path: Path) -> None:
    start = start_of(TOP, SPUN, mu=0.9)
    system, first = system_of().with_parameters(**start["parameters"]), stepper_of("svi:2").start(**start, h=0.01)
    again = {"q": first.q, "p": first.p, "h": 0.01}
    model = sc.Model(system=system, method=sc.SVI(2, "gauss-lobatto:3"), **again, span=1.5)
    run = model.integrate()
    package = sc.load_package(sc.generate_package(model, tmp_path / "tippe_top")).integrate(**again, steps=150)
    assert np.array_equal(package.q[-1], run.q[-1])
    assert package.contact_modes == run.contact_modes


@pytest.mark.second
def test_a_free_base_of_a_robot_falls_on_the_floor(tmp_path: Path) -> None:
    (tmp_path / "foot.xml").write_text(
        '<mujoco model="foot"> <option> <flag contact="disable"/> </option> <worldbody> <body name="base"> '
        '<freejoint name="base"/> <inertial pos="0 0 0" mass="1" diaginertia="0.04 0.05 0.07"/> '
        '<geom type="sphere" size="0.05" pos="0.3 0.2 -0.4"/> </body> </worldbody> </mujoco>'
    )
    foot = sc.contact("z_base + rotate_3(R_base, 0.3, 0.2, -0.4) - 0.05", restitution=1)
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_mjcf(tmp_path / "foot.xml"), "svi:3", contacts=[foot])
    body = Body(BOX.inertia, BOX.c, 0.05, e=1)
    run = stepper.integrate(**start_of(body, THROWN, "_base"), h=0.005, t_end=0.6)
    assert difference(run, body, body.motion(THROWN, 0.6)) < 1e-8
