"""Actuators of MJCF: forces of controls, which are inputs, along joints and tendons, and on sites.

With l = gear times the length and the control u, F = (g0 + g1 l + g2 l_dot) u + b0 + b1 l + b2 l_dot = a + b l_dot acts
along l, f = -dD/dv by the Rayleigh function D = -(a l_dot + b l_dot^2/2). If F is clamped, D = -(Q(a + b l_dot) -
Q(a))/b with its integral Q. https://mujoco.readthedocs.io/en/stable/computation/index.html#actuation-model

The gear of a site, ball or free joint is a wrench (f, tau) with l_dot = f . v + tau . w for the velocity v and angular
velocity w, and l = f . x + tau . a, with the position x and rotation vector a, of ball joints and relative to another
site, else 0. With the axes R of the site and K = hat(tau) R, which does not move, tau . w = d/dt tr(K^T R)/2.
"""

from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from sympy import Add, Expr, Matrix, S

from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.kinks import positive_part
from scvi_codegen.systems.formulas.symbols import DOT, input_parameters, symbol
from scvi_codegen.systems.multibody.trees.closures import frames_in_common
from scvi_codegen.systems.multibody.trees.document import Element
from scvi_codegen.systems.multibody.trees.energies import (
    as_quantities,
    exact_number,
    exact_vector,
    position_of,
    rotation_of,
    rotation_vector,
)
from scvi_codegen.systems.multibody.trees.schema import Kind
from scvi_codegen.systems.multibody.trees.tendons import Tendon, length_of, rate_of
from scvi_codegen.systems.multibody.trees.tree import (
    SINGLE,
    Joint,
    Link,
    Pose,
    Vector,
    identifier,
    numbered,
    symbols_of,
)

Motion = tuple[Expr, Expr]
"""Length of an actuator and its rate, times the gear."""
Range = tuple[float, float] | None
Actuator = tuple[str, str, Range, Expr]  # name in the file, name and range of the input, Rayleigh function
READ = "general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder"
JOINTED = "joint", "jointinparent"
ACTED = *JOINTED, "tendon", "site"
NONE = (0.0, 0.0, 0.0)
ABSENT = Kind(refused={"dyntype": "none integrator filter filterexact", "delay": "0"})
OF_SERVOS = Kind(refused={"dampratio": "0", "inheritrange": "0"})


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
    return intermediate(length), rate.xreplace(dict(zip(held, loads, strict=True)))


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
    gain, bias = _coefficients(element)
    if ratio := element.number("dampratio", 0, 0):
        if inverse is None or element.has("kv") or gain[0] < 0 or gear == 0:
            element.refuse(
                "has a dampratio, which hinges and slides with gear, kp >= 0 and no kv may have: give kv alone"
            )
        bias = (*bias[:2], -2 * ratio * (gain[0] / inverse) ** 0.5 / abs(gear))
    if not (any(gain[1:]) or any(bias)):
        controls, forces = clamped(controls, forces, gain[0]), None
    if forces is not None and gain[2]:
        element.refuse("has a gain that depends on the velocity, and a range of the force: omit one")
    if others.get(label := element.node.get("name", "")):
        element.refuse("is the second actuator of this name: rename one")
    part = next(element.text(key) for key in ACTED if element.has(key))
    label = label or next(x for x in numbered(part) if x not in others)
    taken = {x for link in links for x in symbols_of(link.joint.kind, link.joint.name)}
    taken |= {*(inputs := [*filter(None, others.values())]), *input_parameters(inputs)}
    names = chain([identifier(label)], numbered(f"ctrl_{identifier(label)}"))
    name = next(x for x in names if taken.isdisjoint({x, *input_parameters([x])}))
    a, b, c = (exact_number(g) * symbol(name) + exact_number(b) for g, b in zip(gain, bias, strict=True))
    length, rate = motion[0], intermediate(motion[1])
    return label, name, controls, _dissipation(a + b * length, c, rate, forces)


def _dissipation(at_rest: Expr, slope: Expr, rate: Expr, forces: Range) -> Expr:
    """Return the Rayleigh function of the force at_rest + slope rate, clamped to a range."""
    if forces is None:
        return -(at_rest * rate + slope * rate**2 / 2)
    low, high = map(exact_number, forces)
    if slope == 0:
        return -rate * (at_rest - positive_part(at_rest - high) + positive_part(low - at_rest))
    force = at_rest + slope * rate
    return -(force**2 - Add(*(x * positive_part(x) for x in (force - high, low - force)))) / (2 * slope)


def clamped(inner: Range, outer: Range, factor: float) -> Range:
    """Return the range of numbers x that are clamped to ``inner``, and then factor x to ``outer``."""
    if outer is None or factor == 0:
        return inner
    low, high = sorted(x / factor for x in outer)
    return (low, high) if inner is None else (min(max(inner[0], low), high), min(max(inner[1], low), high))


def activation_of(element: Element) -> str:
    """Return the law of the activation a, the state of an actuator that acts in place of its control u, or ``none``.

    It is a' = u (``integrator``) or a' = (u - a)/timeconst (``filter``, ``filterexact``).
    """
    element.check_neutral(ABSENT)
    constants = element.vector("timeconst", (0,), (1, 2))
    if constants.min() < 0:
        element.refuse(f"has timeconst='{element.text('timeconst')}', which must not be < 0")
    filtered = element.tag == "position" and constants.any()
    implied = {"intvelocity": "integrator", "cylinder": "filter", "general": element.text("dyntype", "none")}
    return "filterexact" if filtered else implied.get(element.tag, "none")


def _coefficients(element: Element) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the coefficients of 1, length and velocity of gain and bias."""
    if element.tag != "position":
        element.check_neutral(OF_SERVOS)
    if element.tag == "motor":
        return (1.0, 0.0, 0.0), NONE
    if element.text("kind", element.tag) != element.tag:
        element.refuse(f"has gains of <{element.text('kind')}> by its class: write them out")
    keys = (("gainprm", (1.0, *NONE)), ("biasprm", NONE))
    gain, bias = ((*map(float, element.vector(key, x, range(1, 11))), *NONE)[:3] for key, x in keys)
    if element.tag in ("position", "intvelocity"):
        stiffness = element.number("kp", gain[0])
        return (stiffness, 0.0, 0.0), (0.0, -stiffness, -element.number("kv", 0))
    if element.tag == "velocity":
        return (element.number("kv", gain[0]), 0.0, 0.0), (0.0, 0.0, -element.number("kv", gain[0]))
    if element.tag == "damper":
        return (0.0, 0.0, -element.number("kv", 0, 0)), NONE
    if element.tag == "cylinder":
        area = (
            np.pi / 4 * element.number("diameter") ** 2 if element.has("diameter") else element.number("area", gain[0])
        )
        return (area, 0.0, 0.0), tuple(map(float, element.vector("bias", bias)))
    if element.tag != "general":
        element.refuse(f"is not read as an actuator: {', '.join(READ)} are; remove it, or actuators=False")
    gain = gain if element.choice("gaintype", "fixed", "affine") == "affine" else (gain[0], 0.0, 0.0)
    bias = bias if element.choice("biastype", "none", "affine") == "affine" else NONE
    if bias[2] > 0 and bias[1] == -gain[0]:
        element.refuse(f"has biasprm='{element.text('biasprm')}', a damping ratio of the mass matrix: give kv")
    return gain, bias
