"""Constraints (DAEs): rods, angles, slides, welds, belts, and a truss, as equations between coordinates.

Each joint is a formula in the list ``constraints``; their number is arbitrary, and degrees of freedom need not be
identified. The constraint force of g = 0 with respect to q is multiplier * dg/dq.
"""

from typing import NamedTuple

import numpy as np

from scvi_codegen import LagrangianSystem, Trajectory, compile_stepper

Point = tuple[str, str]
"""Names, or formulas, of x and y."""
HOOK: Point = ("0", "0")
GRAVITY = 9.81


class Mechanism(NamedTuple):
    """System with constraints, and its initial state."""

    system: LagrangianSystem
    q: list[float]
    velocity: list[float]

    def run(self, span: float, steps: int, method: str = "svi:4") -> Trajectory:
        """Integrate the system over a span."""
        return compile_stepper(self.system, method).integrate(
            self.q, velocity=self.velocity, h=span / steps, steps=steps
        )


def point(k: int) -> Point:
    """Return the coordinates of a mass."""
    return f"x{k}", f"y{k}"


def falling(masses: dict[int, str]) -> str:
    """Return T - V of point masses under gravity."""
    return " + ".join(f"{m}*(x{k}_dot**2 + y{k}_dot**2)/2 - {m}*g*y{k}" for k, m in masses.items())


def rod(a: Point, b: Point, length: str) -> str:
    """Return a constraint of constant distance; the tension is -2 * length * multiplier."""
    return f"({b[0]} - {a[0]})**2 + ({b[1]} - {a[1]})**2 = ({length})**2"


def angle(a: Point, b: Point, c: Point, cosine: str) -> str:
    """Return a constraint of constant angle at b; ``cosine`` is its cosine times both lengths.

    It is singular for angles of 0 and pi, where its gradient is 0: use a weld, or remove the middle point.
    """
    return f"({a[0]} - {b[0]})*({c[0]} - {b[0]}) + ({a[1]} - {b[1]})*({c[1]} - {b[1]}) = {cosine}"


def slide(a: Point, derivative: str) -> str:
    """Return a constraint of a point to a line through the origin."""
    return f"{a[0]}*sin({derivative}) = {a[1]}*cos({derivative})"


def weld(one: tuple[str, str, str], other: tuple[str, str, str], along: str, turned: str) -> list[str]:
    """Return constraints that join two bodies (x, y, angle) rigidly, at a distance along the axis of the first."""
    (x, y, a), (x2, y2, a2) = one, other
    return [f"{x2} = {x} + {along}*cos({a})", f"{y2} = {y} + {along}*sin({a})", f"{a2} = {a} + {turned}"]


def belt(radius: str, a: str, other_radius: str, other: str) -> str:
    """Return a constraint of equal rim speeds of two wheels; for meshing gears use a minus sign."""
    return f"{radius}*{a} = {other_radius}*{other}"


def dumbbell() -> Mechanism:
    """Return two masses on a rod, thrown and rotating."""
    system = LagrangianSystem.from_text(
        name="dumbbell",
        coordinates=[*point(1), *point(2)],
        lagrangian=falling({1: "m", 2: "M"}),
        parameters={"m": 1.0, "M": 3.0, "l": 0.8, "g": GRAVITY},
        constraints=[rod(point(1), point(2), "l")],
    )
    return Mechanism(system, [0.0, 0.0, 0.8, 0.0], [2.0, 3.0, 2.0, 5.0])


def bent_pendulum() -> Mechanism:
    """Return two rods at a right angle, hanging from one end."""
    system = LagrangianSystem.from_text(
        name="bent pendulum",
        coordinates=[*point(1), *point(2)],
        lagrangian=falling({1: "m", 2: "m"}),
        parameters={"m": 1.0, "a": 0.6, "b": 0.4, "bend": np.pi / 2, "g": GRAVITY},
        constraints=[
            rod(HOOK, point(1), "a"),
            rod(point(1), point(2), "b"),
            angle(HOOK, point(1), point(2), "a*b*cos(bend)"),
        ],
    )
    return Mechanism(system, [0.0, -0.6, 0.4, -0.6], [1.2, 0.0, 1.2, 0.8])


def pendulum_on_a_slide() -> Mechanism:
    """Return a mass that slides down a slope, with another hanging from it."""
    system = LagrangianSystem.from_text(
        name="pendulum on a slide",
        coordinates=[*point(1), *point(2)],
        lagrangian=falling({1: "M", 2: "m"}),
        parameters={"M": 2.0, "m": 1.0, "l": 0.5, "derivative": -0.4, "g": GRAVITY},
        constraints=[slide(point(1), "derivative"), rod(point(1), point(2), "l")],
    )
    return Mechanism(system, [0.0, 0.0, 0.5, 0.0], [0.0, 0.0, 0.0, 0.0])


def welded_plates() -> Mechanism:
    """Return two plates welded at a distance, thrown."""
    bodies = [(f"x{k}", f"y{k}", f"a{k}") for k in (1, 2)]
    turning = " + ".join(f"J{k}*a{k}_dot**2/2" for k in (1, 2))
    system = LagrangianSystem.from_text(
        name="welded plates",
        coordinates=[name for body in bodies for name in body],
        lagrangian=f"{falling({1: 'm1', 2: 'm2'})} + {turning}",
        parameters={"m1": 1.0, "m2": 2.0, "J1": 0.1, "J2": 0.3, "d": 0.7, "turned": 0.5, "g": GRAVITY},
        constraints=weld(bodies[0], bodies[1], "d", "turned"),
    )
    return Mechanism(system, [0.0, 0.0, 0.0, 0.7, 0.0, 0.5], [1.0, 4.0, 3.0, 1.0, 6.1, 3.0])


def winch() -> Mechanism:
    """Return a motor whose wheel drives a drum by a belt; its rope lifts a load."""
    system = LagrangianSystem.from_text(
        name="winch",
        coordinates=["a1", "a2", "y"],
        lagrangian="J1*a1_dot**2/2 + J2*a2_dot**2/2 + m*y_dot**2/2 - m*g*y + torque*a1",
        parameters={"J1": 0.02, "J2": 0.3, "m": 5.0, "g": GRAVITY, "torque": 3.0, "r1": 0.1, "r2": 0.4, "drum": 0.15},
        constraints=[belt("r1", "a1", "r2", "a2"), belt("drum", "a2", "1", "y")],
    )
    return Mechanism(system, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])


PANELS, HEIGHT, HANGER = 4, 0.8, 1.5
BOTTOM, TOP = range(PANELS + 1), range(PANELS + 1, 2 * PANELS + 1)
MEMBERS = [
    *((k, k + 1) for k in BOTTOM[:-1]),
    *((k, k + 1) for k in TOP[:-1]),
    *((k, top) for k, top in zip(BOTTOM, TOP, strict=False)),
    *((top, k + 1) for k, top in zip(BOTTOM, TOP, strict=False)),
]
"""Warren truss: bottom chord, top chord, rising and falling diagonals."""
PLACES = np.array([*((k, 0.0) for k in BOTTOM), *((k + 0.5, HEIGHT) for k in range(PANELS))], dtype=float)
LOADS = dict.fromkeys((*BOTTOM, *TOP), "m") | {1: "(m + load)"}


def bridge(swing: float = 0.0) -> Mechanism:
    """Return a loaded truss of 15 rods, hanging from two equal rods at an angle."""
    hangers = [rod((f"{k}", f"{HANGER}"), point(k), f"{HANGER}") for k in (BOTTOM[0], BOTTOM[-1])]
    system = LagrangianSystem.from_text(
        name="hanging bridge",
        coordinates=[name for k in LOADS for name in point(k)],
        lagrangian=falling(LOADS),
        parameters={"m": 0.2, "load": 3.0, "g": GRAVITY},
        constraints=[*(rod(point(a), point(b), repr(length(a, b))) for a, b in MEMBERS), *hangers],
    )
    q = PLACES + HANGER * np.array([np.sin(swing), 1.0 - np.cos(swing)])
    return Mechanism(system, q.ravel().tolist(), [0.0] * q.size)


def length(a: int, b: int) -> float:
    """Return the length of a member of the truss."""
    return float(np.hypot(*(PLACES[b] - PLACES[a])))


def pulls(run: Trajectory) -> np.ndarray:
    """Return (n, 17) tensions of the members and hangers of the truss; negative for compression."""
    return -2.0 * run.multipliers() * [*(length(a, b) for a, b in MEMBERS), HANGER, HANGER]


def main() -> None:
    """Run all mechanisms; print constraint errors and forces."""
    thrown = dumbbell().run(2.0, 100)
    print(f"dumbbell: pull {-2 * 0.8 * thrown.multipliers()[-1, 0]:.9f}, by its turning {0.75 * 2.5**2 * 0.8:.9f}")
    lifted = winch().run(2.0, 50)
    rise = (3.0 * 4.0 - 5.0 * GRAVITY * 0.15) / (0.3 + 5.0 * 0.15**2 + 0.02 * 16.0)
    print(f"winch: turned by {lifted.q[-1, 1]:.9f}, with a constant acceleration {rise * 2.0**2 / 2:.9f}")
    for mechanism in (dumbbell(), bent_pendulum(), pendulum_on_a_slide(), welded_plates(), winch(), bridge(0.3)):
        run = mechanism.run(2.0, 200)
        kept = np.abs(run.constraint_values()[0]).max()
        energy = np.abs(run.energy() - run.energy()[0]).max()
        print(f"{run.q.shape[1]:3} coordinates, {run.multipliers().shape[1]:2} joints kept to {kept:.0e}, ", end="")
        print(f"energy to {energy:.0e}: {mechanism.system.name}")
    still = pulls(bridge().run(0.1, 1, "svi:1"))[-1]
    for (a, b), pull in zip(MEMBERS, still, strict=False):
        print(f"  member {a}-{b} {'pulls' if pull > 0 else 'pushes'} with {abs(pull):.4f}")
    print(f"  hangers pull with {still[-2]:.4f} and {still[-1]:.4f}")


if __name__ == "__main__":
    main()
