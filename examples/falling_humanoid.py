"""A humanoid from its file trips, falls and comes to rest, by steps: in less time than the fall takes.

Run with ``python examples/falling_humanoid.py [PICTURE]``: the equations are derived and compiled once, in about half a
minute, a later run takes them from the cache. PICTURE is a drawing of poses, falling_humanoid.png by default, or with
.gif or .html a moving picture.
"""

import sys
import time
from pathlib import Path

import scvi_codegen as sc

FILE = Path(__file__).with_name("humanoid.xml")
STEP, SECONDS = 2e-3, 4.0


def main(picture: str = "falling_humanoid.png") -> None:
    """Integrate the fall, compare its duration with the time that it took, and draw it."""
    humanoid = sc.LagrangianSystem.from_mjcf(FILE, limits="contact", contacts="planes")
    stepper = sc.compile_stepper(humanoid, "svi:1", transitions="by steps")
    names = [name for name in map(str, humanoid.coordinates) if not name.startswith("R_")]
    start = dict.fromkeys(names, 0.0) | {"R_root": [1, 0, 0, 0], "z_root": 1.3}
    velocity = dict.fromkeys(names, 0.0) | {"x_root": 1.5, "omega_root": [0.3, 1.0, 0.1]}
    begun = time.perf_counter()
    run = stepper.integrate(start, velocity=velocity, h=STEP, t_end=SECONDS)
    taken = time.perf_counter() - begun
    print(f"{SECONDS:g} s of motion took {taken:.2f} s: {taken / (SECONDS / STEP) * 1e6:.0f} us a step")
    at, modes = run.contact_modes[-1]
    touching = [
        f"{contact.name} {mode}" for contact, mode in zip(humanoid.contacts, modes, strict=True) if mode != "open"
    ]
    print(f"fastest velocity at the end {abs(run.velocity[-1]).max():.0e}; since t = {at:.2f} s: {', '.join(touching)}")
    lost, energy = run.lost_energy, run.energy()
    print(f"energy {energy[0]:.1f} J -> {energy[-1]:.1f} J, of which contacts took {lost:.1f} J, joints the rest")
    if picture.endswith((".gif", ".html", ".mp4")):
        run.animate(picture, seconds=SECONDS)
    else:
        run.plot(picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
