"""Redraw ``docs/_static/motions.svg``, the animation of the README: a figure-eight orbit, a double pendulum, two kinks.

Coordinates of each frame are computed by this package; SMIL animates them in any browser, without a script.
"""

from pathlib import Path

import numpy as np

import scvi_codegen as sc

FILM = Path(__file__).resolve().parents[2] / "docs" / "_static" / "motions.svg"
WIDTH, HEIGHT, SECONDS, FRAMES = 300, 230, 9, 150
HEAD = f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {3 * WIDTH} {HEIGHT + 24}" role="img" \
aria-label="Three motions computed by scvi_codegen: a figure-eight orbit, a double pendulum, two colliding kinks">
<style>
svg {{ --ink: #1c1f24; --muted: #59616b; --c0: #1f6fb4; --c1: #d1661a; --c2: #2e8b57; }}
@media (prefers-color-scheme: dark) {{
  svg {{ --ink: #e3e4e6; --muted: #a0a7b0; --c0: #6cb2f2; --c1: #f0a05a; --c2: #6fcf97; }}
}}
path, polyline {{ fill: none; stroke-linejoin: round; }}
text {{ font: 12px system-ui, sans-serif; fill: var(--muted); text-anchor: middle; }}
</style>
"""


def animated(attribute: str, values: list[str]) -> str:
    """Return the element that animates an attribute of its parent through values, forever."""
    listed = ";".join(values)
    return f'<animate attributeName="{attribute}" dur="{SECONDS}s" repeatCount="indefinite" values="{listed}"/>'


def listed(points: np.ndarray) -> str:
    """Return points (n, 2) as the attribute of a polyline."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


def figure_eight() -> str:
    """Return three bodies on their common curve, a third of the period apart."""
    bodies = sc.LagrangianSystem.from_text(
        "three bodies",
        coordinates=["x1", "y1", "x2", "y2", "x3", "y3"],
        lagrangian="(x1_dot**2 + y1_dot**2 + x2_dot**2 + y2_dot**2 + x3_dot**2 + y3_dot**2)/2"
        " + 1/sqrt((x1 - x2)**2 + (y1 - y2)**2)"
        " + 1/sqrt((x2 - x3)**2 + (y2 - y3)**2) + 1/sqrt((x3 - x1)**2 + (y3 - y1)**2)",
    )
    orbit = sc.periodic_orbit(
        sc.compile_stepper(bodies, "svi:8"),
        [0.97, -0.243, -0.97, 0.243, 0.0, 0.0],
        velocity=[0.466, 0.432, 0.466, 0.432, -0.932, -0.864],
        period=6.32591398,
        fixed_period=True,
        steps=FRAMES,
    )
    places = np.array([WIDTH / 2, HEIGHT / 2]) + orbit.run().q.reshape(-1, 3, 2) * [118.0, -118.0]
    parts = [f'<path d="M{listed(places[:, 0])}Z" stroke="var(--muted)" opacity="0.4"/>']
    for k in range(3):
        x, y = ([f"{value:.1f}" for value in places[:, k, axis]] for axis in (0, 1))
        parts.append(f'<circle r="7" fill="var(--c{k})">{animated("cx", x)}{animated("cy", y)}</circle>')
    return "".join(parts)


def double_pendulum() -> str:
    """Return a double pendulum released at rest, and its way back: the motion is reversible."""
    problem = sc.problem("double-pendulum")
    run = sc.compile_stepper(problem.system, "svi:8").integrate(
        [2.0, 2.5], velocity=[0.0, 0.0], h=SECONDS / FRAMES / 2, steps=FRAMES, save_every=1
    )
    forward = np.arange(0, FRAMES + 1, 2)
    rods = np.stack([np.sin(run.q), np.cos(run.q)], axis=2) * 52.0
    places = np.array([WIDTH / 2, HEIGHT / 2]) + np.concatenate([0 * rods[:, :1], np.cumsum(rods, axis=1)], axis=1)
    ends = places[np.concatenate([forward, forward[::-1]])]
    tip = listed(places[:, 2])
    parts = [
        f'<path d="M{tip}" stroke="var(--c1)" opacity="0.4"/>',
        f'<polyline stroke="var(--ink)" stroke-width="2.5">{animated("points", list(map(listed, ends)))}</polyline>',
    ]
    for k in (1, 2):
        x, y = ([f"{value:.1f}" for value in ends[:, k, axis]] for axis in (0, 1))
        parts.append(f'<circle r="8" fill="var(--c{k - 1})">{animated("cx", x)}{animated("cy", y)}</circle>')
    return "".join(parts)


def kinks() -> str:
    """Return the graph of two kinks of the sine-Gordon equation, which repel, and their way back."""
    field = sc.FieldSystem.from_text(
        "sine-Gordon", fields=["u"], space={"x": (-20, 20)}, density="u_t**2/2 - u_x**2/2 - (1 - cos(u))"
    )
    mesh = field.discretise("spectral-elements", degree=8, elements=20)
    x, v = mesh.points["x"], 0.5
    gamma, early = 1 / np.sqrt(1 - v * v), 14.0
    over, under = np.sinh(gamma * x), np.cosh(gamma * v * early)
    rate = 4 * v**2 * gamma * over * np.sinh(gamma * v * early) / (under**2 + v**2 * over**2)
    run = sc.compile_stepper(mesh.system, "svi:4").integrate(
        {"u": 4 * np.arctan(v * over / under)}, velocity={"u": rate}, h=0.05, steps=560, save_every=8
    )
    shown = np.linspace(-20, 20, 61)
    rows = [np.interp(shown, x, row) for row in run.q["u"]]
    places = [np.column_stack([WIDTH / 2 + 6.6 * shown, HEIGHT / 2 - 13.5 * row]) for row in rows]
    values = [listed(each) for each in places + places[::-1]]
    axis = f'<path d="M18 {HEIGHT / 2}H{WIDTH - 18}" stroke="var(--muted)" opacity="0.4"/>'
    return f'{axis}<polyline stroke="var(--c0)" stroke-width="2.5">{animated("points", values)}</polyline>'


def film() -> str:
    """Return the SVG."""
    panels = {
        "figure-eight orbit": figure_eight(),
        "double pendulum": double_pendulum(),
        "two kinks, sine-Gordon": kinks(),
    }
    parts = [
        f'<g transform="translate({k * WIDTH} 0)">{panel}<text x="{WIDTH / 2}" y="{HEIGHT + 12}">{title}</text></g>\n'
        for k, (title, panel) in enumerate(panels.items())
    ]
    return HEAD + "".join(parts) + "</svg>\n"


if __name__ == "__main__":
    FILM.write_text(film(), encoding="utf-8")
    print(FILM.name, FILM.stat().st_size)
