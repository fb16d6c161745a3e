"""Actuators of MJCF: forces of controls, which are inputs, along joints and tendons, and on sites.

With l = gear times the length and the control u, F = (g0 + g1 l + g2 l_dot) u + b0 + b1 l + b2 l_dot, clamped to a
range, acts along l. https://mujoco.readthedocs.io/en/stable/computation/index.html#actuation-model

The gear of a site, ball or free joint is a wrench (f, tau) with l_dot = f . v + tau . w for the velocity v and angular
velocity w, and l = f . x + tau . a, with the position x and rotation vector a, of ball joints and relative to another
site, else 0. With the axes R of the site and K = hat(tau) R, which does not move, tau . w = d/dt tr(K^T R)/2.
"""

from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from sympy import Add, Expr, Matrix, S

from scvi_codegen.api.formulas import DOT, Intermediate, input_parameters, symbol
from scvi_codegen.extras.robots.trees.closures import frames_in_common
from scvi_codegen.extras.robots.trees.document import Element
from scvi_codegen.extras.robots.trees.energies import (
    as_quantities,
    between,
    exact_number,
    exact_vector,
    position_of,
    positive_part,
    rotation_of,
    rotation_vector,
)
from scvi_codegen.extras.robots.trees.schema import ACTUATORS, Kind
from scvi_codegen.extras.robots.trees.tendons import Tendon, length_of, rate_of
from scvi_codegen.extras.robots.trees.tree import SINGLE, Joint, Link, Pose, Vector, identifier, numbered, symbols_of

Motion = tuple[Expr, Expr]
"""Length of an actuator and its rate, times the gear."""
Range = tuple[float, float] | None
Actuator = tuple[str, str, Range, tuple[Expr, Expr]]
"""Name in the file, name and range of the input, force, and the rate along which it acts."""
JOINTED = "joint", "jointinparent"
ACTED = *JOINTED, "tendon", "site"
ABSENT = Kind(refused={"dyntype": "none integrator filter filterexact", "delay": "0"})
TYPES: dict[str, tuple[str, ...]] = {
    "general": (),
    "motor": ("fixed", "none", "none"),
    "position": ("fixed", "affine", "none"),
    "intvelocity": ("fixed", "affine", "integrator"),
    "velocity": ("fixed", "affine", "none"),
    "damper": ("affine", "none", "none"),
    "cylinder": ("fixed", "affine", "filter"),
}
"""Values of ``gaintype``, ``biastype`` and ``dyntype`` of ``<general>`` that other actuators set."""
OF_LAWS = "kind", "gaintype", "gainprm", "biastype", "biasprm", "dyntype", "inheritrange"
"""Attributes that an actuator inherits of classes that its own kind or ``<general>`` wrote, ``kind``."""


def motion_of(links: Sequence[Link], part: Joint | Tendon, gear: Vector, in_parent: bool) -> Motion:
    """Return the motion of a joint or tendon; torques on ball and free ones are in the frame of the body or parent."""
    if isinstance(part, Tendon) or part.kind in SINGLE:
        length = exact_number(gear[0]) * (length_of(links, part) if isinstance(part, Tendon) else symbol(part.name))
        return length, rate_of(links, length)
    force, torque = (exact_vector(x) for x in (gear[:3], gear[3:] if part.kind == "free" else gear[:3]))
    axes, spin = Matrix(3, 3, rotation_of(part).entries), Matrix(rotation_of(part).rates)
    rate = torque.dot(axes * spin if in_parent else spin)
    if part.kind == "ball":
        return torque.dot(rotation_vector(axes)[0]), rate
    return S.Zero, rate + force.dot(Matrix([symbol(name + DOT) for name in position_of(part)]))


def motion_of_sites(links: Sequence[Link], ends: Sequence[tuple[int, Pose]], gear: Vector) -> Motion:
    """Return the motion of a site along a wrench in its frame, or relative to a second site in the frame of this."""
    (place, axes), (origin, others) = frames_in_common(links, [*ends, (-1, Pose())][:2])
    own = others if ends[1:] else axes
    force, torque = (exact_vector(part) for part in (gear[:3], gear[3:]))
    across = as_quantities(own * torque).hat() / 2
    loads = [*as_quantities(own * force), *as_quantities(across * axes), *as_quantities(across * others)]
    held = [symbol(f"load {k}") if load != 0 else S.Zero for k, load in enumerate(loads)]
    rate = rate_of(links, Matrix(held).dot(Matrix([*(place - origin), *axes, *-others])))
    turn = rotation_vector(as_quantities(others.T * axes))[0]
    length = force.dot(others.T * (place - origin)) + torque.dot(turn) if ends[1:] else S.Zero
    return Intermediate.named(length), rate.xreplace(dict(zip(held, loads, strict=True)))


def actuator_of(
    links: Sequence[Link],
    element: Element,
    motion: Motion,
    gear: float,
    others: Mapping[str, str],
    controls: Range,
    forces: Range,
    inverse: float | None,
) -> Actuator:
    """Return the actuator of an element, with these ranges, along a motion, of which joints and tendons have one gear.

    ``others``: inputs of the actuators before it by name, and no text by the names of those after it.
    ``inverse``: entry of M^-1 of a hinge or slide at the reference, for the damping 2 z sqrt(g0/inverse)/gear of
    a ratio z.
    """
    gain, bias = _gain_and_bias(element)
    if ratio := damping_ratio(element):
        if inverse is None or gain[0] < 0 or gear == 0:
            element.refuse("has a dampratio, which hinges and slides with gear and kp >= 0 may have: give kv")
        bias[2] = -2 * ratio * (gain[0] / inverse) ** 0.5 / abs(gear)
    if not (any(gain[1:]) or any(bias)):
        controls, forces = clamped(controls, forces, gain[0]), None
    if others.get(label := element.node.get("name", "")):
        element.refuse("is the second actuator of this name: rename one")
    part = next(element.text(key) for key in ACTED if element.has(key))
    label = label or next(x for x in numbered(part) if x not in others)
    taken = {x for link in links for x in symbols_of(link.joint.kind, link.joint.name)}
    taken |= {*(inputs := [*filter(None, others.values())]), *input_parameters(inputs)}
    names = chain([identifier(label)], numbered(f"ctrl_{identifier(label)}"))
    name = next(x for x in names if taken.isdisjoint({x, *input_parameters([x])}))
    at, along, against = (exact_number(g) * symbol(name) + exact_number(b) for g, b in zip(gain, bias, strict=True))
    length, rate = motion[0], Intermediate.named(motion[1])
    return label, name, controls, (between(at + along * length + against * rate, forces), rate)


def in_shared_ranges(
    acting: Sequence[Actuator], targets: Sequence[tuple[str, str]], tendons: Sequence[Tendon]
) -> list[Actuator]:
    """Return the actuators, several of a tendon with forces scaled so that their sum is in its range around 0."""
    shared = [*acting]
    for tendon in tendons:
        places = [k for k, target in enumerate(targets) if target == ("tendon", tendon.name)]
        total, scale = Intermediate.named(Add(*(acting[k][3][0] for k in places))), S.One
        for bound in map(exact_number, tendon.pull if tendon.pull and len(places) > 1 else ()):
            sign = 1 if bound > 0 else -1
            scale *= bound / (bound + sign * positive_part(sign * (total - bound)))
        for k in places:
            label, name, controls, (force, rate) = acting[k]
            shared[k] = label, name, controls, (force * scale, rate)
    return shared


def clamped(inner: Range, outer: Range, factor: float) -> Range:
    """Return the range of numbers x that are clamped to ``inner``, and then factor x to ``outer``."""
    if outer is None or factor == 0:
        return inner
    low, high = sorted(x / factor for x in outer)
    return (low, high) if inner is None else (min(max(inner[0], low), high), min(max(inner[1], low), high))


def coefficients_of(element: Element) -> list[Vector]:
    """Return the coefficients of 1, length and velocity of gain and bias."""
    defaults = ("gainprm", (1,)), ("biasprm", (0,))
    return [np.append(element.vector(key, x, range(1, 11)), np.zeros(2))[:3] for key, x in defaults]


def is_servo(element: Element) -> bool:
    """Return whether the force is g0 (u - l) and damping."""
    gain, bias = coefficients_of(element)
    return bool(gain[0] == -bias[1]) and element.text("biastype", "none") == "affine"


def damping_ratio(element: Element) -> float:
    """Return the damping ratio of a servo, the third number of its bias if it is > 0."""
    return max(0.0, float(coefficients_of(element)[1][2])) if is_servo(element) else 0.0


def inherited_by(tag: str, defaults: Mapping[str, str]) -> dict[str, str]:
    """Return those attributes of a class that an actuator inherits."""
    kept = tag == "general" or defaults.get("kind", "general") in ("general", tag)
    return {key: value for key, value in defaults.items() if kept or key not in OF_LAWS}


def _motor(_: Element, gain: Vector, bias: Vector) -> None:
    gain[0] = 1


def _servo(element: Element, gain: Vector, bias: Vector) -> None:
    gain[0] = element.number("kp", gain[0])
    ratio = element.number("dampratio", least=0) if element.has("dampratio") else bias[2]
    bias[:] = 0, -gain[0], -element.number("kv", least=0) if element.has("kv") else ratio


def _velocity(element: Element, gain: Vector, bias: Vector) -> None:
    gain[0] = element.number("kv", gain[0])
    bias[:] = 0, 0, -gain[0]


def _damper(element: Element, gain: Vector, bias: Vector) -> None:
    slope = gain[2] if element.text("gaintype", "fixed") == "affine" else 0.0
    gain[:] = 0, 0, -element.number("kv", -slope, 0)
    element.node.attrib["ctrllimited"] = "true"
    if element.vector("ctrlrange", (0, 0), (2,)).min() < 0:
        element.refuse(f"has ctrlrange='{element.text('ctrlrange')}', which must not be < 0")


def _cylinder(element: Element, gain: Vector, bias: Vector) -> None:
    area = element.number("area", gain[0])
    gain[0] = np.pi / 4 * element.number("diameter") ** 2 if element.has("diameter") else area
    bias[:] = element.vector("bias", bias.tolist())


WRITTEN = {
    "motor": _motor,
    "position": _servo,
    "intvelocity": _servo,
    "velocity": _velocity,
    "damper": _damper,
    "cylinder": _cylinder,
}
"""Functions that write the attributes of an actuator into gain and bias, by its tag."""


def as_general(element: Element) -> None:
    """Write gain, bias and activation of an actuator, over inherited ones, as those of ``<general>``.

    https://mujoco.readthedocs.io/en/stable/XMLreference.html#actuator
    """
    attributes, (gain, bias) = element.node.attrib, coefficients_of(element)
    law = element.text("dyntype", "none") if attributes.get("kind") == "position" else "none"
    if element.has("kv") and element.has("dampratio"):
        element.refuse("has kv and dampratio: one is needed")
    if element.tag in WRITTEN:
        WRITTEN[element.tag](element, gain, bias)
    attributes |= zip(("gaintype", "biastype", "dyntype"), TYPES.get(element.tag, (element.tag,)), strict=False)
    if element.tag == "position":
        filtered = element.number("timeconst", law == "filterexact", 0)
        attributes["dyntype"] = "filterexact" if filtered else "none"
    attributes |= {"gainprm": " ".join(map(repr, gain.tolist())), "biasprm": " ".join(map(repr, bias.tolist()))}
    attributes["kind"] = element.tag
    for key in ("kp", "kv", "dampratio", "timeconst", "area", "diameter", "bias"):
        attributes.pop(key, None)


def activation_of(element: Element) -> str:
    """Return the law of the activation a, the state of an actuator that acts in place of its control u, or ``none``.

    It is a' = u (``integrator``) or a' = (u - a)/timeconst (``filter``, ``filterexact``).
    """
    element.check_neutral(ABSENT)
    law = element.text("dyntype", "none")
    if element.number("actdim", -1) not in (-1, law != "none"):
        element.refuse(f"has actdim='{element.text('actdim')}', but {law != 'none':d} activations by its dyntype")
    return law


def _gain_and_bias(element: Element) -> list[Vector]:
    if element.tag not in ACTUATORS:
        element.refuse(f"is not read as an actuator: {', '.join(ACTUATORS)} are; remove it, or actuators=False")
    gain, bias = coefficients_of(element)
    varies = element.choice("gaintype", "fixed", "affine") == "affine"
    return [gain * [1, varies, varies], bias * (element.choice("biastype", "none", "affine") == "affine")]
