"""Elements and attributes of MJCF and URDF: which are read, which are ignored, and which are refused.

https://mujoco.readthedocs.io/en/stable/XMLreference.html and https://docs.ros.org/en/rolling/p/urdfdom. Attributes that
are read are those of the motion, and those of parts that are reported as missing in it (limits, friction, contacts,
actuators). Attributes that are ignored do not change the motion.
"""

import re
from collections.abc import Mapping


class Kind:
    """Attributes and children of an element.

    Args:
        read: names of the attributes that are read.
        ignored: names of those without effect on the motion.
        refused: neutral values (several words are alternatives) of attributes that are not read and change the motion.
        children: tags of the children. ``tag*`` may be repeated, ``tag=kind`` is of another kind than its tag;
            ``tag~`` is not checked, nor what it contains, ``tag!`` is refused; both may be repeated.
        defaults: name of the defaults of its attributes.
    """

    def __init__(
        self,
        read: str = "",
        ignored: str = "",
        refused: Mapping[str, str] | None = None,
        children: str = "",
        defaults: str = "",
    ) -> None:
        self.refused, self.defaults = refused or {}, defaults
        self.attributes = {*read.split(), *ignored.split(), *self.refused}
        parsed = [re.fullmatch(r"(\w+)(?:=(\w+))?([*~!]?)", child).groups() for child in children.split()]  # type: ignore[union-attr]
        self.children = {tag: {"~": "unchecked", "!": "refused"}.get(mark, kind or tag) for tag, kind, mark in parsed}
        self.repeated = {tag for tag, _, mark in parsed if mark}


TURN = "quat axisangle euler xyaxes zaxis"
"""Attributes of orientation."""
SOFTNESS = "solref solimp"
SENSELESS = "group user margin solreflimit solimplimit solreffriction solimpfriction"
"""Attributes of joints and tendons without effect on the motion without limits and friction."""
BODIES = "body* frame* geom* site* camera~ light~ attach* replicate* composite! flexcomp! plugin!"
JOINTS = "inertial joint* freejoint"
TENDON = Kind(
    "name class limited range frictionloss stiffness damping armature springlength",
    f"{SENSELESS} width material rgba actuatorfrcrange actuatorfrclimited",
    {"springyield": "0"},
    "joint~ site~ geom~ pulley~",
    "tendon",
)
EQUALITY = Kind("name class active", f"{SOFTNESS} tendon1 tendon2 polycoef flex cell", defaults="equality")
ACTUATORS = {
    "general": "ctrllimited actdim actlimited actrange biasprm biastype dynprm dyntype gainprm gaintype inheritrange",
    "motor": "ctrllimited",
    "position": "ctrllimited dampratio inheritrange kp kv timeconst",
    "velocity": "ctrllimited kv",
    "intvelocity": "ctrllimited actlimited actrange dampratio inheritrange kp kv",
    "damper": "kv",
    "cylinder": "ctrllimited area bias diameter timeconst",
}
"""Actuators that are read, with the attributes that not all of them have."""
ACTUATED = (
    "name class joint jointinparent tendon site refsite gear armature damping ctrlrange forcelimited "
    "forcerange delay group",
    "actearly body cranklength cranksite ffrange input interp lengthrange nsample slidersite user velrange",
)
OTHERS = "orientation pid muscle adhesion dcmotor plugin"
"""Actuators that are not read."""
ACTING = [*ACTUATORS, *(f"{tag}=other_actuator" for tag in OTHERS.split())]

MJCF = {
    "mujoco": Kind(
        "model",
        children="compiler* option* default* worldbody* deformable* equality* tendon* actuator* contact* asset* "
        "custom~ extension~ keyframe* sensor~ size~ statistic~ visual~",
    ),
    "compiler": Kind(
        "angle assetdir autolimits balanceinertia boundinertia boundmass eulerseq inertiafromgeom inertiagrouprange "
        "meshdir settotalmass strippath",
        "alignfree conflict convexhull discardvisual exactmeshinertia fitaabb fusestatic passthrough savecanonical "
        "savecompiled saveinertial texturedir usethread",
        {"coordinate": "local"},
        "lengthrange~",
    ),
    "option": Kind(
        "gravity density viscosity actuatorgroupdisable",
        "apirate ccd_iterations ccd_tolerance collision cone impratio integrator iterations "
        "jacobian ls_iterations ls_tolerance magnetic mpr_iterations mpr_tolerance noslip_iterations noslip_tolerance "
        "o_friction o_margin o_solimp o_solref sdf_initpoints sdf_iterations sleep_tolerance solver timestep tolerance",
        {"wind": "0"},
        "flag",
    ),
    "flag": Kind(
        "actuation clampctrl constraint contact damper equality filterparent frictionloss gravity limit spring",
        "autoreset diagexact energy eulerdamp fwdinv invdiscrete ipc island midphase multiccd "
        "nativeccd override refsafe sensor sensornoise sleep speculative warmstart",
        {"passive": "enable"},
    ),
    "default": Kind(
        "class",
        children="default* joint geom site equality=any_equality tendon=spatial mesh texture~ material~ "
        f"camera~ light~ pair {' '.join(ACTING)}",
    ),
    "asset": Kind(children="model=asset_model* mesh* hfield~ skin~ texture~ material~"),
    "mesh": Kind(
        "name class file vertex face scale refpos refquat inertia maxhullvert builtin content_type material normal "
        "params smoothnormal texcoord",
        children="plugin~",
        defaults="mesh",
    ),
    "asset_model": Kind("name file", "content_type"),
    "worldbody": Kind(children=BODIES),
    "body": Kind(f"name childclass pos {TURN} gravcomp mocap", "fuse simple sleep user", None, f"{BODIES} {JOINTS}"),
    "frame": Kind(f"name childclass pos {TURN}", "", None, f"{BODIES} {JOINTS}"),
    "replicate": Kind("childclass count euler offset sep", children=f"{BODIES} {JOINTS}"),
    "attach": Kind("model body frame prefix"),
    "inertial": Kind(f"pos {TURN} mass diaginertia fullinertia"),
    "joint": Kind(
        "name class type pos axis ref stiffness springref damping springdamper armature frictionloss limited range "
        "actuatorgravcomp",
        f"{SENSELESS} actuatorfrcrange actuatorfrclimited",
        {"springyield": "0"},
        defaults="joint",
    ),
    "freejoint": Kind("name", "align group"),
    "geom": Kind(
        f"name class type pos {TURN} fromto size mass density shellinertia mesh group contype conaffinity "
        "fluidcoef fluidshape condim friction priority",
        "adhesion castshadow fitscale gap hfield margin material rgba solimp solmix solref surfacevel user",
        None,
        "plugin!",
        "geom",
    ),
    "site": Kind(f"name class type pos {TURN} fromto size", "group material mesh rgba user", defaults="site"),
    "deformable": Kind(children="flex! skin~"),
    "equality": Kind(
        children="connect* weld* joint=coupling* tendon=coupling* flex=any_equality* flexstrain=any_equality* "
        "flexvert=any_equality*"
    ),
    "any_equality": EQUALITY,
    "connect": Kind("name class active body1 body2 anchor site1 site2", SOFTNESS, defaults="equality"),
    "weld": Kind(
        "name class active body1 body2 relpose site1 site2 torquescale", f"{SOFTNESS} anchor", defaults="equality"
    ),
    "coupling": Kind("name class active joint1 joint2 tendon1 tendon2 polycoef", SOFTNESS, defaults="equality"),
    "tendon": Kind(children="spatial* fixed*"),
    "spatial": TENDON,
    "fixed": TENDON,
    "actuator": Kind(children="* ".join([*ACTING, ""])),
    **{tag: Kind(f"{ACTUATED[0]} {own}", ACTUATED[1], defaults="actuator") for tag, own in ACTUATORS.items()},
    "other_actuator": Kind(
        ACTUATED[0],
        f"{ACTUATED[1]} {' '.join(ACTUATORS.values())} cogging controller force fpmax fvmax gain imax inductance "
        "instance ki lmax lmin lugre motorconst nominal plugin posrange range resistance saturation scale slewmax "
        "tausmooth thermal vmax",
        None,
        "config~",
        "actuator",
    ),
    "contact": Kind(children="pair* exclude~"),
    "pair": Kind(
        "name class geom1 geom2 condim friction",
        f"{SOFTNESS} adhesion solreffriction surfacevel margin gap",
        defaults="pair",
    ),
    "keyframe": Kind(children="key*"),
    "key": Kind("name qpos qvel ctrl act", "mpos mquat plastic time"),
}
"""Kinds of elements of MJCF, by tag or by the name that their parent calls them."""

URDF = {
    "robot": Kind(
        "name",
        "version",
        None,
        "link* joint* transmission~ ros2_control~ material~ gazebo~ sensor~ mujoco~ group~ frame~",
    ),
    "link": Kind(
        "name",
        "type",
        None,
        "inertial collision~ visual~ contact~ collision_checking~ gravity~ kinematic~ self_collision_checking~ "
        "self_filter~ surface~",
    ),
    "inertial": Kind(children="origin mass inertia"),
    "mass": Kind("value"),
    "inertia": Kind("ixx ixy ixz iyy iyz izz"),
    "origin": Kind("xyz rpy", "", {"quat_xyzw": "none"}),
    "joint": Kind(
        "name type",
        "dont_collapse",
        None,
        "parent child origin axis dynamics limit mimic joint_properties calibration~ safety_controller~",
    ),
    "parent": Kind("link"),
    "child": Kind("link"),
    "axis": Kind("xyz", "", {"rpy": "0"}),
    "dynamics": Kind("damping friction spring_reference spring_stiffness", "D K mu_coulomb mu_viscous"),
    "joint_properties": Kind("damping friction"),
    "limit": Kind("lower upper", "effort velocity acceleration deceleration jerk command_effort current gear_velocity"),
    "mimic": Kind("joint multiplier offset"),
}
"""Kinds of elements of URDF, by tag."""
