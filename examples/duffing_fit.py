"""Parameter estimation for a driven, damped Duffing oscillator from a noisy time series.

The data are computed by SciPy's DOP853, at irregular times, with gaps, and with noise of 2 per cent. A least-squares
fit with the exact derivatives of an SVI estimates stiffness, nonlinearity, damping and the initial state; its standard
errors are compared with the actual errors.
"""

import numpy as np
from scipy.integrate import solve_ivp

import scvi_codegen as sc

TRUE = {"alpha": -1.0, "beta": 1.0, "delta": 0.3, "gamma": 0.2, "omega": 1.2}
START = [0.9, 0.0]
NOISE = 0.02


def rates(t, y):
    """Return the rates of x'' = -delta x' - alpha x - beta x^3 + gamma cos(omega t)."""
    x, v = y
    force = TRUE["gamma"] * np.cos(TRUE["omega"] * t) - TRUE["delta"] * v
    return [v, force - TRUE["alpha"] * x - TRUE["beta"] * x**3]


random = np.random.default_rng(3)
times = np.sort(random.uniform(0.0, 40.0, 400))
exact = solve_ivp(rates, (0.0, 40.0), START, method="DOP853", t_eval=times, rtol=1e-12, atol=1e-12).y[0]
recorded = exact + NOISE * random.normal(size=len(times))
recorded[random.random(len(times)) < 0.1] = np.nan  # gaps in the recording

duffing = sc.LagrangianSystem.from_text(
    name="Duffing oscillator",
    coordinates=["x"],
    lagrangian="m*x_dot**2/2 - alpha*x**2/2 - beta*x**4/4",
    parameters=TRUE | {"m": 1.0},
    forces={"x": "gamma*cos(omega*t)"},
    dissipation="delta*x_dot**2/2",
)
stepper = sc.compile_stepper(duffing, sc.SVI(4))
guess = {"alpha": -0.8, "beta": 0.8, "delta": 0.2}
given = {"start": 0.0, "q": [0.8], "p": [0.1], "h": 0.2, "parameters": guess}
fit = sc.fit(stepper, times, recorded, unknown=["alpha", "beta", "delta"], **given)
print(fit)
true = np.array([TRUE["alpha"], TRUE["beta"], TRUE["delta"], *START])
away = np.abs(fit.values - true) / np.sqrt(np.diag(fit.covariance))
print(f"the largest error is {away.max():.1f} of those that the fit claims")
print(f"noise of {fit.deviations[0]:.4f}, {NOISE} was added; the motion was computed {fit.evaluations} times")

try:
    sc.fit(stepper, times, recorded, unknown=["m", "alpha", "beta", "delta", "gamma"], **given)
except sc.FitError as error:
    print(error)
