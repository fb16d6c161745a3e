"""Scenes of contacts, robots, inputs, transformed time and heat baths: golden cells whose programs print whole states.

A program prints twenty states. Two judges read them: their bits are those of the recorded source (``golden_cells.py``),
and those of contacts and robots are near the states in ``golden/states.npz``. These were recorded once, before the
machinery of contacts was replaced; do not record them again where bits change. The motions are insensitive: changes of
1e-12 of the initial state, and fixed steps of half the size, move no state by a tenth of the tolerance.
"""

import hashlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from golden_drivers import scene_driver
from notation import lagrange
from numpy.typing import NDArray

import scvi_codegen as sc
from scvi_codegen import as_method
from scvi_codegen.codegen.pipeline import generate_source
from scvi_codegen.codegen.rendering.source import Source

STATES = Path(__file__).parents[1] / "golden" / "states.npz"
OUTPUTS = 20

Table = tuple[Sequence[float], Sequence[Sequence[float]]]
"""Breakpoints of an input, and from each on the coefficients of powers of the time since it."""


@dataclass(frozen=True)
class Scene:
    """A motion from (q, p) to t_end, by adaptive steps within rounding, or by ``steps`` fixed ones.

    Attributes:
        steps: their number, a multiple of the number of outputs; 0 for adaptive steps.
        inputs: tables of the inputs.
        tau: function g of transformed time dt = g dtau, in which steps have a fixed size.
        within: tolerance of recorded states, relative to the largest q and the largest p; 0 if none are recorded.
    """

    system: Callable[[], Any]
    method: str
    q: tuple[float, ...]
    p: tuple[float, ...]
    t_end: float
    steps: int = 0
    solver: str = "auto"
    inputs: Mapping[str, Table] | None = None
    tau: str | None = None
    within: float = 0.0

    def made(self, name: str) -> tuple[Source, str]:
        """Return the source of the integrator, and a main program."""
        system, tables = self.system(), dict(self.inputs or {})
        method = as_method(self.method, system)
        source, interface = generate_source(
            system, method, solver=self.solver, prefix=name, controlled=not self.steps, time_transformation=self.tau
        )
        events = interface.searched(())
        parameters = [0.0] * len(interface.parameters)
        parameters[: len(system.defaults)] = map(float, system.defaults)
        main = scene_driver(
            interface.prefix,
            self.q,
            self.p,
            parameters,
            self.t_end,
            self.steps,
            outputs=OUTPUTS,
            events=[event.direction for event in events],
            inputs=[tables[name] for name in system.inputs],
            in_tau=self.tau is not None,
            seed=7 if system.bath else None,
        )
        return source, main


def from_mjcf(text: str, **arguments: Any) -> Any:
    """Return the system of a robot in MJCF."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "robot.xml")
        file.write_text(f"<mujoco>{text}</mujoco>")
        return sc.LagrangianSystem.from_mjcf(file, **arguments)


def states_of(printed: str) -> NDArray[np.float64]:
    """Return the (20, 1 + 2m) times, positions and momenta that a program printed."""
    rows = [line.split()[1:] for line in printed.splitlines() if line.startswith("state ")]
    return np.array([[float.fromhex(value) for value in row] for row in rows])


def farthest(states: NDArray[Any], recorded: NDArray[Any]) -> float:
    """Largest difference of states, of positions and momenta relative to their largest ones."""
    q, p = np.split(np.abs(states - recorded)[:, 1:], 2, axis=1)
    of_q, of_p = np.split(np.abs(recorded)[:, 1:], 2, axis=1)
    return float(max(q.max() / of_q.max(), p.max() / of_p.max()))


def digest(files: Mapping[str, str]) -> str:
    """Return a number of a program, which its recorded states carry."""
    return hashlib.sha256("".join(files.values()).encode()).hexdigest()


def bodies(coordinates: str, text: str, contacts: Sequence[Any], **parameters: float) -> Any:
    """Return a system with contacts."""
    return sc.LagrangianSystem.from_text(
        "bodies", coordinates.split(), text, parameters=parameters or None, contacts=contacts
    )


CONTACT = partial(Scene, method="svi:8", within=1e-9)
G, WIDTH, HEIGHT = 9.81, 0.5, 0.2
BOX = f"(x_dot**2 + y_dot**2)/2 + {(HEIGHT**2 + WIDTH**2) / 3}*a_dot**2/2"
CORNERS = [
    sc.contact(
        f"y - {HEIGHT}*cos(a) {e:+}*{WIDTH}*sin(a)",
        slip=f"x_dot + a_dot*({HEIGHT}*cos(a) {-e:+}*{WIDTH}*sin(a))",
        friction=0.4,
        static_friction=0.5,
    )
    for e in (-1, 1)
]
WOODPECKER = {"mS": 4.5e-3, "mM": 3e-4, "JS": 7e-7, "JM": 5e-9, "k": 0.0056, "g": G, "lM": 0.01, "lG": 0.015}
CONTACTS = {
    # falls, bounces, slides and rolls
    "contact_ball": CONTACT(
        lambda: bodies(
            "x y a",
            "(x_dot**2 + y_dot**2) + a_dot**2/5 - 2*g*y",
            [sc.contact("y - 1/2", slip="x_dot - a_dot/2", friction=0.3, restitution=0.7)],
            g=G,
        ),
        q=(0.0, 1.5, 0.0),
        p=(8.0, 0.0, 0.3),
        t_end=4.0,
    ),
    # sticks and slips
    "contact_belt": CONTACT(
        lambda: bodies(
            "x y",
            "(x_dot**2 + y_dot**2)/2 - x**2/2 - y",
            [sc.contact("y", slip="x_dot - v", friction=0.25, static_friction=0.4)],
            v=0.3,
        ),
        q=(0.0, 0.0),
        p=(0.3, 0.0),
        t_end=15.0,
    ),
    # sticks, slides, falls over
    "contact_rod": CONTACT(
        lambda: bodies(
            "x y a",
            "(x_dot**2 + y_dot**2)/2 + a_dot**2/6 - y",
            [sc.contact("y - cos(a)", slip="x_dot - cos(a)*a_dot", friction=0.3)],
        ),
        q=(0.0, float(np.cos(0.1)), 0.1),
        p=(0.0, 0.0, 0.0),
        t_end=3.8,
    ),
    # slips in space along a curve, and stops
    "contact_block": CONTACT(
        lambda: bodies(
            "x y z",
            f"(x_dot**2 + y_dot**2 + z_dot**2)/2 - {G}*(cos(b)*z - sin(b)*x)",
            [sc.contact("z", slip=["x_dot", "y_dot"], friction=0.5)],
            b=0.3,
        ),
        q=(0.0, 0.0, 0.0),
        p=(0.3, 1.5, 0.0),
        t_end=1.5,
    ),
    # two corners depend on each other; static friction exceeds that of sliding
    "contact_box": CONTACT(
        lambda: sc.LagrangianSystem.from_text(
            "box", ["x", "y", "a"], f"{BOX} - {G}*y", forces={"x": f"{0.5 * G / 0.97}*t"}, contacts=CORNERS
        ),
        method="svi:3",
        q=(0.0, HEIGHT, 0.0),
        p=(0.0, 0.0, 0.0),
        t_end=1.2,
        steps=60,
    ),
    # impact without collision (Painleve), then flight
    "contact_paradox": CONTACT(
        lambda: bodies(
            "x y a",
            "(x_dot**2 + y_dot**2)/2 + a_dot**2/6 - y",
            [sc.contact("y - cos(a)", slip="x_dot - cos(a)*a_dot", friction=1.5, restitution=0.4)],
        ),
        method="svi:6",
        q=(0.0, float(np.cos(np.arctan(0.5))), float(np.arctan(0.5))),
        p=(-3.0, 0.0, 0.0),
        t_end=1.0,
    ),
    # impacts of two balls on each other and on a floor that moves
    "contact_column": CONTACT(
        lambda: bodies(
            "y z",
            f"3*y_dot**2/2 + z_dot**2/2 - {G}*(3*y + z)",
            [sc.contact("y - sin(3*t)/50", restitution=0.5), sc.contact("z - y - 1", restitution=0.4)],
        ),
        method="svi:4",
        q=(0.4, 1.6),
        p=(0.0, 0.0),
        t_end=3.0,
    ),
    # three contacts with friction, of a woodpecker (C. Glocker & F. Pfeiffer)
    "contact_woodpecker": CONTACT(
        lambda: bodies(
            "y u s",
            "(mS + mM)*y_dot**2/2 + mS*lM*y_dot*u_dot + mS*lG*y_dot*s_dot + (JM + mS*lM**2)*u_dot**2/2"
            " + mS*lM*lG*u_dot*s_dot + (JS + mS*lG**2)*s_dot**2/2 - (mS + mM)*g*y - k*(u - s)**2/2"
            " - mS*g*(lM*u + lG*s)",
            [
                sc.contact("0.0024 - 0.02*s", slip="y_dot + lM*u_dot - 0.0051*s_dot", friction=0.3, restitution=0.5),
                *(sc.contact(f"0.0006 {way} 0.0058*u", slip="y_dot + 0.0031*u_dot", friction=0.3) for way in "+-"),
            ],
            **WOODPECKER,
        ),
        method="svi:6",
        q=(0.0, -0.6 / 5.8, -0.2788),
        p=(-2.1e-3, -2.0e-5, -3.6e-5),
        t_end=0.3,
    ),
}

RIGID: dict[str, Any] = {"limits": "contact", "friction": "contact", "contacts": "planes"}
ROBOT = partial(Scene, method="svi:6", within=1e-7)
GROUND = '<geom type="plane" size="5 5 .1" friction=".8"/>'
FEET = "".join(
    f'<geom type="sphere" pos="{at} -.1" size=".03" mass=".1" friction=".8"/>'
    for at in (".125 .173", "-.25 0", ".125 -.173")
)
SITTER = """<default><joint axis="0 1 0"/><geom type="capsule" size=".04" friction=".7"/></default><worldbody>
<geom type="plane" size="5 5 .1"/><body pos="0 0 .7"><joint name="x" type="slide" axis="1 0 0"/><joint name="z"
type="slide" axis="0 0 1"/><joint name="pitch"/><geom fromto="-.2 0 0 .2 0 0" mass="6"/><body pos=".2 0 0"><joint
name="hip" damping="1" stiffness="20"/><geom fromto="0 0 0 .1 0 -.4" mass="1"/></body></body></worldbody>"""
LIMITED = """<worldbody><body><joint name="a" axis="0 1 0" range="-60 40"/><geom type="capsule" size=".03"
fromto="0 0 0 0 0 -.5" mass="1"/><body pos="0 0 -.5"><joint name="b" axis="0 1 0" range="0 100" damping=".01"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".5"/></body></body></worldbody>"""
FOUR_BAR = """<option gravity="3 0 -9"/><worldbody>
<body pos="0 0 0"><joint name="a" axis="0 1 0"/><geom type="capsule" size=".02"
fromto="0 0 0 0 0 .4" mass="1"/><body name="rod" pos="0 0 .4"><joint name="b" axis="0 1 0"/><geom type="capsule"
size=".02" fromto="0 0 0 .6 0 0" mass="1"/></body></body><body name="arm" pos=".6 0 0"><joint name="c" axis="0 1 0"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 .4" mass="1"/></body></worldbody><equality><connect body1="rod"
body2="arm" anchor=".6 0 0"/></equality>"""
SERVOS = """<worldbody><body><joint name="a" axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 -.5"
mass="1"/><body pos="0 0 -.5"><joint name="b" axis="0 1 0" armature=".01"/><geom type="capsule" size=".02"
fromto="0 0 0 0 0 -.4" mass=".5"/></body></body></worldbody><actuator><position name="servo" joint="a" kp="9" kv="1"/>
<motor name="motor" joint="b" gear=".5"/></actuator>"""
ROPE = """<worldbody><site name="top"/><body name="mass" pos=".3 0 0"><joint name="x" type="slide" axis="1 0 0"/>
<joint name="z" type="slide" axis="0 0 1"/><site name="mass"/><geom size=".1" mass="2"/></body></worldbody><tendon>
<spatial name="r" range="0 .5"><site site="top"/><site site="mass"/></spatial></tendon>"""
DRY_TENDON = """<option gravity="0 0 0"/><worldbody>
<body><joint name="a" type="slide"/><geom mass="2" size=".1"/></body>
<body><joint name="b" type="slide" frictionloss=".1"/><geom mass="1" size=".1"/></body></worldbody><tendon>
<fixed frictionloss=".6"><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>"""
HOPPER = f"""<worldbody>{GROUND}<body pos="0 0 .8"><joint name="x" type="slide" axis="1 0 0"/><joint name="z"
type="slide" axis="0 0 1"/><geom type="box" size=".1 .1 .1" mass="5" contype="0" conaffinity="0"/><body><joint
name="leg" type="slide" axis="0 0 1" stiffness="900" damping="4"/><geom type="sphere" pos="0 0 -.5" size=".05"
mass=".5"/></body></body></worldbody>"""
ROBOTS = {
    # dry friction of a joint: stops on an incline
    "robot_slide": ROBOT(
        lambda: from_mjcf(
            '<worldbody><body><joint name="s" type="slide" axis="1 0 -.364" frictionloss="4"/>'
            '<geom size=".1" mass="1"/></body></worldbody>',
            **RIGID,
        ),
        q=(0.0,),
        p=(1.0,),
        t_end=2.0,
    ),
    # a ball joint at its limit
    "robot_ball_joint": ROBOT(
        lambda: from_mjcf(
            '<worldbody><body><joint name="j" type="ball" range="0 40"/>'
            '<geom size=".1" pos="0 0 -.5" mass="2"/></body></worldbody>',
            **RIGID,
            restitution=0.4,
        ),
        q=(1.0, 0.0, 0.0, 0.0),
        p=(0.0, 4.0, 1.0, 0.02),
        t_end=1.0,
    ),
    # hinges between rigid stops, with restitution
    "robot_limits": ROBOT(lambda: from_mjcf(LIMITED, **RIGID, restitution=0.3), q=(0.5, 0.9), p=(0.0, 0.0), t_end=1.0),
    # a rope that becomes taut
    "robot_rope": ROBOT(lambda: from_mjcf(ROPE, **RIGID), q=(0.0, 0.0), p=(0.0, 0.0), t_end=1.0),
    # dry friction of a tendon and of a joint
    "robot_tendon": ROBOT(lambda: from_mjcf(DRY_TENDON, **RIGID), q=(0.0, 0.0), p=(0.3, 1.2), t_end=4.0),
    # falls on its capsules and rests
    "robot_sitter": ROBOT(
        lambda: from_mjcf(SITTER, **RIGID), q=(0.0, 0.0, 0.0, 0.0), p=(0.0, 0.0, 0.0, 0.0), t_end=0.6
    ),
    # lands and hops
    "robot_hopper": ROBOT(lambda: from_mjcf(HOPPER, **RIGID), q=(0.0, 0.0, 0.0), p=(2.0, 0.0, 0.0), t_end=1.5),
    # a free body on three feet
    "robot_stool": ROBOT(
        lambda: from_mjcf(
            f'<worldbody>{GROUND}<body pos="0 0 .15"><freejoint name="seat"/><geom type="box" size=".3 .12 .05" '
            f'mass="3" contype="0" conaffinity="0"/>{FEET}</body></worldbody>',
            **RIGID,
            restitution=0.3,
        ),
        method="svi:4",
        steps=40,
        q=(0.0, 0.0, 0.15, 0.98, 0.0, 0.0, float(np.sqrt(1 - 0.98**2))),
        p=(0.9, 0.0, 0.0, 0.0, 0.05, 0.02, 0.0),
        t_end=0.3,
    ),
    # a free sphere that slides, then rolls
    "robot_ball": ROBOT(
        lambda: from_mjcf(
            f'<worldbody>{GROUND}<body pos="0 0 .1"><freejoint name="b"/><geom size=".1" mass="1"/></body></worldbody>',
            **RIGID,
        ),
        q=(0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0),
        p=(0.5, 0.2, 0.0, 0.0, 0.01, 0.02, 0.0),
        t_end=0.5,
    ),
    # smooth: a closed chain, servos with inputs, a robot of a file of URDF
    "robot_four_bar": ROBOT(lambda: from_mjcf(FOUR_BAR), q=(0.0, 0.0, 0.0), p=(0.0, 0.0, 0.0), t_end=0.4),
    "robot_servos": ROBOT(
        lambda: from_mjcf(SERVOS, actuators=True),
        q=(0.5, 0.9),
        p=(0.0, 0.0),
        t_end=2.0,
        inputs={
            "servo": ((0.0, 0.7, 2.0), ((0.3, -0.5, 0.0, 0.0), (-0.05, 0.0, 0.2, 0.0))),
            "motor": ((0.0, 1.1, 2.0), ((0.2, 0.0, 0.0, 0.0), (-0.4, 0.1, 0.0, 0.3))),
        },
    ),
    "robot_arm": ROBOT(
        lambda: sc.LagrangianSystem.from_urdf(Path(__file__).parents[1] / "systems" / "robots" / "arm.urdf"),
        q=(0.4, 0.1),
        p=(0.2, -0.1),
        t_end=1.0,
    ),
}


def pushed(formula: str, forces: Mapping[str, str], inputs: str) -> Any:
    """Return a system of x and y with inputs."""
    return lagrange("pushed", "x y", formula, forces=dict(forces), inputs=inputs)


HOLD: Table = ((0.0, 1.3, 2.0, 4.1), ((0.4, 0, 0, 0), (-0.3, 0, 0, 0), (0.1, 0, 0, 0)))
CUBIC: Table = ((-1.0, 0.9, 5.0), ((0.1, 0.2, -0.1, 0.05), (-0.3, 0.1, 0.2, -0.05)))
COUPLED = "(1 + y**2)*x_dot**2/2 + y_dot**2/2 - x**2 - (x - y)**4/4"
OTHERS = {
    "input_fixed": Scene(
        lambda: pushed(COUPLED, {"x": "u", "y": "-u*y"}, "u"), "svi:4", (0.3, -0.4), (0.2, 0.5), 4.0, 80,
        inputs={"u": HOLD},
    ),
    "input_adaptive": Scene(
        lambda: pushed(COUPLED, {"x": "u*cos(t)", "y": "w - y_dot"}, "u w"), "svi:6", (0.3, -0.4), (0.2, 0.5), 4.0,
        inputs={"u": HOLD, "w": CUBIC},
    ),
    "input_newton": Scene(
        lambda: pushed(COUPLED, {"x": "u*y"}, "u"), "gauss:2", (0.3, -0.4), (0.2, 0.5), 4.0, 80, solver="newton",
        inputs={"u": CUBIC},
    ),
    "input_friction": Scene(
        lambda: sc.LagrangianSystem.from_text(
            "rubbed", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - (x - y)**2", forces={"x": "u"}, inputs=["u"],
            contacts=[sc.friction("y_dot", limit=0.15)],
        ),
        "svi:3", (0.0, 0.0), (0.1, 0.0), 4.0, 80,
        inputs={"u": HOLD},
    ),
    "tau_double": Scene(
        lambda: sc.problem("double-pendulum").system, "svi:4", (0.9, -0.6), (0.5, 1.2), 2.0, 60,
        tau="1/(1 + theta1**2)",
    ),
    "tau_rods": Scene(
        lambda: lagrange(
            "rods", "x y", "(x_dot**2 + y_dot**2)/2 - 3*y", constraints=["x**2 + y**2 = 1"],
        ),
        "svi:3", (0.6, 0.8), (-0.8, 0.6), 2.0, 60, tau="1/(2 + x)",
    ),
    "bath_well": Scene(
        lambda: lagrange("well", "x", "x_dot**2/2 - (x**2 - 1)**2 - x/2", damping="g", temperature="kT", kT=1.0, g=1.0),
        "svi:2", (0.7,), (0.2,), 20.0, 200,
    ),
    "bath_chain": Scene(
        lambda: lagrange(
            "chain", "a b c",
            "(a_dot**2 + 2*b_dot**2 + c_dot**2 + a_dot*b_dot)/2 - (a**2 + (b-a)**4 + (c-b)**2 + c**2)/2",
            dissipation="g*a_dot**2/2", temperature="kT", kT=1.3, g=0.7,
        ),
        "svi:4", (0.7, 0.1, -0.3), (0.2, 0.0, 0.4), 20.0, 200,
    ),
}  # fmt: skip

SCENES: dict[str, Scene] = CONTACTS | ROBOTS | OTHERS
