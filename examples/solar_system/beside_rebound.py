"""Comparison with REBOUND: the same bodies from the same states, distances from DE421, and computing times.

REBOUND 5 with IAS15, alone for Newton and with `gr_full` of REBOUNDx for Einstein, Infeld and Hoffmann, if that is
installed (`pip install rebound reboundx`). From 1969 to 2053; best of several runs, in processor time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import ephemeris
import numpy as np
import rebound
from ephemeris import AU, BODIES
from models import Model, ladder

try:
    import reboundx
except (ImportError, OSError):  # not installed, or built for another REBOUND
    reboundx = None

REPEATS = int(sys.argv[1]) if len(sys.argv) > 1 else 3
T = np.arange(0.0, ephemeris.END_OF_FIT, 64.0)
STEP = 4.0  # days, of ours


def here(model: Model) -> np.ndarray:
    q, v = model.start
    run = model.stepper.integrate(q, velocity=v, h=STEP, steps=round(T[-1] / STEP), save_every=round(T[1] / STEP))
    return run.q.reshape(len(T), -1, 3)


def there(relativity: bool) -> np.ndarray:
    simulation = rebound.Simulation()
    simulation.integrator = "ias15"
    for mass, q, v in zip(ephemeris.masses().values(), *(each[0] for each in ephemeris.states(T[:1])), strict=True):
        simulation.add(m=mass, x=q[0], y=q[1], z=q[2], vx=v[0], vy=v[1], vz=v[2])
    if relativity:
        extras = reboundx.Extras(simulation)
        force = extras.load_force("gr_full")
        extras.add_force(force)
        force.params["c"] = ephemeris.LIGHT
    places = np.empty((len(T), len(BODIES), 3))
    for t, row in zip(T, places, strict=True):
        simulation.integrate(t)
        simulation.serialize_particle_data(xyz=row)
    return places


def best(run: Callable[[], np.ndarray]) -> tuple[np.ndarray, float]:
    seconds = []
    for _ in range(REPEATS):
        began = time.process_time()
        places = run()
        seconds.append(time.process_time() - began)
    return ephemeris.relative(places) * AU, min(seconds)


def main() -> None:
    reference = ephemeris.relative(ephemeris.states(T)[0]) * AU
    for model, relativity in zip(ladder(), (False, True), strict=False):
        if relativity and reboundx is None:
            print("REBOUNDx is not installed")
            break
        (ours, mine), (theirs, other) = best(lambda model=model: here(model)), best(lambda r=relativity: there(r))
        print(f"\n{model.name:34}" + "".join(f"{body:>9}" for body in BODIES[1:]))
        for name, places, seconds in (("SVI(8), h = 4 d", ours, mine), ("IAS15", theirs, other)):
            away = np.linalg.norm(places - reference, axis=-1).max(axis=0)
            print(f"{name:20} {seconds:7.3f} s  km " + "".join(f"{km:9.3g}" for km in away))
        apart = 1e3 * np.linalg.norm(ours - theirs, axis=-1).max(axis=0)
        print(f"{'time, ratio':20} {other / mine:7.1f}    m  " + "".join(f"{m:9.2g}" for m in apart) + "  apart")


if __name__ == "__main__":
    main()
