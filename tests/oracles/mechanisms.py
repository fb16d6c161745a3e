"""Mechanisms published with SymPy and PyDy, and their motion by SymPy's own equations and SciPy's DOP853."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import sympy
from scipy.integrate import solve_ivp
from sympy import Matrix, sin, symbols
from sympy.core.function import AppliedUndef
from sympy.physics.mechanics import (
    KanesMethod,
    LagrangesMethod,
    Lagrangian,
    LinearDamper,
    LinearPathway,
    LinearSpring,
    Particle,
    PinJoint,
    Point,
    PrismaticJoint,
    ReferenceFrame,
    RigidBody,
    System,
    TorqueActuator,
    dynamicsymbols,
    inertia,
)
from sympy.physics.mechanics.models import n_link_pendulum_on_cart

from scvi_codegen import LagrangianSystem

T = dynamicsymbols._t
G = 9.81
EASY = 5
"""Coordinates for which SymPy solves its equations in seconds."""


@dataclass(frozen=True)
class Mechanism:
    """A method of SymPy with its equations formed, or a System, and a state to begin in.

    Attributes:
        model: the method or system.
        read: the reader of this project for it.
        constants: value by name, of parameters and of functions of time that stay constant.
        q, u: (m,) coordinates and generalised speeds at the start, in the model's order.
        span: a time in which it moves a good way.
    """

    model: Any
    read: Callable[..., LagrangianSystem]
    constants: dict[str, float]
    q: tuple[float, ...]
    u: tuple[float, ...]
    span: float = 1.0

    def system(self) -> LagrangianSystem:
        """Return the system as read by this project."""
        return self.read(self.model, name="mechanism", parameters=self.constants)

    @property
    def method(self) -> Any:
        """SymPy's method that forms the equations."""
        return self.model.eom_method if isinstance(self.model, System) else self.model

    def speeds_to_rates(self, q: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dq/dt, by SymPy's kinematic equations."""
        return self._numbers(self._kinematics())(q, u)

    def _kinematics(self) -> Matrix:
        if isinstance(self.method, LagrangesMethod):
            return self.method.q.diff(T)
        rates = self.method.kindiffdict()
        return Matrix([rates[q.diff(T)] for q in self.method.q])

    def _numbers(self, expressions: Matrix) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        speeds = list(self.method.q.diff(T) if isinstance(self.method, LagrangesMethod) else self.method.u)
        state = [*self.method.q, *speeds]
        plain = {function: sympy.Dummy() for function in state}
        named = {f: self.constants[f.func.__name__] for f in expressions.atoms(AppliedUndef) if f not in plain}
        named |= {s: self.constants[s.name] for s in expressions.free_symbols if s.name in self.constants}
        f = sympy.lambdify([list(plain.values())], expressions.xreplace(plain).xreplace(named), cse=True)
        return lambda q, u: np.asarray(f(np.concatenate([q, u])), dtype=float)[:, 0]

    def _rates(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        return self._numbers(Matrix(self.method.rhs()[: 2 * len(self.q)]))

    def _rates_solved_for(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Solve the linear equations numerically, where SymPy would take minutes."""
        size = 2 * len(self.q)
        rows = self._numbers(Matrix([*self.method.forcing_full, *self.method.mass_matrix_full]))

        def rates(q: np.ndarray, u: np.ndarray) -> np.ndarray:
            found = rows(q, u)
            return np.linalg.solve(found[size:].reshape(size, size), found[:size])

        return rates

    def motion(self) -> tuple[np.ndarray, np.ndarray]:
        """q and dq/dt after the span, by SymPy's ``rhs()`` and DOP853."""
        m = len(self.q)
        rhs = self._rates() if m < EASY else self._rates_solved_for()
        found = solve_ivp(
            lambda t, y: rhs(y[:m], y[m:]),
            (0.0, self.span),
            [*self.q, *self.u],
            method="DOP853",
            rtol=1e-13,
            atol=1e-14,
        )
        q, u = found.y[:m, -1], found.y[m:, -1]
        return q, self.speeds_to_rates(q, u)


def links_on_a_cart(n: int) -> Mechanism:
    """``sympy.physics.mechanics.models.n_link_pendulum_on_cart``, pushed by a constant force."""
    constants = {f"m{i}": 1.0 + 0.1 * i for i in range(n + 1)} | {f"l{i}": 0.8 - 0.05 * i for i in range(n)}
    q = (0.1, *(0.4 + 0.2 * i for i in range(n)))
    model = n_link_pendulum_on_cart(n, cart_force=True)
    return Mechanism(model, LagrangianSystem.from_kanes_method, constants | {"g": G, "F": 1.5}, q, (0.2,) * (n + 1))


def standing_human() -> Mechanism:
    """PyDy's tutorial: lower leg, upper leg and torso in the plane, with torques at ankle, knee and hip."""
    angles, speeds, torques = (dynamicsymbols(f"{name}1:4") for name in ("theta", "omega", "T"))
    masses, lengths, centres, moments = (symbols(f"{name}1:4") for name in ("m", "l", "d", "I"))
    g = sympy.Symbol("g")
    ground, joint = ReferenceFrame("N"), Point("A")
    joint.set_vel(ground, 0)
    parent, bodies, loads = ground, [], []
    for i in range(3):
        frame = ReferenceFrame(f"B{i}")
        frame.orient_axis(parent, parent.z, angles[i])
        frame.set_ang_vel(parent, speeds[i] * parent.z)
        centre = joint.locatenew(f"C{i}", centres[i] * frame.y)
        centre.v2pt_theory(joint, ground, frame)
        bodies.append(RigidBody(f"body{i}", centre, frame, masses[i], (inertia(frame, 0, 0, moments[i]), centre)))
        loads += [(centre, -masses[i] * g * ground.y), (frame, torques[i] * ground.z), (parent, -torques[i] * ground.z)]
        after = joint.locatenew(f"J{i}", lengths[i] * frame.y)
        after.v2pt_theory(joint, ground, frame)
        joint, parent = after, frame
    kinematics = [q.diff(T) - u for q, u in zip(angles, speeds, strict=True)]
    model = KanesMethod(ground, q_ind=angles, u_ind=speeds, kd_eqs=kinematics)
    model.kanes_equations(bodies, loads)
    values = [("m", 6, 14, 40), ("l", 0.6, 0.4, 0.5), ("d", 0.35, 0.2, 0.3), ("I", 0.2, 0.3, 2), ("T", 40, -20, 15)]
    constants = {f"{name}{i}": each for name, *three in values for i, each in enumerate(three, 1)} | {"g": G}
    return Mechanism(model, LagrangianSystem.from_kanes_method, constants, (0.2, -0.1, 0.3), (0.1, 0.2, -0.4), 0.3)


def four_bar_linkage() -> Mechanism:
    """SymPy's documentation, *Multi Degree of Freedom Holonomic System* with joints, closed by two constraints."""
    lengths, rho = symbols("l1:5"), sympy.Symbol("rho")
    frame = ReferenceFrame("N")
    links = [
        RigidBody(f"link{i}", mass=rho * each, frame=frame if i == 1 else None) for i, each in enumerate(lengths, 1)
    ]
    for link, each in zip(links, lengths, strict=True):
        link.central_inertia = inertia(link.frame, 0, 0, rho * each**3 / 12)
    model = System.from_newtonian(links[0])
    angles, speeds = dynamicsymbols("q1:4"), dynamicsymbols("u1:4")
    for i in range(3):
        parent, child = links[i], links[i + 1]
        model.add_joints(
            PinJoint(
                f"J{i}",
                parent,
                child,
                coordinates=angles[i],
                speeds=speeds[i],
                parent_point=lengths[i] / 2 * parent.x,
                child_point=-lengths[i + 1] / 2 * child.x,
                joint_axis=parent.z,
            )
        )
    first, last = links[0], links[3]
    loop = last.masscenter.pos_from(first.masscenter) + lengths[0] / 2 * first.x + lengths[3] / 2 * last.x
    model.add_holonomic_constraints(loop.dot(first.x), loop.dot(first.y))
    model.apply_uniform_gravity(-sympy.Symbol("g") * first.y)
    model.q_ind, model.q_dep, model.u_ind, model.u_dep = angles[:1], angles[1:], speeds[:1], speeds[1:]
    model.form_eoms()
    constants = {"l1": 0.13, "l2": 0.24, "l3": 0.21, "l4": 0.34, "rho": 997.0, "g": G}
    q = (2.1, 0.6655470375077588, 2.527408138024188)  # on the constraints, from SymPy's own test
    u = (0.2, -0.17963733938852067, 0.1309060540601612)
    return Mechanism(model, LagrangianSystem.from_system, constants, q, u, 0.2)


def disc_on_an_incline() -> Mechanism:
    """SymPy's test of ``LagrangesMethod`` with a holonomic constraint: a disc that rolls down a plane."""
    (y, theta), (m, g, r, length, alpha) = dynamicsymbols("y theta"), symbols("m g R l alpha")
    ground = ReferenceFrame("N")
    plane = ground.orientnew("A", "Axis", [sympy.pi / 2 - alpha, ground.z])
    turned = plane.orientnew("B", "Axis", [-theta, plane.z])
    centre = Point("Do")
    centre.set_vel(ground, y.diff(T) * plane.x)
    disc = RigidBody("D", centre, turned, m, (m * r**2 / 2 * (turned.z | turned.z), centre))
    disc.potential_energy = m * g * (length - y) * sin(alpha)
    model = LagrangesMethod(Lagrangian(ground, disc), [y, theta], hol_coneqs=[y - r * theta], bodies=[disc])
    model.form_lagranges_equations()
    constants = {"m": 2.0, "g": G, "R": 0.3, "l": 1.0, "alpha": 0.4}
    return Mechanism(model, LagrangianSystem.from_lagranges_method, constants, (0.15, 0.5), (0.3, 1.0))


def rolling_disc() -> Mechanism:
    """SymPy's documentation, *A rolling disc, with Kane's method*: no slip is built into the velocities."""
    (q1, q2, q3), (u1, u2, u3), (r, m, g) = dynamicsymbols("q1:4"), dynamicsymbols("u1:4"), symbols("r m g")
    ground = ReferenceFrame("N")
    yaw = ground.orientnew("Y", "Axis", [q1, ground.z])
    lean = yaw.orientnew("L", "Axis", [q2, yaw.x])
    turned = lean.orientnew("R", "Axis", [q3, lean.y])
    rates = turned.ang_vel_in(ground)
    turned.set_ang_vel(ground, u1 * lean.x + u2 * lean.y + u3 * lean.z)
    contact = Point("C")
    contact.set_vel(ground, 0)
    centre = contact.locatenew("Dmc", r * lean.z)
    centre.v2pt_theory(contact, ground, turned)
    moments = inertia(lean, m / 4 * r**2, m / 2 * r**2, m / 4 * r**2)
    kinematics = [(turned.ang_vel_in(ground) - rates).dot(axis) for axis in lean]
    model = KanesMethod(ground, q_ind=[q1, q2, q3], u_ind=[u1, u2, u3], kd_eqs=kinematics)
    model.kanes_equations([RigidBody("disc", centre, turned, m, (moments, centre))], [(centre, -m * g * yaw.z)])
    return Mechanism(
        model, LagrangianSystem.from_kanes_method, {"r": 0.4, "m": 1.2, "g": G}, (0.3, 0.2, 0.1), (0.4, 6.0, 0.3)
    )


def chaos_pendulum() -> Mechanism:
    """PyDy's example: a plate that turns about a rod that swings, with joints."""
    mA, mB, lA, lB, IAxx, IBxx, IByy, IBzz, g = symbols("mA mB lA lB IAxx IBxx IByy IBzz g")
    theta, phi, omega, alpha = dynamicsymbols("theta phi omega alpha")
    rod, plate, ceiling = RigidBody("rod", mass=mA), RigidBody("plate", mass=mB), RigidBody("ceiling")
    rod.central_inertia = inertia(rod.frame, IAxx, IAxx, 0)
    plate.central_inertia = inertia(plate.frame, IBxx, IByy, IBzz)
    model = System.from_newtonian(ceiling)
    model.add_joints(
        PinJoint("J1", ceiling, rod, theta, omega, child_point=-lA * rod.z, joint_axis=ceiling.y),
        PinJoint("J2", rod, plate, phi, alpha, parent_point=(lB - lA) * rod.z, joint_axis=rod.z),
    )
    model.apply_uniform_gravity(g * ceiling.z)
    model.form_eoms()
    constants = {"mA": 0.01, "mB": 0.1, "lA": 0.075 / 2, "lB": 0.075, "g": G}
    constants |= {"IAxx": 5e-6, "IBxx": 2e-4, "IByy": 5e-5, "IBzz": 2.5e-4}
    return Mechanism(model, LagrangianSystem.from_system, constants, (0.8, 0.1), (0.0, 1.0))


def particles_on_a_spring() -> Mechanism:
    """Two particles in the plane, joined by a spring and a damper along a ``LinearPathway``."""
    (x1, y1, x2, y2), (m, k, c, rest, g) = dynamicsymbols("x1 y1 x2 y2"), symbols("m k c rest g")
    frame, origin = ReferenceFrame("N"), Point("O")
    model = System(frame, origin)
    ends = []
    for name, x, y in (("P", x1, y1), ("Q", x2, y2)):
        point = origin.locatenew(name, x * frame.x + y * frame.y)
        point.set_vel(frame, x.diff(T) * frame.x + y.diff(T) * frame.y)
        model.add_bodies(Particle(name, point, m))
        ends.append(point)
    model.add_coordinates(x1, y1, x2, y2)
    model.add_speeds(*(q.diff(T) for q in (x1, y1, x2, y2)))
    pathway = LinearPathway(*ends)
    model.add_actuators(LinearSpring(k, pathway, equilibrium_length=rest), LinearDamper(c, pathway))
    model.apply_uniform_gravity(-g * frame.y)
    model.form_eoms(LagrangesMethod)
    constants = {"m": 0.7, "k": 25.0, "c": 0.3, "rest": 0.8, "g": G}
    return Mechanism(model, LagrangianSystem.from_system, constants, (0.0, 0.1, 1.1, 0.3), (0.2, 0.5, -0.1, 0.9))


def pendulum_on_a_slider() -> Mechanism:
    """The example of SymPy's ``System``: a cart on a rail, a pendulum at a pin joint, and friction in the pin."""
    length, F, g, c = symbols("l F g c")
    rail, cart, bob = RigidBody("rail"), RigidBody("cart"), Particle("bob")
    rod = ReferenceFrame("bob_frame")
    model = System.from_newtonian(rail)
    slider = PrismaticJoint("slider", rail, cart, joint_axis=rail.x)
    pin = PinJoint("pin", cart, bob, joint_axis=cart.z, child_interframe=rod, child_point=length * rod.y)
    model.add_joints(slider, pin)
    model.apply_uniform_gravity(-g * model.y)
    model.add_loads((cart.masscenter, F * rail.x))
    model.add_actuators(TorqueActuator.at_pin_joint(-c * pin.speeds[0], pin))
    model.form_eoms()
    constants = {"cart_mass": 2.0, "bob_mass": 0.5, "l": 0.6, "F": 1.0, "g": G, "c": 0.05}
    return Mechanism(model, LagrangianSystem.from_system, constants, (0.1, 2.8), (0.0, 0.3))


def bicycle() -> KanesMethod:
    """SymPy's documentation, *A bicycle*: wheels that roll without slip; its equations are not formed."""
    (q1, q2, q4, q5), (u1, u2, u3, u4, u5, u6) = dynamicsymbols("q1 q2 q4 q5"), dynamicsymbols("u1:7")
    tilt, rear, front, wheelbase, rake, length, g = symbols("htangle WRrad WFrad framelength forkoffset forklength g")
    ground = ReferenceFrame("N")
    yaw = ground.orientnew("Y", "Axis", [q1, ground.z])
    lean = yaw.orientnew("R", "Axis", [q2, yaw.x])
    frame = lean.orientnew("Frame", "Axis", [q4 + tilt, lean.y])
    fork = frame.orientnew("Fork", "Axis", [q5, frame.x])
    wheels = ReferenceFrame("WR"), ReferenceFrame("WF")
    turning = [(yaw, ground, u1 * yaw.z), (lean, yaw, u2 * lean.x), (frame, lean, u4 * frame.y)]
    turning += [(fork, frame, u5 * fork.x), (wheels[0], frame, u3 * frame.y), (wheels[1], fork, u6 * fork.y)]
    for one, other, rate in turning:
        one.set_ang_vel(other, rate)
    contact = Point("WR_cont")
    contact.set_vel(ground, 0)
    rear_centre = contact.locatenew("WR_mc", rear * lean.z)
    rear_centre.v2pt_theory(contact, ground, wheels[0])
    head = rear_centre.locatenew("Steer", wheelbase * frame.z)
    head.v2pt_theory(rear_centre, ground, frame)
    front_centre = head.locatenew("WF_mc", length * fork.x + rake * fork.z)
    front_centre.v2pt_theory(head, ground, fork)
    down = (fork.y.dot(yaw.z) * fork.y - yaw.z).normalize()
    touching = front_centre.locatenew("WF_cont", front * down)
    touching.v2pt_theory(front_centre, ground, wheels[1])
    bodies = []
    for name, centre, turned, at in (
        ("frame", head, frame, frame),
        ("fork", front_centre, fork, fork),
        ("rear", rear_centre, wheels[0], frame),
        ("front", front_centre, wheels[1], fork),
    ):
        moments = inertia(at, *symbols(f"I{name}11 I{name}22 I{name}11"))
        bodies.append(RigidBody(name, centre, turned, sympy.Symbol(f"m{name}"), (moments, centre)))
    return KanesMethod(
        ground,
        q_ind=[q1, q2, q5],
        q_dependent=[q4],
        configuration_constraints=[touching.pos_from(contact).dot(yaw.z)],
        u_ind=[u2, u3, u5],
        u_dependent=[u1, u4, u6],
        velocity_constraints=[touching.vel(ground).dot(axis) for axis in yaw],
        kd_eqs=[q.diff(T) - u for q, u in ((q1, u1), (q2, u2), (q4, u4), (q5, u5))],
        bodies=bodies,
        forcelist=[(body.masscenter, -body.mass * g * yaw.z) for body in bodies],
    )


MECHANISMS: dict[str, Callable[[], Mechanism]] = {
    "two links on a cart": cache(lambda: links_on_a_cart(2)),
    "standing human": cache(standing_human),
    "four-bar linkage": cache(four_bar_linkage),
    "disc on an incline": cache(disc_on_an_incline),
    "rolling disc": cache(rolling_disc),
    "chaos pendulum": cache(chaos_pendulum),
    "particles on a spring": cache(particles_on_a_spring),
    "pendulum on a slider": cache(pendulum_on_a_slider),
}
"""By name; each is made once."""
