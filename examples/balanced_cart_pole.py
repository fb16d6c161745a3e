"""Feedback control with zero-order hold: a linear-quadratic regulator balances a pole on a cart, sampled every 20 ms.

The linearisation about the upright pole is computed by finite differences of the compiled steps, SciPy's Riccati solver
returns the gain. The run continues between samples with a constant input, bit for bit as a single run would, and no
sample compiles anything. Finally the forces that were applied are used as a tabulated input.
"""

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from scvi_codegen import SVI, LagrangianSystem, compile_stepper

SAMPLE, STEPS = 0.02, 2
cart = LagrangianSystem.from_text(
    name="cart and pole",
    coordinates=["x", "a"],
    lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*a_dot*cos(a) + m*l**2*a_dot**2/2 - m*g*l*cos(a)",
    parameters={"M": 1.0, "m": 0.2, "l": 0.5, "g": 9.81},
    forces={"x": "u"},
    inputs=["u"],
)
stepper = compile_stepper(cart, SVI(4))


def after_a_sample(state: np.ndarray, force: float) -> np.ndarray:
    """Return (x, a, p_x, p_a) one sampling interval later."""
    run = stepper.start(state[:2], state[2:], h=SAMPLE / STEPS)
    run.set_inputs(u=force)
    run.advance(STEPS)
    return np.concatenate([run.q, run.p])


near = 1e-6
A = np.column_stack([(after_a_sample(near * e, 0.0) - after_a_sample(-near * e, 0.0)) / (2 * near) for e in np.eye(4)])
B = ((after_a_sample(np.zeros(4), near) - after_a_sample(np.zeros(4), -near)) / (2 * near))[:, np.newaxis]
mass = np.array([[1.2, 0.1], [0.1, 0.05]])  # of the upright pole
falling = np.zeros((4, 4))
falling[:2, 2:], falling[3, 1] = np.linalg.inv(mass), 0.2 * 9.81 * 0.5
print(f"the linear part is that of the formula to {np.abs(A - expm(SAMPLE * falling)).max():.0e}")

Q, R = np.diag([1.0, 10.0, 0.1, 0.1]), np.eye(1) * 0.01
P = solve_discrete_are(A, B, Q, R)
gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)

run = stepper.start([0.0, 0.35], velocity=[0.0, 0.0], h=SAMPLE / STEPS)
times, forces, tilt = [], [], []
for _ in range(300):
    force = -(gain @ np.concatenate([run.q, run.p])).item()
    run.set_inputs(u=force)
    times.append(run.t), forces.append(force), tilt.append(run.q[1])
    run.advance(STEPS)
print(f"tilt {tilt[0]:.2f} at first, {abs(tilt[100]):.0e} after 2 s, {abs(run.q[1]):.0e} after 6 s")
print(f"the largest force is {np.abs(forces).max():.1f}")

given = (np.array([*times, 6.0]), np.array([*forces, 0.0]), "constant")
again = stepper.integrate([0.0, 0.35], velocity=[0.0, 0.0], inputs={"u": given}, h=SAMPLE / STEPS, t_end=6.0)
print(f"driven by these forces as data it ends {np.abs(again.q[-1] - run.q).max():.0e} away")
