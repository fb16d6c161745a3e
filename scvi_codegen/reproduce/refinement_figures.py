"""Figures of errors of one step: over the number of points (6, 16, 17) and over the step size (7, 8, 18-20).

Their studies are those of ``refinement.toml``.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from scvi_codegen.files.toml_text import package_table
from scvi_codegen.reproduce.experiment import Experiment
from scvi_codegen.reproduce.refinement import InitialValue, Law, StepCase, Study, refinement
from scvi_codegen.reproduce.runs import KEPLER, system_of
from scvi_codegen.tables.precision import Number, mp


def _oscillator_errors(q: Sequence[Number], p: Sequence[Number], h: Number) -> dict[str, Number]:
    return {"q": abs(q[0] - mp.sin(h)), "energy": abs(q[0] ** 2 + p[0] ** 2 - 1) / 2}


def _kepler_errors(e: Number, q: Sequence[Number], p: Sequence[Number], h: Number) -> dict[str, Number]:
    """Return the errors of a step from the perihelion, by Kepler's equation."""
    minor = mp.sqrt(1 - e**2)
    anomaly = mp.findroot(lambda E: E - e * mp.sin(E) - h, h / (1 - e) if h < 1 else h)
    energy = (p[0] ** 2 + p[1] ** 2) / 2 - 1 / mp.hypot(*q) + mp.mpf(1) / 2
    errors = q[0] - mp.cos(anomaly) + e, q[1] - minor * mp.sin(anomaly), q[0] * p[1] - q[1] * p[0] - minor, energy
    return dict(zip(("q1", "q2", "momentum", "energy"), map(abs, errors), strict=True))


def _kepler(eccentricity: float) -> InitialValue:
    e = mp.mpf(eccentricity)
    fitted = tuple((1 - e) ** 1.5 * mp.mpf(h) for h in ("0.05", "0.025"))
    start = (1 - e, mp.zero), (mp.zero, mp.sqrt((1 + e) / (1 - e)))
    return InitialValue(KEPLER, *start, partial(_kepler_errors, e), fitted)


SMALL_STEPS = tuple(mp.mpf(2) ** k for k in (-8, -6, -4))
OSCILLATOR = InitialValue(system_of("harmonic-oscillator"), (mp.zero,), (mp.one,), _oscillator_errors, SMALL_STEPS)
CASES = {
    case.title: case
    for case in (
        StepCase("N points", OSCILLATOR),
        StepCase("N the degree", OSCILLATOR, 0, judged=False),
        StepCase("N the degree, N + 1 Gauss points", OSCILLATOR, 0, 1, judged=False),
        *(StepCase(f"e = {e:g}", _kepler(e), 1, -1) for e in (0.0, 0.2, 0.5)),
        StepCase("circle, N points", _kepler(0.0), 1, -1),
        StepCase("e = 0.5, N the degree", _kepler(0.5), 0, judged=False),
    )
}
STEPS = {
    "oscillator-over-h": tuple(10.0 ** (0.3 * k - 3.0) for k in range(14)),
    "kepler-over-h": tuple(float(h) for h in np.geomspace(1e-3, 3.0, 36)),
}


def _study(name: str, **changes: Any) -> Study:
    """Return a study of the file, with some of its entries changed."""
    table = {"steps": STEPS.get(name), **_TABLES["studies"][name], **changes}
    lines = {(scheme, q): Law(*law) for scheme, laws in table.pop("lines", {}).items() for q, law in laws.items()}
    powers = {q: {int(power): x for power, x in each.items()} for q, each in table.pop("powers", {}).items()}
    table |= {key: tuple(table[key]) for key in ("sentences", "quantities", "steps")}
    return Study(**table | {"cases": tuple(CASES[title] for title in table["cases"]), "lines": lines, "powers": powers})


def _figure(name: str, title: str, study: str, **changes: Any) -> Experiment:
    return refinement(name, title, _study(study, **changes))


_TABLES = package_table("reproduce/refinement.toml")
STUDIES = {name: _study(name) for name in _TABLES["studies"]}
EXPERIMENTS = tuple(_figure(name, **table) for name, table in _TABLES.items() if name != "studies")
