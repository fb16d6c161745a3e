"""Orbits of Kepler's problem in 40 digits, and steppers of the recorded motions."""

import mpmath
import numpy as np
from extrapolation import Real
from motions import MOTIONS

import scvi_codegen as sc


def on_an_ellipse(q, p, times):
    """Kepler's problem with mu = 1 in 40 digits, by his equation; (n, 4) states at times, from (q, p) at the first."""
    with mpmath.workdps(40):
        (x, y), (vx, vy) = map(mpmath.mpf, q), map(mpmath.mpf, p)
        r = mpmath.hypot(x, y)
        a = 1 / (2 / r - vx**2 - vy**2)
        n, e_sin, e_cos = a ** mpmath.mpf(-1.5), (x * vx + y * vy) / mpmath.sqrt(a), 1 - r / a
        found = []
        for t in times:
            mean = n * (mpmath.mpf(float(t)) - mpmath.mpf(float(times[0])))
            g = mean  # change of the eccentric anomaly: g - e_cos sin g + e_sin (1 - cos g) = mean
            low, high = mean - 2, mean + 2
            for _ in range(300):
                rest = g - e_cos * mpmath.sin(g) + e_sin * (1 - mpmath.cos(g)) - mean
                low, high = (low, g) if rest > 0 else (g, high)
                new = g - rest / (1 - e_cos * mpmath.cos(g) + e_sin * mpmath.sin(g))
                new = new if low < new < high else (low + high) / 2
                if abs(new - g) < mpmath.mpf(10) ** -38:
                    break
                g = new
            f, h = 1 - a / r * (1 - mpmath.cos(g)), (mean - g + mpmath.sin(g)) / n
            now = a * (1 - e_cos * mpmath.cos(g) + e_sin * mpmath.sin(g))
            f_dot, h_dot = -mpmath.sqrt(a) / (now * r) * mpmath.sin(g), 1 - a / now * (1 - mpmath.cos(g))
            state = (f * x + h * vx, f * y + h * vy, f_dot * x + h_dot * vx, f_dot * y + h_dot * vy)
            found.append([Real(mpmath.nstr(each, 30)) for each in state])
    return np.array(found)


def motion_stepper(name):
    motion = MOTIONS[name]
    system = sc.LagrangianSystem.from_text(
        "motion", motion.coordinates.split(), motion.lagrangian, forces=motion.forces
    )
    start = {"q": motion.q, "p": motion.p, "t": motion.span[0], "t_end": motion.span[1]}
    return sc.compile_stepper(system, motion.method), start
