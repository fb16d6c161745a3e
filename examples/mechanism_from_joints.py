"""A crane from SymPy's joints: its Lagrangian, comparison with SymPy's own equations, and its energy balance."""

import numpy as np
import sympy
from scipy.integrate import solve_ivp
from sympy.physics.mechanics import (
    Particle,
    PinJoint,
    PrismaticJoint,
    ReferenceFrame,
    RigidBody,
    System,
    TorqueActuator,
)

import scvi_codegen as sc

# A trolley on a rail, pulled by a constant force F, with a load at a pin joint that has some friction.
length, g, F, c = sympy.symbols("l g F c")
rail, trolley, load, rope = RigidBody("rail"), RigidBody("trolley"), Particle("load"), ReferenceFrame("rope")
system = System.from_newtonian(rail)
slider = PrismaticJoint("slider", rail, trolley, joint_axis=rail.x)
pin = PinJoint("pin", trolley, load, joint_axis=trolley.z, child_interframe=rope, child_point=length * rope.y)
system.add_joints(slider, pin)
system.apply_uniform_gravity(-g * system.y)
system.add_loads((trolley.masscenter, F * rail.x))
system.add_actuators(TorqueActuator.at_pin_joint(-c * pin.speeds[0], pin))
values = {"trolley_mass": 2.0, "load_mass": 0.5, "l": 0.6, "g": 9.81, "F": 1.0, "c": 0.05}

crane = sc.LagrangianSystem.from_system(system, name="crane", parameters=values)
print("L =", crane.to_text())
print("forces:", *crane.forces, sep="  ")

stepper = sc.compile_stepper(crane, sc.SVI(6))
run = stepper.integrate([0.0, 1.2], velocity=[0.1, 0.0], h=0.02, steps=500)
print(f"energy given to friction in 10 s: {-run.work()[-1]:.4f}")
print(f"energy unaccounted for: {abs(run.energy() - run.energy()[0] - run.work()).max():.0e}")

# SymPy's equations of motion, by SciPy.
system.form_eoms()
equations = system.rhs().xreplace({sympy.Symbol(name): value for name, value in values.items()})
rates = sympy.lambdify([[*system.q, *system.u]], list(equations), cse=True)
known = solve_ivp(lambda t, x: rates(x), (0, 10), [0, 1.2, 0.1, 0], method="DOP853", rtol=1e-13, atol=1e-13)
print(f"apart from SymPy's own equations after 10 s: {np.abs(known.y[:2, -1] - run.q[-1]).max():.0e}")
