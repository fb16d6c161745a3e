"""Systems from sympy.physics.mechanics: a Lagrangian in dynamicsymbols, and a LagrangesMethod."""

import sympy
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

import scvi_codegen as sc

# A bead of mass m on a hoop of radius r that turns about its vertical diameter with the angular velocity Omega.
theta = dynamicsymbols("theta")
theta_dot = dynamicsymbols("theta", 1)
m, r, g, Omega = sympy.symbols("m r g Omega", positive=True)
kinetic = m * r**2 * (theta_dot**2 + Omega**2 * sympy.sin(theta) ** 2) / 2
lagrangian = kinetic + m * g * r * sympy.cos(theta)
parameters = {m: 1.0, r: 0.5, g: 9.81, Omega: 6.0}

bead = sc.LagrangianSystem.from_sympy(
    name="bead on a turning hoop", lagrangian=lagrangian, coordinates=[theta], parameters=parameters
)
same = sc.LagrangianSystem.from_lagranges_method(
    LagrangesMethod(lagrangian, [theta]), name="bead on a turning hoop", parameters=parameters
)
print("L =", bead.to_text())
print("the same from LagrangesMethod:", bead == same)

stepper = sc.compile_stepper(bead, sc.SVI(6))
run = stepper.integrate([0.3], [0.0], h=0.05, steps=10_000)
print(f"energy error over 10000 steps: {abs(run.energy() - run.energy()[0]).max():.1e}")

# Above the critical angular velocity sqrt(g/r) = 4.43 the bead swings about a tilted angle, below it about the bottom.
for speed in (3.0, 6.0):
    run = stepper.integrate([0.3], [0.0], h=0.05, steps=2000, parameters={"Omega": speed})
    print(f"Omega = {speed}: theta between {run.q.min():+.3f} and {run.q.max():+.3f}")
