"""Systems beyond the catalogue, generic states, and compiled steppers shared between tests."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from notation import hamilton, lagrange
from oracle import Mechanics, numbers, oracle_step

from scvi_codegen import HamiltonianSystem, LagrangianSystem, Stepper, compile_stepper, problem
from scvi_codegen.codegen.ir.equations import FixedPointIteration
from scvi_codegen.codegen.ir.program import Program
from scvi_codegen.codegen.lowering.program import iteration_of, lower
from scvi_codegen.codegen.native.building import FLAGS_VARIABLE, TUNED_FLAGS
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.methods.method import Method
from scvi_codegen.runs.ensembles.ensemble import Ensemble, EnsembleSettings
from scvi_codegen.runs.ensembles.individual import runs_of
from scvi_codegen.runs.states.validation import States
from scvi_codegen.systems.system import MechanicalSystem


def lowered(system: MechanicalSystem, method: Method) -> Program:
    """The program with Newton's iteration alone."""
    return lower(system, method, prefix="p", solver="newton")


def fixed_point(system: MechanicalSystem, method: Method) -> FixedPointIteration | None:
    """The fixed-point iteration, if there is one."""
    return iteration_of(system, discretise(system, method))


def ensemble_runs(
    stepper: Stepper, q: States, p: States | None, *, velocity: States | None = None, **settings: Any
) -> Any:
    """The runs of an ensemble, before its first step, of arguments of ``integrate_ensemble``."""
    return runs_of(Ensemble.of(stepper, q, p, EnsembleSettings(**settings), velocity=velocity))


def oscillator() -> LagrangianSystem:
    """A mass of 1 on a spring of 1: a method of any degree keeps its energy."""
    return LagrangianSystem.from_text(name="oscillator", coordinates=["q"], lagrangian="q_dot**2/2 - q**2/2")


def driven_duffing() -> LagrangianSystem:
    return problem("duffing").system.with_parameters(gamma=0.7, omega=1.3)


def pumped_cart_pole() -> LagrangianSystem:
    """A cart and a pendulum whose rod is shortened and lengthened: the mass matrix depends on theta and on time."""
    text = """
        M*x_dot**2/2 - k*x**2/2 + m*g*l*(1 + a*sin(w*t))*cos(theta)
        + m*(x_dot + l*a*w*cos(w*t)*sin(theta) + l*(1 + a*sin(w*t))*cos(theta)*theta_dot)**2/2
        + m*(l*(1 + a*sin(w*t))*sin(theta)*theta_dot - l*a*w*cos(w*t)*cos(theta))**2/2
        """
    return lagrange("pumped cart and pole", "x theta", text, M=2.0, m=1.0, l=0.8, g=3.0, a=0.2, w=1.7, k=0.5)


def linkage() -> LagrangianSystem:
    """Four bars with friction and a motor: three constraints leave one of four coordinates."""
    return LagrangianSystem.from_text(
        name="four-bar linkage",
        coordinates=["x1", "y1", "x2", "y2"],
        lagrangian="m*(x1_dot**2 + y1_dot**2 + x2_dot**2 + y2_dot**2 + x1_dot*x2_dot/2)/2 - m*g*(y1 + y2)",
        parameters={"m": 1.0, "g": 9.81, "a": 1.0, "b": 2.0, "c": 1.5, "d": 2.0},
        constraints=["x1**2 + y1**2 = a**2", "(x2 - x1)**2 + (y2 - y1)**2 = b**2", "(x2 - d)**2 + y2**2 = c**2"],
        forces={"x2": "-0.1*x2_dot + sin(t)"},
    )


def two_rods() -> LagrangianSystem:
    """One mass below the other, the upper rod of changing length: constant masses, a step is one of RATTLE."""
    return LagrangianSystem.from_text(
        name="two rods",
        coordinates=["x1", "y1", "x2", "y2"],
        lagrangian="m*(x1_dot**2 + y1_dot**2)/2 + (x2_dot**2 + y2_dot**2)/2 - g*(m*y1 + y2)",
        parameters={"m": 2.0, "g": 3.0},
        constraints=["x1**2 + y1**2 = (1 + sin(t)/9)**2", "(x2 - x1)**2 + (y2 - y1)**2 = 1"],
    )


def sleigh() -> LagrangianSystem:
    """Chaplygin's, between springs: its blade at (x, y) goes where it points, its mass is d ahead of it."""
    text = """m*(x_dot**2 + y_dot**2)/2 + J*a_dot**2/2 + m*d*a_dot*(y_dot*cos(a) - x_dot*sin(a))
        - k*(x**2 + 2*y**2)/2"""
    return lagrange("sleigh", "x y a", text, constraints=["x_dot*sin(a) - y_dot*cos(a)"], m=1.3, J=0.7, d=0.2, k=0.5)


def earth_and_moon() -> LagrangianSystem:
    """Return the restricted three-body problem in the rotating frame."""
    distances = "(1 - mu)/sqrt((x + mu)**2 + y**2 + z**2) + mu/sqrt((x - 1 + mu)**2 + y**2 + z**2)"
    text = f"((x_dot - y)**2 + (y_dot + x)**2 + z_dot**2)/2 + {distances}"
    return lagrange("restricted three-body problem", "x y z", text, mu=1.215058560962404e-2)


def pushed_pendulum() -> LagrangianSystem:
    """Return a pendulum with a force u and a moving pivot w."""
    text = "q_dot**2/2 + (1 + w)*cos(q)"
    return lagrange("pushed pendulum", "q", text, forces={"q": "u - c*q_dot"}, inputs="u w", c=0.2)


def damped_pendulum() -> LagrangianSystem:
    """Return a pendulum on a cart with a spring; damping rate from two parameters, and explicit time in L."""
    text = "m*x_dot**2/2 + x_dot*a_dot*cos(a) + a_dot**2/2 - (1 + cos(t)/3)*x**2 + cos(a)"
    return lagrange("damped pendulum", "x a", text, damping="c*r", m=2.0, c=0.4, r=0.7)


def pumped_swing() -> HamiltonianSystem:
    """A Hamiltonian with time, rubbed and pushed."""
    text = "p**2/(2*l**2*(1 + a*sin(w*t))**2) - g*l*(1 + a*sin(w*t))*cos(q)"
    return hamilton(
        "pumped swing", "q", text, momenta="p", forces={"q": "-c*p + cos(t)"}, l=0.8, g=3.0, a=0.2, w=1.7, c=0.1
    )


def turning_wire() -> LagrangianSystem:
    """A bead on a straight wire that turns: one constraint, with time, on coordinates that the masses couple."""
    text = "((u_dot + v_dot)**2 + 2*(u_dot - v_dot)**2)/2 - k*(u**2 + 2*v**2 + u**4)"
    return lagrange("turning wire", "u v", text, constraints=["(u + v)*sin(w*t) = (u - v)*cos(w*t)"], w=0.8, k=3.0)


def tangle() -> LagrangianSystem:
    """Four coordinates that all meet, each pair in its own way: a mass matrix without zeros, potentials, time."""
    text = """
        a*x_dot**2 + (2 + sin(x*z))*y_dot**2/2 + b*(1 + w**2)*z_dot**2/2 + (3 + cos(y))*w_dot**2/2
        + (1 + x*y)*x_dot*y_dot/3 + cos(w)*x_dot*z_dot/2 + z*x_dot*w_dot/4 + (1 + z**2)*y_dot*z_dot/3
        + sin(x)*y_dot*w_dot/2 + y*z_dot*w_dot/3 + c*x*y*w_dot + sin(t)*z*y_dot
        - (x**4 + y**4 + z**4 + w**4)/4 - (x - z)**2 - x*y*w/2 - cos(2*y - w + t)
        """
    return lagrange("tangle", "x y z w", text, a=0.8, b=1.3, c=0.4)


def pumped_chain(count: int = 8) -> LagrangianSystem:
    """Neighbours that meet in masses, where pivots are exchanged, and in springs that change with time."""
    numbers, pairs = range(count), [(i, i + 1) for i in range(count - 1)]
    masses = [f"m*(1 + {i % 2})*x{i}_dot**2/2" for i in numbers] + [
        f"{3 - 2 * (i % 2)}*x{i}_dot*x{j}_dot" for i, j in pairs
    ]
    springs = [f"(x{j} - x{i})**4/4 + (1 + a*sin(w*t))*(x{j} - x{i})**2/2" for i, j in pairs]
    text = f"{' + '.join(masses)} - ({' + '.join(springs)}) - x0**2/2"
    return lagrange("pumped chain", [f"x{i}" for i in numbers], text, m=1.1, a=0.3, w=1.1)


def three_bodies() -> LagrangianSystem:
    """Three masses in the plane, each pair joined by a spring that is stiffer the longer it is."""
    pairs = (("a", "b"), ("b", "c"), ("a", "c"))
    kinetic = " + ".join(f"m_{body}*(x_{body}_dot**2 + y_{body}_dot**2)/2" for body in "abc")
    springs = [f"((x_{i} - x_{j})**2 + (y_{i} - y_{j})**2)" for i, j in pairs]
    text = kinetic + "".join(f" - k*{square}/2 - k*{square}**2/8" for square in springs)
    return lagrange(
        "three bodies", [f"{axis}_{body}" for body in "abc" for axis in "xy"], text, m_a=1.0, m_b=0.7, m_c=1.6, k=0.9
    )


def forced_cart_pole() -> LagrangianSystem:
    """A motor on the cart, friction in the joint, drag by the square of the cart's speed."""
    return LagrangianSystem.from_text(
        name="cart and pole with a motor",
        coordinates=["x", "theta"],
        lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*theta_dot*cos(theta) + m*l**2*theta_dot**2/2 + m*g*l*cos(theta)",
        parameters={"M": 2.0, "m": 1.0, "l": 0.8, "g": 3.0, "b": 0.3, "c": 0.4, "F": 1.5, "w": 1.7},
        forces={"x": "F*sin(w*t) - b*x_dot**3 - b*x*theta_dot"},
        dissipation="c*theta_dot**2*(1 + x**2)/2",
    )


def radial_friction() -> LagrangianSystem:
    """Friction along the radius, a mass that depends on place: no torque."""
    drag = "-c*{0}*(x*x_dot + y*y_dot)*(1 + x_dot**2 + y_dot**2)/(x**2 + y**2)"
    text = "(x_dot**2 + y_dot**2)*(1 + x**2 + y**2)/2 + 1/sqrt(x**2 + y**2)"
    return lagrange("radial friction", "x y", text, forces={"x": drag.format("x"), "y": drag.format("y")}, c=0.3)


def damped_pair() -> LagrangianSystem:
    """Two coupled coordinates with uniform damping, a mass that depends on place, and time."""
    text = "(1 + x**2)*x_dot**2/2 + y_dot**2/2 + x_dot*y_dot/3 + cos(x) - y**2*x/4 + y*cos(2*t)/5"
    return lagrange("damped", "x y", text, damping="c*m", c=0.4, m=0.9)


def runaway() -> LagrangianSystem:
    """q'' = q^2."""
    return LagrangianSystem.from_text(name="runaway", coordinates=["q"], lagrangian="q_dot**2/2 + q**3/3")


OWN_SYSTEMS: dict[str, Callable[[], LagrangianSystem]] = {
    "driven-duffing": driven_duffing,
    "pumped-cart-pole": pumped_cart_pole,
    "forced-cart-pole": forced_cart_pole,
    "radial-friction": radial_friction,
    "damped-pair": damped_pair,
    "three-bodies": three_bodies,
    "runaway": runaway,
}

GENERIC = {
    "harmonic-oscillator": ((0.7,), (0.4,)),
    "planar-pendulum": ((0.7,), (0.4,)),
    "driven-duffing": ((0.6,), (-0.3,)),
    "relativistic-particle": ((0.5,), (0.6,)),
    "kepler": ((0.3, 0.8), (-1.1, 0.4)),
    "double-pendulum": ((0.9, -0.6), (0.5, 1.2)),
    "cart-pole": ((0.2, 0.9), (0.4, -0.7)),
    "pumped-cart-pole": ((0.2, 0.9), (0.4, -0.7)),
    "forced-cart-pole": ((0.3, 1.1), (0.5, -0.4)),
    "radial-friction": ((1.0, 0.1), (0.3, 0.8)),
    "damped-pair": ((0.3, -0.4), (0.5, 0.7)),
    "henon-heiles": ((0.1, -0.2), (0.3, 0.25)),
    "spherical-pendulum": ((0.9, 0.3), (0.4, 1.3)),
    "charged-particle": ((0.2, -0.1, 0.3), (1.0, 0.4, 0.1)),
    "three-bodies": ((0.1, 0.0, 1.1, 0.2, 0.3, 0.9), (0.2, -0.1, 0.0, 0.4, -0.3, 0.1)),
}
"""Coordinates and velocities with no symmetry and no turning point in them."""


@dataclass(frozen=True)
class Sample:
    """A system, its oracle, and one generic state."""

    name: str
    system: LagrangianSystem

    @cached_property
    def mechanics(self) -> Mechanics:
        return Mechanics(self.system)

    @cached_property
    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """(q, p) at t = 0."""
        q, v = map(numbers, GENERIC[self.name])
        return q.astype(float), self.mechanics.momentum([0], q[None], v[None])[0].astype(float)

    def oracle(self, method: Method, q: np.ndarray, p: np.ndarray, h: float, t: float = 0.0) -> np.ndarray:
        return np.array(oracle_step(self.mechanics, method.specification(), q, p, h, t))


@cache
def sample_named(name: str) -> Sample:
    return Sample(name, OWN_SYSTEMS[name]() if name in OWN_SYSTEMS else problem(name).system)


UNOPTIMISED = ("-O0", "-Dalways_inline=unused")
"""For most tests. Inlining takes a third of the time of gcc where it does not optimise."""
QUICK_FLAGS = TUNED_FLAGS if FLAGS_VARIABLE in os.environ else ("-O1", *TUNED_FLAGS[1:])
"""What users get, but for the optimisation of which most of the compilation time is made.

The flags of the environment come last: with them these are the default flags, so that tests share libraries.
"""
UNOPTIMISED_FLAGS = QUICK_FLAGS if FLAGS_VARIABLE in os.environ else (*QUICK_FLAGS, UNOPTIMISED[0])
"""For products of systems, methods and situations in any tier: half of the compilation time of ``QUICK_FLAGS``."""


def stepper_for(name: str, method: Method, *, solver: str = "auto", flags: tuple[str, ...] = QUICK_FLAGS) -> Stepper:
    return _compiled_once(name, method, solver, flags, os.environ.get(FLAGS_VARIABLE, ""))


@cache
def _compiled_once(name: str, method: Method, solver: str, flags: tuple[str, ...], wanted: str) -> Stepper:
    return compile_stepper(sample_named(name).system, method, solver=solver, flags=flags)


def compile_quickly(system: LagrangianSystem, method: Method) -> Stepper:
    return compile_stepper(system, method, flags=QUICK_FLAGS)
