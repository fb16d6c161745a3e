"""Random robots in MJCF and URDF over the attributes that are read, and their energies by MuJoCo and Pinocchio.

``python tests/tools/random_robots.py`` records the energies for tests on machines without these programs.
"""

import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

RECORDED = Path(__file__).parents[1] / "systems" / "robots" / "random.json"
SEEDS = 8
"""Number of robots of each format whose energies are recorded."""
TURNS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
SHAPES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
State = dict[str, list[float]]
"""Position (or quaternion) and velocity of each joint, one after the other, by its name."""


class Draw:
    """Random numbers that are equal in all versions of Python."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed).random

    def maybe(self, chance: float = 0.5) -> bool:
        return self.random() < chance

    def one(self, *options: Any) -> Any:
        return options[int(self.random() * len(options))]

    def numbers(self, count: int, low: float = -1.0, high: float = 1.0) -> str:
        return " ".join(f"{low + (high - low) * self.random():.3f}" for _ in range(count))

    def some(self, chance: float, **attributes: str) -> dict[str, str]:
        """Return each attribute with a chance."""
        return {key: value for key, value in attributes.items() if self.maybe(chance)}

    def turn(self, chance: float = 0.6) -> dict[str, str]:
        kind = self.one(*TURNS)
        return {kind: self.numbers(TURNS[kind])} if self.maybe(chance) else {}


def element(tag: str, attributes: dict[str, str], *inner: str) -> str:
    written = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f"<{tag}{written}>{''.join(inner)}</{tag}>"


class Mjcf:
    """Random model; ``document`` is its text, ``included`` that of a file that it includes."""

    depth = 2

    def __init__(self, seed: int) -> None:
        self.draw, self.seed = Draw(seed), seed
        draw = self.draw
        self.joints: dict[str, str] = {}
        self.bodies = 0
        self.fromto = draw.maybe(0.3)  # geoms then have no pos
        self.classes = ["main", "a", "b", "c"]
        compiler = draw.some(0.4, angle=draw.one("radian", "degree"), settotalmass="7")
        compiler |= draw.some(0.5, eulerseq="".join(draw.one(*"xyzXYZ") for _ in range(3)), inertiafromgeom="true")
        compiler |= draw.some(0.3, inertiagrouprange="0 2")
        flags = ("gravity", "spring", "damper", "constraint", "equality", "contact", "filterparent")
        flag = element("flag", draw.some(0.12, **dict.fromkeys(flags, "disable")))
        option = element("option", draw.some(0.8, gravity=draw.numbers(3, -9, 9)), flag)
        inner = element("default", {"class": "a"}, self.default(), element("default", {"class": "b"}, self.default()))
        defaults = element("default", {}, inner, self.default())
        defaults += element("default", {}, self.default(), element("default", {"class": "c"}, self.default()))
        world = "".join(self.body(self.depth) for _ in range(2))
        self.included = f"<mujocoinclude>{world}</mujocoinclude>"
        sections = [
            element("compiler", compiler),
            option,
            defaults,
            element("worldbody", {}, '<include file="included.xml"/>', element("site", {"name": "s"} | self.site())),
            element("equality", {}, *self.equalities()),
            element("actuator", {}, *self.actuators()),
            *self.sections(),
        ]
        self.document = element("mujoco", {}, *sorted(sections, key=lambda _: draw.random()))

    def default(self) -> str:
        draw = self.draw
        parts = {
            "joint": self.joint() | draw.some(0.2, type="slide"),
            "geom": self.geom(),
            "site": self.site(),
            "equality": draw.some(0.4, active=draw.one("true", "false")),
            draw.one("motor", "general", "position"): self.actuator(),
            "tendon": draw.some(0.5, group="1"),
        }
        return "".join(element(tag, attributes) for tag, attributes in parts.items() if draw.maybe(0.4))

    def joint(self) -> dict[str, str]:
        draw = self.draw
        attributes = draw.some(0.4, pos=draw.numbers(3), axis=draw.numbers(3, 0.1), damping=draw.numbers(1, 0))
        attributes |= draw.some(0.3, armature=draw.numbers(1, 0), ref=draw.numbers(1), springref=draw.numbers(1))
        return attributes | draw.some(0.2, frictionloss="0.1", group="3", margin="0.1")

    def geom(self) -> dict[str, str]:
        draw = self.draw
        attributes = draw.turn(0.5) | draw.some(0.5, density=draw.numbers(1, 100, 900))
        attributes |= draw.some(0.4, type=draw.one(*SHAPES)) | draw.some(0.5, size=draw.numbers(3, 0.1, 0.5))
        attributes |= draw.some(
            0.2, mass=draw.numbers(1, 0.5, 3), group=draw.one("0", "3"), contype="2", rgba="1 0 0 1"
        )
        return attributes | ({} if self.fromto else draw.some(0.5, pos=draw.numbers(3)))

    def spring(self, kind: str) -> dict[str, str]:
        return {"stiffness": "0" if kind == "ball" else self.draw.numbers(1, -1, 3)}

    def forces(self, kind: str) -> dict[str, str]:
        """Return further attributes of a joint."""
        return {}

    def further(self, name: str) -> list[str]:
        """Return further parts of a body."""
        return []

    def sections(self) -> list[str]:
        """Return further sections."""
        return []

    def site(self) -> dict[str, str]:
        return self.draw.turn(0.4) | self.draw.some(0.5, pos=self.draw.numbers(3))

    def actuator(self) -> dict[str, str]:
        draw = self.draw
        return draw.some(0.5, armature=draw.numbers(1, 0), damping=draw.numbers(1, 0), gear=draw.numbers(1, 1, 3))

    def klass(self, key: str, chance: float = 0.4) -> dict[str, str]:
        return self.draw.some(chance, **{key: self.draw.one(*self.classes)})

    def body(self, depth: int) -> str:
        draw, name = self.draw, f"b{self.bodies}"
        self.bodies += 1
        free, parts = depth == self.depth and draw.maybe(0.25), []
        kinds = [draw.one("hinge", "slide", "ball")] + ["hinge" for _ in range(draw.maybe(0.3))]
        for k, kind in enumerate([] if free or not (depth == self.depth or draw.maybe(0.8)) else kinds):
            if kind == "hinge" and "ball" in kinds[:k]:
                continue
            self.joints[f"j{name}{k}"] = kind
            spring = self.spring(kind)
            own = {"name": f"j{name}{k}", "type": kind, **self.joint(), **self.klass("class"), **spring}
            own |= self.forces(kind)
            parts.append(element("joint", own))
        if free:
            self.joints[f"j{name}"] = "free"
            bare = f'<freejoint name="j{name}"/>'
            parts = [draw.one(bare, element("joint", {"name": f"j{name}", "type": "free", "stiffness": "0"}))]
        shape = draw.one(*SHAPES)
        size = {"size": draw.numbers(draw.one(SHAPES[shape], 3), 0.1, 0.5)}
        geom = self.geom() | {"group": "0"} | {"type": shape} | size | self.klass("class")
        if self.fromto and shape != "sphere":
            geom |= {"fromto": draw.numbers(6)}
        parts.append(element("geom", geom))
        if draw.maybe(0.4):
            moments = {"diaginertia": "0.3 0.4 0.5", **draw.turn()}
            full = {"fullinertia": "0.3 0.4 0.5 0.01 -0.02 0.03"}
            mass = {"pos": draw.numbers(3), "mass": draw.numbers(1, 1, 3)}
            parts.append(element("inertial", mass | (moments if draw.maybe() else full)))
        if draw.maybe(0.4):
            parts = [element("frame", {"pos": draw.numbers(3), **draw.turn(), **self.klass("childclass")}, *parts)]
        parts += self.further(name)
        parts += [self.body(depth - 1) for _ in range(depth > 0 and 1 + draw.maybe(0.3))]
        parts.append(element("site", {"name": f"s{name}"} | self.site()))
        own = {"name": name, "pos": draw.numbers(3), **draw.turn(), **self.klass("childclass")}
        return element("body", own | draw.some(0.2, gravcomp=draw.numbers(1)), *parts)

    def equalities(self) -> list[str]:
        draw = self.draw
        last = f"b{self.bodies - 1}"
        pairs = [{"site1": "s", "site2": f"s{last}"}, {"body1": last, "anchor": draw.numbers(3)}]
        made = [element("connect", draw.one(*pairs) | draw.some(0.3, active="false"))] if draw.maybe() else []
        singles = [name for name, kind in self.joints.items() if kind in ("hinge", "slide")]
        if len(singles) > 1 and draw.maybe():
            own = {"joint1": singles[0], "joint2": singles[1], "polycoef": draw.numbers(draw.one(2, 3, 5))}
            made.append(element("joint", own | self.klass("class")))
        return made

    def actuators(self) -> list[str]:
        names = [name for name, kind in self.joints.items() if kind in ("hinge", "slide") and self.draw.maybe(0.4)]
        return [element("motor", {"joint": name} | self.actuator() | self.klass("class")) for name in names]

    def write(self, folder: Path) -> Path:
        (folder / "included.xml").write_text(self.included)
        (folder / "model.xml").write_text(self.document)
        return folder / "model.xml"


BOX = "-1 -.5 -.25 0 -.5 -.25 -1 .5 -.25 0 .5 -.25 -1 -.5 .25 0 -.5 .25 -1 .5 .25 0 .7 .25"
FACES = "0 2 1 1 2 3 4 5 6 5 7 6 0 1 4 1 5 4 2 6 3 3 6 7 0 4 2 2 4 6 1 3 5 3 7 5"
PART = """<mujoco model="part"><compiler angle="{angle}" eulerseq="{sequence}"/><default><geom size=".2"/></default>
<worldbody><body name="p" pos="{place}" euler="{turn}"><joint name="pj" axis="{axis}" ref=".3" stiffness="2 1"/>
<geom pos="{center}"/><site name="ps" pos=".1 0 0"/></body></worldbody></mujoco>"""


class Whole(Mjcf):
    """Random model over all parts that are read: meshes, tendons, springs, media, macros, actuators, limits, keys."""

    depth = 1

    def __init__(self, seed: int) -> None:
        self.clamped = seed % 3 == 0  # torques, and then no actuators of tendons
        super().__init__(20000 + seed)
        self.included = self.included.replace('gravcomp="-', 'gravcomp="')  # which MuJoCo ignores if all are < 0
        kinds = {"angle": self.draw.one("radian", "degree"), "sequence": self.draw.one("xyz", "ZYX")}
        numbers = {key: self.draw.numbers(3, 0.1) for key in ("place", "turn", "axis", "center")}
        self.part = PART.format(**kinds, **numbers)

    def spring(self, kind: str) -> dict[str, str]:
        return {}

    def forces(self, kind: str) -> dict[str, str]:
        draw = self.draw
        damping = {"damping": draw.numbers(draw.one(1, 2, 3), 0)} if draw.maybe(0.3) else {}
        stiffness = draw.numbers(draw.one(1, 2, 3), 0, 3) if draw.maybe() else "0"
        limits = draw.some(0.3, range="0 0.2" if kind == "ball" else "0.1 0.2")
        return {"stiffness": stiffness, **damping, **limits, **draw.some(0.5 * self.clamped, actuatorfrcrange="-1 2")}

    def further(self, name: str) -> list[str]:
        draw, parts = self.draw, list[str]()
        if draw.maybe(0.3):
            shape = {"type": "mesh", "mesh": draw.one("m0", "m1"), "size": "0.1", **draw.turn()}
            parts.append(element("geom", shape | draw.some(0.5, pos=draw.numbers(3), mass=draw.numbers(1, 1, 2))))
        if draw.maybe(0.2):
            sphere = {"type": "sphere", "size": ".1", "group": "0", "pos": draw.numbers(3)}
            inner = element("geom", sphere) if draw.maybe() else self.copied(sphere)
            copies = {"count": draw.one("1", "2", "3"), "offset": draw.numbers(3), "sep": draw.one("", "-")}
            parts.append(element("replicate", copies | draw.some(0.5, euler=draw.numbers(3)), inner))
        elif draw.maybe(0.15):
            parts.append(element("attach", {"model": "part", "body": "p", "prefix": f"a{name}/"}))
        return parts

    def copied(self, shape: dict[str, str]) -> str:
        """Return a body of a replicate, whose joints have no other names."""
        own = {"name": f"r{self.bodies}", "pos": self.draw.numbers(3)}
        joint = {"name": f"rj{self.bodies}", "type": "hinge", "axis": self.draw.numbers(3, 0.1), "stiffness": "1"}
        return element("body", own, element("joint", joint), element("geom", shape))

    def sections(self) -> list[str]:
        draw, (first, *_) = self.draw, [*self.singles(), ""]
        meshes = []
        for k, rule in enumerate((draw.one("convex", "exact"), draw.one("legacy", "shell"))):
            at = draw.some(0.5, scale=draw.numbers(3, 0.3), refpos=draw.numbers(3), refquat=draw.numbers(4, 0.2))
            meshes.append(element("mesh", {"name": f"m{k}", "vertex": BOX, "face": FACES, "inertia": rule, **at}))
        medium = draw.some(0.2, density=draw.numbers(1, 0, 2), viscosity=draw.numbers(1, 0))
        forces = draw.some(0.6, stiffness=draw.numbers(draw.one(1, 2), 0, 2), damping=draw.numbers(1, 0))
        forces |= draw.some(0.3, springlength=draw.one(".1", ".1 .3"))
        start = int(draw.random() * self.bodies)
        sites = (element("site", {"site": f"sb{(start + k) % self.bodies}"}) for k in range(2))
        path = element("spatial", {"name": "path", **forces}, '<site site="s"/>', *sites)
        factors = (element("joint", {"joint": name, "coef": draw.numbers(1)}) for name in self.singles())
        tendons = [path] + ([element("fixed", {"name": "sum", **forces}, *factors)] if first else [])
        bounds = draw.some(0.5, ctrlrange="-.3 .2") | draw.some(0.3, forcerange="-.2 .4", gear=draw.numbers(1, 1, 3))
        servo = draw.one(("position", {"kp": "3", "kv": "1"}), ("velocity", {"kv": "2"}), ("motor", {}))
        plain = {"armature": "0", "damping": "0", **servo[1], **bounds}
        acting = [] if self.clamped else [element(servo[0], {"name": "servo", "tendon": "path", **plain})]
        affine = {"gaintype": "fixed", "biastype": "affine", "biasprm": "1 -2 -.5", "gainprm": "2", **bounds}
        acting += (
            [element("general", {"name": "force", "joint": first, **affine})] if first and not self.clamped else []
        )
        if not self.clamped:
            ends = {"site": f"sb{start}"} | draw.some(0.5, refsite=draw.one("s", f"sb{(start + 1) % self.bodies}"))
            acting.append(element(servo[0], {"name": "wrench", **plain, **ends, "gear": draw.numbers(draw.one(3, 6))}))
        return [
            element("asset", {}, *meshes, '<model name="part" file="part.xml"/>'),
            element("option", medium),
            element("tendon", {}, *(each for each in tendons if draw.maybe(0.6) or each is path)),
            element("actuator", {}, *acting),
            element("keyframe", {}, element("key", draw.some(0.5, name="k"))),
        ]

    def singles(self) -> list[str]:
        return [name for name, kind in self.joints.items() if kind in ("hinge", "slide")]

    def write(self, folder: Path) -> Path:
        (folder / "part.xml").write_text(self.part)
        return super().write(folder)


class Urdf:
    """Random robot; ``floating`` is whether its base is free."""

    def __init__(self, seed: int) -> None:
        self.draw, self.seed = Draw(1000 + seed), seed
        draw = self.draw
        self.floating = draw.maybe()
        self.joints = {"l0": "free"} if self.floating else {}
        self.mimics: dict[str, tuple[str, float, float]] = {}
        links = [self.link(0)]
        joints = []
        for k in range(1, 7):
            links.append(self.link(k))
            kind = draw.one("revolute", "continuous", "prismatic", "fixed") if k > 1 else "revolute"
            inner = [f'<parent link="l{int(draw.random() * k)}"/><child link="l{k}"/>', self.origin()]
            inner += [element("axis", {"xyz": draw.numbers(3, 0.1)})] if draw.maybe(0.8) else []
            if kind != "fixed":
                inner.append(element("dynamics", {"damping": draw.numbers(1, 0)} | draw.some(0.5, friction="0.2")))
                if kind in ("revolute", "prismatic"):
                    inner.append('<limit lower="-1" upper="2" effort="10" velocity="3"/>')
                single = [name for name, each in self.joints.items() if each == kind != "continuous"]
                if single and draw.maybe(0.3):
                    factor, offset = draw.numbers(2).split()
                    self.mimics[f"j{k}"] = single[0], float(factor), float(offset)
                    inner.append(element("mimic", {"joint": single[0], "multiplier": factor, "offset": offset}))
                else:
                    self.joints[f"j{k}"] = kind
            joints.append(element("joint", {"name": f"j{k}", "type": kind}, *inner))
        self.document = element("robot", {"name": "random"}, *links, *joints)

    def link(self, k: int) -> str:
        moments = {"ixx": "0.3", "ixy": "0.01", "ixz": "-0.02", "iyy": "0.4", "iyz": "0.03", "izz": "0.5"}
        inertial = (
            self.origin(),
            element("mass", {"value": self.draw.numbers(1, 0.5, 3)}),
            element("inertia", moments),
        )
        return element("link", {"name": f"l{k}"}, element("inertial", {}, *inertial))

    def origin(self) -> str:
        return element("origin", self.draw.some(0.8, xyz=self.draw.numbers(3), rpy=self.draw.numbers(3)))

    def write(self, folder: Path) -> Path:
        (folder / "robot.urdf").write_text(self.document)
        return folder / "robot.urdf"


def state_of(robot: Mjcf | Urdf) -> State:
    """Return a random state: free joints have position, unit quaternion, velocity, and angular velocity of the body."""
    draw = Draw(robot.seed + 5000)
    state: State = {}
    for name, kind in robot.joints.items():
        place = [*map(float, draw.numbers(3 if kind == "free" else 1).split())]
        if kind == "ball":
            place = []
        if kind in ("ball", "free"):
            turn = [*map(float, draw.numbers(4, 0.2).split())]
            place += [each / sum(a * a for a in turn) ** 0.5 for each in turn]
        rates = {"free": 6, "ball": 3}.get(kind, 1)
        state[name] = [*place, *map(float, draw.numbers(rates).split())]
    return state


def by_mujoco(robot: Mjcf, state: State, path: Path) -> list[float]:
    """Return T - V - (-V at q = 0), the power of damping, and the sorted absolute values of the constraints."""
    import mujoco
    import numpy as np

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    disabled = model.opt.disableflags
    lifts = model.body_gravcomp * model.body_mass
    if disabled & mujoco.mjtDisableBit.mjDSBL_SPRING and disabled & mujoco.mjtDisableBit.mjDSBL_DAMPER:
        lifts *= 0
    if disabled & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        lifts *= 0
    potentials = []
    for scale in (0.0, 1.0):
        for name, kind in robot.joints.items():
            joint, values = model.joint(name), state[name]
            count = {"free": 7, "ball": 4}.get(kind, 1)
            at, rate = joint.qposadr[0], joint.dofadr[0]
            identity = [0.0] * (count - 4) + [1.0, 0.0, 0.0, 0.0] if count > 1 else [0.0]
            data.qpos[at : at + count] = values[:count] if scale else identity
            data.qvel[rate : rate + len(values) - count] = scale * np.array(values[count:])
        mujoco.mj_forward(model, data)
        potentials.append(data.energy[0] + lifts @ data.xipos @ model.opt.gravity)
    rows = np.array(data.efc_pos)[: data.ne]
    power = data.qfrc_damper @ data.qvel
    return [data.energy[1] - potentials[1] + potentials[0], power, *sorted(abs(rows))]


def by_pinocchio(robot: Urdf, state: State, path: Path) -> list[float]:
    """Return T - V - (-V at q = 0) and the power of damping."""
    import numpy as np
    import pinocchio

    base = [pinocchio.JointModelFreeFlyer()] if robot.floating else []
    model = pinocchio.buildModelFromUrdf(str(path), *base)
    data = model.createData()
    damped = np.array(model.damping)
    potentials = []
    for scale in (0.0, 1.0):
        q, v = pinocchio.neutral(model), np.zeros(model.nv)
        for name in model.names[1:]:
            joint = model.joints[model.getJointId(name)]
            if name == "root_joint":
                x, turn, rates, spin = (state["l0"][i:j] for i, j in ((0, 3), (3, 7), (7, 10), (10, 13)))
                if scale:
                    rotation = pinocchio.Quaternion(*turn).toRotationMatrix()
                    q[joint.idx_q : joint.idx_q + 7] = [*x, *turn[1:], turn[0]]
                    v[joint.idx_v : joint.idx_v + 6] = [*(rotation.T @ rates), *spin]
                continue
            leader, factor, offset = robot.mimics.get(name, (name, 1.0, 0.0))
            angle, rate = scale * factor * state[leader][0] + offset, scale * factor * state[leader][1]
            q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
            v[joint.idx_v] = rate
        energy = pinocchio.computeKineticEnergy(model, data, q, v)
        potentials.append(pinocchio.computePotentialEnergy(model, data, q))
    return [energy - potentials[1] + potentials[0], -damped @ v**2]


def motion_by_pinocchio(robot: Urdf, state: State, path: Path) -> tuple[list[str], tuple[Any, Any, Any]]:
    """Return joints, the base first, and their positions, velocities and accelerations in MuJoCo's order.

    With v = G u, where G has the factors of joints that follow others, u' = (G^T M G)^-1 G^T (f - n(q, v)).
    """
    import numpy as np
    import pinocchio

    model = pinocchio.buildModelFromUrdf(str(path), *[pinocchio.JointModelFreeFlyer()] * robot.floating)
    data, q, free = model.createData(), pinocchio.neutral(model), 6 * robot.floating
    names = [name for name in model.names[1:] if name not in robot.mimics and name != "root_joint"]
    follows, u = np.zeros((model.nv, free + len(names))), np.zeros(free + len(names))
    follows[:free, :free] = np.eye(free)
    if robot.floating:
        turn = state["l0"][3:7]
        rotation = pinocchio.Quaternion(*turn).toRotationMatrix()
        q[:7], u[:3], u[3:6] = [*state["l0"][:3], *turn[1:], turn[0]], rotation.T @ state["l0"][7:10], state["l0"][10:]
    for name in model.names[1 + robot.floating :]:
        joint = model.joints[model.getJointId(name)]
        leader, factor, offset = robot.mimics.get(name, (name, 1.0, 0.0))
        angle, place = factor * state[leader][0] + offset, free + names.index(leader)
        q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
        follows[joint.idx_v, place], u[place] = factor, state[leader][1]
    v = follows @ u
    mass, bias = pinocchio.crba(model, data, q), pinocchio.nonLinearEffects(model, data, q, v)
    mass = np.triu(mass) + np.triu(mass, 1).T
    changes = np.linalg.solve(follows.T @ mass @ follows, follows.T @ (-model.damping * v - bias))
    if robot.floating:
        changes[:3] = rotation @ (changes[:3] + np.cross(u[3:6], u[:3]))
        u[:3] = state["l0"][7:10]
    places = [*(state["l0"][:7] if robot.floating else []), *(state[name][0] for name in names)]
    return [*(["l0"] if robot.floating else []), *names], (np.array(places), u, changes)


def flow(kinds: Any, q: Any, v: Any) -> Any:
    """Return the rates of MuJoCo's positions q of joints of these kinds at its velocities v."""
    import numpy as np

    rates, k = [], 0
    for kind in kinds:
        count = (3, 0, 1, 1)[kind]
        rates += [*v[k : k + count]]
        k += count
        if kind < 2:
            w, x, y, z = q[len(rates) : len(rates) + 4]
            rates += [*np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ v[k : k + 3] / 2]
            k += 3
    return np.array(rates)


def errors_of_motion(system: Any, path: Path) -> list[float]:
    """Return relative errors of T - V (but for a constant), power and equations of motion at a random state of MuJoCo.

    The accelerations are MuJoCo's without equalities.
    """
    import mujoco
    import numpy as np

    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data, draw = mujoco.MjData(model), np.random.default_rng(1)
    equations = equations_of(system, [*system.joint_names], model.jnt_type)
    controls = dict(zip(system.actuators.values(), draw.uniform(-2, 2, len(system.actuators)), strict=True))
    held = controls | {name: min(max(controls[name], low), high) for name, low, high in system.input_ranges}
    constants = [held.get(name.removesuffix("_0"), 0.0) for name in ("t", *map(str, system.parameters))]
    energies, lifts, off = [], model.body_gravcomp * model.body_mass, mujoco.mjtDisableBit
    passive = off.mjDSBL_SPRING | off.mjDSBL_DAMPER  # without energies of lifts in MuJoCo
    lifted = not (model.opt.disableflags & passive == passive or model.opt.disableflags & off.mjDSBL_GRAVITY)
    for scale in (0.0, 1.0):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, draw.uniform(-1, 1, model.nv) * scale, 1.0)
        data.qvel[:] = scale * draw.uniform(-1, 1, model.nv)
        data.ctrl[: len(controls)] = [*controls.values()]
        for name, place in zip(controls, model.actuator_actadr, strict=False):
            data.act[place : place + (place >= 0)] = held[name]  # which mj_forward does not clamp
        mujoco.mj_forward(model, data)
        energy, power, error = equations((data.qpos, data.qvel, data.qacc_smooth), constants)
        lift = lifts @ data.xipos @ model.opt.gravity * lifted
        energies.append(energy - data.energy[1] + data.energy[0] + lift)
    powers = (data.qfrc_damper + data.qfrc_fluid + data.qfrc_actuator) * data.qvel
    sizes = np.abs(data.energy).max() + 1, np.abs(powers).sum() + 1, 1
    errors = energies[1] - energies[0], power - powers.sum(), error
    return [float(abs(x) / size) for x, size in zip(errors, sizes, strict=True)]


def equations_of(system: Any, labels: Sequence[str], kinds: Sequence[int]) -> Any:
    """Return a function of positions, velocities and accelerations of joints of these labels and MuJoCo's kinds.

    It returns L, the power of forces, and the error of d/dt L_v - L_q - f relative to |f| + |L_q| + 1.
    """
    import numpy as np
    from sympy import S

    from scvi_codegen.common.precision import mp
    from scvi_codegen.systems.formulas.expressions import Tape, gradient

    names: list[str] = []
    for kind, label in zip(kinds, labels, strict=True):
        name = system.joint_names[label]
        place, turn = [f"{x}_{name}" for x in "xyz"], [f"R_{name}_{x}" for x in "wxyz"]
        names += ([*place, *turn], turn, [name], [name])[kind]
    order = [names.index(str(q)) for q in system.coordinates]
    m, variables = system.dimension, (*system.coordinates, *system.velocities)
    slopes, forces = gradient(system.lagrangian, variables), system.forces or [S.Zero] * m
    tape = Tape(
        [system.lagrangian, *(slopes.get(k, S.Zero) for k in range(2 * m)), *forces],
        (*variables, system.time, *system.parameters),
    )

    def equations(motion: Sequence[Any], constants: Sequence[float]) -> tuple[Any, Any, Any]:
        places, rates, changes = motion
        rate = flow(kinds, places, rates)
        second = flow(kinds, places, changes)
        second += flow(kinds, rate, rates) - flow(kinds, 0 * rate, rates)
        q, v, a = ([*map(mp.mpf, part[order].tolist())] for part in (places, rate, second))
        step, sides = mp.mpf("1e-15"), []
        for h in (-step, 0, step):
            moved = [x + h * y + h * h / 2 * z for x, y, z in zip(q, v, a, strict=True)]
            sides.append(tape([*moved, *(y + h * z for y, z in zip(v, a, strict=True)), *map(mp.mpf, constants)]))
        before, (energy, *values), after = (np.array(side) for side in sides)
        torques, along, acting = values[:m], ((after - before) / (2 * step))[1 + m : 1 + 2 * m], values[2 * m :]
        size = max(map(abs, torques)) + max(map(abs, acting)) + 1
        return energy, np.dot(acting, v), np.abs(along - torques - acting).max() / size

    return equations


def motion_by_mujoco(path: Path, place: Any, rates: Any, span: float) -> Any:
    """Return qpos after a time span, by DOP853 of M a = f + J^T l, J a = -dJ/dt v, with dependent equations."""
    import mujoco
    import numpy as np
    from scipy.integrate import solve_ivp

    model = mujoco.MjModel.from_xml_path(str(path))
    data, mass, step = mujoco.MjData(model), np.zeros((model.nv, model.nv)), 1e-5

    def field(_: float, state: Any) -> Any:
        sides = []
        for h in (step, -step, 0):
            data.qpos[:], data.qvel[:] = np.split(state, [model.nq])
            mujoco.mj_integratePos(model, data.qpos, data.qvel, h)
            mujoco.mj_forward(model, data)
            sides.append(np.array(data.efc_J).reshape(-1, model.nv)[: data.ne])
        mujoco.mj_fullM(model, data, mass)
        free, rows = np.array(data.qacc_smooth), sides[2]
        bias, lifted = (sides[0] - sides[1]) @ data.qvel / (2 * step), np.linalg.solve(mass, rows.T)
        forces = np.linalg.lstsq(rows @ lifted, rows @ free + bias, rcond=1e-7)[0]
        return np.concatenate([flow(model.jnt_type, data.qpos, data.qvel), free - lifted @ forces])

    return solve_ivp(field, (0, span), [*place, *rates], method="DOP853", rtol=1e-11, atol=1e-12).y[: model.nq, -1]


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        recorded: dict[str, list[list[float]]] = {"mjcf": [], "urdf": []}
        for seed in range(SEEDS):
            for kind, make, reference in (("mjcf", Mjcf, by_mujoco), ("urdf", Urdf, by_pinocchio)):
                robot = make(seed)
                recorded[kind].append(reference(robot, state_of(robot), robot.write(folder)))  # type: ignore[operator]
    RECORDED.write_text(json.dumps(recorded, indent=1) + "\n")
