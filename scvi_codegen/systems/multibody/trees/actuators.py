"""Actuators of MJCF: forces of controls, which are inputs, along the lengths of joints and tendons.

With l = gear times the length and the control u, F = (g0 + g1 l + g2 l_dot) u + b0 + b1 l + b2 l_dot = a + b l_dot acts
along l, f = -dD/dv by the Rayleigh function D = -(a l_dot + b l_dot^2/2). If F is clamped, D = -(Q(a + b l_dot) -
Q(a))/b with its integral Q. https://mujoco.readthedocs.io/en/stable/computation/index.html#actuation-model
"""

from collections.abc import Mapping, Sequence
from itertools import chain

from sympy import Add, Expr

from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.kinks import positive_part
from scvi_codegen.systems.formulas.symbols import input_parameters, symbol
from scvi_codegen.systems.multibody.trees.document import Element
from scvi_codegen.systems.multibody.trees.energies import exact_number
from scvi_codegen.systems.multibody.trees.schema import Kind
from scvi_codegen.systems.multibody.trees.tendons import Tendon, length_of, rate_of
from scvi_codegen.systems.multibody.trees.tree import Link, identifier, numbered, symbols_of

Range = tuple[float, float] | None
Actuator = tuple[str, str, Range, Expr]  # name in the file, name and range of the input, Rayleigh function
NONE = (0.0, 0.0, 0.0)
ABSENT = Kind(refused={"dyntype": "none", "timeconst": "0", "delay": "0"})
OF_SERVOS = Kind(refused={"dampratio": "0", "inheritrange": "0"})


def actuator_of(
    links: Sequence[Link],
    element: Element,
    tendon: Tendon,
    others: Mapping[str, str],
    controls: Range,
    forces: Range,
    inverse: float,
) -> Actuator:
    """Return the actuator of an element, with these ranges, on a tendon; a joint is a tendon with one factor, 1.

    ``others``: inputs of the actuators before it by name, and no text by the names of those after it.
    ``inverse``: entry of M^-1 of the joint in the reference configuration, for the damping 2 z sqrt(g0/inverse)/gear of
    a ratio z.
    """
    gear = float(element.vector("gear", (1,), range(1, 7))[0])
    gain, bias = _coefficients(element)
    if ratio := element.number("dampratio", 0, 0):
        if element.has("tendon") or element.has("kv") or gain[0] < 0 or gear == 0:
            element.refuse("has a dampratio, which is read of joints with gear, kp >= 0 and without kv: give kv alone")
        bias = (*bias[:2], -2 * ratio * (gain[0] / inverse) ** 0.5 / abs(gear))
    forces = _clamped(forces, tendon.pull, gear)
    if not (any(gain[1:]) or any(bias)):
        controls, forces = _clamped(controls, forces, gain[0]), None
    if forces is not None and gain[2]:
        element.refuse("has a gain that depends on the velocity, and a range of the force: omit one")
    if others.get(label := element.node.get("name", "")):
        element.refuse("is the second actuator of this name: rename one")
    part = element.text("joint", element.text("jointinparent", element.text("tendon", "")))
    label = label or next(x for x in numbered(part) if x not in others)
    taken = {x for link in links for x in symbols_of(link.joint.kind, link.joint.name)}
    taken |= {*(inputs := [*filter(None, others.values())]), *input_parameters(inputs)}
    names = chain([identifier(label)], numbered(f"ctrl_{identifier(label)}"))
    name = next(x for x in names if taken.isdisjoint({x, *input_parameters([x])}))
    length = exact_number(gear) * length_of(links, tendon)
    a, b, c = (exact_number(g) * symbol(name) + exact_number(b) for g, b in zip(gain, bias, strict=True))
    rate = intermediate(rate_of(links, length))
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


def _clamped(inner: Range, outer: Range, factor: float) -> Range:
    """Return the range of numbers x that are clamped to ``inner``, and then factor x to ``outer``."""
    if outer is None or factor == 0:
        return inner
    low, high = sorted(x / factor for x in outer)
    return (low, high) if inner is None else (min(max(inner[0], low), high), min(max(inner[1], low), high))


def _coefficients(element: Element) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the coefficients of 1, length and velocity of gain and bias."""
    element.check_neutral(ABSENT)
    if element.tag != "position":
        element.check_neutral(OF_SERVOS)
    if element.tag == "motor":
        return (1.0, 0.0, 0.0), NONE
    if element.text("kind", element.tag) != element.tag:
        element.refuse(f"has gains of <{element.text('kind')}> by its class: write them out")
    keys = (("gainprm", (1.0, *NONE)), ("biasprm", NONE))
    gain, bias = ((*map(float, element.vector(key, x, range(1, 11))), *NONE)[:3] for key, x in keys)
    if element.tag == "position":
        stiffness = element.number("kp", gain[0])
        return (stiffness, 0.0, 0.0), (0.0, -stiffness, -element.number("kv", 0))
    if element.tag == "velocity":
        return (element.number("kv", gain[0]), 0.0, 0.0), (0.0, 0.0, -element.number("kv", gain[0]))
    if element.tag != "general":
        element.refuse("is not read as an actuator: general, motor, position, velocity are")
    gain = gain if element.choice("gaintype", "fixed", "affine") == "affine" else (gain[0], 0.0, 0.0)
    bias = bias if element.choice("biastype", "none", "affine") == "affine" else NONE
    if bias[2] > 0 and bias[1] == -gain[0]:
        element.refuse(f"has biasprm='{element.text('biasprm')}', a damping ratio of the mass matrix: give kv")
    return gain, bias
