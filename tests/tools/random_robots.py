"""Random robots in MJCF and URDF over all that is read, and their motions by MuJoCo and Pinocchio.

``python tests/tools/random_robots.py`` records the motions for tests on machines without these programs.
"""

import json
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RECORDED = Path(__file__).parents[1] / "systems" / "robots" / "random.json"
SEEDS = 8
"""Number of robots of each format whose motions are recorded."""
TURNS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
SHAPES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
Motion = dict[str, Any]
"""Labels of joints and MuJoCo's kinds; positions, velocities and accelerations at rest and at a random state; energies
of both, powers of forces and residuals of equalities at the second; and the values of inputs by name."""


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


BOX = "-1 -.5 -.25 0 -.5 -.25 -1 .5 -.25 0 .5 -.25 -1 -.5 .25 0 -.5 .25 -1 .5 .25 0 .7 .25"
FACES = "0 2 1 1 2 3 4 5 6 5 7 6 0 1 4 1 5 4 2 6 3 3 6 7 0 4 2 2 4 6 1 3 5 3 7 5"
PART = """<mujoco model="part"><compiler angle="{angle}" eulerseq="{sequence}"/><default><geom size=".2"/></default>
<worldbody><body name="p" pos="{place}" euler="{turn}"><joint name="pj" axis="{axis}" ref=".3" stiffness="2 1"/>
<geom pos="{center}"/><site name="ps" pos=".1 0 0"/></body></worldbody></mujoco>"""


class Mjcf:
    """Random model: its text, and those of a file that it includes and of one that it attaches."""

    def __init__(self, seed: int) -> None:
        self.draw = draw = Draw(seed)
        self.joints: dict[str, str] = {}
        self.bodies, self.depth = 0, draw.one(1, 1, 1, 2)
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
            element("asset", {}, *self.meshes(), '<model name="part" file="part.xml"/>'),
            element("option", draw.some(0.2, density=draw.numbers(1, 0, 2), viscosity=draw.numbers(1, 0))),
            element("equality", {}, *self.equalities()),
            element("tendon", {}, *self.tendons()),
            element("actuator", {}, *self.motors(), *self.servos()),
            element("keyframe", {}, element("key", draw.some(0.5, name="k"))),
        ]
        self.document = element("mujoco", {}, *sorted(sections, key=lambda _: draw.random()))
        kinds = {"angle": draw.one("radian", "degree"), "sequence": draw.one("xyz", "ZYX")}
        self.part = PART.format(**kinds, **{key: draw.numbers(3, 0.1) for key in ("place", "turn", "axis", "center")})

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

    def forces(self, kind: str) -> dict[str, str]:
        """Return springs, dampers and limits of a joint."""
        draw = self.draw
        damping = {"damping": draw.numbers(draw.one(1, 2, 3), 0)} if draw.maybe(0.3) else {}
        stiffness = draw.numbers(draw.one(1, 2, 3), -(kind != "ball"), 3) if draw.maybe() else "0"
        limits = draw.some(0.3, range="0 0.2" if kind == "ball" else "0.1 0.2")
        return {"stiffness": stiffness, **damping, **limits, **draw.some(0.2, actuatorfrcrange="-.1 .2")}

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
            own = {"name": f"j{name}{k}", "type": kind, **self.joint(), **self.klass("class")}
            parts.append(element("joint", own | self.forces(kind)))
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
        return element("body", own | draw.some(0.2, gravcomp=draw.numbers(1, 0)), *parts)

    def equalities(self) -> list[str]:
        draw = self.draw
        last = f"b{self.bodies - 1}"
        pairs = [{"site1": "s", "site2": f"s{last}"}, {"body1": last, "anchor": draw.numbers(3)}]
        made = [element("connect", draw.one(*pairs) | draw.some(0.3, active="false"))] if draw.maybe() else []
        singles = self.singles()
        if len(singles) > 1 and draw.maybe():
            own = {"joint1": singles[0], "joint2": singles[1], "polycoef": draw.numbers(draw.one(2, 3, 5))}
            made.append(element("joint", own | self.klass("class")))
        return made

    def further(self, name: str) -> list[str]:
        """Return further parts of a body: meshes, copies, and a part of another model."""
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

    def singles(self) -> list[str]:
        return [name for name, kind in self.joints.items() if kind in ("hinge", "slide")]

    def meshes(self) -> list[str]:
        draw, meshes = self.draw, []
        for k, rule in enumerate((draw.one("convex", "exact"), draw.one("legacy", "shell"))):
            at = draw.some(0.5, scale=draw.numbers(3, 0.3), refpos=draw.numbers(3), refquat=draw.numbers(4, 0.2))
            meshes.append(element("mesh", {"name": f"m{k}", "vertex": BOX, "face": FACES, "inertia": rule, **at}))
        return meshes

    def tendons(self) -> list[str]:
        draw = self.draw
        forces = draw.some(0.6, stiffness=draw.numbers(draw.one(1, 2), 0, 2), damping=draw.numbers(1, 0))
        forces |= draw.some(0.3, springlength=draw.one(".1", ".1 .3"))
        self.ends = [f"sb{int(draw.random() * self.bodies)}", f"sb{int(draw.random() * self.bodies)}"]
        sites = (element("site", {"site": name}) for name in ("s", *dict.fromkeys(self.ends)))
        factors = [element("joint", {"joint": name, "coef": draw.numbers(1)}) for name in self.singles()]
        combined = [element("fixed", {"name": "sum", **forces}, *factors)] if factors and draw.maybe(0.6) else []
        return [element("spatial", {"name": "path", **forces}, *sites), *combined]

    def motors(self) -> list[str]:
        names = [name for name in self.singles() if self.draw.maybe(0.4)]
        return [element("motor", {"joint": name} | self.actuator() | self.klass("class")) for name in names]

    def servos(self) -> list[str]:
        """Return actuators of a tendon, a joint, and a site."""
        draw = self.draw
        bounds = draw.some(0.5, ctrlrange="-.3 .2") | draw.some(0.3, forcerange="-.2 .4", gear=draw.numbers(1, 1, 3))
        servo = draw.one(("position", {"kp": "3", "kv": "1"}), ("velocity", {"kv": "2"}), ("motor", {}))
        plain = {"armature": "0", "damping": "0", **servo[1], **bounds}
        affine = {"gaintype": draw.one("fixed", "affine"), "biastype": "affine", "biasprm": "1 -2 -.5"}
        affine |= {"gainprm": draw.numbers(3), **bounds}
        ends = {"site": self.ends[0]} | draw.some(0.5, refsite="s") | {"gear": draw.numbers(draw.one(3, 6))}
        made = [element(servo[0], {"name": "servo", "tendon": "path", **plain})]
        made += [element("general", {"name": "force", "joint": name, **affine}) for name in self.singles()[:1]]
        return [*made, element(servo[0], {"name": "wrench", **plain, **ends})]

    def write(self, folder: Path) -> Path:
        for name, text in (("included", self.included), ("part", self.part), ("model", self.document)):
            (folder / f"{name}.xml").write_text(text)
        return folder / "model.xml"


class Urdf:
    """Random robot; ``floating`` is whether its base is free."""

    def __init__(self, seed: int) -> None:
        self.draw = draw = Draw(1000 + seed)
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


def by_mujoco(system: Any, path: Path) -> Motion:
    """Return the motion by MuJoCo, with accelerations without equalities, at random inputs of a system."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data, draw = mujoco.MjData(model), np.random.default_rng(1)
    controls = dict(zip(system.actuators.values(), draw.uniform(-2, 2, len(system.actuators)).tolist(), strict=True))
    held = controls | {name: min(max(controls[name], low), high) for name, low, high in system.input_ranges}
    lifts, off, states, energies = model.body_gravcomp * model.body_mass, mujoco.mjtDisableBit, [], []
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
        states.append([part.tolist() for part in (data.qpos, data.qvel, data.qacc_smooth)])
        energies.append(float(data.energy[1] - data.energy[0] - lifts @ data.xipos @ model.opt.gravity * lifted))
    powers = (data.qfrc_damper + data.qfrc_fluid + data.qfrc_actuator) * data.qvel
    labels = [model.joint(k).name for k in range(model.njnt)]
    residuals = np.abs(data.efc_pos[: data.ne]).tolist()
    own = {"labels": labels, "kinds": model.jnt_type.tolist(), "states": states, "energies": energies, "inputs": held}
    return own | {"powers": powers.tolist(), "residuals": residuals}


def by_pinocchio(path: Path, floating: bool, mimics: Mapping[str, tuple[str, float, float]]) -> Motion:
    """Return the motion by Pinocchio; ``mimics``: leader, factor and offset of joints that follow.

    With v = G u, where G has the factors of joints that follow others, u' = (G^T M G)^-1 G^T (f - n(q, v)).
    """
    import pinocchio

    model = pinocchio.buildModelFromUrdf(str(path), *[pinocchio.JointModelFreeFlyer()] * floating)
    data, free = model.createData(), 6 * floating
    names = [name for name in model.names[1 + floating :] if name not in mimics]
    follows, offsets = np.zeros((model.nv, free + len(names))), np.zeros(model.nv)
    follows[:free, :free] = np.eye(free)
    for name in model.names[1 + floating :]:
        leader, factor, offset = mimics.get(name, (name, 1.0, 0.0))
        place = model.joints[model.getJointId(name)].idx_v
        follows[place, free + names.index(leader)], offsets[place] = factor, offset
    draw, states, energies = np.random.default_rng(1), [], []
    for scale in (0.0, 1.0):
        moved, u = scale * draw.uniform(-1, 1, (2, free + len(names)))
        q, v = pinocchio.integrate(model, pinocchio.neutral(model), follows @ moved + offsets), follows @ u
        mass, bias = pinocchio.crba(model, data, q), pinocchio.nonLinearEffects(model, data, q, v)
        mass = np.triu(mass) + np.triu(mass, 1).T
        changes = np.linalg.solve(follows.T @ mass @ follows, follows.T @ (-model.damping * v - bias))
        place = moved[free:]
        if floating:
            rotation = pinocchio.Quaternion(*q[[6, 3, 4, 5]]).toRotationMatrix()
            changes[:3] = rotation @ (changes[:3] + np.cross(u[3:6], u[:3]))
            u[:3], place = rotation @ u[:3], np.concatenate([q[[0, 1, 2, 6, 3, 4, 5]], place])
        states.append([part.tolist() for part in (place, u, changes)])
        energies.append(
            pinocchio.computeKineticEnergy(model, data, q, v) - pinocchio.computePotentialEnergy(model, data, q)
        )
    labels, powers = ["l0"] * floating + names, (-model.damping * v**2).tolist()
    own = {"labels": labels, "kinds": [0] * floating + [3] * len(names), "states": states, "energies": energies}
    return own | {"powers": powers, "residuals": [], "inputs": {}}


def errors(system: Any, motion: Motion) -> list[float]:
    """Return relative errors of T - V (but for a constant), power, equations of motion, and equalities."""
    equations = equations_of(system, motion["labels"], motion["kinds"])
    inputs = motion["inputs"]
    constants = [inputs.get(name.removesuffix("_0"), 0.0) for name in ("t", *map(str, system.parameters))]
    (rest, *_), (energy, power, error, residuals) = (equations(state, constants) for state in motion["states"])
    theirs, powers = np.array(motion["energies"]), np.array(motion["powers"])
    sizes = np.abs(theirs).max() + 1, np.abs(powers).sum() + 1, 1
    differences = (energy - theirs[1]) - (rest - theirs[0]), power - powers.sum(), error
    others = [*motion["residuals"], *[np.inf] * (not motion["residuals"])]  # dependent equations are omitted
    lost = float(len(motion["residuals"]) > 0 and not residuals)
    gaps = (min(abs(abs(value) - other) for other in others) for value in residuals)
    return [*(float(abs(x) / size) for x, size in zip(differences, sizes, strict=True)), max([lost, *map(float, gaps)])]


def errors_of_motion(system: Any, path: Path) -> list[float]:
    """Return the first three of these errors of an MJCF file."""
    return errors(system, by_mujoco(system, path))[:3]


def flow(kinds: Any, q: Any, v: Any) -> Any:
    """Return the rates of MuJoCo's positions q of joints of these kinds at its velocities v."""
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


def equations_of(system: Any, labels: Sequence[str], kinds: Sequence[int]) -> Any:
    """Return a function of positions, velocities and accelerations of joints of these labels and MuJoCo's kinds.

    It returns L, the power of forces, the error of d/dt L_v - L_q - f relative to |f| + |L_q| + 1, and the constraints.
    """
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
        [system.lagrangian, *(slopes.get(k, S.Zero) for k in range(2 * m)), *forces, *system.constraints],
        (*variables, system.time, *system.parameters),
    )

    def equations(motion: Sequence[Any], constants: Sequence[float]) -> tuple[Any, Any, Any]:
        places, rates, changes = map(np.array, motion)
        rate = flow(kinds, places, rates)
        second = flow(kinds, places, changes)
        second += flow(kinds, rate, rates) - flow(kinds, 0 * rate, rates)
        q, v, a = ([*map(mp.mpf, part[order].tolist())] for part in (places, rate, second))
        step, sides = mp.mpf("1e-15"), []
        for h in (-step, 0, step):
            moved = [x + h * y + h * h / 2 * z for x, y, z in zip(q, v, a, strict=True)]
            sides.append(tape([*moved, *(y + h * z for y, z in zip(v, a, strict=True)), *map(mp.mpf, constants)]))
        before, (energy, *values), after = (np.array(side) for side in sides)
        torques, along, acting = values[:m], ((after - before) / (2 * step))[1 + m : 1 + 2 * m], values[2 * m : 3 * m]
        size = max(map(abs, torques)) + max(map(abs, acting)) + 1
        return energy, np.dot(acting, v), np.abs(along - torques - acting).max() / size, list(values[3 * m :])

    return equations


if __name__ == "__main__":
    import tempfile

    import scvi_codegen as sc

    with tempfile.TemporaryDirectory() as scratch:
        recorded: dict[str, list[Motion]] = {"mjcf": [], "urdf": []}
        for seed in range(SEEDS):
            path = Mjcf(seed).write(Path(scratch))
            recorded["mjcf"].append(by_mujoco(sc.LagrangianSystem.from_mjcf(path, actuators=True), path))
            robot = Urdf(seed)
            recorded["urdf"].append(by_pinocchio(robot.write(Path(scratch)), robot.floating, robot.mimics))
    RECORDED.write_text(json.dumps(recorded) + "\n")
